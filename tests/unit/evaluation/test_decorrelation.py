"""Decorrelation: closed forms, uniform p-values without dependence, and planted dependence that is found."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import ndimage, stats

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.evaluation.decorrelation import (
    Measure,
    class_of_cells,
    colour_of_cells,
    contingency,
    dependence,
    mutual_information,
    prediction_auc,
    shape_of_cells,
)
from zerobev.geometry.projection import cells_of_pixels

SIDE = 12

tables = hnp.arrays(np.int64, st.tuples(st.integers(1, 6), st.just(2)), elements=st.integers(0, 50))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def entropy(fraction: float) -> float:
    return -fraction * np.log2(fraction) - (1 - fraction) * np.log2(1 - fraction)


def blobs(count: int, rng: np.random.Generator, sigma: float = 2.0) -> np.ndarray:
    """(count, SIDE, SIDE) bool: smooth random textures, half white; the cells of one are dependent."""
    noise = rng.standard_normal((count, SIDE, SIDE))
    return ndimage.gaussian_filter(noise, (0, sigma, sigma), mode="wrap") > 0


def furniture(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, SIDE, SIDE) int in 0..3: large regions, like classes."""
    return 2 * blobs(count, rng).astype(int) + blobs(count, rng)


# mutual information


@pytest.mark.parametrize("error", [0.01, 0.1, 0.3, 0.5])
def test_information_of_a_noisy_channel(error):
    table = np.round(1e8 * np.array([[1 - error, error], [error, 1 - error]]))
    assert mutual_information(table) == pytest.approx(1 - entropy(error), abs=1e-6)


@pytest.mark.parametrize("fraction", [0.05, 0.2, 0.5])
def test_information_of_a_map_that_follows_from_its_descriptor(fraction):
    white = round(fraction * 1000)
    table = np.array([[1000 - white, 0], [0, white - 10], [0, 10], [0, 0]])
    assert mutual_information(table) == pytest.approx(entropy(fraction))
    assert prediction_auc(table, table) == 1


@given(tables)
def test_information_is_entropy_minus_conditional_entropy(table):
    if table.sum():
        parts = [stats.entropy(part.ravel(), base=2) for part in (table.sum(axis=0), table.sum(axis=1), table)]
        assert mutual_information(table) == pytest.approx(parts[0] + parts[1] - parts[2], abs=1e-9)
    else:
        assert mutual_information(table) == 0


@given(tables)
def test_a_coarser_descriptor_has_no_more_information(table):
    coarser = np.concatenate([table[:1] + table[-1:], table[1:-1]])
    assert mutual_information(coarser) <= mutual_information(table) + 1e-9


# prediction


@given(tables, st.data())
def test_auc_is_the_chance_to_rank_a_pair_rightly(fitted, data):
    scored = data.draw(hnp.arrays(np.int64, fitted.shape, elements=st.integers(0, 9)))
    auc = prediction_auc(fitted, scored)
    overall = fitted[:, 1].sum() / max(fitted.sum(), 1)
    score = [(white + overall) / (black + white + 1) for black, white in fitted]
    rows = range(len(fitted))
    ranked = [(scored[i, 1] * scored[j, 0], np.sign(score[i] - score[j])) for i in rows for j in rows]
    pairs = sum(count for count, _ in ranked)
    if pairs:
        assert auc == pytest.approx(sum(count * (1 + sign) / 2 for count, sign in ranked) / pairs)
    else:
        assert np.isnan(auc)


def test_values_without_fitted_cells_have_an_auc_of_one_half():
    fitted = np.array([[50, 50], [0, 0], [0, 0]])
    assert prediction_auc(fitted, np.array([[0, 0], [3, 9], [5, 1]])) == 0.5


def test_contingency_counts_valid_cells(rng):
    maps, descriptor, valid = blobs(3, rng), furniture(3, rng), blobs(3, rng)
    table = contingency(maps, descriptor, valid, 5)
    for value in range(5):
        for white in (0, 1):
            assert table[value, white] == (valid & (descriptor == value) & (maps == white)).sum()


# null distribution


