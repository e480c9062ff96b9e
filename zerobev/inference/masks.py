"""Masks: one binary image per thing."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from zerobev.common.errors import InputError
from zerobev.inference.arrays import Channels, as_array, stacked
from zerobev.inference.bev_map import BevMap
from zerobev.inference.modality import BinaryImages, chosen_names
from zerobev.inference.reader import Source, black_and_white, read_mask


@dataclass(frozen=True, eq=False)
class Masks:
    """K masks of one photograph, as arrays."""

    #: (H, W), (K, H, W) or (H, W, K): bool, 0 and 1, or black and white of uint8 or uint16 (see `black_and_white`);
    #: also a list of K images
    values: Any
    names: Sequence[str] | None = None  #: K names; default: their numbers
    channels: Channels = None

    @classmethod
    def read(cls, *sources: Source, names: Sequence[str] | None = None) -> Self:
        """Masks from one image file each; named by their files. Raises `InputError`, see `read_mask`."""
        if not sources:
            raise InputError("masks: expected an image file at least, found none")
        masks = [read_mask(source) for source in sources]
        for source, mask in zip(sources, masks):
            if mask.shape != masks[0].shape:
                found = f"{mask.shape} beside {masks[0].shape}"
                raise InputError(f"{_name(source)}: expected masks of one size, found {found}")
        if names is None and all(isinstance(source, str | Path) for source in sources):
            names = [_name(source) for source in sources]
        return cls(np.stack(masks), names, "first")

    def layers(self, shape: tuple[int, int]) -> tuple[BinaryImages]:
        """One binary image per mask; an `InputError` for another size or type, and for grey levels."""
        array = as_array(self.values, "modality")
        if array.dtype.kind not in "biuf":
            raise InputError(f"modality: expected an array of bool or of numbers, found {array.dtype}")
        images = stacked(array, shape, self.channels, "Masks")
        if array.ndim == 3 and self.channels is None and images is not array and len(images) in (3, 4):
            hint = "take one channel of a colour image, or say channels='last' for as many masks"
            raise InputError(f"modality: expected (H, W) or (K, H, W), found {array.shape}: {hint}")
        labels = chosen_names(range(len(images)), self.names)
        return (BinaryImages(labels, [black_and_white(image, "modality") for image in images]),)

    def result(self, maps: tuple[BevMap, ...]) -> BevMap:
        """One map per mask."""
        return maps[0]


def _name(source: Source) -> str:
    return Path(source).stem if isinstance(source, str | Path) else "mask"
