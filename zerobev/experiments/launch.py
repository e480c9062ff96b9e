"""Compute rows of the tables: one row, or several side by side; recorded ones are read.

Reads scenes, views and textures (made first if they are missing, in `.cache`); writes the records to
`reports/<scale>/records/` and their maps to `reports/<scale>/gallery/`. One row, started with `accelerate launch`, uses
several GPUs: the processes share training and evaluation, and rank 0 writes. Of several rows, those without a record
are computed, each in a process of its own; the same command continues after an interruption.
"""

import argparse
import os
import sys
import time
from collections.abc import Sequence

import joblib
import torch
from accelerate import PartialState
from filelock import FileLock

from zerobev.common.errors import InputError, attempt
from zerobev.common.parallel import cluster
from zerobev.config import SPLITS, Split
from zerobev.experiments.registry import EXPERIMENTS, experiment
from zerobev.experiments.run_records import RunRecord
from zerobev.experiments.runs import SEEDS, Run
from zerobev.experiments.side_by_side import compute_all, result_line
from zerobev.experiments.workspace import Workspace, add_workspace_arguments


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev run`."""
    add_workspace_arguments(parser)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--row", nargs="+", metavar="ROW", help=f"some of {', '.join(EXPERIMENTS)}")
    which.add_argument("--all", action="store_true", help="all rows")
    parser.add_argument("--seed", "--seeds", nargs="+", type=int, default=[SEEDS[0]], metavar="N", help="default: 0")
    parser.add_argument(
        "--jobs",
        type=int,
        metavar="N",
        help="rows at a time; with more than one, each has one thread (default: the number of cores; with a GPU, 1)",
    )
    parser.add_argument(
        "--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help="values, such as train.steps=2400"
    )
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a dask cluster that makes the views")


def run(options: argparse.Namespace) -> None:
    """Compute the missing records and print their IoU; exit code 1 if one of several rows failed."""
    workspace = Workspace(options.scale, options.scenes, settings=options.set)
    rows = [experiment(row) for row in dict.fromkeys(EXPERIMENTS if options.all else options.row)]
    runs = [Run(row, workspace, seed) for seed in dict.fromkeys(options.seed) for row in rows]
    jobs = (1 if torch.cuda.is_available() else joblib.cpu_count()) if options.jobs is None else options.jobs
    if jobs < 1:
        raise InputError(f"--jobs: expected 1 or more, found {jobs}")
    if len(runs) == 1:
        _compute_one(runs[0], options.dask)
    else:
        arguments = ["--scale", options.scale, "--scenes", options.scenes]
        _compute_several(runs, options.dask, [*arguments, *(["--set", *options.set] if options.set else [])], jobs)


def _compute_one(wanted: Run, dask: str | None) -> None:
    """Compute a run in this process, alone or with the other processes of a launch."""
    is_recorded = isinstance(attempt(wanted.recorded), RunRecord)
    state = PartialState(cpu=not torch.cuda.is_available()) if is_recorded else _prepare([wanted], dask)
    record = wanted.record()
    if state.is_main_process:
        print(result_line(wanted, record))
    state.destroy_process_group()


def _compute_several(runs: Sequence[Run], dask: str | None, arguments: Sequence[str], jobs: int) -> None:
    """Compute those of `runs` that have no record, each in a process of its own."""
    if int(os.environ.get("WORLD_SIZE", 1)) > 1:
        raise InputError(f"--row: expected one row with one seed under `accelerate launch`, found {len(runs)}")
    begin = time.monotonic()
    # an unreadable record fails in the process of its run
    missing = [wanted for wanted in runs if not isinstance(attempt(wanted.recorded), RunRecord)]
    if skipped := [wanted.name for wanted in runs if wanted not in missing]:
        print(f"recorded: {'; '.join(skipped)}", flush=True)
    failed = 0
    if missing:
        _prepare(missing, dask)
        _train_starts(missing)
        failed = compute_all(missing, arguments, jobs)
    counts = f"{len(missing) - failed} computed, {len(skipped)} recorded before, {failed} failed"
    print(f"{len(runs)} runs: {counts}; {time.monotonic() - begin:.0f} s")
    if failed:
        sys.exit(1)


def _prepare(runs: Sequence[Run], dask: str | None) -> PartialState:
    """Make what runs of one workspace share: views, textures, the depth estimator and its estimates."""
    workspace, pretraining = runs[0].workspace, runs[0].pretraining
    learned = [wanted for wanted in runs if wanted.experiment.network]
    with _one_at_a_time(workspace), cluster(dask):
        for split in SPLITS:
            workspace.views(split)
        synth = [wanted.experiment for wanted in learned if wanted.experiment.stream == "synth"]
        for texture in dict.fromkeys(row.texture(workspace.scale) for row in synth):
            workspace.bank(texture)
    # after the data are made: a rank that waits for the lock could exceed the time limit of torch.distributed
    state = PartialState(cpu=not torch.cuda.is_available())
    estimated = dict.fromkeys(split for wanted in runs for split in _estimated(wanted))
    if estimated or not all(wanted.backbone for wanted in learned):
        _ = pretraining.record  # trained by all ranks if it is missing
        state.wait_for_everyone()
        with _one_at_a_time(workspace):
            for split in estimated:
                pretraining.views(split)
    return state


def _train_starts(runs: Sequence[Run]) -> None:
    """Train the weights that runs start from; side by side, several runs would train them at the same time."""
    for start in dict.fromkeys(wanted.start for wanted in runs if wanted.start is not None):
        start.trained()


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
