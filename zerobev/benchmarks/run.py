"""Measure the cost of data, of a training step and of inference.

Reads homes and views (made first if they are missing); prints a table and writes all measurements with `--json`.
Settings are interleaved, so that machine noise hits all alike, and reported with their spread. Milliseconds depend on
machine and time; ratios carry over: to the machine's peak of matrix products, and between settings.
"""

import argparse
import itertools
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from zerobev.benchmarks import data as generation
from zerobev.benchmarks import projection
from zerobev.benchmarks.throughput import measure_throughput
from zerobev.benchmarks.training import (
    Machine,
    Run,
    draw,
    few,
    measure_drawing,
    measure_paper_step,
    measure_training,
    training_step,
)
from zerobev.common.memory import keep_freed_memory
from zerobev.common.storage import write_json
from zerobev.config import SCALES, Scale, scale
from zerobev.data.samples import SynthSamples
from zerobev.experiments import versions
from zerobev.experiments.provenance import peak_memory_mb
from zerobev.experiments.records import recorded
from zerobev.experiments.workspace import Workspace
from zerobev.models import BevModel, build

MODALITIES = (1, 8, 40)  #: zero-shot images per RGB image
ROWS = ("c", "d", "e", "f", "f.r")  #: of which inference is measured
PAPER_ROWS = ("c", "e", "f")  #: the same at the paper's sizes
REPEATS = 5  #: of the recorded benchmark
_LARGE_PX = 128  # of the images of larger cameras
_SIZES = (0.5, 1.0, 2.0)  # of images and of maps, relative to the scale's
_SCENES = (1, 4)


def measure_inference(
    setting: Scale, rows: Sequence[str], modalities: Sequence[int], machine: Machine, repeats: int
) -> dict[str, Any]:
    """Milliseconds of one call for K zero-shot images of one RGB image, per row and precision.

    `ratio`: relative to one image in the same precision.
    """
    precisions = ("float32", "bfloat16") if machine.bfloat16 else ("float32",)
    measured = {}
    for row in rows:
        net = build(row, setting.camera, setting.model).to(machine.device).eval()
        batches = {k: machine.batch(setting.camera, 1, k) for k in modalities}
        runs: dict[tuple[str, int], Run] = {
            (precision, k): partial(_project, net, [batch], machine.autocast(precision == "bfloat16"))
            for precision, (k, batch) in itertools.product(precisions, batches.items())
        }
        found = machine.milliseconds(runs, repeats)
        measured[row] = {
            precision: {
                str(k): found[precision, k] | {"ratio": found[precision, k]["median"] / found[precision, 1]["median"]}
                for k in modalities
            }
            for precision in precisions
        }
    return measured


def measure_calls(setting: Scale, machine: Machine, repeats: int) -> dict[str, Any]:
    """Milliseconds of (c) for K zero-shot images of one RGB image, in one call and in K calls; `ratio`: of the two."""
    net = build("c", setting.camera, setting.model).to(machine.device).eval()
    runs: dict[tuple[str, int], Run] = {}
    for k in MODALITIES:
        batch = machine.batch(setting.camera, 1, k)
        singles = [batch | {"zero": image} for image in batch["zero"].split(1, dim=1)]
        for how, calls in (("one call", [batch]), ("K calls", singles)):
            runs[how, k] = partial(_project, net, calls, machine.autocast(False))
    found = machine.milliseconds(runs, repeats)
    return {
        str(k): {how: found[how, k] for how in ("one call", "K calls")}
        | {"ratio": found["one call", k]["median"] / found["K calls", k]["median"]}
        for k in MODALITIES
    }


def measure_sizes(setting: Scale, machine: Machine, repeats: int) -> dict[str, dict[str, Any]]:
    """Time of a step by size of image and of map, and time of drawing a batch by number of scenes.

    Each with its ratio to the scale's own size, or to one scene.
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
        stream = SynthSamples(views, workspace.bank(), camera, 0, setting.train.batch)
        runs[f"scenes {scenes}"] = partial(draw, stream, itertools.count(), machine)
    found = machine.milliseconds(runs, repeats)
    base = {"image": "image 1x", "map": "map 1x", "scenes": f"scenes {_SCENES[0]}"}
    return {
        name: one | {"ratio": one["median"] / found[base[name.split()[0]]]["median"]} for name, one in found.items()
    }


def measure_memory(setting: Scale) -> dict[str, float]:
    """Peak memory of new processes, MB: after imports, five training steps, 40 projected images, 20 batches."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        parts = ("imports", "training", "inference", "data")
        return {part: pool.submit(_peak_of, part, setting.name).result() for part in parts}


def _peak_of(part: str, name: str) -> float:
    setting, machine = scale(name), Machine()
    if part == "training":
        keep_freed_memory()
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
        stream = SynthSamples(workspace.views("train", _SCENES[-1]), workspace.bank(), setting.camera, 0, 16)
        for number in range(20):
            stream.batch(number)
    return peak_memory_mb()


