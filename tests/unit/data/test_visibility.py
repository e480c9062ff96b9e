"""Seen, between and hidden cells against closed forms."""

import math

import numpy as np
import pytest

from zerobev.config import CameraConfig
from zerobev.data.visibility import VISIBILITY, visibility
from zerobev.geometry.cameras import Pose

from support.scenes import box, build, room

SEEN, BETWEEN, HIDDEN = range(len(VISIBILITY))
POSE = Pose(3.0, 0.3, 0.0, math.pi / 2)  # forward is +y


def rows_of_floor(camera: CameraConfig) -> np.ndarray:
    """Distances at which rows of pixels meet the floor, metres."""
    below = np.arange(camera.fpv_px // 2) + 0.5
    return camera.focal_px * camera.height_m / below


@pytest.mark.parametrize("fpv_px", [32, 64])
def test_rows_of_pixels_on_an_empty_floor_see_the_cells_they_fall_into(fpv_px):
    camera = CameraConfig(fpv_px=fpv_px, bev_px=40)
    found = visibility(build(room((6, 9, 2.5))), [POSE], camera)[0]
    ahead = found[::-1, camera.bev_px // 2]  # the column right of the middle, nearest cell first
    distance = rows_of_floor(camera)
    distance = distance[
        distance * 0.5 / camera.focal_px < camera.cell_m
    ]  # the first column of pixels is in these cells
    with_row = np.isin(np.arange(camera.bev_px), np.floor(distance / camera.cell_m))
    nearest = int(distance.min() / camera.cell_m)  # nearer cells are below the image
    assert np.array_equal(ahead == SEEN, with_row)
    assert (ahead[nearest + 1 :] != HIDDEN).all() and (ahead[: nearest - 1] == HIDDEN).all()
    assert (ahead == BETWEEN).sum() > (fpv_px == 32) * 10


def test_cells_behind_a_box_are_hidden():
    camera = CameraConfig(fpv_px=64, bev_px=40)
    wall = box("cabinet", (2.0, 2.3, 0), (4.0, 2.5, 2.0))  # 2 to 2.2 m ahead, 2 m wide
    found = visibility(build([*room((6, 9, 2.5)), wall]), [POSE], camera)[0]
    forward = (np.arange(camera.bev_px)[::-1] + 0.5) * camera.cell_m
    shadow = found[(forward > 2.4) & (forward < 4.8)][:, 17:23]
    assert (shadow == HIDDEN).all()
    assert (found[(forward > 1.0) & (forward < 1.9)][:, 17:23] != HIDDEN).all()


def test_a_higher_camera_sees_over_a_table():
    camera = CameraConfig(fpv_px=64, bev_px=40)
    scene = build([*room((6, 9, 2.5)), box("table", (2.0, 2.3, 0), (4.0, 2.5, 0.8))])
    hidden = [
        (visibility(scene, [Pose(3.0, 0.3, 0.0, math.pi / 2, height)], camera)[0][:20, 17:23] == HIDDEN).mean()
        for height in (0.5, 1.7)
    ]
    assert hidden[0] > hidden[1] + 0.3
