"""The G-buffer: the texel of the scene at every FPV pixel and BEV cell, by one ray cast each.

Any modality on the surfaces is then rendered by look-up, without further ray casts, so that a new texture per sample is
cheap (paper, Section 3.2, "Data generation").
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import Pose, bev_cell_centres, fpv_rays
from zerobev.scenes.categories import is_ceiling
from zerobev.scenes.scene import Scene

#: Writable arrays with one entry per ray: index of the face (-1: none), barycentric u and v, distance.
Hits = tuple[np.ndarray, ...]

_STEP_M = 1e-4  # a ray that passes a face continues this far behind it
_EDGE_M = 1e-3  # the map starts this far below `max_height_m`, so that undersides at that height are above it
_MAX_SIDE_M = 1.0  # maximum distance of the sides of a body without a bottom; under a roof it is larger


@dataclass(frozen=True)
class GBuffer:
    """The first surface on each ray of a sensor."""

    texel: np.ndarray  #: (H, W, 3) int16: chart, row, column; chart -1 for no hit
    atlas: np.ndarray  #: (H, W) int64: index of the texel in the concatenated charts; their size for no hit
    instance: np.ndarray  #: (H, W) uint16 instance id, 0 for no hit
    distance: np.ndarray  #: (H, W) float32, metres: planar depth (FPV) or height above the floor (BEV); 0 for no hit


class RayCaster:
    """Casts the rays of both sensors into a scene. Rays pass through the backs of faces that are not double-sided.

    The map is a cut through the scene, `max_height_m` above the floor at the camera; inverse projection leaves out the
    points above the same height. A cell shows the first surface below the cut, and nothing above it: no ceiling, lamp
    or further storey, independent of names and of the faces' orientation. If the cut goes through a body, such as a
    wall or a tall wardrobe, the cell shows the top of the body, at its height. A point is inside a body if the next
    face below points down, or if the next face above points up and sides of the same instance are near. Ceilings by
    name (`is_ceiling`) are left out at any height, so that a low one does not hide the floor.

    In generated flats the map is seen by a camera `bev_above_m` above the pinhole, as in the paper. Their ceilings face
    down, with nothing above; lamps are therefore on the map, and recorded data depend on it.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        ceilings = np.array([i.id for i in scene.instances if is_ceiling(i.name)], np.uint16)
        self._everything = _Geometry(scene, np.arange(len(scene.faces)))
        self._below_ceiling = _Geometry(scene, np.flatnonzero(~np.isin(scene.face_instance, ceilings)))

    def fpv(self, pose: Pose, camera: CameraConfig) -> GBuffer:
        """The pinhole camera's view; `distance` is planar depth."""
        rays = _camera_rays(camera)
        if pose.height_m is not None:
            rays = rays * np.array([1, pose.stretch(camera), 1], np.float32)
        directions = rays @ pose.world_R_camera.T.astype(np.float32)
        origins = np.broadcast_to(pose.centre(camera).astype(np.float32), directions.shape)
        return self._everything.cast(origins, directions)

    def bev(self, pose: Pose, camera: CameraConfig) -> GBuffer:
        """The map's view; `distance` is the height above the floor."""
        right, forward = bev_cell_centres(camera)
        in_generated = camera.height_m + camera.bev_above_m
        start_m = in_generated if self.scene.generated else camera.max_height_m - _EDGE_M
        local = np.stack([right, forward, np.full_like(right, start_m)], axis=-1)
        origins = (local @ pose.world_R_map.T + (pose.x, pose.y, pose.floor_z)).astype(np.float32)
        seen = self._below_ceiling.cast_down(origins, cut=not self.scene.generated)
        height = np.where(seen.texel[..., 0] < 0, 0, start_m - seen.distance).astype(np.float32)
        return replace(seen, distance=height)


def _along(points: np.ndarray, axis: int, sign: int) -> np.ndarray:
    """(N, 3) float32 directions along an axis of the world, one per point."""
    directions = np.zeros_like(points)
    directions[:, axis] = sign
    return directions


@functools.lru_cache(maxsize=4)
def _camera_rays(camera: CameraConfig) -> np.ndarray:
    return fpv_rays(camera).astype(np.float32)


