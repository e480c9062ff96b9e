"""Masks: one binary image per object."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from zerobev.common.errors import InputError
from zerobev.inference.arrays import Channels, as_array, stacked
from zerobev.inference.modality import BinaryImages, MapModality, chosen_names
from zerobev.inference.reader import Source, black_and_white, read_mask


@dataclass(frozen=True, eq=False)
class Masks(MapModality):
    """K masks of one photograph, with one map per mask."""

    #: (H, W), (K, H, W), (H, W, K) or a list of K images: bool, 0 and 1, or black and white (see `black_and_white`)
    values: Any
    names: Sequence[str] | None = None  #: K names; default: the numbers
    channels: Channels = None

    @classmethod
    def read(cls, *sources: Source, names: Sequence[str] | None = None) -> Self:
        """Masks from one image file each.

        names: default: the files' names without suffixes, if all sources are paths
        Raises `InputError` as `read_mask`, and for masks of different sizes.
        """
        if not sources:
            raise InputError("masks: expected an image file at least, found none")
        masks = [read_mask(source) for source in sources]
        paths = [Path(source) for source in sources if isinstance(source, str | Path)]
        for source, mask in zip(sources, masks):
            if mask.shape != masks[0].shape:
                name = source if isinstance(source, str | Path) else "mask"
                raise InputError(f"{name}: expected masks of one size, found {mask.shape} and {masks[0].shape}")
        if names is None and len(paths) == len(sources):
            names = [path.stem for path in paths]
        return cls(np.stack(masks), names, "first")

    def layers(self, shape: tuple[int, int]) -> tuple[BinaryImages]:
        """One binary image per mask. Raises `InputError` for another size or type, and for grey levels."""
        array = as_array(self.values, "modality")
        if array.dtype.kind not in "biuf":
            raise InputError(f"modality: expected an array of bool or of numbers, found {array.dtype}")
        images = stacked(array, shape, self.channels, "Masks")
        if array.ndim == 3 and self.channels is None and images is not array and len(images) in (3, 4):
            hint = "take one channel of a colour image, or pass channels='last' for as many masks"
            raise InputError(f"modality: expected (H, W) or (K, H, W), found {array.shape}: {hint}")
        labels = chosen_names(range(len(images)), self.names)
        return (BinaryImages(labels, [black_and_white(image, "modality") for image in images]),)
