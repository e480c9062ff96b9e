"""Zero-BEV: zero-shot projection of any first-person modality to a bird's-eye-view map.

`zerobev.load().project(rgb, modality)` covers most uses, see `zerobev.inference`; `zerobev.HomeMap` fuses the maps of a
walk; `zerobev.playground()` shows the map of a mask that is painted in JupyterLab.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

# OpenMP reads this when torch is loaded. By default its threads spin while they wait, which makes a training step more
# than ten times as slow beside two other busy processes on two cores.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from zerobev.inference import BevArrows, BevMap, Boxes, Camera, Flow, Labels, Masks, Probabilities, Projector, load
    from zerobev.interactive import playground
    from zerobev.mapping import HomeMap, Pose2D

__version__ = "0.2.0.dev0"

__all__ = [
    "BevArrows",
    "BevMap",
    "Boxes",
    "Camera",
    "Flow",
    "HomeMap",
    "Labels",
    "Masks",
    "Pose2D",
    "Probabilities",
    "Projector",
    "load",
    "playground",
]

# the room of each name that is not of `inference`
_ROOMS = {"HomeMap": "mapping", "Pose2D": "mapping", "playground": "interactive"}


def __getattr__(name: str) -> Any:
    # imported on first use: most commands need no network
    if name in __all__:
        return getattr(import_module(f"zerobev.{_ROOMS.get(name, 'inference')}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
