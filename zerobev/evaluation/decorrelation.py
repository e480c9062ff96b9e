"""Decorrelation, measured: the information of a scene about M_zero without I_zero (paper, Section 3.2, P3).

If the RGB image predicts M_zero, a network may learn to ignore I_zero. A *descriptor* stands for the content of the
image: one integer per map cell, such as its class or its colour. Two numbers measure the dependence of a binary map on
a descriptor: their mutual information, in bits, and the ROC-AUC of a predictor that knows the fraction of white cells
per value of the descriptor in other views.

All cells of a view have one texture, and with one texture per scene so have all views of the scene: they are not
independent samples. The null distribution therefore exchanges the maps of whole *groups* of views.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.evaluation.metrics import INTERVAL
from zerobev.geometry.projection import cells_of_pixels

#: Number of steps per colour channel in `colour_of_cells`.
_SHADES = 4
#: Number of distances from the edge of a class in `shape_of_cells`.
_DISTANCES = 4


@dataclass(frozen=True)
class Measure:
    """The dependence of maps on a descriptor, and its null distribution."""

    own: float  #: with each view's own map
    exchanged: float  #: with the map of another view: chance
    differences: np.ndarray  #: (draws,) own - exchanged, with the two swapped at random for each pair of groups

    @property
    def excess(self) -> float:
        """own - exchanged; 0 on average if maps do not depend on the descriptor."""
        return self.own - self.exchanged

    @property
    def p_value(self) -> float:
        """Probability of at least this excess if maps do not depend on the descriptor."""
        # not "differences >= excess": NaN must count as no evidence
        return float((1 + np.count_nonzero(~(self.differences < self.excess))) / (1 + len(self.differences)))

    def chance(self) -> tuple[float, float]:
        """Interval that holds `own` with a probability of 90 % if maps do not depend on the descriptor."""
        low, high = np.quantile(self.differences, INTERVAL)
        return self.exchanged + float(low), self.exchanged + float(high)


def dependence(
    maps: np.ndarray,
    descriptor: np.ndarray,
    valid: np.ndarray,
    groups: np.ndarray,
    draws: int,
    rng: np.random.Generator,
) -> tuple[Measure, Measure]:
    """Mutual information in bits, and AUC of the prediction, of `maps` given `descriptor`.

    maps: (V, M, M) bool
    descriptor: (V, M, M) int >= 0; negative: unknown
    valid: (V, M, M) bool, the cells that count
    groups: (V,) int, equal for views with dependent textures: the index of the view if each view has a fresh texture,
        the index of the scene for one texture per scene
    draws: number of draws of the null distribution

    Groups are paired at random, and each view with a view of the other group. The two exchange their maps; cells that
    are valid in both count. If maps are independent of the content of their views, both assignments are equally likely:
    a draw of the null distribution flips a coin for each pair of groups. Maps keep their frame, so a variation of both
    M_zero and scenes from near to far is no dependence. Any other trace of geometry is one: a map that is black outside
    the visible area depends on the scene.

    The predictor is fitted on every other pair of groups and scored on the rest, then the other way round. Information
    is the plug-in estimate minus its bias, which the same two halves of the data show. It is 0 on average for
    independent maps, even if the cells of a view depend on each other, and may be negative.

    Raises `InputError` for arrays of different shapes, and for less than four groups.
    """
    if not maps.shape == descriptor.shape == valid.shape or groups.shape != maps.shape[:1]:
        shapes = [array.shape for array in (maps, descriptor, valid, groups)]
        raise InputError(f"maps: expected descriptor and valid of the same shape and a group per view, found {shapes}")
    members = [np.flatnonzero(groups == group) for group in rng.permutation(np.unique(groups))]
    if len(members) < 4:
        raise InputError(f"groups: expected at least 4, found {len(members)}")
    values = int(descriptor.max()) + 1
    known = valid & (descriptor >= 0)
    own, exchanged = [], []  # one contingency table per pair of groups
    for one, other in zip(members[0::2], members[1::2]):
        count = min(len(one), len(other))
        here = np.concatenate([one[:count], other[:count]])
        there = np.concatenate([other[:count], one[:count]])
        common = known[here] & known[there]
        own.append(contingency(maps[here], descriptor[here], common, values))
        exchanged.append(contingency(maps[there], descriptor[here], common, values))
    coins = rng.integers(2, size=(draws + 1, len(own)))
    coins[0] = 0  # the data themselves
    observed = _measured(np.array(own), np.array(exchanged), coins)
    swapped = _measured(np.array(own), np.array(exchanged), 1 - coins)
    bits, auc = (Measure(a[0], b[0], a[1:] - b[1:]) for a, b in zip(observed, swapped))
    return bits, auc


def _measured(own: np.ndarray, exchanged: np.ndarray, coins: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bits and AUC per row of `coins` (draws, pairs): 0 takes a table of `own` (pairs, values, 2), 1 of `exchanged`."""
    change = exchanged - own
    first, second = (
        own[half::2].sum(axis=0) + np.tensordot(coins[:, half::2], change[half::2], axes=1) for half in (0, 1)
    )
    auc = [(prediction_auc(a, b) + prediction_auc(b, a)) / 2 for a, b in zip(first, second)]
    # the bias of the plug-in estimate is twice as large for half of the data: extrapolated to no bias
    bits = 2 * mutual_information(first + second) - (mutual_information(first) + mutual_information(second)) / 2
    return bits, np.array(auc)


