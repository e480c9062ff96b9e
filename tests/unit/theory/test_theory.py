"""The theory against references: loops over pixels, enumeration of all binary values, convex solvers."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, minimize

from zerobev import config
from zerobev.config import CameraConfig
from zerobev.geometry.projection import cells_of_pixels
from zerobev.models.band_transformer import BandAttention
from zerobev.models.fpv_to_bev import columns, reweigh
from zerobev.models.polar import band_rows
from zerobev.models.variants import build
from zerobev.theory.attended import attended, column_attention
from zerobev.theory.attention import CrossAttention, divergence, total_variation, train, zero_shot_error
from zerobev.theory.correspondence import (
    Columns,
    correspondence,
    pool,
    positions,
    uncertain_correspondence,
    uniform_attention,
)
from zerobev.theory.max_pooling import best_attention, best_linear, expected_error, worst_case, worst_case_attention

CAMERA = CameraConfig(fpv_px=16, bev_px=20)
SEEDS = st.integers(0, 2**32 - 1)
COUNTS = ((1, 0), (1, 3), (2, 0), (2, 4), (3, 2), (4, 4), (6, 1))


def steps_of_depth(rng: np.random.Generator, views: int) -> torch.Tensor:
    """Depth images with a few walls per column, some beyond the map and some missing."""
    walls = rng.uniform(-0.3, 6.0, size=(views, 4, CAMERA.fpv_px)).repeat(4, axis=1).clip(min=0)
    return torch.from_numpy(walls + rng.uniform(0, 0.1, size=walls.shape) * (walls > 0)).float()


# --- correspondence


@given(SEEDS)
@settings(max_examples=20)
def test_positions_are_the_map_rows_of_the_projection(seed):
    depth = steps_of_depth(np.random.default_rng(seed), 2)
    cell, position = cells_of_pixels(depth, CAMERA), positions(depth, CAMERA)
    on_map = cell < CAMERA.bev_px**2
    assert on_map.any() and torch.equal(position[on_map], cell[on_map] // CAMERA.bev_px)
    # rays continue beyond the sides of the map: a wider map of the same cells contains them
    wide = cells_of_pixels(depth, replace(CAMERA, bev_px=60, bev_extent_m=15.0))
    near = (wide < 60**2) & (wide // 60 >= 40)
    assert torch.equal(position < CAMERA.bev_px, near)


@given(SEEDS)
@settings(max_examples=20)
def test_identity_values_and_the_normalised_indicator_are_average_pooling(seed):
    rng = np.random.default_rng(seed)
    depth, images = steps_of_depth(rng, 2), torch.from_numpy(rng.normal(size=(2, 3, 16, 16))).float()
    gamma = correspondence(depth, CAMERA)
    expected = np.zeros((2, 16, 20, 3), np.float32)
    position = positions(depth, CAMERA)
    for view, column, p in product(range(2), range(16), range(20)):
        rows = [y for y in range(16) if position[view, y, column] == p]
        assert gamma[view * 16 + column, p].nonzero().flatten().tolist() == rows
        if rows:
            expected[view, column, p] = np.mean([images[view, :, y, column].numpy() for y in rows], axis=0)
    expected = torch.from_numpy(expected).flatten(0, 1)
    weights = uniform_attention(gamma)
    torch.testing.assert_close(pool(images, depth, CAMERA, "mean"), expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(weights @ columns(images), expected, atol=1e-6, rtol=0)
    # the zero-shot stream of variant (e) computes the same sum
    rays = reweigh(weights[:, None], images.flatten(0, 1)[:, None]).unflatten(0, (2, 3))  # B K C P 1
    torch.testing.assert_close(rays.permute(0, 2, 3, 1, 4).flatten(3).flatten(0, 1), expected, atol=1e-6, rtol=0)


def test_max_and_sum_pooling():
    rng = np.random.default_rng(0)
    depth, images = steps_of_depth(rng, 1), torch.from_numpy(rng.random((1, 1, 16, 16))).float()
    gamma = correspondence(depth, CAMERA)
    largest = (gamma * columns(images).mT).amax(-1, keepdim=True)
    torch.testing.assert_close(pool(images, depth, CAMERA, "amax"), largest)
    counts = pool(torch.ones_like(images), depth, CAMERA, "sum")[..., 0]
    assert torch.equal(counts, gamma.sum(-1).float()) and counts.max() > 1


@pytest.mark.parametrize("sigma_m", [0.05, 0.5])
def test_uncertain_correspondence_is_how_often_a_pixel_falls_into_a_position(sigma_m):
    rng = np.random.default_rng(1)
    depth, draws = steps_of_depth(rng, 1).clamp(min=1), 4000
    expected = uncertain_correspondence(depth, sigma_m, CAMERA)
    columns_seen = slice(0, 3)
    sampled = torch.zeros(3, CAMERA.bev_px, CAMERA.fpv_px)
    for _ in range(draws):
        error = torch.from_numpy(rng.normal(scale=sigma_m, size=depth.shape)).float()
        sampled += correspondence(depth + error, CAMERA)[columns_seen]
    assert (sampled / draws - expected[columns_seen]).abs().max() < 4.5 * 0.5 * draws**-0.5
    assert expected.max() > 0.1


def test_certain_depth_is_the_indicator():
    depth = steps_of_depth(np.random.default_rng(2), 2).clamp(min=0.6)
    gamma = correspondence(depth, CAMERA)
    assert (uncertain_correspondence(depth, 1e-7, CAMERA) - gamma.double()).abs().max() < 1e-3


# --- attention


def learned(rng: np.random.Generator, value: tuple[int, int] | None = None) -> tuple[CrossAttention, Columns]:
    depth = steps_of_depth(rng, 24)
    seen = Columns.of(depth, CAMERA)
    return CrossAttention(CAMERA.bev_px, seen.features.shape[-1], rng, value=value), seen


def test_cross_attention_is_the_scaled_dot_product():
    net, seen = learned(np.random.default_rng(0), value=(3, 2))
    values = torch.rand(*seen.features.shape[:2], 3)
    keys, queries = seen.features @ net.keys, net.queries.expand(len(values), -1, -1)
    for found, projected in (
        (net.aux(seen.features, values), values @ net.value),
        (net.zero(seen.features, values), values),
    ):
        torch.testing.assert_close(found, F.scaled_dot_product_attention(queries, keys, projected))


@given(SEEDS)
@settings(max_examples=20)
def test_total_variation_bounds_the_error_of_every_modality(seed):
    rng = np.random.default_rng(seed)
    gamma = correspondence(steps_of_depth(rng, 1), CAMERA)
    attention = torch.from_numpy(rng.normal(size=gamma.shape)).softmax(-1)
    bound = total_variation(attention, gamma)
    difference = attention - uniform_attention(gamma).double()
    seen = gamma.any(-1)
    values = torch.from_numpy(rng.random((len(gamma), gamma.shape[-1], 5)))
    assert ((difference @ values).abs() <= bound[..., None] + 1e-12)[seen].all()
    worst = (difference.clamp(min=0).sum(-1), (-difference).clamp(min=0).sum(-1))  # h = 1 if alpha is too large
    for reached in worst:
        torch.testing.assert_close(reached[seen], bound[seen])


def test_training_the_aux_stream_trains_the_zero_shot_stream():
    rng = np.random.default_rng(3)
    net, seen = learned(rng, value=(4, 4))
    uniform = uniform_attention(seen.gamma)
    shape = seen.features.shape[:2]
    aux, unseen = (torch.from_numpy(rng.random((*shape, 4)) < 0.5).float() for _ in range(2))
    translation = torch.from_numpy(rng.normal(size=(4, 4))).float()
    before = zero_shot_error(net, seen, unseen, uniform @ unseen)
    progress = train(net, net.aux, seen, aux, uniform @ aux @ translation, rng, steps=300, batch=64)
    assert progress.step == list(range(0, 301, 10))
    assert progress.divergence[-1] < 0.4 * progress.divergence[0] and progress.loss[-1] < 0.1 * progress.loss[0]
    assert zero_shot_error(net, seen, unseen, uniform @ unseen) < 0.4 * before
    # the translation of the modality is in the value projection, which the zero-shot stream does not use
    torch.testing.assert_close(net.value.detach(), translation, atol=0.3, rtol=0)
    assert divergence(net, seen) == pytest.approx(progress.divergence[-1], rel=0.2)


# --- max-pooling


def enumeration(inside: int, outside: int, white: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All binary values of a column, their probability, and the maximum over the pixels inside."""
    values = np.array(list(product((0.0, 1.0), repeat=inside + outside)))
    probability = np.prod(np.where(values > 0, white, 1 - white), axis=1)
    return values, probability, values[:, :inside].max(axis=1)


