"""P^-1 against a closed form and a naive voxel grid; the field of view against scikit-image's convex hull."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.morphology import convex_hull_image

from zerobev.config import CameraConfig
from zerobev.geometry.projection import cells_of_pixels, fov_mask, inverse_project, inverse_project_mask, map_points

CAMERA = CameraConfig(fpv_px=24, bev_px=20)
NOWHERE = CAMERA.bev_px**2
SEEDS = st.integers(0, 2**32 - 1)


def pixels_of(point: tuple[float, float, float], camera: CameraConfig) -> torch.Tensor:
    """Depth image of one point (right, forward, up in the map frame); other pixels have no depth."""
    right, forward, up = point
    column = int(np.floor(right / forward * camera.focal_px + camera.fpv_px / 2))
    row = int(np.floor((camera.height_m - up) / forward * camera.focal_px + camera.fpv_px / 2))
    depth = torch.zeros(camera.fpv_px, camera.fpv_px, dtype=torch.float64)
    if 0 <= row < camera.fpv_px and 0 <= column < camera.fpv_px:
        depth[row, column] = forward
    return depth


@given(st.floats(-3, 3), st.floats(0.3, 6), st.floats(-0.5, 3))
@settings(max_examples=200)
def test_a_point_lands_in_its_cell(right, forward, up):
    camera = CameraConfig(fpv_px=301, bev_px=20)  # fine pixels: their centres are close to the point
    depth = pixels_of((right, forward, up), camera)
    slack = forward / camera.focal_px
    cell = camera.cell_m
    near_border = [
        abs(right / cell - round(right / cell)) * cell < slack,
        abs(forward / cell - round(forward / cell)) * cell < 1e-6,
        abs(up - camera.max_height_m) < slack,
    ]
    seen = depth > 0
    if any(near_border) or not seen.any():
        return
    column, row = int(np.floor((right + 2.5) / cell)), int(np.floor((5 - forward) / cell))
    inside = 0 <= column < 20 and 0 <= row < 20 and up < camera.max_height_m
    assert cells_of_pixels(depth, camera)[seen].item() == (20 * row + column if inside else NOWHERE)


def test_points_by_hand():
    """Pixels of a 2 x 2 image of 90 degrees, at 2 m and at 2.5 m."""
    camera = CameraConfig(fpv_px=2, bev_px=5, hfov_deg=90)
    points = map_points(torch.full((2, 2), 2.0), camera)
    assert points[1, 1].tolist() == pytest.approx([1, 2, 0.88 - 1])
    assert points[0, 0].tolist() == pytest.approx([-1, 2, 0.88 + 1])
    # cells of 1 m; row 2 is 2 to 3 m away, columns 1 and 3 are 1 m to the left and to the right
    assert cells_of_pixels(torch.full((2, 2), 2.5), camera).tolist() == [[25, 25], [11, 13]]  # 2.13 m is too high


def random_view(seed: int, camera: CameraConfig, batch: int = 2, modalities: int = 3):
    """Values and depths as in a room: a wall at a random distance, holes, and random masks."""
    rng = np.random.default_rng(seed)
    shape = (batch, 1, camera.fpv_px, camera.fpv_px)
    depth = rng.uniform(0.5, 8, (batch, 1, 1, 1)) * rng.uniform(0.8, 1.2, shape) * (rng.random(shape) < 0.9)
    zero = rng.random((batch, modalities, *shape[2:])) < rng.random((1, modalities, 1, 1)) * 0.3
    return torch.from_numpy(zero).double(), torch.from_numpy(depth)


def voxel_projection(zero: np.ndarray, depth: np.ndarray, camera: CameraConfig, side: int) -> np.ndarray:
    """As in the paper: count white points in side x side x 100 voxels, sum over height, threshold at zero."""
    batch, modalities, height, width = zero.shape
    levels = 100
    maps = np.zeros((batch, modalities, side, side), bool)
    for b in range(batch):
        for k in range(modalities):
            voxels = np.zeros((side, side, levels), int)
            for i in range(height):
                for j in range(width):
                    z = depth[b, 0, i, j]
                    if z == 0 or not zero[b, k, i, j]:
                        continue
                    right = (j + 0.5 - width / 2) * z / camera.focal_px
                    up = camera.height_m - (i + 0.5 - height / 2) * z / camera.focal_px
                    column = int(np.floor((right + camera.bev_extent_m / 2) / camera.bev_extent_m * side))
                    row = int(np.floor((camera.bev_extent_m - z) / camera.bev_extent_m * side))
                    # points below the floor count in the lowest voxel
                    level = max(int(np.floor(up / camera.max_height_m * levels)), 0)
                    if 0 <= column < side and 0 <= row < side and level < levels:
                        voxels[row, column, level] += 1
            maps[b, k] = voxels.sum(axis=-1) > 0
    return maps


@given(SEEDS)
@settings(max_examples=10)
def test_projection_equals_counting_in_voxels(seed):
    zero, depth = random_view(seed, CAMERA)
    voxels = voxel_projection(zero.numpy(), depth.numpy(), CAMERA, side=20)
    assert np.array_equal(inverse_project(zero, depth, CAMERA).numpy(), voxels)


@given(SEEDS)
@settings(max_examples=5)
def test_voxels_of_five_centimetres_give_the_same_map_if_cells_are_whole_voxels(seed):
    """100^3 voxels, pooled to the map: equal at 20 x 20; at 40 x 40, voxels within one cell agree."""
    zero, depth = random_view(seed, CAMERA)
    fine = voxel_projection(zero.numpy(), depth.numpy(), CAMERA, side=100)
    pooled = fine.reshape(2, 3, 20, 5, 20, 5).max(axis=(3, 5))
    assert np.array_equal(inverse_project(zero, depth, CAMERA).numpy(), pooled)

    finer = replace(CAMERA, bev_px=40)
    cell_of_voxel = (np.arange(100) + 0.5) * 40 / 100
    whole = np.floor(cell_of_voxel - 0.2 + 1e-9) == np.floor(cell_of_voxel + 0.2 - 1e-9)
    assert whole.sum() == 80
    direct, pooled = inverse_project(zero, depth, finer).numpy(), np.zeros((2, 3, 40, 40))
    for row in np.flatnonzero(whole):
        for column in np.flatnonzero(whole):
            cell = pooled[..., int(cell_of_voxel[row]), int(cell_of_voxel[column])]
            np.maximum(cell, fine[..., row, column], out=cell)
    assert (pooled <= direct).all()  # points in such voxels are on the map


@given(SEEDS)
@settings(max_examples=20)
def test_the_projection_of_one_mask_equals_that_of_an_image(seed):
    zero, depth = random_view(seed, CAMERA)
    mask = zero[0, 0] > 0
    expected = inverse_project(mask[None, None].double(), depth[:1], CAMERA)[0, 0].numpy()
    found = inverse_project_mask(mask.numpy(), depth[0, 0].numpy(), CAMERA)
    assert found.dtype == bool and np.array_equal(found, expected > 0)


@given(SEEDS)
@settings(max_examples=20)
def test_projection_is_a_maximum(seed):
    """It commutes with scaling and with the maximum of two images, and is monotone."""
    zero, depth = random_view(seed, CAMERA)
    generator = torch.Generator().manual_seed(seed)
    a, b = zero * torch.rand(zero.shape, generator=generator), torch.rand(zero.shape, generator=generator).double()
    of_a, of_b = inverse_project(a, depth, CAMERA), inverse_project(b, depth, CAMERA)
    assert torch.equal(inverse_project(torch.maximum(a, b), depth, CAMERA), torch.maximum(of_a, of_b))
    assert torch.allclose(inverse_project(0.25 * a, depth, CAMERA), 0.25 * of_a)
    assert (inverse_project(torch.maximum(a, b), depth, CAMERA) >= of_a).all()


def test_pixels_without_depth_reach_no_cell():
    zero = torch.ones(1, 1, 24, 24)
    assert not inverse_project(zero, torch.zeros(1, 1, 24, 24), CAMERA).any()
    assert (cells_of_pixels(torch.zeros(24, 24), CAMERA) == NOWHERE).all()
    assert not fov_mask(np.zeros((24, 24), np.float32), CAMERA).any()


@given(SEEDS)
@settings(max_examples=20)
def test_field_of_view_is_the_convex_hull_of_the_cells(seed):
    """scikit-image takes the hull of the middles of pixel edges, ours that of corners: they differ at the border."""
    depth = random_view(seed, CAMERA)[1][0, 0].numpy()
    reached = np.zeros(NOWHERE + 1, bool)
    reached[cells_of_pixels(torch.from_numpy(depth), CAMERA).numpy()] = True
    cells = reached[:-1].reshape(20, 20)
    mask = fov_mask(depth, CAMERA)
    assert mask.dtype == bool and (mask | ~cells).all()
    if not cells.any():
        assert not mask.any()
        return
    theirs = convex_hull_image(cells)
    assert (mask | ~theirs).all()
    rows, columns = np.nonzero(mask & ~theirs)
    for row, column in zip(rows, columns):  # additional cells of ours touch theirs
        assert theirs[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].any()
    assert (mask & ~theirs).sum() <= 0.1 * mask.sum() + 4


def test_field_of_view_of_one_cell_and_of_two():
    camera = CameraConfig(fpv_px=301, bev_px=20)
    one = pixels_of((0.6, 2.6, 0.1), camera).numpy()
    two = one + pixels_of((0.6, 3.9, 0.1), camera).numpy()
    assert np.argwhere(fov_mask(one, camera)).tolist() == [[9, 12]]
    assert np.argwhere(fov_mask(two, camera)).tolist() == [[row, 12] for row in range(4, 10)]


def test_field_of_view_on_an_infinite_floor_is_a_trapezium():
    """On an infinite floor the mask is the trapezium between the edges of the view, from the first row with floor."""
    camera = CameraConfig(fpv_px=400, bev_px=50)
    down = (np.arange(400) + 0.5 - 200) / camera.focal_px
    depth = np.where(down > 0, camera.height_m / np.where(down > 0, down, 1), 0)
    mask = fov_mask(np.broadcast_to(depth[:, None], (400, 400)).astype(np.float32), camera)
    rows, columns = np.indices(mask.shape)
    forward, right = 5 - (rows + 0.5) * 0.1, -2.5 + (columns + 0.5) * 0.1
    edge = np.tan(np.radians(camera.hfov_deg / 2))
    expected = (np.abs(right) < edge * forward) & (forward > camera.height_m / edge)
    borders = np.abs(right) - edge * forward, forward - camera.height_m / edge, 5 - forward
    clear = np.abs(borders).min(axis=0) > 0.2
    assert np.array_equal(mask[clear], expected[clear])
    assert clear.mean() > 0.75


def test_memory_does_not_grow_with_the_number_of_cameras():
    """Each view of a training has a camera of its own."""
    depth = np.ones((CAMERA.fpv_px, CAMERA.fpv_px), np.float32)
    fov_mask(depth, CAMERA)
    tracemalloc.start()
    for height in np.linspace(0.3, 1.8, 300):
        fov_mask(depth, CAMERA.at_height(float(height)))
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 300 * depth.nbytes / 8
