"""Scores of a home's whole map: IoU, and F1 of boundaries, from counts per home.

Both follow Semantic MapNet (Cartillier et al., AAAI 2021): counts of all homes are added before a class has its IoU or
F1, and the mean is over classes. The boundary of a class are its cells with a side to another one; a boundary cell is
right if one of the other map is at most a cell away, diagonals included (there: less than 3 cells of 2 cm).
Differences: a cell may be of several classes, and a class that is never predicted has F1 = 0 (there it is left out).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from zerobev.evaluation.metrics import Counts, iou_per_class


@dataclass(frozen=True, eq=False)
class HomeScores:
    """Numbers of cells per home and class."""

    area: Counts  #: of the maps
    precision: Counts  #: right boundary cells among those of the predicted map
    recall: Counts  #: the same, of the true map

    @classmethod
    def of(cls, predicted: np.ndarray, target: np.ndarray, region: np.ndarray) -> Self:
        """The scores of one home within a region.

        predicted, target: (K, R, C) bool
        region: (R, C) bool; all cells outside count as of no class, in both maps
        """
        predicted, target = predicted & region, target & region
        edges = _boundaries(predicted), _boundaries(target)
        return cls(
            _counts(predicted & target, predicted | target),
            _counts(edges[0] & _dilated(edges[1]), edges[0]),
            _counts(edges[1] & _dilated(edges[0]), edges[1]),
        )

    @classmethod
    def joined(cls, homes: Sequence["HomeScores"]) -> Self:
        """The scores of several sets of homes together."""
        return cls(
            *(
                Counts(*(np.concatenate([getattr(one, side) for one in counts]) for side in ("intersection", "union")))
                for counts in zip(*((home.area, home.precision, home.recall) for home in homes))
            )
        )

    def iou(self) -> np.ndarray:
        """(K,) float64 over all homes; NaN for a class that is neither present nor predicted."""
        return self.area.iou_per_class()

    def boundary_f1(self) -> np.ndarray:
        """(K,) float64 over all homes; NaN for a class that is neither present nor predicted."""
        precision, recall = (counts.value(_share) for counts in (self.precision, self.recall))
        total = precision + recall
        f1 = np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)
        return np.where(np.isnan(self.iou()), np.nan, f1)

    def to_json(self) -> dict[str, Any]:
        """Plain lists, for a record."""
        return {name: getattr(self, name).to_json() for name in ("area", "precision", "recall")}

    @classmethod
    def from_json(cls, value: Any) -> Self:
        """The inverse of `to_json`."""
        return cls(*(Counts.from_json(value[name]) for name in ("area", "precision", "recall")))


def _share(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    return np.nan_to_num(iou_per_class(part, whole))


def _counts(part: np.ndarray, whole: np.ndarray) -> Counts:
    return Counts(*(cells.sum(axis=(1, 2), dtype=np.int64)[None] for cells in (part, whole)))


def _boundaries(maps: np.ndarray) -> np.ndarray:
    """Cells of each map (K, R, C) with one of four neighbours, or the grid's border, outside of it."""
    padded = np.pad(maps, ((0, 0), (1, 1), (1, 1)))
    vertical, horizontal = padded[:, :, 1:-1], padded[:, 1:-1]
    return maps & ~(vertical[:, :-2] & vertical[:, 2:] & horizontal[..., :-2] & horizontal[..., 2:])


def _dilated(maps: np.ndarray) -> np.ndarray:
    """Cells of each map (K, R, C) and their eight neighbours."""
    padded = np.pad(maps, ((0, 0), (1, 1), (1, 1)))
    wide = padded[..., :-2] | padded[..., 1:-1] | padded[..., 2:]
    return wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:]
