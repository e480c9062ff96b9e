"""Baked light: direct light of lamps and windows with shadows, and light reflected between surfaces.

All surfaces are diffuse. Light is computed at the cells of a coarse grid on each quad and linearly interpolated.
"""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

#: Side of a cell of the light map, metres.
CELL_M = 0.14
#: Light weaker than this (1 is well lit) is ignored, without a shadow ray.
FAINT = 0.02
#: Uniform light in place of further reflections.
AMBIENT = np.float32(0.02)
_LIFT_M = 2e-3
_LARGE_CELLS = 25


@dataclass(frozen=True)
class Lamp:
    """A small light source; `facing` is (0, 0, 0) if it shines in all directions."""

    position: np.ndarray  #: (3,) metres
    power: np.ndarray  #: (3,) linear RGB: irradiance at 1 m, perpendicular to the light
    facing: np.ndarray  #: (3,) unit vector from a window into the room


@dataclass(frozen=True)
class LightMap:
    """Linear RGB irradiance at the cells of each quad; a surface of albedo a has the colour a * light."""

    start: np.ndarray  #: (Q + 1,) int: the cells of quad q are start[q]:start[q + 1], row by row
    shape: np.ndarray  #: (Q, 2) int: rows and columns of cells
    light: np.ndarray  #: (cells, 3) float32

    @classmethod
    def uniform(cls, quads: int) -> "LightMap":
        """White light, one cell per quad."""
        return cls(np.arange(quads + 1), np.ones((quads, 2), np.int64), np.ones((quads, 3), np.float32))

    def exposed(self, albedo: np.ndarray, key: float) -> "LightMap":
        """Scaled to a median brightness of `key` on large surfaces; albedo: (Q, 3) linear RGB."""
        cells = self.shape.prod(axis=1)
        large = np.repeat(cells >= _LARGE_CELLS, np.diff(self.start))
        brightness = (self.light * np.repeat(albedo, np.diff(self.start), axis=0)).mean(axis=1)
        factor = key / max(float(np.median(brightness[large])), 1e-4)
        return LightMap(self.start, self.shape, self.light * np.float32(factor))

    def of(self, quad: int) -> np.ndarray:
        """(rows, columns, 3) of one quad."""
        return self.light[self.start[quad] : self.start[quad + 1]].reshape(*self.shape[quad], 3)


