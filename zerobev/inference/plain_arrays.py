"""The kind of a plain array, by its type and values; ambiguous arrays are an error that lists the possible kinds."""

from typing import Any

import numpy as np

from zerobev.common.errors import InputError
from zerobev.inference.arrays import as_array
from zerobev.inference.labels import IGNORE, Labels
from zerobev.inference.masks import Masks
from zerobev.inference.modality import Names
from zerobev.inference.probabilities import Probabilities

_NEAR = 16  # most grey values of a JPEG mask are this close to black or white


def kind_of(value: Any, shape: tuple[int, int], names: Names = None) -> Masks | Labels | Probabilities:
    """The kind of a plain array for a photograph of `shape` (H, W).

    bool (H, W) or (K, H, W): `Masks`; integers (H, W): `Labels`; floating point (H, W) or (K, H, W): `Probabilities`
    Raises `InputError`, with the possible kinds, for
        - integers (H, W) of 0 and 1, or close to 0 and 255: a mask or labels, unless `names` has a name for each
        - integers (H, W) with 255 as the largest label: a label or "no label", unless decided by `names`
        - integers in three dimensions other than 0 and 1, or 0 and 255
        - (H, W, 2) floating point: flow or two probabilities; (H, W, 3) and (H, W, 4): also a colour image
    """
    array = as_array(value, "modality")
    kind = array.dtype.kind
    if kind not in "biuf":
        raise InputError(f"modality: expected an array of bool, integers or floating point, found {array.dtype}")
    if array.ndim == 3 and array.size and array.shape[:2] == tuple(shape) and array.shape[1:] != tuple(shape):
        _refuse_pixels(array)
    if kind == "b":
        return Masks(array, names)  # type: ignore[arg-type]  # names by number work, too
    if kind == "f":
        return Probabilities(array, names)  # type: ignore[arg-type]
    if array.ndim == 3 and array.size:
        if set(np.unique(array)) <= {0, 1} or set(np.unique(array)) <= {0, 255}:
            return Masks(array, names)  # type: ignore[arg-type]
        found = f"{array.dtype} {array.shape}; a stack of masks has to be bool, 0 and 1, or 0 and 255"
        raise InputError(f"modality: expected a label map (H, W), found {found}")
    return Labels(array, names, _ignored(array, names)) if array.size else Labels(array, names)


def _refuse_pixels(array: np.ndarray) -> None:
    """Raise `InputError` if the last axis may be flow or the channels of a colour image."""
    channels = array.shape[-1]
    if channels == 2 and array.dtype.kind == "f":
        found = f"{array.shape}: use Flow.of(array), or Probabilities(array, channels='last')"
        raise InputError(f"modality: expected one kind, found flow or probabilities in {found}")
    if channels in (3, 4):
        kind = "Probabilities" if array.dtype.kind == "f" else "Masks"
        found = f"{array.shape}: take one channel, or use {kind}(array, channels='last') for {channels} images"
        raise InputError(f"modality: expected one kind, found a colour image or {channels} images in {found}")


def _ignored(array: np.ndarray, names: Names) -> int | None:
    """Label for "no label" in a label map. Raises `InputError` if this is ambiguous, or if it may be a mask."""
    levels = np.unique(array)
    is_binary = levels[0] >= 0 and levels[-1] <= 1
    is_black_or_white = levels[-1] <= 255 and levels[-1] >= 255 - _NEAR and levels[0] >= 0
    is_black_or_white &= bool(np.mean((array <= _NEAR) | (array >= 255 - _NEAR)) > 0.9)
    if is_binary or (is_black_or_white and IGNORE not in levels) or set(levels) <= {0, IGNORE}:
        if _names_all(names, levels):
            return None
        found = f"integers from {levels[0]} to {levels[-1]}: use Masks(array), or Labels(array)"
        raise InputError(f"modality: expected one kind, found a mask or a label map in {found}")
    if IGNORE in levels and levels[-1] == IGNORE:
        if _names_all(names, levels):
            return None
        if names is not None:  # a value without a name is not a label
            return IGNORE
        found = f"{IGNORE}: use Labels(array, ignore={IGNORE}), or Labels(array) if it is an ordinary label"
        raise InputError(f"modality: expected labels, found one that often means no label, {found}; or Masks(array)")
    return None


def _names_all(names: Names, levels: np.ndarray) -> bool:
    """Whether every label has a name."""
    if names is None:
        return False
    try:
        return all(names[int(level)] is not None for level in levels if level >= 0)
    except (LookupError, TypeError):
        return False
