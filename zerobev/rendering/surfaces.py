"""A photograph's mesh as pyrender's primitives: textures in atlases, colours, and transparency."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import trimesh
from PIL import Image

from zerobev.rendering.opengl import pyrender
from zerobev.scenes.glb import TINT
from zerobev.scenes.gltf import REPEAT, rgba

_UV_SLACK = 1e-3  # rounding of texture coordinates beyond [0, 1] if the image is not tiled
_ATLAS_PX = 8192  # maximum side of an atlas, unless one texture is larger
_WHITE = Image.new("RGB", (1, 1), "white")  # for surfaces without a texture


class Solid(pyrender.Mesh):
    """An opaque mesh, drawn before any `Glass`."""

    is_transparent = False


class Glass(pyrender.Mesh):
    """A transparent mesh, drawn after any `Solid`."""

    is_transparent = True


@dataclass(frozen=True)
class _Textured:
    """Triangles with one image."""

    corners: np.ndarray  #: (3 F, 3) float32
    uv: np.ndarray  #: (3 F, 2) float32, in units of the image, u right and v down
    tint: np.ndarray | None  #: (3 F, 4) float32 linear RGBA, multiplied with the image; None for white
    image: Image.Image
    wrap: tuple[int, int]
    alpha_mode: str
    alpha_cutoff: float  #: 0 unless the mode is MASK
    double_sided: bool

    @property
    def tiled(self) -> bool:
        """Whether texture coordinates leave the image."""
        return bool(self.uv.min() < -_UV_SLACK or self.uv.max() > 1 + _UV_SLACK)


def primitives(photograph: trimesh.Scene) -> tuple[list[pyrender.Primitive], list[pyrender.Primitive]]:
    """Opaque primitives and blended ones, one per atlas of textures: few draw calls render faster."""
    groups: dict[tuple, list[_Textured]] = defaultdict(list)
    for mesh in photograph.dump():
        if len(mesh.faces):
            part = _part(mesh)
            image = (id(part.image), part.wrap) if part.tiled else (0, (REPEAT, REPEAT))
            groups[part.double_sided, part.alpha_mode, part.alpha_cutoff, image].append(part)
    solid: list[pyrender.Primitive] = []
    glass: list[pyrender.Primitive] = []
    for (_, mode, *_), parts in groups.items():
        (glass if mode == "BLEND" else solid).extend(_textured_primitives(parts))
    return solid, glass


def from_back_to_front(glass: list[pyrender.Primitive], eye: np.ndarray) -> list[pyrender.Primitive]:
    """The triangles of `glass`, ordered by the distance of their centres from `eye` ((3,), world), farthest first."""
    centre = np.concatenate([one.positions.reshape(-1, 3, 3).mean(axis=1) for one in glass])
    owner = np.repeat(np.arange(len(glass)), [len(one.positions) // 3 for one in glass])
    index = np.concatenate([np.arange(len(one.positions) // 3) for one in glass])
    order = np.argsort(-np.linalg.norm(centre - eye, axis=1), kind="stable")
    runs = []
    for run in np.split(order, np.flatnonzero(np.diff(owner[order])) + 1):
        one, corner = glass[owner[run[0]]], (3 * index[run][:, None] + np.arange(3)).ravel()
        tint = None if one.color_0 is None else one.color_0[corner]
        runs.append(_primitive(one.positions[corner], one.texcoord_0[corner], tint, one.material))
    return runs


def _part(mesh: trimesh.Trimesh) -> _Textured:
    corners = np.asarray(mesh.triangles, np.float32).reshape(-1, 3)
    material = getattr(mesh.visual, "material", None)
    image = getattr(material, "baseColorTexture", None)
    if image is None:
        uv = np.full((len(corners), 2), 0.5, np.float32)
    else:
        uv = np.asarray(mesh.visual.uv, np.float32)[mesh.faces].reshape(-1, 2) * (1, -1) + (0, 1)
    mode = getattr(material, "alphaMode", None) or "OPAQUE"
    cutoff = getattr(material, "alphaCutoff", None)
    tint = _tint(mesh)
    if tint is not None and mode == "OPAQUE":
        tint = np.concatenate([tint[:, :3], np.ones((len(tint), 1), np.float32)], axis=1)
    return _Textured(
        corners=corners,
        uv=uv,
        tint=None if tint is None else tint[mesh.faces].reshape(-1, 4),
        image=_WHITE if image is None else image,
        wrap=mesh.metadata.get("wrap", (REPEAT, REPEAT)),
        alpha_mode=mode,
        alpha_cutoff=0.0 if mode != "MASK" else 0.5 if cutoff is None else cutoff,
        double_sided=bool(getattr(material, "doubleSided", False)),
    )


def _tint(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """(V, 4) float32 linear RGBA, multiplied with the texture; None for white."""
    if TINT in mesh.vertex_attributes:
        return np.asarray(mesh.vertex_attributes[TINT], np.float32)
    if mesh.visual.kind != "texture":
        return np.asarray(mesh.visual.vertex_colors, np.float32) / 255
    factor = getattr(mesh.visual.material, "baseColorFactor", None)
    if factor is None and getattr(mesh.visual.material, "baseColorTexture", None) is None:
        factor = mesh.visual.material.main_color
    if factor is None or (np.asarray(factor) == 255).all():
        return None
    return np.tile(np.asarray(factor, np.float32) / 255, (len(mesh.vertices), 1))


def _textured_primitives(parts: list[_Textured]) -> list[pyrender.Primitive]:
    """The primitives of surfaces of one kind, with their images packed into atlases."""
    # RGBA, because OpenGL needs rows of a multiple of four bytes
    images = {id(part.image): _texels(part) for part in parts}
    if len(images) > 1:
        # a frame that repeats the border keeps linear interpolation within an image
        images = {key: np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge") for key, image in images.items()}
    frame = int(len(images) > 1)
    found = []
    for positions in _shelves({key: image.shape[:2] for key, image in images.items()}):
        rows, columns = (max(positions[key][k] + images[key].shape[k] for key in positions) for k in (0, 1))
        atlas = np.zeros((rows, columns, 4), np.uint8)
        for key, (row, column) in positions.items():
            atlas[row : row + images[key].shape[0], column : column + images[key].shape[1]] = images[key]
        here = [part for part in parts if id(part.image) in positions]
        corners = np.concatenate([part.corners for part in here])
        uv_px = [part.uv * part.image.size + np.add(positions[id(part.image)], frame)[::-1] for part in here]
        uv = np.concatenate(uv_px) / (columns, rows) * (1, -1) + (0, 1)  # OpenGL's v runs up
        tint = None
        if any(part.tint is not None for part in here):
            white = (np.ones((len(part.corners), 4), np.float32) for part in here)
            tint = np.concatenate([one if part.tint is None else part.tint for part, one in zip(here, white)])
        # no mip maps: they would mix neighbouring images of the atlas
        linear = pyrender.GLTF.LINEAR
        sampler = pyrender.Sampler(magFilter=linear, minFilter=linear, wrapS=here[0].wrap[0], wrapT=here[0].wrap[1])
        material = pyrender.MetallicRoughnessMaterial(
            baseColorTexture=pyrender.Texture(source=atlas, source_channels="RGBA", sampler=sampler),
            metallicFactor=0.0,
            roughnessFactor=1.0,
            doubleSided=here[0].double_sided,
            alphaMode="BLEND" if here[0].alpha_mode == "BLEND" else "OPAQUE",
            alphaCutoff=here[0].alpha_cutoff,
        )
        found.append(_primitive(corners, uv, tint, material))
    return found


def _texels(part: _Textured) -> np.ndarray:
    """(rows, columns, 4) uint8 image of a part; alpha is 255 if it is opaque."""
    texels = rgba(part.image)
    if part.alpha_mode == "OPAQUE":
        texels = texels.copy()
        texels[..., 3] = 255
    return texels


def _primitive(
    corners: np.ndarray, uv: np.ndarray, tint: np.ndarray | None, material: pyrender.Material
) -> pyrender.Primitive:
    return pyrender.Primitive(
        positions=corners, normals=_normals(corners), texcoord_0=uv, color_0=tint, material=material
    )


def _shelves(shapes: dict[int, tuple[int, int]]) -> list[dict[int, tuple[int, int]]]:
    """Shelf packing: key -> (row, column) of each image's upper left corner, one dict per atlas."""
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


def _normals(corners: np.ndarray) -> np.ndarray:
    """(3 F, 3) float32: the normal of each corner's face."""
    a, b, c = corners[0::3], corners[1::3], corners[2::3]
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.repeat(normal, 3, axis=0)
