"""Photographs (RGB) of a scene, rasterised by pyrender through EGL: a GPU where there is one, else Mesa."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import trimesh
from PIL import Image

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import Pose
from zerobev.rendering.opengl import pyrender, renderer
from zerobev.scenes.scene import Scene

_SUPERSAMPLING = 2  # rendered this much larger and averaged: fine textures would flicker otherwise
_NEAR_M, _FAR_M = 0.05, 100.0
_SKY = (0.62, 0.75, 0.92)  # seen where a home has a hole
_AMBIENT, _HEADLAMP = 0.35, 6.0  # light of scenes that bring none of their own
# camera axes: ours x right, y down, z forward; OpenGL's x right, y up, z backward
_CAMERA_R_OPENGL = np.diag([1.0, -1.0, -1.0])
_UV_SLACK = 1e-3  # texture coordinates of images that are not tiled may leave [0, 1] by rounding
_ATLAS_PX = 8192  # side of the largest atlas of textures, unless one texture is larger


class Photographer:
    """Takes photographs of one scene with one camera. All of a process share one GL context."""

    def __init__(self, scene: Scene, camera: CameraConfig) -> None:
        self._camera = camera
        self._flags = pyrender.RenderFlags.FLAT if scene.unlit else pyrender.RenderFlags.NONE
        if np.any(scene.double_sided):
            self._flags |= pyrender.RenderFlags.SKIP_CULL_FACES
        self._scene = pyrender.Scene(ambient_light=[_AMBIENT] * 3, bg_color=[*_SKY, 1.0])
        self._scene.add(pyrender.Mesh(_primitives(scene.photograph)))
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
        samples = [color[i::_SUPERSAMPLING, j::_SUPERSAMPLING] for i, j in np.ndindex(_SUPERSAMPLING, _SUPERSAMPLING)]
        total = np.add.reduce(samples, dtype=np.uint16)
        return np.rint(total / np.float32(len(samples))).astype(np.uint8)

    def depth(self, pose: Pose) -> np.ndarray:
        """(S, S) float32 planar depth in metres from `pose`, super-sampled, 0 for nothing: it checks the ray caster."""
        return self._render(pose)[1]

    def _render(self, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
        self._scene.set_pose(self._eye, world_T_opengl(pose, self._camera))
        return render(self._scene, self._flags, self._side)


def world_T_opengl(pose: Pose, camera: CameraConfig) -> np.ndarray:
    """(4, 4) float64: the camera at `pose`, with the axes of OpenGL's cameras."""
    world_T_camera = np.eye(4)
    world_T_camera[:3, :3] = pose.world_R_camera @ _CAMERA_R_OPENGL
    world_T_camera[:3, 3] = pose.centre(camera)
    return world_T_camera


def render(scene: "pyrender.Scene", flags: int, side_px: int) -> tuple[np.ndarray, np.ndarray]:
    """(S, S, 3) uint8 colours and (S, S) float32 depth of a scene, through the process's one GL context."""
    made = renderer()
    made.viewport_width = made.viewport_height = side_px
    return made.render(scene, flags)


@dataclass(frozen=True)
class _Textured:
    """Triangles that wear one image."""

    corners: np.ndarray  #: (3 F, 3) float32
    uv: np.ndarray  #: (3 F, 2) float32, in units of the image, u right and v down
    image: Image.Image
    double_sided: bool

    @property
    def tiled(self) -> bool:
        """Whether the image is repeated over the surface."""
        return bool(self.uv.min() < -_UV_SLACK or self.uv.max() > 1 + _UV_SLACK)


def _primitives(photograph: trimesh.Scene) -> "list[pyrender.Primitive]":
    """One primitive an atlas of textures, and one for all that is plain: a draw call costs more than its triangles."""
    plain: list[tuple[np.ndarray, np.ndarray]] = []
    groups: dict[tuple[bool, int], list[_Textured]] = defaultdict(list)
    for mesh in photograph.dump():
        corners = np.asarray(mesh.triangles, np.float32).reshape(-1, 3)
        material = getattr(mesh.visual, "material", None)
        image = getattr(material, "baseColorTexture", None)
        if material is None or image is None:
            plain.append((corners, _corner_colors(mesh)))
            continue
        uv = np.asarray(mesh.visual.uv, np.float32)[mesh.faces].reshape(-1, 2) * (1, -1) + (0, 1)
        part = _Textured(corners, uv, image, bool(material.doubleSided))
        groups[part.double_sided, id(image) if part.tiled else 0].append(part)
    primitives = [primitive for parts in groups.values() for primitive in _textured_primitives(parts)]
    if plain:
        corners = np.concatenate([c for c, _ in plain])
        colors = np.concatenate([c for _, c in plain])
        primitives.append(pyrender.Primitive(positions=corners, normals=_normals(corners), color_0=colors))
    return primitives


def _textured_primitives(parts: list[_Textured]) -> "list[pyrender.Primitive]":
    """The primitives of surfaces of one kind, their images side by side in as few atlases as hold them."""
    # four bytes a texel: OpenGL takes rows of three only where they are a multiple of four long
    images = {id(part.image): np.asarray(part.image.convert("RGB").convert("RGBA")) for part in parts}
    if len(images) > 1:
        # a frame of their own border keeps linear look-ups within an image
        images = {key: np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge") for key, image in images.items()}
    frame = int(len(images) > 1)
    # no mip maps: they would mix texels of neighbours in the atlas
    linear = pyrender.Sampler(magFilter=pyrender.GLTF.LINEAR, minFilter=pyrender.GLTF.LINEAR)
    primitives = []
    for places in _shelves({key: image.shape[:2] for key, image in images.items()}):
        rows, columns = (max(places[key][k] + images[key].shape[k] for key in places) for k in (0, 1))
        atlas = np.zeros((rows, columns, 4), np.uint8)
        for key, (row, column) in places.items():
            atlas[row : row + images[key].shape[0], column : column + images[key].shape[1]] = images[key]
        here = [part for part in parts if id(part.image) in places]
        corners = np.concatenate([part.corners for part in here])
        uv_px = [part.uv * part.image.size + np.add(places[id(part.image)], frame)[::-1] for part in here]
        uv = np.concatenate(uv_px) / (columns, rows) * (1, -1) + (0, 1)  # OpenGL's v runs up
        material = pyrender.MetallicRoughnessMaterial(
            baseColorTexture=pyrender.Texture(source=atlas, source_channels="RGBA", sampler=linear),
            metallicFactor=0.0,
            roughnessFactor=1.0,
            doubleSided=here[0].double_sided,
        )
        primitives.append(
            pyrender.Primitive(positions=corners, normals=_normals(corners), texcoord_0=uv, material=material)
        )
    return primitives


def _shelves(shapes: dict[int, tuple[int, int]]) -> list[dict[int, tuple[int, int]]]:
    """Row and column of the upper left corner of each image, dealt onto shelves of atlases: one dict an atlas."""
    atlases: list[dict[int, tuple[int, int]]] = [{}]
    row = column = height = 0
    for key, (rows, columns) in shapes.items():
        if column + columns > _ATLAS_PX:
            row, column, height = row + height, 0, 0
        if row + rows > _ATLAS_PX and atlases[-1]:
            atlases.append({})
            row = column = height = 0
        atlases[-1][key] = (row, column)
        column, height = column + columns, max(height, rows)
    return atlases


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
