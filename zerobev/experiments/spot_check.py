"""Compute one recorded run again and compare it with its record.

Reads the records in `reports/<scale>/`; writes nothing. Without `--row`, the date chooses the run. `make reproduce`
ends with a spot check: it finds a change of behaviour even if the recipe version was not raised. Rounding differs
between machines, and so do trained weights: the new averages must lie in the recorded run's interval over test scenes.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from zerobev.common.errors import InputError
from zerobev.evaluation.metrics import bootstrap_interval, class_iou, pixel_iou
from zerobev.experiments.registry import EXPERIMENTS
from zerobev.experiments.run_records import RunRecord, RunStore
from zerobev.experiments.runs import Run
from zerobev.experiments.workspace import Workspace, add_workspace_arguments

_SEED = 0


@dataclass(frozen=True)
class SpotCheck:
    """A recorded run, and the same run computed now."""

    recorded: RunRecord
    again: RunRecord

    @property
    def agrees(self) -> bool:
        """Whether both averages of the new run lie in the 90 % interval of the recorded run."""
        for statistic in (class_iou, pixel_iou):
            low, high = bootstrap_interval([self.recorded.counts], statistic, np.random.default_rng(0))
            if not low <= self.again.counts.value(statistic) <= high:
                return False
        return True

    def __str__(self) -> str:
        """One line: averages recorded, averages now, and whether they agree."""
        runs = (self.recorded.counts, self.again.counts)
        was, now = (f"{100 * counts.class_iou():.2f} / {100 * counts.pixel_iou():.2f}" for counts in runs)
        verdict = "agrees" if self.agrees else "DOES NOT AGREE: has behaviour changed without a new recipe version?"
        return f"{self.recorded.key}: class / pixel IoU recorded {was}, now {now}: {verdict}"


def spot_check(workspace: Workspace, row: str | None) -> SpotCheck:
    """Compute one recorded run again, in a temporary folder.

    row: one of `EXPERIMENTS`; None: another recorded row each day, in turns
    Raises `InputError` for a row without a record.
    """
    runs = {row: Run(experiment, workspace, _SEED) for row, experiment in EXPERIMENTS.items()}
    recorded = {row: record for row, run in runs.items() if (record := run.recorded()) is not None}
    rows = list(recorded)
    if not rows or (row is not None and row not in rows):
        raise InputError(f"spot check: expected one of the recorded rows {', '.join(rows) or '(none)'}, found {row!r}")
    chosen = row or rows[date.today().toordinal() % len(rows)]
    with tempfile.TemporaryDirectory() as scratch:
        again = runs[chosen].compute(RunStore(Path(scratch)))
    return SpotCheck(recorded[chosen], again)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev spot-check`."""
    add_workspace_arguments(parser)
    parser.add_argument("--row", metavar="ROW", help="a recorded row; default: a different one each day")


def run(options: argparse.Namespace) -> None:
    """Compute a recorded run again and print the comparison; exit code 1 if the two do not agree."""
    workspace = Workspace(options.scale, options.scenes)
    print("spot check ...", flush=True)
    checked = spot_check(workspace, options.row)
    print(checked)
    if not checked.agrees:
        sys.exit(1)
