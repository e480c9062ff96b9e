"""Every network by the letter of its row in the paper's Tables 1 and 2, or (f), and by its checkpoint."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from zerobev.config import CameraConfig, ModelConfig
from zerobev.errors import InputError
from zerobev.models.checkpoint import BevModel, description
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
    """The network of a row, with random weights from torch's generator; an unknown row is an `InputError`."""
    if row not in VARIANTS:
        raise InputError(f"row: expected one of {', '.join(VARIANTS)}, found {row!r}")
    network, changes = VARIANTS[row]
    return network(camera, replace(model, **changes))


def load_model(path: Path) -> BevModel:
    """The network saved in `path`, whatever its class; as `BevModel.load`, which names what is wrong with a file."""
    classes = {network.__name__: network for network in (*(network for network, _ in VARIANTS.values()), DepthNet)}
    name = description(path)["class"]
    if name not in classes:
        raise InputError(f"{path}: expected a checkpoint of {', '.join(classes)}, found one of {name}")
    return classes[name].load(path)