@torch.inference_mode()
def _project(net: BevModel, batches: Sequence[dict[str, Tensor]], autocast: torch.autocast) -> None:
    with autocast:
        for batch in batches:
            net(batch["rgb"], batch["zero"], batch["depth"])


def measure(setting: Scale, repeats: int) -> dict[str, Any]:
    """All measurements, as plain data."""
    machine = Machine()
    large = replace(setting, camera=replace(setting.camera, fpv_px=_LARGE_PX))
    inference = {
        name: measure_inference(of, rows, modalities, machine, turns)
        for name, of, rows, modalities, turns in (
            (f"{setting.name}, {setting.camera.fpv_px} px", setting, ROWS, MODALITIES, repeats),
            (f"{setting.name}, {_LARGE_PX} px", large, ROWS, MODALITIES, repeats),
            ("paper", scale("paper"), PAPER_ROWS, MODALITIES[:2], 1),
        )
    }
    calls = measure_calls(setting, machine, repeats)
    keep_freed_memory()  # as in training
    return {
        "scale": setting.name,
        "device": machine.device.type,
        "threads": torch.get_num_threads(),
        "repeats": repeats,
        "training": measure_training(setting, machine, repeats),
        "paper_step": measure_paper_step(machine, few(repeats)),
        "drawing": measure_drawing(machine, repeats),
        "throughput": measure_throughput(setting, machine, repeats),
        "inference": inference,
        "calls": calls,
        "views": projection.measure_views(machine, repeats),
        "onnx": projection.measure_onnx(machine, repeats),
        "sizes": measure_sizes(setting, machine, repeats),
        "memory_mb": measure_memory(setting),
        "generation": generation.measure(setting, repeats, seconds=1.0),  # last: it leaves torch with one thread
    }


def table(measured: dict[str, Any]) -> list[str]:
    """The figures of interest as lines of text: medians, with the range of the repeats in brackets."""
    training = measured["training"]
    lines = [f"scale {measured['scale']} on {measured['device']}: median [smallest, largest] of the repeats, ms"]
    lines += [f"generation, {line}" for line in generation.table(measured["generation"])[1:]]
    for what, found in ("training", training), ("paper's sizes", measured["paper_step"]):
        for name, ms in found["milliseconds"].items():
            lines.append(f"{f'{what}, {name}':<34}{ms['median']:>9.1f}  [{ms['low']:.1f}, {ms['high']:.1f}]")
            if name in found["share_of_peak"]:
                peak, roofline = (100 * found[key][name] for key in ("share_of_peak", "share_of_roofline"))
                lines[-1] += f"  {peak:5.1f} % of the peak, {roofline:5.1f} % of the roofline"
    for name, drawn in measured["drawing"].items():
        lines.append(f"{f'drawing at {name}, of a step':<34}{100 * drawn['share']:>9.1f} %")
    for row, found in measured["throughput"]["rows"].items():
        lines += [
            f"{f'step ({row}), {name}':<34}{ms['median']:>9.1f}  {ms['ratio']:.2f} x" for name, ms in found.items()
        ]
    for name, ms in measured["throughput"]["busy"].items():
        lines.append(f"{f'beside busy loops, {name}':<34}{ms['median']:>9.1f}  {ms['ratio']:.2f} x")
    for sizes, rows in measured["inference"].items():
        for row, precision in ((row, precision) for row, found in rows.items() for precision in found):
            found = rows[row][precision]
            ratios = ", ".join(f"{k}: {ms['ratio']:.2f}" for k, ms in found.items())
            lines.append(
                f"{f'inference ({row}), {sizes}':<34}{found['1']['median']:>9.1f}  {precision}, x for K {ratios}"
            )
    for k, found in measured["calls"].items():
        lines.append(f"{f'one call against {k} calls':<34}{found['ratio']:>9.2f} x")
    lines += projection.table(measured["views"], measured["onnx"])
    lines += [f"{name:<34}{one['ratio']:>9.2f} x" for name, one in measured["sizes"].items()]
    return lines + [f"memory, {name:<26}{peak:>9.0f} MB" for name, peak in measured["memory_mb"].items()]


def recorded_benchmark(workspace: Workspace) -> dict[str, Any]:
    """The measurements of a report, recorded in `benchmark.json`; made now if they are missing (some minutes)."""
    config = {"version": versions.BENCHMARK, "scale": workspace.scale.name}
    path = workspace.reports / "benchmark.json"
    return recorded(path, "benchmark", config, lambda: measure(workspace.scale, REPEATS), Machine().device.type)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev benchmark`."""
    parser.add_argument("--scale", default="reduced", help=f"one of {', '.join(SCALES)} (default: reduced)")
    parser.add_argument(
        "--repeats", type=int, default=REPEATS, help=f"the median of these is taken (default: {REPEATS})"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write everything measured to FILE")


def run(options: argparse.Namespace) -> None:
    """Measure, print the table, and write all measurements with `--json`."""
    measured = measure(scale(options.scale), options.repeats)
    for line in table(measured):
        print(line)
    if options.json:
        write_json(options.json, measured)
