"""Several processes compute what one computes: training and evaluation by `accelerate launch`, views by dask.

The file is also the script that `accelerate launch` starts: each process of a launch runs `main`.
"""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import torch
from dask.distributed import KilledWorker, LocalCluster
from torch import nn

from zerobev import cli
from zerobev.common.parallel import cluster
from zerobev.config import LABELS, SCALES, CameraConfig, SceneConfig, TextureConfig, TrainConfig
from zerobev.data.generate import generate
from zerobev.data.samples import semantic_batches
from zerobev.evaluation.evaluate import evaluate, model_predictor
from zerobev.experiments import launch as row_command
from zerobev.experiments.depth_pretraining import DepthPretraining
from zerobev.experiments.registry import EXPERIMENTS
from zerobev.experiments.run_records import RunStore
from zerobev.experiments.runs import Run
from zerobev.experiments.workspace import Workspace
from zerobev.models import ZeroBEV
from zerobev.models import build as build_network
from zerobev.models.base import BevModel
from zerobev.scenes.hm3dsem_writer import write_scene
from zerobev.training.distributed import rank_and_world_size
from zerobev.training.history import History
from zerobev.training.loader import model_inputs
from zerobev.training.losses import Losses, zero_bev_loss
from zerobev.training.train import train

from support.paths import ROOT
from support.scenes import build, furnished

SMOKE = SCALES["smoke"]
TINY = replace(
    SMOKE,
    name="tiny",
    scenes=SceneConfig(train=1, validation=1, test=2, views=12),
    train=TrainConfig(steps=4, learning_rate=1e-3, decay_every=2, validate_every=2, batch=4),
    depth=TrainConfig(steps=2, learning_rate=1e-3, decay_every=2, validate_every=2, batch=4),
    texture=TextureConfig(tiles=2, tile_px=128),
)
CONFIG = TrainConfig(steps=6, learning_rate=3e-3, decay_every=4, validate_every=2, batch=4)
#: Losses of one process and of two, in float32: the same sums in another order. Adam divides each gradient by its size,
#: so that rounding of tiny gradients moves weights by the learning rate: later losses are less alike.
ROUNDING, LATER = 2e-6, 5e-3
LAUNCH = [sys.executable, "-m", "accelerate.commands.launch", "--multi_gpu"]  # without a GPU: gloo, on the CPU


class Samples:
    """Fresh samples for every step: the map is a coarse copy of the image."""

    def __init__(self, killed_at: int | None = None) -> None:
        self.killed_at = killed_at  #: the step at which the second process dies

    def batch(self, step: int, rank: int = 0, ranks: int = 1) -> dict[str, torch.Tensor]:
        if step == self.killed_at and rank == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return samples(range(step * CONFIG.batch + rank, (step + 1) * CONFIG.batch, ranks))


def samples(indices: range) -> dict[str, torch.Tensor]:
    batch = []
    for index in indices:
        rng = np.random.default_rng(index)
        # unlike from sample to sample: the mean of the processes' Dice losses is not the loss of the batch
        zero = rng.random((1, 32, 32)) < (0.9 if index % 2 else 0.1)
        target = zero[:, :20, :20]
        aux = np.stack([zero[0, :20, :20], ~zero[0, :20, :20]])
        fov = rng.random((1, 20, 20)) < 0.8
        batch.append((rng.random((3, 32, 32)), zero, target, aux, fov))
    parts = (torch.from_numpy(np.stack(part).astype(np.float32)) for part in zip(*batch))
    return dict(zip(("rgb", "zero", "target", "aux", "fov"), parts, strict=True))


def train_frozen(folder: Path, killed_at: int | None = None) -> History:
    """Train a Zero-BEV network whose batch norms stay in evaluation mode: on a CPU each process has its own."""
    torch.set_num_threads(1)
    torch.cpu.get_capabilities = dict  # float32 on every processor
    torch.manual_seed(0)
    network = build_network("c", SMOKE.camera, SMOKE.model)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval().train = lambda mode=True, module=module: module
    validation = [samples(range(10_000, 10_006))]
    data = Samples(killed_at)
    return train(network, data, validation, CONFIG, folder, 0, key="run", objective=objective, device="cpu")


