"""Checks of depth from a sensor."""

from typing import Any

import numpy as np

from zerobev.common.errors import InputError

MAX_MEDIAN_M = 200.0  #: larger median depths are probably in millimetres


def checked_depth(depth: Any, shape: tuple[int, int]) -> np.ndarray:
    """Depth of a sensor as (H, W) float32, metres; 0 for no value.

    depth: (H, W) floating point, metres; 0 or NaN for no value
    Raises `InputError` for another shape or type, for negative or infinite values, and for probable millimetres.
    """
    try:
        values = np.asarray(depth)
    except (TypeError, ValueError):
        raise InputError(f"depth: expected an array of the photograph's size {shape}, found {depth!r:.100}") from None
    if values.shape != shape:
        raise InputError(f"depth: expected the photograph's size {shape}, found {values.shape}")
    if not np.issubdtype(values.dtype, np.floating):
        hint = "; millimetres are divided by 1000." if np.issubdtype(values.dtype, np.integer) else ""
        raise InputError(f"depth: expected floating point, metres, found {values.dtype}{hint}")
    values = np.nan_to_num(values.astype(np.float32), nan=0.0, posinf=-1.0, neginf=-1.0)
    if (values < 0).any():
        raise InputError("depth: expected metres, or 0 or NaN for no value, found infinity or less than 0")
    known = values[values > 0]
    if len(known) and (median := float(np.median(known))) > MAX_MEDIAN_M:
        raise InputError(f"depth: expected metres, found a median of {median:g}: millimetres?")
    return values
