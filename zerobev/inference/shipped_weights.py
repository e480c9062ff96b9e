"""The trained weights that ship with the package: `python -m zerobev.inference.shipped_weights` makes them again.

They are those of recorded runs, in half precision, which is a rounding of the weights by less than a thousandth. Each
file names its run.
"""

import argparse
import json
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from zerobev.common.errors import InputError, run_command
from zerobev.common.storage import replacing

#: The scale of the runs, and the rows that ship; the last one is what `zerobev.load()` gives.
SCALE = "reduced"
ROWS = ("c", "d")
#: Name of the depth estimator among them.
DEPTH = "depth"

FOLDER = Path(__file__).with_name("shipped")
_SEED = 0


def shipped(name: str) -> Path:
    """The file of a row's weights, or of the depth estimator's; an `InputError` where it is missing."""
    path = FOLDER / f"{name}.safetensors"
    if not path.is_file():
        raise InputError(f"{path}: expected weights that `python -m zerobev.inference.shipped_weights` writes, found nothing")
    return path


def run_of(path: Path) -> str:
    """Name of the recorded run that a shipped file comes from."""
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["zerobev"])["run"]


def shipped_runs() -> dict[str, str]:
    """Name of the recorded run that each shipped file comes from."""
    return {name: run_of(shipped(name)) for name in (*ROWS, DEPTH)}


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
    # imported here, since what uses the weights does not need what trains them
    from zerobev.experiments.registry import experiment
    from zerobev.experiments.depth_pretraining import DepthPretraining
    from zerobev.experiments.runs import run_key
    from zerobev.experiments.workspace import Workspace

    workspace = Workspace(SCALE)
    keys = {row: run_key(experiment(row), workspace, _SEED) for row in ROWS}
    return keys | {DEPTH: DepthPretraining(workspace).key}


def write_weights(folder: Path = FOLDER) -> None:
    """Write the weights of all rows and of the depth estimator; what is not trained yet is trained now."""
    from zerobev.experiments.registry import experiment
    from zerobev.experiments.depth_pretraining import DepthPretraining
    from zerobev.experiments.runs import train_run
    from zerobev.experiments.workspace import Workspace

    workspace = Workspace(SCALE)
    for name, key in runs().items():
        if name == DEPTH:
            trained = DepthPretraining(workspace).weights
        else:
            trained = workspace.runs / key / "model.safetensors"
            if not trained.exists():
                train_run(experiment(name), workspace, _SEED, key)
        halve(trained, folder / f"{name}.safetensors", key)


def main() -> None:
    """Write the weights into the package."""
    argparse.ArgumentParser(prog="python -m zerobev.inference.shipped_weights", description=__doc__).parse_args()
    write_weights()


if __name__ == "__main__":
    run_command(main)
