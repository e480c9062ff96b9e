"""Surfaces of a glTF 2.0 file: its primitives, materials and nodes, read by the specification.

trimesh does not read second sets of texture coordinates, texture transforms, samplers, instances and triangle fans.
"""

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from zerobev.scenes.accessors import Accessors

CLAMP, REPEAT, MIRROR = 33071, 10497, 33648

_INSTANCES, _TRANSFORM, _UNLIT = "EXT_mesh_gpu_instancing", "KHR_texture_transform", "KHR_materials_unlit"
_SPECULAR, _WEBP = "KHR_materials_pbrSpecularGlossiness", "EXT_texture_webp"
EXTENSIONS = (_INSTANCES, _WEBP, _SPECULAR, _UNLIT, "KHR_mesh_quantization", _TRANSFORM)
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_IMAGES = ("PNG", "JPEG", "WEBP")  # PIL would also open PostScript files, and execute them
_MAX_VERTICES = 1 << 25  # of a scene: a short file could have many instances


@dataclass(frozen=True)
class Material:
    """The properties of a material that are used."""

    image: Image.Image | None = None  #: opened, not decoded
    uv_set: int = 0
    uv_matrix: np.ndarray | None = None  #: (2, 3): texture transform
    wrap: tuple[int, int] = (REPEAT, REPEAT)  #: of u and of v
    base_color: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)  #: linear RGBA, multiplied with the image
    alpha_mode: str = "OPAQUE"
    alpha_cutoff: float = 0.5
    unlit: bool = False
    double_sided: bool = False


@dataclass(frozen=True)
class Surface:
    """Triangles of one primitive at one node, in the world frame."""

    vertices: np.ndarray  #: (V, 3) float32, metres
    faces: np.ndarray  #: (F, 3) int64, counter-clockwise as seen from the front
    uv: np.ndarray | None  #: (V, 2) float32, v down; None without an image
    colors: np.ndarray | None  #: (V, 4) float32, linear RGBA, multiplied with the base colour
    material: Material | None  #: None if the file names none


