"""Runs side by side, each in a process of its own, with their progress.

Several trainings with one thread each use the cores better than one training with several threads.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from tqdm import tqdm

from zerobev.common.errors import attempt
from zerobev.experiments.run_records import RunRecord
from zerobev.experiments.runs import Run
from zerobev.training.history import Entry

_POLL_S = 0.5  # between two looks at the processes
_LINE_S = 60.0  # between two lines of a run that has made progress, without a terminal
_STOP_S = 30.0  # for interrupted processes to end by themselves


def compute_all(runs: Sequence[Run], arguments: Sequence[str], jobs: int) -> int:
    """Compute the records of `runs`, at most `jobs` at a time, and return the number of runs that failed.

    A run that fails does not end the others. Its output is in `run.log` of its folder. With more than one job, each
    process has one thread. An interruption (Ctrl-C, SIGTERM) ends all processes; checkpoints stay.

    arguments: of the command `zerobev run` of each process, beside row and seed
    """
    environment = {**os.environ, **({"OMP_NUM_THREADS": "1"} if jobs > 1 else {})}
    waiting, at_work, failed = deque(runs), list[_Process](), 0
    with _terminated_as_interrupted():
        try:
            while waiting or at_work:
                while waiting and len(at_work) < jobs:
                    at_work.append(_Process(waiting.popleft(), arguments, environment))
                time.sleep(_POLL_S)
                for process in list(at_work):
                    process.show()
                    if process.ended():
                        at_work.remove(process)
                        failed += not process.report(f"{len(runs) - len(waiting) - len(at_work)} of {len(runs)}")
        finally:
            _stop(at_work)
    return failed


def result_line(run: Run, record: RunRecord) -> str:
    """File and IoU of a record."""
    iou = f"class {100 * record.counts.class_iou():.2f}, pixel {100 * record.counts.pixel_iou():.2f}"
    return f"{run.store.path(record.key)}: IoU in percent: {iou}"


class _Process:
    """A run in a process, and its progress: a bar on a terminal, lines elsewhere."""

    def __init__(self, run: Run, arguments: Sequence[str], environment: dict[str, str]) -> None:
        self.run = run
        self._steps = run.workspace.scale.train.steps
        self._history, self._log = run.folder / "history.jsonl", run.folder / "run.log"
        self._earlier = self._modified()
        run.folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "zerobev", "run", "--row", run.experiment.row, "--seed", str(run.seed)]
        with self._log.open("ab") as log:
            self._start = log.tell()
            self.process = subprocess.Popen(
                [*command, *arguments], env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        self._started = self._said_at = time.monotonic()
        self._said = 0  # step of the last line
        self.bar = tqdm(total=self._steps, leave=False, disable=not sys.stderr.isatty(), bar_format="{desc} |{bar}|")
        self.bar.set_description_str(f"{run.name}: started")
        if self.bar.disable:
            _say(f"{run.name}: started")

    def show(self) -> None:
        """Show the step of the training and the remaining time."""
        entry = self._entry()
        if entry is None or entry.step == self._said:
            return
        left = entry.seconds / entry.step * (self._steps - entry.step)
        text = f"{self.run.name}: step {entry.step} of {self._steps}, {entry.seconds:.0f} s, {left:.0f} s remaining"
        self.bar.n = entry.step
        self.bar.set_description_str(text)
        tenth = 10 * entry.step // self._steps > 10 * self._said // self._steps
        if self.bar.disable and (tenth or time.monotonic() - self._said_at > _LINE_S):
            self._said, self._said_at = entry.step, time.monotonic()
            _say(text)

    def ended(self) -> bool:
        """Whether the process has ended."""
        return self.process.poll() is not None

    def report(self, number: str) -> bool:
        """Print the result of the ended process; whether it has made the record."""
        self.bar.close()
        record = attempt(self.run.recorded) if self.process.returncode == 0 else None
        result = result_line(self.run, record) if isinstance(record, RunRecord) else f"failed: {self._reason()}"
        _say(f"[{number}] {self.run.name}: {time.monotonic() - self._started:.0f} s, {result}")
        return isinstance(record, RunRecord)

    def _reason(self) -> str:
        if self.process.returncode == -signal.SIGKILL:
            reason = "killed (out of memory?)"
        else:
            written = self._log.read_bytes()[self._start :].decode(errors="replace").split("\n")
            lines = [line.strip() for line in written if line.strip()]
            reason = lines[-1] if lines else f"exit code {self.process.returncode}"
        return f"{reason}; log: {self._log}"

    def _entry(self) -> Entry | None:
        """The last entry of the history that this process has written; None before the first."""
        if self._modified() == self._earlier:
            return None
        lines = self._history.read_text().split("\n")[:-1]  # the last line may be incomplete
        return Entry(**json.loads(lines[-1])) if lines else None

    def _modified(self) -> int:
        return self._history.stat().st_mtime_ns if self._history.exists() else 0


def _say(line: str) -> None:
    """Print a line above the bars."""
    tqdm.write(line)
    sys.stdout.flush()


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """SIGTERM raises `KeyboardInterrupt`: no process stays behind."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _stop(at_work: Sequence[_Process]) -> None:
    """End the processes and their bars."""
    for one in at_work:
        one.process.send_signal(signal.SIGINT)
    try:
        with suppress(subprocess.TimeoutExpired):
            for one in at_work:
                one.process.wait(_STOP_S)
    finally:
        for one in at_work:
            one.process.kill()
            one.process.wait()
            one.bar.close()
