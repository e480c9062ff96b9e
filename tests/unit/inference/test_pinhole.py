"""Images of any camera, resampled to the network's: against closed forms, and against views of a scene."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.geometry.cameras import Camera, Pose, bev_cell_centres
from zerobev.geometry.projection import inverse_project_mask
from zerobev.inference.pinhole import PinholeView
from zerobev.rendering.gbuffer import RayCaster

from support.scenes import box, build, room

CAMERA = CameraConfig(fpv_px=64, bev_px=40)


def scene_of_rays(width: int, height: int, hfov_deg: float) -> np.ndarray:
    """(H, W, 3) image of a pinhole camera in a world with colours affine in the ray."""
    focal = width / 2 / np.tan(np.radians(hfov_deg) / 2)
    x, y = np.meshgrid(*((np.arange(length) + 0.5 - length / 2) / focal for length in (width, height)))
    return np.stack([0.5 + 0.2 * x, 0.5 + 0.2 * y, 0.5 + 0.1 * (x - y)], axis=-1)


@pytest.mark.parametrize(("width", "height", "hfov"), [(64, 64, 79), (640, 480, 95), (301, 233, 60), (90, 200, 79)])
def test_a_resampled_photograph_is_that_of_the_network_s_camera(width, height, hfov):
    view = PinholeView((height, width), Camera(hfov), CAMERA)
    expected = scene_of_rays(64, 64, 79)
    # a pixel is covered if its middle is
    focal = width / 2 / np.tan(np.radians(hfov) / 2)
    ray = np.abs((np.arange(64) + 0.5 - 32) / CAMERA.focal_px)
    covered = (ray[:, None] <= height / 2 / focal + 1e-9) & (ray <= width / 2 / focal + 1e-9)
    np.testing.assert_array_equal(view.covered, covered)
    photograph = view.photograph(scene_of_rays(width, height, hfov))
    rows, columns = (np.flatnonzero(covered.any(axis=axis)) for axis in (1, 0))
    clipped = np.ix_(np.clip(range(64), rows[0], rows[-1]), np.clip(range(64), columns[0], columns[-1]))
    assert photograph.dtype == np.float32
    np.testing.assert_array_equal(photograph, photograph[clipped])  # extended with the colours at the border
    # the border may be off by the larger pixel of the two cameras
    slack = 0.3 * max(1 / CAMERA.focal_px, 1 / focal)
    assert np.abs(photograph - expected)[covered].max() < slack
    inner = covered & np.roll(covered, (1, 1), (0, 1)) & np.roll(covered, (-1, -1), (0, 1))
    assert np.abs(photograph - expected)[inner].mean() < 0.1 * slack


@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_whole_factors_are_exact(seed, factor):
    small = np.random.default_rng(seed).random((64, 64)) < 0.3
    rgb = np.random.default_rng(seed).random((64, 64, 3)).astype(np.float32)
    large, large_rgb = (np.repeat(np.repeat(image, factor, 0), factor, 1) for image in (small, rgb))
    view = PinholeView(large.shape, Camera(), CAMERA)
    np.testing.assert_array_equal(view.mask(large), small)
    np.testing.assert_allclose(view.photograph(large_rgb), rgb, atol=1e-5)


@given(st.integers(0, 630), st.booleans())
def test_lines_of_half_a_pixel_are_kept_whole_and_thinner_ones_in_part(left, upright):
    view = PinholeView((640, 640), Camera(), CAMERA)
    for width, min_px in ((5, 64), (1, 1)):
        image = np.zeros((640, 640), bool)
        image[:, left : left + width] = True
        found = view.mask(image if upright else image.T)
        assert found.sum() >= min_px and (found if upright else found.T).all(axis=0).any()
    assert not view.mask(np.zeros((640, 640), bool)).any()


def test_edges_grow_by_a_quarter_of_a_pixel():
    view = PinholeView((640, 640), Camera(), CAMERA)
    grown = []
    for left in range(200, 210):
        image = np.zeros((640, 640), bool)
        image[:, left:500] = True
        grown.append(view.mask(image)[0].sum() * 10 - image[0].sum())
    assert 1 < np.mean(grown) < 4  # tenths of a pixel


@pytest.mark.parametrize("hfov", [0, 180, -3, float("nan"), 0.1])
def test_impossible_fields_of_view_are_refused(hfov):
    with pytest.raises(InputError, match=r"camera.*: expected"):
        PinholeView((48, 48), Camera(hfov), CAMERA)


# --- tilted cameras, and other heights ----------------------------------------------------------------------------

TILTED = st.builds(
    Camera,
    hfov_deg=st.floats(50, 110),
    height_m=st.floats(0.3, 1.8),
    pitch_deg=st.floats(-30, 15),
    roll_deg=st.floats(-5, 5),
)


def rays_of(camera: Camera, shape: tuple[int, int]) -> np.ndarray:
    """(H, W, 3) ray of each pixel of a camera in the frame of a level one, planar depth 1 along its axis."""
    fx, fy, cx, cy = camera.lens(shape)
    x, y = np.meshgrid((np.arange(shape[1]) + 0.5 - cx) / fx, (np.arange(shape[0]) + 0.5 - cy) / fy)
    return np.stack([x, y, np.ones_like(x)], axis=-1) @ camera.level_R_camera.T


def test_angles_turn_the_camera_as_documented():
    up = Camera(pitch_deg=30).level_R_camera[:, 2]
    np.testing.assert_allclose(up, [0, -0.5, math.sqrt(0.75)], atol=1e-12)  # y points down
    right = Camera(roll_deg=30).level_R_camera[:, 0]
    np.testing.assert_allclose(right, [math.sqrt(0.75), 0.5, 0], atol=1e-12)  # the right side goes down
    assert Camera(fx=50, fy=60, cx=20, cy=30).lens((48, 64)) == (50, 60, 20, 30)
    assert Camera(hfov_deg=90).lens((48, 64)) == pytest.approx((32, 32, 32, 24))


@given(TILTED)
@example(Camera(height_m=0.5))
@example(Camera(height_m=1.5))
def test_any_camera_s_photograph_becomes_that_of_the_level_camera(camera):
    """Colours are affine in the direction's slopes after the vertical stretch, so the expected image is known."""
    shape = (240, 320)
    rays = rays_of(camera, shape)
    slopes = rays[..., :2] / rays[..., 2:] * [1, CAMERA.height_m / camera.height_m]
    view = PinholeView(shape, camera, CAMERA)
    expected = (np.arange(64) + 0.5 - 32) / CAMERA.focal_px
    for axis, target in enumerate(np.meshgrid(expected, expected)):
        channel = np.where(rays[..., 2] > 0.05, slopes[..., axis], 0)
        found = view.photograph(np.repeat(channel[..., None], 3, axis=2))[..., 0]
        inner = view.covered.copy()
        for shift in (-1, 1):
            inner &= np.roll(view.covered, shift, 0) & np.roll(view.covered, shift, 1)
        assert np.abs(found - target)[inner].max(initial=0) < 1.5 / CAMERA.focal_px


