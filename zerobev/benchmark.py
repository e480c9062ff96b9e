"""What data, a training step and an inference cost: `python -m zerobev.benchmark [--scale S] [--json FILE]`.

One run measures everything, in turns and with its spread. Milliseconds belong to a machine and a minute: what carries
over are the ratios, to the machine's own peak of matrix products and between settings.
"""

import argparse
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from zerobev.config import SCALES, CameraConfig, Scale, scale
from zerobev.errors import run_command
from zerobev.learning.losses import zero_bev_loss
from zerobev.learning.precision import computes_bfloat16
from zerobev.models import BevModel, ZeroBEV, build
from zerobev.records import kept, peak_memory_mb
from zerobev.storage import write_json
from zerobev.streams import benchmark as generation
from zerobev.streams.benchmark import spread
from zerobev.streams.tuples import SynthTuples
from zerobev.workspace import Workspace

MODALITIES = (1, 8, 40)  #: zero-shot images of one photograph
ROWS = ("c", "e", "f")  #: that inference is measured of
_MATMUL = 2048  # side of the matrices whose product is the machine's peak
_SIZES = (0.5, 1.0, 2.0)  # of images and of maps, times the scale's
_SCENES = (1, 4)
_VERSION = 1  # raised by hand when what is measured changes

Run = Callable[[], Any]


class Machine:
    """The device that everything is measured on, and how time is taken there."""

    def __init__(self) -> None:
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.bfloat16 = computes_bfloat16(self.device.type)

    def autocast(self) -> torch.autocast:
        """As in training."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16)

    def milliseconds(self, runs: dict[str, Run], repeats: int) -> dict[str, dict[str, float]]:
        """Spread of the time of each run. They take turns, so that a slow minute is everybody's."""
        times: dict[str, list[float]] = {name: [] for name in runs}
        for repeat in range(repeats + 1):  # the first one warms up
            for name, run in runs.items():
                start = time.perf_counter()
                run()
                if self.device.type == "cuda":
                    torch.cuda.synchronize()
                if repeat:
                    times[name].append(1e3 * (time.perf_counter() - start))
        return {name: spread(values) for name, values in times.items()}

    def batch(self, camera: CameraConfig, samples: int, images: int = 1) -> dict[str, Tensor]:
        """Random tensors of the form of `streams.tuples`; what is in them takes no time."""
        side, cells = camera.fpv_px, camera.bev_px
        shapes = {"rgb": (3, side), "zero": (images, side), "depth": (1, side), "target": (images, cells)}
        shapes |= {"aux": (2, cells), "fov": (1, cells)}
        random = {name: torch.rand(samples, k, n, n, device=self.device) for name, (k, n) in shapes.items()}
        return {name: image if name in ("rgb", "depth") else image.round() for name, image in random.items()}


def training_step(net: BevModel, batch: dict[str, Tensor], machine: Machine) -> Run:
    """One step as `learning.train` takes it: forward, loss, backward, Adam."""
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-4, fused=True)
    net.train()

    def step() -> None:
        with machine.autocast():
            projection = net(batch["rgb"], batch["zero"], batch["depth"])
        zero_bev_loss(projection, batch, 0.5, net.config.aux).total.backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def blocks(net: ZeroBEV, batch: dict[str, Tensor], machine: Machine) -> dict[str, Run]:
    """Forward and backward of each block of the network by itself, on the maps that it gets in a step."""
    with machine.autocast():
        rgb = net.backbone(batch["rgb"])
        fpv = net.fpv_maps(rgb, batch["zero"])
        pyramid = net.pyramid(fpv)
        bev, _ = net.bands(pyramid)
    inputs = {name: _leaves(maps) for name, maps in {"rgb": rgb, "fpv": fpv, "pyramid": pyramid, "bev": [bev]}.items()}
    parts: dict[str, Callable[[], Iterable[Tensor]]] = {
        "backbone": lambda: net.backbone(batch["rgb"]),
        "zero-shot CNN": lambda: net.fpv_maps(inputs["rgb"], batch["zero"]),
        "pyramid": lambda: net.pyramid(inputs["fpv"]),
        "band transformers": lambda: [net.bands(inputs["pyramid"])[0]],
        "U-Net": lambda: [net.decoder(inputs["bev"][0])],
    }

    def both(part: Callable[[], Iterable[Tensor]]) -> Run:
        def run() -> None:
            with machine.autocast():
                outputs = list(part())
            torch.autograd.backward(outputs, [torch.ones_like(output) for output in outputs])

        return run

    return {name: both(part) for name, part in parts.items()}


