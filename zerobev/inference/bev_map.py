"""Results of a projection: maps, and arrows between maps, in metres."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch

from zerobev.common.errors import InputError
from zerobev.common.storage import replacing
from zerobev.config import LABELS, CameraConfig

#: One colour per class, in the order of `LABELS`; the hues of Okabe and Ito, which colour-blind readers can tell apart.
CLASS_COLORS = ("#3b3b3b", "#e3cf8f", "#d55e00", "#cc79a7", "#0072b2", "#009e73", "#56b4e9", "#e69f00")
#: Colours of cells in the field of view in which no map is white, and of cells outside of it.
NOTHING, OUTSIDE = "#ffffff", "#9aa0a6"
_MAX_LEGEND = 12
_COLORS = [color for name in ("tab10", "Set2", "Set1") for color in matplotlib.color_sequences[name]]


@dataclass(frozen=True, eq=False)
class BevMap:
    """K maps of M x M cells: row 0 farthest, column 0 leftmost, the camera at the middle of the lower edge."""

    values: np.ndarray  #: (K, M, M) float32 in [0, 1]: probability of white, or the projected real value
    labels: tuple[str, ...]  #: K names
    evidence: np.ndarray  #: (K, M, M) float32 >= 0: rise of the logit over that of an empty image; of P^-1: the values
    fov: np.ndarray  #: (M, M) bool: cells in the field of view, from estimated depth
    camera: CameraConfig
    scores: np.ndarray | None = None  #: (K,) float64, of detections

    @property
    def maps(self) -> np.ndarray:
        """(K, M, M) bool: cells in the field of view with a value above 1/2."""
        return (self.values > 0.5) & self.fov

    @property
    def cell_m(self) -> float:
        """Side of a cell, metres."""
        return self.camera.cell_m

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """`extent` for `imshow`: metres to the right of the camera and in front of it."""
        return self.camera.extent

    @property
    def centres_m(self) -> np.ndarray:
        """(K, 2) float64: position of each modality, metres right and forward; NaN where all evidence is zero.

        This is the centre of gravity of the evidence over cells with at least half of its maximum; no probability needs
        to be above 1/2, which small objects may not reach.
        """
        row, column = np.indices(self.fov.shape) + 0.5
        right, forward = column * self.cell_m + self.extent[0], self.extent[3] - row * self.cell_m
        evidence = self.evidence.astype(np.float64) * self.fov
        evidence *= evidence >= evidence.max(axis=(1, 2), keepdims=True) / 2
        total = evidence.sum(axis=(1, 2))[:, None]
        sums = np.stack([(evidence * axis).sum(axis=(1, 2)) for axis in (right, forward)], axis=1)
        return np.divide(sums, total, out=np.full(sums.shape, np.nan), where=total > 0)

    def footprints(self) -> pd.DataFrame:
        """One row per map: label, score if there is one, area of `maps` in square metres, and centre in metres."""
        score = {} if self.scores is None else {"score": self.scores}
        right, forward = self.centres_m.T
        area = self.maps.sum(axis=(1, 2)) * self.cell_m**2
        return pd.DataFrame({"label": self.labels, **score, "area_m2": area, "right_m": right, "forward_m": forward})

    def image(self) -> np.ndarray:
        """(M, M, 3) float64: each map in another colour, larger maps below smaller ones."""
        colors, image = colors_of(self.labels), np.where(self.fov[..., None], to_rgb(NOTHING), to_rgb(OUTSIDE))
        for k in np.argsort(-self.maps.sum(axis=(1, 2)), kind="stable").tolist():
            opacity = (self.values[k] * self.fov * (self.values[k] > 0.1))[..., None]
            image = (1 - opacity) * image + opacity * np.array(colors[k])
        return image.clip(0, 1)  # blending rounds

    def show(self, axes: Axes | None = None) -> Axes:
        """Draw the maps with metres on both axes, and a legend of the maps that are not empty.

        Classes have the colours of all figures, see `colors_of`; the legend also names cells with nothing and cells
        outside the view. All detections are shown: a cross marks the centre of a detection with an empty map.
        """
        axes = axes or plt.gca()
        axes.imshow(self.image(), extent=self.extent, interpolation="nearest")
        axes.set(xlabel="right [m]", ylabel="forward [m]")
        maps, colors = self.maps, colors_of(self.labels)
        found = maps.any(axis=(1, 2))
        if self.scores is not None:
            for k in np.flatnonzero(~found).tolist():
                axes.plot(*self.centres_m[k], "x", color=colors[k])
            found |= np.isfinite(self.centres_m).all(axis=1)
        entries = [(self._title(k), colors[k]) for k in np.flatnonzero(found).tolist()]
        add_legend_of_maps(axes, entries, bool((self.fov & ~maps.any(axis=0)).any()), not self.fov.all())
        return axes

    def save(self, path: str | Path) -> None:
        """Write one NPZ file: values, maps, fov, labels, extent (metres), cell_m, and scores if there are any.

        path: ends in `.npz`, which is added to a name without a suffix
        Raises `InputError` for another suffix, and if the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() not in ("", ".npz") or not path.name:
            raise InputError(f"path: expected a name that ends in .npz, found {str(path)!r}")
        path = path if path.suffix else path.with_name(f"{path.name}.npz")
        scores = {} if self.scores is None else {"scores": self.scores}
        try:
            with replacing(path) as temporary, temporary.open("wb") as file:
                np.savez_compressed(
                    file,
                    values=self.values,
                    maps=self.maps,
                    fov=self.fov,
                    labels=np.array(self.labels),
                    extent=self.extent,
                    cell_m=self.cell_m,
                    **scores,  # type: ignore[arg-type]  # NumPy's stub matches them with `allow_pickle`
                )
        except (FileExistsError, IsADirectoryError, NotADirectoryError, PermissionError) as error:
            raise InputError(f"{path}: expected a file that can be written, found: {error.strerror}") from None

    def _title(self, k: int) -> str:
        return self.labels[k] if self.scores is None else f"{self.labels[k]} {self.scores[k]:.2f}"


