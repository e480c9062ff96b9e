"""The navigable floor of a scene, and poses drawn uniformly from it (paper, Section 4)."""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy import ndimage

from zerobev.common.errors import InputError
from zerobev.config import LABELS, AgentConfig
from zerobev.geometry.cameras import Pose
from zerobev.scenes.scene import Scene

_SAMPLES_PER_M2 = 2000  # density of the samples of obstacles: five per 5 cm cell of a horizontal surface
_MIN_UP = 0.9  # minimum vertical part of a floor face's unit normal


@dataclass(frozen=True)
class NavigableFloor:
    """Free floor of a scene: centres of the cells for the agent's axis."""

    cells: np.ndarray  #: (N, 3) float64, metres, world
    grid_m: float

    @property
    def area_m2(self) -> float:
        """Navigable area, m2."""
        return len(self.cells) * self.grid_m**2

    def draw(self, rng: np.random.Generator, heights_m: tuple[float, float] | None = None) -> Pose:
        """A pose with uniform position on the free floor, uniform heading, and a height between `heights_m`, if given.

        The logarithm of the height is uniform.
        """
        x, y, z = self.cells[rng.integers(len(self.cells))]
        dx, dy = rng.uniform(-self.grid_m / 2, self.grid_m / 2, 2)
        yaw = float(rng.uniform(-np.pi, np.pi))
        height = None if heights_m is None else float(np.exp(rng.uniform(*np.log(heights_m))))
        return Pose(float(x + dx), float(y + dy), float(z), yaw, height)


def navigable_floor(scene: Scene, agent: AgentConfig, rng: np.random.Generator) -> NavigableFloor:
    """Rasterise the floor per storey, remove cells where the agent's body would collide, and remove small patches.

    Cells at a floor's end, or at a step of more than `climb_m`, are not navigable. Raises `InputError` if no free floor
    is left.
    """
    corner = scene.vertices[scene.faces].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    up = np.abs(normal[:, 2]) > _MIN_UP * np.linalg.norm(normal, axis=1)
    floor = up & (scene.instance_label[scene.face_instance] == LABELS.index("floor"))
    if not floor.any():
        raise InputError(f"scene {scene.name}: expected a horizontal face of class floor, found none")
    low = corner[floor].min(axis=(0, 1))[:2]
    shape = tuple(np.ceil((corner[floor].max(axis=(0, 1))[:2] - low) / agent.grid_m).astype(int) + 1)
    lowest, highest = corner[floor][..., 2].min() + agent.climb_m, corner[floor][..., 2].max() + agent.height_m
    obstacle = ~floor & (corner[..., 2].max(axis=1) > lowest) & (corner[..., 2].min(axis=1) < highest)
    x, y, z = _surface_samples(corner[obstacle], rng)
    i, j = (((axis - start) / agent.grid_m).astype(np.float32) for axis, start in zip((x, y), low))
    inside = np.flatnonzero((i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1]))
    obstacle_m = z.take(inside)
    obstacle_cell = i.take(inside).astype(np.intp) * shape[1] + j.take(inside).astype(np.intp)

    cells = []
    for height in _storeys(scene, floor, low, shape, agent):
        above = obstacle_m - height.ravel().take(obstacle_cell)
        free = np.isfinite(height) & ~_is_edge(height, agent.climb_m)
        free.ravel()[obstacle_cell[(above > agent.climb_m) & (above < agent.height_m)]] = False
        # the axis keeps a distance of the radius to cells that are not free, and to the border of the grid
        standing = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * agent.grid_m > agent.radius_m
        patch, count = ndimage.label(standing)
        area = ndimage.sum_labels(standing, patch, np.arange(count + 1)) * agent.grid_m**2
        i, j = np.nonzero(standing & (area[patch] >= agent.island_m2))
        cells.append(np.stack([*(low[:, None] + (np.stack([i, j]) + 0.5) * agent.grid_m), height[i, j]], axis=1))
    found = np.concatenate(cells)
    if not len(found):
        raise InputError(f"scene {scene.name}: expected at least {agent.island_m2} m2 of free floor, found none")
    return NavigableFloor(found, agent.grid_m)


def _surface_samples(corner: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """x, y and z, float32, of points drawn uniformly on the triangles `corner` (F, 3, 3)."""
    edge = corner[:, 1:] - corner[:, :1]
    area = np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1) / 2
    face = np.repeat(np.arange(len(corner)), np.ceil(area * _SAMPLES_PER_M2).astype(int))
    a, b = rng.random((2, len(face)), np.float32)
    beyond = a + b > 1  # points in the other half of the parallelogram are mirrored into the triangle
    a, b = np.where(beyond, 1 - a, a), np.where(beyond, 1 - b, b)
    sides = np.stack([corner[:, 0], edge[:, 0], edge[:, 1]]).astype(np.float32)
    start, first, second = (side.T for side in sides)
    return tuple(start[k].take(face) + a * first[k].take(face) + b * second[k].take(face) for k in range(3))


def _storeys(
    scene: Scene, floor: np.ndarray, low: np.ndarray, shape: tuple[int, int], agent: AgentConfig
) -> list[np.ndarray]:
    """Floor height of each grid cell: one (I, J) array per storey, from the lowest up, NaN without a floor.

    Sorted floor heights more than `climb_m` apart are of different storeys. If stairs of class floor join two storeys,
    one array has the upper floor of each cell, and the next one the lower floor.
    """
    embree = EmbreeScene()
    mesh = TriangleMesh(embree, scene.vertices.astype(np.float32), scene.faces[floor].astype(np.int32))
    i, j = np.indices(shape)
    start = np.full(shape, scene.vertices[scene.faces, 2].max() + 1.0)  # unused vertices may be anywhere
    layers = []  # from the top down; one layer may mix floors of several storeys
    while True:
        origins = np.stack([low[0] + (i + 0.5) * agent.grid_m, low[1] + (j + 0.5) * agent.grid_m, start], axis=-1)
        origins = np.ascontiguousarray(origins.reshape(-1, 3), np.float32)
        down = np.broadcast_to(np.array([0, 0, -1], np.float32), origins.shape)
        found = embree.run(origins, np.ascontiguousarray(down), query="INTERSECT", output=True)
        hit = found["primID"].reshape(shape) >= 0
        height = np.where(hit, start - found["tfar"].reshape(shape), np.nan)
        layers.append(height)
        if not hit.any():
            break
        # surfaces within the agent's height below are of the same storey, such as the floor under a rug
        start = np.where(hit, height - agent.height_m, -1e6)
    del mesh  # Embree uses its arrays until here
    heights = np.sort(np.concatenate([height[np.isfinite(height)] for height in layers]))
    starts = heights[1:][np.diff(heights) > agent.climb_m]  # lowest height of each storey except the first
    storey = np.searchsorted(starts, layers, side="right")
    of_storeys = [-np.sort(np.where(storey == k, np.negative(layers), np.nan), axis=0) for k in range(len(starts) + 1)]
    return [height for layer in of_storeys for height in layer if np.isfinite(height).any()]


def _is_edge(height: np.ndarray, climb_m: float) -> np.ndarray:
    """(I, J) bool: cells with a neighbour more than `climb_m` higher or lower."""
    edge = np.zeros(height.shape, bool)
    for axis in (0, 1):
        step = np.abs(np.diff(height, axis=axis)) > climb_m
        for side in ((1, 0), (0, 1)):
            edge |= np.pad(step, [side if k == axis else (0, 0) for k in (0, 1)])
    return edge
