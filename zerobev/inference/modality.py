"""The interface of a modality, and its parts: binary images.

A new kind is one class with the two methods of `Modality`, and a line in `zerobev.inference.__init__`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from zerobev.common.errors import InputError
from zerobev.inference.bev_map import BevArrows, BevMap

Names = Mapping[int, str] | Sequence[str] | None
Result = TypeVar("Result", BevMap, BevArrows, covariant=True)


@dataclass(frozen=True, eq=False)
class BinaryImages:
    """K modalities, each as `levels` binary images of a photograph's size."""

    labels: tuple[str, ...]  #: K names
    images: Iterable[np.ndarray]  #: K * levels (H, W) bool, level fastest; may be a generator
    levels: int = 1
    scores: np.ndarray | None = None  #: (K,) float64, of detections
    photograph: np.ndarray | None = None  #: (H, W, 3) of these images; None: the argument of `project`


@runtime_checkable
class Modality(Protocol[Result]):
    """First-person data of a photograph, to be projected as binary images."""

    def layers(self, shape: tuple[int, int]) -> tuple[BinaryImages, ...]:
        """Sets of binary images for a photograph of `shape` (H, W); each set is projected to one `BevMap`.

        Raises `InputError` if the modality does not fit this shape, or is empty.
        """

    def result(self, maps: tuple[BevMap, ...]) -> Result:
        """The result of `project`, from one map per set of `layers`."""


class MapModality:
    """Base of modalities with one set of binary images; the result is their `BevMap`."""

    def result(self, maps: tuple[BevMap, ...]) -> BevMap:
        """The only map."""
        return maps[0]


def chosen_names(numbers: Iterable[int], names: Names) -> tuple[str, ...]:
    """The names of the given numbers, by default the numbers. Raises `InputError` if one is missing."""
    if names is None:
        return tuple(map(str, numbers))
    try:
        return tuple(str(names[number]) for number in numbers)
    except (LookupError, TypeError) as error:
        raise InputError(f"names: expected one for every mask or label, found none: {error!r}") from None
