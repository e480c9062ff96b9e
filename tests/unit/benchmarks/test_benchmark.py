"""Counts of the benchmark against closed forms."""

import pytest
import torch
from torch import nn

from zerobev.benchmarks import run as benchmark
from zerobev.benchmarks import training
from zerobev.benchmarks.run import measure_calls, measure_inference
from zerobev.benchmarks.training import Machine, blocks, flops, measure_drawing, min_milliseconds, training_step
from zerobev.config import SCALES
from zerobev.models import build

SMOKE = SCALES["smoke"]


@pytest.fixture(autouse=True)
def single_thread():
    torch.set_num_threads(1)


def test_operations_of_products_and_convolutions_in_closed_form():
    a, b = torch.rand(3, 5), torch.rand(5, 7)
    assert flops(lambda: a @ b) == 2 * 3 * 5 * 7
    layer, image = nn.Conv2d(4, 6, 3, padding=1), torch.rand(2, 4, 8, 8)
    forward = 2 * (2 * 8 * 8) * (4 * 9) * 6
    assert flops(lambda: layer(image)) == forward
    # the gradient of the weights costs the same; the image needs no gradient
    assert flops(lambda: layer(image).sum().backward()) == 2 * forward


def test_blocks_are_all_of_a_step():
    machine = Machine()
    net = build("c", SMOKE.camera, SMOKE.model).to(machine.device)
    batch = machine.batch(SMOKE.camera, 2)
    step = flops(training_step(net, batch, machine))
    assert sum(flops(run) for run in blocks(net, batch, machine).values()) == step > 0


def test_a_roofline_in_closed_form():
    """At 1 GFLOP and 1 MB per millisecond: 1 TFLOP/s and 1 GB/s."""
    a, b = torch.rand(2, 1000, 250)
    assert min_milliseconds(lambda: a + b, 1, 1) == pytest.approx(3)  # two read, one written, one megabyte each
    assert min_milliseconds(lambda: a.add_(b), 1, 1) == pytest.approx(2)
    assert min_milliseconds(lambda: a + b[:1], 1, 1) == pytest.approx(2.001)
    assert min_milliseconds(lambda: a.T.unsqueeze(0).detach().view(1, 250, 1000), 1, 1) == 0
    assert min_milliseconds(lambda: torch.empty_like(a), 1, 1) == 0
    product = 2 * 1000 * 250 * 1000 / 1e9  # milliseconds; in memory it takes 2 for the factors, 4 for the result
    assert min_milliseconds(lambda: a @ b.T, 1, 1) == pytest.approx(6)
    assert min_milliseconds(lambda: a @ b.T, 0.01, 1) == pytest.approx(100 * product)
    assert min_milliseconds(lambda: a + a @ b.T @ a, 0.01, 1) == pytest.approx(200 * product + 3)


def test_a_roofline_of_products_alone_is_their_number():
    machine = Machine()
    net = build("c", SMOKE.camera, SMOKE.model).to(machine.device)
    step = training_step(net, machine.batch(SMOKE.camera, 2), machine)
    assert min_milliseconds(step, 1, float("inf")) == pytest.approx(flops(step) / 1e9)
    assert min_milliseconds(step, 1, 1) > min_milliseconds(step, 1, 10) > flops(step) / 1e9


def test_the_share_of_drawing_is_that_of_its_sum_with_a_step(monkeypatch):
    clock, drawn = [0.0], []

    class Slow:
        def __init__(self, views, setting, samples):
            self.samples = samples

        def batch(self, step, rank=0, world_size=1):
            clock[0] += 3
            drawn.append((self.samples, step))
            return Machine().batch(SMOKE.camera, 2)

    def counted(net, batch, machine):
        def step():
            clock[0] += 5

        return step

    monkeypatch.setattr(training, "SCALES", {"smoke": SMOKE})
    monkeypatch.setattr(training, "home_folder", lambda folder, number: folder)
    monkeypatch.setattr(training, "stored_views", lambda *_: None)
    monkeypatch.setattr(training, "synth_stream", Slow)
    monkeypatch.setattr(training, "training_step", counted)
    monkeypatch.setattr(training.time, "perf_counter", lambda: clock[0])
    measured = measure_drawing(Machine(), repeats=2)["smoke"]
    assert measured["share"] == 3 / 8 and measured["samples"] == SMOKE.train.batch
    assert drawn == [(SMOKE.train.batch, step) for step in range(3)]  # another batch each time


def test_runs_take_turns_and_the_first_turn_does_not_count(monkeypatch):
    clock, calls = iter(range(100)), []
    monkeypatch.setattr(training.time, "perf_counter", lambda: next(clock) ** 2)
    found = Machine().milliseconds({name: lambda name=name: calls.append(name) for name in "ab"}, repeats=2)
    assert calls == list("ababab")
    # the warm-up reads the clock twice; then a takes 3^2 - 2^2, b 5^2 - 4^2, and so on
    assert found["a"] == {"median": 9e3, "low": 5e3, "high": 13e3}
    assert found["b"] == {"median": 13e3, "low": 9e3, "high": 17e3}


def test_k_images_are_compared_with_one_in_the_same_precision(monkeypatch):
    """A clock on which a call takes 2 + K in float32 and 1 + K in bfloat16."""
    clock, rgb_px = [0.0], set()

    class Network(nn.Module):
        def forward(self, rgb, images, depth):
            rgb_px.add(rgb.shape[-1])
            assert images.shape[0] == 1 and depth is not None and not torch.is_grad_enabled()
            clock[0] += images.shape[1] + 2 - torch.is_autocast_enabled("cpu")

    monkeypatch.setattr(benchmark, "build", lambda row, camera, model: Network())
    monkeypatch.setattr(training.time, "perf_counter", lambda: clock[0])
    machine = Machine()
    machine.bfloat16 = True
    measured = measure_inference(SMOKE, ("c", "f"), (1, 8), machine, repeats=2)
    assert measured["c"] == measured["f"] and rgb_px == {SMOKE.camera.fpv_px}
    ratios = {p: {k: ms["ratio"] for k, ms in found.items()} for p, found in measured["c"].items()}
    assert ratios == {"float32": {"1": 1, "8": 10 / 3}, "bfloat16": {"1": 1, "8": 9 / 2}}
    machine.bfloat16 = False  # emulated, which is slower
    assert list(measure_inference(SMOKE, ("c",), (1,), machine, repeats=1)["c"]) == ["float32"]
    # one call takes 2 + K, K calls take 3 K
    assert {k: found["ratio"] for k, found in measure_calls(SMOKE, machine, 2).items()} == {
        "1": 1,
        "8": 10 / 24,
        "40": 42 / 120,
    }
