"""Forecast of the time, memory and disk that a reproduction takes on this machine.

Reads what is recorded; writes nothing. Views of one home and samples of two trainings are measured, in about a minute;
the rest is multiplication. The figures are estimates for one process and one device: every network is assumed to cost
as much as that of row (c), and drawing the figures is left out.
"""

import argparse
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from zerobev.benchmarks.data import home_folder, noise_bank, view_rates
from zerobev.common.errors import InputError
from zerobev.config import SCALES, SPLITS, Scale
from zerobev.data.generate import shard_path
from zerobev.data.samples import SynthSamples, ViewSet, as_float, collate, semantic_sample
from zerobev.data.shards import Shard, write_shard
from zerobev.data.views import ViewSource
from zerobev.experiments.depth_pretraining import DepthPretraining
from zerobev.experiments.provenance import peak_memory_mb
from zerobev.experiments.registry import EXPERIMENTS
from zerobev.experiments.runs import SEEDS, Run
from zerobev.experiments.workspace import Workspace
from zerobev.models import build
from zerobev.models.depth import DepthNet
from zerobev.scenes.readers import read_scene
from zerobev.training.depth import DepthSamples, depth_objective
from zerobev.training.loader import Source, gpu_workers, model_inputs, moved
from zerobev.training.train import Objective, dice_objective, training_accelerator

_VIEWS, _SECONDS = 4, 4.0  # views that are stored and trained on; seconds in which they are counted
_SAMPLES = {"cpu": 2, "cuda": 8}  # of a pass; with fewer a GPU has little to do
_COPIES = 5  # of the weights: themselves, their gradient, Adam's two moments, the best so far


@dataclass(frozen=True)
class Network:
    """What a network takes of this machine."""

    weight_bytes: int
    process_bytes: float  #: of a process that does not train yet
    sample_bytes: float  #: kept for the backward pass, of each sample
    train_s: float  #: of a sample: drawing it, forward and backward pass
    test_s: float  #: forward pass of a view in the test

    def memory_bytes(self, batch: int) -> float:
        """Of a training: process, weights, optimiser, and what is kept for a backward pass."""
        return self.process_bytes + _COPIES * self.weight_bytes + batch * self.sample_bytes


@dataclass(frozen=True)
class Forecast:
    """What there is to do at a scale, and what it takes."""

    scale: Scale
    homes: dict[str, int]  #: by split
    networks: int
    left: dict[str, int]  #: homes, networks and estimators without a shard, a record, weights
    there_bytes: int  #: of views, depth and weights
    view_bytes: float  #: compressed
    view_s: float  #: of one core
    network: Network  #: of row (c)
    estimator: Network

    @property
    def views(self) -> int:
        """Of all homes."""
        return sum(self.homes.values()) * self.scale.scenes.views

    @property
    def disk_bytes(self) -> dict[str, float]:
        """Of a finished reproduction: estimated depth is float16, every network is kept twice, one has a checkpoint."""
        depth = self.views * 2 * self.scale.camera.fpv_px**2
        weights = (2 * self.networks + _COPIES - 1) * self.network.weight_bytes
        return {"views": self.views * self.view_bytes, "depth": depth, "weights": weights}

    @property
    def needed_bytes(self) -> dict[str, float]:
        """Of the disk, beside what is there, and for the training that takes the most memory."""
        network, estimator = self.network, self.estimator
        memory = max(network.memory_bytes(self.scale.train.batch), estimator.memory_bytes(self.scale.depth.batch))
        return {"free disk": max(sum(self.disk_bytes.values()) - self.there_bytes, 0), "memory": memory}

    def hours(self, workers: int) -> dict[str, float]:
        """Of what is left to do."""
        scale, left = self.scale, self.left
        trained, estimated = (config.steps * config.batch for config in (scale.train, scale.depth))
        tested = self.homes["test"] * (scale.test_views or scale.scenes.views)
        seconds = {
            "views": left["homes"] * scale.scenes.views * self.view_s / workers,
            "estimator": left["estimators"] * (estimated * self.estimator.train_s + self.views * self.estimator.test_s),
            "networks": left["networks"] * trained * self.network.train_s,
            "evaluation": left["networks"] * tested * self.network.test_s,
        }
        return {name: value / 3600 for name, value in seconds.items()}

    def check(self, there: Mapping[str, float]) -> None:
        """Raise `InputError` where there is less than needed of disk or memory."""
        for what, needed in self.needed_bytes.items():
            if needed > there[what]:
                raise InputError(f"scale {self.scale.name}: expected {_gb(needed)} of {what}, found {_gb(there[what])}")

    def table(self, there: Mapping[str, float], workers: int) -> str:
        """All of it, as text."""
        scale, needed, hours = self.scale, self.needed_bytes, self.hours(workers)
        rows = {
            "homes": ", ".join(f"{number} {part}" for part, number in self.homes.items()),
            "views": f"{self.views:,}; each {self.view_bytes / 1e6:.2f} MB and {self.view_s:.2f} s of a core",
            "networks": f"{self.networks}, of {scale.train.steps:,} steps of {scale.train.batch} samples",
            "estimator": f"{scale.depth.steps:,} steps of {scale.depth.batch} samples",
            "to do": ", ".join(f"{what}: {number}" for what, number in self.left.items()),
            "disk": ", ".join(f"{what} {_gb(size)}" for what, size in self.disk_bytes.items()),
            "needed": ", ".join(f"{_gb(size)} of {what}, of {_gb(there[what])}" for what, size in needed.items()),
            "hours": ", ".join(f"{what} {value:,.1f}" for what, value in hours.items()),
            "in all": f"{sum(hours.values()):,.1f} hours, {sum(hours.values()) / 24:,.1f} days",
        }
        return "\n".join([f"scale {scale.name}, estimated:", *(f"  {name:<10} {text}" for name, text in rows.items())])