class Asset:
    """One glTF asset, from its JSON header and binary chunk."""

    def __init__(self, path: Path, header: dict[str, Any], binary: bytes) -> None:
        self._file, self._header = Accessors(path, header, binary), header
        self._images: dict[int, Image.Image] = {}
        self._materials: dict[int, Material] = {}
        unknown = sorted(set(header.get("extensionsRequired", [])) - set(EXTENSIONS))
        if unknown:
            raise self._file.error(f"no required extension but {', '.join(EXTENSIONS)}", ", ".join(unknown))

    def surfaces(self) -> list[Surface]:
        """Every surface of the default scene, ordered by mesh and by primitive."""
        placed = sorted(self._placed_meshes(), key=lambda mesh: mesh[0])
        found: list[Surface] = []
        total = 0
        for mesh, world_T_copies in placed:
            for primitive in self._file.item("meshes", mesh)["primitives"]:
                shape = self._shape(primitive)
                if shape is None:
                    continue
                total += len(shape.vertices) * len(world_T_copies)
                if total > _MAX_VERTICES:
                    raise self._file.error(f"at most {_MAX_VERTICES} vertices", "more")
                found.append(_placed(shape, world_T_copies))
        return found

    # --- materials ---------------------------------------------------------------------------------------------

    def _image(self, index: int) -> Image.Image:
        if index not in self._images:
            image = self._file.item("images", index)
            content = self._file.data(image["uri"]) if "uri" in image else self._file.view(image["bufferView"])
            try:
                self._images[index] = Image.open(io.BytesIO(content), formats=_IMAGES)
            except OSError as error:
                kind = image.get("mimeType", "a file of no type")
                raise self._file.error(f"a readable PNG or JPEG as image {index}", str(kind)) from error
        return self._images[index]

    def _material(self, index: int) -> Material:
        """A material; only its base colour has a texture."""
        if index not in self._materials:
            material = self._file.item("materials", index)
            surface, extensions = material.get("pbrMetallicRoughness", {}), material.get("extensions", {})
            factor, texture = (surface.get(key) for key in ("baseColorFactor", "baseColorTexture"))
            if _SPECULAR in extensions:
                factor, texture = (extensions[_SPECULAR].get(key) for key in ("diffuseFactor", "diffuseTexture"))
            mode = material.get("alphaMode", "OPAQUE")
            if mode not in ("OPAQUE", "MASK", "BLEND"):
                raise self._file.error("alpha mode OPAQUE, MASK or BLEND", repr(mode)[:40])
            color = tuple(float(c) for c in ((1, 1, 1, 1) if factor is None else factor))
            if len(color) != 4 or not all(0 <= c <= 1 for c in color):
                raise self._file.error("four base colour factors from 0 to 1", str(color)[:80])
            self._materials[index] = Material(
                **({} if texture is None else self._texture(texture)),
                base_color=color,
                alpha_mode=mode,
                alpha_cutoff=float(material.get("alphaCutoff", 0.5)),
                unlit=_UNLIT in extensions,
                double_sided=bool(material.get("doubleSided", False)),
            )
        return self._materials[index]

    def _texture(self, info: dict[str, Any]) -> dict[str, Any]:
        """The fields of a `Material` that depend on its texture."""
        texture = self._file.item("textures", info["index"])
        source = texture.get("extensions", {}).get(_WEBP, texture).get("source")
        if source is None:
            found = ", ".join(texture.get("extensions", {})) or "none"
            raise self._file.error(f"a PNG or JPEG for texture {info['index']}", found)
        sampler = self._file.item("samplers", texture["sampler"]) if "sampler" in texture else {}
        wrap = sampler.get("wrapS", REPEAT), sampler.get("wrapT", REPEAT)
        if not set(wrap) <= {CLAMP, REPEAT, MIRROR}:
            raise self._file.error(f"wrap modes {CLAMP}, {REPEAT} or {MIRROR}", str(wrap)[:80])
        transform = info.get("extensions", {}).get(_TRANSFORM)
        matrix, uv_set = None, info.get("texCoord", 0)
        if transform is not None:
            uv_set = transform.get("texCoord", uv_set)
            cosine, sine = np.cos(transform.get("rotation", 0.0)), np.sin(transform.get("rotation", 0.0))
            # v points down, so counter-clockwise rotates u towards -v, as in the extension's example and all viewers;
            # the listing in the extension's text rotates the other way
            rotation = np.array([[cosine, sine], [-sine, cosine]])
            matrix = np.empty((2, 3))
            matrix[:, :2] = rotation * transform.get("scale", (1, 1))
            matrix[:, 2] = transform.get("offset", (0, 0))
        return {"image": self._image(source), "uv_set": uv_set, "uv_matrix": matrix, "wrap": wrap}

    # --- meshes ------------------------------------------------------------------------------------------------

    def _shape(self, primitive: dict[str, Any]) -> Surface | None:
        """A primitive in the frame of its mesh; None for points and lines."""
        mode = primitive.get("mode", _TRIANGLES)
        if mode in (0, 1, 2, 3):
            return None
        attributes = primitive["attributes"]
        positions = self._file.floats(attributes["POSITION"], "VEC3")
        if not np.isfinite(positions).all():
            raise self._file.error("finite vertices", "one that is not")
        order = np.arange(len(positions))
        if "indices" in primitive:
            order = self._file.numbers(primitive["indices"], ("SCALAR",))[0][:, 0]
            if order.dtype.kind != "u":
                raise self._file.error("unsigned integers as indices", str(order.dtype))
            order = order.astype(np.int64)
            if order.size and order.max() >= len(positions):
                raise self._file.error("faces between vertices", "a face with a vertex that does not exist")
        material = self._material(primitive["material"]) if "material" in primitive else None
        uv, colors = None, None
        if material is not None and material.image is not None:
            name = f"TEXCOORD_{material.uv_set}"
            if name not in attributes:
                raise self._file.error("UV coordinates on every mesh with a texture", f"one without {name}")
            uv = self._file.floats(attributes[name], "VEC2")
            if material.uv_matrix is not None:
                uv = (uv @ material.uv_matrix[:, :2].T + material.uv_matrix[:, 2]).astype(np.float32)
            if not np.isfinite(uv).all():
                raise self._file.error("finite UV coordinates", "one that is not")
        if "COLOR_0" in attributes:
            stored = self._file.floats(attributes["COLOR_0"], "VEC3", "VEC4", normalized=True)
            colors = np.ones((len(stored), 4), np.float32)
            colors[:, : stored.shape[1]] = np.clip(stored, 0, 1)
            if not np.isfinite(colors).all():
                raise self._file.error("finite vertex colours", "one that is not")
        for name, values in (("UV coordinates", uv), ("vertex colours", colors)):
            if values is not None and len(values) != len(positions):
                raise self._file.error(f"{len(positions)} {name}, one per vertex", str(len(values)))
        return Surface(positions, self._triangles(mode, order), uv, colors, material)

    def _triangles(self, mode: int, order: np.ndarray) -> np.ndarray:
        """(F, 3) corners of triangles, a strip or a fan over the vertices `order`."""
        if mode == _TRIANGLES:
            if len(order) % 3:
                raise self._file.error("triangles of three vertices", f"{len(order)} vertices")
            return order.reshape(-1, 3)
        if mode == _FAN:
            return np.stack([order[1:-1], order[2:], np.broadcast_to(order[:1], max(len(order) - 2, 0))], axis=1)
        if mode != _STRIP:
            raise self._file.error("a mode from 0 to 6", repr(mode)[:40])
        faces = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
        faces[1::2] = faces[1::2, ::-1]  # every other triangle of a strip has the opposite orientation
        repeated = (faces == np.roll(faces, 1, axis=1)).any(axis=1)  # degenerate triangles join pieces of a strip
        return faces[~repeated]

    # --- nodes -------------------------------------------------------------------------------------------------

    def _placed_meshes(self) -> Iterator[tuple[int, np.ndarray]]:
        """Meshes of the default scene, and (N, 4, 4) float64 transforms of their copies to the world."""
        if "scenes" not in self._header:
            return
        roots = self._file.item("scenes", self._header.get("scene", 0)).get("nodes", [])
        pending = [(index, np.eye(4)) for index in reversed(roots)]
        seen = set()
        while pending:
            index, world_T_parent = pending.pop()
            node = self._file.item("nodes", index)
            if index in seen:
                raise self._file.error("a tree of nodes", f"node {index} in two places")
            seen.add(index)
            world_T_node = world_T_parent @ _local_transform(node)
            pending += [(child, world_T_node) for child in reversed(node.get("children", []))]
            if "mesh" in node:
                self._check_rigid(node)
                yield node["mesh"], world_T_node @ self._copies(node)

    def _check_rigid(self, node: dict[str, Any]) -> None:
        weights = node.get("weights", self._file.item("meshes", node["mesh"]).get("weights", []))
        if "skin" in node or any(weights):
            raise self._file.error("rigid meshes", f"{'a skin' if 'skin' in node else 'a morph target'} on one")

    def _copies(self, node: dict[str, Any]) -> np.ndarray:
        """(N, 4, 4) transforms of the copies of a node's mesh to the node; one identity without instances."""
        instances = node.get("extensions", {}).get(_INSTANCES)
        if instances is None:
            return np.eye(4)[None]
        attributes = instances["attributes"]
        known = {"TRANSLATION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3"}
        arrays = {name: self._file.floats(attributes[name], form) for name, form in known.items() if name in attributes}
        counts = {len(array) for array in arrays.values()}
        if len(counts) != 1:
            raise self._file.error("instances with attributes of one length", str(sorted(counts)))
        (count,) = counts
        if count > _MAX_VERTICES // 16:
            raise self._file.error(f"at most {_MAX_VERTICES // 16} instances", str(count))
        transforms = np.tile(np.eye(4), (count, 1, 1))
        for n in range(count):
            transforms[n] = _local_transform({name.lower(): array[n] for name, array in arrays.items()})
        return transforms


