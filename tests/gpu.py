"""All checks on a GPU, in one command: `python -m tests.gpu [--json FILE] [--compile] [-- ARGUMENTS OF zerobev run]`.

1. The tests of the CUDA paths (`tests/unit/training/test_cuda.py`).
2. A training step of rows (c), (b.2) and (f) at the sizes of `paper` and `reduced`: time, memory, and fractions of the
   rate of a matrix product and of the roofline. With `--compile`, also a compiled step of (c) at `reduced`.
3. `zerobev run` with the arguments after `--`, if any.

Without a GPU, the CUDA tests are skipped and listed, and only steps of the scale `smoke` are timed.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

from zerobev import cli
from zerobev.benchmarks.training import Machine, against_the_machine, training_step
from zerobev.common.storage import write_json
from zerobev.config import SCALES
from zerobev.experiments.provenance import git_revision, origin
from zerobev.models import build

ROOT = Path(__file__).resolve().parents[1]
ROWS = ("c", "b.2", "f")
_REPEATS = 10


def run_tests() -> bool:
    """Run the tests of the CUDA paths; prints skipped tests with reasons."""
    command = [sys.executable, "-m", "pytest", "-q", "-rs", "tests/unit/training/test_cuda.py"]
    return subprocess.run(command, cwd=ROOT, check=False).returncode == 0


def measure_steps(machine: Machine, name: str, samples: int) -> dict[str, Any]:
    """A step of each row at a scale, against a matrix product and a copy; on a GPU also its peak memory, GB."""
    setting = SCALES[name]
    runs, memory = {}, {}
    for row in ROWS:
        net = build(row, setting.camera, setting.model).to(machine.device)
        batch = machine.batch(setting.camera, samples)
        if row == "b.2":  # TIM predicts a map per class
            batch["target"] = batch["target"].expand(-1, 8, -1, -1)
        runs[row] = training_step(net, batch, machine)
        if machine.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats()
            runs[row]()
            memory[row] = torch.cuda.max_memory_allocated() / 1e9
    return against_the_machine(runs, machine, _REPEATS) | {"samples": samples, "memory_gb": memory}


def measure_compiled(machine: Machine) -> dict[str, Any]:
    """Milliseconds of a step of (c) at `reduced`, eager and with `torch.compile`, interleaved."""
    setting = SCALES["reduced"]
    runs = {}
    for name in ("eager", "compiled"):
        net = build("c", setting.camera, setting.model).to(machine.device)
        net = torch.compile(net) if name == "compiled" else net
        runs[name] = training_step(net, machine.batch(setting.camera, setting.train.batch), machine)
    return machine.milliseconds(runs, _REPEATS)


def main() -> None:
    """Run the tests, time the steps, run the training; exit code 1 if a test failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.gpu", description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the times there")
    parser.add_argument("--compile", action="store_true", help="also time a compiled step")
    parser.add_argument("run", nargs="*", metavar="ARGUMENTS", help="of `zerobev run`, after --")
    options = parser.parse_args()
    passed = run_tests()
    machine = Machine()
    on_gpu = machine.device.type == "cuda"
    sizes = {"paper": 16, "reduced": 16} if on_gpu else {"smoke": 4}
    found: dict[str, Any] = {name: measure_steps(machine, name, samples) for name, samples in sizes.items()}
    found["origin"] = origin(torch.cuda.get_device_name() if on_gpu else "cpu", git_revision())
    if options.compile:
        found["compiled"] = measure_compiled(machine)
    print(json.dumps(found, indent=1))
    if options.json:
        write_json(options.json, found)
    if options.run:
        cli.main(["run", *options.run])
    sys.exit(0 if passed else 1)


if __name__ == "__main__":
    main()
