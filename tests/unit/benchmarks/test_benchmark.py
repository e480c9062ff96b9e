"""Counts of the benchmark against closed forms."""

import pytest
import torch
from torch import nn

from zerobev.benchmarks import run as benchmark
from zerobev.benchmarks import training
from zerobev.benchmarks.run import ROWS, measure_inference
from zerobev.benchmarks.training import Machine, blocks, flops, min_milliseconds, training_step, waiting_fraction
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


def test_waiting_is_the_time_between_steps(monkeypatch):
    clock = [0.0]

    class Slow:
        def batch(self, step, rank=0, world_size=1):
            clock[0] += 3
            return Machine().batch(SMOKE.camera, 2)

    def counted(net, batch, machine):
        def step():
            clock[0] += 5

        return step

    monkeypatch.setattr(training.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(training, "training_step", counted)
    assert waiting_fraction(None, Slow(), Machine(), workers=0) == {"share": 3 / 8, "milliseconds": 8000}


def test_runs_take_turns_and_the_first_turn_does_not_count(monkeypatch):
    clock, calls = iter(range(100)), []
    monkeypatch.setattr(training.time, "perf_counter", lambda: next(clock) ** 2)
    found = Machine().milliseconds({name: lambda name=name: calls.append(name) for name in "ab"}, repeats=2)
    assert calls == list("ababab")
    # the warm-up reads the clock twice; then a takes 3^2 - 2^2, b 5^2 - 4^2, and so on
    assert found["a"] == {"median": 9e3, "low": 5e3, "high": 13e3}
    assert found["b"] == {"median": 13e3, "low": 9e3, "high": 17e3}


def test_one_call_and_separate_calls_get_the_same_images(monkeypatch):
    seen = {"shared": [], "separate": []}

    def listen(row, camera, model):
        net = build(row, camera, model)
        net.register_forward_pre_hook(lambda _, inputs: seen[current[0]].append(inputs[1].shape[1]))
        return net

    current = ["shared"]

    def once(self, runs, repeats):
        for name, run in runs.items():
            current[0] = name.split()[0]
            run()
        return {name: {"median": 1.0} for name in runs}

    monkeypatch.setattr(benchmark, "build", listen)
    monkeypatch.setattr(benchmark, "MODALITIES", (1, 8))
    monkeypatch.setattr(Machine, "milliseconds", once)
    measured = measure_inference(SMOKE, Machine(), repeats=1)
    assert seen == {"shared": [1, 8] * len(ROWS), "separate": [1] * 9 * len(ROWS)}
    assert measured["c"]["k8_over_k1"] == 1 and set(measured) == set(ROWS)