def objective(model: nn.Module, batch: dict[str, torch.Tensor]) -> Losses:
    """Dice, whose sums run over the processes, and a mean of the process's own samples, as that of depth."""
    predicted = model(*model_inputs(batch))
    losses = zero_bev_loss(predicted, batch, CONFIG.alpha)
    own = (predicted.zero_logits.sigmoid() - batch["target"]).square().mean()
    return Losses(losses.total + own, losses.main + own, losses.aux)


def main(folder: Path, how: str = "whole") -> None:
    """One process of a launch: a training, in which the second one dies if `how` is "killed", and the command of a run.

    "alone" is the training without the run: it takes a process of its own, since accelerate settles its precision once.
    """
    history = train_frozen(folder / "frozen", killed_at=3 if how == "killed" else None)
    (folder / f"history{rank_and_world_size()[0]}.json").write_text(
        json.dumps([vars(entry) for entry in history.entries])
    )
    if how == "alone":
        return
    SCALES["tiny"] = TINY
    for kind, name in (RunStore, "write"), (BevModel, "save"):
        setattr(kind, name, noted(getattr(kind, name), folder / "written"))
    vars(row_command)["Workspace"] = partial(Workspace, root=folder)
    cli.main(["run", "--scale", "tiny", "--row", "d"])


def noted(write: Callable, notes: Path) -> Callable:
    """`write`, which notes whose it is and the rank of the process that calls it."""

    def noting(own: Any, *arguments: Any) -> None:
        with notes.open("a") as file:
            file.write(f"{type(own).__name__} {rank_and_world_size()[0]}\n")
        write(own, *arguments)

    return noting


def launch(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    """`accelerate launch` with two processes, which meet on the CPU."""
    options = ["--num_processes", "2", "--num_machines", "1", "--mixed_precision", "no", "--dynamo_backend", "no"]
    return start(*LAUNCH, *options, "--main_process_port", "0", __file__, str(folder), *arguments)


def start(*command: str) -> subprocess.CompletedProcess:
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    env = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=600)


@pytest.fixture(scope="module")
def launched(tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess]:
    """The folder of a launch that lost a process and was started again, and how it ended the first time."""
    folder = tmp_path_factory.mktemp("launched")
    first = launch(folder, "killed")
    assert not list(folder.glob("history*.json"))
    again = launch(folder)
    assert again.returncode == 0, again.stderr
    return folder, first


@pytest.mark.slow
def test_a_launch_that_loses_a_process_stops_and_says_so(launched):
    folder, first = launched
    assert first.returncode not in (0, None)
    assert re.search(r"rank\s*: 1 .*exitcode\s*: -9 .*Signal 9 \(SIGKILL\)", first.stderr, re.DOTALL)
    assert "resumed at step 2" in (folder / "frozen/train.log").read_text()


@pytest.mark.slow
def test_two_processes_take_the_steps_of_one(launched, tmp_path):
    """Also where one died on the way; and they agree on the score, without which their weights would part."""
    folder, _ = launched
    ended = start(sys.executable, __file__, str(tmp_path), "alone")
    assert ended.returncode == 0, ended.stderr
    files = (tmp_path / "history0.json", folder / "history0.json", folder / "history1.json")
    alone, ours, theirs = (json.loads(path.read_text()) for path in files)
    assert len(ours) == len(alone) == CONFIG.steps
    for entry, first, second in zip(alone, ours, theirs):
        for name in ("step", "loss", "main", "aux", "learning_rate", "validation"):
            assert first[name] == second[name]
            assert first[name] == pytest.approx(entry[name], abs=ROUNDING if entry["step"] <= 3 else LATER)


