"""Simulated depth cameras: range, holes, and errors that grow with distance."""

import numpy as np

from zerobev.data.sensor_depth import sensor_depth

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
