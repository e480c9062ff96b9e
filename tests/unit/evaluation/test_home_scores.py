"""IoU and boundary F1 of whole maps: by hand, and against distances between all boundary cells."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays
from scipy.ndimage import binary_erosion
from scipy.spatial.distance import cdist

from zerobev.evaluation.home_scores import HomeScores

EVERYWHERE = np.ones((6, 8), bool)
MASKS = arrays(bool, (2, 6, 8))


def rectangle(top: int, bottom: int, left: int, right: int) -> np.ndarray:
    mask = np.zeros((1, 6, 8), bool)
    mask[0, top:bottom, left:right] = True
    return mask


def test_a_shifted_rectangle_by_hand():
    target = rectangle(1, 5, 1, 5)  # 4 x 4, with a boundary of 12 cells
    for shift, iou, right in ((0, 1, 12), (1, 12 / 20, 12), (3, 4 / 28, 8)):
        scores = HomeScores.of(rectangle(1, 5, 1 + shift, 5 + shift), target, EVERYWHERE)
        assert scores.iou() == pytest.approx([iou])
        if shift < 2:
            assert scores.boundary_f1() == pytest.approx([right / 12])
        else:  # of columns 4 to 7 and 1 to 4, those within a cell of the other boundary
            assert scores.precision.intersection[0, 0] == scores.recall.intersection[0, 0] < 12


@given(MASKS, MASKS, arrays(bool, (6, 8)))
def test_boundaries_against_all_distances(predicted, target, region):
    scores = HomeScores.of(predicted, target, region)
    for k in range(2):
        one, two = (np.argwhere(mask & ~binary_erosion(mask)) for mask in (predicted[k] & region, target[k] & region))
        near = cdist(one, two, "chebyshev") <= 1
        assert scores.precision.union[0, k] == len(one) and scores.recall.union[0, k] == len(two)
        assert scores.precision.intersection[0, k] == near.any(axis=1).sum()
        assert scores.recall.intersection[0, k] == near.any(axis=0).sum()
    assert np.array_equal(scores.area.intersection[0], (predicted & target & region).sum(axis=(1, 2)))


def test_classes_that_are_missing():
    scores = HomeScores.of(
        np.concatenate([rectangle(0, 0, 0, 0), rectangle(0, 0, 0, 0), rectangle(1, 5, 1, 5)]),
        np.concatenate([rectangle(0, 0, 0, 0), rectangle(1, 5, 1, 5), rectangle(0, 0, 0, 0)]),
        EVERYWHERE,
    )
    assert np.isnan([scores.iou()[0], scores.boundary_f1()[0]]).all()  # neither present nor predicted
    assert scores.iou()[1:].tolist() == scores.boundary_f1()[1:].tolist() == [0, 0]


def test_homes_are_counted_together_and_survive_json():
    target = rectangle(1, 5, 1, 5)
    homes = [HomeScores.of(target, target, EVERYWHERE), HomeScores.of(rectangle(0, 0, 0, 0), target, EVERYWHERE)]
    both = HomeScores.from_json(HomeScores.joined(homes).to_json())
    assert both.area.union.tolist() == [[16], [16]] and both.iou() == pytest.approx([0.5])
    assert both.boundary_f1() == pytest.approx([2 * 1 * 0.5 / 1.5])  # all predicted cells are right, half are found
