"""Figures of the notebooks and the page of results."""

from collections.abc import Collection, Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from zerobev.config import LABELS, NO_LABEL, CameraConfig
from zerobev.evaluation.metrics import bootstrap_interval, class_iou, pixel_iou
from zerobev.experiments.run_records import RunRecord
from zerobev.geometry.cameras import Pose
from zerobev.rendering.gbuffer import RayCaster
from zerobev.report.paper import TABLES
from zerobev.report.tables import rows_of
from zerobev.scenes.scene import Scene

#: One colour per class, in the order of `LABELS`.
COLORS = ("#4c566a", "#c9b79c", "#e07a1f", "#3a7d44", "#2f6db5", "#7cc36e", "#b04fb0", "#d62839")
#: (9, 3) uint8: these, then light grey for `NO_LABEL`.
_PALETTE = (255 * to_rgba_array([*COLORS, "#ececec"])[:, :3]).round().astype(np.uint8)


def label_image(label: np.ndarray, fov: np.ndarray | None = None) -> np.ndarray:
    """(H, W) labels -> (H, W, 3) uint8 colours; white outside `fov`."""
    image = _PALETTE[label]
    return image if fov is None else np.where(fov[..., None], image, np.uint8(255))


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
    """Both averages per row of a table: ours with 90 % intervals over scenes and seeds, the paper's as crosses."""
    rows = [row for row in rows_of(number) if any(record.row == row for record in records)]
    figure, panels = plt.subplots(1, 2, figsize=(8, 0.9 + 0.28 * len(rows)), sharey=True)
    for axes, (name, statistic) in zip(panels, {"class": class_iou, "pixel": pixel_iou}.items()):
        for y, row in enumerate(rows):
            counts = [record.counts for record in records if record.row == row]
            low, high = bootstrap_interval(counts, statistic, np.random.default_rng(0))
            mean = np.mean([one.value(statistic) for one in counts])
            axes.plot([100 * low, 100 * high], [y, y], color=COLORS[4], linewidth=3, alpha=0.5)
            axes.plot(100 * mean, y, "o", color=COLORS[4])
            if (published := TABLES.get(number, {}).get(row)) is not None:
                axes.plot(published.class_iou if name == "class" else published.pixel_iou, y, "x", color=COLORS[0])
        axes.set(xlabel=f"{name} IoU [%]", xlim=(0, None))
        axes.grid(axis="x", alpha=0.3)
    panels[0].set_yticks(range(len(rows)), [f"({row})" for row in rows])
    panels[0].invert_yaxis()
    figure.tight_layout()
    return figure


def gallery_figure(views: Mapping[str, np.ndarray], maps: Mapping[str, np.ndarray]) -> Figure:
    """One line per view of the test scenes: photograph, its labels, the maps of each row, and the true map.

    views: see `zerobev.experiments.gallery.gallery`
    maps: row -> (N, 8, M, M) bool, see `RunStore.maps`
    """
    truth = [label_image(label, fov) for label, fov in zip(views["bev_label"], views["fov"])]
    predicted = [
        (f"({row})", [maps_image(m, fov) for m, fov in zip(masks, views["fov"])]) for row, masks in maps.items()
    ]
    labels = [label_image(label) for label in views["fpv_label"]]
    figure = grid([("photograph", views["rgb"]), ("FPV labels", labels), *predicted, ("truth", truth)], side=1.2)
    add_legend(figure)
    return figure


def grid(columns: Sequence[tuple[str, Collection[np.ndarray]]], side: float = 1.5) -> Figure:
    """A figure of image columns, each with a title and one image per row; 2-D images are grey.

    side: of an image, inches
    """
    rows = len(columns[0][1])
    figure, axes = plt.subplots(rows, len(columns), figsize=(side * len(columns), side * rows + 0.3), squeeze=False)
    for j, (title, images) in enumerate(columns):
        axes[0, j].set_title(title, fontsize=8)
        for i, image in enumerate(images):
            axes[i, j].imshow(image, cmap="gray", interpolation="nearest")
            axes[i, j].set_axis_off()
    figure.tight_layout(pad=0.3)
    return figure


def add_legend(figure: Figure) -> None:
    """Add the eight classes and their colours below a figure."""
    patches = [Patch(color=color, label=name) for name, color in zip(LABELS, COLORS)]
    figure.legend(handles=patches, loc="lower center", ncols=len(LABELS), fontsize=7, bbox_to_anchor=(0.5, -0.04))


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
