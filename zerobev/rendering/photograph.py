"""Photographs (RGB) of a scene, rasterised by pyrender with EGL, on a GPU or by Mesa on the CPU."""

import numpy as np

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import Pose
from zerobev.rendering.opengl import pyrender, renderer
from zerobev.scenes.scene import Scene

_SUPERSAMPLING = 2  # rendered this much larger and averaged, against aliasing
NEAR_M, FAR_M = 0.05, 100.0
_SKY = (0.62, 0.75, 0.92)  # background
_AMBIENT, _HEADLAMP = 0.35, 6.0  # light of scenes without baked light
# camera axes: ours x right, y down, z forward; OpenGL's x right, y up, z backward
_CAMERA_R_OPENGL = np.diag([1.0, -1.0, -1.0])


class Photographer:
    """Renders photographs of one scene with one camera. All instances of a process share one OpenGL context."""

    def __init__(self, scene: Scene, camera: CameraConfig) -> None:
        from zerobev.rendering.surfaces import Solid, primitives  # imports pyrender, which may be missing

        self._camera = camera
        self._flags = pyrender.RenderFlags.FLAT if scene.unlit else pyrender.RenderFlags.NONE
        if np.any(scene.double_sided):
            self._flags |= pyrender.RenderFlags.SKIP_CULL_FACES
        self._scene = pyrender.Scene(ambient_light=[_AMBIENT] * 3, bg_color=[*_SKY, 1.0])
        solid, self._glass = primitives(scene.photograph)
        self._scene.add(Solid(solid))
        side = camera.fpv_px * _SUPERSAMPLING
        focal = camera.focal_px * _SUPERSAMPLING
        lens = pyrender.IntrinsicsCamera(focal, focal, side / 2, side / 2, NEAR_M, FAR_M)
        self._eye = self._scene.add(lens)
        if not scene.unlit:
            self._scene.add(pyrender.PointLight(intensity=_HEADLAMP), parent_node=self._eye)
        self._side = side

    def take(self, pose: Pose) -> np.ndarray:
        """(H, W, 3) uint8 sRGB photograph from `pose`."""
        color, _ = self._render(pose)
        samples = [color[i::_SUPERSAMPLING, j::_SUPERSAMPLING] for i, j in np.ndindex(_SUPERSAMPLING, _SUPERSAMPLING)]
        total = np.add.reduce(samples, dtype=np.uint16)
        return np.rint(total / np.float32(len(samples))).astype(np.uint8)

    def depth(self, pose: Pose) -> np.ndarray:
        """(S, S) float32 planar depth in metres from `pose`, super-sampled, 0 for no surface; checks the ray caster."""
        return self._render(pose)[1]

    def _render(self, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
        self._scene.set_pose(self._eye, world_T_opengl(pose, self._camera))
        self._eye.camera.fy = self._eye.camera.fx / pose.stretch(self._camera)
        if not self._glass:
            return render(self._scene, self._flags, self._side)
        from zerobev.rendering.surfaces import Glass, from_back_to_front

        glass = self._scene.add(Glass(from_back_to_front(self._glass, pose.centre(self._camera))))
        images = render(self._scene, self._flags, self._side)
        self._scene.remove_node(glass)
        return images


def world_T_opengl(pose: Pose, camera: CameraConfig) -> np.ndarray:
    """(4, 4) float64 transform from the camera at `pose`, with OpenGL's axes, to the world."""
    world_T_camera = np.eye(4)
    world_T_camera[:3, :3] = pose.world_R_camera @ _CAMERA_R_OPENGL
    world_T_camera[:3, 3] = pose.centre(camera)
    return world_T_camera


def render(scene: "pyrender.Scene", flags: int, side_px: int) -> tuple[np.ndarray, np.ndarray]:
    """(S, S, 3) uint8 colours and (S, S) float32 depth in metres of a scene, rendered by the process's renderer."""
    shared = renderer()
    shared.viewport_width = shared.viewport_height = side_px
    return shared.render(scene, flags)
