"""Make the shipped weights: weights of recorded runs in half precision, each file with the key of its run.

Reads the weights of the runs in `.cache` (trained now if they are missing); writes `zerobev/inference/shipped/`. Half
precision changes a weight by less than a thousandth of it.
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
from zerobev.experiments.depth_pretraining import DepthPretraining
from zerobev.experiments.registry import experiment
from zerobev.experiments.runs import Run
from zerobev.experiments.workspace import Workspace
from zerobev.inference.shipped_weights import DEPTH, FOLDER, ROWS

SCALE = "deploy"
_SEED = 0


def halve(source: Path, target: Path, run: str) -> None:
    """Write the weights of `source` to `target` in half precision, with the key `run`.

    Raises `InputError` if a weight is too large for half precision.
    """
    with safe_open(source, framework="pt") as file:
        described = json.loads(file.metadata()["zerobev"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (not a mapping)
    halves = {name: t.half() if t.is_floating_point() else t for name, t in tensors.items()}
    for name, tensor in halves.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            raise InputError(f"{source}: expected weights within half precision, found others in {name}")
    # one entry: the order of several is not fixed
    metadata = {"zerobev": json.dumps({**described, "run": run}, sort_keys=True)}
    with replacing(target) as temporary:
        save_file(halves, temporary, metadata=metadata)


def sources() -> dict[str, Run | DepthPretraining]:
    """The run, or the depth pretraining, of each shipped file; keys are the files' stems."""
    workspace = Workspace(SCALE)
    return {row: Run(experiment(row), workspace, _SEED) for row in ROWS} | {DEPTH: DepthPretraining(workspace)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`zerobev release` has no arguments."""


def run(options: argparse.Namespace) -> None:
    """Write the weights into the package. Raises `InputError` outside a checkout."""
    if checkout() is None:
        raise InputError("release: expected a checkout of the project, found an installed package")
    for name, source in sources().items():
        weights = source.trained() if isinstance(source, Run) else source.weights
        halve(weights, FOLDER / f"{name}.safetensors", source.key)
