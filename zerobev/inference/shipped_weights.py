"""The trained weights that ship with the package; `experiments.release` makes them."""

import json
from pathlib import Path

from safetensors import safe_open

from zerobev.common.errors import InputError

#: Rows whose weights ship; `zerobev.load()` gives the last one.
ROWS = ("c", "d")
#: Name of the depth estimator among the shipped files.
DEPTH = "depth"

FOLDER = Path(__file__).with_name("shipped")


def shipped(name: str) -> Path:
    """The file of a row's weights, or of the depth estimator's; an `InputError` where it is missing."""
    path = FOLDER / f"{name}.safetensors"
    if not path.is_file():
        raise InputError(f"{path}: expected weights that ship with the package, found nothing")
    return path


def run_of(path: Path) -> str:
    """Name of the recorded run that a shipped file comes from."""
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["zerobev"])["run"]


def shipped_runs() -> dict[str, str]:
    """Name of the recorded run that each shipped file comes from."""
    return {name: run_of(shipped(name)) for name in (*ROWS, DEPTH)}
