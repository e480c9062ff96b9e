"""The known part of the geometry, against the pinhole model."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from zerobev.config import SCALES, CameraConfig
from zerobev.errors import InputError
from zerobev.models.band_transformer import sinusoids
from zerobev.models.polar import PolarToCartesian, band_rows

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
def test_a_ramp_over_the_image_columns_reads_back_the_pinhole_column(camera, stem):
    """A ray map that holds its own image column must give every cell the column that the pinhole model says."""
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
def test_one_hot_columns_light_the_cells_they_see(scale, stem):
    """Light one column at one ray position: exactly the cells of that row within one column's width light up."""
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
                distance = 0.0  # left of the first centre its value goes on
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


def test_the_paper_bands():
    camera = SCALES["paper"].camera
    assert [len(rows) for rows in band_rows(camera, EDGES)] == [16, 24, 36, 24]
    assert band_rows(camera, EDGES)[0][-1] == 99, "the near band ends at the camera"


@pytest.mark.parametrize("edges", [(0.5, 2.0, 5.0), (0.0, 2.0, 4.0), (0.0, 3.0, 2.0, 5.0), (0.0, 0.01, 5.0)])
def test_bad_bands_are_named(edges):
    with pytest.raises(InputError, match="band_edges_m"):
        band_rows(SCALES["smoke"].camera, edges)


def test_sinusoids_have_sine_on_even_and_cosine_on_odd_channels():
    encoding = sinusoids(7, 16)
    for row in range(7):
        for pair in range(8):
            angle = row / 10_000 ** (2 * pair / 16)
            assert encoding[row, 2 * pair].item() == pytest.approx(math.sin(angle), abs=1e-6)
            assert encoding[row, 2 * pair + 1].item() == pytest.approx(math.cos(angle), abs=1e-6)
