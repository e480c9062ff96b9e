"""Every network by the letter of its row in the paper's Tables 1 and 2, or (f), and by its checkpoint."""

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

#: row -> class, and what the row changes in the configuration of a scale
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
    """The network of a row, with random weights from torch's generator; an unknown row is an `InputError`.

    Maps of a modality or a class start from `model.foreground_prior`, auxiliary maps from one half. White is rare: if a
    map starts half white, the Dice loss of a rare class has its minimum at all white for hundreds of steps.
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
    """The network saved in `path`, whatever its class; as `BevModel.load`, which names what is wrong with a file."""
    networks: list[type[BevModel]] = [*(network for network, _ in VARIANTS.values()), DepthNet]
    classes = {network.__name__: network for network in networks}
    name = description(path)["class"]
    if name not in classes:
        raise InputError(f"{path}: expected a checkpoint of {', '.join(classes)}, found one of {name}")
    return classes[name].load(path)
