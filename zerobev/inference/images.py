"""Masks, label maps and real values -> the binary images that a zero-shot network knows.

A network that was trained on binary textures has never seen a grey one. Real values therefore go through it as their
superlevel sets, and the projected value is the mean over levels t of "value above t" (the layer-cake formula). Taking
maxima commutes with thresholds, so that for P^-1 this is the projection of the values, up to the step of the levels.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from zerobev.common.errors import InputError

#: Superlevel sets that stand for an image of real values.
LEVELS = 8
#: A label map with more labels is taken for something else: depth, or instance codes of a whole data set.
MOST_LABELS = 256

Names = Mapping[int, str] | Sequence[str] | None


@dataclass(frozen=True, eq=False)
class BinaryImages:
    """K modalities, each as `levels` binary images of a photograph's size."""

    labels: tuple[str, ...]  #: K names
    images: Iterable[np.ndarray]  #: K * levels (H, W) bool, level fastest; may be made one at a time
    levels: int = 1
    scores: np.ndarray | None = None  #: (K,) float64, of modalities that have one


def binary_images(array: np.ndarray, shape: tuple[int, int], names: Names = None) -> BinaryImages:
    """Binary images of an array, whose meaning follows from its type.

    array: bool (H, W) or (K, H, W): masks; integers (H, W): a label map, of which every label from 0 up is one
        modality (negative: nothing); floating point (H, W) or (K, H, W): values in [0, 1]
    shape: (H, W) of the photograph
    names: of the K masks or images of values, in order; of labels: by label. Default: their numbers.
    Raises `InputError` for another type, shape or range, for NaN, and where there is no image at all.
    """
    kind = array.dtype.kind
    if kind not in "biuf":
        raise InputError(f"modality: expected an array of bool, integers or floating point, found {array.dtype}")
    dimensions = (2,) if kind in "iu" else (2, 3)
    if array.ndim not in dimensions or array.shape[-2:] != tuple(shape) or not array.size:
        expected = " or ".join(str((*(("K",) * (n - 2)), *shape)).replace("'", "") for n in dimensions)
        hint = "; a stack of masks has to be bool" if kind in "iu" and array.ndim == 3 else ""
        raise InputError(f"modality: expected {expected} of {array.dtype}, found {array.shape}{hint}")
    if kind in "iu":
        return _of_labels(array, names)
    stack = array.reshape(-1, *shape)
    labels = _names(range(len(stack)), names)
    if kind == "b":
        return BinaryImages(labels, stack)
    if not (np.isfinite(stack).all() and stack.min() >= 0 and stack.max() <= 1):
        found = "NaN or infinity" if not np.isfinite(stack).all() else f"{stack.min():g} to {stack.max():g}"
        raise InputError(f"modality: expected values in [0, 1], found {found}")
    thresholds = (np.arange(LEVELS) + 0.5) / LEVELS
    return BinaryImages(labels, (image > level for image in stack for level in thresholds), LEVELS)


def _of_labels(array: np.ndarray, names: Names) -> BinaryImages:
    present = [int(label) for label in np.unique(array) if label >= 0]
    if not 1 <= len(present) <= MOST_LABELS:
        raise InputError(f"modality: expected 1 to {MOST_LABELS} labels from 0 up, found {len(present)}")
    return BinaryImages(_names(present, names), (array == label for label in present))


def _names(numbers: Iterable[int], names: Names) -> tuple[str, ...]:
    if names is None:
        return tuple(map(str, numbers))
    try:
        return tuple(str(names[number]) for number in numbers)
    except (LookupError, TypeError) as error:
        raise InputError(f"names: expected one for every mask or label, found none: {error!r}") from None
