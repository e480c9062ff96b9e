"""Making the shipped weights: the weights of recorded runs, in half precision, each file with the name of its run.

Half precision rounds the weights by less than a thousandth.
"""

import json
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from zerobev.common.errors import InputError
from zerobev.common.storage import replacing
from zerobev.experiments.depth_pretraining import DepthPretraining
from zerobev.experiments.registry import experiment
from zerobev.experiments.runs import run_key, train_run
from zerobev.experiments.workspace import Workspace
from zerobev.inference.shipped_weights import DEPTH, FOLDER, ROWS

#: Scale and seed of the runs.
SCALE = "reduced"
_SEED = 0


def halve(source: Path, target: Path, run: str) -> None:
    """Write the checkpoint `source` to `target` in half precision, with the name of its run.

    Raises `InputError` where a weight is out of half precision's range.
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


def runs() -> dict[str, str]:
    """Name of the recorded run that each shipped file has to come from."""
    workspace = Workspace(SCALE)
    keys = {row: run_key(experiment(row), workspace, _SEED) for row in ROWS}
    return keys | {DEPTH: DepthPretraining(workspace).key}


def write_weights(folder: Path = FOLDER) -> None:
    """Write the weights of all rows and of the depth estimator; missing ones are trained first."""
    workspace = Workspace(SCALE)
    for name, key in runs().items():
        if name == DEPTH:
            trained = DepthPretraining(workspace).weights
        else:
            trained = workspace.runs / key / "model.safetensors"
            if not trained.exists():
                train_run(experiment(name), workspace, _SEED, key)
        halve(trained, folder / f"{name}.safetensors", key)
