"""Reads GLB files as trimesh's scenes, and writes GLB files from primitives.

trimesh flips v with a rounding error, so the exact UV coordinates are stored as a second attribute. trimesh's exporter
has no samplers, no 16-bit colours and no JPEG quality.
"""

import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from zerobev.common.errors import InputError
from zerobev.scenes.gltf import CLAMP, REPEAT, Asset, Material, Surface

#: Vertex attributes besides trimesh's own: UV coordinates with v down, and linear colours as factors.
RAW_UV, TINT = "_TEXCOORD_0", "_TINT"

_MAGIC, _VERSION = b"glTF", 2
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_NEAREST_CLAMPED = {"magFilter": 9728, "minFilter": 9728, "wrapS": CLAMP, "wrapT": CLAMP}


@dataclass(frozen=True)
class Primitive:
    """Triangles of one material, as stored in a GLB file."""

    name: str
    positions: np.ndarray  #: (V, 3) float32, metres
    faces: np.ndarray  #: (F, 3) integers
    uv: np.ndarray | None = None  #: (V, 2) float32, v down
    colors: np.ndarray | None = None  #: (V, 4) uint16, linear
    image: bytes | None = None  #: a PNG or JPEG file; written once if shared with the same wrap modes
    base_color: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)  #: linear RGBA, multiplied with the image
    unlit: bool = False
    double_sided: bool = False
    alpha_mode: str = "OPAQUE"
    alpha_cutoff: float = 0.5
    wrap: tuple[int, int] = (REPEAT, REPEAT)  #: of u and of v; not used with nearest sampling


def read_glb(path: Path) -> trimesh.Scene:
    """The surfaces of the default scene of the GLB file at `path`, in the world frame.

    One mesh per primitive and node, in the file's order of primitives. Besides trimesh's own attributes a mesh has
    `vertex_attributes[RAW_UV]` ((V, 2) float32, v down, texture transform applied), `vertex_attributes[TINT]`
    ((V, 4) float32, linear: vertex colour times base colour; absent if white), and in its `metadata` the sampler's
    `wrap` modes (of u, of v) and `unlit`. Images are opened, not decoded. A file is an `InputError` if it is missing,
    truncated, not GLB 2, compressed, not finite, without triangles, requires an unknown extension, or has base colours
    in another format than PNG, JPEG or WebP.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: expected a GLB file, found {error.strerror}") from error
    header, end = _header(path, content)
    try:
        surfaces = Asset(path, header, content[end + 8 :]).surfaces()
        meshes = [_mesh(surface) for surface in surfaces]
    except InputError:
        raise
    except Exception as error:  # JSON with wrong types, and PIL's many kinds of error for a damaged image
        found = " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError(f"{path}: expected a readable GLB file, found {found}") from error
    if sum(len(mesh.faces) for mesh in meshes) == 0:
        raise InputError(f"{path}: expected a mesh, found no triangles")
    scene = trimesh.Scene()
    scene.geometry.update((f"{index:06d}", mesh) for index, mesh in enumerate(meshes))
    for name in reversed(scene.geometry):  # the order of textures in an atlas determines the last bits of a photograph
        scene.graph.update(frame_to=name, geometry=name)
    return scene


def _mesh(surface: Surface) -> trimesh.Trimesh:
    """A surface as trimesh's mesh; without a material it is white."""
    material = surface.material or Material()
    attributes, visual = {}, None
    if surface.uv is not None:
        attributes[RAW_UV] = surface.uv
    tint = np.asarray(material.base_color, np.float32) * (1 if surface.colors is None else surface.colors)
    if (tint != 1).any():
        attributes[TINT] = np.broadcast_to(tint, (len(surface.vertices), 4))
    if surface.material is None and surface.colors is not None:
        colors = np.rint(255 * surface.colors).astype(np.uint8)
        visual = trimesh.visual.ColorVisuals(vertex_colors=colors)
    else:
        pbr = trimesh.visual.material.PBRMaterial(
            baseColorFactor=list(material.base_color),
            baseColorTexture=material.image,
            alphaMode=material.alpha_mode,
            alphaCutoff=material.alpha_cutoff,
            doubleSided=material.double_sided,
        )
        up = None if surface.uv is None else np.stack([surface.uv[:, 0], 1 - surface.uv[:, 1]], axis=1)
        visual = trimesh.visual.TextureVisuals(uv=up, material=pbr)
    metadata = {"wrap": material.wrap, "unlit": material.unlit}
    return trimesh.Trimesh(
        surface.vertices, surface.faces, visual=visual, vertex_attributes=attributes, metadata=metadata, process=False
    )


