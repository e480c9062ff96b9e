"""Forecast of the time, memory and disk of a reproduction on this machine.

Reads records and caches; prints the forecast. Views of one home and samples of two trainings are measured, in about a
minute, and multiplied. The figures are estimates for one process and one device: all networks count as row (c), and
figures of the report count nothing.
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

from zerobev.benchmarks.data import home_folder, synth_stream, view_rates
from zerobev.common.errors import InputError
from zerobev.config import SPLITS, Scale
from zerobev.data.generate import shard_path
from zerobev.data.samples import as_float, collate, semantic_sample
from zerobev.data.shards import Shard, write_shard
from zerobev.data.view_set import ViewSet
from zerobev.data.views import ViewSource
from zerobev.experiments.depth_pretraining import DepthPretraining
from zerobev.experiments.provenance import peak_memory_mb
from zerobev.experiments.registry import EXPERIMENTS
from zerobev.experiments.runs import SEEDS, Run
from zerobev.experiments.workspace import Workspace, add_workspace_arguments
from zerobev.models import build
from zerobev.models.depth import DepthNet
from zerobev.scenes.readers import read_scene
from zerobev.training.depth import DepthSamples, depth_objective
from zerobev.training.loader import Source, gpu_workers, model_inputs, moved
from zerobev.training.train import Objective, dice_objective, training_accelerator

_VIEWS = 4  # for training
_SECONDS = 4.0  # in which views are counted
_SAMPLES = {"cpu": 2, "cuda": 8}  # of a pass; fewer do not fill a GPU
_COPIES = 5  # of the weights: the weights, their gradient, Adam's two moments, the best weights


@dataclass(frozen=True)
class Network:
    """Cost of a network on this machine."""

    weight_bytes: int
    process_bytes: float  #: of the process before training
    sample_bytes: float  #: saved for the backward pass, per sample
    train_s: float  #: per sample: drawing, forward and backward pass
    test_s: float  #: per view in the test: forward pass

    def memory_bytes(self, batch: int) -> float:
        """Memory of a training: process, weights, optimiser, and tensors saved for the backward pass."""
        return self.process_bytes + _COPIES * self.weight_bytes + batch * self.sample_bytes


@dataclass(frozen=True)
class Forecast:
    """The work at a scale, and its cost."""

    scale: Scale
    homes: dict[str, int]  #: per split
    networks: int
    left: dict[str, int]  #: missing: homes without a shard, networks and estimators without a record
    there_bytes: int  #: existing views, depth and weights
    view_bytes: float  #: per view, compressed
    view_s: float  #: per view, on one core
    network: Network  #: of row (c)
    estimator: Network

    @property
    def views(self) -> int:
        """Number of views of all homes."""
        return sum(self.homes.values()) * self.scale.scenes.views

    @property
    def disk_bytes(self) -> dict[str, float]:
        """Disk of a finished reproduction: depth in float16, two files per network, one checkpoint."""
        depth = self.views * 2 * self.scale.camera.fpv_px**2
        weights = (2 * self.networks + _COPIES - 1) * self.network.weight_bytes
        return {"views": self.views * self.view_bytes, "depth": depth, "weights": weights}

    @property
    def needed_bytes(self) -> dict[str, float]:
        """Disk beyond the existing files, and memory of the largest training."""
        network, estimator = self.network, self.estimator
        memory = max(network.memory_bytes(self.scale.train.batch), estimator.memory_bytes(self.scale.depth.batch))
        return {"free disk": max(sum(self.disk_bytes.values()) - self.there_bytes, 0), "memory": memory}

    def hours(self, workers: int) -> dict[str, float]:
        """Hours of the missing work; `workers` draw the views."""
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
        """Raise `InputError` if disk or memory is too small."""
        for what, needed in self.needed_bytes.items():
            if needed > there[what]:
                raise InputError(f"scale {self.scale.name}: expected {_gb(needed)} of {what}, found {_gb(there[what])}")

    def table(self, there: Mapping[str, float], workers: int) -> str:
        """The forecast as text."""
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
    """Measure a view and two networks, and count the work."""
    scale, folders, depth = workspace.scale, workspace.split, DepthPretraining(workspace)
    homes, shards = {split: folders.of(split) for split in SPLITS}, workspace.views_folder
    missing = [home for split, of in homes.items() for home in of if not shard_path(home, shards / split).exists()]
    networks = [Run(experiment, workspace, SEEDS[0]) for experiment in EXPERIMENTS.values() if experiment.network]
    left = {
        "homes": len(missing),
        "networks": sum(run.recorded() is None for run in networks),
        "estimators": int(depth.recorded() is None),
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
    """Cost of a view and of two networks, fields of `Forecast`; `home` in HM3DSem layout, None: a generated home."""
    threads, samples = torch.get_num_threads(), _SAMPLES[training_accelerator().device.type]
    with tempfile.TemporaryDirectory() as scratch:
        folder, path = home or home_folder(Path(scratch), 0), Path(scratch) / "views.h5"
        set_up_s, rates = view_rates(folder, scale, 1, _SECONDS)
        torch.set_num_threads(threads)  # as in training; `view_rates` uses one
        scene = read_scene(folder)
        source = ViewSource(scene, scale.camera, scale.texture, np.random.default_rng(0))
        drawn = [source.draw() for _ in range(_VIEWS)]
        stored_s = _seconds(lambda: write_shard(path, scene, drawn, scale.camera, scale.texture, 0)) / _VIEWS
        views = ViewSet([Shard(path, scale.camera, scale.texture)])
        synth = synth_stream(views, scale, samples)
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
    saved = saved_bytes(lambda: objective(net, batch).total, net)
    _, passed_s = (_seconds(lambda: objective(net, batch).total.backward()) / samples for _ in range(2))
    # with a GPU, workers draw the next batches meanwhile
    train_s = max(drawn_s / gpu_workers(), passed_s) if device.type == "cuda" else drawn_s + passed_s
    net.eval()
    with torch.inference_mode():
        test_s = _seconds(lambda: net(*(image.to(device) for image in test)))
    return Network(weights, process, saved / samples, train_s, test_s)


def saved_bytes(forward: Callable[[], Tensor], net: nn.Module) -> int:
    """Memory that autograd saves for the backward pass, without the weights; shared storage counts once."""
    saved: dict[int, int] = {}

    def note(tensor: Tensor) -> Tensor:
        saved[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor.detach()  # not the tensor, which would keep the graph alive

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        _loss = forward()  # the reference keeps the saved tensors alive
    return sum(saved.values()) - sum(saved.get(p.untyped_storage().data_ptr(), 0) for p in net.parameters())


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
    add_workspace_arguments(parser)
    parser.add_argument("--textures", type=Path, metavar="DIR", help="texture images for the zero-shot stream")
    parser.add_argument(
        "--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help="values, such as train.steps=2400"
    )


def run(options: argparse.Namespace) -> None:
    """Print the forecast. Raises `InputError` if disk or memory of this machine is too small."""
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
