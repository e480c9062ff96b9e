"""Intersection over union, kept as counts per test scene, and intervals from resampling scenes.

The two averages are the paper's (supplement, "Metrics"). Counts are exact integers, so that they merge in
any order, survive JSON, and give any average or interval later without the predictions. torchmetrics'
`JaccardIndex` keeps one confusion matrix for all images; one object a scene, with its state read back
out, would be longer than these sums. The tests hold the two against each other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from zerobev.common.errors import InputError

#: From intersections and unions (..., K) to a value (...), or a value of each class (..., K).
Statistic = Callable[[np.ndarray, np.ndarray], np.ndarray]


def iou_per_class(intersection: np.ndarray, union: np.ndarray) -> np.ndarray:
    """(..., K) counts -> (..., K) float64; a class that is neither present nor predicted is NaN."""
    return np.divide(intersection, union, out=np.full(np.shape(union), np.nan), where=np.asarray(union) > 0)


def class_iou(intersection: np.ndarray, union: np.ndarray) -> np.ndarray:
    """(..., K) counts -> (...) mean of the classes' IoU; NaN classes are left out, NaN if all are."""
    seen = (np.asarray(union) > 0).sum(axis=-1)
    total = np.nansum(iou_per_class(intersection, union), axis=-1)
    return np.divide(total, seen, out=np.full(np.shape(seen), np.nan), where=seen > 0)


def pixel_iou(intersection: np.ndarray, union: np.ndarray) -> np.ndarray:
    """(..., K) counts -> (...) sum of all intersections over sum of all unions; NaN if there are none."""
    return iou_per_class(np.sum(intersection, axis=-1), np.sum(union, axis=-1))


@dataclass(frozen=True, eq=False)
class Counts:
    """Cells of each test scene and class, summed over the scene's images."""

    intersection: np.ndarray  #: (S, K) int64, cells in both the true and the predicted mask
    union: np.ndarray  #: (S, K) int64, cells in either

    def __post_init__(self) -> None:
        intersection, union = self.intersection, self.union
        if intersection.ndim != 2 or intersection.shape != union.shape:
            raise InputError(f"counts: expected two equal shapes (S, K), found {intersection.shape} and {union.shape}")
        if intersection.dtype != np.int64 or union.dtype != np.int64:
            raise InputError(f"counts: expected int64, found {intersection.dtype} and {union.dtype}")
        if not ((intersection >= 0) & (intersection <= union)).all():
            raise InputError("counts: expected 0 <= intersection <= union, found a cell outside")

    @classmethod
    def empty(cls, scenes: int, classes: int) -> "Counts":
        """No image counted yet."""
        return cls(np.zeros((scenes, classes), np.int64), np.zeros((scenes, classes), np.int64))

    def __add__(self, other: "Counts") -> "Counts":
        """The counts of both sets of images; the scenes must be the same ones."""
        if self.union.shape != other.union.shape:
            raise InputError(f"counts: expected the shape {self.union.shape}, found {other.union.shape}")
        return Counts(self.intersection + other.intersection, self.union + other.union)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Counts)
            and np.array_equal(self.intersection, other.intersection)
            and np.array_equal(self.union, other.union)
        )

    def value(self, statistic: Statistic) -> np.ndarray:
        """`statistic` of all scenes together."""
        return statistic(self.intersection.sum(axis=0), self.union.sum(axis=0))

    def iou_per_class(self) -> np.ndarray:
        """(K,) float64; NaN for a class that is neither present nor predicted in any scene."""
        return self.value(iou_per_class)

    def class_iou(self) -> float:
        """Average class IoU: all classes weigh the same; those that are NaN are left out."""
        return float(self.value(class_iou))

    def pixel_iou(self) -> float:
        """Average pixel IoU: classes weigh by their area."""
        return float(self.value(pixel_iou))

    def to_json(self) -> dict[str, list[list[int]]]:
        """Plain lists, for a record."""
        return {"intersection": self.intersection.tolist(), "union": self.union.tolist()}

    @classmethod
    def from_json(cls, value: Any) -> "Counts":
        """The inverse of `to_json`."""
        try:
            return cls(*(np.array(value[name]) for name in ("intersection", "union")))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(f"counts: expected lists of integers `intersection` and `union`, found {error}") from error


def count(predicted: Tensor, target: Tensor, fov: Tensor, scene: Tensor, scenes: int) -> Counts:
    """Intersections and unions inside the FOV of a batch of binary maps.

    predicted: (B, K, M, M) bool
    target: (B, K, M, M) in {0, 1}
    fov: (B, 1, M, M) in {0, 1}
    scene: (B,) integers in [0, scenes)
    """
    if predicted.shape != target.shape:
        raise InputError(
            f"predicted: expected the target's shape {tuple(target.shape)}, found {tuple(predicted.shape)}"
        )
    if scene.numel() and not 0 <= int(scene.min()) <= int(scene.max()) < scenes:
        raise InputError(f"scene: expected ids in [0, {scenes}), found {int(scene.min())} to {int(scene.max())}")
    inside, truth = fov > 0.5, target > 0.5
    sums = [
        torch.zeros(scenes, target.shape[1], dtype=torch.int64, device=target.device).index_add_(
            0, scene.to(torch.int64), (cells & inside).sum(dim=(2, 3))
        )
        for cells in (predicted & truth, predicted | truth)
    ]
    return Counts(*(total.cpu().numpy() for total in sums))


def bootstrap_interval(
    counts: Sequence[Counts], statistic: Statistic, rng: np.random.Generator, level: float = 0.9, draws: int = 1000
) -> tuple[np.ndarray, np.ndarray]:
    """Percentile interval of the statistic's mean over seeds, from resampling test scenes and seeds with replacement.

    counts: one a seed, of the same scenes; every draw takes the same scenes from all of them
    statistic: `class_iou`, `pixel_iou` or `iou_per_class`, or another function of (..., K) counts
    Returns the lower and upper end that enclose the share `level` of `draws` draws.
    """
    (values,) = resampled_scenes([counts], statistic, rng, draws)
    low, high = np.nanquantile(values, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return low, high


def resampled_scenes(
    rows: Sequence[Sequence[Counts]], statistic: Statistic, rng: np.random.Generator, draws: int
) -> list[np.ndarray]:
    """The statistic's mean over seeds of several rows, (draws, ...) each, under resampling of test scenes and of seeds.

    rows: counts of each row, one a seed, all of the same scenes. They are paired: draw i takes the same scenes from
    all rows and seeds, so that differences and quotients of rows have intervals of their own. Seeds are drawn for each
    row by itself, as trainings are: what another training might have undone is then not certain. Of three seeds that
    is a rough measure, and of one none at all.
    """
    scenes = {len(one.union) for counts in rows for one in counts}
    if len(scenes) != 1 or 0 in scenes:
        raise InputError(f"counts: expected the same scenes in all, found {sorted(scenes)} scenes")
    (size,) = scenes
    weights = rng.multinomial(size, np.full(size, 1 / size), size=draws)  # how often each scene is in each draw
    means = []
    for counts in rows:
        values = np.stack([statistic(weights @ one.intersection, weights @ one.union) for one in counts])
        drawn = rng.integers(len(counts), size=values.shape[:2])
        means.append(values[drawn, np.arange(draws)].mean(axis=0))
    return means
