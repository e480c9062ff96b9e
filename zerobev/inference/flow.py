"""Optical flow (paper, Section 4, "Additional zero-shot capabilities" figure of flow): vectors as discs.

Each vector is projected as two images: a filled circle at its start, and one at its end.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from skimage.color import rgb2gray
from skimage.draw import disk
from skimage.registration import optical_flow_ilk, optical_flow_tvl1

from zerobev.common.errors import InputError
from zerobev.inference.images import BinaryImages

METHODS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "tvl1": optical_flow_tvl1,
    "ilk": optical_flow_ilk,
}
_RADIUS = 1 / 32  # of a disc, as a share of the image's width
_SPACING = 1 / 24  # of vectors, likewise


@dataclass(frozen=True, eq=False)
class Flow:
    """N vectors in a photograph: x to the right and y down, in pixels from the image's upper left corner.

    Ends are projected with the frame that they belong to, `after`; without it with the first frame, as their starts.
    """

    start_px: np.ndarray  #: (N, 2) float64
    end_px: np.ndarray  #: (N, 2) float64
    after: np.ndarray | None = None  #: (H, W, 3): the second frame

    def __post_init__(self) -> None:
        try:
            for name in ("start_px", "end_px"):
                object.__setattr__(self, name, np.asarray(getattr(self, name), np.float64))
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(f"flow: expected numbers as starts and ends, found {error}") from None
        shapes = np.shape(self.start_px), np.shape(self.end_px)
        if shapes[0] != shapes[1] or len(shapes[0]) != 2 or shapes[0][1] != 2 or not shapes[0][0]:
            raise InputError(f"flow: expected starts and ends (N, 2) of one vector at least, found {shapes}")
        if not (np.isfinite(self.start_px).all() and np.isfinite(self.end_px).all()):
            raise InputError("flow: expected finite vectors, found NaN or infinity")

    @classmethod
    def of(
        cls,
        field: np.ndarray,
        after: np.ndarray | None = None,
        min_px: float = 1.0,
        spacing_px: int | None = None,
    ) -> Self:
        """The vectors of a flow field that are longer than `min_px`, on a grid.

        field: (H, W, 2) floating point, pixels to the right and down that each pixel moves
        spacing_px: of the grid; default: a 24th of the width
        Raises `InputError` for another shape or type, for NaN, and where nothing moves that far.
        """
        field = np.asarray(field)
        if field.ndim != 3 or field.shape[-1] != 2 or field.dtype.kind != "f" or not field.size:
            raise InputError(f"flow: expected floating point (H, W, 2), found {field.dtype} {field.shape}")
        if not np.isfinite(field).all():
            raise InputError("flow: expected finite vectors, found NaN or infinity")
        step = spacing_px or max(1, round(field.shape[1] * _SPACING))
        rows, columns = (np.arange(step // 2, length, step) for length in field.shape[:2])
        x, y = np.meshgrid(columns, rows)
        vector = field[y, x].astype(np.float64)
        moving = np.linalg.norm(vector, axis=-1) >= min_px
        if not moving.any():
            raise InputError(f"flow: expected a vector of {min_px:g} px at least, found none")
        start = np.stack([x, y], axis=-1)[moving] + 0.5
        return cls(start, start + vector[moving], after)

    @classmethod
    def between(
        cls, first: np.ndarray, second: np.ndarray, method: str = "tvl1", min_px: float = 1.0, **grid: int | None
    ) -> Self:
        """The flow from one photograph to the next, (H, W, 3), with the second as `after`; see `flow_field`, `of`."""
        return cls.of(flow_field(first, second, method), second, min_px, **grid)

    def discs(self, shape: tuple[int, int]) -> tuple[BinaryImages, BinaryImages]:
        """A filled circle at each start, and one at each end, in photographs of `shape` (H, W)."""
        labels = tuple(map(str, range(len(self.start_px))))
        starts, ends = (_discs(points, shape) for points in (self.start_px, self.end_px))
        return BinaryImages(labels, starts), BinaryImages(labels, ends)


def flow_field(first: np.ndarray, second: np.ndarray, method: str = "tvl1") -> np.ndarray:
    """Optical flow by scikit-image: TV-L1 ("tvl1") or iterative Lucas-Kanade ("ilk").

    first, second: (H, W, 3) uint8 or floating point in [0, 1]
    Returns (H, W, 2) float32: the pixels to the right and down that each pixel of `first` moves.
    """
    if method not in METHODS:
        raise InputError(f"method: expected one of {', '.join(METHODS)}, found {method!r}")
    shapes = np.shape(first), np.shape(second)
    if shapes[0] != shapes[1] or len(shapes[0]) != 3 or shapes[0][2] != 3:
        raise InputError(f"frames: expected two of one shape (H, W, 3), found {shapes[0]} and {shapes[1]}")
    down, right = METHODS[method](rgb2gray(first), rgb2gray(second))
    return np.stack([right, down], axis=-1).astype(np.float32)


def _discs(points: np.ndarray, shape: tuple[int, int]) -> Iterator[np.ndarray]:
    radius = max(shape[1] * _RADIUS, 1.0)
    for x, y in np.clip(points, -(2**20), 2**20):  # far outside is far enough
        image = np.zeros(shape, bool)
        image[disk((y - 0.5, x - 0.5), radius, shape=shape)] = True
        yield image
