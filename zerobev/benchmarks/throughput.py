"""Training steps of the whole machine, and beside other work; part of `zerobev benchmark`.

The number of threads, the allocator and the behaviour of waiting threads belong to a process. So each setting has
processes of its own. They wait until it is their turn.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any

import torch

from zerobev.benchmarks.training import Machine, Run, training_step
from zerobev.common.memory import keep_freed_memory
from zerobev.config import Scale, scale
from zerobev.models import build

ROWS = ("c", "f")  #: of which steps are measured
_STEPS = 4  # per turn
_LOOPS = 2  # busy processes beside a training
_LOOP_SECONDS = 10  # after which a busy loop ends; the limit of a measurement beside it
_SPINS = "300000"  # of a waiting thread before it sleeps: the default of GCC's OpenMP library

_steps: dict[str, Run] = {}  # of this process, by row; filled in the processes of trainers


class Trainer:
    """A process with its own networks, for training steps on demand.

    threads: of torch
    keeps: freed memory is kept for reuse, as in `training.train`; otherwise the allocator has its defaults
    spins: waiting threads spin first, as by default of OpenMP; otherwise they sleep, as set by `zerobev`
    """

    def __init__(self, setting: Scale, threads: int, keeps: bool, spins: bool = False) -> None:
        arguments = (setting.name, threads, keeps)
        self.pool = ProcessPoolExecutor(1, get_context("spawn"), _prepare, arguments)
        with _spinning() if spins else contextlib.nullcontext():
            self.start(ROWS[0], 0)  # starts the process

    def start(self, row: str, steps: int) -> Future[None]:
        """Begin training steps of a row."""
        return self.pool.submit(_make_steps, row, steps)


@contextlib.contextmanager
def _spinning() -> Iterator[None]:
    os.environ["GOMP_SPINCOUNT"] = _SPINS  # takes precedence over OMP_WAIT_POLICY
    try:
        yield
    finally:
        del os.environ["GOMP_SPINCOUNT"]


def _prepare(name: str, threads: int, keeps: bool) -> None:
    if keeps:
        keep_freed_memory()
    torch.set_num_threads(threads)
    setting, machine = scale(name), Machine()
    for row in ROWS:
        net = build(row, setting.camera, setting.model).to(machine.device)
        _steps[row] = training_step(net, machine.batch(setting.camera, setting.train.batch), machine)


def _make_steps(row: str, steps: int) -> None:
    for _ in range(steps):
        _steps[row]()


@contextlib.contextmanager
def busy_loops(count: int) -> Iterator[list[subprocess.Popen]]:
    """Processes that compute all the time; they end with the context, or after some seconds."""
    code = f"import time\nend = time.monotonic() + {_LOOP_SECONDS}\nwhile time.monotonic() < end: pass"
    loops = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(count)]
    try:
        yield loops
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def make_steps(trainers: Sequence[Trainer], row: str, steps: int, loops: int = 0) -> None:
    """Make `steps` of a row in each trainer, at the same time, beside busy loops."""
    with busy_loops(loops):
        for future in [trainer.start(row, steps) for trainer in trainers]:
            future.result()


def measure_throughput(setting: Scale, machine: Machine, repeats: int) -> dict[str, Any]:
    """Milliseconds of the machine per training step, by row, processes and allocator; and a step beside busy loops.

    Returns `rows`: per row and setting the spread, and `ratio` to two threads with the default allocator. And `busy`:
    of row (c) the time of a step beside two busy loops, and `ratio` to a step alone.
    """
    two, one = (
        {
            allocator: [Trainer(setting, threads, allocator == "kept") for _ in range(processes)]
            for allocator in ("default", "kept")
        }
        for threads, processes in ((2, 1), (1, 2))
    )
    spinning = [Trainer(setting, 2, True, spins=True)]
    trainers = {f"two threads, {allocator}": of for allocator, of in two.items()}
    trainers |= {f"one thread, {allocator}": of[:1] for allocator, of in one.items()}
    trainers |= {f"two processes, {allocator}": of for allocator, of in one.items()}
    beside = {"two threads": two["kept"], "one thread": one["kept"][:1], "two threads that spin": spinning}
    runs = {(row, name): partial(make_steps, of, row, _STEPS) for row in ROWS for name, of in trainers.items()}
    busy = {
        (name, loops): partial(make_steps, of, "c", 1, loops) for name, of in beside.items() for loops in (0, _LOOPS)
    }
    try:
        found = machine.milliseconds(runs, repeats)
        found_busy = machine.milliseconds(busy, repeats)
    finally:
        for trainer in (*two["default"], *two["kept"], *one["default"], *one["kept"], *spinning):
            trainer.pool.shutdown()
    rows = {}
    for row in ROWS:
        steps = {
            name: {of: ms / (_STEPS * len(trainers[name])) for of, ms in found[row, name].items()} for name in trainers
        }
        base = steps["two threads, default"]["median"]
        rows[row] = {name: step | {"ratio": step["median"] / base} for name, step in steps.items()}
    return {
        "rows": rows,
        "busy": {
            name: found_busy[name, _LOOPS]
            | {"ratio": found_busy[name, _LOOPS]["median"] / found_busy[name, 0]["median"]}
            for name in beside
        },
    }