@given(TILTED)
@example(Camera(height_m=0.5))
@example(Camera(height_m=1.5))
def test_a_tilted_camera_with_depth_gives_the_level_camera_s_map(camera):
    """A box on the floor of a room: its mask and depth, seen by any camera, are projected to the box's cells."""
    scene = build([*room((10, 10, 2.5), (-5, -1, 0)), box("chair", (-0.6, 2.2, 0), (0.6, 3.0, 0.6))])
    pose, shape = Pose(0.0, 0.0, 0.0, math.pi / 2), (120, 160)
    rays = rays_of(camera, shape) @ pose.world_R_camera.T
    origins = np.broadcast_to((0, 0, camera.height_m), rays.shape)
    seen = RayCaster(scene)._everything.cast(origins.astype(np.float32), rays.astype(np.float32))
    depth = PinholeView(shape, camera, CAMERA).depth(np.where(seen.instance == 7, seen.distance, 0))
    found = inverse_project_mask(depth > 0, depth, CAMERA.at_height(camera.height_m))
    x, y = bev_cell_centres(CAMERA)
    half = CAMERA.cell_m / 2 + 0.02  # the nearest pixel is up to half a pixel off
    assert (np.abs(x[found]) < 0.6 + half).all() and (2.2 - half < y[found]).all() and (y[found] < 3.0 + half).all()
    if (depth > 0).sum() > 100:
        assert found[(np.abs(x) < 0.4) & (np.abs(y - 2.25) < 0.1)].any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"height_m": 0}, "camera.height_m: expected metres above 0 and below 10, found 0"),
        ({"pitch_deg": 90}, "camera.pitch_deg: expected an angle between -90 and 90"),
        ({"roll_deg": "3"}, "camera.roll_deg: expected a number, found '3'"),
        ({"pitch_deg": float("nan")}, "camera.pitch_deg: expected a finite number"),
        ({"fx": 50}, "camera: expected either hfov_deg or all of fx, fy, cx, cy"),
        ({"fx": 50, "fy": 50, "cx": 3, "cy": 3, "hfov_deg": 60}, "camera: expected either hfov_deg or"),
    ],
)
def test_impossible_cameras_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        Camera(**arguments)


def test_what_lies_behind_the_camera_has_the_colour_of_the_nearest_border():
    """The camera looks up from high above the floor: the lowest rays of the level view are behind it."""
    rgb = np.zeros((120, 160, 3))
    rgb[:60] = 1.0
    view = PinholeView((120, 160), Camera(pitch_deg=40, height_m=1.8), CAMERA)
    assert not view.covered[-1].any() and (view.photograph(rgb)[-1] == 0).all()


def test_a_camera_that_looks_elsewhere_is_refused():
    with pytest.raises(InputError, match=r"camera: expected a view that covers a pixel .* level, found Camera\("):
        PinholeView((48, 48), Camera(hfov_deg=20, pitch_deg=80), CAMERA)
    with pytest.raises(InputError, match=r"camera: expected a zerobev.Camera, found 66"):
        PinholeView((48, 48), 66, CAMERA)
