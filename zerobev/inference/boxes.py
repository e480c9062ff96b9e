"""Detected objects as filled boxes (paper, Section 4, "Additional zero-shot capabilities" figure of objects)."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import pandas as pd
from skimage.measure import regionprops

from zerobev.common.errors import InputError
from zerobev.inference.arrays import as_array
from zerobev.inference.modality import BinaryImages, MapModality

_SIDES = ("xmin", "ymin", "xmax", "ymax")
_MAX_FRACTION = 1.5  # corners given as fractions of the image may be slightly outside of it
Form = Literal["xyxy", "xywh", "cxcywh"]

_MIN_PX = 12  # smaller instances are not detected


@dataclass(frozen=True, eq=False)
class Boxes(MapModality):
    """N detections in one photograph, with one map per box.

    For formats other than corners in pixels see `Boxes.of`.
    Raises `InputError` for arrays of different lengths, for corners that are not finite, in the wrong order, or all
    within one pixel, as fractions of the image would be, and for scores outside [0, 1].
    """

    corners: np.ndarray  #: (N, 4) float64: left, top, right, bottom, in pixels from the image's upper left corner
    labels: tuple[str, ...]
    scores: np.ndarray  #: (N,) float64 in [0, 1]
    source: str = "given"  #: the detector, in words

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "corners", as_array(self.corners, "boxes").astype(np.float64, casting="same_kind"))
            object.__setattr__(self, "scores", as_array(self.scores, "boxes").astype(np.float64, casting="same_kind"))
            object.__setattr__(self, "labels", tuple(map(str, self.labels)))
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(f"boxes: expected numbers as corners and scores, and labels, found {error}") from None
        count = len(self.labels)
        if np.shape(self.corners) != (count, 4) or np.shape(self.scores) != (count,):
            found = f"{np.shape(self.corners)} and {np.shape(self.scores)}"
            raise InputError(f"boxes: expected corners ({count}, 4) and scores ({count},), found {found}")
        for number, (left, top, right, bottom) in enumerate(self.corners):
            if not (np.isfinite([left, top, right, bottom]).all() and left < right and top < bottom):
                found = f"{left:g}, {top:g}, {right:g}, {bottom:g}"
                hint = "; for x, y, width, height use Boxes.of(..., form='xywh')"
                raise InputError(f"boxes: expected xmin < xmax and ymin < ymax in box {number}, found {found}{hint}")
        if count and np.abs(self.corners).max() <= _MAX_FRACTION:
            hint = "for fractions of the image use Boxes.of(..., size=(height, width))"
            raise InputError(f"boxes: expected corners in pixels, found none above {self.corners.max():g}; {hint}")
        if not all(0 <= score <= 1 for score in self.scores):
            raise InputError(f"boxes: expected scores in [0, 1], found {np.min(self.scores)} to {np.max(self.scores)}")

    @classmethod
    def of(
        cls,
        values: Any,
        labels: Iterable[str],
        scores: Any = None,
        form: Form = "xyxy",
        size: tuple[int, int] | None = None,
    ) -> Self:
        """Boxes in another format.

        values: (N, 4) numbers. form "xyxy": left, top, right, bottom; "xywh": left, top, width, height, as in COCO;
            "cxcywh": centre, width, height, as in YOLO and DETR
        scores: N in [0, 1]; default: 1
        size: (H, W) of the photograph if values are fractions of it; None: values are pixels
        Raises `InputError` as the class does, and for fractions outside [-0.5, 1.5].
        """
        boxes, labels = as_array(values, "boxes"), tuple(labels)
        if boxes.ndim != 2 or boxes.shape[1] != 4 or boxes.dtype.kind not in "iuf":
            raise InputError(f"boxes: expected numbers (N, 4), found {boxes.dtype} {boxes.shape}")
        first, second = boxes[:, :2].astype(np.float64), boxes[:, 2:].astype(np.float64)
        if form == "xyxy":
            corners = np.hstack([first, second])
        elif form == "xywh":
            corners = np.hstack([first, first + second])
        elif form == "cxcywh":
            corners = np.hstack([first - second / 2, first + second / 2])
        else:
            raise InputError(f"form: expected xyxy, xywh or cxcywh, found {form!r}")
        if size is not None:
            if not (np.abs(corners) <= _MAX_FRACTION).all():
                raise InputError(f"boxes: expected fractions of the image, found up to {np.abs(corners).max():g}")
            corners = corners * np.array([size[1], size[0]] * 2)
        return cls(corners, labels, np.ones(len(corners)) if scores is None else scores)

    @classmethod
    def from_table(cls, table: pd.DataFrame, source: str = "given") -> Self:
        """The rows of a table with columns xmin, ymin, xmax, ymax (pixels), label, and optionally score (else 1)."""
        missing = [name for name in (*_SIDES, "label") if name not in table]
        if missing:
            found = ", ".join(map(str, table.columns))
            raise InputError(f"{source}: expected columns {', '.join(_SIDES)}, label, found {found}")
        try:
            corners = table[list(_SIDES)].to_numpy(np.float64)
            scores = table["score"].to_numpy(np.float64) if "score" in table else np.ones(len(table))
        except (ValueError, TypeError) as error:
            raise InputError(f"{source}: expected numbers as corners and scores, found: {error}") from None
        return cls(corners, tuple(map(str, table["label"])), scores, source)

    @classmethod
    def read_csv(cls, path: Path) -> Self:
        """As `from_table`, from a CSV file with a header. Raises `InputError` if it cannot be read."""
        try:
            table = pd.read_csv(path)
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: expected a CSV table of boxes, found: {error}") from None
        return cls.from_table(table, str(path))

    def layers(self, shape: tuple[int, int]) -> tuple[BinaryImages]:
        """Each box as a filled mask of a photograph of `shape` (H, W).

        Raises `InputError` if there is no box, and for a box outside the photograph.
        """
        if not self.labels:
            raise InputError("modality: expected at least one box, found none")
        height, width = shape
        for number, (left, top, right, bottom) in enumerate(self.corners):
            if left >= width or top >= height or right <= 0 or bottom <= 0:
                found = f"{left:g}, {top:g}, {right:g}, {bottom:g}"
                raise InputError(f"modality: expected box {number} within {width} x {height} pixels, found {found}")
        return (BinaryImages(self.labels, self._filled(shape), scores=self.scores),)

    def _filled(self, shape: tuple[int, int]) -> Iterator[np.ndarray]:
        for corners in self.corners:
            sides = np.floor(np.clip(corners, -1, max(shape) + 1) + 0.5).astype(int)
            left, top = sides[:2]  # pixels with their centre inside, at least one
            right, bottom = np.maximum(sides[2:], (left + 1, top + 1))
            image = np.zeros(shape, bool)
            image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = True
            yield image


def rendered_boxes(
    instance: np.ndarray,
    names: Mapping[int, str],
    rng: np.random.Generator,
    jitter: float = 0.05,
    misses: float = 0.1,
) -> Boxes:
    """Simulated detections: boxes of rendered instances with noise; `source` states this.

    instance: (H, W) integers, instance id per pixel
    names: instance id -> label, of the objects to detect
    jitter: standard deviation of each side, as a fraction of the box's width or height
    misses: fraction of the objects without a detection
    The score of a box is its overlap (IoU) with the true box.
    """
    found: list[tuple[np.ndarray, str, float]] = []
    for region in regionprops(np.asarray(instance).astype(np.int64)):
        if region.label not in names or region.area < _MIN_PX:
            continue
        missed, shifts = rng.random() < misses, rng.normal(0, jitter, 4)
        top, left, bottom, right = region.bbox
        true = np.array([left, top, right, bottom], np.float64)
        size = np.array([right - left, bottom - top] * 2)
        limits = np.array([instance.shape[1], instance.shape[0]] * 2)
        noisy = np.clip(true + shifts * size, 0, limits)
        if not missed and (noisy[2:] - noisy[:2] >= 1).all():
            found.append((noisy, names[region.label], _overlap(true, noisy)))
    corners = np.array([corners for corners, _, _ in found]).reshape(-1, 4)
    scores = np.array([score for _, _, score in found], np.float64)
    return Boxes(corners, tuple(label for _, label, _ in found), scores, "rendered instances, jittered, some missed")


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two boxes (left, top, right, bottom)."""
    inside = np.prod(np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None))
    return float(inside / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - inside))
