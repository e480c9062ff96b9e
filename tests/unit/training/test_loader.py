"""Batches drawn by worker processes: same batches, same order, and no process is left behind."""

import multiprocessing
import os
import signal

import joblib
import numpy as np
import pytest
import torch

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig, TextureConfig
from zerobev.data.samples import SemanticPass, SynthSamples, as_float
from zerobev.data.shards import Shard, write_shard
from zerobev.data.textures import TextureBank
from zerobev.data.view_set import ViewSet
from zerobev.data.views import ViewSource
from zerobev.training.loader import batches, gpu_workers

from support.scenes import build, furnished

CAMERA, TEXTURE, CPU = CameraConfig(fpv_px=32, bev_px=20), TextureConfig(tiles=2, tile_px=64), torch.device("cpu")


@pytest.fixture(scope="module")
def views(tmp_path_factory) -> ViewSet:
    """Two shards of a scene, already opened by this process."""
    folder, scene = tmp_path_factory.mktemp("shards"), build(furnished())
    source = ViewSource(scene, CAMERA, TEXTURE, np.random.default_rng(0))
    for name in "ab":
        write_shard(folder / f"{name}.h5", scene, [source.draw() for _ in range(6)], CAMERA, TEXTURE, 0)
    views = ViewSet([Shard(folder / f"{name}.h5", CAMERA, TEXTURE) for name in "ab"])
    for index in range(len(views)):
        views.locate(index)
    return views


@pytest.fixture(scope="module")
def source(views) -> SynthSamples:
    tiles = np.random.default_rng(1).random((2, 64, 64)) < 0.2
    return SynthSamples(views, TextureBank(tiles, TEXTURE), CAMERA, seed=3, batch=4, extruded_fraction=0.5)


def same(one: list, other: list) -> bool:
    return len(one) == len(other) and all(
        a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a) for a, b in zip(one, other)
    )


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_workers_change_nothing(source, workers):
    for processes in ((0, 1), (1, 2)):
        expected = [as_float(source.batch(step, *processes)) for step in range(5, 12)]
        torch.manual_seed(0)
        assert same(list(batches(source, range(5, 12), CPU, *processes, workers)), expected)
        assert torch.initial_seed() == 0 and torch.rand(1) == torch.rand(1, generator=torch.manual_seed(0))


def test_processes_divide_the_batches_of_a_pass_over_test_views(views):
    source = SemanticPass(views, CAMERA, 5)
    assert len(source) == 3
    halves = [list(batches(source, range(rank, len(source), 2), CPU, workers=1)) for rank in (0, 1)]
    assert same([halves[0][0], halves[1][0], halves[0][1]], [as_float(source.batch(number)) for number in range(3)])
    scenes = torch.cat([batch["scene"] for half in halves for batch in half])
    assert scenes.bincount().tolist() == [6, 6]


class Broken:
    """A source that fails at step 2: with an error of the data, or with the death of the process."""

    def __init__(self, dies: bool) -> None:
        self.dies = dies

    def batch(self, step: int, rank: int = 0, world_size: int = 1) -> dict[str, torch.Tensor]:
        if step == 2 and self.dies:
            os.kill(os.getpid(), signal.SIGKILL)
        if step == 2:
            raise InputError("home.h5: expected view 7, found nothing")
        return {"step": torch.tensor([step])}


@pytest.mark.parametrize("workers", [0, 2])
def test_an_error_of_the_data_is_raised_unchanged_after_the_batches_before_it(workers):
    drawn = batches(Broken(dies=False), range(5), CPU, workers=workers)
    assert [next(drawn)["step"].item() for _ in range(2)] == [0, 1]
    with pytest.raises(InputError, match=r"^home\.h5: expected view 7, found nothing$"):
        next(drawn)


def test_a_worker_that_dies_is_an_error():
    with pytest.raises(RuntimeError, match=r"worker .* (killed by signal: Killed|exited unexpectedly)"):
        list(batches(Broken(dies=True), range(5), CPU, workers=2))


def test_workers_end_when_the_iterator_is_closed(source):
    before = set(multiprocessing.active_children())
    drawn = batches(source, range(1000), CPU, workers=2)
    next(drawn)
    assert len(set(multiprocessing.active_children()) - before) == 2
    drawn.close()
    assert set(multiprocessing.active_children()) == before


def test_training_processes_divide_the_cores_for_workers(monkeypatch):
    for cores, processes, expected in ((64, None, 16), (16, None, 15), (64, 8, 7), (4, 8, 1), (1, None, 1)):
        monkeypatch.setattr(joblib, "cpu_count", lambda cores=cores: cores)
        if processes is None:
            monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
        else:
            monkeypatch.setenv("LOCAL_WORLD_SIZE", str(processes))
        assert gpu_workers() == expected
