"""The G-buffer: which texel of the scene every FPV pixel and every BEV cell sees, by one ray cast each.

Any modality that lives on the surfaces is then rendered by look-up, without casting again: that is what
makes a new texture for every sample cheap (paper, Section 3.2, "Data generation").
"""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from zerobev.config import CameraConfig
from zerobev.scenes.scene import Scene, texel_of_uv
from zerobev.sensors.cameras import Pose, bev_cell_centres, fpv_rays

_STEP_M = 1e-4  # behind a culled face the ray starts again this much farther


@dataclass(frozen=True)
class GBuffer:
    """What each ray of a sensor met."""

    texel: np.ndarray  #: (H, W, 3) int16: chart, row, column; chart -1 where nothing was met
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
        directions = fpv_rays(camera) @ pose.world_R_camera.T
        origins = np.broadcast_to(pose.centre(camera), directions.shape)
        return self._everything.cast(origins, directions)

    def bev(self, pose: Pose, camera: CameraConfig) -> GBuffer:
        """What the orthographic camera above sees, ceilings left out; `distance` is the height above the floor."""
        right, forward = bev_cell_centres(camera)
        start_m = camera.height_m + camera.bev_above_m
        local = np.stack([right, forward, np.full_like(right, start_m)], axis=-1)
        origins = local @ pose.world_R_map.T + (pose.x, pose.y, pose.floor_z)
        seen = self._below_ceiling.cast(origins, np.broadcast_to((0.0, 0.0, -1.0), origins.shape))
        height = np.where(seen.texel[..., 0] < 0, 0, start_m - seen.distance).astype(np.float32)
        return GBuffer(seen.texel, seen.instance, height)


class _Geometry:
    """The faces `keep` of a scene, ready for ray casting."""

    def __init__(self, scene: Scene, keep: np.ndarray) -> None:
        self._scene = scene
        self._keep = keep
        self._embree = EmbreeScene()
        self._mesh = TriangleMesh(self._embree, scene.vertices.astype(np.float32), scene.faces[keep].astype(np.int32))
        corner = scene.vertices[scene.faces[keep]]
        self._normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> GBuffer:
        """Cast rays of shape (H, W, 3); `distance` is in units of the length of the direction."""
        shape = origins.shape[:-1]
        face, weights, distance = self._first_visible(origins.reshape(-1, 3), directions.reshape(-1, 3))
        hit = face >= 0
        face = np.where(hit, self._keep[face], 0)
        uv = np.einsum("nc,ncd->nd", weights, self._scene.face_uv[face])
        texel = np.full((*hit.shape, 3), -1, np.int16)
        instance = np.zeros(hit.shape, np.uint16)
        chart_of_hit = self._scene.face_chart[face]
        for chart in np.unique(chart_of_hit[hit]):
            image = self._scene.chart_instance[chart]
            on = hit & (chart_of_hit == chart)
            row, column = texel_of_uv(uv[on], image.shape)
            texel[on] = np.stack([np.full_like(row, chart), row, column], axis=-1)
            instance[on] = image[row, column]
        distance = np.where(hit, distance, 0).astype(np.float32)
        return GBuffer(texel.reshape(*shape, 3), instance.reshape(shape), distance.reshape(shape))

    def _first_visible(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First face met by each ray that is not culled: index (-1: none), barycentric weights (N, 3), distance."""
        face, weights, distance = self._first(origins, directions)
        if self._scene.double_sided:
            return face, weights, distance
        pending = np.flatnonzero(self._is_back(face, directions))
        while pending.size:
            start = distance[pending] + _STEP_M
            again = origins[pending] + start[:, None] * directions[pending]
            face[pending], weights[pending], farther = self._first(again, directions[pending])
            distance[pending] = start + farther
            pending = pending[self._is_back(face[pending], directions[pending])]
        return face, weights, distance

    def _is_back(self, face: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Which of the faces met (-1: none) are seen from behind."""
        return (face >= 0) & (np.einsum("nd,nd->n", self._normal[face], directions) > 0)

    def _first(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First face met by each ray, front or back."""
        found = self._embree.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            query="INTERSECT",
            output=True,
        )
        u, v = found["u"], found["v"]
        return found["primID"], np.stack([1 - u - v, u, v], axis=-1), found["tfar"].astype(np.float64)
