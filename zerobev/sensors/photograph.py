"""Photographs (RGB) of a scene, rasterised by pyrender through EGL: a GPU where there is one, else Mesa."""

import atexit
import functools
import os

import numpy as np
import trimesh

# pyrender chooses its platform on import: without this it looks for a window
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
# pyrender 0.1.45 still asks for the spelling that NumPy 2 removed
if not hasattr(np, "infty"):
    np.infty = np.inf  # noqa: NPY201

import pyrender

from zerobev.config import CameraConfig
from zerobev.scenes.scene import Scene
from zerobev.sensors.cameras import Pose

_SUPERSAMPLING = 2  # rendered this much larger and averaged: fine textures would flicker otherwise
_NEAR_M, _FAR_M = 0.05, 100.0
_SKY = (0.62, 0.75, 0.92)  # seen where a home has a hole
_AMBIENT, _HEADLAMP = 0.35, 6.0  # light of scenes that bring none of their own
# camera axes: ours x right, y down, z forward; OpenGL's x right, y up, z backward
_CAMERA_R_OPENGL = np.diag([1.0, -1.0, -1.0])
# no mip maps: they would mix texels of neighbours in the atlas
_LINEAR = pyrender.Sampler(magFilter=pyrender.GLTF.LINEAR, minFilter=pyrender.GLTF.LINEAR)


class Photographer:
    """Takes photographs of one scene with one camera. All of a process share one GL context."""

    def __init__(self, scene: Scene, camera: CameraConfig) -> None:
        self._camera = camera
        self._flags = pyrender.RenderFlags.FLAT if scene.unlit else pyrender.RenderFlags.NONE
        if scene.double_sided:
            self._flags |= pyrender.RenderFlags.SKIP_CULL_FACES
        self._scene = pyrender.Scene(ambient_light=[_AMBIENT] * 3, bg_color=[*_SKY, 1.0])
        for primitive in _primitives(scene.photograph):
            self._scene.add(pyrender.Mesh([primitive]))
        side = camera.fpv_px * _SUPERSAMPLING
        focal = camera.focal_px * _SUPERSAMPLING
        lens = pyrender.IntrinsicsCamera(focal, focal, side / 2, side / 2, _NEAR_M, _FAR_M)
        self._eye = self._scene.add(lens)
        if not scene.unlit:
            self._scene.add(pyrender.PointLight(intensity=_HEADLAMP), parent_node=self._eye)
        self._side = side

    def take(self, pose: Pose) -> np.ndarray:
        """(H, W, 3) uint8 sRGB photograph from `pose`."""
        color, _ = self._render(pose)
        side = self._camera.fpv_px
        blocks = color.reshape(side, _SUPERSAMPLING, side, _SUPERSAMPLING, 3).mean(axis=(1, 3))
        return np.round(blocks).astype(np.uint8)

    def depth(self, pose: Pose) -> np.ndarray:
        """(S, S) float32 planar depth in metres from `pose`, super-sampled, 0 for nothing: it checks the ray caster."""
        return self._render(pose)[1]

    def _render(self, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
        world_T_camera = np.eye(4)
        world_T_camera[:3, :3] = pose.world_R_camera @ _CAMERA_R_OPENGL
        world_T_camera[:3, 3] = pose.centre(self._camera)
        self._scene.set_pose(self._eye, world_T_camera)
        renderer = _renderer()
        renderer.viewport_width = renderer.viewport_height = self._side
        return renderer.render(self._scene, self._flags)


@functools.cache
def _renderer() -> pyrender.OffscreenRenderer:
    """The process's one renderer: closing one of several would take the display from the others."""
    renderer = pyrender.OffscreenRenderer(1, 1)
    atexit.register(renderer.delete)
    return renderer


def _primitives(photograph: trimesh.Scene) -> list[pyrender.Primitive]:
    """One primitive a texture, and one for all that is plain: a draw call costs more than its triangles."""
    plain: list[tuple[np.ndarray, np.ndarray]] = []
    textured: list[pyrender.Primitive] = []
    for mesh in photograph.dump():
        corners = np.asarray(mesh.triangles, np.float32).reshape(-1, 3)
        material = getattr(mesh.visual, "material", None)
        image = getattr(material, "baseColorTexture", None)
        if image is None:
            plain.append((corners, _corner_colors(mesh)))
            continue
        # trimesh's v runs up, OpenGL's too
        uv = np.asarray(mesh.visual.uv, np.float32)[mesh.faces].reshape(-1, 2)
        texture = pyrender.Texture(source=np.asarray(image.convert("RGB")), source_channels="RGB", sampler=_LINEAR)
        surface = pyrender.MetallicRoughnessMaterial(
            baseColorTexture=texture, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=bool(material.doubleSided)
        )
        textured.append(
            pyrender.Primitive(positions=corners, normals=_normals(corners), texcoord_0=uv, material=surface)
        )
    if plain:
        corners = np.concatenate([c for c, _ in plain])
        colors = np.concatenate([c for _, c in plain])
        textured.append(pyrender.Primitive(positions=corners, normals=_normals(corners), color_0=colors))
    return textured


def _corner_colors(mesh: trimesh.Trimesh) -> np.ndarray:
    """(3 F, 4) float32 linear colours of the corners of a mesh without a texture."""
    if mesh.visual.kind == "texture":
        factor = mesh.visual.material.main_color
        return np.tile(np.asarray(factor, np.float32) / 255, (3 * len(mesh.faces), 1))
    return np.asarray(mesh.visual.vertex_colors, np.float32)[mesh.faces].reshape(-1, 4) / 255


def _normals(corners: np.ndarray) -> np.ndarray:
    """(3 F, 3) float32: each corner gets the normal of its face."""
    a, b, c = corners[0::3], corners[1::3], corners[2::3]
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.repeat(normal, 3, axis=0)
