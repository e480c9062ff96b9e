"""The G-buffer: which texel of the scene every FPV pixel and every BEV cell sees, by one ray cast each.

Any modality that lives on the surfaces is then rendered by look-up, without casting again: that is what
makes a new texture for every sample cheap (paper, Section 3.2, "Data generation").
"""

import functools
from dataclasses import dataclass, replace

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import Pose, bev_cell_centres, fpv_rays
from zerobev.scenes.scene import Scene

_STEP_M = 1e-4  # behind a culled face the ray starts again this much farther


@dataclass(frozen=True)
class GBuffer:
    """What each ray of a sensor met."""

    texel: np.ndarray  #: (H, W, 3) int16: chart, row, column; chart -1 where nothing was met
    atlas: (
        np.ndarray
    )  #: (H, W) int64: the texel's index in all charts laid end to end; their size where nothing was met
    instance: np.ndarray  #: (H, W) uint16 instance id, 0 where nothing was met
    distance: np.ndarray  #: (H, W) float32, metres: planar depth (FPV) or height above the floor (BEV); 0 for nothing


class RayCaster:
    """Casts the rays of both sensors into a scene. Back faces are passed through unless the scene is double-sided."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        ceiling = np.array([i.id for i in scene.instances if i.name.lower() == "ceiling"], np.uint16)
        # seen from above, a ceiling would hide the home; a single-sided one is culled, a double-sided one is left out
        below_ceiling = np.flatnonzero(~np.isin(scene.face_instance, ceiling))
        self._everything = _Geometry(scene, np.arange(len(scene.faces)))
        self._below_ceiling = _Geometry(scene, below_ceiling)

    def fpv(self, pose: Pose, camera: CameraConfig) -> GBuffer:
        """What the pinhole camera sees; `distance` is planar depth."""
        directions = _camera_rays(camera) @ pose.world_R_camera.T.astype(np.float32)
        origins = np.broadcast_to(pose.centre(camera).astype(np.float32), directions.shape)
        return self._everything.cast(origins, directions)

    def bev(self, pose: Pose, camera: CameraConfig) -> GBuffer:
        """What the orthographic camera above sees, ceilings left out; `distance` is the height above the floor."""
        right, forward = bev_cell_centres(camera)
        start_m = camera.height_m + camera.bev_above_m
        local = np.stack([right, forward, np.full_like(right, start_m)], axis=-1)
        origins = (local @ pose.world_R_map.T + (pose.x, pose.y, pose.floor_z)).astype(np.float32)
        down = np.broadcast_to(np.array([0, 0, -1], np.float32), origins.shape)
        seen = self._below_ceiling.cast(origins, down)
        height = np.where(seen.texel[..., 0] < 0, 0, start_m - seen.distance).astype(np.float32)
        return replace(seen, distance=height)


@functools.lru_cache(maxsize=4)
def _camera_rays(camera: CameraConfig) -> np.ndarray:
    return fpv_rays(camera).astype(np.float32)


class _Geometry:
    """The faces `keep` of a scene, ready for ray casting. Everything is in float32, as Embree is."""

    def __init__(self, scene: Scene, keep: np.ndarray) -> None:
        self._embree = EmbreeScene()
        self._mesh = TriangleMesh(self._embree, scene.vertices.astype(np.float32), scene.faces[keep].astype(np.int32))
        corner = scene.vertices[scene.faces[keep]]
        self._normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        self._double_sided = scene.double_sided
        # one look-up serves the hits on all charts; what comes last is nothing
        self._instance = np.concatenate([*(image.ravel() for image in scene.chart_instance), [np.uint16(0)]])
        self._shape = np.array([image.shape for image in scene.chart_instance])
        self._start = np.cumsum([0, *self._shape.prod(axis=1)])
        self._chart = scene.face_chart[keep]
        # texel coordinates (column, row) of a face's first corner, and of the two edges from there
        corner_px = scene.face_uv[keep] * self._shape[self._chart][:, None, ::-1].astype(np.float32)
        self._uv_px = np.concatenate([corner_px[:, 0], *np.moveaxis(corner_px[:, 1:] - corner_px[:, :1], 1, 0)], axis=1)

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> GBuffer:
        """Cast float32 rays of shape (H, W, 3); `distance` is in units of the length of the direction."""
        shape = origins.shape[:-1]
        face, u, v, distance = self._first_visible(origins.reshape(-1, 3), directions.reshape(-1, 3))
        texel = np.full((*shape, 3), -1, np.int16)
        atlas = np.full(shape, len(self._instance) - 1)
        hit = face >= 0
        place = np.flatnonzero(hit)
        # `take` is several times as fast as an index in brackets
        face, u, v = face.take(place), u.take(place), v.take(place)
        chart = self._chart.take(face)
        rows, columns = (side.take(chart) for side in self._shape.T)
        column, row, *edges = self._uv_px.take(face, axis=0).T
        column = np.clip((column + u * edges[0] + v * edges[2]).astype(np.intp), 0, columns - 1)
        row = np.clip((row + u * edges[1] + v * edges[3]).astype(np.intp), 0, rows - 1)
        texel.reshape(-1, 3)[place] = np.stack([chart, row, column], axis=1)
        atlas.reshape(-1)[place] = self._start.take(chart) + row * columns + column
        return GBuffer(texel, atlas, self._instance.take(atlas), np.where(hit, distance, 0).reshape(shape))

    def _first_visible(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
        """First face met by each ray that is not culled: index (-1: none), barycentric u and v, distance."""
        first = self._first(origins, directions)
        if self._double_sided:
            return first
        face, _, _, distance = first
        pending = np.flatnonzero(self._is_back(face, directions))
        while pending.size:
            start = distance[pending] + np.float32(_STEP_M)
            again = origins[pending] + start[:, None] * directions[pending]
            for values, found in zip(first, self._first(again, directions[pending])):
                values[pending] = found
            distance[pending] += start
            pending = pending[self._is_back(face[pending], directions[pending])]
        return first

    def _is_back(self, face: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Which of the faces met (-1: none) are seen from behind."""
        return (face >= 0) & (np.einsum("nd,nd->n", self._normal[face], directions) > 0)

    def _first(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
        """First face met by each ray, front or back: index (-1: none), barycentric u and v, distance."""
        found = self._embree.run(
            np.ascontiguousarray(origins), np.ascontiguousarray(directions), query="INTERSECT", output=True
        )
        return found["primID"], found["u"], found["v"], found["tfar"]
