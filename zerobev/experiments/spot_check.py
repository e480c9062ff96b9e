"""Trust in records: one of them, drawn by date or named, is computed again and held against what was recorded.

`make reproduce` does this once everything is recorded, so that a change of behaviour is found even where the
recipe version was not raised. A run on another machine differs in the last digits and then in the weights, so
that the new averages have to lie in the recorded run's interval over test scenes, not to be equal.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from zerobev import config
from zerobev.common.errors import InputError, run_command
from zerobev.evaluation.metrics import bootstrap_interval, class_iou, pixel_iou
from zerobev.experiments.records import Record, RecordStore
from zerobev.experiments.registry import EXPERIMENTS
from zerobev.experiments.runs import compute, run_key
from zerobev.experiments.workspace import Workspace

_SEED = 0


@dataclass(frozen=True)
class SpotCheck:
    """A recorded run beside the same run computed now."""

    recorded: Record
    again: Record

    @property
    def agrees(self) -> bool:
        """Both averages of the new run lie in the 90 % interval of the recorded one."""
        for statistic in (class_iou, pixel_iou):
            low, high = bootstrap_interval([self.recorded.counts], statistic, np.random.default_rng(0))
            if not low <= self.again.counts.value(statistic) <= high:
                return False
        return True

    def __str__(self) -> str:
        """One line for a person: what was recorded, what came out now, and whether they agree."""
        runs = (self.recorded.counts, self.again.counts)
        was, now = (f"{100 * counts.class_iou():.2f} / {100 * counts.pixel_iou():.2f}" for counts in runs)
        verdict = "agrees" if self.agrees else "DOES NOT AGREE: has behaviour changed without a new recipe version?"
        return f"{self.recorded.key}: class / pixel IoU recorded {was}, now {now}: {verdict}"


def spot_check(workspace: Workspace, row: str | None = None, day: date | None = None) -> SpotCheck:
    """Compute one recorded run again, in a temporary folder.

    row: one of `EXPERIMENTS`; by default the recorded rows take turns, a day each (`day` is today if not given).
    Raises `InputError` for a row that has no record.
    """
    store = RecordStore(workspace.reports)
    found = {e: store.find(run_key(e, workspace, _SEED)) for e in EXPERIMENTS.values()}
    recorded = {experiment.row: (experiment, record) for experiment, record in found.items() if record is not None}
    rows = list(recorded)
    if not rows or (row is not None and row not in rows):
        raise InputError(f"spot check: expected one of the recorded rows {', '.join(rows) or '(none)'}, found {row!r}")
    experiment, record = recorded[row or rows[(day or date.today()).toordinal() % len(rows)]]
    with tempfile.TemporaryDirectory() as scratch:
        again = compute(experiment, workspace, _SEED, RecordStore(Path(scratch)))
    return SpotCheck(record, again)


def main() -> None:
    """Parse the command line, compute a recorded run again, say how it compares; exit code 1 if it does not agree."""
    parser = argparse.ArgumentParser(prog="python -m zerobev.experiments.spot_check", description=__doc__)
    parser.add_argument("--scale", default="reduced", help=f"one of {', '.join(config.SCALES)}")
    parser.add_argument("--scenes", default="", metavar="DIR", help="HM3DSem scenes instead of generated homes")
    parser.add_argument("--row", metavar="ROW", help="a recorded row; default: they take turns, a day each")
    options = parser.parse_args()
    workspace = Workspace(options.scale, options.scenes)
    print("spot check ...", flush=True)
    checked = spot_check(workspace, options.row)
    print(checked)
    if not checked.agrees:
        sys.exit(1)


if __name__ == "__main__":
    run_command(main)
