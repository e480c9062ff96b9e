"""The UV atlas of a home: one rectangle per quad, texels of one centimetre."""

from dataclasses import dataclass

import numpy as np

#: Texels per metre, on all quads.
TEXELS_PER_M = 100.0
#: Largest side of a chart, texels.
CHART_PX = 1024
#: Texels of the same owner around each rectangle, so that a nearest look-up never reaches a neighbour.
PAD_PX = 1


@dataclass(frozen=True)
class Atlas:
    """Positions of Q quads in the charts. Rectangles are (row, column, height, width), padding included."""

    chart: np.ndarray  #: (Q,) int16
    rectangle: np.ndarray  #: (Q, 4) int32, texels
    shapes: tuple[tuple[int, int], ...]  #: (rows, columns) of each chart
    corners: np.ndarray  #: (Q, 4, 2) float64: column and row of the corners in their chart, texels
    origin: np.ndarray  #: (Q, 3) float64, metres: the world point of a rectangle's inner upper left corner
    right: np.ndarray  #: (Q, 3) unit vector along a row
    down: np.ndarray  #: (Q, 3) unit vector along a column

    @property
    def uv(self) -> np.ndarray:
        """(Q, 4, 2) float32: u right and v down, in [0, 1]."""
        size = np.array(self.shapes, float)[self.chart][:, None, ::-1]
        return (self.corners / size).astype(np.float32)

    def owner_images(self, owner: np.ndarray) -> tuple[np.ndarray, ...]:
        """One uint16 image per chart, with `owner` ((Q,) int) of each quad in its rectangle; 0 elsewhere."""
        images = tuple(np.zeros(shape, np.uint16) for shape in self.shapes)
        for chart, (row, column, height, width), value in zip(self.chart, self.rectangle, owner):
            images[chart][row : row + height, column : column + width] = value
        return images


def unwrap(quads: np.ndarray, hidden: np.ndarray) -> Atlas:
    """Arrange (Q, 4, 3) quads, metres, in charts; a hidden quad ((Q,) bool) has a single texel.

    Quads are flattened with the first edge horizontal and the scale of `TEXELS_PER_M`.
    """
    right = quads[:, 1] - quads[:, 0]
    right = right / np.linalg.norm(right, axis=1, keepdims=True)
    normal = np.cross(right, quads[:, 2] - quads[:, 0])
    down = -np.cross(normal / np.linalg.norm(normal, axis=1, keepdims=True), right)
    along, below = np.einsum("qkc,qc->qk", quads, right), np.einsum("qkc,qc->qk", quads, down)
    flat = np.stack([along - along.min(axis=1, keepdims=True), below - below.min(axis=1, keepdims=True)], axis=-1)
    origin = quads[:, 0] - flat[:, 0, :1] * right - flat[:, 0, 1:] * down
    texels = np.where(hidden[:, None, None], 0.0, flat * TEXELS_PER_M)
    size = np.maximum(np.ceil(texels.max(axis=1) - 1e-6), 1).astype(np.int32) + 2 * PAD_PX
    chart, row, column, shapes = _pack(size[:, 1], size[:, 0])
    start = np.stack([column, row], axis=1)[:, None] + float(PAD_PX)
    corners = start + np.where(hidden[:, None, None], 0.5, texels)
    rectangle = np.stack([row, column, size[:, 1], size[:, 0]], axis=1).astype(np.int32)
    return Atlas(chart, rectangle, shapes, corners, origin, right, down)


def _pack(height: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple]:
    """Shelf packing, tallest first, each on the first shelf with room: chart, row, column, and the charts' shapes."""
    chart, row, column = (np.zeros(len(height), np.int32) for _ in range(3))
    free = np.zeros(0, np.int64)  # width left on each shelf
    shelves: list[tuple[int, int]] = []  # chart and row of each
    used = [0]  # rows of each chart
    for index in np.lexsort((-width, -height)):
        h, w = int(height[index]), int(width[index])
        shelf = int(np.argmax(free >= w)) if len(free) else 0
        if not len(free) or free[shelf] < w:
            open_chart = next((c for c, rows in enumerate(used) if rows + h <= CHART_PX), len(used))
            if open_chart == len(used):
                used.append(0)
            shelf = len(shelves)
            shelves.append((open_chart, used[open_chart]))
            free = np.append(free, CHART_PX)
            used[open_chart] += h
        chart[index], row[index] = shelves[shelf]
        column[index] = CHART_PX - free[shelf]
        free[shelf] -= w
    return chart.astype(np.int16), row, column, tuple((rows, CHART_PX) for rows in used)
