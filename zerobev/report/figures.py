"""Figures of the notebooks and the page of results."""

import re
from collections.abc import Collection, Mapping, Sequence
from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from zerobev.config import LABELS, NO_LABEL, CameraConfig
from zerobev.evaluation.metrics import bootstrap_interval, class_iou, pixel_iou
from zerobev.experiments.run_records import RunRecord
from zerobev.geometry.cameras import Pose
from zerobev.inference.bev_map import CLASS_COLORS, NOTHING, OUTSIDE
from zerobev.rendering.gbuffer import RayCaster
from zerobev.report.claims import Verdict, limit_of
from zerobev.report.names import named
from zerobev.report.paper import TABLES
from zerobev.report.tables import rows_of
from zerobev.scenes.scene import Scene

COLORS = CLASS_COLORS
#: Our numbers, and the paper's.
OURS, PAPER = COLORS[4], COLORS[2]
#: (10, 3) uint8: classes, outside, nothing (`NO_LABEL`, the last).
_PALETTE = (255 * to_rgba_array([*COLORS, OUTSIDE, NOTHING])[:, :3]).round().astype(np.uint8)


def label_image(label: np.ndarray, fov: np.ndarray | None = None) -> np.ndarray:
    """(H, W) labels -> (H, W, 3) uint8 colours; grey outside `fov`, white for no class."""
    image = _PALETTE[label]
    return image if fov is None else np.where(fov[..., None], image, _PALETTE[len(COLORS)])


def mask_image(mask: np.ndarray, fov: np.ndarray, color: str = "#ffffff", ground: str = "#000000") -> np.ndarray:
    """(M, M) bool -> (M, M, 3) uint8: one colour on a ground of another, grey outside `fov`."""
    palette = (255 * to_rgba_array([ground, color, OUTSIDE])[:, :3]).round().astype(np.uint8)
    return palette[np.where(fov, mask.astype(int), 2)]


def maps_image(maps: np.ndarray, fov: np.ndarray) -> np.ndarray:
    """Predicted masks (8, M, M) -> (M, M, 3) uint8 colours; later classes lie above earlier ones, floor below all."""
    label = np.full(maps.shape[1:], NO_LABEL)
    for index in sorted(range(len(LABELS)), key=lambda index: LABELS[index] != "floor"):
        label[maps[index]] = index
    return label_image(label, fov)


def flat(masks: np.ndarray) -> np.ndarray:
    """(K, H, W) bool -> one image (H, W) in [0, 1]: one grey per mask, brighter for earlier masks."""
    grey = np.linspace(0.4, 1, len(masks))[::-1] if len(masks) else np.zeros(0)
    return np.max(masks * grey[:, None, None], axis=0, initial=0)


def averages_figure(number: int, records: Sequence[RunRecord]) -> Figure:
    """Both averages per row of a table: ours with 90 % intervals over scenes and seeds, the paper's as crosses.

    Axes do not begin at zero, so that small differences are visible.
    """
    rows = [row for row in rows_of(number) if any(record.row == row for record in records)]
    figure, panels = plt.subplots(1, 2, figsize=(7, 1.2 + 0.38 * len(rows)), sharey=True)
    for axes, (name, statistic) in zip(panels, {"class": class_iou, "pixel": pixel_iou}.items()):
        for y, row in enumerate(rows):
            counts = [record.counts for record in records if record.row == row]
            low, high = bootstrap_interval(counts, statistic, np.random.default_rng(0))
            mean = np.mean([one.value(statistic) for one in counts])
            axes.plot([100 * low, 100 * high], [y, y], color=OURS, linewidth=3, alpha=0.5)
            ours = axes.plot(100 * mean, y, "o", color=OURS, clip_on=False)
            if (of_paper := TABLES.get(number, {}).get(row)) is not None:
                value = of_paper.class_iou if name == "class" else of_paper.pixel_iou
                paper = axes.plot(value, y, "x", color=PAPER, markeredgewidth=2, clip_on=False)
        axes.set(xlabel=f"{name} IoU [%]", ylim=(len(rows) - 0.6, -0.6))
        axes.margins(x=0.08)
        axes.grid(axis="x", alpha=0.3)
    panels[0].set_yticks([])
    for y, row in enumerate(rows):
        _text_above(panels[0], y, named(row))
    marks = {"ours, 90 % interval": ours} | ({"the paper's": paper} if number in TABLES else {})
    figure.tight_layout()
    handles = [mark[0] for mark in marks.values()]
    figure.legend(handles, list(marks), fontsize=9, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1), frameon=False)
    return figure