def forecast(workspace: Workspace) -> Forecast:
    """Measure one of each, and count what there is to do."""
    scale, folders, depth = workspace.scale, workspace.split, DepthPretraining(workspace)
    homes, shards = {split: folders.of(split) for split in SPLITS}, workspace.views_folder
    missing = [home for split, of in homes.items() for home in of if not shard_path(home, shards / split).exists()]
    networks = [Run(experiment, workspace, SEEDS[0]) for experiment in EXPERIMENTS.values() if experiment.network]
    left = {
        "homes": len(missing),
        "networks": sum(run.recorded() is None for run in networks),
        "estimators": int(not depth.is_recorded),
    }
    there = [path for of in (shards, workspace.cache / depth.key, workspace.runs) for path in of.rglob("*")]
    return Forecast(
        scale=scale,
        homes={split: len(of) for split, of in homes.items()},
        networks=len(networks),
        left=left,
        there_bytes=sum(path.stat().st_size for path in there if path.is_file()),
        **measure(scale, folders.train[0] if workspace.source else None),
    )


def measure(scale: Scale, home: Path | None) -> dict[str, Any]:
    """What a view and two networks take, fields of a `Forecast`; of a home in HM3DSem layout, or of a generated one."""
    threads, samples = torch.get_num_threads(), _SAMPLES[training_accelerator().device.type]
    with tempfile.TemporaryDirectory() as scratch:
        folder, path = home or home_folder(Path(scratch), 0), Path(scratch) / "views.h5"
        set_up_s, rates = view_rates(folder, scale, 1, _SECONDS)
        torch.set_num_threads(threads)  # of the trainings; each worker that draws views has one
        scene = read_scene(folder)
        source = ViewSource(scene, scale.camera, scale.texture, np.random.default_rng(0))
        drawn = [source.draw() for _ in range(_VIEWS)]
        stored_s = _seconds(lambda: write_shard(path, scene, drawn, scale.camera, scale.texture, 0)) / _VIEWS
        views, bank = (
            ViewSet([Shard(path, scale.camera, scale.texture)]),
            noise_bank(scale, scale.texture.white_fraction),
        )
        synth = SynthSamples(
            views, bank, scale.camera, 0, samples, scale.empty_fraction, extruded_fraction=scale.extruded_fraction
        )
        depth, test = DepthSamples(views, 0, samples), as_float(collate([semantic_sample(views, 0, scale.camera)]))
        network, estimator = build("c", scale.camera, scale.model), DepthNet(scale.camera, scale.model)
        return {
            "view_bytes": path.stat().st_size / _VIEWS,
            "view_s": 1 / rates[0, 0] + stored_s + set_up_s / scale.scenes.views,
            "network": _network(network, dice_objective(scale.train.alpha), synth, samples, model_inputs(test)),
            "estimator": _network(estimator, depth_objective, depth, samples, [test["rgb"]]),
        }


def _network(net: nn.Module, objective: Objective, data: Source, samples: int, test: list[Tensor]) -> Network:
    accelerator, weights = training_accelerator(), sum(p.numel() * p.element_size() for p in net.parameters())
    device, net = accelerator.device, accelerator.prepare(net)
    batch = moved(data.batch(0, 0, 1), device)
    drawn_s = _seconds(lambda: data.batch(1, 0, 1)) / samples
    process = 2**20 * peak_memory_mb() if device.type == "cpu" else 0
    kept = saved_bytes(lambda: objective(net, batch).total, net)
    _, passed_s = (_seconds(lambda: objective(net, batch).total.backward()) / samples for _ in range(2))
    # beside a GPU, workers draw the batches to come
    train_s = max(drawn_s / gpu_workers(), passed_s) if device.type == "cuda" else drawn_s + passed_s
    net.eval()
    with torch.inference_mode():
        test_s = _seconds(lambda: net(*(image.to(device) for image in test)))
    return Network(weights, process, kept / samples, train_s, test_s)


def saved_bytes(forward: Callable[[], Tensor], net: nn.Module) -> int:
    """What autograd keeps of a forward pass for the backward one, beside the weights; storage that is shared once."""
    kept: dict[int, int] = {}

    def note(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor.detach()  # the tensor itself would keep the graph alive

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        _loss = forward()  # as long as it lives, what it keeps does
    return sum(kept.values()) - sum(kept.get(p.untyped_storage().data_ptr(), 0) for p in net.parameters())


def _seconds(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    run()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start


def _gb(size: float) -> str:
    return f"{size / 1e9:,.1f} GB"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev plan`."""
    parser.add_argument("--scale", default="reduced", help=f"one of {', '.join(SCALES)} (default: reduced)")
    parser.add_argument("--scenes", default="", metavar="DIR", help="HM3DSem scenes instead of generated homes")
    parser.add_argument("--textures", type=Path, metavar="DIR", help="texture images for the zero-shot stream")
    parser.add_argument(
        "--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help="values, such as train.steps=2400"
    )


def run(options: argparse.Namespace) -> None:
    """Print the forecast; an `InputError` if this machine has less disk or memory than needed."""
    if options.textures:
        os.environ["ZEROBEV_TEXTURES"] = str(options.textures.resolve())
    workspace = Workspace(options.scale, options.scenes, settings=options.set)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if torch.cuda.is_available():
        memory = torch.cuda.mem_get_info()[1]
    there = {"free disk": shutil.disk_usage(workspace.reports.parents[1]).free, "memory": memory}
    found = forecast(workspace)
    print(found.table(there, os.cpu_count() or 1))
    found.check(there)
