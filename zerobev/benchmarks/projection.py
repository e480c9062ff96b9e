"""Latency of projection on one CPU thread; part of `zerobev benchmark`.

Networks have the sizes of the scale `deploy` and random weights. Photographs have the network's size, so that the time
of resampling does not count.
"""

import contextlib
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from zerobev.benchmarks.training import Machine, Run
from zerobev.config import Scale, scale
from zerobev.inference import Masks, Projector
from zerobev.inference.export import export_onnx
from zerobev.models import BevModel, build
from zerobev.models.base import ZeroShotModel
from zerobev.models.depth import DepthNet

SIZES = "deploy"  #: scale of the measured networks
ROWS = ("c", "d", "f", "f.r")
MODALITIES = (1, 8, 40)  #: masks per photograph
_PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """torch computes with one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def projector(row: str, setting: Scale) -> Projector:
    """A projector with random weights, on the CPU."""
    network = build(row, setting.camera, setting.model).eval()
    assert isinstance(network, ZeroShotModel)  # as all of `ROWS`
    return Projector(row, setting.camera, network, DepthNet(setting.camera, setting.model).eval())


def measure_views(machine: Machine, repeats: int) -> dict[str, Any]:
    """Milliseconds of K masks of a photograph, first and second, per row and precision.

    `first`: `project` with the photograph; `second`: `view.project`, for a photograph already seen. `ratio`: of the
    two; `per_second`: photographs with K masks, at the first's median.
    """
    setting, rng = scale(SIZES), np.random.default_rng(0)
    side = setting.camera.fpv_px
    rgb = rng.integers(0, 256, (side, side, 3), dtype=np.uint8)
    masks = {k: Masks(rng.random((k, side, side)) < 0.2, channels="first") for k in MODALITIES}
    measured: dict[str, Any] = {}
    with one_thread():
        for row in ROWS:
            runs: dict[tuple[str, int, str], Run] = {}
            for name, dtype in _PRECISIONS.items() if machine.bfloat16 else [("float32", torch.float32)]:
                model = projector(row, setting).to("cpu", dtype)
                view = model.view(rgb)
                for k, of in masks.items():
                    runs[name, k, "first"] = partial(model.project, rgb, of)
                    runs[name, k, "second"] = partial(view.project, of)
            found = machine.milliseconds(runs, repeats)
            measured[row] = {}
            for name, k in dict.fromkeys((name, k) for name, k, _ in runs):
                first, second = (found[name, k, which] for which in ("first", "second"))
                summary = {"ratio": second["median"] / first["median"], "per_second": 1e3 / first["median"]}
                measured[row].setdefault(name, {})[str(k)] = {"first": first, "second": second} | summary
    return measured


def measure_onnx(machine: Machine, repeats: int) -> dict[str, Any]:
    """Milliseconds of the network (c) for K masks of one photograph, by torch and by ONNX Runtime; `ratio`: to torch.

    Both in float32, without depth and without resampling.
    """
    setting = scale(SIZES)
    net = build("c", setting.camera, setting.model).eval()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    with tempfile.TemporaryDirectory() as folder:
        export_onnx(net, path := Path(folder) / "c.onnx")
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    runs: dict[tuple[str, int], Run] = {}
    for k in MODALITIES:
        side = setting.camera.fpv_px
        inputs = {"rgb": torch.rand(1, 3, side, side), "zero": torch.rand(1, k, side, side).round()}
        runs["torch", k] = partial(_call, net, inputs)
        runs["onnx", k] = partial(session.run, ["logits"], {name: tensor.numpy() for name, tensor in inputs.items()})
    with one_thread():
        found = machine.milliseconds(runs, repeats)
    return {
        str(k): {how: found[how, k] for how in ("torch", "onnx")}
        | {"ratio": found["onnx", k]["median"] / found["torch", k]["median"]}
        for k in MODALITIES
    }


@torch.inference_mode()
def _call(net: BevModel, inputs: dict[str, Tensor]) -> None:
    net(**inputs)


def table(views: dict[str, Any], onnx: dict[str, Any]) -> list[str]:
    """The figures of interest as lines of text."""
    lines = []
    for row, precisions in views.items():
        for name, found in precisions.items():
            ratios = ", ".join(f"{k}: {one['ratio']:.2f}" for k, one in found.items())
            rates = ", ".join(f"{k}: {one['per_second']:.1f}" for k, one in found.items())
            first = found["1"]["first"]["median"]
            lines.append(f"{f'one thread ({row}), {name}':<34}{first:>9.1f}  second/first {ratios}; per s {rates}")
    ratios = ", ".join(f"{k}: {one['ratio']:.2f}" for k, one in onnx.items())
    return [*lines, f"{'one thread (c), ONNX':<34}{onnx['1']['onnx']['median']:>9.1f}  x of torch for K {ratios}"]
