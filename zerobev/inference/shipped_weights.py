"""Trained weights shipped with the package; made by `experiments.release`."""

import json
from pathlib import Path

from safetensors import safe_open

from zerobev.common.errors import InputError

#: Rows with shipped weights; the last one is the default of `zerobev.load`.
ROWS = ("c", "f.r", "d")
#: Name of the depth estimator among the shipped files.
DEPTH = "depth"

FOLDER = Path(__file__).with_name("shipped")


def shipped(name: str) -> Path:
    """File of the weights of a row, or of the depth estimator. Raises `InputError` if it is missing."""
    path = FOLDER / f"{name}.safetensors"
    if not path.is_file():
        raise InputError(f"{path}: expected shipped weights, found nothing")
    return path


def run_of(path: Path) -> str:
    """Name of the recorded run of a shipped file."""
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["zerobev"])["run"]


def shipped_runs() -> dict[str, str]:
    """Name of the recorded run of each shipped file."""
    return {name: run_of(shipped(name)) for name in (*ROWS, DEPTH)}
