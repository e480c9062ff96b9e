"""The two cameras, pinhole FPV and orthographic BEV, and their frames.

Frames, metres. World: z up. Camera: x right, y down, z forward, origin at the pinhole. Map: x right of the camera,
y forward, z up, origin on the floor below the pinhole. The camera is level, so map and camera frame differ only by a
fixed rotation and the camera's height.
"""

from dataclasses import dataclass

import numpy as np

from zerobev.config import CameraConfig


@dataclass(frozen=True)
class Pose:
    """Position of the camera on the floor (world frame, metres), and its heading.

    yaw: angle of the forward direction from world +x, counter-clockwise, radians
    """

    x: float
    y: float
    floor_z: float
    yaw: float

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
        return np.array([self.x, self.y, self.floor_z + camera.height_m])


def fpv_rays(camera: CameraConfig) -> np.ndarray:
    """(H, W, 3) float64: ray of each pixel centre in the camera frame, scaled to z = 1.

    The ray parameter of a hit is therefore its planar depth.
    """
    u = (np.arange(camera.fpv_px) + 0.5 - camera.fpv_px / 2) / camera.focal_px
    x, y = np.meshgrid(u, u)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def bev_cell_centres(camera: CameraConfig) -> tuple[np.ndarray, np.ndarray]:
    """Right and forward map coordinates of every cell centre: two (M, M) float64 arrays, metres."""
    across = (np.arange(camera.bev_px) + 0.5) * camera.cell_m
    return np.meshgrid(across - camera.bev_extent_m / 2, across[::-1])