def placed_meshes(scene: trimesh.Scene) -> Iterator[tuple[trimesh.Trimesh, np.ndarray, np.ndarray]]:
    """Each mesh of `scene`, its vertices ((V, 3) float32, world) and faces ((F, 3)), in the order of the geometries."""
    order = {name: index for index, name in enumerate(scene.geometry)}
    placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
    for world_T_mesh, name in sorted(placed, key=lambda node: order[node[1]]):
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh):
            continue
        vertices, faces = mesh.vertices.view(np.ndarray), mesh.faces.view(np.ndarray)
        if not np.array_equal(world_T_mesh, np.eye(4)):
            vertices = trimesh.transform_points(vertices, world_T_mesh)
            if np.linalg.det(world_T_mesh[:3, :3]) < 0:  # mirroring swaps front and back
                faces = faces[:, ::-1]
        yield mesh, vertices.astype(np.float32), faces


def write_glb(path: Path, primitives: Sequence[Primitive], nearest: bool) -> None:
    """Write `primitives` as a GLB 2 file, with a mesh and a node per primitive. Same input, same bytes.

    With `nearest`, images have nearest, clamped sampling; else samplers only have wrap modes, and repeated images none.
    """
    header: dict[str, Any] = {"asset": {"version": "2.0", "generator": "zerobev"}, "scene": 0}
    for key in ("nodes", "meshes", "materials", "accessors", "bufferViews", "images", "textures"):
        header[key] = []
    header["scenes"] = [{"nodes": list(range(len(primitives)))}]
    if nearest:
        header["samplers"] = [_NEAREST_CLAMPED]
    if any(primitive.unlit for primitive in primitives):
        header["extensionsUsed"] = ["KHR_materials_unlit"]
    binary = bytearray()
    texture_of: dict[tuple[int, tuple[int, int]], int] = {}  # by identity: equal images of two charts stay separate
    for index, primitive in enumerate(primitives):
        attributes = {"POSITION": _add_array(header, binary, primitive.positions, _FLOAT, bounds=True)}
        if primitive.uv is not None:
            attributes["TEXCOORD_0"] = _add_array(header, binary, primitive.uv, _FLOAT)
        if primitive.colors is not None:
            attributes["COLOR_0"] = _add_array(header, binary, primitive.colors, _UINT16)
        indices = _add_array(header, binary, primitive.faces.reshape(-1), _UINT32)
        triangles = {"attributes": attributes, "indices": indices, "mode": 4}
        header["meshes"].append({"name": primitive.name, "primitives": [triangles]})
        header["nodes"].append({"name": primitive.name, "mesh": index})
        if primitive.colors is not None and primitive.image is None and primitive.alpha_mode == "OPAQUE":
            continue  # readers such as trimesh would use the material's white
        texture = None
        if primitive.image is not None:
            sampled = id(primitive.image), primitive.wrap
            if sampled not in texture_of:
                texture_of[sampled] = _add_image(header, binary, primitive.image, None if nearest else primitive.wrap)
            texture = texture_of[sampled]
        triangles["material"] = len(header["materials"])
        header["materials"].append(_material(primitive, texture))
    header["buffers"] = [{"byteLength": len(binary)}]
    used = {key: value for key, value in header.items() if value != []}
    Path(path).write_bytes(_container(used, struct.pack("<II", len(binary), _BINARY) + binary))