class _Geometry:
    """The faces `keep` of a scene, prepared for ray casting, in float32 as Embree requires."""

    def __init__(self, scene: Scene, keep: np.ndarray) -> None:
        self._embree = EmbreeScene()
        self._mesh = TriangleMesh(self._embree, scene.vertices.astype(np.float32), scene.faces[keep].astype(np.int32))
        corner = scene.vertices[scene.faces[keep]]
        self._normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        self._double_sided = np.broadcast_to(scene.double_sided, len(scene.faces))[keep]
        self._owner = scene.face_instance[keep]
        # all charts in one array, for a single look-up; the last entry means 'no hit'
        self._instance = np.concatenate([*(image.ravel() for image in scene.chart_instance), [np.uint16(0)]])
        self._shape = np.array([image.shape for image in scene.chart_instance])
        self._start = np.cumsum([0, *self._shape.prod(axis=1)])
        self._chart = scene.face_chart[keep]
        # texel coordinates (column, row) of a face's first corner, and of its two edges from there
        corner_px = scene.face_uv[keep] * self._shape[self._chart][:, None, ::-1].astype(np.float32)
        self._uv_px = np.concatenate([corner_px[:, 0], *np.moveaxis(corner_px[:, 1:] - corner_px[:, :1], 1, 0)], axis=1)

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> GBuffer:
        """Cast float32 rays of shape (H, W, 3); `distance` is in units of the direction's length."""
        found = self._first_visible(origins.reshape(-1, 3), directions.reshape(-1, 3))
        return self._look_up(found, origins.shape[:-1])

    def cast_down(self, origins: np.ndarray, cut: bool) -> GBuffer:
        """Cast rays straight down from float32 points of shape (H, W, 3).

        With `cut`, a ray that starts in a body hits the body's top, at a negative distance.
        """
        points = np.ascontiguousarray(origins.reshape(-1, 3))
        found = self._first_visible(points, _along(points, 2, -1))
        if cut:
            self._put_tops(points, found)
        return self._look_up(found, origins.shape[:-1])

    def _put_tops(self, points: np.ndarray, found: Hits) -> None:
        """Replace the hits of points inside a body by the body's top, vertically above."""
        body = self._body(points)
        ray = np.flatnonzero(body >= 0)
        inside, up = points[ray], _along(points[ray], 2, 1)

        def is_not_top(face: np.ndarray, of: np.ndarray) -> np.ndarray:
            return ~(self._is_back(face, up[of]) & (self._owner[face] == body[ray[of]]))

        top = self._first_unpassed(inside, up, is_not_top)
        ray, top = ray[top[0] >= 0], tuple(values[top[0] >= 0] for values in top)
        for values, new in zip(found, (*top[:3], -top[3])):
            values[ray] = new

    def _body(self, points: np.ndarray) -> np.ndarray:
        """(N,) instance id of the body around each point (N, 3), -1 for none."""
        down, up = _along(points, 2, -1), _along(points, 2, 1)
        below, above = self._first(points, down)[0], self._first(points, up)[0]
        body = np.where(self._is_back(below, down), self._owner[below].astype(int), -1)
        # a body may have no bottom: then the next face below is the floor under it
        open_below = np.flatnonzero((body < 0) & self._is_back(above, up))
        owner, start = self._owner[above[open_below]], points[open_below]
        enclosed = np.zeros(len(open_below), bool)
        for axis in (0, 1):
            sides = [self._first(start, _along(start, axis, sign)) for sign in (-1, 1)]
            near = [(face >= 0) & (distance < _MAX_SIDE_M) for face, _, _, distance in sides]
            own = [self._owner[face] == owner for face, *_ in sides]
            enclosed |= near[0] & near[1] & (own[0] | own[1])
        body[open_below] = np.where(enclosed, owner, -1)
        return body

    def _look_up(self, found: Hits, shape: tuple[int, ...]) -> GBuffer:
        """The texels of hits; `shape` is that of the image, with a ray per pixel."""
        face, u, v, distance = found
        texel = np.full((*shape, 3), -1, np.int16)
        atlas = np.full(shape, len(self._instance) - 1)
        hit = face >= 0
        ray = np.flatnonzero(hit)
        # `take` is several times as fast as an index in brackets
        face, u, v = face.take(ray), u.take(ray), v.take(ray)
        chart = self._chart.take(face)
        rows, columns = (side.take(chart) for side in self._shape.T)
        column, row, *edges = self._uv_px.take(face, axis=0).T
        column = np.clip((column + u * edges[0] + v * edges[2]).astype(np.intp), 0, columns - 1)
        row = np.clip((row + u * edges[1] + v * edges[3]).astype(np.intp), 0, rows - 1)
        texel.reshape(-1, 3)[ray] = np.stack([chart, row, column], axis=1)
        atlas.reshape(-1)[ray] = self._start.take(chart) + row * columns + column
        return GBuffer(texel, atlas, self._instance.take(atlas), np.where(hit, distance, 0).reshape(shape))

    def _first_visible(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """First face on each ray that is not culled."""
        if self._double_sided.all():
            return self._first(origins, directions)

        def is_culled(face: np.ndarray, ray: np.ndarray) -> np.ndarray:
            return self._is_back(face, directions[ray]) & ~self._double_sided[face]

        return self._first_unpassed(origins, directions, is_culled)

    def _first_unpassed(
        self, origins: np.ndarray, directions: np.ndarray, is_passed: Callable[[np.ndarray, np.ndarray], np.ndarray]
    ) -> Hits:
        """First face on each ray for which `is_passed(face, ray)`, of indices (N,), is false."""
        found = self._first(origins, directions)
        face, _, _, distance = found
        pending = np.flatnonzero(face >= 0)
        pending = pending[is_passed(face[pending], pending)]
        while pending.size:
            start = distance[pending] + np.float32(_STEP_M)
            again = origins[pending] + start[:, None] * directions[pending]
            for values, new in zip(found, self._first(again, directions[pending])):
                values[pending] = new
            distance[pending] += start
            pending = pending[face[pending] >= 0]
            pending = pending[is_passed(face[pending], pending)]
        return found

    def _is_back(self, face: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(N,) bool: whether the face (-1: none) is hit from behind."""
        return (face >= 0) & (np.einsum("nd,nd->n", self._normal[face], directions) > 0)

    def _first(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """First face on each ray, front or back."""
        found = self._embree.run(
            np.ascontiguousarray(origins), np.ascontiguousarray(directions), query="INTERSECT", output=True
        )
        return found["primID"], found["u"], found["v"], found["tfar"]
