"""A view: all that the sensors record at one pose. `ViewSource` draws poses that see enough of the map."""

from dataclasses import astuple, dataclass, replace

import numpy as np

from zerobev.common.errors import InputError
from zerobev.config import AgentConfig, CameraConfig, TextureConfig
from zerobev.data.textures import MODSEM_DRAWS, modsem_textures
from zerobev.geometry.cameras import Pose
from zerobev.geometry.projection import fov_mask
from zerobev.rendering.gbuffer import RayCaster
from zerobev.rendering.photograph import Photographer
from zerobev.rendering.poses import navigable_floor
from zerobev.scenes.scene import Scene

_PREVIEW_PX = 64  # larger images are cast only if one of this size sees enough of the map
_MAX_TRIES = 50  # poses drawn per view


@dataclass(frozen=True)
class View:
    """One pose: samples of all streams are made of it by look-up. H pixels and M cells per side."""

    rgb: np.ndarray  #: (H, H, 3) uint8 photograph
    depth: np.ndarray  #: (H, H) float32 planar depth, metres, 0 for no surface
    fpv_texel: np.ndarray  #: (H, H, 3) int16 chart, row, column; chart -1 for no surface
    fpv_instance: np.ndarray  #: (H, H) uint16
    fpv_modsem: np.ndarray  #: (H, H) uint8: bit b is set if white in draw b of the scene's *Mod. Sem.* textures
    bev_texel: np.ndarray  #: (M, M, 3) int16
    bev_instance: np.ndarray  #: (M, M) uint16
    bev_modsem: np.ndarray  #: (M, M) uint8
    bev_height: np.ndarray  #: (M, M) float32, metres above the floor
    fov: np.ndarray  #: (M, M) bool: cells inside the field of view
    #: (4,) or (5,) float64: x, y, height of the floor (metres, world), yaw (radians); height of the camera above the
    #: floor (metres) if it differs between views
    pose: np.ndarray

    @property
    def height_m(self) -> float | None:
        """Height of the camera above the floor, if it differs between views."""
        return float(self.pose[4]) if len(self.pose) > 4 else None

    def seen_by(self, camera: CameraConfig) -> CameraConfig:
        """`camera` with the limits on heights that hold in this view."""
        return camera if self.height_m is None else camera.at_height(self.height_m)


class ViewSource:
    """Draws views of one scene. `texture` sets the *Mod. Sem.* textures; poses do not depend on it.

    heights_m: range of the camera's heights above the floor; None: that of `camera`
    """

    def __init__(
        self,
        scene: Scene,
        camera: CameraConfig,
        texture: TextureConfig,
        rng: np.random.Generator,
        heights_m: tuple[float, float] | None = None,
    ) -> None:
        self._agent = AgentConfig()
        self._heights_m = heights_m
        self._camera = camera
        self._rng = rng
        self.scene = scene
        self.floor = navigable_floor(scene, self._agent, rng)
        self._caster = RayCaster(scene)
        self._photographer = Photographer(scene, camera)
        child = rng.spawn(1)[0]
        draws = (modsem_textures(chart, texture, child) for chart in scene.chart_instance)
        bit = (1 << np.arange(MODSEM_DRAWS)).astype(np.uint8)
        bits = (np.einsum("drc,d->rc", white.view(np.uint8), bit).ravel() for white in draws)
        self._modsem = np.concatenate([*bits, [np.uint8(0)]])  # the last entry means 'no surface'

    def draw(self) -> View:
        """The view at a random pose that sees enough of the map, `AgentConfig.min_view` of it.

        Raises `InputError` if none is found.
        """
        for _ in range(_MAX_TRIES):
            pose = self.floor.draw(self._rng, self._heights_m)
            view = self.at(pose)
            if view is not None:
                return view
        raise InputError(
            f"scene {self.scene.name}: expected a view of at least {self._agent.min_view:.0%} of the map, "
            f"found none in {_MAX_TRIES} poses"
        )

    def at(self, pose: Pose) -> View | None:
        """The view at `pose`, or None if it sees too little of the map."""
        if self._camera.fpv_px > _PREVIEW_PX and self._is_blocked(replace(self._camera, fpv_px=_PREVIEW_PX), pose):
            return None
        fpv = self._caster.fpv(pose, self._camera)
        fov = fov_mask(fpv.distance, _at(pose, self._camera))
        if fov.mean() < self._agent.min_view:
            return None
        bev = self._caster.bev(pose, self._camera)
        return View(
            rgb=self._photographer.take(pose),
            depth=fpv.distance,
            fpv_texel=fpv.texel,
            fpv_instance=fpv.instance,
            fpv_modsem=self._modsem.take(fpv.atlas),
            bev_texel=bev.texel,
            bev_instance=bev.instance,
            bev_modsem=self._modsem.take(bev.atlas),
            bev_height=bev.distance,
            fov=fov,
            pose=np.array([value for value in astuple(pose) if value is not None]),
        )

    def _is_blocked(self, camera: CameraConfig, pose: Pose) -> bool:
        fov = fov_mask(self._caster.fpv(pose, camera).distance, _at(pose, camera))
        return fov.mean() < self._agent.min_view


def _at(pose: Pose, camera: CameraConfig) -> CameraConfig:
    return camera if pose.height_m is None else camera.at_height(pose.height_m)