def _header(path: Path, content: bytes) -> tuple[dict[str, Any], int]:
    """The JSON chunk and the offset of its end; the header's length has to be the file's."""
    if len(content) < 20 or content[:4] != _MAGIC:
        raise InputError(f"{path}: expected a GLB file, found {len(content)} bytes that start with {content[:4]!r}")
    version, length, size, kind = struct.unpack_from("<IIII", content, 4)
    if version != _VERSION or kind != _JSON:
        raise InputError(f"{path}: expected GLB version 2 with a JSON header, found version {version}")
    if length != len(content):
        raise InputError(f"{path}: expected {length} bytes, by its header, found {len(content)}")
    try:
        header = json.loads(content[20 : 20 + size])
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected a JSON header, found {error}") from error
    if not isinstance(header, dict):
        raise InputError(f"{path}: expected a JSON object as header, found {type(header).__name__}")
    return header, 20 + size


def _container(header: dict[str, Any], rest: bytes) -> bytes:
    """A GLB file with a JSON header, followed by `rest`."""
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", _MAGIC, _VERSION, 20 + len(text) + len(rest), len(text), _JSON) + text + rest


def _material(primitive: Primitive, texture: int | None) -> dict[str, Any]:
    surface: dict[str, Any] = {"baseColorFactor": list(primitive.base_color), "metallicFactor": 0.0}
    surface["roughnessFactor"] = 1.0
    if texture is not None:
        surface["baseColorTexture"] = {"index": texture}
    material = {"name": primitive.name, "pbrMetallicRoughness": surface, "doubleSided": primitive.double_sided}
    if primitive.alpha_mode != "OPAQUE":
        material["alphaMode"] = primitive.alpha_mode
    if primitive.alpha_mode == "MASK":
        material["alphaCutoff"] = primitive.alpha_cutoff
    if primitive.unlit:
        material["extensions"] = {"KHR_materials_unlit": {}}
    return material


def _add_view(header: dict[str, Any], binary: bytearray, content: bytes) -> int:
    header["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(content)})
    binary += content + bytes(-len(content) % 4)
    return len(header["bufferViews"]) - 1


def _add_array(header: dict[str, Any], binary: bytearray, array: np.ndarray, kind: int, bounds: bool = False) -> int:
    """Index of a new accessor for `array`, stored as `kind`; positions need bounds."""
    stored = array.astype({_FLOAT: "<f4", _UINT16: "<u2", _UINT32: "<u4"}[kind])
    form = "SCALAR" if stored.ndim == 1 else f"VEC{stored.shape[1]}"
    view = _add_view(header, binary, stored.tobytes())
    accessor = {"bufferView": view, "componentType": kind, "count": len(stored), "type": form}
    if kind == _UINT16:
        accessor["normalized"] = True
    if bounds:
        accessor |= {"min": stored.min(axis=0).tolist(), "max": stored.max(axis=0).tolist()}
    header["accessors"].append(accessor)
    return len(header["accessors"]) - 1


def _add_image(header: dict[str, Any], binary: bytearray, image: bytes, wrap: tuple[int, int] | None) -> int:
    """Index of a new texture for `image`, an encoded file; without `wrap` it has sampler 0."""
    kind = "image/png" if image.startswith(b"\x89PNG") else "image/jpeg"
    header["images"].append({"bufferView": _add_view(header, binary, image), "mimeType": kind})
    texture = {"source": len(header["images"]) - 1}
    if wrap is None:
        texture["sampler"] = 0
    elif wrap != (REPEAT, REPEAT):
        header.setdefault("samplers", []).append({"wrapS": wrap[0], "wrapT": wrap[1]})
        texture["sampler"] = len(header["samplers"]) - 1
    header["textures"].append(texture)
    return len(header["textures"]) - 1
