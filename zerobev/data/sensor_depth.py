"""Depth as a depth camera would measure it: limited range, noise, steps, holes and misalignment; and its completion."""

import numpy as np

#: Range of values, metres.
NEAR_M, FAR_M = 0.3, 6.0
# A stereo or structured-light camera measures 1 / z: noise and step in 1 / metres give errors that grow with z^2
_NOISE, _STEP = 0.0015, 0.0025
_EDGE = 0.08  # relative step of depth to a neighbour at which a value is lost
_LOST_AT_EDGES = 0.5  # fraction of values lost there
_BLACK, _BRIGHT = 0.06, 0.97  # brightness below and above which a surface gives no value (black, or glass)
_LOST_IF_DARK = 0.7  # fraction of values lost at such surfaces
_HOLES = 3  # mean number of further holes per image
_MIN_KNOWN = 64  # pixels with a value from which the scale of an estimate is taken
# powers of an estimate's relative error: the estimator has seen the views of the training, and its errors in other
# views are about 1.4 times as large
_POWERS = (1.0, 1.6)
# fractions of training samples: most users have no depth camera, and estimated depth is the hardest to use
_KINDS = {"true": 0.1, "estimated": 0.5, "none": 0.1, "completed": 0.2, "measured": 0.1}


def sensor_depth(depth: np.ndarray, rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A measurement of true depth.

    depth: (H, W) planar depth, metres, 0 for no surface
    rgb: (H, W, 3) uint8 photograph
    Returns (H, W) float32, metres, 0 for no value.
    """
    side = depth.shape
    # the photograph and the depth image are a pixel apart at most
    top, left = rng.integers(0, 3, 2)
    measured = np.pad(depth.astype(np.float64), 1)[top : top + side[0], left : left + side[1]]
    known = (measured > NEAR_M) & (measured < FAR_M)
    inverse = 1 / np.where(known, measured, 1.0) + rng.normal(0, _NOISE, side)
    measured = 1 / np.maximum(np.rint(inverse / _STEP) * _STEP, 1 / FAR_M)
    brightness = rgb.mean(axis=2) / 255
    known &= ~(((brightness < _BLACK) | (brightness > _BRIGHT)) & (rng.random(side) < _LOST_IF_DARK))
    steps = [np.abs(np.diff(measured, axis=axis, prepend=measured.take([0], axis=axis))) for axis in (0, 1)]
    known &= ~((np.maximum(*steps) > _EDGE * measured) & (rng.random(side) < _LOST_AT_EDGES))
    for _ in range(rng.poisson(_HOLES)):
        known &= ~_ellipse(side, rng)
    return np.where(known, measured, 0).astype(np.float32)


def completed(known: np.ndarray, estimated: np.ndarray) -> np.ndarray:
    """Known depth, with the estimate where it is 0: (H, W) float32, metres.

    The estimate is scaled by the median ratio of known to estimated depth, so that both agree where they meet.
    """
    valid = known > 0
    if valid.sum() >= _MIN_KNOWN:
        estimated = estimated * np.median(known[valid] / np.maximum(estimated[valid], 1e-3))
    return np.where(valid, known, estimated).astype(np.float32)


def with_measured(measured: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Depth and a mask of the pixels with a measured value, (..., 2, H, W) float32, from two images (..., H, W)."""
    return np.stack([depth, measured > 0], axis=-3).astype(np.float32)


def fused(measured: np.ndarray, estimated: np.ndarray) -> np.ndarray:
    """Measured depth, `completed` by the estimate, with the mask of `with_measured`: (2, H, W) float32."""
    return with_measured(measured, completed(measured, estimated))


def exaggerated(estimated: np.ndarray, depth: np.ndarray, power: float) -> np.ndarray:
    """`depth * (estimated / depth) ** power`, (H, W) float32, metres; the estimate itself where true depth is 0."""
    known = (depth > 0) & (estimated > 0)
    ratio = np.where(known, estimated, 1.0) / np.where(known, depth, 1.0)
    return np.where(known, depth * ratio**power, estimated).astype(np.float32)


def mixed_depth(depth: np.ndarray, estimated: np.ndarray, rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Depth of a random quality: true, measured, estimated, or missing, in part or wholly.

    Measured depth is completed by the estimate, or its holes stay 0. Errors of the estimate are exaggerated at random.
    Returns (2, H, W) float32: metres, and 1 where depth is true or measured.
    """
    kind = rng.choice(list(_KINDS), p=list(_KINDS.values()))
    estimated = exaggerated(estimated, depth, rng.uniform(*_POWERS))
    if kind == "true":
        return with_measured(depth, depth)
    if kind in ("estimated", "none"):
        none = np.zeros_like(estimated)
        return with_measured(none, estimated if kind == "estimated" else none)
    measured = sensor_depth(depth, rgb, rng)
    return fused(measured, estimated) if kind == "completed" else with_measured(measured, measured)


def _ellipse(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool: an ellipse at a random place, with half axes of 2 to 15 % of the image."""
    row, column = np.ogrid[: shape[0], : shape[1]]
    centre, half = rng.random(2) * shape, rng.uniform(0.02, 0.15, 2) * shape
    return ((row - centre[0]) / half[0]) ** 2 + ((column - centre[1]) / half[1]) ** 2 < 1