@pytest.mark.parametrize("white", [0.2, 0.5])
@pytest.mark.parametrize(("inside", "outside"), COUNTS)
def test_errors_in_closed_form_are_those_of_all_binary_values(inside, outside, white):
    values, probability, target = enumeration(inside, outside, white)
    weights = np.random.default_rng(0).normal(size=inside + outside)
    gamma = torch.arange(inside + outside) < inside
    exact = probability @ (values @ weights - target) ** 2
    assert float(expected_error(torch.from_numpy(weights), gamma, white)) == pytest.approx(exact)

    root = np.sqrt(probability)
    solution = np.linalg.lstsq(root[:, None] * values, root * target, rcond=None)[0]
    found, error = best_linear(inside, outside, white)
    np.testing.assert_allclose(found, solution, atol=1e-9)
    assert error == pytest.approx(probability @ (values @ solution - target) ** 2, abs=1e-12)
    assert (error > 1e-3) == (inside > 1)


@pytest.mark.parametrize("white", [0.2, 0.5])
@pytest.mark.parametrize(("inside", "outside"), COUNTS)
def test_the_best_attention_is_the_convex_optimum(inside, outside, white):
    values, probability, target = enumeration(inside, outside, white)
    count = inside + outside
    solved = minimize(
        lambda w: probability @ (values @ w - target) ** 2,
        np.full(count, 1 / count),
        bounds=[(0, 1)] * count,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1},
        options={"ftol": 1e-14},
    )
    weights, error = best_attention(inside, outside, white)
    assert weights.min() >= 0 and weights.sum() == pytest.approx(1)
    assert error == pytest.approx(solved.fun, abs=1e-7)
    assert error >= best_linear(inside, outside, white)[1] - 1e-12


