"""One map of a home from the maps of a walk: log-odds fusion on a grid in the world frame.

World frame: x and y in metres, angles counter-clockwise from +x, as in `zerobev.geometry.cameras`. A picture of the
grid is a floor plan: row 0 is at the largest y, column 0 at the smallest x.
"""

import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from scipy.special import expit, logit

from zerobev.common.errors import InputError, first_line
from zerobev.common.storage import replacing
from zerobev.inference.bev_map import NOTHING, OUTSIDE, BevMap, add_legend_of_maps, colors_of
from zerobev.mapping.grid import Grid, Window
from zerobev.mapping.nav2 import FREE, OCCUPIED, UNKNOWN, write_nav2
from zerobev.mapping.pose import Pose2D

#: Probability of a cell before any view, the one of white in training (`TextureConfig.white_fraction`). A view with
#: this value says nothing.
PRIOR = 0.2
#: Smallest and largest probability from one view: networks are too sure of themselves, and P^-1 has only 0 and 1.
LOWEST, HIGHEST = 0.05, 0.9
#: Largest absolute log-odds of a cell, so that a few views can correct many wrong ones.
LIMIT = 6.0

# a full disk is not among them: it ends every command in the same way
_CANNOT_WRITE = (FileExistsError, IsADirectoryError, NotADirectoryError, PermissionError)


@dataclass(frozen=True, eq=False)
class _Layer:
    """Sums over views, per cell: (R, C)."""

    log_odds: np.ndarray  #: float32
    total: np.ndarray  #: float32: of the values
    views: np.ndarray  #: int32: with the cell in the field of view

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> Self:
        log_odds = np.full(shape, logit(PRIOR), np.float32)
        return cls(log_odds, np.zeros(shape, np.float32), np.zeros(shape, np.int32))

    def part(self, window: Window) -> "_Layer":
        """The sums of a part of the cells; they share memory with these."""
        return _Layer(self.log_odds[window], self.total[window], self.views[window])

    def add(self, visible: np.ndarray, values: np.ndarray) -> None:
        """Add a view: its values (N,) in the N cells of the mask `visible` (R, C)."""
        evidence = logit(np.clip(values, LOWEST, HIGHEST)) - np.float32(logit(PRIOR))
        self.log_odds[visible] = np.clip(self.log_odds[visible] + evidence, -LIMIT, LIMIT)
        self.total[visible] += values
        self.views[visible] += 1


