"""Compute one row of a table, or read it if it is recorded.

Reads scenes, views and textures (made first if they are missing, in `.cache`); writes the record to
`reports/<scale>/records/` and its maps to `reports/<scale>/gallery/`. For several GPUs, start it with `accelerate
launch`: the processes share training and evaluation, and rank 0 writes.
"""

import argparse

import torch
from accelerate import PartialState
from filelock import FileLock

from zerobev.common.parallel import cluster
from zerobev.config import SPLITS, Split
from zerobev.experiments.registry import EXPERIMENTS, experiment
from zerobev.experiments.runs import Run
from zerobev.experiments.workspace import Workspace, add_workspace_arguments


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev run`."""
    add_workspace_arguments(parser)
    parser.add_argument("--row", required=True, help=f"one of {', '.join(EXPERIMENTS)}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help="values, such as train.steps=2400"
    )
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a dask cluster that makes the views")


def run(options: argparse.Namespace) -> None:
    """Compute the record if it is missing, alone or with the other processes of a launch, and print its IoU."""
    workspace = Workspace(options.scale, options.scenes, settings=options.set)
    wanted = Run(experiment(options.row), workspace, options.seed)
    with _one_at_a_time(workspace), cluster(options.dask):
        _make_data(wanted)
    # after the data are made: a rank that waits for the lock could exceed the time limit of torch.distributed
    state = PartialState(cpu=not torch.cuda.is_available())
    estimated = _estimated(wanted)
    if estimated or (wanted.experiment.network and not wanted.backbone):
        _ = wanted.pretraining.record  # trained by all ranks if it is missing
        state.wait_for_everyone()
        with _one_at_a_time(workspace):
            for split in estimated:
                wanted.pretraining.views(split)
    record = wanted.record()
    if state.is_main_process:
        iou = f"class {100 * record.counts.class_iou():.2f}, pixel {100 * record.counts.pixel_iou():.2f}"
        print(f"{wanted.store.path(record.key)}: IoU in percent: {iou}")
    state.destroy_process_group()


def _make_data(wanted: Run) -> None:
    """Make the views and the textures of a run."""
    for split in SPLITS:
        wanted.workspace.views(split)
    if wanted.experiment.network and wanted.experiment.stream == "synth":
        wanted.workspace.bank(wanted.experiment.texture(wanted.workspace.scale))


def _estimated(wanted: Run) -> list[Split]:
    """Splits that a run reads with estimated depth."""
    if not wanted.experiment.reads_depth:
        return []
    stages = wanted.experiment.stages(wanted.workspace.scale)
    depths = {"train": stages, "validation": stages[-1:], "test": (wanted.experiment.test_depth,)}
    return [split for split in SPLITS if {"estimated", "mixed"} & set(depths[split])]


def _one_at_a_time(workspace: Workspace) -> FileLock:
    """A lock shared by all processes that use the cache: the first makes the data, the others find it."""
    workspace.cache.mkdir(parents=True, exist_ok=True)
    return FileLock(workspace.cache / "data.lock")
