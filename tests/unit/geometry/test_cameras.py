"""Frames and rays of the two cameras against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import Pose, bev_cell_centres, fpv_rays

YAWS = st.floats(-10, 10)
CAMERAS = st.builds(CameraConfig, fpv_px=st.integers(1, 33), bev_px=st.integers(1, 33), hfov_deg=st.floats(20, 150))


@given(YAWS)
def test_frames_are_proper_rotations(yaw):
    pose = Pose(0, 0, 0, yaw)
    for rotation in (pose.world_R_map, pose.world_R_camera):
        assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)


@pytest.mark.parametrize(
    "yaw, right, forward",
    [(0, (0, -1, 0), (1, 0, 0)), (math.pi / 2, (1, 0, 0), (0, 1, 0)), (math.pi, (0, 1, 0), (-1, 0, 0))],
)
def test_axes_at_known_headings(yaw, right, forward):
    pose = Pose(0, 0, 0, yaw)
    for rotation, axes in (
        (pose.world_R_map, (right, forward, (0, 0, 1))),
        (pose.world_R_camera, (right, (0, 0, -1), forward)),
    ):
        assert rotation == pytest.approx(np.column_stack(axes), abs=1e-12)


def test_pinhole_is_above_the_point_on_the_floor():
    camera = CameraConfig(fpv_px=8, bev_px=8, height_m=1.1)
    assert Pose(2, -3, 2.6, 0.4).centre(camera) == pytest.approx([2, -3, 3.7])


@given(CAMERAS)
@settings(max_examples=25)
def test_rays_have_unit_depth_and_span_the_field_of_view(camera):
    rays = fpv_rays(camera)
    assert rays.shape == (camera.fpv_px, camera.fpv_px, 3)
    assert (rays[..., 2] == 1).all()
    # half a pixel beyond the last centre is the edge of the image, at half the field of view
    edge = rays[0, -1, 0] + 0.5 / camera.focal_px
    assert math.degrees(math.atan(edge)) == pytest.approx(camera.hfov_deg / 2)
    assert rays == pytest.approx(-rays[::-1, ::-1] * (1, 1, -1), abs=1e-12)  # the axis is in the middle
    assert rays[..., 0] == pytest.approx(rays[..., 1].T)


def test_rays_of_an_odd_image_by_hand():
    rays = fpv_rays(CameraConfig(fpv_px=3, bev_px=1, hfov_deg=90))
    assert rays[1, 1] == pytest.approx([0, 0, 1])
    assert rays[0, 2] == pytest.approx([2 / 3, -2 / 3, 1])  # upper right: x to the right, y down


@given(CAMERAS)
@settings(max_examples=25)
def test_cells_tile_the_square_in_front_of_the_camera(camera):
    right, forward = bev_cell_centres(camera)
    half, cell = camera.bev_extent_m / 2, camera.cell_m
    rows, columns = np.indices(right.shape)
    assert right == pytest.approx(-half + (columns + 0.5) * cell)
    assert forward == pytest.approx(camera.bev_extent_m - (rows + 0.5) * cell)


def test_cells_of_an_odd_map_by_hand():
    right, forward = bev_cell_centres(CameraConfig(fpv_px=1, bev_px=5))
    assert right[0] == pytest.approx([-2, -1, 0, 1, 2])
    assert forward[:, 0] == pytest.approx([4.5, 3.5, 2.5, 1.5, 0.5])
