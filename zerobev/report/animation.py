"""A walk as an animated PNG: it plays in JupyterLab, in static HTML and in every browser, without scripts."""

import io
from collections.abc import Sequence

import numpy as np
from IPython.display import Image as Shown
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from zerobev.mapping import Pose2D
from zerobev.mapping.grid import Grid
from zerobev.report.figures import maps_image

_COLOURS = 128  # of all frames together: the palette makes the file a third as large


def walk_animation(
    photographs: np.ndarray,
    maps: Sequence[tuple[int, np.ndarray, np.ndarray]],
    truth: np.ndarray,
    poses: Sequence[Pose2D],
    grid: Grid,
    frame_ms: int = 300,
) -> Shown:
    """Frames with the photograph of a view, the map of the home after it with the way so far, and the true map.

    photographs: (N, H, W, 3) uint8, and N poses
    maps: per frame the number of views so far, (8, R, C) bool, and (R, C) bool: cells in view so far
    truth: (8, R, C) bool
    grid: of the maps
    """
    x0, y0, x1, y1 = grid.extent
    figure = Figure(figsize=(8.4, 2.9), dpi=100, layout="tight")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(1, 3)
    photograph = panels[0].imshow(photographs[0])
    growing = panels[1].imshow(np.ones((*grid.shape, 3)), extent=(x0, x1, y0, y1), interpolation="nearest")
    panels[2].imshow(maps_image(truth, np.ones(grid.shape, bool)), extent=(x0, x1, y0, y1), interpolation="nearest")
    (way,) = panels[1].plot([], [], color="black", linewidth=1)
    (camera,) = panels[1].plot([], [], "o", color="black", markersize=4)
    panels[0].set_axis_off()
    panels[2].set_title("true map", fontsize=8)
    for panel in panels[1:]:
        panel.tick_params(labelsize=8)
        panel.set_xlabel("x [m]", fontsize=8)
        panel.set_ylabel("y [m]", fontsize=8)
    x, y = (np.array([getattr(pose, axis) for pose in poses]) for axis in ("x", "y"))
    frames = []
    for views, classes, viewed in maps:
        photograph.set_data(photographs[views - 1])
        growing.set_data(maps_image(classes, viewed))
        way.set_data(x[:views], y[:views])
        camera.set_data(x[views - 1 : views], y[views - 1 : views])
        panels[0].set_title(f"view {views}", fontsize=8)
        panels[1].set_title(f"map of {views} views", fontsize=8)
        canvas.draw()
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    palette = Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames])).quantize(_COLOURS)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    file = io.BytesIO()
    first.save(file, "PNG", save_all=True, append_images=others, duration=frame_ms, loop=0)
    return Shown(file.getvalue(), format="png")
