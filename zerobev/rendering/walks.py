"""Walks through a scene: a tour of shortest paths through all its rooms."""

from itertools import pairwise

import numpy as np
from scipy import ndimage
from skimage.graph import MCP_Geometric

from zerobev.common.errors import InputError
from zerobev.config import LABELS, AgentConfig
from zerobev.geometry.cameras import Pose
from zerobev.rendering.poses import NavigableFloor
from zerobev.scenes.scene import Scene

Cell = tuple[int, int]

#: Every point of the floor is at most this far from a stop of the tour, on foot.
REACH_M = 3.5
STEP_M = 0.5  #: between two poses, along the path


def walk(scene: Scene, floor: NavigableFloor, views: int) -> list[Pose]:
    """`views` poses, `STEP_M` apart, along a tour of all rooms; each faces the next one.

    The tour stays on the largest connected part of one storey. Its stops are the middles of the rooms, and further
    points until `REACH_M` holds. It goes from each stop to the nearest one that is left, on the shortest path, and at
    its end back and forth on the same way.
    Raises `InputError` for a floor with one stop alone.
    """
    free, height, low = _raster(floor)
    paths = MCP_Geometric(np.where(free, 1.0, np.inf))
    middles = (_room_middles(scene) - low) / floor.grid_m - 0.5
    stops, distances = _stops(paths, free, middles, REACH_M / floor.grid_m)
    if len(stops) < 2:
        raise InputError(f"floor: expected a way of more than {REACH_M} m, found none")
    order = [0]
    while left := set(range(len(stops))) - set(order):
        order.append(min(sorted(left), key=lambda k: distances[order[-1]][stops[k]]))
    cells = [stops[order[0]]]
    for start, end in pairwise(order):
        paths.find_costs([stops[start]])
        cells += paths.traceback(stops[end])[1:]
    there = low + (np.array(cells) + 0.5) * floor.grid_m
    back_and_forth = [there, there[-2:0:-1]] * (1 + int(views * STEP_M / _length(there)))
    return _poses(np.concatenate(back_and_forth), float(np.median(height[free])), views)


def _raster(floor: NavigableFloor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The part to walk on, (I, J) bool; heights of the floor, (I, J); the lower left corner, (2,); float64, metres."""
    storey = np.abs(floor.cells[:, 2] - np.median(floor.cells[:, 2])) <= AgentConfig().climb_m
    x, y, z = floor.cells[storey].T
    low = np.array([x.min(), y.min()]) - floor.grid_m / 2
    i, j = (np.floor((axis - start) / floor.grid_m).astype(int) for axis, start in zip((x, y), low))
    height = np.full((i.max() + 1, j.max() + 1), np.nan)
    height[i, j] = z
    patch, count = ndimage.label(np.isfinite(height), structure=np.ones((3, 3)))
    return patch == 1 + np.argmax(np.bincount(patch.ravel(), minlength=count + 1)[1:]), height, low


def _room_middles(scene: Scene) -> np.ndarray:
    """(N, 2) float64: the middle of each region's floors, metres."""
    floors: dict[int, list[int]] = {}
    for instance in scene.instances:
        if instance.label == LABELS.index("floor"):
            floors.setdefault(instance.region, []).append(instance.id)
    bounds = [scene.instance_bounds[ids] for _, ids in sorted(floors.items())]
    middles = np.array([(each[:, 0].min(axis=0) + each[:, 1].max(axis=0))[:2] / 2 for each in bounds])
    return middles[np.isfinite(middles).all(axis=1)]  # a floor may have no face


def _stops(
    paths: MCP_Geometric, free: np.ndarray, middles: np.ndarray, reach: float
) -> tuple[list[Cell], list[np.ndarray]]:
    """The cells of the stops, and the walking distances from each to all cells; all lengths in cells."""
    cells = np.argwhere(free)
    nearest = [cells[np.linalg.norm(cells - middle, axis=1).argmin()] for middle in middles]
    waiting: list[Cell] = sorted({(int(i), int(j)) for i, j in nearest})
    stops: list[Cell] = []
    distances: list[np.ndarray] = []
    while waiting:
        stops.append(waiting.pop(0))
        distances.append(paths.find_costs([stops[-1]])[0].copy())  # all calls return one buffer
        left = np.where(free, np.min(distances, axis=0), 0)
        if not waiting and left.max() > reach:
            i, j = np.unravel_index(int(left.argmax()), free.shape)
            waiting.append((int(i), int(j)))
    return stops, distances


def _length(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _poses(path: np.ndarray, floor_z: float, views: int) -> list[Pose]:
    """Poses at equal distances along a polyline (N, 2)."""
    along = np.append(0, np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum())
    x, y = (np.interp(np.arange(views + 1) * STEP_M, along, axis) for axis in path.T)
    return [
        Pose(float(x[k]), float(y[k]), floor_z, float(np.arctan2(y[k + 1] - y[k], x[k + 1] - x[k])))
        for k in range(views)
    ]
