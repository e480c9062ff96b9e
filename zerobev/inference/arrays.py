"""Arrays in common formats -> checked NumPy arrays: photographs, and stacks with channels first or last."""

from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from zerobev.common.errors import InputError
from zerobev.inference.reader import MAX_MEGAPIXELS, is_source, read_image

#: Axis of the K images in a stack: (K, H, W) or (H, W, K); None: by the photograph's size.
Channels = Literal["first", "last"] | None


def checked_image(rgb: Any) -> np.ndarray:
    """A photograph -> (H, W, 3) float32 in [0, 1].

    rgb: (H, W, 3) uint8, or floating point in [0, 1]; or a source of `zerobev.inference.reader`
    Raises `InputError` for anything else.
    """
    array = read_image(rgb) if is_source(rgb) else as_array(rgb, "rgb")
    if array.ndim != 3 or array.shape[-1] != 3 or not array.size:
        hint = ""
        if array.ndim == 3 and array.shape[0] == 3:
            hint = ": move the channels last"
        elif array.ndim == 3 and array.shape[-1] == 4:
            hint = ": remove alpha"
        raise InputError(f"rgb: expected (H, W, 3), found {array.shape}{hint}")
    if array.shape[0] * array.shape[1] > MAX_MEGAPIXELS * 1_000_000:
        found = f"{array.shape[0] * array.shape[1] / 1e6:.0f}: scale photograph and modality down equally"
        raise InputError(f"rgb: expected at most {MAX_MEGAPIXELS} megapixels, found {found}")
    if array.dtype == np.uint8:
        return array.astype(np.float32) / 255
    if array.dtype.kind != "f":
        raise InputError(f"rgb: expected uint8 or floating point, found {array.dtype}")
    if not np.isfinite(array).all():
        raise InputError("rgb: expected values in [0, 1], found NaN or infinity")
    if array.min() < 0 or array.max() > 1:
        raise InputError(f"rgb: expected values in [0, 1], found {array.min():g} to {array.max():g}")
    return array.astype(np.float32)


def as_array(value: Any, name: str) -> np.ndarray:
    """A NumPy array from an array, a torch tensor on any device, or nested lists of numbers.

    Raises `InputError` for anything else, including image files, and for masked arrays with masked values.
    """
    if is_source(value) or (isinstance(value, list | tuple) and any(map(is_source, value))):
        raise InputError(f"{name}: expected an array, found an image file: use Masks.read(...) or Labels.read(...)")
    if np.ma.is_masked(value):
        raise InputError(f"{name}: expected an array, found one with masked values: fill them")
    try:
        if isinstance(value, list | tuple) and any(isinstance(entry, Tensor) for entry in value):
            return np.stack([_of_tensor(entry) for entry in value])
        return _of_tensor(value)
    except (ValueError, TypeError, RuntimeError, OverflowError):
        raise InputError(f"{name}: expected an array, found {type(value).__name__} that cannot be converted") from None


def _of_tensor(value: Any) -> np.ndarray:
    if not isinstance(value, Tensor):
        return np.asarray(value)
    value = value.detach().cpu()
    return (value.float() if value.dtype == torch.bfloat16 else value).numpy()


def stacked(array: np.ndarray, shape: tuple[int, int], channels: Channels, name: str) -> np.ndarray:
    """(H, W), (K, H, W) or (H, W, K) -> (K, H, W).

    shape: (H, W) of the photograph
    Raises `InputError` for another shape, and if `channels` is None and both orders fit.
    """
    height, width = shape
    if array.size and array.shape == (height, width):
        return array[None]
    first = array.ndim == 3 and array.shape[1:] == (height, width)
    last = array.ndim == 3 and array.shape[:2] == (height, width)
    if first and last and channels is None and len(array) > 1:
        found = f"{array.shape}: pass channels='first' or channels='last', as in {name}(array, channels='first')"
        raise InputError(f"modality: expected channels first or last, found both in {found}")
    if array.size and ((first and channels != "last") or (last and channels != "first")):
        return array if first and channels != "last" else np.moveaxis(array, -1, 0)
    expected = f"({height}, {width}) or (K, {height}, {width})"
    expected = f"({height}, {width}, K)" if channels == "last" else expected
    hint = ""
    if array.ndim in (2, 3) and array.shape[-2:] == (width, height):
        hint = ": rows and columns are swapped, or only the photograph was turned by its EXIF orientation"
    elif array.ndim == 2 and array.size and abs(array.shape[1] * height - array.shape[0] * width) < sum(array.shape):
        hint = ": resize it to the photograph, by nearest neighbour"
    raise InputError(f"modality: expected {expected} of {array.dtype}, found {array.shape}{hint}")