def contingency(maps: np.ndarray, descriptor: np.ndarray, valid: np.ndarray, values: int) -> np.ndarray:
    """(values, 2) int64: number of `valid` cells per value of the descriptor, black and white."""
    index = 2 * descriptor[valid].astype(np.int64) + maps[valid]
    return np.bincount(index, minlength=2 * values).reshape(values, 2)


def mutual_information(table: np.ndarray) -> np.ndarray:
    """Plug-in mutual information of rows and columns of contingency tables (..., values, 2): (...) float64, bits.

    It is at least 0, and biased upwards: compare it with a null distribution.
    """
    joint = table / np.maximum(table.sum(axis=(-2, -1), keepdims=True), 1)
    independent = joint.sum(axis=-1, keepdims=True) * joint.sum(axis=-2, keepdims=True)
    ratio = np.divide(joint, independent, out=np.ones_like(joint), where=joint > 0)
    return (joint * np.log2(ratio)).sum(axis=(-2, -1))


def prediction_auc(fitted: np.ndarray, scored: np.ndarray) -> float:
    """ROC-AUC on one contingency table of the frequency of white per value in another table.

    fitted, scored: (values, 2). The score of a value without fitted cells is the overall frequency of white. NaN if all
    scored cells are white, or none is.
    """
    overall = fitted[:, 1].sum() / max(fitted.sum(), 1)
    score = (fitted[:, 1] + overall) / (fitted.sum(axis=1) + 1)
    _, level = np.unique(score, return_inverse=True)
    black, white = (np.bincount(level, weights=column) for column in scored.T)
    if not black.sum() or not white.sum():
        return float("nan")
    below = np.cumsum(black) - black / 2  # a tie counts for one half
    return float(white @ below / (white.sum() * black.sum()))


def class_of_cells(classes: torch.Tensor) -> np.ndarray:
    """(B, M, M) int64: class of each cell, K for none; classes: (B, K, M, M) float32 masks."""
    found, label = classes.max(dim=1)
    return torch.where(found > 0, label, classes.shape[1]).numpy()


def shape_of_cells(label: np.ndarray) -> np.ndarray:
    """Class and distance from its edge: (B, M, M) int64, label * 4 + whole cells to another class (at most 3).

    label: (B, M, M) int, see `class_of_cells`; the border of the map is no edge
    """
    shapes = np.empty_like(label)
    for label_of_view, shape in zip(label, shapes):
        distance = np.full(shape.shape, np.inf)
        for value in np.unique(label_of_view):
            inside = label_of_view == value
            if not inside.all():
                distance[inside] = ndimage.distance_transform_cdt(inside)[inside]
        shape[:] = label_of_view * _DISTANCES + np.minimum(distance - 1, _DISTANCES - 1)
    return shapes


def colour_of_cells(rgb: torch.Tensor, depth: torch.Tensor, camera: CameraConfig) -> np.ndarray:
    """Mean RGB colour of the pixels per cell, in 64 steps: (B, M, M) int64, -1 for a cell without pixels.

    rgb: (B, 3, H, W) floating point in [0, 1]; depth: (B, 1, H, W), metres. P^-1 gives the cell of each pixel.
    Raises `InputError` for integers, such as the bytes of a batch before `data.samples.as_float`.
    """
    if not rgb.is_floating_point():
        raise InputError(f"rgb: expected floating point in [0, 1], found {rgb.dtype}")
    cells = camera.bev_px**2
    cell = cells_of_pixels(depth[:, 0], camera).flatten(1)
    index = (cell + torch.arange(len(cell))[:, None] * (cells + 1)).flatten().numpy()
    pixels = np.bincount(index, minlength=len(rgb) * (cells + 1))
    step = np.zeros(len(pixels), np.int64)
    for channel in rgb.unbind(1):
        mean = np.bincount(index, weights=channel.flatten().numpy(), minlength=len(pixels)) / np.maximum(pixels, 1)
        step = step * _SHADES + np.minimum((mean * _SHADES).astype(np.int64), _SHADES - 1)
    return np.where(pixels > 0, step, -1).reshape(len(rgb), -1)[:, :-1].reshape(len(rgb), camera.bev_px, camera.bev_px)
