"""The photographed textures: albedo times baked light per texel."""

from functools import lru_cache

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.atlas import TEXELS_PER_M, Atlas
from zerobev.scenes.indoor.light import LightMap
from zerobev.scenes.indoor.solids import Material


def paint(
    atlas: Atlas, hidden: np.ndarray, materials: list[Material], light: LightMap, exposure: float, shoulder: float
) -> list[np.ndarray]:
    """One (rows, columns, 3) uint8 sRGB image per chart.

    Tone mapping: light times `exposure`, with highlights compressed by `shoulder`.

    Light is linear and colours are sRGB with a gamma of 2, so that colours are multiplied by the root of the light.
    Patterns are aligned to world coordinates, so that they continue across neighbouring quads of a plane.
    """
    planes = [np.zeros((3, *shape), np.uint8) for shape in atlas.shapes]
    exposed = light.light.T * np.float32(exposure) / (1 + np.float32(shoulder) * light.light.T)
    root = np.sqrt(exposed) * np.float32(255)
    offset = np.stack(
        [np.einsum("qc,qc->q", atlas.origin, atlas.down), np.einsum("qc,qc->q", atlas.origin, atlas.right)], axis=1
    )
    offset = (np.floor(offset * TEXELS_PER_M).astype(int) % surfaces.TILE_PX).tolist()
    start, cells = light.start.tolist(), light.shape.tolist()
    color = np.array([m.color for m in materials], np.float32)[:, :, None, None]
    change = (np.array([m.second for m in materials], np.float32)[:, :, None, None] - color) / np.float32(255)
    for quad, (row, column, height, width) in enumerate(atlas.rectangle.tolist()):
        if hidden[quad]:
            continue
        y, x = offset[quad]
        shown = surfaces.tile(materials[quad].pattern)[y : y + height, x : x + width] * change[quad]
        shown += color[quad]
        if materials[quad].glow:
            shown *= 255
        else:
            shown *= _spread(root[:, start[quad] : start[quad + 1]], cells[quad], height, width)
        np.minimum(shown, 255, out=shown)
        planes[atlas.chart[quad]][:, row : row + height, column : column + width] = shown
    return [np.ascontiguousarray(plane.transpose(1, 2, 0)) for plane in planes]


def _spread(cells: np.ndarray, shape: list[int], height: int, width: int) -> np.ndarray:
    """(3, rows * columns) cells, linearly interpolated to (3, height, width) texels."""
    rows, columns = shape
    if rows == columns == 1:
        return cells[:, :, None]
    light = cells.reshape(3, rows, columns)
    return _hat(height, rows) @ light @ _hat(width, columns).T


@lru_cache(maxsize=4096)
def _hat(texels: int, cells: int) -> np.ndarray:
    """(texels, cells) float32 weights of linear interpolation between the centres of cells."""
    at = np.clip((np.arange(texels, dtype=np.float32) + 0.5) * cells / texels - 0.5, 0, cells - 1)
    return np.maximum(1 - np.abs(at[:, None] - np.arange(cells, dtype=np.float32)), 0)