def p_values(scenes: int, views: int, grouped: bool, draws: int = 39) -> np.ndarray:
    """(60, 2) p-values of both numbers for textures independent of the furniture, both fixed per scene."""
    found = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        maps, descriptor = (np.repeat(make(scenes, rng), views, axis=0) for make in (blobs, furniture))
        scene = np.repeat(np.arange(scenes), views)
        groups = scene if grouped else np.arange(scenes * views)
        measures = dependence(maps, descriptor, np.ones_like(maps), groups, draws, rng)
        found.append([measure.p_value for measure in measures])
    return np.array(found)


def is_uniform(p: np.ndarray, draws: int = 39) -> bool:
    """Whether p-values could be uniform on 1/(draws + 1), ..., 1."""
    spread = p - np.random.default_rng(0).random(len(p)) / (draws + 1)
    return stats.kstest(spread, "uniform").pvalue > 0.01


@pytest.mark.parametrize("scenes,views", [(24, 1), (12, 4)])
def test_p_values_of_independent_textures_are_uniform(scenes, views):
    """Although neither the cells of a view nor the views of a scene are independent."""
    for p in p_values(scenes, views, grouped=True).T:
        assert is_uniform(p)


def test_views_that_share_a_texture_are_no_independent_samples():
    """The reason for groups: with one texture per scene, views taken as independent show a false dependence."""
    assert not is_uniform(p_values(12, 6, grouped=False)[:, 0])


def test_textures_that_end_at_the_edges_of_objects_are_no_dependence():
    """As charts of an atlas do: a class then has one texture per view."""
    bits, auc = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        descriptor = furniture(24, rng)
        maps = np.take_along_axis(rng.random((24, 4)) < 0.3, descriptor.reshape(24, -1), axis=1).reshape(
            descriptor.shape
        )
        measures = dependence(maps, descriptor, np.ones_like(maps), np.arange(24), 1, rng)
        bits.append(measures[0].own)
        auc.append(measures[1].own)
    for found, chance in ((bits, 0), (auc, 0.5)):
        assert abs(np.mean(found) - chance) < 2.5 * np.std(found) / np.sqrt(len(found))


def planted(error: float, rng: np.random.Generator, draws: int = 99) -> tuple[Measure, Measure]:
    """Maps that are one class of the furniture (a quarter of the cells), with a fraction of wrong cells."""
    descriptor = furniture(40, rng)
    maps = (descriptor == 2) ^ (rng.random(descriptor.shape) < error)
    return dependence(maps, descriptor, np.ones_like(maps), np.arange(40), draws, rng)


@pytest.mark.parametrize("error", [0.0, 0.05, 0.2])
def test_a_planted_dependence_is_found_and_sized(error, rng):
    bits, auc = planted(error, rng)
    assert bits.p_value == auc.p_value == 0.01
    # probability of white: 1 - error in the class, error elsewhere
    white = 0.25 * (1 - error) + 0.75 * error
    conditional = entropy(error) if error else 0
    assert bits.own == pytest.approx(entropy(white) - conditional, abs=0.08)
    # probability of the class in a white cell, in a black cell
    hit, alarm = 0.25 * (1 - error) / white, 0.25 * error / (1 - white)
    assert auc.own == pytest.approx(0.5 + (hit - alarm) / 2, abs=0.03)
    # exchanged maps show no dependence
    assert bits.exchanged < 0.02 and abs(auc.exchanged - 0.5) < 0.1
    for measure in (bits, auc):
        low, high = measure.chance()
        assert low < measure.exchanged < high < measure.own
        assert np.mean(measure.differences > 0) == pytest.approx(0.5, abs=0.2)


def test_a_common_variation_with_map_position_is_no_dependence(rng):
    """Classes and textures may both change from near to far: exchanged maps do so too."""
    far = np.arange(SIDE)[:, None] / SIDE
    descriptor = (rng.random((40, SIDE, SIDE)) < far).astype(int)
    maps = rng.random((40, SIDE, SIDE)) < far
    bits, auc = dependence(maps, descriptor, np.ones_like(maps), np.arange(40), 99, rng)
    assert bits.own > 0.05 and auc.own > 0.6
    assert bits.p_value > 0.05 and auc.p_value > 0.05


