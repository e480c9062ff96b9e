"""Decorrelation, measured: what a scene tells about M_zero when I_zero is not shown (paper, Section 3.2, P3).

Where M_zero can be told from the photograph, a network may learn to read it there and to ignore I_zero. What the
photograph shows is held as a *descriptor*: one integer a cell of the map, such as the class of what is there, or its
colour. Two numbers say how much a descriptor tells about a binary map: their mutual information, in bits, and the
ROC-AUC of the predictor that knows, for each value of the descriptor, how often it was white in other views.

Cells of a view wear one texture, and so do the views of a scene whose texture is kept: neither are independent
samples. What counts as chance is hence found by exchanging the maps of whole *groups* of views.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.geometry.projection import cells_of_pixels

#: Steps of each colour channel that `colour_of_cells` tells apart.
_SHADES = 4
#: Distances from the edge of a class that `shape_of_cells` tells apart, cells.
_DEEPEST = 4


@dataclass(frozen=True)
class Measure:
    """How much a descriptor tells about maps, and how much it tells about the maps of other views."""

    own: float  #: about each view's own map
    exchanged: float  #: about the map of another view, which is chance
    differences: np.ndarray  #: (draws,) own - exchanged if a coin decides for each pair which of the two is which

    @property
    def excess(self) -> float:
        """What is not chance; 0 on average if maps do not depend on the descriptor."""
        return self.own - self.exchanged

    @property
    def p_value(self) -> float:
        """Probability of at least this excess if maps do not depend on the descriptor."""
        # not "differences >= excess": a measure that is undefined is no evidence
        return float((1 + np.count_nonzero(~(self.differences < self.excess))) / (1 + len(self.differences)))

    def chance(self, level: float = 0.9) -> tuple[float, float]:
        """Interval that holds `own` with probability `level` if maps do not depend on the descriptor."""
        low, high = np.quantile(self.differences, [(1 - level) / 2, (1 + level) / 2])
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

    maps: (V, M, M) bool; descriptor: (V, M, M) int >= 0 (negative: unknown); valid: (V, M, M) bool, the cells that
    count; groups: (V,) int, equal for views whose textures are not independent of each other: the number of the view
    itself for a fresh texture a view, the number of the scene for one texture a scene.

    Groups are paired at random, and each view with one of the other group; cells count where both views are valid,
    and the two exchange their maps. If maps are independent of what their views show, a pair is as likely either way:
    a draw of the null distribution lets a coin decide for each pair of groups. Maps stay in their frame: that M_zero
    and scenes both vary from near to far is no dependence yet. Any other trace of geometry is one: a map that is black
    where the camera does not see depends on the scene, though its white says nothing of it. The predictor is fitted
    on every other pair of groups and scored on the rest, then the other way round. Information is the plug-in estimate,
    less its bias as the same two halves of the data show it: 0 on average for maps that are independent, whatever ties
    the cells of one view together, where one texture ends at the edge of an object, say; it may fall below 0.

    Raises `InputError` for arrays of different shapes, and for less than four groups.
    """
    if not maps.shape == descriptor.shape == valid.shape or groups.shape != maps.shape[:1]:
        shapes = [array.shape for array in (maps, descriptor, valid, groups)]
        raise InputError(f"maps: expected descriptor and valid of the same shape and a group a view, found {shapes}")
    members = [np.flatnonzero(groups == group) for group in rng.permutation(np.unique(groups))]
    if len(members) < 4:
        raise InputError(f"groups: expected at least 4, found {len(members)}")
    values = int(descriptor.max()) + 1
    known = valid & (descriptor >= 0)
    own, exchanged = [], []  # a contingency table a pair of groups
    for one, other in zip(members[0::2], members[1::2]):
        count = min(len(one), len(other))
        here = np.concatenate([one[:count], other[:count]])
        there = np.concatenate([other[:count], one[:count]])
        common = known[here] & known[there]
        own.append(contingency(maps[here], descriptor[here], common, values))
        exchanged.append(contingency(maps[there], descriptor[here], common, values))
    coins = rng.integers(2, size=(draws + 1, len(own)))
    coins[0] = 0  # nothing exchanged: the data as they are
    as_tossed = _measured(np.array(own), np.array(exchanged), coins)
    the_other_way = _measured(np.array(own), np.array(exchanged), 1 - coins)
    bits, auc = (Measure(a[0], b[0], a[1:] - b[1:]) for a, b in zip(as_tossed, the_other_way))
    return bits, auc


