"""The cameras and their frames: the networks' pinhole FPV and orthographic BEV, and the camera of a photograph.

Frames, metres. World: z up. Camera: x right, y down, z forward, origin at the pinhole. Map: x right of the camera,
y forward, z up, origin on the floor below the pinhole. The networks' camera is level, so map and camera frame differ
only by a fixed rotation and the camera's height.
"""

import math
from dataclasses import dataclass, fields
from functools import cache

import numpy as np

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig


@dataclass(frozen=True)
class Camera:
    """The pinhole camera of a photograph. Raises `InputError` for values outside their range.

    Give `hfov_deg`, or a calibrated `fx`, `fy`, `cx`, `cy`, in pixels of the photograph; without either, the field of
    view is 79 degrees, as in training.
    """

    hfov_deg: float | None = None  #: horizontal field of view, degrees; pixels are square, the axis is in the middle
    height_m: float = 0.88  #: of the pinhole above the floor
    pitch_deg: float = 0.0  #: positive: the camera looks up
    roll_deg: float = 0.0  #: positive: the camera is turned clockwise, as seen from behind
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None  #: from the left edge of the image
    cy: float | None = None  #: from the upper edge of the image

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None:
                continue
            if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.number):
                raise InputError(f"camera.{field.name}: expected a number, found {value!r}")
            if not math.isfinite(value):
                raise InputError(f"camera.{field.name}: expected a finite number, found {value!r}")
        lens = (self.fx, self.fy, self.cx, self.cy)
        if any(value is not None for value in lens) and (None in lens or self.hfov_deg is not None):
            raise InputError("camera: expected either hfov_deg or all of fx, fy, cx, cy, found a mixture")
        ranges = {
            "hfov_deg": (0, 180, "an angle between 0 and 180 degrees"),
            "height_m": (0, 10, "metres above 0 and below 10"),
            "pitch_deg": (-90, 90, "an angle between -90 and 90 degrees"),
            "roll_deg": (-180, 180, "an angle between -180 and 180 degrees"),
            "fx": (0, math.inf, "more than 0 pixels"),
            "fy": (0, math.inf, "more than 0 pixels"),
        }
        for name, (low, high, expected) in ranges.items():
            value = getattr(self, name)
            if value is not None and not low < value < high:
                raise InputError(f"camera.{name}: expected {expected}, found {value:g}")

    @property
    def is_level(self) -> bool:
        """Whether the optical axis is horizontal and image columns are vertical."""
        return self.pitch_deg == 0 and self.roll_deg == 0

    def lens(self, shape: tuple[int, int]) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy for images of `shape` (H, W), pixels."""
        if self.fx is not None and self.fy is not None and self.cx is not None and self.cy is not None:
            return self.fx, self.fy, self.cx, self.cy
        hfov_deg = 79.0 if self.hfov_deg is None else self.hfov_deg
        focal_px = 0.5 * shape[1] / math.tan(math.radians(max(hfov_deg, _MIN_HFOV_DEG)) / 2)
        return focal_px, focal_px, shape[1] / 2, shape[0] / 2

    def positions(self, rays: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Image positions of rays in images of `shape` (H, W): u and v, pixels, and depth along the optical axis.

        rays: (3, ...) right, down and forward in the frame of a level camera; results have their type
        Rays from behind the camera get positions far outside the image, on their side of it. No ray of a level view is
        near the direction opposite to a pitch below 90 degrees, so none falls on the image.
        """
        fx, fy, cx, cy = self.lens(shape)
        x, y, z = np.tensordot(self.level_R_camera.T.astype(rays.dtype), rays, axes=1)
        z = np.maximum(z, z.dtype.type(1e-6))
        return cx + fx * x / z, cy + fy * y / z, z

    @property
    def level_R_camera(self) -> np.ndarray:
        """(3, 3) float64: columns are the camera's right, down and forward in the frame of a level camera."""
        pitch, roll = math.radians(self.pitch_deg), math.radians(self.roll_deg)
        cp, sp, cr, sr = math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll)
        looking_up = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
        turned = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
        return looking_up @ turned


_MIN_HFOV_DEG = 1e-6  # smaller angles overflow, and cover no pixel in any case


@dataclass(frozen=True)
class Pose:
    """Position of the camera on the floor (world frame, metres), its heading, and its height.

    yaw: angle of the forward direction from world +x, counter-clockwise, radians
    height_m: of the pinhole above the floor; None: that of the `CameraConfig`. Images from another height are stretched
        vertically to the floor of `CameraConfig`, see `CameraConfig.at_height`
    """

    x: float
    y: float
    floor_z: float
    yaw: float
    height_m: float | None = None

    @property
    def world_R_map(self) -> np.ndarray:
        """(3, 3) float64: columns are the map's right, forward and up in the world frame."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[s, c, 0.0], [-c, s, 0.0], [0.0, 0.0, 1.0]])

    @property
    def world_R_camera(self) -> np.ndarray:
        """(3, 3) float64: columns are the camera's right, down and forward in the world frame."""
        right, forward, up = self.world_R_map.T
        return np.stack([right, -up, forward], axis=1)

    def centre(self, camera: CameraConfig) -> np.ndarray:
        """(3,) float64: the pinhole in the world frame."""
        return np.array([self.x, self.y, self.floor_z + (self.height_m or camera.height_m)])

    def stretch(self, camera: CameraConfig) -> float:
        """Height of the pinhole over that of `camera`: the factor on the vertical slopes of an image's rays."""
        return 1.0 if self.height_m is None else self.height_m / camera.height_m


def fpv_rays(camera: CameraConfig) -> np.ndarray:
    """(H, W, 3) float64: ray of each pixel centre in the camera frame, scaled to z = 1.

    The ray parameter of a hit is therefore its planar depth.
    """
    slopes = column_slopes(camera.fpv_px, camera.focal_px)
    x, y = np.meshgrid(slopes, slopes)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


@cache
def column_slopes(fpv_px: int, focal_px: float) -> np.ndarray:
    """(H,) float64: at depth 1, the offset of each image column to the right, and of each row downwards."""
    slopes = (np.arange(fpv_px) + 0.5 - fpv_px / 2) / focal_px
    slopes.flags.writeable = False
    return slopes


def bev_cell_centres(camera: CameraConfig) -> tuple[np.ndarray, np.ndarray]:
    """Right and forward map coordinates of every cell centre: two (M, M) float64 arrays, metres."""
    across = (np.arange(camera.bev_px) + 0.5) * camera.cell_m
    return np.meshgrid(across - camera.bev_extent_m / 2, across[::-1])