def test_cells_that_are_not_valid_or_not_known_do_not_count(rng):
    descriptor = furniture(20, rng)
    valid = rng.random(descriptor.shape) < 0.9
    known = rng.random(descriptor.shape) < 0.9
    maps = blobs(20, rng)
    spoiled = np.where(valid & known, maps, descriptor == 2)
    a, b = (
        dependence(m, np.where(known, descriptor, -1), valid, np.arange(20), 20, np.random.default_rng(0))
        for m in (maps, spoiled)
    )
    for one, other in zip(a, b):
        assert (one.own, one.exchanged) == (other.own, other.exchanged)
        assert np.array_equal(one.differences, other.differences)


def test_groups_of_different_sizes_and_an_odd_one(rng):
    groups = np.array([0] * 5 + [1] * 2 + [2] * 4 + [3] * 3 + [4] * 6)
    descriptor = furniture(len(groups), rng)
    bits, auc = dependence(descriptor > 1, descriptor, np.ones(descriptor.shape, bool), groups, 50, rng)
    assert auc.own == 1
    assert 0.1 < bits.p_value < 0.5  # 2 pairs: one outcome of the coins in four is the observed one


def test_an_undefined_measure_is_no_evidence(rng):
    descriptor = furniture(8, rng)
    maps = np.zeros(descriptor.shape, bool)
    bits, auc = dependence(maps, descriptor, ~maps, np.arange(8), 20, rng)
    assert np.isnan(auc.own) and auc.p_value == 1
    assert bits.own == pytest.approx(0) and bits.p_value == 1


def test_bad_input_is_named(rng):
    maps = blobs(6, rng)
    with pytest.raises(InputError, match="groups: expected at least 4, found 3"):
        dependence(maps, maps.astype(int), maps, np.arange(6) // 2, 5, rng)
    with pytest.raises(InputError, match="same shape"):
        dependence(maps, maps[:5].astype(int), maps, np.arange(6), 5, rng)
    with pytest.raises(InputError, match="a group per view"):
        dependence(maps, maps.astype(int), maps, np.arange(5), 5, rng)


# descriptors


def test_class_of_a_cell():
    classes = torch.zeros(2, 3, 4, 4)
    classes[0, 1, 2, 3] = classes[1, 0, 0, 0] = classes[1, 2, 3] = 1
    label = class_of_cells(classes)
    expected = np.full((2, 4, 4), 3)
    expected[0, 2, 3], expected[1, 0, 0], expected[1, 3] = 1, 0, 2
    assert np.array_equal(label, expected)


def test_shape_is_class_and_distance_from_its_edge(rng):
    label = np.concatenate([furniture(3, rng), np.ones((1, SIDE, SIDE), int)])
    shape = shape_of_cells(label)
    for view, of_view in zip(label, shape):
        for cell, value in np.ndenumerate(of_view):
            others = np.argwhere(view != view[cell])
            nearest = np.abs(others - cell).max(axis=1).min() if len(others) else np.inf
            assert value == view[cell] * 4 + min(nearest - 1, 3)


def test_colour_of_a_cell_is_the_mean_of_its_pixels(rng):
    camera = CameraConfig(fpv_px=16, bev_px=10)
    rgb = torch.from_numpy(rng.random((2, 3, 16, 16), np.float32))
    depth = torch.from_numpy(rng.uniform(0, 6, (2, 1, 16, 16)).astype(np.float32))
    colour = colour_of_cells(rgb, depth, camera)
    for b in range(2):
        place = cells_of_pixels(depth[b, 0], camera)
        for cell in range(camera.bev_px**2):
            pixels = rgb[b][:, place == cell]
            value = colour[b].flat[cell]
            if pixels.shape[1] == 0:
                assert value == -1
            else:
                red, green, blue = (int(4 * mean) for mean in pixels.mean(dim=1))
                assert value == 16 * red + 4 * green + blue
    white = colour_of_cells(torch.ones_like(rgb), depth, camera)
    assert set(np.unique(white)) == {-1, 63}
    with pytest.raises(InputError, match=r"rgb: expected floating point in \[0, 1\], found torch.uint8"):
        colour_of_cells((255 * rgb).to(torch.uint8), depth, camera)
