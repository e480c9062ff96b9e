"""GPU results equal CPU results: training with workers and resumption, bfloat16, evaluation, projection.

Every test runs on the CPU; on a GPU it is skipped if there is none. Batches are drawn from a seed and need neither
homes nor a renderer.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from zerobev.config import AUX, SCALES, TrainConfig
from zerobev.evaluation.evaluate import evaluate, model_predictor
from zerobev.geometry.projection import inverse_project
from zerobev.inference import Masks, Projector
from zerobev.models import build
from zerobev.models.depth import DepthNet
from zerobev.training import train as training
from zerobev.training.loader import Batch, batches
from zerobev.training.train import train, training_accelerator

CUDA = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU"))
DEVICES = ["cpu", CUDA]
SMOKE = SCALES["smoke"]
pytestmark = pytest.mark.slow
CONFIG = TrainConfig(steps=12, learning_rate=2e-3, decay_every=6, validate_every=6, batch=8)


class Blocks:
    """Learnable samples: blocks in the image, and the same blocks mirrored on the map; depth is 2 m everywhere."""

    def __init__(self, seed: int, batch: int = CONFIG.batch, modalities: int = 1) -> None:
        self._seed, self._batch, self._modalities = seed, batch, modalities

    def batch(self, step: int, rank: int = 0, world_size: int = 1) -> Batch:
        samples = [self.sample(self._batch * step + i) for i in range(rank, self._batch, world_size)]
        return {name: torch.from_numpy(np.stack([sample[name] for sample in samples])) for name in samples[0]}

    def sample(self, index: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng([self._seed, index])
        pixels, cells, shape = SMOKE.camera.fpv_px, SMOKE.camera.bev_px, (self._modalities, 4, 4)
        blocks = rng.random(shape) < 0.3
        return {
            "rgb": rng.integers(256, size=(3, pixels, pixels), dtype=np.uint8),
            "zero": blocks.repeat(pixels // 4, axis=1).repeat(pixels // 4, axis=2),
            "depth": np.full((1, pixels, pixels), 2.0, np.float32),
            "target": blocks[:, ::-1].repeat(cells // 4, axis=1).repeat(cells // 4, axis=2).copy(),
            "aux": rng.random((len(AUX), cells, cells)) < 0.5,
            "fov": np.ones((1, cells, cells), bool),
            "scene": np.int64(index % 2),
        }


class Stopped(Exception):
    """Raised instead of a kill."""


class Interrupted(Blocks):
    """As `Blocks`, up to step 9."""

    def batch(self, step: int, rank: int = 0, world_size: int = 1) -> Batch:
        if step == 9:
            raise Stopped
        return super().batch(step, rank, world_size)


@pytest.fixture(autouse=True)
def no_workers(monkeypatch):
    """Batches of `train` come from its own process, on a GPU, too."""
    monkeypatch.setattr(training, "batches", partial(batches, workers=0))


def trained(folder, device, data=None):
    torch.manual_seed(0)
    model = build("c", SMOKE.camera, SMOKE.model)
    validation = [Blocks(1).batch(0)]
    history = train(model, data or Blocks(0), validation, CONFIG, folder, 0, key="cuda", device=device)
    return model.cpu().state_dict(), history


def distance(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> float:
    """Largest difference of weights, relative to their size."""
    pairs = [(one[name].float(), other[name].float()) for name in one if one[name].is_floating_point()]
    return max(float((a - b).norm() / (b.norm() + 1e-3)) for a, b in pairs)


@pytest.mark.parametrize("device", DEVICES)
def test_training_is_the_same_with_workers_and_after_an_interruption(device, tmp_path, monkeypatch):
    """Equal weights on the CPU; on a GPU the order of sums may change the last digits."""
    whole, history = trained(tmp_path / "whole", device)
    with monkeypatch.context() as patch:
        patch.setattr(training, "batches", partial(batches, workers=2))
        with_workers, _ = trained(tmp_path / "workers", device)
    with pytest.raises(Stopped):
        trained(tmp_path / "stopped", device, data=Interrupted(0))
    resumed, resumed_history = trained(tmp_path / "stopped", device)
    tolerance = 0.0 if device == "cpu" else 0.02
    assert distance(with_workers, whole) <= tolerance
    assert distance(resumed, whole) <= tolerance
    assert [e.step for e in history.entries] == [e.step for e in resumed_history.entries] == list(range(1, 13))
    assert all(np.isfinite(entry.loss) for entry in history.entries)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("row", ["b.1", "c", "d", "e", "f.r"])
def test_every_kind_of_network_learns_on_the_device(device, row, tmp_path):
    classes = Blocks(0, modalities=8) if row == "b.1" else Blocks(0)
    torch.manual_seed(0)
    model = build(row, SMOKE.camera, SMOKE.model)
    config = replace(CONFIG, steps=30, validate_every=30)
    history = train(model, classes, [classes.batch(0)], config, tmp_path, 0, key="cuda", device=device)
    losses = [entry.loss for entry in history.entries]
    assert np.mean(losses[-5:]) < np.mean(losses[:5])
    assert next(model.parameters()).device.type == device


@pytest.mark.parametrize("device", DEVICES)
def test_forward_passes_are_bfloat16_if_the_device_computes_in_it(device):
    accelerator = training_accelerator(device)
    model = accelerator.prepare(build("c", SMOKE.camera, SMOKE.model))
    seen = []
    model.decoder.head.register_forward_hook(lambda module, inputs, output: seen.append(output.dtype))
    batch = {name: value.to(accelerator.device) for name, value in Blocks(0).batch(0).items()}
    model(batch["rgb"].float() / 255, batch["zero"].float())
    assert seen == [torch.bfloat16 if accelerator.mixed_precision == "bf16" else torch.float32]


@pytest.mark.parametrize("device", DEVICES)
def test_evaluation_counts_equal_those_of_the_cpu(device):
    torch.manual_seed(0)
    model = build("d", SMOKE.camera, SMOKE.model)
    data = [Blocks(2, modalities=8).batch(step) for step in range(2)]
    batches = [{n: v.float() if v.dtype in (torch.bool, torch.uint8) else v for n, v in b.items()} for b in data]
    on_cpu = evaluate(model_predictor(model, "cpu"), batches, 2, 8)
    there = evaluate(model_predictor(model, device), batches, 2, 8)
    # logits close to zero may change sign
    for name in ("intersection", "union"):
        assert np.abs(getattr(there, name) - getattr(on_cpu, name)).sum() <= 0.002 * on_cpu.union.sum()


@pytest.mark.parametrize("device", DEVICES)
def test_the_inverse_projection_is_the_same(device):
    rng = np.random.default_rng(0)
    side = SMOKE.camera.fpv_px
    zero = torch.from_numpy(rng.random((2, 3, side, side)) < 0.3).float()
    depth = torch.from_numpy(rng.uniform(0.3, 6, (2, 1, side, side)).astype(np.float32))
    expected = inverse_project(zero, depth, SMOKE.camera)
    assert torch.equal(inverse_project(zero.to(device), depth.to(device), SMOKE.camera).cpu(), expected)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("row", ["a.2", "c", "d", "f.r"])
def test_a_projector_on_the_device_gives_the_maps_of_the_cpu(device, row):
    """Views, batches and half precision; results are on the CPU."""
    torch.manual_seed(0)
    network = None if row == "a.2" else build(row, SMOKE.camera, SMOKE.model).eval()
    model = Projector(row, SMOKE.camera, network, DepthNet(SMOKE.camera, SMOKE.model).eval())
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (3, 40, 50, 3), dtype=np.uint8)
    masks = [Masks(rng.random((k, 40, 50)) > 0.7, channels="first") for k in (1, 3, 2)]
    expected = [model.project(image, mask) for image, mask in zip(images, masks)]
    there = model.to(device)
    assert there.device.type == device and model.device.type == "cpu"
    single = [there.view(image).project(mask) for image, mask in zip(images, masks)]
    for found in (single, there.project_batch(images, masks)):
        for one, other in zip(found, expected):
            # a pixel at the edge of a cell may change its cell
            assert (np.abs(one.values - other.values) > 1e-3).mean() < 0.01
    half = there.to(dtype=torch.bfloat16)
    assert half.device == there.device
    assert np.abs(half.project(images[0], masks[0]).values - expected[0].values).mean() < 0.03


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
def test_a_step_does_not_wait_for_the_gpu():
    accelerator = training_accelerator("cuda")
    model = build("c", SMOKE.camera, SMOKE.model)
    optimizer = torch.optim.Adam(model.parameters(), fused=True)
    model, optimizer = accelerator.prepare(model, optimizer)
    batch = {name: value.cuda() for name, value in Blocks(0).batch(0).items()}
    rgb, zero, target = batch["rgb"].float() / 255, batch["zero"].float(), batch["target"].float()
    for step in range(3):
        torch.cuda.set_sync_debug_mode("error" if step else "default")  # the first step may set things up
        try:
            accelerator.backward((model(rgb, zero).zero_logits.sigmoid() - target).square().mean())
            optimizer.step()
            optimizer.zero_grad()
        finally:
            torch.cuda.set_sync_debug_mode("default")
