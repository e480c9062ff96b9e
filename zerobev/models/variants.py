"""All networks, by row of the paper's Tables 1 and 2 (or "f"), and by checkpoint."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig, ModelConfig
from zerobev.models.base import BevModel, description
from zerobev.models.depth import DepthNet
from zerobev.models.max_pooling import MaxPoolZeroBEV
from zerobev.models.tim import TIM
from zerobev.models.two_streams import TwoStreamZeroBEV
from zerobev.models.vpn import VPN
from zerobev.models.zero_bev import ZeroBEV

#: Row -> class, and changes of the row to the configuration of a scale.
VARIANTS: dict[str, tuple[type[BevModel], dict[str, Any]]] = {
    "b.1": (VPN, {"aux": ()}),
    "b.2": (TIM, {"aux": ()}),
    "b.3": (TIM, {"aux": (), "segmentation": True}),
    "-": (ZeroBEV, {"aux": ()}),
    "c": (ZeroBEV, {}),
    "c.I": (ZeroBEV, {"aux": ("obstacles",)}),
    "c.II": (ZeroBEV, {"aux": ("navigable",)}),
    "d": (ZeroBEV, {"residual": True}),
    "d.I": (ZeroBEV, {"aux": (), "residual": True}),
    "e": (TwoStreamZeroBEV, {}),
    "f": (MaxPoolZeroBEV, {}),
    "f.r": (MaxPoolZeroBEV, {"residual": True}),
}


def build(row: str, camera: CameraConfig, model: ModelConfig) -> BevModel:
    """The network of a row, with random weights from torch's generator. Raises `InputError` for an unknown row.

    The initial probability is `model.foreground_prior` in maps of a modality or class, and 1/2 in auxiliary maps. White
    is rare: from 1/2, the Dice loss of a rare class would have its minimum at all white for hundreds of steps.
    """
    if row not in VARIANTS:
        raise InputError(f"row: expected one of {', '.join(VARIANTS)}, found {row!r}")
    kind, changes = VARIANTS[row]
    network = kind(camera, replace(model, **changes))
    bias = network.get_parameter("decoder.head.bias")
    with torch.no_grad():
        bias[: len(bias) - len(network.config.aux)] += math.log(model.foreground_prior / (1 - model.foreground_prior))
    return network


def load_model(path: Path) -> BevModel:
    """The network saved in `path`, of any class. Raises `InputError` as `BevModel.load`."""
    networks: list[type[BevModel]] = [*(network for network, _ in VARIANTS.values()), DepthNet]
    classes = {network.__name__: network for network in networks}
    name = description(path)["class"]
    if name not in classes:
        raise InputError(f"{path}: expected a checkpoint of {', '.join(classes)}, found one of {name}")
    return classes[name].load(path)