def measure_training(setting: Scale, machine: Machine, repeats: int) -> dict[str, Any]:
    """A step of (c), its blocks, and the drawing of its batch; and what share of the peak of products they reach.

    The peak is that of the matrix product of two matrices of 2048 x 2048, in bfloat16 where training computes in it.
    """
    net = build("c", setting.camera, setting.model).to(machine.device)
    assert isinstance(net, ZeroBEV)  # as row (c) is
    batch = machine.batch(setting.camera, setting.train.batch)
    matrix = torch.rand(_MATMUL, _MATMUL, device=machine.device)
    matrix = matrix.bfloat16() if machine.bfloat16 else matrix
    views = Workspace(setting.name).views("train", _SCENES[0])
    samples = (setting.camera, 0, setting.train.batch, setting.blank)
    stream = SynthTuples(views, Workspace(setting.name).bank(), *samples, upright=setting.upright)
    runs: dict[str, Run] = {"matrix product": lambda: matrix @ matrix, "step": training_step(net, batch, machine)}
    runs |= blocks(net, batch, machine) | {"batch": lambda: stream.batch(0)}
    milliseconds = machine.milliseconds(runs, repeats)
    peak = 2 * _MATMUL**3 / milliseconds["matrix product"]["low"] / 1e9  # TFLOP a second
    operations = {name: flops(run) for name, run in runs.items() if name != "batch"}
    step, drawn = milliseconds["step"]["median"], milliseconds["batch"]["median"]
    return {
        "milliseconds": milliseconds,
        "gigaflops": {name: count / 1e9 for name, count in operations.items()},
        "peak_tflops": peak,
        "share_of_peak": {n: count / milliseconds[n]["median"] / 1e9 / peak for n, count in operations.items()},
        "data_share": drawn / (step + drawn),
    }


def measure_inference(setting: Scale, machine: Machine, repeats: int) -> dict[str, Any]:
    """Milliseconds for K images of one photograph, in one call and in K calls, of the networks `ROWS`."""
    measured = {}
    for row in ROWS:
        net = build(row, setting.camera, setting.model).to(machine.device).eval()
        runs: dict[str, Run] = {}
        for k in MODALITIES:
            batch = machine.batch(setting.camera, 1, k)
            rgb, images = batch["rgb"], batch["zero"]
            runs[f"shared {k}"] = partial(net, rgb, images)
            runs[f"separate {k}"] = partial(_one_by_one, net, rgb, images)
        with torch.inference_mode():
            found = machine.milliseconds(runs, repeats)
        one = found["shared 1"]["median"]
        measured[row] = {
            "milliseconds": found,
            "k8_over_k1": found["shared 8"]["median"] / one,
            "shared_over_separate": {
                str(k): found[f"shared {k}"]["median"] / found[f"separate {k}"]["median"] for k in MODALITIES
            },
        }
    return measured


def measure_sizes(setting: Scale, machine: Machine, repeats: int) -> dict[str, dict[str, Any]]:
    """How a step grows with the image, with the map, and the drawing of a batch with the number of scenes.

    Ratios to the scale's own size, or to one scene.
    """
    camera = setting.camera
    cameras = {f"image {s:g}x": replace(camera, fpv_px=round(s * camera.fpv_px)) for s in _SIZES}
    cameras |= {f"map {s:g}x": replace(camera, bev_px=round(s * camera.bev_px)) for s in _SIZES}
    runs = {}
    for name, other in cameras.items():
        net = build("c", other, setting.model).to(machine.device)
        runs[name] = training_step(net, machine.batch(other, setting.train.batch), machine)
    workspace = Workspace(setting.name)
    for scenes in _SCENES:
        views = workspace.views("train", scenes)
        stream = SynthTuples(views, workspace.bank(), camera, 0, setting.train.batch)
        runs[f"scenes {scenes}"] = partial(_next_batch, stream, itertools.count())
    found = machine.milliseconds(runs, repeats)
    base = {"image": "image 1x", "map": "map 1x", "scenes": f"scenes {_SCENES[0]}"}
    return {
        name: one | {"ratio": one["median"] / found[base[name.split()[0]]]["median"]} for name, one in found.items()
    }


