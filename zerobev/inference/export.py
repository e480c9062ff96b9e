"""Write a network as an ONNX file, for programs without torch.

Reads weights as `zerobev project` does; writes one ONNX file in float32, whose outputs it compares with torch's. The
metadata `camera` contains the camera and the map as JSON. The numbers of photographs B and of images K are free.

    zero-shot network: rgb (B, 3, S, S) in [0, 1], zero (B, K, S, S) of 0 and 1 -> logits (B, K, M, M)
    residual network:  also depth (B, 1, S, S), metres, and height_m (B,) of the cameras; with `ModelConfig.measured`
                       depth (B, 2, S, S), whose second channel is 1 where a sensor measured, else 0
    depth estimator:   rgb (B, 3, S, S) -> depth (B, 1, S, S), metres; with `own_rays` also height_m (B,)

All are float32, and images are those of the level camera of the metadata. A residual network's depth is that of the
estimator's file (`--row depth`), or of a sensor. The map's value is the sigmoid of the logit.
"""

import argparse
import copy
import io
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor, nn

from zerobev.common.errors import InputError, first_line
from zerobev.common.storage import replacing
from zerobev.inference.placement import placement
from zerobev.inference.pretrained import load_parts
from zerobev.inference.shipped_weights import DEPTH, ROWS, shipped
from zerobev.models import load_model
from zerobev.models.base import BevModel, ZeroShotModel
from zerobev.models.depth import DepthNet

#: Maximum difference between outputs of a file and of torch, relative to the larger of 1 and torch's.
TOLERANCE = 1e-4


class _Logits(nn.Module):
    """A zero-shot network whose only output is its logits."""

    def __init__(self, network: ZeroShotModel):
        super().__init__()
        self.network = network

    def forward(self, rgb: Tensor, zero: Tensor, depth: Tensor | None = None, height_m: Tensor | None = None) -> Tensor:
        return self.network.decode(self.network.encode(rgb, depth, height_m), zero).zero_logits


def export_onnx(network: BevModel, path: str | Path) -> None:
    """Write a zero-shot network or a `DepthNet` as an ONNX file.

    Raises `InputError` for another module, for weights that are not float32, for operations that ONNX cannot hold, and
    if the file's outputs differ from torch's by more than `TOLERANCE`.
    """
    if not isinstance(network, ZeroShotModel | DepthNet):
        found = type(network).__name__
        raise InputError(f"network: expected a zero-shot network or the package's DepthNet, found {found}")
    if placement(network) != (torch.device("cpu"), torch.float32):
        found = " ".join(map(str, placement(network)))
        raise InputError(f"network: expected float32 on the CPU, found {found}")
    network = copy.deepcopy(network)
    graph = (network if isinstance(network, DepthNet) else _Logits(network)).eval()
    output = "depth" if isinstance(network, DepthNet) else "logits"
    example = _example(network, batch=2, images=3)
    dynamic = {name: {0: "batch"} | ({1: "images"} if name == "zero" else {}) for name in example}
    try:
        with _quiet():
            program = torch.onnx.export(
                graph,
                kwargs=example,
                input_names=list(example),
                output_names=[output],
                dynamic_shapes=dynamic,
                dynamo=True,
                verbose=False,
            )
    except torch.onnx.OnnxExporterError as error:
        found = f"{type(network).__name__} with other ones: {first_line(error)}"
        raise InputError(f"network: expected operations that ONNX has, found {found}") from error
    assert program is not None  # as with `dynamo`
    program.model.metadata_props["camera"] = json.dumps(asdict(network.camera))
    with replacing(Path(path)) as temporary:
        program.save(temporary)
        _compare(graph, temporary, [example, _example(network, batch=1, images=1)], output)


def _example(network: BevModel, batch: int, images: int) -> dict[str, Tensor]:
    """Random inputs of a network."""
    generator, side = torch.Generator().manual_seed(0), network.camera.fpv_px
    inputs = {"rgb": torch.rand(batch, 3, side, side, generator=generator)}
    if isinstance(network, ZeroShotModel):
        inputs["zero"] = torch.rand(batch, images, side, side, generator=generator).round()
        if network.config.residual:
            shape = batch, 1 + network.config.measured, side, side
            inputs["depth"] = network.camera.bev_extent_m * torch.rand(shape, generator=generator)
            if network.config.measured:
                inputs["depth"][:, 1] = inputs["depth"][:, 1] > network.camera.bev_extent_m / 2
    if network.config.own_rays if isinstance(network, DepthNet) else network.config.residual:
        inputs["height_m"] = network.camera.height_m * (1 + torch.rand(batch, generator=generator))
    return inputs


def _compare(graph: nn.Module, path: Path, examples: list[dict[str, Tensor]], output: str) -> None:
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    for example in examples:
        with torch.inference_mode():
            expected = graph(**example).numpy()
        (found,) = session.run([output], {name: tensor.numpy() for name, tensor in example.items()})
        difference = float((np.abs(found - expected) / np.maximum(np.abs(expected), 1)).max())
        if not difference <= TOLERANCE:
            raise InputError(f"{output}: expected torch's up to {TOLERANCE:g}, found a difference of {difference:g}")


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's notes on packages and optimisations that are not needed here."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels):
            logger.setLevel(level)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev export`."""
    parser.add_argument("--format", choices=["onnx"], default="onnx", help="default: onnx")
    rows = f"{', '.join(ROWS)}, their names, {DEPTH} for the depth estimator, or your checkpoint or folder"
    parser.add_argument("--row", default=ROWS[-1], help=f"{rows} (default: {ROWS[-1]})")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.onnx")


def run(options: argparse.Namespace) -> None:
    """Write the file and print its name and size. Raises `InputError`."""
    export_onnx(_network(options.row), options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.1f} MB")


def _network(row: str) -> BevModel:
    """The network of a row, or a depth estimator by its name or checkpoint."""
    if row == DEPTH:
        return DepthNet.load(shipped(DEPTH))
    if Path(row).is_file():
        return load_model(Path(row))
    network = load_parts(row, None).network
    if network is None:
        raise InputError(f"--row: expected a network, found P^-1 ({row}): it has no weights; export {DEPTH} alone")
    return network
