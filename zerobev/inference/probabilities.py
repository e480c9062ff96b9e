"""Real values in [0, 1]: probabilities, heat maps.

A network that was trained on binary textures has never seen a grey one. Real values therefore go through it as their
superlevel sets, and the projected value is the mean over levels t of "value above t" (the layer-cake formula). Taking
maxima commutes with thresholds, so that for P^-1 this is the projection of the values, up to the step of the levels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from zerobev.common.errors import InputError
from zerobev.inference.arrays import Channels, as_array, stacked
from zerobev.inference.bev_map import BevMap
from zerobev.inference.modality import BinaryImages, chosen_names

#: Superlevel sets that stand for an image of real values.
LEVELS = 8


@dataclass(frozen=True, eq=False)
class Probabilities:
    """K images of real values in [0, 1], of one photograph."""

    values: Any  #: (H, W), (K, H, W) or (H, W, K) floating point in [0, 1]
    names: Sequence[str] | None = None  #: K names; default: their numbers
    channels: Channels = None

    def layers(self, shape: tuple[int, int]) -> tuple[BinaryImages]:
        """`LEVELS` binary images per image; an `InputError` for another shape, type or range, and for NaN."""
        array = as_array(self.values, "modality")
        if array.dtype.kind != "f":
            raise InputError(f"modality: expected probabilities in floating point, found {array.dtype}")
        stack = stacked(array, shape, self.channels, "Probabilities")
        if not (np.isfinite(stack).all() and stack.min() >= 0 and stack.max() <= 1):
            found = "NaN or infinity" if not np.isfinite(stack).all() else f"{stack.min():g} to {stack.max():g}"
            raise InputError(f"modality: expected values in [0, 1], found {found}")
        thresholds = (np.arange(LEVELS) + 0.5) / LEVELS
        labels = chosen_names(range(len(stack)), self.names)
        return (BinaryImages(labels, (image > level for image in stack for level in thresholds), LEVELS),)

    def result(self, maps: tuple[BevMap, ...]) -> BevMap:
        """One map of projected values per image."""
        return maps[0]