def measure_memory(setting: Scale) -> dict[str, float]:
    """Peak memory in MB of fresh processes: that import, train five steps, project 40 images, draw batches."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        parts = ("imports", "training", "inference", "data")
        return {part: pool.submit(_peak_of, part, setting.name).result() for part in parts}


def _peak_of(part: str, name: str) -> float:
    setting, machine = scale(name), Machine()
    if part == "training":
        net = build("c", setting.camera, setting.model).to(machine.device)
        step = training_step(net, machine.batch(setting.camera, setting.train.batch), machine)
        for _ in range(5):
            step()
    elif part == "inference":
        net = build("c", setting.camera, setting.model).to(machine.device).eval()
        batch = machine.batch(setting.camera, 1, MODALITIES[-1])
        with torch.inference_mode():
            net(batch["rgb"], batch["zero"])
    elif part == "data":
        workspace = Workspace(name)
        stream = SynthTuples(workspace.views("train", _SCENES[-1]), workspace.bank(), setting.camera, 0, 16)
        for number in range(20):
            stream.batch(number)
    return peak_memory_mb()


def _one_by_one(net: BevModel, rgb: Tensor, images: Tensor) -> None:
    for image in images.split(1, dim=1):
        net(rgb, image)


def _next_batch(stream: SynthTuples, steps: Iterator[int]) -> None:
    stream.batch(next(steps))


def flops(run: Run) -> int:
    """Floating-point operations of matrix products and convolutions, forward and backward."""
    with FlopCounterMode(display=False) as counter:
        run()
    return counter.get_total_flops()


def measure(setting: Scale, repeats: int) -> dict[str, Any]:
    """Everything, as plain data."""
    machine = Machine()
    training = measure_training(setting, machine, repeats)
    inference = measure_inference(setting, machine, repeats)
    return {
        "scale": setting.name,
        "device": machine.device.type,
        "threads": torch.get_num_threads(),
        "repeats": repeats,
        "k8_over_k1": inference["c"]["k8_over_k1"],
        "generation": generation.measure(setting, repeats, seconds=1.0),
        "training": training,
        "inference": inference,
        "sizes": measure_sizes(setting, machine, repeats),
        "memory_mb": measure_memory(setting),
    }


def table(measured: dict[str, Any]) -> list[str]:
    """The figures of interest as lines of text: medians, and the range of the repeats in brackets."""
    training = measured["training"]
    lines = [f"scale {measured['scale']} on {measured['device']}: median [smallest, largest] of the repeats, ms"]
    lines += [f"generation, {line}" for line in generation.table(measured["generation"])[1:]]
    for name, ms in training["milliseconds"].items():
        share = training["share_of_peak"].get(name)
        of_peak = "" if share is None else f"{100 * share:6.1f} % of the peak"
        lines.append(f"training, {name:<24}{ms['median']:>9.1f}  [{ms['low']:.1f}, {ms['high']:.1f}]{of_peak}")
    lines.append(f"{'data, share of a step':<34}{100 * training['data_share']:>9.1f} %")
    for row, found in measured["inference"].items():
        shares = ", ".join(f"{k}: {ratio:.2f}" for k, ratio in found["shared_over_separate"].items())
        lines.append(f"inference ({row}): 8 images take {found['k8_over_k1']:.2f} x one; one call / K calls {shares}")
    lines += [f"{name:<34}{one['ratio']:>9.2f} x" for name, one in measured["sizes"].items()]
    return lines + [f"memory, {name:<26}{peak:>9.0f} MB" for name, peak in measured["memory_mb"].items()]


def _leaves(maps: Iterable[Tensor]) -> list[Tensor]:
    return [m.detach().clone().requires_grad_() for m in maps]


def recorded_benchmark(workspace: Workspace) -> dict[str, Any]:
    """The measurements of a report, `benchmark.json`: read where they are recorded, else taken now (some minutes)."""
    identity = {"version": _VERSION, "scale": workspace.scale.name}
    return kept(workspace.reports / "benchmark.json", identity, lambda: measure(workspace.scale, repeats=9))


def main() -> None:
    """Measure, print the table, and write everything with `--json`."""
    parser = argparse.ArgumentParser(prog="python -m zerobev.benchmark", description=__doc__)
    parser.add_argument("--scale", default="reduced", help=f"one of {', '.join(SCALES)} (default: reduced)")
    parser.add_argument("--repeats", type=int, default=9, help="of which the median is taken (default: 9)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write everything measured to FILE")
    options = parser.parse_args()
    measured = measure(scale(options.scale), options.repeats)
    for line in table(measured):
        print(line)
    if options.json:
        write_json(options.json, measured)


if __name__ == "__main__":
    run_command(main)
