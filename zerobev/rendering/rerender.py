"""Pairs without a G-buffer: every texture is rendered anew, as in the paper. For comparison."""

import numpy as np

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import Pose
from zerobev.rendering.opengl import pyrender
from zerobev.rendering.photograph import FAR_M, NEAR_M, render, world_T_opengl
from zerobev.scenes.scene import Scene


class Rerenderer:
    """Renders pairs with one pass of pyrender per camera and texture."""

    def __init__(self, scene: Scene, camera: CameraConfig) -> None:
        self._camera = camera
        self._primitives = []
        self._scene = pyrender.Scene(bg_color=[0.0, 0.0, 0.0, 1.0])
        for chart in range(len(scene.chart_instance)):
            corners = scene.vertices[scene.faces[scene.face_chart == chart]].reshape(-1, 3)
            uv = scene.face_uv[scene.face_chart == chart].reshape(-1, 2) * (1, -1) + (0, 1)
            surface = pyrender.MetallicRoughnessMaterial()
            self._primitives.append(pyrender.Primitive(positions=corners, texcoord_0=uv, material=surface))
        self._scene.add(pyrender.Mesh(self._primitives))
        half = camera.fpv_px / 2
        self._eye = self._scene.add(
            pyrender.IntrinsicsCamera(camera.focal_px, camera.focal_px, half, half, NEAR_M, FAR_M)
        )
        half_m = camera.bev_extent_m / 2
        self._above = self._scene.add(pyrender.OrthographicCamera(half_m, half_m, NEAR_M, FAR_M))

    def set_texture(self, texture: list[np.ndarray]) -> None:
        """Set the texture of the surfaces: one (rows, columns) bool image per chart."""
        nearest = pyrender.Sampler(magFilter=pyrender.GLTF.NEAREST, minFilter=pyrender.GLTF.NEAREST)
        for primitive, white in zip(self._primitives, texture):
            source = np.repeat(np.where(white, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)
            image = pyrender.Texture(source=source, source_channels="RGB", sampler=nearest)
            primitive.material = pyrender.MetallicRoughnessMaterial(baseColorTexture=image)

    def fpv(self, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
        """I_zero (H, H) bool, and planar depth (H, H) float32, metres."""
        self._scene.set_pose(self._eye, world_T_opengl(pose, self._camera))
        self._scene.main_camera_node = self._eye
        colors, depth = render(self._scene, pyrender.RenderFlags.FLAT, self._camera.fpv_px)
        return colors[..., 0] > 127, depth

    def bev(self, pose: Pose) -> np.ndarray:
        """M_zero (M, M) bool. Ceilings have to be single-sided, so that they are culled."""
        camera = self._camera
        world_T_camera = np.eye(4)
        world_T_camera[:3, :3] = pose.world_R_map  # OpenGL's cameras look along -z, with y up in the image
        start = np.array([0, camera.bev_extent_m / 2, camera.height_m + camera.bev_above_m])
        world_T_camera[:3, 3] = pose.world_R_map @ start + (pose.x, pose.y, pose.floor_z)
        self._scene.set_pose(self._above, world_T_camera)
        self._scene.main_camera_node = self._above
        return render(self._scene, pyrender.RenderFlags.FLAT, camera.bev_px)[0][..., 0] > 127
