"""Real values in [0, 1]: probabilities, heat maps.

Networks are trained on binary textures. Real values are therefore projected as superlevel sets, and the projected value
is the mean over levels t of "value above t" (the layer-cake formula). Maxima commute with thresholds, so for P^-1 this
is the projection of the values, up to the spacing of the levels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from zerobev.common.errors import InputError
from zerobev.inference.arrays import Channels, as_array, stacked
from zerobev.inference.modality import BinaryImages, MapModality, chosen_names

#: Superlevel sets per image of real values.
LEVELS = 8


@dataclass(frozen=True, eq=False)
class Probabilities(MapModality):
    """K images of real values in [0, 1] of one photograph, with one map of projected values per image."""

    values: Any  #: (H, W), (K, H, W) or (H, W, K) floating point in [0, 1]
    names: Sequence[str] | None = None  #: K names; default: the numbers
    channels: Channels = None

    def layers(self, shape: tuple[int, int]) -> tuple[BinaryImages]:
        """`LEVELS` binary images per image. Raises `InputError` for another shape, type or range, and for NaN."""
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
