"""The known part of the geometry, against the pinhole model."""

import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from zerobev.common.errors import InputError
from zerobev.config import SCALES, CameraConfig
from zerobev.geometry.cameras import Pose
from zerobev.geometry.projection import cells_of_pixels, inverse_project, map_points
from zerobev.models.band_transformer import sinusoids
from zerobev.models.fpv_to_bev import reweigh
from zerobev.models.polar import PolarToCartesian, band_rows, floor_row
from zerobev.rendering.gbuffer import RayCaster

from support.scenes import build, furnished

EDGES = (0.0, 0.8, 2.0, 3.8, 5.0)
cameras = st.builds(
    CameraConfig, fpv_px=st.integers(24, 130), bev_px=st.integers(15, 60), hfov_deg=st.floats(40.0, 110.0)
)


def cell_in_image(camera: CameraConfig, row: int, column: int) -> float:
    """The image column, pixels, of a cell's centre: tan of its bearing times the focal length, by the pinhole model."""
    forward = 5.0 - (row + 0.5) * 5.0 / camera.bev_px
    right = -2.5 + (column + 0.5) * 5.0 / camera.bev_px
    half = math.tan(math.radians(camera.hfov_deg) / 2)
    return camera.fpv_px * (0.5 + right / forward / (2 * half))


def resamplers(camera: CameraConfig, stem: int = 2) -> list[tuple[range, int, PolarToCartesian]]:
    strides = [stem * 8, stem * 4, stem * 2, stem]
    return [(r, s, PolarToCartesian(camera, r, s)) for r, s in zip(band_rows(camera, EDGES), strides)]