@pytest.mark.parametrize("inside", range(1, 7))
def test_the_worst_case_is_the_minimax(inside):
    values, _, target = enumeration(inside, 0, 0.5)
    # least e with |values w - target| <= e
    minus = -np.ones((len(values), 1))
    rows = np.block([[values, minus], [-values, minus]])
    objective, limits = np.append(np.zeros(inside), 1.0), np.concatenate([target, -target])
    free = [(None, None)] * inside + [(0, None)]
    assert linprog(objective, rows, limits, bounds=free).fun == pytest.approx(worst_case(inside), abs=1e-9)
    one = np.append(np.ones(inside), 0.0)[None]
    convex = linprog(objective, rows, limits, A_eq=one, b_eq=[1.0], bounds=[(0, None)] * (inside + 1))
    assert convex.fun == pytest.approx(worst_case_attention(inside), abs=1e-9)


# --- attention of a trained network


def looking_at(position: torch.Tensor, rows: range, stride: int, wanted: torch.Tensor) -> torch.Tensor:
    """An attention of one head on a feature with a pixel of its position.

    position: (H, W); wanted: (H, W) bool, pixels to attend to for positions without pixels. Without such a pixel, all
    attention is on the top row.
    """
    size = -(-position.shape[0] // stride)
    weights = torch.zeros(size, 1, len(rows), size)
    for column, (p, row) in product(range(size), enumerate(rows)):
        part = slice(column * stride, (column + 1) * stride)
        falls = (position[:, part] == row).any(1)
        chosen = falls if falls.any() else wanted[:, part].any(1)
        weights[column, 0, p, int(chosen.nonzero()[0, 0]) // stride if chosen.any() else 0] = 1
    return weights


@pytest.mark.parametrize("knows_depth", (True, False))
def test_attention_is_measured_on_floor_raised_and_hidden_cells(knows_depth, monkeypatch):
    scale = replace(config.scale("smoke"), camera=CameraConfig(fpv_px=32, bev_px=20))
    net = build("c", scale.camera, replace(scale.model, heads=1))
    # a level floor up to 4 m; in the left half a box at 2 m hides the floor behind it
    depth = flat_floor(scale.camera).clamp(max=4.0)
    floor = depth < 4.0
    box = (torch.arange(32)[:, None] >= 8) & (torch.arange(32) < 16) & (depth > 2.0)
    depth, floor = torch.where(box, 2.0, depth), floor & ~box
    position = positions(depth, scale.camera)
    bands = [
        BandAttention([], [], [looking_at(position if knows_depth else position.flip(0), rows, stride, floor)])
        for rows, stride in zip(band_rows(scale.camera, scale.model.band_edges_m), (16, 8, 4, 2))
    ]
    monkeypatch.setattr(net, "attention", lambda *_: bands)
    found = attended(net, torch.zeros(1, 3, 32, 32), torch.zeros(1, 1, 32, 32), depth[None], floor[None])
    share = found["share"].unstack("cells are").droplevel("head")
    cells = found["cells"].unstack("cells are").droplevel("head")
    if knows_depth:
        assert (share.stack().dropna() == 1).all() and share.loc[2].notna().all()
    else:
        assert share.loc[1:, "floor"].max() < 0.5
    # the box hides floor behind it: in its own columns, farther than 2 m and nearer than the wall at 4 m
    assert cells["hidden"].tolist()[:2] == [0, 0] and cells["hidden"].sum() > 0
    assert cells["raised"].sum() > 0 and cells.loc[0, "floor"] == 0  # nearer floor is below the image


def flat_floor(camera: CameraConfig) -> torch.Tensor:
    """Planar depth (H, W) of a level floor, 50 m above the horizon."""
    below = (torch.arange(camera.fpv_px) + 0.5 - camera.fpv_px / 2).clamp(min=1e-3)
    depth = camera.focal_px * camera.height_m / below
    return depth.clamp(max=50.0)[:, None].expand(-1, camera.fpv_px).contiguous()


def test_a_column_of_attention_is_a_distribution_over_image_rows():
    scale = config.scale("smoke")
    net = build("c", scale.camera, scale.model).eval()
    rgb, zero = torch.rand(1, 3, 32, 32), torch.rand(1, 1, 32, 32)
    columns_of_attention = [column_attention(net, rgb, zero, column) for column in (0, 1, 16)]
    for weights in columns_of_attention:
        assert weights.shape == (scale.model.heads, 20, 32)
        torch.testing.assert_close(weights.sum(-1), torch.ones(weights.shape[:2]))
    assert torch.equal(columns_of_attention[0], columns_of_attention[1])  # one feature at every stride
    far = net.attention(rgb, zero)[-1].cross[-1]  # (16, heads, P, 16): the farthest band uses the finest map
    torch.testing.assert_close(columns_of_attention[2][:, 0, ::2] * 2, far[8, :, 0])
