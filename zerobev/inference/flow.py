"""Optical flow (paper, Section 4, "Additional zero-shot capabilities" figure of flow): vectors as discs.

Each vector is projected as two images: a disc at its start and a disc at its end.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from skimage.color import rgb2gray
from skimage.draw import disk
from skimage.registration import optical_flow_tvl1

from zerobev.common.errors import InputError
from zerobev.inference.arrays import as_array, checked_image
from zerobev.inference.bev_map import BevArrows, BevMap
from zerobev.inference.modality import BinaryImages

_UNKNOWN_PX = 1e9  # larger components are unknown, by the convention of `.flo` files
_FLO = b"PIEH"  # 202021.25 as float32
_RADIUS = 1 / 32  # of a disc, as a fraction of the image's width
_SPACING = 1 / 24  # of vectors, likewise
#: Shorter vectors are left out.
MIN_PX = 1.0


@dataclass(frozen=True, eq=False)
class Flow:
    """N vectors in a photograph: x to the right and y down, in pixels from the image's upper left corner."""

    start_px: np.ndarray  #: (N, 2) float64
    end_px: np.ndarray  #: (N, 2) float64
    after: np.ndarray | None = None  #: (H, W, 3): the second frame, for the ends; None: the first frame for both

    def __post_init__(self) -> None:
        try:
            for name in ("start_px", "end_px"):
                points = as_array(getattr(self, name), "flow").astype(np.float64, casting="same_kind")
                object.__setattr__(self, name, points)
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(f"flow: expected numbers as starts and ends, found {error}") from None
        shapes = np.shape(self.start_px), np.shape(self.end_px)
        if shapes[0] != shapes[1] or len(shapes[0]) != 2 or shapes[0][1] != 2 or not shapes[0][0]:
            raise InputError(f"flow: expected starts and ends (N, 2) of one vector at least, found {shapes}")
        if not (np.isfinite(self.start_px).all() and np.isfinite(self.end_px).all()):
            raise InputError("flow: expected finite vectors, found NaN or infinity")

    @classmethod
    def of(cls, field: np.ndarray, after: np.ndarray | None = None, spacing_px: int | None = None) -> Self:
        """The vectors of a flow field of at least one pixel, on a grid.

        field: (H, W, 2) floating point, motion of each pixel to the right and down, pixels. Vectors with a component
            of NaN or beyond 1e9, as in Middlebury's files, are unknown and left out.
        spacing_px: of the grid; default: 1/24 of the width
        Raises `InputError` for another shape or type, and if no such vector is left.
        """
        field = as_array(field, "flow")
        if field.ndim != 3 or field.shape[-1] != 2 or field.dtype.kind != "f" or not field.size:
            hint = ": move the components last" if field.ndim == 3 and field.shape[0] == 2 else ""
            raise InputError(f"flow: expected floating point (H, W, 2), found {field.dtype} {field.shape}{hint}")
        step = spacing_px or max(1, round(field.shape[1] * _SPACING))
        rows, columns = (np.arange(step // 2, length, step) for length in field.shape[:2])
        x, y = np.meshgrid(columns, rows)
        vector = field[y, x].astype(np.float64)
        known = (np.abs(vector) <= _UNKNOWN_PX).all(axis=-1)  # False for NaN
        moving = known & (np.linalg.norm(np.where(known[..., None], vector, 0), axis=-1) >= MIN_PX)
        if not moving.any():
            found = f"none; {known.mean():.0%} of the vectors are known"
            raise InputError(f"flow: expected a vector of {MIN_PX:g} px at least, found {found}")
        start = np.stack([x, y], axis=-1)[moving] + 0.5
        return cls(start, start + vector[moving], after)

    @classmethod
    def read(cls, path: str | Path, after: np.ndarray | None = None, spacing_px: int | None = None) -> Self:
        """As `of`, from a `.flo` file of Middlebury's benchmark. Raises `InputError` for any other file."""
        return cls.of(read_flo(path), after, spacing_px)

    @classmethod
    def between(cls, first: np.ndarray, second: np.ndarray, spacing_px: int | None = None) -> Self:
        """The flow from one photograph to the next, (H, W, 3), with the second as `after`; see `flow_field`, `of`."""
        return cls.of(flow_field(first, second), second, spacing_px)

    def layers(self, shape: tuple[int, int]) -> tuple[BinaryImages, BinaryImages]:
        """A disc at each start, and a disc at each end, in photographs of `shape` (H, W).

        Raises `InputError` if the two frames differ in size.
        """
        after = None if self.after is None else checked_image(self.after)
        if after is not None and after.shape[:2] != tuple(shape):
            raise InputError(f"after: expected the first frame's shape {(*shape, 3)}, found {after.shape}")
        labels = tuple(map(str, range(len(self.start_px))))
        starts, ends = (_discs(points, shape) for points in (self.start_px, self.end_px))
        return BinaryImages(labels, starts), BinaryImages(labels, ends, photograph=after)

    def result(self, maps: tuple[BevMap, ...]) -> BevArrows:
        """Arrows between the maps of starts and ends."""
        return BevArrows(*maps)


def read_flo(path: str | Path) -> np.ndarray:
    """The field (H, W, 2) float32 of a `.flo` file: pixels to the right and down, unknown beyond 1e9.

    Raises `InputError` if the file is missing, of another kind (KITTI's flow is PNG), or of another size than stated.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: expected a .flo file, found: {error.strerror}") from None
    if content[:4] != _FLO:
        hint = "; decode it and use Flow.of(field)" if content[:4] == b"\x89PNG" else ""
        raise InputError(f"{path}: expected a .flo file that starts with {_FLO!r}, found {content[:4]!r}{hint}")
    width, height = (int(side) for side in np.frombuffer(content[4:12].ljust(8, b"\0"), "<i4"))
    if width < 1 or height < 1 or len(content) != 12 + 8 * width * height:
        found = f"{width} x {height} pixels in {len(content)} bytes"
        raise InputError(f"{path}: expected 12 bytes and 8 per pixel, found {found}")
    return np.frombuffer(content, "<f4", offset=12).reshape(height, width, 2).astype(np.float32)


def flow_field(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Optical flow by scikit-image's TV-L1.

    first, second: (H, W, 3) uint8 or floating point in [0, 1]
    Returns (H, W, 2) float32: motion of each pixel of `first` to the right and down, pixels.
    """
    shapes = np.shape(first), np.shape(second)
    if shapes[0] != shapes[1] or len(shapes[0]) != 3 or shapes[0][2] != 3:
        raise InputError(f"frames: expected two of one shape (H, W, 3), found {shapes[0]} and {shapes[1]}")
    down, right = optical_flow_tvl1(rgb2gray(first), rgb2gray(second))
    return np.stack([right, down], axis=-1).astype(np.float32)


def _discs(points: np.ndarray, shape: tuple[int, int]) -> Iterator[np.ndarray]:
    radius = max(shape[1] * _RADIUS, 1.0)
    for x, y in np.clip(points, -(2**20), 2**20):  # integers of `disk` could overflow
        image = np.zeros(shape, bool)
        image[disk((y - 0.5, x - 0.5), radius, shape=shape)] = True
        yield image
