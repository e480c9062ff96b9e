"""Label maps: one number per pixel."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from zerobev.common.errors import InputError
from zerobev.inference.arrays import as_array
from zerobev.inference.modality import BinaryImages, MapModality, Names, chosen_names
from zerobev.inference.reader import Source, read_labels

_MAX_LABELS = 256  # arrays with more values are probably depth, or instance codes of a whole data set
#: Label of pixels without a class, in tools of VOC, Cityscapes and ADE20K.
IGNORE = 255


@dataclass(frozen=True, eq=False)
class Labels(MapModality):
    """A label map, with one map per label from 0 up; pixels with negative labels or `ignore` are left out."""

    values: Any  #: (H, W) integers
    names: Names = None  #: by label; default: the numbers
    ignore: int | None = None  #: label of pixels without a class, often `IGNORE`

    @classmethod
    def read(cls, source: Source, names: Names = None, ignore: int | None = None) -> Self:
        """A label map from an image file. Raises `InputError`, see `read_labels`."""
        return cls(read_labels(source), names, ignore)

    def layers(self, shape: tuple[int, int]) -> tuple[BinaryImages]:
        """One binary image per label. Raises `InputError` for another type or shape, and for no or too many labels."""
        array = as_array(self.values, "modality")
        if array.dtype.kind not in "biu" or array.shape != tuple(shape) or not array.size:
            expected = f"integers {tuple(shape)}"
            raise InputError(f"modality: expected {expected}, found {array.dtype} {array.shape}")
        present = [int(label) for label in np.unique(array) if label >= 0 and label != self.ignore]
        if not 1 <= len(present) <= _MAX_LABELS:
            raise InputError(f"modality: expected 1 to {_MAX_LABELS} labels from 0 up, found {len(present)}")
        return (BinaryImages(chosen_names(present, self.names), (array == label for label in present)),)
