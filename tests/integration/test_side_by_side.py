"""`zerobev run` with several rows: the records of single runs, after failures and interruptions too."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from zerobev import cli
from zerobev.common.locks import locked
from zerobev.experiments.registry import experiment
from zerobev.experiments.run_records import RunRecord
from zerobev.experiments.runs import Run
from zerobev.experiments.workspace import Workspace

from support.paths import ROOT

pytestmark = pytest.mark.slow

ROWS = ("a.1", "c", "f")
SETTINGS = [
    *("scenes.train=1", "scenes.validation=1", "scenes.test=1", "scenes.views=4", "depth.steps=2"),
    *("train.steps=20", "train.validate_every=4", "train.batch=4", "texture.tiles=2", "texture.tile_px=128"),
]
LAST = ["--scale", "smoke", "--set", *SETTINGS]
SEVERAL = ["run", "--row", *ROWS, "--jobs", "2", *LAST]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Run]:
    """The runs of three rows, computed side by side."""
    torch.set_num_threads(1)
    root = tmp_path_factory.mktemp("home")
    workspace = Workspace("smoke", root=root, settings=SETTINGS)
    ended = start(root, *SEVERAL)
    assert ended.wait(300) == 0, ended.communicate()
    return {row: Run(experiment(row), workspace) for row in ROWS}


@pytest.fixture(autouse=True)
def home(runs: dict[str, Run], monkeypatch: pytest.MonkeyPatch) -> Path:
    root = runs["c"].workspace.reports.parents[1]
    monkeypatch.setenv("ZEROBEV_HOME", str(root))
    monkeypatch.chdir(ROOT)  # processes find the package
    return root


def start(root: Path, *arguments: str) -> subprocess.Popen:
    env = {**os.environ, "ZEROBEV_HOME": str(root), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "zerobev", *arguments]
    return subprocess.Popen(command, cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def found(run: Run) -> tuple[dict, bytes]:
    """What a run has made: the result in its record, and its weights."""
    record = run.recorded()
    assert isinstance(record, RunRecord)
    return record.result, run.weights.read_bytes()


def forget(run: Run) -> None:
    run.store.path(run.key).unlink(missing_ok=True)
    shutil.rmtree(run.folder)


def test_a_run_beside_others_makes_what_it_makes_alone(runs, capsys):
    before = found(runs["c"])
    forget(runs["c"])
    cli.main(["run", "--row", "c", "--seed", "0", *LAST])
    assert found(runs["c"]) == before
    record = re.escape(str(runs["c"].store.path(runs["c"].key)))
    assert re.fullmatch(rf"{record}: IoU in percent: class [\d.]+, pixel [\d.]+\n", capsys.readouterr().out)


def test_recorded_runs_are_skipped(runs, capsys):
    before = {row: run.store.path(run.key).stat().st_mtime_ns for row, run in runs.items()}
    cli.main(SEVERAL)
    assert before == {row: run.store.path(run.key).stat().st_mtime_ns for row, run in runs.items()}
    recorded, total = capsys.readouterr().out.splitlines()
    assert recorded == "recorded: a.1 seed 0; c seed 0; f seed 0"
    assert re.fullmatch(r"3 runs: 0 computed, 3 recorded before, 0 failed; \d+ s", total)


def test_a_failing_run_does_not_end_the_others(runs, capsys):
    """One record is damaged, one run is at work elsewhere; the third is computed."""
    damaged, busy = runs["c"].store.path(runs["c"].key), runs["f"]
    original = damaged.read_text()
    for run in runs["a.1"], busy:
        run.store.path(run.key).unlink()
    damaged.write_text("{}")
    try:
        with locked(busy.folder, "work"), pytest.raises(SystemExit) as ended:
            cli.main(SEVERAL)
    finally:
        damaged.write_text(original)
    assert ended.value.code == 1
    lines = {line.split()[3]: line for line in capsys.readouterr().out.splitlines() if line.startswith("[")}
    assert runs["a.1"].recorded() and "IoU in percent" in lines["a.1"]
    assert re.search(rf"failed: error: {damaged}: expected a record, .*; log: {runs['c'].folder}/run.log$", lines["c"])
    refused = f"failed: error: {busy.folder}: expected no other process with this run, found one at work;"
    assert refused in lines["f"] and not busy.recorded()
    cli.main(SEVERAL)
    assert "3 runs: 1 computed, 2 recorded before, 0 failed" in capsys.readouterr().out and busy.recorded()


def test_an_interrupted_call_ends_its_processes_and_is_continued(runs, home):
    """The signal reaches the first process alone."""
    before = {row: found(runs[row]) for row in ("c", "f")}
    for _ in range(5):  # on a busy machine the signal may come after the last step
        for row in before:
            forget(runs[row])
        first = start(home, *SEVERAL)
        while not (runs["c"].folder / "checkpoint.pt").exists():
            assert first.poll() is None, first.communicate()
            time.sleep(0.02)
        first.send_signal(signal.SIGTERM)
        assert first.wait(60) == 1 and "interrupted" in first.communicate()[1]
        if not runs["c"].recorded():
            break
    with locked(runs["c"].folder, "work"), locked(runs["f"].folder, "work"):
        assert not runs["c"].recorded()
    cli.main(SEVERAL)
    assert "resumed at step" in (runs["c"].folder / "train.log").read_text()
    assert {row: found(runs[row]) for row in before} == before


def test_several_runs_are_refused_in_a_launch(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(SystemExit, match=r"error: --row: expected one row with one seed under .*, found 3"):
        cli.main(SEVERAL)
