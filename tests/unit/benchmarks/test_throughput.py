"""Steps of several processes: settings reach their process, and ratios follow from the times."""

import os

import pytest
import torch

from zerobev.benchmarks import throughput, training
from zerobev.benchmarks.throughput import Trainer, busy_loops, measure_throughput
from zerobev.benchmarks.training import Machine
from zerobev.config import SCALES

SMOKE = SCALES["smoke"]


def test_busy_loops_run_and_end():
    with busy_loops(2) as loops:
        assert len(loops) == 2 and [loop.poll() for loop in loops] == [None, None]
    assert all(loop.returncode for loop in loops)  # killed


@pytest.mark.slow
def test_settings_belong_to_the_process_of_a_trainer():
    before = dict(os.environ)
    spinning, plain = Trainer(SMOKE, 2, keeps=True, spins=True), Trainer(SMOKE, 1, keeps=False)
    assert dict(os.environ) == before
    for trainer, threads, spins in ((spinning, 2, "300000"), (plain, 1, None)):
        assert trainer.pool.submit(torch.get_num_threads).result() == threads
        assert trainer.pool.submit(os.getenv, "GOMP_SPINCOUNT").result() == spins
        trainer.start("f", 1).result()
        trainer.pool.shutdown()


@pytest.mark.parametrize("keeps", [True, False])
def test_the_allocator_of_training_is_a_setting(monkeypatch, keeps):
    called = []
    monkeypatch.setattr(throughput, "keep_freed_memory", lambda: called.append(True))
    monkeypatch.setattr(throughput, "_steps", {})
    throughput._prepare("smoke", 1, keeps)
    assert called == [True] * keeps and set(throughput._steps) == {"c", "f"}


def test_ratios_of_machine_time(monkeypatch):
    """A clock on which a step takes 8 s with two threads, 10 s with one, 1 s less with kept memory.

    Two processes at the same time take 1 s longer; each busy loop adds 2 s, and 10 s for threads that spin.
    """
    clock, loops = [0.0], [0]

    class Fake:
        def __init__(self, setting, threads, keeps, spins=False):
            self.pool = self
            self.seconds = (8 if threads == 2 else 10) - keeps
            self.busy = 10 if spins else 2

        def start(self, row, steps):
            running.append(self)
            self.steps = steps
            return self

        def result(self):
            if running:  # the first result ends when all have made their steps
                seconds = max(one.seconds + one.busy * loops[0] for one in running) + (len(running) - 1)
                clock[0] += seconds * self.steps
                running.clear()

        def shutdown(self):
            closed.append(self)

    class Loops:
        def __init__(self, count):
            self.count = count

        def __enter__(self):
            loops[0] = self.count

        def __exit__(self, *_):
            loops[0] = 0

    running, closed = [], []
    monkeypatch.setattr(throughput, "Trainer", Fake)
    monkeypatch.setattr(throughput, "busy_loops", Loops)
    monkeypatch.setattr(training.time, "perf_counter", lambda: clock[0])
    found = measure_throughput(SMOKE, Machine(), repeats=1)
    for row in ("c", "f"):
        assert {name: (step["median"], step["ratio"]) for name, step in found["rows"][row].items()} == {
            "two threads, default": (8e3, 1),
            "two threads, kept": (7e3, 7 / 8),
            "one thread, default": (10e3, 10 / 8),
            "one thread, kept": (9e3, 9 / 8),
            "two processes, default": (5.5e3, 11 / 16),
            "two processes, kept": (5e3, 5 / 8),
        }
    busy = {name: (step["median"], step["ratio"]) for name, step in found["busy"].items()}
    assert busy == {
        "two threads": (11e3, 11 / 7),
        "one thread": (13e3, 13 / 9),
        "two threads that spin": (27e3, 27 / 7),
    }
    assert len(closed) == 7