def bake(
    quads: np.ndarray, origin: np.ndarray, right: np.ndarray, down: np.ndarray, size_m: np.ndarray,
    faces: np.ndarray, albedo: np.ndarray, lamps: list[Lamp], hidden: np.ndarray,
    opaque: np.ndarray, directions: int,
) -> LightMap:  # fmt: skip
    """Light on (Q, 4, 3) quads.

    origin, right, down: (Q, 3) frames of their rectangles; size_m: (Q, 2) height and width of those;
    faces: (F, 3) int32 triangles of the quads' corners; albedo: (Q, 3) linear RGB; hidden: (Q,) bool,
    quads without light; opaque: (Q,) bool, quads that block light (lamp shades do not);
    directions: rays per cell for the light of other surfaces.
    """
    shape = np.where(hidden[:, None], 1, np.maximum(np.ceil(size_m / CELL_M), 1)).astype(np.int64)
    count = np.where(hidden, 0, shape.prod(axis=1))
    start = np.concatenate([[0], np.cumsum(np.maximum(count, 1))])
    quad = np.repeat(np.arange(len(quads)), np.diff(start))
    cell = np.arange(start[-1]) - start[quad]
    row, column = np.divmod(cell, shape[quad, 1])
    step = np.maximum(size_m, 1e-6) / shape
    point = origin[quad] + right[quad] * ((column + 0.5) * step[quad, 1])[:, None]
    point += down[quad] * ((row + 0.5) * step[quad, 0])[:, None]
    normal = np.cross(down, right)[quad]
    point = (point + _LIFT_M * normal).astype(np.float32)
    seen = np.flatnonzero(~hidden[quad])

    scene = EmbreeScene()
    blocking = faces[opaque[faces[:, 0] // 4]]
    TriangleMesh(scene, quads.reshape(-1, 3).astype(np.float32), blocking)
    quad_of_face = blocking[:, 0] // 4

    light = np.zeros((len(point), 3), np.float32)
    light[seen] = _direct(scene, point[seen], normal[seen].astype(np.float32), lamps)
    turn = (3 * (row % 3) + column % 3)[seen] * (2 * np.pi / 9)
    frame = start, shape, origin, right, down, step
    other = _looked_at(scene, quad_of_face, point[seen], normal[seen], turn, directions, *frame)
    reflected = albedo.astype(np.float32)[quad]
    dark = np.zeros((1, 3), np.float32)
    bounced = np.zeros_like(light[seen])
    for _ in range(2):
        total = light.copy()
        total[seen] += bounced
        bounced = np.concatenate([total * reflected, dark])[other].mean(axis=1)
    around = np.zeros_like(light)
    around[seen] = bounced
    light += AMBIENT + _smooth(around, quad, row, column, start, shape)
    return LightMap(start, shape, light)


def _smooth(light: np.ndarray, quad, row, column, start, shape) -> np.ndarray:
    """Mean over 3 x 3 cells of the same quad, which have evenly rotated directions."""
    total = np.zeros_like(light)
    for up in (-1, 0, 1):
        near_row = np.clip(row + up, 0, shape[quad, 0] - 1)
        for left in (-1, 0, 1):
            total += light[start[quad] + near_row * shape[quad, 1] + np.clip(column + left, 0, shape[quad, 1] - 1)]
    return total / 9


def _direct(scene: EmbreeScene, point: np.ndarray, normal: np.ndarray, lamps: list[Lamp]) -> np.ndarray:
    """(N, 3) irradiance from the lamps visible at each point."""
    light = np.zeros((len(point), 3), np.float32)
    for lamp in lamps:
        ray = lamp.position.astype(np.float32) - point
        distance2 = np.einsum("nc,nc->n", ray, ray)
        near = np.flatnonzero(distance2 < lamp.power.max() / FAINT)
        ray, distance2 = ray[near], np.maximum(distance2[near], 0.04)
        strength = np.einsum("nc,nc->n", ray, normal[near]) / distance2**1.5
        if lamp.facing.any():
            strength *= np.maximum(ray @ -lamp.facing.astype(np.float32), 0) / np.sqrt(distance2)
        bright = strength * lamp.power.max() > FAINT
        near, ray, strength = near[bright], ray[bright], strength[bright]
        if len(near):
            blocked = scene.run(point[near], ray, dists=np.full(len(near), 0.999, np.float32), query="OCCLUDED") >= 0
            light[near] += np.where(blocked, 0, strength)[:, None] * lamp.power.astype(np.float32)
    return light


def _looked_at(
    scene, quad_of_face, point, normal, turn, directions, start, shape, origin, right, down, step
) -> np.ndarray:
    """(N, directions) cell visible from each point per direction, rotated by `turn` (N,); `start[-1]` for none."""
    index = np.arange(directions) + 0.5
    radius, angle = np.sqrt(index / directions), index * np.pi * (3 - np.sqrt(5))  # Vogel's spiral: cosine-weighted
    helper = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    a = np.cross(normal, helper)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(normal, a)
    x = np.cos(turn)[:, None] * a + np.sin(turn)[:, None] * b
    y = np.cross(normal, x)
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1)
    ray = (np.stack([x, y, normal], axis=1).transpose(0, 2, 1) @ local.T).transpose(0, 2, 1)
    ray = np.ascontiguousarray(ray, np.float32).reshape(-1, 3)
    source = np.repeat(point, directions, axis=0)
    hit = scene.run(source, ray, query="INTERSECT", output=True)
    met = hit["primID"] >= 0
    quad = quad_of_face[hit["primID"][met]]
    offset = source[met] + ray[met] * hit["tfar"][met, None] - origin[quad]
    row = np.einsum("nc,nc->n", offset, down[quad]) / step[quad, 0]
    column = np.einsum("nc,nc->n", offset, right[quad]) / step[quad, 1]
    row = np.clip(row.astype(np.int64), 0, shape[quad, 0] - 1)
    column = np.clip(column.astype(np.int64), 0, shape[quad, 1] - 1)
    other = np.full(len(source), start[-1], np.int64)
    other[met] = start[quad] + row * shape[quad, 1] + column
    return other.reshape(-1, directions)