def rgba(image: Image.Image) -> np.ndarray:
    """(rows, columns, 4) uint8 texels of an image of any mode; 16 bits are rounded to 8.

    Raises PIL's errors for a damaged image.
    """
    if image.mode.startswith("I"):
        grey = np.rint(np.asarray(image) / 257).astype(np.uint8)
        return np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=-1)
    return np.asarray(image.convert("RGBA"))


def _local_transform(node: dict[str, Any]) -> np.ndarray:
    """(4, 4) transform of a node to its parent, from a matrix or from translation, rotation and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    transform = np.eye(4)
    x, y, z, w = np.asarray(node.get("rotation", (0, 0, 0, 1)), np.float64)
    transform[:3, :3] = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3]
    transform[:3, :3] *= np.asarray(node.get("scale", (1, 1, 1)), np.float64)
    transform[:3, 3] = node.get("translation", (0, 0, 0))
    return transform


def _placed(shape: Surface, world_T_copies: np.ndarray) -> Surface:
    """All copies of a shape in the world frame; the order of corners is reversed in mirrored ones."""
    vertices, faces = [], []
    for copy, world_T_mesh in enumerate(world_T_copies):
        positions = shape.vertices
        if not np.array_equal(world_T_mesh, np.eye(4)):
            positions = trimesh.transform_points(positions.astype(np.float64), world_T_mesh).astype(np.float32)
        mirrored = np.linalg.det(world_T_mesh[:3, :3]) < 0
        vertices.append(positions)
        faces.append((shape.faces[:, ::-1] if mirrored else shape.faces) + copy * len(positions))
    count = len(world_T_copies)
    uv, colors = (None if a is None else np.tile(a, (count, 1)) for a in (shape.uv, shape.colors))
    return Surface(np.concatenate(vertices), np.concatenate(faces), uv, colors, shape.material)