class HomeMap:
    """Layers by name (classes, instances, any modality) on one grid, fused from any number of projected maps.

    A view changes only the cells in its field of view: their log-odds grow by those of its value, between `LOWEST` and
    `HIGHEST`, over those of `PRIOR`. After one view a cell has the view's probability. The order of views does not
    matter unless a cell reaches `LIMIT`. A layer starts with the first view that contains it; for earlier views it is
    unknown.
    """

    def __init__(self, extent: Sequence[float], cell_m: float) -> None:
        """An empty map.

        extent: x0, y0, x1, y1 in the world, metres; x1 and y1 are moved outwards to a whole number of cells
        cell_m: side of a cell, metres; it may differ from that of the views' maps
        Raises `InputError` for an extent or a cell that cannot be in metres, and for more than 16 million cells.
        """
        self.grid = Grid.of(extent, cell_m)
        self._layers: dict[str, _Layer] = {}
        self._cells_of_views: tuple[int, float] | None = None  # per side of a view's map, and their size in metres

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers, in the order of their first views."""
        return tuple(self._layers)

    @property
    def viewed(self) -> np.ndarray:
        """(R, C) bool: cells that were in a field of view."""
        return np.any([np.zeros(self.grid.shape, bool), *(layer.views > 0 for layer in self._layers.values())], axis=0)

    @property
    def maps(self) -> dict[str, np.ndarray]:
        """(R, C) bool per layer: cells with a probability above 1/2."""
        return {name: layer.log_odds > 0 for name, layer in self._layers.items()}

    def probabilities(self, layer: str) -> np.ndarray:
        """(R, C) float32: fused probability of a layer, `PRIOR` where it was not in view.

        Raises `InputError` for an unknown layer.
        """
        return expit(self._layer(layer).log_odds)

    def means(self, layer: str) -> np.ndarray:
        """(R, C) float32: mean over views of a layer's values, NaN where it was not in view.

        For real values that are no probabilities, such as a temperature in [0, 1]. Raises `InputError` for an unknown
        layer.
        """
        found = self._layer(layer)
        empty = np.full(self.grid.shape, np.nan, np.float32)
        return np.divide(found.total, found.views, out=empty, where=found.views > 0)

    def add(self, bev: BevMap, pose: Pose2D) -> None:
        """Fuse the map of one view.

        bev: a result of `Projector.project`. Layers that it lacks stay as they are: project the masks of all classes,
            also the empty ones, so that their absence counts. Maps of the same name, such as two boxes of a chair,
            count as one with the larger value. Maps of P^-1 are 0 in cells without a pixel; to leave these unknown,
            replace `fov` by the map of an all-white mask: `dataclasses.replace(bev, fov=...)`
        pose: of the view's camera
        A cell of the home takes the value of the cell of `bev` in which its centre lies. All maps of a home have the
        same grid (cells per side, and their size); the camera of the photographs may change. Parts outside the home's
        extent are left out.
        Raises `InputError`, and leaves the map as it was, for anything else than a `BevMap` with values in [0, 1] and a
        `Pose2D`, for a grid that differs from that of earlier views, and for a pose outside the extent.
        """
        cells = self._checked_cells(bev)
        if not isinstance(pose, Pose2D):
            raise InputError(f"pose: expected a Pose2D, found {type(pose).__name__}")
        self.grid.check_inside(pose)
        window, row, column, inside = self.grid.look_up(pose, bev.camera)
        visible = inside & bev.fov[row, column]
        for name, values in _by_name(bev).items():
            layer = self._layers.setdefault(name, _Layer.empty(self.grid.shape))
            layer.part(window).add(visible, values[row, column][visible])
        self._cells_of_views = cells

    def crop(self) -> "HomeMap":
        """The smallest part with all cells that were in view. Raises `InputError` if there are none."""
        row, column = np.nonzero(self.viewed)
        if not len(row):
            raise InputError("map: expected cells in the field of view of a view, found none")
        window = slice(int(row.min()), int(row.max()) + 1), slice(int(column.min()), int(column.max()) + 1)
        grid = self.grid.part(window)
        cropped = HomeMap(grid.extent, grid.cell_m)
        for name, layer in self._layers.items():
            part = layer.part(window)
            cropped._layers[name] = _Layer(part.log_odds.copy(), part.total.copy(), part.views.copy())
        cropped._cells_of_views = self._cells_of_views
        return cropped

    def image(self) -> np.ndarray:
        """(R, C, 3) float64: a colour per layer, smaller ones above larger ones; grey where nothing was in view."""
        image = np.where(self.viewed[..., None], to_rgb(NOTHING), to_rgb(OUTSIDE))
        maps, colors = list(self.maps.values()), colors_of(self.layers)
        for k in sorted(range(len(maps)), key=lambda k: -maps[k].sum()):
            image = np.where(maps[k][..., None], colors[k], image)
        return image

    def show(self, axes: Axes | None = None) -> Axes:
        """Draw the map with metres on both axes, and a legend of the layers that are not empty."""
        axes = axes or plt.gca()
        x0, y0, x1, y1 = self.grid.extent
        axes.imshow(self.image(), extent=(x0, x1, y0, y1), interpolation="nearest")
        axes.set(xlabel="x [m]", ylabel="y [m]")
        maps = self.maps
        found = [(name, color) for name, color in zip(maps, colors_of(self.layers)) if maps[name].any()]
        empty = self.viewed & ~np.any(list(maps.values()), axis=0)
        add_legend_of_maps(axes, found, bool(empty.any()), not self.viewed.all())
        return axes

    def save(self, path: str | Path) -> None:
        """Write one NPZ file, which `HomeMap.load` reads.

        path: ends in `.npz`, which is added to a name without a suffix
        Raises `InputError` for another suffix, and if the file cannot be written.
        """
        path = _checked_path(path, ".npz")
        sums = {
            name: np.array([getattr(layer, name) for layer in self._layers.values()]).reshape(-1, *self.grid.shape)
            for name in ("log_odds", "total", "views")
        }
        try:
            with replacing(path) as temporary, temporary.open("wb") as file:
                np.savez_compressed(
                    file,
                    layers=np.array(self.layers, str),
                    extent=np.array(self.grid.extent),
                    cell_m=np.array(self.grid.cell_m),
                    cells_of_views=np.array(self._cells_of_views or ()),
                    **sums,  # type: ignore[arg-type]  # NumPy's stub matches them with `allow_pickle`
                )
        except _CANNOT_WRITE as error:
            raise _unwritten(path, error) from None

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """The map saved in `path`. Raises `InputError` for anything else."""
        try:
            with np.load(path, allow_pickle=False) as file:
                saved = {name: file[name] for name in file.files}
            home = cls(saved["extent"].tolist(), float(saved["cell_m"]))
            names, cells = saved["layers"].tolist(), saved["cells_of_views"].tolist()
            for k, name in enumerate(names):
                sums = saved["log_odds"][k], saved["total"][k], saved["views"][k]
                if any(array.shape != home.grid.shape for array in sums):
                    raise ValueError(f"a layer of another shape than {home.grid.shape}")
                home._layers[name] = _Layer(*sums)
            home._cells_of_views = (int(cells[0]), float(cells[1])) if cells else None
        except (OSError, ValueError, LookupError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as error:
            raise InputError(f"{path}: expected a saved HomeMap, found: {first_line(error)}") from None
        return home

    def save_nav2(self, path: str | Path, free: str | Iterable[str], occupied: str | Iterable[str]) -> None:
        """Write an occupancy grid for robots, in the format of nav2's (and ROS's) `map_server`.

        path: ends in `.yaml`, which is added to a name without a suffix; the image is a PGM file of the same name
        free: layers in which a robot can drive, such as "floor"
        occupied: layers that stop it; a cell of both is occupied. All other cells are unknown
        Raises `InputError` for an unknown layer, a layer in both, another suffix, and if a file cannot be written.
        """
        path = _checked_path(path, ".yaml")
        can_drive, stops = (_names(names) for names in (free, occupied))
        if both := sorted(set(can_drive) & set(stops)):
            raise InputError(f"occupied: expected layers other than the free ones, found {both[0]!r} in both")
        image = np.full(self.grid.shape, UNKNOWN, np.uint8)
        for value, names in ((FREE, can_drive), (OCCUPIED, stops)):
            for name in names:
                image[self._layer(name).log_odds > 0] = value
        try:
            write_nav2(path, image, (self.grid.x0, self.grid.y0), self.grid.cell_m)
        except _CANNOT_WRITE as error:
            raise _unwritten(path, error) from None

    def _layer(self, name: str) -> _Layer:
        if name not in self._layers:
            raise InputError(f"layer: expected one of {', '.join(self._layers) or 'none'}, found {name!r}")
        return self._layers[name]

    def _checked_cells(self, bev: BevMap) -> tuple[int, float]:
        if not isinstance(bev, BevMap):
            raise InputError(f"bev: expected a BevMap, found {type(bev).__name__}")
        if not (np.isfinite(bev.values).all() and bev.values.min(initial=0) >= 0 and bev.values.max(initial=0) <= 1):
            raise InputError("bev.values: expected values in [0, 1], found others")
        cells = bev.camera.bev_px, bev.cell_m
        if self._cells_of_views not in (None, cells):
            expected = "{} cells of {:g} m".format(*self._cells_of_views or ())
            found = "{} of {:g} m".format(*cells)
            raise InputError(f"bev: expected {expected} per side, as in earlier views, found {found}")
        return cells


def _by_name(bev: BevMap) -> dict[str, np.ndarray]:
    """(M, M) float32 per name: the maximum over the maps of this name."""
    found: dict[str, np.ndarray] = {}
    for name, values in zip(bev.labels, bev.values):
        found[name] = np.maximum(found.get(name, np.float32(0)), values)
    return found


def _names(names: str | Iterable[str]) -> list[str]:
    return [names] if isinstance(names, str) else list(names)


def _checked_path(path: str | Path, suffix: str) -> Path:
    """The path with `suffix`, which is added to a name without one."""
    path = Path(path)
    if path.suffix.lower() not in ("", suffix) or not path.name:
        raise InputError(f"path: expected a name that ends in {suffix}, found {str(path)!r}")
    return path if path.suffix else path.with_name(f"{path.name}{suffix}")


def _unwritten(path: Path, error: OSError) -> InputError:
    return InputError(f"{path}: expected a file that can be written, found: {error.strerror}")