@given(cameras, st.sampled_from([2, 4]))
@settings(max_examples=25, deadline=None)
def test_a_ramp_over_the_image_columns_gives_the_pinhole_column(camera, stem):
    """Rays with their image column as value give every cell its column in the pinhole model."""
    for rows, stride, resample in resamplers(camera, stem):
        count = -(-camera.fpv_px // stride)
        centres = stride * (torch.arange(count) + 0.5)
        features, valid = resample(centres[None, :, None, None].expand(1, count, len(rows), 1))
        u = torch.tensor([[cell_in_image(camera, row, column) for column in range(camera.bev_px)] for row in rows])
        inside = (u >= 0) & (u <= camera.fpv_px)
        on_the_edge = ((u - camera.fpv_px / 2).abs() - camera.fpv_px / 2).abs() < 1e-4 * camera.fpv_px
        assert ((valid == inside) | on_the_edge).all()
        expected = u.clamp(float(centres[0]), float(centres[-1])) * valid
        assert torch.allclose(features[0, :, :, 0], expected, atol=1e-3 * stride)


@pytest.mark.parametrize(("scale", "stem"), [("smoke", 2), ("reduced", 2), ("paper", 4)])
def test_one_hot_columns_are_resampled_to_their_cells(scale, stem):
    """One column at one ray position: exactly the cells of that row within one column's width are above zero."""
    camera = SCALES[scale].camera
    for rows, stride, resample in resamplers(camera, stem):
        count = camera.fpv_px // stride
        lit, p = count // 3, len(rows) // 2
        rays = torch.zeros(1, count, len(rows), 1)
        rays[0, lit, p] = 1
        features = resample(rays)[0][0, :, :, 0]
        assert not features[torch.arange(len(rows)) != p].any()
        for column in range(camera.bev_px):
            u = cell_in_image(camera, rows[p], column)
            distance = abs(u / stride - (lit + 0.5))
            if lit == 0 and u < stride / 2:
                distance = 0.0  # the first value extends to the left edge
            expected = max(0.0, 1 - distance) if 0 <= u <= camera.fpv_px else 0.0
            assert features[p, column].item() == pytest.approx(expected, abs=1e-5)


@given(cameras)
@settings(max_examples=25, deadline=None)
def test_bands_tile_the_map_and_the_view_is_symmetric(camera):
    bands = resamplers(camera)
    assert [row for rows, _, _ in reversed(bands) for row in rows] == list(range(camera.bev_px))
    for _, stride, resample in bands:
        assert torch.equal(resample.valid, resample.valid.flip(1))
        assert torch.equal(resample.weights.sum(-1).round(decimals=5), resample.valid.float())
        if camera.fpv_px % stride == 0:
            assert torch.allclose(resample.weights, resample.weights.flip(1, 2), atol=1e-6)


@pytest.mark.parametrize("fpv", [96, 100])
def test_points_of_the_floor_are_in_their_cells_of_the_pinhole_model(fpv):
    """Every cell gets its own position from the image, in which the pinhole model projects the floor.

    The image holds x / z and 1 / z of the floor in each pixel. Both are linear in the pixel's position, so that
    attention to the two image rows around the right one, and the resampler's interpolation, are exact.
    """
    camera = CameraConfig(fpv_px=fpv, bev_px=40, height_m=0.3)
    focal = fpv / 2 / math.tan(math.radians(79) / 2)
    for rows, stride, resample in resamplers(camera):
        count = -(-fpv // stride)
        centre = stride * (torch.arange(count) + 0.5)
        offset = (centre - fpv / 2) / focal
        floor = torch.stack([offset.expand(count, count), offset[:, None].expand(count, count) / 0.3])[None]
        z = 5 - (torch.tensor(rows) + 0.5) * 0.125
        at = ((fpv / 2 + focal * 0.3 / z) / stride - 0.5)[:, None]  # image row of the floor at depth z, in map pixels
        attention = (1 - (at - torch.arange(count)).abs()).clamp(min=0)  # P R
        seen = at[:, 0] <= count - 1
        cells, valid = resample(reweigh(attention.expand(count, 2, -1, -1), floor))  # 1 P M 2
        right = (torch.arange(40) + 0.5) * 0.125 - 2.5
        u = fpv / 2 + focal * right / z[:, None]
        inside = seen[:, None] & valid & (u >= centre[0]) & (u <= centre[-1])
        assert inside.sum() > 10, "every band has cells whose ground is in the image"
        x_over_z, inverse_z = cells[0].unbind(-1)
        assert torch.allclose((1 / inverse_z)[inside], z[:, None].expand(-1, 40)[inside], atol=1e-3)
        assert torch.allclose((x_over_z / inverse_z)[inside], right.expand(len(rows), -1)[inside], atol=1e-3)


@torch.no_grad()
@pytest.mark.parametrize("band", range(4))
def test_true_correspondence_as_attention_gives_the_projection(band):
    """Theorem 3.1's construction with depth from a G-buffer: the stream with identity values is P^-1.

    Attention of a ray position is even over the pixels of its column that lie in the position's map row. Compared are
    the cells where P^-1 knows one answer: their pixels, and those of the one or two columns that they are resampled
    from, agree (average and maximum are then the same), and each of these columns has a pixel in the cell.
    """
    camera = CameraConfig(fpv_px=384, bev_px=40, height_m=0.4)
    rows, stride = band_rows(camera, (0.0, 0.8, 2.0, 3.8, 5.0))[band], (32, 16, 8, 4)[band]
    coarse = replace(camera, fpv_px=384 // stride)
    depth = torch.from_numpy(RayCaster(build(furnished())).fpv(Pose(0.5, 2.6, 0.0, -0.1), coarse).distance)
    side = coarse.fpv_px
    zero = (torch.rand(1, 4, 5, 5, generator=torch.Generator().manual_seed(0)) > 0.5).float()
    zero = F.interpolate(zero, (side, side), mode="nearest")  # four images, one per head
    cell = cells_of_pixels(depth, camera=coarse)  # R C
    member = (cell // 40)[None] == torch.tensor(rows)[:, None, None]  # P R C
    attention = (member / member.sum(1, keepdim=True).clamp(min=1)).permute(2, 0, 1)  # C P R
    rays = reweigh(attention[:, None].expand(-1, 4, -1, -1), zero)
    found = PolarToCartesian(camera, rows, stride)(rays)[0].permute(0, 3, 1, 2)[0]  # 4 P M
    expected = inverse_project(zero, depth[None, None], coarse)[0]

    compared = []
    for p, row in enumerate(rows):
        z = (40 - row - 0.5) * camera.cell_m
        for column in range(40):
            u = 192 + camera.focal_px * ((column + 0.5) * camera.cell_m - 2.5) / z
            at = min(max(u / stride - 0.5, 0), side - 1)
            read = {int(at), min(int(at) + 1, side - 1)} if at % 1 else {int(at)}
            inside = cell == 40 * row + column
            if not 0 <= u <= 384 or not all(inside[:, c].any() for c in read):
                continue
            for k in range(4):
                values = torch.cat([zero[0, k][inside], *(zero[0, k, member[p, :, c], c] for c in read)])
                if values.unique().numel() == 1:
                    compared.append((float(found[k, p, column]), float(expected[k, row, column])))
    ours, theirs = torch.tensor(compared).T
    assert len(ours) > 20 and 0 < theirs.mean() < 1
    assert torch.allclose(ours, theirs, atol=1e-6)


def test_the_paper_bands():
    camera = SCALES["paper"].camera
    assert [len(rows) for rows in band_rows(camera, EDGES)] == [16, 24, 36, 24]
    assert band_rows(camera, EDGES)[0][-1] == 99, "the near band ends at the camera"


@pytest.mark.parametrize("edges", [(0.5, 2.0, 5.0), (0.0, 2.0, 4.0), (0.0, 3.0, 2.0, 5.0), (0.0, 0.01, 5.0)])
def test_bad_bands_are_named(edges):
    with pytest.raises(InputError, match="band_edges_m"):
        band_rows(SCALES["smoke"].camera, edges)


def test_sinusoids_have_sine_on_even_and_cosine_on_odd_channels():
    encoding = sinusoids(torch.arange(7), 16)
    for row in range(7):
        for pair in range(8):
            angle = row / 10_000 ** (2 * pair / 16)
            assert encoding[row, 2 * pair].item() == pytest.approx(math.sin(angle), abs=1e-6)
            assert encoding[row, 2 * pair + 1].item() == pytest.approx(math.cos(angle), abs=1e-6)


@given(cameras, st.sampled_from((2, 4, 8, 16)))
@settings(max_examples=30)
def test_floor_rows_are_rows_of_the_floor(camera, stride):
    """A point at the depth of a map row, in its floor row, has height zero."""
    rows = range(camera.bev_px)
    found = floor_row(camera, rows, stride)
    last = -(-camera.fpv_px // stride) - 1
    depths = [(camera.bev_px - row - 0.5) * camera.cell_m for row in rows]
    for row, depth in zip(found, depths):
        height = map_points(torch.full((camera.fpv_px, 1), depth).expand(-1, camera.fpv_px), camera)[:, 0, 2].double()
        pixel = stride * (row + 0.5) - 0.5
        assert pixel > camera.fpv_px / 2 - 0.5
        if row < last:
            slope = (height[-1] - height[0]) / (camera.fpv_px - 1)  # heights are linear in the row
            assert abs(height[0] + slope * pixel) < 1e-4 * max(1.0, depth)
        else:
            assert row == last
    assert (found[1:] >= found[:-1]).all()