def _measured(own: np.ndarray, exchanged: np.ndarray, coins: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bits and AUC for each row of `coins` (draws, pairs): 0 takes the table of `own` (pairs, values, 2), else 1."""
    change = exchanged - own
    first, second = (
        own[half::2].sum(axis=0) + np.tensordot(coins[:, half::2], change[half::2], axes=1) for half in (0, 1)
    )
    auc = [(prediction_auc(a, b) + prediction_auc(b, a)) / 2 for a, b in zip(first, second)]
    # the plug-in estimate is too large by chance, and half of the data by twice as much: extrapolated to none
    bits = 2 * mutual_information(first + second) - (mutual_information(first) + mutual_information(second)) / 2
    return bits, np.array(auc)


def contingency(maps: np.ndarray, descriptor: np.ndarray, valid: np.ndarray, values: int) -> np.ndarray:
    """(values, 2) int64: how many of the `valid` cells have each descriptor, black and white."""
    index = 2 * descriptor[valid].astype(np.int64) + maps[valid]
    return np.bincount(index, minlength=2 * values).reshape(values, 2)


def mutual_information(table: np.ndarray) -> np.ndarray:
    """Plug-in mutual information of rows and columns of contingency tables (..., values, 2): (...) float64, bits.

    It is at least 0, and larger than that by chance: hold it against a null distribution.
    """
    joint = table / np.maximum(table.sum(axis=(-2, -1), keepdims=True), 1)
    independent = joint.sum(axis=-1, keepdims=True) * joint.sum(axis=-2, keepdims=True)
    ratio = np.divide(joint, independent, out=np.ones_like(joint), where=joint > 0)
    return (joint * np.log2(ratio)).sum(axis=(-2, -1))


def prediction_auc(fitted: np.ndarray, scored: np.ndarray) -> float:
    """ROC-AUC, on the cells of one contingency table, of predicting white by its frequency in another.

    Both are (values, 2). A value that was never seen is predicted as often as white is overall. NaN where all cells
    are white, or none is.
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
    """(B, M, M) int64: class of what is on each cell, K for none of them; classes: (B, K, M, M) float32 masks."""
    found, label = classes.max(dim=1)
    return torch.where(found > 0, label, classes.shape[1]).numpy()


def shape_of_cells(label: np.ndarray) -> np.ndarray:
    """Class and distance from its edge: (B, M, M) int64, label * 4 + whole cells to the next other class (at most 3).

    label: (B, M, M) int, as of `class_of_cells`; the rim of the map is no edge.
    """
    shapes = np.empty_like(label)
    for label_of_view, shape in zip(label, shapes):
        distance = np.full(shape.shape, np.inf)
        for value in np.unique(label_of_view):
            inside = label_of_view == value
            if not inside.all():
                distance[inside] = ndimage.distance_transform_cdt(inside)[inside]
        shape[:] = label_of_view * _DEEPEST + np.minimum(distance - 1, _DEEPEST - 1)
    return shapes


def colour_of_cells(rgb: torch.Tensor, depth: torch.Tensor, camera: CameraConfig) -> np.ndarray:
    """The photograph's mean colour on each cell, in 64 steps: (B, M, M) int64, -1 for a cell that no pixel falls into.

    rgb: (B, 3, H, W) in [0, 1]; depth: (B, 1, H, W), metres: pixels are put on the map as in P^-1.
    """
    cells = camera.bev_px**2
    cell = cells_of_pixels(depth[:, 0], camera).flatten(1)
    place = (cell + torch.arange(len(cell))[:, None] * (cells + 1)).flatten().numpy()
    pixels = np.bincount(place, minlength=len(rgb) * (cells + 1))
    step = np.zeros(len(pixels), np.int64)
    for channel in rgb.unbind(1):
        mean = np.bincount(place, weights=channel.flatten().numpy(), minlength=len(pixels)) / np.maximum(pixels, 1)
        step = step * _SHADES + np.minimum((mean * _SHADES).astype(np.int64), _SHADES - 1)
    return np.where(pixels > 0, step, -1).reshape(len(rgb), -1)[:, :-1].reshape(len(rgb), camera.bev_px, camera.bev_px)
