"""Where an agent can stand in a scene, and poses drawn uniformly from there (paper, Section 4)."""

from dataclasses import dataclass

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy import ndimage

from zerobev.config import LABELS, AgentConfig
from zerobev.errors import InputError
from zerobev.scenes.scene import Scene
from zerobev.sensors.cameras import Pose

_SAMPLES_PER_M2 = 2000  # surface samples that find obstacles: five for each 5 cm cell of a horizontal surface
_LEVEL = 0.9  # a floor face's normal points up at least this much


@dataclass(frozen=True)
class NavigableFloor:
    """Free floor of a scene: centres of the cells where the agent's axis may stand."""

    cells: np.ndarray  #: (N, 3) float64, metres, world
    grid_m: float

    @property
    def area_m2(self) -> float:
        """Navigable area."""
        return len(self.cells) * self.grid_m**2

    def draw(self, rng: np.random.Generator) -> Pose:
        """A pose with position uniform over the free floor and uniform heading."""
        x, y, z = self.cells[rng.integers(len(self.cells))]
        dx, dy = rng.uniform(-self.grid_m / 2, self.grid_m / 2, 2)
        return Pose(float(x + dx), float(y + dy), float(z), float(rng.uniform(-np.pi, np.pi)))


def navigable_floor(scene: Scene, agent: AgentConfig, rng: np.random.Generator) -> NavigableFloor:
    """Rasterise the floor, take away what the agent's body would meet, and keep patches of a useful size.

    Several storeys are handled one above the other. Raises `InputError` where no free floor is left.
    """
    corner = scene.vertices[scene.faces].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    up = np.abs(normal[:, 2]) > _LEVEL * np.linalg.norm(normal, axis=1)
    floor = up & (scene.instance_label[scene.face_instance] == LABELS.index("floor"))
    if not floor.any():
        raise InputError(f"scene {scene.name}: expected a horizontal face of class floor, found none")
    low = corner[floor].min(axis=(0, 1))[:2]
    shape = tuple(np.ceil((corner[floor].max(axis=(0, 1))[:2] - low) / agent.grid_m).astype(int) + 1)
    obstacles = _surface_samples(scene, ~floor, rng)
    obstacle_cell = np.floor((obstacles[:, :2] - low) / agent.grid_m).astype(int)
    inside = ((obstacle_cell >= 0) & (obstacle_cell < shape)).all(axis=1)
    obstacles, obstacle_cell = obstacles[inside, 2], obstacle_cell[inside]

    cells = []
    for height in _storeys(scene, floor, low, shape, agent):
        above = obstacles - height[*obstacle_cell.T]
        hit = (above > agent.climb_m) & (above < agent.height_m)
        free = np.isfinite(height)
        free[*obstacle_cell[hit].T] = False
        # the axis keeps the radius from everything that is not free, the border of the grid included
        room = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * agent.grid_m > agent.radius_m
        patch, count = ndimage.label(room)
        area = ndimage.sum_labels(room, patch, np.arange(count + 1)) * agent.grid_m**2
        i, j = np.nonzero(room & (area[patch] >= agent.island_m2))
        cells.append(np.stack([*(low[:, None] + (np.stack([i, j]) + 0.5) * agent.grid_m), height[i, j]], axis=1))
    found = np.concatenate(cells)
    if not len(found):
        raise InputError(f"scene {scene.name}: expected at least {agent.island_m2} m2 of free floor, found none")
    return NavigableFloor(found, agent.grid_m)


def _surface_samples(scene: Scene, keep: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) points drawn uniformly on the faces `keep`."""
    mesh = trimesh.Trimesh(scene.vertices, scene.faces[keep], process=False)
    if mesh.area == 0:
        return np.zeros((0, 3))
    count = int(mesh.area * _SAMPLES_PER_M2)
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=rng)
    return np.asarray(points)


def _storeys(
    scene: Scene, floor: np.ndarray, low: np.ndarray, shape: tuple[int, int], agent: AgentConfig
) -> list[np.ndarray]:
    """Floor height of each grid cell, one (I, J) array a storey from the lowest up; NaN where there is no floor.

    Floors of one storey are no step higher than `climb_m` apart, so that a gallery ends at its edge.
    """
    embree = EmbreeScene()
    mesh = TriangleMesh(embree, scene.vertices.astype(np.float32), scene.faces[floor].astype(np.int32))
    i, j = np.indices(shape)
    start = np.full(shape, scene.vertices[:, 2].max() + 1.0)
    layers = []  # from the top down; one layer may be upper floor here and lower floor there
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
        # what lies within the agent's height below is the same storey (the floor under a rug)
        start = np.where(hit, height - agent.height_m, -1e6)
    del mesh  # Embree points into its arrays until here
    heights = np.sort(np.concatenate([height[np.isfinite(height)] for height in layers]))
    lowest = heights[1:][np.diff(heights) > agent.climb_m]  # of each storey but the first
    storey = np.searchsorted(lowest, layers, side="right")
    return [np.fmax.reduce(np.where(storey == k, layers, np.nan)) for k in range(len(lowest) + 1)]
