"""The grid of a home's map in the world frame, and the cells of a view's map on it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.mapping.pose import Pose2D

Window = tuple[slice, slice]  #: rows and columns of a part of a grid

_MAX_SIDE_M, _MAX_CELL_M, _MAX_CELLS = 150.0, 1.0, 16_000_000
_TIE = 1e-6  # of a cell: centres this near to the border between two cells of a view's map are in the second one


@dataclass(frozen=True)
class Grid:
    """Square cells, row 0 at the largest y and column 0 at the smallest x, so that a picture of it is a floor plan."""

    x0: float  #: of the left edge, metres
    y0: float  #: of the lower edge, metres
    shape: tuple[int, int]  #: rows and columns
    cell_m: float  #: side of a cell

    @classmethod
    def of(cls, extent: Sequence[float], cell_m: float) -> Self:
        """The grid that covers `extent`: x0, y0, x1, y1, metres; x1 and y1 move outwards to a whole number of cells.

        Raises `InputError` for an extent or a cell that cannot be in metres, and for more than 16 million cells.
        """
        x0, y0, x1, y1 = _checked_extent(extent)
        if not (_is_number(cell_m) and 0 < cell_m <= _MAX_CELL_M):
            hint = ": centimetres?" if _is_number(cell_m) and cell_m > _MAX_CELL_M else ""
            raise InputError(f"cell_m: expected metres, more than 0 and at most {_MAX_CELL_M:g}, found {cell_m}{hint}")
        rows, columns = (math.ceil(side / cell_m - _TIE) for side in (y1 - y0, x1 - x0))
        if rows * columns > _MAX_CELLS:
            raise InputError(f"cell_m: expected at most {_MAX_CELLS} cells, found {rows * columns}: take larger ones")
        return cls(x0, y0, (rows, columns), float(cell_m))

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """x0, y0, x1, y1, metres."""
        rows, columns = self.shape
        return self.x0, self.y0, self.x0 + columns * self.cell_m, self.y0 + rows * self.cell_m

    @property
    def centres(self) -> tuple[np.ndarray, np.ndarray]:
        """x of the cells' centres per column, (C,), and y per row, (R,); float64, metres."""
        rows, columns = (np.arange(length) + 0.5 for length in self.shape)
        return self.x0 + columns * self.cell_m, self.extent[3] - rows * self.cell_m

    def part(self, window: Window) -> "Grid":
        """The grid of a part of the cells."""
        rows, columns = window
        x0, y0 = self.x0 + columns.start * self.cell_m, self.y0 + (self.shape[0] - rows.stop) * self.cell_m
        return Grid(x0, y0, (rows.stop - rows.start, columns.stop - columns.start), self.cell_m)

    def check_inside(self, pose: Pose2D) -> None:
        """Raise `InputError` for a pose outside the extent."""
        x0, y0, x1, y1 = self.extent
        if not (x0 <= pose.x <= x1 and y0 <= pose.y <= y1):
            inside = f"x from {x0:g} to {x1:g} and y from {y0:g} to {y1:g} metres"
            raise InputError(f"pose: expected {inside}, the map's extent, found ({pose.x:g}, {pose.y:g})")

    def look_up(self, pose: Pose2D, camera: CameraConfig) -> tuple[Window, np.ndarray, np.ndarray, np.ndarray]:
        """The cells around the map of a view: for each, the cell of that map in which its centre lies.

        pose: inside the extent
        camera: of the map
        Returns a window of this grid with (R, C) cells; row and column on the view's map, (R, C) int, 0 outside of it;
        and (R, C) bool, whether a centre lies on it.
        """
        half, side = camera.bev_extent_m / 2, camera.bev_px
        c, s = math.cos(pose.yaw), math.sin(pose.yaw)
        right, forward = np.array([-half, half, -half, half]), np.array([0, 0, 2 * half, 2 * half])
        x, y = pose.x + right * s + forward * c, pose.y - right * c + forward * s
        rows, columns = self.shape
        window = _between((self.extent[3] - y) / self.cell_m, rows), _between((x - self.x0) / self.cell_m, columns)
        dx, dy = self.centres[0][None, window[1]] - pose.x, self.centres[1][window[0], None] - pose.y
        column = np.floor((dx * s - dy * c + half) / camera.cell_m + _TIE).astype(int)
        row = side - 1 - np.floor((dx * c + dy * s) / camera.cell_m + _TIE).astype(int)
        inside = (row >= 0) & (row < side) & (column >= 0) & (column < side)
        return window, np.where(inside, row, 0), np.where(inside, column, 0), inside


def _between(positions: np.ndarray, length: int) -> slice:
    """The indices between the smallest and the largest of positions on an axis."""
    return slice(max(math.floor(positions.min()), 0), min(math.ceil(positions.max()), length))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and math.isfinite(value)


def _checked_extent(extent: Sequence[float]) -> tuple[float, float, float, float]:
    values = tuple(extent)
    if len(values) != 4 or not all(map(_is_number, values)):
        raise InputError(f"extent: expected x0, y0, x1, y1 in metres, found {values}")
    x0, y0, x1, y1 = map(float, values)
    if x0 >= x1 or y0 >= y1:
        raise InputError(f"extent: expected x0 < x1 and y0 < y1, found {(x0, y0, x1, y1)}")
    if max(x1 - x0, y1 - y0) > _MAX_SIDE_M:
        found = f"{x1 - x0:g} x {y1 - y0:g}: centimetres?"
        raise InputError(f"extent: expected metres, at most {_MAX_SIDE_M:g} across, found {found}")
    return x0, y0, x1, y1
