"""Samples as seen by other cameras: tilted, or with another field of view.

Photographs are levelled before they reach a network (`inference.pinhole`): the part of the level view that the
photograph did not cover has the colours at its border, no mask, and is outside the field of view on the map. Training
samples are level views of the same kind, so only the uncovered part is missing from them.
"""

from functools import cache

import numpy as np

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import Camera, fpv_rays

_SHAPES = ((480, 640), (480, 640), (480, 480), (360, 640), (640, 480))  # (H, W) of the photographs
_MIN_COVERED = 0.3  # of the level view; other cameras are drawn again


def other_camera(camera: CameraConfig, stretch: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The part of the level view that the photograph of a random camera covers.

    Its horizontal field of view is 50 to 110 degrees; most are tilted, by a pitch of -30 to 15 and a roll of -5 to 5
    degrees.
    stretch: see `Pose.stretch`
    Returns covered pixels (H, H) bool, and for each pixel the flat index of the nearest covered one, (H, H) int32.
    """
    while True:
        tilted = rng.random() < 0.7
        pitch, roll = (rng.uniform(-30, 15), rng.uniform(-5, 5)) if tilted else (0.0, 0.0)
        other = Camera(hfov_deg=rng.uniform(50, 110), pitch_deg=pitch, roll_deg=roll)
        covered, nearest = _covered_by(other, _SHAPES[rng.integers(len(_SHAPES))], camera, stretch)
        if covered.mean() > _MIN_COVERED:
            return covered, nearest


def _covered_by(
    other: Camera, shape: tuple[int, int], camera: CameraConfig, stretch: float
) -> tuple[np.ndarray, np.ndarray]:
    fx, fy, cx, cy = other.lens(shape)
    rays = _rays(camera) * np.array([[1], [stretch], [1]], np.float32)
    u, v, _ = other.positions(rays.reshape(3, camera.fpv_px, camera.fpv_px), shape)
    covered = (u >= 0) & (u < shape[1]) & (v >= 0) & (v < shape[0])
    # the nearest pixel of the photograph, and back to the level view
    side = camera.fpv_px
    nearest = np.arange(side * side, dtype=np.int32).reshape(side, side)
    u, v = np.clip(u[~covered], 0, shape[1]), np.clip(v[~covered], 0, shape[0])
    x, y, z = other.level_R_camera @ np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)])
    z = np.maximum(z, 1e-3)
    column, row = (np.floor(slope * camera.focal_px + side / 2) for slope in (x / z, y / z / stretch))
    nearest[~covered] = np.clip(row, 0, side - 1) * side + np.clip(column, 0, side - 1)
    return covered, nearest


@cache
def _rays(camera: CameraConfig) -> np.ndarray:
    """(3, H * H) float32."""
    return fpv_rays(camera).reshape(-1, 3).T.astype(np.float32)