_LINEAR = 2  # the scoreboard's axis is linear up to so many points
_MARKS = {"holds": ("o", OURS), "undecided": ("D", "#8c8c8c"), "does not hold": ("s", PAPER)}


def scoreboard_figure(verdicts: Sequence[Verdict]) -> Figure:
    """Difference per claim, in IoU points: ours with its 90 % interval, the paper's as a cross; blue bars are limits.

    The axis is linear up to 2 points and logarithmic beyond, so that tenths of a point are visible beside tens.
    """
    shown = sorted((v for v in verdicts if v.ours is not None), key=lambda v: v.table)
    tables = [v.table for v in shown]
    figure, axes = plt.subplots(figsize=(6, 1.6 + 0.36 * len(shown)))
    axes.axvline(0, color="black", linewidth=0.8)
    for border in (-_LINEAR, _LINEAR):
        axes.axvline(border, color="#cccccc", linewidth=0.8, linestyle=":")
    for y, v in enumerate(shown):
        assert v.ours is not None and v.low is not None and v.high is not None  # as selected above
        marker, color = _MARKS[v.verdict]
        if (limit := limit_of(v)) is not None:
            axes.plot([0, limit], [y, y], color=COLORS[6], linewidth=8, alpha=0.4, solid_capstyle="butt")
        axes.plot([v.low, v.high], [y, y], color=color, linewidth=2)
        axes.plot(v.ours, y, marker, color=color, markersize=6)
        if v.paper is not None:
            axes.plot(v.paper, y, "x", color="black", markersize=6)
        _text_above(axes, y, f"{v.id}  {_short(v)}")
        if y and tables[y] != tables[y - 1]:
            axes.axhline(y - 0.6, color="#777777", linewidth=0.8)
    ticks = [-20, -5, -2, -1, 0, 1, 2, 5, 20]
    axes.set_xscale("symlog", linthresh=_LINEAR, linscale=1)
    axes.set_xticks(ticks, [f"{tick:+d}" if tick else "0" for tick in ticks])
    axes.minorticks_off()
    axes.set_yticks([])
    axes.set(ylim=(len(shown) - 0.6, -0.6))
    axes.set_xlabel("difference or spread, IoU points; linear between the dotted lines, logarithmic beyond", fontsize=9)
    axes.margins(x=0.05)
    marks: list[Artist] = [Line2D([], [], marker=m, color=c, label=f"ours: {name}") for name, (m, c) in _MARKS.items()]
    marks += [Line2D([], [], marker="x", color="black", linestyle="", label="the paper's")]
    marks += [Patch(color=COLORS[6], alpha=0.4, label="limit of a spread")]
    axes.legend(handles=marks, fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1), frameon=False)
    figure.tight_layout()
    return figure


def _text_above(axes: Axes, y: float, text: str) -> None:
    """Write above the marks at height `y`, from the left side on: figures stay narrow, and can be read on a phone."""
    box = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
    axes.text(0.01, y - 0.32, text, transform=axes.get_yaxis_transform(), va="center", fontsize=8, bbox=box)


def _short(verdict: Verdict) -> str:
    """A claim in a few words: both rows by name and the metric, or the text of a claim on several rows."""
    rows, _, text = verdict.claim.partition(": ")
    if limit_of(verdict) is not None:
        return f"{text}, {rows.rpartition(', ')[2]}"
    return re.sub(r"\((.+?)\)", lambda found: f"{named(found[1], letter=False)} {found[0]}", rows)


