"""Make the shipped weights: the weights of recorded runs, in half precision, each file with the name of its run.

Reads the checkpoints of the runs in `.cache` (trained now if they are missing); writes `zerobev/inference/shipped/`.
Half precision rounds the weights by less than a thousandth.
"""

import argparse
import json
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from zerobev.common.errors import InputError
from zerobev.common.paths import checkout
from zerobev.common.storage import replacing
from zerobev.experiments.registry import experiment
from zerobev.experiments.runs import Run
from zerobev.experiments.workspace import Workspace
from zerobev.inference.shipped_weights import DEPTH, FOLDER, ROWS

#: Scale and seed of the runs.
SCALE = "reduced"
_SEED = 0


def halve(source: Path, target: Path, run: str) -> None:
    """Write the checkpoint `source` to `target` in half precision, with the name of its run.

    Raises `InputError` if a weight is out of half precision's range.
    """
    with safe_open(source, framework="pt") as file:
        described = json.loads(file.metadata()["zerobev"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (not a mapping)
    halves = {name: t.half() if t.is_floating_point() else t for name, t in tensors.items()}
    for name, tensor in halves.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            raise InputError(f"{source}: expected weights within half precision, found others in {name}")
    # one entry, since the order of several is not fixed
    metadata = {"zerobev": json.dumps({**described, "run": run}, sort_keys=True)}
    with replacing(target) as temporary:
        save_file(halves, temporary, metadata=metadata)
        temporary.chmod(0o644)


def released_runs() -> dict[str, str]:
    """Name of the recorded run that each shipped file has to come from."""
    runs = _runs()
    return {row: run.key for row, run in runs.items()} | {DEPTH: runs[ROWS[0]].pretraining.key}


def write_weights(folder: Path = FOLDER) -> None:
    """Write the weights of all rows and of the depth estimator; missing ones are trained first."""
    runs = _runs()
    for row, run in runs.items():
        if not run.weights.exists():
            run.train()
        halve(run.weights, folder / f"{row}.safetensors", run.key)
    pretraining = runs[ROWS[0]].pretraining
    halve(pretraining.weights, folder / f"{DEPTH}.safetensors", pretraining.key)


def _runs() -> dict[str, Run]:
    workspace = Workspace(SCALE)
    return {row: Run(experiment(row), workspace, _SEED) for row in ROWS}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`zerobev release` has no arguments."""


def run(options: argparse.Namespace) -> None:
    """Write the weights into the package; an `InputError` outside a checkout."""
    if checkout() is None:
        raise InputError("release: expected a checkout of the project, found an installed package")
    write_weights()
