"""Label maps: one number per pixel, and one map per label."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from zerobev.common.errors import InputError
from zerobev.inference.arrays import as_array
from zerobev.inference.bev_map import BevMap
from zerobev.inference.modality import BinaryImages, Names, chosen_names
from zerobev.inference.reader import Source, read_labels

#: A label map with more labels is taken for something else: depth, or instance codes of a whole data set.
MAX_LABELS = 256
#: The label that tools of VOC, Cityscapes and ADE20K give to pixels without one.
IGNORE = 255


@dataclass(frozen=True, eq=False)
class Labels:
    """A label map. Every label from 0 up becomes one map; negative ones and `ignore` become none."""

    values: Any  #: (H, W) integers
    names: Names = None  #: by label; default: their numbers
    ignore: int | None = None  #: the label of pixels without one, often `IGNORE`

    @classmethod
    def read(cls, source: Source, names: Names = None, ignore: int | None = None) -> Self:
        """A label map from an image file. Raises `InputError`, see `read_labels`."""
        return cls(read_labels(source), names, ignore)

    def layers(self, shape: tuple[int, int]) -> tuple[BinaryImages]:
        """One binary image per label; an `InputError` for another type or shape, and for no or too many labels."""
        array = as_array(self.values, "modality")
        if array.dtype.kind not in "biu" or array.shape != tuple(shape) or not array.size:
            expected = f"integers {tuple(shape)}"
            raise InputError(f"modality: expected {expected}, found {array.dtype} {array.shape}")
        present = [int(label) for label in np.unique(array) if label >= 0 and label != self.ignore]
        if not 1 <= len(present) <= MAX_LABELS:
            raise InputError(f"modality: expected 1 to {MAX_LABELS} labels from 0 up, found {len(present)}")
        return (BinaryImages(chosen_names(present, self.names), (array == label for label in present)),)

    def result(self, maps: tuple[BevMap, ...]) -> BevMap:
        """One map per label."""
        return maps[0]
