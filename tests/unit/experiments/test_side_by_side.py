"""Processes side by side: their ends, their progress and their threads; a script stands in for `zerobev run`."""

import json
import os
import re
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from zerobev.experiments import side_by_side
from zerobev.experiments.registry import experiment
from zerobev.experiments.runs import Run
from zerobev.experiments.side_by_side import compute_all
from zerobev.experiments.workspace import Workspace


@pytest.fixture
def runs(tmp_path: Path) -> dict[str, Run]:
    workspace = Workspace("smoke", root=tmp_path)
    return {row: Run(experiment(row), workspace) for row in ("a.1", "c", "f")}


@pytest.fixture
def behave(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Replace the process of each run by a shell script per row."""

    def replace(**scripts: str) -> None:
        cases = "".join(f'*"--row {row.replace("_", ".")} "*) {script} ;;\n' for row, script in scripts.items())
        program = tmp_path / "zerobev.sh"
        program.write_text(f'#!/bin/sh\ncase "$*" in\n{cases}esac\n')
        program.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(program))

    monkeypatch.setattr(side_by_side, "_POLL_S", 0.01)
    return replace


def entry(step: int, seconds: float) -> str:
    names = ("loss", "main", "aux", "learning_rate", "validation")
    return json.dumps({"step": step, "seconds": seconds} | dict.fromkeys(names, 0.5))


def test_every_failure_is_one_line_with_its_cause_and_its_log(runs, behave, capsys):
    behave(
        a_1="kill -9 $$",
        c="echo 'Traceback:' >&2; echo 'ValueError: 3 metres' >&2; echo; exit 1",
        f="exit 7",
    )
    runs["f"].folder.mkdir(parents=True)
    (runs["f"].folder / "run.log").write_text("of an earlier process\n")
    assert compute_all(list(runs.values()), [], 1) == 3
    lines = [line for line in capsys.readouterr().out.splitlines() if "started" not in line]
    causes = {"a.1": "killed (out of memory?)", "c": "ValueError: 3 metres", "f": "exit code 7"}
    for number, (line, (row, cause)) in enumerate(zip(lines, causes.items(), strict=True), start=1):
        log = runs[row].folder / "run.log"
        assert re.fullmatch(
            rf"\[{number} of 3\] {row} seed 0: \d+ s, failed: {re.escape(f'{cause}; log: {log}')}", line
        )


@pytest.mark.parametrize("jobs, threads", [(1, "3"), (2, "1")])
def test_processes_side_by_side_have_one_thread_each(runs, behave, monkeypatch, jobs, threads):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    behave(c='echo "$OMP_NUM_THREADS $*"', f="")
    compute_all([runs["c"], runs["f"]], ["--scale", "smoke"], jobs)
    log = (runs["c"].folder / "run.log").read_text()
    assert log == f"{threads} -m zerobev run --row c --seed 0 --scale smoke\n"


def test_no_more_jobs_than_asked_for_are_at_work(runs, behave, tmp_path):
    """A process that finds a folder made by another stays away from it."""
    alone = f"mkdir {tmp_path}/busy && sleep 0.1 && rmdir {tmp_path}/busy && echo alone"
    behave(a_1=alone, c=alone, f=alone)
    compute_all(list(runs.values()), [], 1)
    assert all((run.folder / "run.log").read_text() == "alone\n" for run in runs.values())


@pytest.fixture
def progress_of(behave, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Compute a run whose process has written another step of 240 at each look at it; the last line is incomplete."""

    def compute(run: Run) -> None:
        history, stop = run.folder / "history.jsonl", tmp_path / "stop"
        run.folder.mkdir(parents=True)
        history.write_text(f"{entry(240, 99.0)}\n")
        os.utime(history, (1000, 1000))  # by an earlier process
        contents = ["", *("".join(f"{entry(s, s / 2)}\n" for s in steps) for steps in ([1], [1, 23], [24], [47]))]
        contents += [contents[-1] + entry(120, 60.0)[:20]]
        changes = iter([lambda: None, *(partial(history.write_text, content) for content in contents)])

        def look(seconds: float) -> None:
            next(changes, stop.touch)()
            time.sleep(seconds)

        behave(c=f"while [ ! -e {stop} ]; do sleep 0.01; done")
        monkeypatch.setattr(side_by_side, "time", SimpleNamespace(sleep=look, monotonic=time.monotonic))
        compute_all([run], [], 1)

    return compute


def test_a_line_per_tenth_of_the_steps(runs, progress_of, capsys):
    progress_of(runs["c"])
    shown = capsys.readouterr()
    assert [line for line in shown.out.splitlines() if "failed" not in line] == [
        "c seed 0: started",
        "c seed 0: step 24 of 240, 12 s, 108 s remaining",
    ]
    assert not shown.err


def test_a_line_per_minute(runs, progress_of, capsys, monkeypatch):
    monkeypatch.setattr(side_by_side, "_LINE_S", 0.0)
    progress_of(runs["c"])
    assert re.findall(r"step (\d+) of", capsys.readouterr().out) == ["1", "23", "24", "47"]


def test_a_bar_on_a_terminal(runs, progress_of, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    progress_of(runs["c"])
    shown = capsys.readouterr()
    assert re.search(r"c seed 0: step 47 of 240, 24 s, 96 s remaining \|█", shown.err)
    assert "step 120" not in shown.err and "step 240" not in shown.err
    assert re.fullmatch(r"\[1 of 1\] c seed 0: \d+ s, failed: .*\n", shown.out)
