"""Intersection over union from counts per test scene, and bootstrap intervals over scenes.

The two averages are the paper's (supplement, "Metrics"). Counts are exact integers: they add up in any order, survive
JSON, and give any average or interval later without the predictions. `JaccardIndex` of torchmetrics has one confusion
matrix for all images; one object per scene would take more code than these sums. The tests compare the two.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from zerobev.common.errors import InputError

#: Quantiles that bound all 90 % intervals.
INTERVAL = ((1 - 0.9) / 2, (1 + 0.9) / 2)
#: Draws of a bootstrap.
DRAWS = 1000
#: From intersections and unions (..., K) to a value (...), or a value per class (..., K).
Statistic = Callable[[np.ndarray, np.ndarray], np.ndarray]


def iou_per_class(intersection: np.ndarray, union: np.ndarray) -> np.ndarray:
    """(..., K) counts -> (..., K) float64; NaN for a class that is neither present nor predicted."""
    return np.divide(intersection, union, out=np.full(np.shape(union), np.nan), where=np.asarray(union) > 0)


def class_iou(intersection: np.ndarray, union: np.ndarray) -> np.ndarray:
    """(..., K) counts -> (...) mean IoU of the classes without NaN; NaN if all are NaN."""
    seen = (np.asarray(union) > 0).sum(axis=-1)
    total = np.nansum(iou_per_class(intersection, union), axis=-1)
    return np.divide(total, seen, out=np.full(np.shape(seen), np.nan), where=seen > 0)


def pixel_iou(intersection: np.ndarray, union: np.ndarray) -> np.ndarray:
    """(..., K) counts -> (...) sum of intersections over sum of unions; NaN if all unions are 0."""
    return iou_per_class(np.sum(intersection, axis=-1), np.sum(union, axis=-1))


@dataclass(frozen=True, eq=False)
class Counts:
    """Numbers of cells per test scene and class, summed over the images of the scene."""

    intersection: np.ndarray  #: (S, K) int64, cells in both the true and the predicted mask
    union: np.ndarray  #: (S, K) int64, cells in at least one of them

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
        """Counts of no image."""
        return cls(np.zeros((scenes, classes), np.int64), np.zeros((scenes, classes), np.int64))

    def __add__(self, other: "Counts") -> "Counts":
        """Counts of both sets of images, of the same scenes."""
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
        """(K,) float64, over all scenes; NaN for a class that is neither present nor predicted."""
        return self.value(iou_per_class)

    def class_iou(self) -> float:
        """Average class IoU: the mean over classes, without NaN."""
        return float(self.value(class_iou))

    def pixel_iou(self) -> float:
        """Average pixel IoU: classes are weighted by their area."""
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
    """Intersections and unions of a batch of binary maps, inside the field of view.

    predicted: (B, K, M, M) bool
    target: (B, K, M, M) in {0, 1}
    fov: (B, 1, M, M) in {0, 1}
    scene: (B,) integers in [0, scenes)
    Raises `InputError` for maps of different shapes, and for scenes out of range.
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
    counts: Sequence[Counts], statistic: Statistic, rng: np.random.Generator, draws: int = DRAWS
) -> tuple[np.ndarray, np.ndarray]:
    """90 % percentile interval of the mean over seeds, by resampling test scenes and seeds with replacement.

    counts: one per seed, of the same scenes; a draw takes the same scenes for all seeds
    statistic: `class_iou`, `pixel_iou`, `iou_per_class`, or another function of (..., K) counts
    Returns the lower and the upper end.
    """
    (values,) = resampled_scenes([counts], statistic, rng, draws)
    low, high = np.nanquantile(values, INTERVAL, axis=0)
    return low, high


def resampled_scenes(
    rows: Sequence[Sequence[Counts]], statistic: Statistic, rng: np.random.Generator, draws: int
) -> list[np.ndarray]:
    """The mean of the statistic over seeds per row, (draws, ...) each, with resampled test scenes and seeds.

    rows: counts of each row, one per seed, all of the same scenes. Draw i takes the same scenes for all rows and seeds,
        so that differences and quotients of rows have valid intervals. Seeds are drawn independently per row, as
        trainings are independent; with three seeds the spread over trainings is a rough estimate, with one it is 0.
    Raises `InputError` for rows of different scenes.
    """
    scenes = {len(one.union) for counts in rows for one in counts}
    if len(scenes) != 1 or 0 in scenes:
        raise InputError(f"counts: expected the same scenes in all, found {sorted(scenes)} scenes")
    (size,) = scenes
    weights = rng.multinomial(size, np.full(size, 1 / size), size=draws)  # times that each scene is drawn
    means = []
    for counts in rows:
        values = np.stack([statistic(weights @ one.intersection, weights @ one.union) for one in counts])
        drawn = rng.integers(len(counts), size=values.shape[:2])
        means.append(values[drawn, np.arange(draws)].mean(axis=0))
    return means
