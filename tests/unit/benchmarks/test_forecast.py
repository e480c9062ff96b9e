"""The forecast of a reproduction: arithmetic, measurements; and the paper's scale end to end in small numbers."""

import subprocess
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn
from transformers import ResNetConfig, ResNetModel

from zerobev import cli
from zerobev.benchmarks import forecast as forecasting
from zerobev.benchmarks.forecast import Forecast, Network, forecast, saved_bytes
from zerobev.common.errors import InputError
from zerobev.config import SCALES, SceneConfig, TextureConfig
from zerobev.experiments.registry import EXPERIMENTS
from zerobev.experiments.runs import Run
from zerobev.experiments.workspace import Workspace
from zerobev.models import build

from support.paths import ROOT

TINY = replace(
    SCALES["smoke"],
    name="tiny",
    scenes=SceneConfig(train=1, validation=1, test=1, views=12),
    texture=TextureConfig(tiles=2, tile_px=128),
)
FORECAST = Forecast(
    scale=replace(SCALES["paper"], test_views=500),
    homes={"train": 145, "validation": 4, "test": 32},
    networks=24,
    left={"homes": 81, "networks": 20, "estimators": 1},
    there_bytes=100_000_000_000,
    view_bytes=600_000,
    view_s=0.36,
    network=Network(200_000_000, 1e9, 5e8, train_s=0.18, test_s=0.9),
    estimator=Network(100_000_000, 1e9, 3e8, train_s=0.1, test_s=0.05),
)


def test_arithmetic_of_a_forecast_by_hand():
    assert FORECAST.views == 362_000
    assert FORECAST.disk_bytes == {
        "views": 217.2e9,
        "depth": 362_000 * 384 * 384 * 2,  # float16
        "weights": (24 * 2 + 4) * 200e6,
    }
    assert FORECAST.needed_bytes["free disk"] == pytest.approx(217.2e9 + 106.758144e9 + 10.4e9 - 100e9)
    # 32 samples of the estimator take more than 16 of (c): 1 + 5 x 0.1 + 32 x 0.3 against 1 + 1 + 8 GB
    assert FORECAST.needed_bytes["memory"] == pytest.approx(11.1e9)
    assert replace(FORECAST, estimator=FORECAST.network).needed_bytes["memory"] == pytest.approx(18e9)
    assert FORECAST.hours(workers=2) == pytest.approx(
        {
            "views": 81 * 2000 * 0.36 / 2 / 3600,
            "estimator": (612_500 * 32 * 0.1 + 362_000 * 0.05) / 3600,
            "networks": 20 * 290.0,  # 362,500 x 16 x 0.18 s
            "evaluation": 20 * 4.0,  # 32 homes x 500 views x 0.9 s
        }
    )
    assert replace(FORECAST, there_bytes=10**12).needed_bytes["free disk"] == 0


def test_too_little_disk_or_memory_is_refused_in_one_line():
    there = {"free disk": 235e9, "memory": 12e9}
    FORECAST.check(there)
    with pytest.raises(InputError, match=r"^scale paper: expected 234\.4 GB of free disk, found 200\.0 GB$"):
        FORECAST.check({**there, "free disk": 200e9})
    with pytest.raises(InputError, match=r"^scale paper: expected 11\.1 GB of memory, found 8\.0 GB$"):
        FORECAST.check({**there, "memory": 8e9})
    table = FORECAST.table(there, workers=2)
    assert len(table.splitlines()) == 10 and "362,000" in table and "234.4 GB of free disk, of 235.0 GB" in table


def test_saved_bytes_by_hand():
    """The input, and the output of the first layer once, although two layers save it; not the weights."""
    net = nn.Sequential(nn.Linear(4, 8, bias=False), nn.ReLU(), nn.Linear(8, 2, bias=False))
    images = torch.rand(5, 4)
    assert saved_bytes(lambda: net(images).sum(), net) == 4 * (5 * 4 + 5 * 8)