def gallery_figure(views: Mapping[str, np.ndarray], maps: Mapping[str, np.ndarray]) -> Figure:
    """One line per view of the test scenes: photograph, its labels, the maps of each row, and the true map.

    views: see `zerobev.experiments.gallery.gallery`
    maps: row -> (N, 8, M, M) bool, see `RunStore.maps`
    """
    truth = [label_image(label, fov) for label, fov in zip(views["bev_label"], views["fov"])]
    predicted = [
        (
            f"({row})\n{fill(named(row, letter=False), 15, break_on_hyphens=False)}",
            [maps_image(m, fov) for m, fov in zip(masks, views["fov"])],
        )
        for row, masks in maps.items()
    ]
    labels = [label_image(label) for label in views["fpv_label"]]
    figure = grid([("photograph", views["rgb"]), ("labels", labels), *predicted, ("true map", truth)], side=1.2)
    add_scale(figure.axes[len(predicted) + 2], truth[0].shape[0])
    add_legend(figure)
    return figure


def grid(columns: Sequence[tuple[str, Collection[np.ndarray]]], side: float = 1.5) -> Figure:
    """A figure of image columns, each with a title and one image per row; 2-D images are grey.

    side: of an image, inches
    """
    rows = len(columns[0][1])
    lines = max(title.count("\n") + 1 for title, _ in columns)
    size = (side * len(columns), side * rows + 0.1 + 0.2 * lines)
    figure, axes = plt.subplots(rows, len(columns), figsize=size, squeeze=False)
    for j, (title, images) in enumerate(columns):
        axes[0, j].set_title(title, fontsize=9)
        for i, image in enumerate(images):
            axes[i, j].imshow(image, cmap="gray", interpolation="nearest")
            axes[i, j].set_axis_off()
    figure.tight_layout(pad=0.3)
    return figure


def add_legend(figure: Figure) -> None:
    """Add the eight classes, "no class" and "outside the view" with their colours below a figure."""
    entries = [*zip(LABELS, COLORS), ("no class", NOTHING), ("outside the view", OUTSIDE)]
    patches = [Patch(facecolor=color, edgecolor="#777777", linewidth=0.5, label=name) for name, color in entries]
    ncols = 10 if figure.get_figwidth() > 8 else 5
    figure.legend(handles=patches, loc="upper center", ncols=ncols, fontsize=9, bbox_to_anchor=(0.5, 0.0))


def add_scale(axes: Axes, cells: int, extent_m: float = CameraConfig(fpv_px=1, bev_px=1).bev_extent_m) -> None:
    """Draw a bar of 1 m into a map of `cells` x `cells` cells that is `extent_m` wide."""
    right, low = 0.95 * cells, 0.94 * cells
    axes.plot([right - cells / extent_m, right], [low, low], color="black", linewidth=2)
    axes.text(right - cells / extent_m / 2, low - 0.02 * cells, "1 m", ha="center", va="bottom", fontsize=8)


def top_view(scene: Scene) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """The scene from above in cells of 5 cm: (M, M) int8 labels, and the `extent` for `imshow`, world metres."""
    low, high = scene.vertices[:, :2].min(axis=0), scene.vertices[:, :2].max(axis=0)
    side_m = float((high - low).max())
    # a BEV camera with a map of that size, at the middle of the southern edge, facing north
    camera = CameraConfig(fpv_px=1, bev_px=round(side_m / 0.05), bev_extent_m=side_m)
    middle = float((low[0] + high[0]) / 2)
    seen = RayCaster(scene).bev(Pose(middle, float(low[1]), float(scene.vertices[:, 2].min()), np.pi / 2), camera)
    extent = (middle - side_m / 2, middle + side_m / 2, float(low[1]), float(low[1]) + side_m)
    return scene.instance_label[seen.instance], extent
