"""Measure the cost of data, of a training step and of inference.

Reads homes and views (made first if they are missing); prints a table and writes all measurements with `--json`.
Settings are interleaved, so that machine noise hits all alike, and reported with their spread. Milliseconds depend on
machine and time; ratios carry over: to the machine's peak of matrix products, and between settings.
"""

import argparse
import itertools
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from zerobev.benchmarks import data as generation
from zerobev.benchmarks.training import Machine, Run, measure_paper_step, measure_training, training_step
from zerobev.common.storage import write_json
from zerobev.config import SCALES, Scale, scale
from zerobev.data.samples import SynthSamples
from zerobev.experiments import versions
from zerobev.experiments.provenance import peak_memory_mb
from zerobev.experiments.records import recorded
from zerobev.experiments.workspace import Workspace
from zerobev.models import BevModel, build

MODALITIES = (1, 8, 40)  #: zero-shot images per RGB image
ROWS = ("c", "e", "f")  #: of which inference is measured
REPEATS = 9  #: of the recorded benchmark
_SIZES = (0.5, 1.0, 2.0)  # of images and of maps, relative to the scale's
_SCENES = (1, 4)


def measure_inference(setting: Scale, machine: Machine, repeats: int) -> dict[str, Any]:
    """Milliseconds of the networks `ROWS` for K zero-shot images of one RGB image, in one call and in K calls."""
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
        runs[f"scenes {scenes}"] = partial(_next_batch, stream, itertools.count())
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


def _one_by_one(net: BevModel, rgb: Tensor, images: Tensor) -> None:
    for image in images.split(1, dim=1):
        net(rgb, image)


def _next_batch(stream: SynthSamples, steps: Iterator[int]) -> None:
    stream.batch(next(steps))


def measure(setting: Scale, repeats: int) -> dict[str, Any]:
    """All measurements, as plain data."""
    machine = Machine()
    training = measure_training(setting, machine, repeats)
    paper = measure_paper_step(machine, max(repeats // 3, 1))
    inference = measure_inference(setting, machine, repeats)
    return {
        "scale": setting.name,
        "device": machine.device.type,
        "threads": torch.get_num_threads(),
        "repeats": repeats,
        "k8_over_k1": inference["c"]["k8_over_k1"],
        "generation": generation.measure(setting, repeats, seconds=1.0),
        "training": training,
        "paper_step": paper,
        "inference": inference,
        "sizes": measure_sizes(setting, machine, repeats),
        "memory_mb": measure_memory(setting),
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
    for workers, waiting in training["waiting_share"].items():
        lines.append(f"{f'waiting for data, workers: {workers}':<34}{100 * waiting['share']:>9.1f} %")
    for row, found in measured["inference"].items():
        ratios = ", ".join(f"{k}: {ratio:.2f}" for k, ratio in found["shared_over_separate"].items())
        lines.append(f"inference ({row}): 8 images take {found['k8_over_k1']:.2f} x one; one call / K calls {ratios}")
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