@pytest.mark.slow
def test_two_processes_count_what_one_counts_and_the_first_writes(launched, monkeypatch):
    folder, _ = launched
    monkeypatch.setitem(SCALES, "tiny", TINY)
    workspace = Workspace("tiny", root=folder)
    run = Run(EXPERIMENTS["d"], workspace)
    record = run.recorded()
    predict = model_predictor(ZeroBEV.load(run.weights), "cpu")
    batches = list(semantic_batches(DepthPretraining(workspace).views("test"), workspace.scale.camera, 16))
    assert len(batches) == 2  # one for each process
    torch.set_num_threads(1)
    assert record.counts == evaluate(predict, batches, 2, len(LABELS))
    assert record.history["step"][-1] == TINY.train.steps
    written = (folder / "written").read_text().splitlines()
    assert [of for of in written if not of.startswith("DepthNet")] == ["ZeroBEV 0", "RunStore 0"]
    assert not list(folder.rglob(".*part*"))


# --- views on a dask cluster

CAMERA, TEXTURE, VIEWS, SEED = CameraConfig(fpv_px=32, bev_px=20), TextureConfig(), 40, 3


@pytest.fixture(scope="module")
def homes(tmp_path_factory) -> list[Path]:
    """Six names of one home."""
    root = tmp_path_factory.mktemp("homes")
    write_scene(root / "00000-AAAAAAAAAAA", build(furnished()))
    for number in range(1, 6):
        (root / f"{number:05d}-AAAAAAAAAAA").symlink_to(root / "00000-AAAAAAAAAAA")
    return sorted(root.iterdir())


class Generation(threading.Thread):
    """`generate` on a cluster, beside the test; `outcome` is what it returned, or raised."""

    def __init__(self, homes: list[Path], out: Path, address: str) -> None:
        super().__init__(daemon=True)
        self.arguments, self.address, self.outcome = (homes, out, VIEWS, CAMERA, TEXTURE, SEED), address, None

    def run(self) -> None:
        try:
            with cluster(self.address):
                self.outcome = generate(*self.arguments)
        except Exception as error:
            self.outcome = error


def kill_a_writer(out: Path, after: int, generation: Generation) -> list[Path]:
    """Kill a worker in the middle of a shard once `after` of them are written; returns those that are."""
    while True:
        assert generation.is_alive(), generation.outcome
        whole, parts = list(out.glob("[!.]*.h5")), list(out.glob(".*.part.h5"))
        if len(whole) >= after and parts:
            os.kill(int(parts[0].name.split(".")[2]), signal.SIGKILL)  # the name of an unfinished file has the process
            return whole
        time.sleep(0.005)


def state(path: Path) -> tuple[int, int]:
    return path.stat().st_ino, path.stat().st_mtime_ns


def test_a_worker_that_dies_loses_nothing_and_nothing_is_written_twice(homes, tmp_path):
    assert generate(homes, tmp_path / "here", VIEWS, CAMERA, TEXTURE, SEED) == {}
    out = tmp_path / "dask"
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as workers:
        generation = Generation(homes, out, workers.scheduler_address)
        generation.start()
        whole = {path: state(path) for path in kill_a_writer(out, 2, generation)}
        generation.join(120)
    assert generation.outcome == {}
    assert 2 <= len(whole) < len(homes)
    assert {path: state(path) for path in whole} == whole
    contents = [{path.name: path.read_bytes() for path in of.iterdir()} for of in (out, tmp_path / "here")]
    assert len(contents[0]) == len(homes) + 1  # and the manifest, nothing unfinished
    assert contents[0] == contents[1]


def test_a_home_that_ends_its_workers_is_an_error_and_not_waited_for(homes, tmp_path):
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as workers,
    ):
        generation = Generation(homes, tmp_path, workers.scheduler_address)
        generation.start()
        kill_a_writer(tmp_path, 0, generation)
        generation.join(60)
    assert isinstance(generation.outcome, KilledWorker)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