@pytest.mark.slow
def test_a_forecast_measures_views_and_counts_existing_ones(tmp_path, monkeypatch):
    monkeypatch.setitem(SCALES, "tiny", TINY)
    monkeypatch.setattr(forecasting, "_SECONDS", 0.1)
    workspace = Workspace("tiny", root=tmp_path)
    before = forecast(workspace)
    assert not list(tmp_path.iterdir())  # it writes nothing
    assert before.homes == {"train": 1, "validation": 1, "test": 1} and before.there_bytes == 0
    assert before.left == {"homes": 3, "networks": before.networks, "estimators": 1}
    assert before.networks == sum(experiment.network is not None for experiment in EXPERIMENTS.values())
    assert all(value > 0 for value in before.hours(1).values())
    views = workspace.views("test")
    size = views.shards[0].path.stat().st_size
    assert 12 * before.view_bytes == pytest.approx(size, rel=0.3)
    measured = {name: getattr(before, name) for name in ("view_bytes", "view_s", "network", "estimator")}
    monkeypatch.setattr(forecasting, "measure", lambda scale, home: measured)
    after = forecast(workspace)
    assert after.left["homes"] == 2
    assert size <= after.there_bytes < 1.1 * size  # and the manifest
    weights = sum(p.numel() for p in build("c", TINY.camera, TINY.model).parameters())
    assert before.network.weight_bytes == 4 * weights


def test_the_command_prints_the_forecast_and_refuses(monkeypatch, capsys):
    monkeypatch.setattr(forecasting, "forecast", lambda workspace: FORECAST)
    monkeypatch.setattr(forecasting.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e9))
    with pytest.raises(SystemExit, match=r"^error: scale paper: expected 234\.4 GB of free disk, found 1\.0 GB$"):
        cli.main(["plan", "--scale", "paper"])
    assert "362,000" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, called",
    [
        (["SCALE=paper"], ["plan", "reproduce", "summary", "spot-check"]),
        (["SCALE=paper", "PLAN=1"], ["plan"]),
        (["SCALE=smoke", "PLAN=1"], ["plan"]),
        (["SCALE=smoke", "PLAN=0"], ["reproduce", "summary", "spot-check"]),
        (["SCALE=paper", "REFUSED=1"], ["plan"]),
    ],
)
def test_make_forecasts_the_papers_scale_first(arguments, called, tmp_path):
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\necho "$2 $3"\n[ -z "$REFUSED" ] || exit 1\n')
    python.chmod(0o755)
    command = ["make", "-C", str(ROOT), "-o", "setup", "reproduce", f"PYTHON={python}", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert [line for line in ended.stdout.splitlines() if "zerobev" in line] == [f"zerobev {name}" for name in called]
    assert (ended.returncode == 0) == ("REFUSED=1" not in arguments)


@pytest.mark.slow
def test_the_papers_scale_end_to_end(tmp_path, monkeypatch):
    """From homes to a record at the paper's sizes and with its network; three homes, one view each, two steps."""
    ResNetModel(ResNetConfig()).save_pretrained(tmp_path / "resnet-50")  # a ResNet-50 with random weights
    paper = SCALES["paper"]
    few = replace(
        paper,
        scenes=SceneConfig(train=1, validation=1, test=1, views=1),
        train=replace(paper.train, steps=2, validate_every=2, batch=1),
        texture=replace(paper.texture, tiles=2),
        backbone=str(tmp_path / "resnet-50"),
    )
    monkeypatch.setitem(SCALES, "paper", few)
    workspace = Workspace("paper", root=tmp_path)
    run = Run(EXPERIMENTS["c"], workspace)
    record, found = run.record(), run.recorded()
    assert found.counts == record.counts and found.history == record.history
    assert record.history["step"] == [1, 2]
    assert np.isfinite(record.history["loss"]).all()
    assert [score is not None for score in record.history["validation"]] == [False, True]
    assert run.store.maps(record.key).shape == (1, 8, 100, 100)
    assert workspace.views("train").shards[0].view(0).rgb.shape == (384, 384, 3)
    assert not (workspace.reports / "depth.json").exists()  # at this scale (c) needs no estimator
    assert record.counts.union.shape == (1, 8) and record.counts.union.sum() > 0
