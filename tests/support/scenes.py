"""Scenes of a few rectangles with known places: what sensors and streams see of them has a closed form."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from zerobev.scenes.categories import label_of
from zerobev.scenes.hm3dsem import read_scene
from zerobev.scenes.scene import Instance, Scene

from support.paths import REAL_HOMES

TEXEL_M = 0.02
_MARGIN = 2  # texels around a rectangle in the atlas that belong to it
_CHART_COLUMNS = 512
_CHARTS = 2

Point = Sequence[float]


@dataclass(frozen=True)
class Thing:
    """One instance: (Q, 4, 3) rectangles, counter-clockwise as seen from their front."""

    name: str
    quads: np.ndarray


def box(name: str, low: Point, high: Point) -> Thing:
    """A closed box, seen from outside."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    quads = [
        [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)],  # top
        [(x0, y1, z0), (x1, y1, z0), (x1, y0, z0), (x0, y0, z0)],  # bottom
        [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)],
        [(x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)],
        [(x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)],
        [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
    ]
    return Thing(name, np.array(quads, np.float64))


def room(size: Point, corner: Point = (0, 0, 0), ceiling: str = "ceiling") -> list[Thing]:
    """Floor, ceiling and four walls of a room of `size` at `corner`, all seen from inside alone."""
    inside = box("room", corner, np.add(corner, size)).quads[:, ::-1]
    names = [ceiling, "floor", "wall", "wall", "wall", "wall"]
    return [Thing(name, quad[None]) for name, quad in zip(names, inside)]


def table(corner: Point, size: tuple[float, float], height: float = 0.75) -> list[Thing]:
    """A plate of 4 cm on four legs of 5 cm, at `corner` on the floor."""
    (x, y, z), (width, depth) = corner, size
    legs = [(x + a, y + b) for a in (0, width - 0.05) for b in (0, depth - 0.05)]
    plate = box("table", (x, y, z + height - 0.04), (x + width, y + depth, z + height))
    solids = [box("table", (a, b, z), (a + 0.05, b + 0.05, z + height - 0.04)) for a, b in legs]
    return [Thing("table", np.concatenate([plate.quads, *(leg.quads for leg in solids)]))]


def furnished() -> list[Thing]:
    """A room of 5 m x 4 m x 2.5 m with furniture of five of the eight classes."""
    return [
        *room((5, 4, 2.5)),
        box("bed", (0.2, 0.3, 0), (1.8, 2.3, 0.5)),
        box("chair", (2.6, 3.3, 0), (3.1, 3.8, 0.8)),
        box("tv", (4.85, 1.2, 0.9), (4.95, 2.2, 1.5)),
        box("rug", (2.2, 1.0, 0), (3.6, 2.0, 0.02)),
        *table((3.8, 2.8, 0), (1.0, 0.9)),
    ]


def build(things: Iterable[Thing], name: str = "test", double_sided: bool = False) -> Scene:
    """The scene made of `things`, instance ids from 1 on; the photograph shows each in its annotation colour.

    The first six things (a room) are on chart 0, all others on chart 1.
    """
    things = list(things)
    pens = [_Pen() for _ in range(_CHARTS)]
    quads, uv_px, charts = [], [], []
    for number, thing in enumerate(things):
        chart = min(number // 6, _CHARTS - 1)
        for quad in thing.quads:
            quads.append(quad)
            uv_px.append(pens[chart].place(quad, number + 1))
            charts.append(chart)
    images = tuple(pen.image() for pen in pens)
    shapes = np.array([image.shape[::-1] for image in images])
    uv = (np.array(uv_px) / shapes[charts][:, None]).astype(np.float32)
    corner = np.array([[0, 1, 2], [0, 2, 3]])
    vertices = np.concatenate(quads).astype(np.float32)
    faces = (4 * np.arange(len(quads))[:, None, None] + corner).reshape(-1, 3).astype(np.int32)
    instances = tuple(
        Instance(i, _color(i), thing.name, 0, label_of(thing.name)) for i, thing in enumerate(things, start=1)
    )
    face_chart = np.repeat(charts, 2).astype(np.int16)
    return Scene(
        name=name,
        vertices=vertices,
        faces=faces,
        face_uv=uv[:, corner].reshape(-1, 3, 2),
        face_chart=face_chart,
        chart_instance=images,
        instances=instances,
        photograph=_photograph(vertices, faces, uv.reshape(-1, 2), face_chart, images),
        unlit=True,
        double_sided=double_sided,
    )


class _Pen:
    """Places rectangles on a chart, in rows of rectangles."""

    def __init__(self) -> None:
        self._column, self._row, self._bottom = 0, 0, 1
        self._drawn: list[tuple[slice, slice, int]] = []

    def place(self, quad: np.ndarray, instance: int) -> np.ndarray:
        """(4, 2) texel coordinates (u right, v down) of the corners of `quad`."""
        width, height = (np.linalg.norm(quad[corner] - quad[0]) / TEXEL_M for corner in (1, 3))
        columns, rows = (int(np.ceil(length)) + 2 * _MARGIN for length in (width, height))
        if self._column + columns > _CHART_COLUMNS:
            self._column, self._row = 0, self._bottom
        column, row = self._column, self._row
        self._drawn.append((slice(row, row + rows), slice(column, column + columns), instance))
        self._column += columns
        self._bottom = max(self._bottom, row + rows)
        left, top = column + _MARGIN, row + _MARGIN
        right, bottom = left + width, top + height
        return np.array([(left, top), (right, top), (right, bottom), (left, bottom)])

    def image(self) -> np.ndarray:
        """Instance of each texel."""
        image = np.zeros((self._bottom, _CHART_COLUMNS), np.uint16)
        for rows, columns, instance in self._drawn:
            image[rows, columns] = instance
        return image


def _color(instance: int) -> tuple[int, int, int]:
    return (40 + 53 * instance % 200, 30 + 97 * instance % 211, 20 + 31 * instance % 199)


def _photograph(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, face_chart: np.ndarray, images: tuple[np.ndarray, ...]
) -> trimesh.Scene:
    scene = trimesh.Scene()
    for chart, image in enumerate(images):
        on = face_chart == chart
        if not on.any():
            continue
        used, local = np.unique(faces[on], return_inverse=True)
        palette = np.array([(0, 0, 0), *(_color(i) for i in range(1, image.max() + 1))], np.uint8)
        material = PBRMaterial(baseColorTexture=Image.fromarray(palette[image]), doubleSided=False)
        visual = TextureVisuals(uv[used] * (1, -1) + (0, 1), material=material)  # trimesh's v runs up
        scene.add_geometry(trimesh.Trimesh(vertices[used], local.reshape(-1, 3), visual=visual, process=False))
    return scene


def real_home() -> Scene:
    """A home of the development set, or a skipped test where there is none."""
    folder = REAL_HOMES / "val/00903-Sh3dStudioA"
    if not folder.is_dir():
        pytest.skip(f"no development homes at {REAL_HOMES}")
    return read_scene(folder)
