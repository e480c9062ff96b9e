"""Simulated depth cameras: range, holes, and errors that grow with distance."""

import numpy as np
import pytest

from zerobev.data.sensor_depth import exaggerated, mixed_depth, sensor_depth

GREY = np.full((64, 64, 3), 128, np.uint8)


def measured(metres: float, rgb: np.ndarray = GREY) -> np.ndarray:
    """(20, 64, 64) measurements of a wall."""
    rng = np.random.default_rng(0)
    return np.stack([sensor_depth(np.full((64, 64), metres, np.float32), rgb, rng) for _ in range(20)])


def test_errors_grow_with_the_square_of_the_distance():
    errors = []
    for metres in (1.0, 2.0, 4.0):
        values = measured(metres)
        assert 0.7 < (values > 0).mean() < 1
        errors.append(np.abs(values[values > 0] - metres).mean())
    assert 3 < errors[1] / errors[0] < 6 and 3 < errors[2] / errors[1] < 6


def test_surfaces_out_of_range_and_black_ones_are_lost():
    assert not measured(7.0).any() and not measured(0.2).any()
    assert (measured(2.0, np.zeros_like(GREY)) > 0).mean() < 0.4


def test_values_are_lost_at_edges_and_nowhere_invented():
    depth = np.full((64, 64), 2.0, np.float32)
    depth[:, 32:] = 4.0
    depth[:8] = 0.0
    values = np.stack([sensor_depth(depth, GREY, np.random.default_rng(seed)) for seed in range(20)])
    assert not values[:, :7].any()
    edge, inside = (values[:, 12:, columns] > 0 for columns in (slice(31, 34), slice(8, 24)))
    assert edge.mean() < inside.mean() - 0.2


@pytest.mark.parametrize("power", [1.0, 1.5, 2.0])
def test_exaggeration_multiplies_the_logarithm_of_the_error(power):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 5, (64, 64)).astype(np.float32)
    depth[:4] = 0
    estimated = np.exp(rng.normal(0.2, 0.3, depth.shape)).astype(np.float32) * np.where(depth > 0, depth, 2.0)
    found = exaggerated(estimated, depth, power)
    np.testing.assert_array_equal(found[:4], estimated[:4].astype(np.float32))
    errors = np.log(found[4:] / depth[4:]), np.log(estimated[4:] / depth[4:])
    np.testing.assert_allclose(errors[0], power * errors[1], rtol=1e-4, atol=1e-5)


def test_mixed_depth_has_all_qualities_with_larger_errors_of_estimates():
    depth = np.full((64, 64), 2.0, np.float32)
    estimated = np.full_like(depth, 2.4)
    found = [mixed_depth(depth, estimated, GREY, np.random.default_rng(seed))[0] for seed in range(400)]
    whole = np.array([one.flat[0] for one in found if (one == one.flat[0]).all()])
    errors = np.unique(whole[whole > 2.1])  # estimates alone: measured depth is not the same everywhere
    assert (whole == 0).mean() > 0.1 and (whole == 2.0).mean() > 0.1
    assert errors.min() == pytest.approx(2.4, abs=0.02) and errors.max() == pytest.approx(2.4 * 1.2**0.6, abs=0.02)
    assert 160 < len(errors) < 240  # half of the samples
