"""Latency of projection: ratios and rates follow from the times, all on one thread."""

import pytest
import torch

from zerobev.benchmarks import projection, training
from zerobev.benchmarks.training import Machine


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """Seconds, for `Machine.milliseconds`."""
    now = [0.0]
    monkeypatch.setattr(training.time, "perf_counter", lambda: now[0])
    return now


@pytest.fixture
def machine() -> Machine:
    machine = Machine()
    machine.bfloat16 = True
    return machine


def test_a_second_modality_is_compared_with_the_first(monkeypatch, clock, machine):
    """A photograph takes 3 s, a mask 1 s; half of that in bfloat16."""

    class Fake:
        def __init__(self, factor=1.0, photograph=3):
            self.factor, self.photograph = factor, photograph

        def to(self, device, dtype):
            assert device == "cpu"
            return Fake(0.5 if dtype == torch.bfloat16 else 1.0)

        def view(self, rgb):
            return Fake(self.factor, 0)

        def project(self, *arguments):
            assert torch.get_num_threads() == 1
            clock[0] += self.factor * (self.photograph + len(arguments[-1].values))

    monkeypatch.setattr(projection, "projector", lambda row, setting: Fake())
    threads = torch.get_num_threads()
    found = projection.measure_views(machine, repeats=2)
    assert torch.get_num_threads() == threads and set(found) == set(projection.ROWS)
    for of in found.values():
        for precision, factor in (("float32", 1), ("bfloat16", 0.5)):
            for k, one in of[precision].items():
                assert one["ratio"] == pytest.approx(int(k) / (3 + int(k)))
                assert one["per_second"] == pytest.approx(1 / factor / (3 + int(k)))
    lines = projection.table(found, {"1": {"onnx": {"median": 2.0}, "ratio": 0.5}})
    assert "1: 0.25, 8: 0.73, 40: 0.93; per s 1: 0.2, 8: 0.1" in lines[0] and lines[-1].endswith("1: 0.50")
    machine.bfloat16 = False  # emulated
    assert list(projection.measure_views(machine, repeats=1)["c"]) == ["float32"]


def test_onnx_is_compared_with_torch(monkeypatch, clock, machine):
    """A call of torch takes K seconds, a call of ONNX Runtime K / 4."""

    class Session:
        def __init__(self, path, options, providers):
            assert options.intra_op_num_threads == 1 and path.exists() and providers == ["CPUExecutionProvider"]

        def run(self, outputs, inputs):
            clock[0] += inputs["zero"].shape[1] / 4

    class Network:
        def eval(self):
            return self

        def __call__(self, rgb, zero):
            assert torch.get_num_threads() == 1
            clock[0] += zero.shape[1]

    monkeypatch.setattr(projection, "build", lambda row, camera, model: Network())
    monkeypatch.setattr(projection, "export_onnx", lambda net, path: path.write_bytes(b""))
    monkeypatch.setattr(projection.onnxruntime, "InferenceSession", Session)
    found = projection.measure_onnx(machine, repeats=2)
    assert {k: one["ratio"] for k, one in found.items()} == {"1": 0.25, "8": 0.25, "40": 0.25}
    assert found["40"]["torch"]["median"] == 40e3