@dataclass(frozen=True, eq=False)
class BevArrows:
    """N flow vectors on the map, each from the centre of its start's map to the centre of its end's map."""

    starts: BevMap
    ends: BevMap

    @property
    def start_m(self) -> np.ndarray:
        """(N, 2) float64, metres right and forward; NaN as in `BevMap.centres_m`."""
        return self.starts.centres_m

    @property
    def end_m(self) -> np.ndarray:
        """(N, 2) float64, metres right and forward; NaN as in `BevMap.centres_m`."""
        return self.ends.centres_m

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """`extent` for `imshow`, metres."""
        return self.starts.extent

    def show(self, axes: Axes | None = None, color: str = "tab:red") -> Axes:
        """Draw the arrows over the field of view, with metres on both axes."""
        axes = axes or plt.gca()
        field = np.where(self.starts.fov[..., None], to_rgb(NOTHING), to_rgb(OUTSIDE))
        axes.imshow(field, extent=self.extent, interpolation="nearest")
        start, vector = self.start_m, self.end_m - self.start_m
        axes.quiver(*start.T, *vector.T, color=color, angles="xy", scale_units="xy", scale=1, width=0.006)
        axes.set(xlabel="right [m]", ylabel="forward [m]")
        return axes


def colors_of(names: Sequence[str]) -> list[tuple[float, float, float]]:
    """A colour per map: its class's for the first map of a class, else the next one of a sequence of some dozens."""
    others, of_class = itertools.cycle(_COLORS), dict(zip(LABELS, CLASS_COLORS))
    return [to_rgb(of_class.pop(name, "") or next(others)) for name in names]


def add_legend_of_maps(
    axes: Axes, maps: Sequence[tuple[str, tuple[float, float, float]]], nothing: bool, outside: bool
) -> None:
    """Add a legend beside the axes.

    maps: name and colour of each; more than a dozen are left out
    nothing, outside: whether there are cells without a map, and outside the field of view
    """
    entries = list(maps) if len(maps) <= _MAX_LEGEND else []
    entries += [("nothing", to_rgb(NOTHING))] if nothing else []
    entries += [("outside the view", to_rgb(OUTSIDE))] if outside else []
    patches = [Patch(facecolor=color, edgecolor="#777777", linewidth=0.5, label=name) for name, color in entries]
    axes.legend(handles=patches, fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1), borderaxespad=0)
