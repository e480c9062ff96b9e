"""Writes scenes in the format of HM3DSem v0.2, for `hm3dsem` to read."""

import io
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from zerobev.common.errors import InputError
from zerobev.common.storage import write_json
from zerobev.scenes.glb import TINT, Primitive, placed_meshes, write_glb
from zerobev.scenes.gltf import REPEAT, rgba
from zerobev.scenes.hm3dsem import FIRST_LINE, hash_of
from zerobev.scenes.scene import Instance, Scene

_CONFIG = "hm3d_annotated_basis.scene_dataset_config.json"
_JPEG_QUALITY = 90


def write_scene(folder: Path, scene: Scene) -> None:
    """Write `scene` to `folder` (`NNNNN-HASH`) as `HASH.glb`, `HASH.semantic.glb` and `HASH.semantic.txt`.

    Annotation colours are stored twice, as in HM3DSem: as raw sRGB bytes in the texture, and as linear vertex colours.
    The annotation is lossless (PNG); the photograph's textures are JPEG, or PNG if transparent.

    In the scene that `read_scene` returns, faces are grouped by chart, then by sidedness. There is one vertex for each
    combination of vertex, chart, UV coordinate and instance in use; unused vertices and charts are left out. A scene in
    that form is read back bit for bit, except for the compression of the photograph.

    The folder is written atomically and replaces an earlier scene. A folder with other files, a bad folder name and an
    instance name of several lines are `InputError`s.
    """
    folder = Path(folder)
    stem = hash_of(folder)
    names = [f"{stem}.glb", f"{stem}.semantic.glb", f"{stem}.semantic.txt"]
    rows = [_row(instance) for instance in scene.instances]
    with _replacing_folder(folder, names) as temporary:
        write_glb(temporary / names[0], list(_photograph_primitives(scene)), nearest=False)
        write_glb(temporary / names[1], list(_annotation_primitives(scene)), nearest=True)
        (temporary / names[2]).write_text("\n".join([FIRST_LINE, *rows]) + "\n", encoding="utf-8")


def write_dataset_config(root: Path, scenes: Iterable[Path]) -> None:
    """Write Habitat's configuration of the data set at `root` with `scenes`, folders in it."""
    root = Path(root)
    stages = [(folder / f"{hash_of(folder)}.glb").relative_to(root).as_posix() for folder in map(Path, scenes)]
    same_name = "%%CONFIG_NAME_AS_ASSET_FILENAME%%"
    attributes = {
        "shader_type": "flat",
        "up": [0, 0, 1],
        "front": [0, 1, 0],
        "origin": [0, 0, 0],
        "semantic_descriptor_filename": f"{same_name}.semantic.txt",
        "semantic_asset": f"{same_name}.semantic.glb",
        "has_semantic_textures": True,
    }
    config = {
        "stages": {"paths": {".glb": sorted(stages)}, "default_attributes": attributes},
        "objects": {},
        "light_setups": {},
        "scene_instances": {"default_attributes": {"default_lighting": "no_lights"}},
    }
    write_json(root / _CONFIG, config)


def srgb_to_linear(color: np.ndarray) -> np.ndarray:
    """sRGB bytes (any shape) to linear colour, 16-bit normalised (uint16)."""
    srgb = np.asarray(color) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.round(linear * 65535).astype(np.uint16)


def _row(instance: Instance) -> str:
    if "\n" in instance.name or "\r" in instance.name:
        raise InputError(f"instance {instance.id}: expected a name of one line, found {instance.name!r}")
    red, green, blue = instance.color
    return f'{instance.id},{red:02X}{green:02X}{blue:02X},"{instance.name}",{instance.region}'


def _annotation_primitives(scene: Scene) -> Iterator[Primitive]:
    """One primitive per chart, or two with the same image if some of its faces are double-sided."""
    colors = np.zeros((len(scene.instance_label), 3), np.uint8)
    for instance in scene.instances:
        colors[instance.id] = instance.color
    linear = np.concatenate([srgb_to_linear(colors), np.full((len(colors), 1), 65535, np.uint16)], axis=1)
    for chart, image in enumerate(scene.chart_instance):
        encoded = _encoded(Image.fromarray(np.take(colors, image, axis=0)), "PNG", compress_level=1)
        for sided in (False, True):
            on = (scene.face_chart == chart) & (scene.double_sided == sided)
            if not on.any():
                continue
            corner_uv = np.ascontiguousarray(scene.face_uv[on], np.float32).reshape(-1, 2)
            ids = np.repeat(scene.face_instance[on], 3)
            first, faces = _shared_corners(scene.faces[on].reshape(-1), corner_uv, ids)
            yield Primitive(
                name=f"chunk{chart:03d}",
                positions=scene.vertices[scene.faces[on].reshape(-1)[first]],
                faces=faces,
                uv=corner_uv[first],
                colors=linear[ids[first]],
                image=encoded,
                unlit=True,
                double_sided=sided,
            )


def _shared_corners(vertex: np.ndarray, uv: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge corners of faces with the same vertex, UV and instance: GLB has one of each per vertex.

    Returns one corner per group, ordered by vertex, and the faces ((F, 3)) over these groups.
    """
    keys = (uv.view(np.uint64).reshape(-1), vertex.astype(np.uint64) << np.uint64(16) | ids)
    order = np.lexsort(keys)
    new = np.ones(len(order), bool)
    new[1:] = np.any([key[order][1:] != key[order][:-1] for key in keys], axis=0)
    group = np.empty(len(order), np.int64)
    group[order] = np.cumsum(new) - 1
    return order[new], group.reshape(-1, 3)


def _photograph_primitives(scene: Scene) -> Iterator[Primitive]:
    """One primitive per mesh, in the world frame."""
    encoded: dict[int, bytes] = {}
    for index, (mesh, positions, faces) in enumerate(placed_meshes(scene.photograph)):
        uv, colors, image, double_sided = None, None, None, bool(np.any(scene.double_sided))
        alpha: dict[str, Any] = {}
        factor: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
        if mesh.visual.kind == "texture":
            material = mesh.visual.material
            material = material.to_pbr() if isinstance(material, trimesh.visual.material.SimpleMaterial) else material
            image, double_sided = material.baseColorTexture, double_sided or bool(material.doubleSided)
            alpha = {"alpha_mode": material.alphaMode or "OPAQUE", "alpha_cutoff": material.alphaCutoff or 0.0}
            tint = mesh.vertex_attributes.get(TINT)
            if tint is not None and (tint == tint[0]).all():
                factor = tuple(float(c) for c in tint[0])
            elif tint is not None:
                colors = np.rint(65535 * tint).astype(np.uint16)
            elif material.baseColorFactor is not None:
                factor = tuple(float(c) for c in trimesh.visual.color.to_float(material.baseColorFactor))
            if mesh.visual.uv is not None:
                uv = np.array([0, 1]) + np.asarray(mesh.visual.uv)[:, :2] * np.array([1, -1])  # v up to v down
        elif mesh.visual.kind is not None:
            colors = mesh.visual.vertex_colors.astype(np.uint16) * 257
        if image is not None and id(image) not in encoded:
            encoded[id(image)] = _encoded_photograph(image)
        yield Primitive(
            name=f"chunk{index:03d}",
            positions=positions,
            faces=faces,
            uv=uv,
            colors=colors,
            image=None if image is None else encoded[id(image)],
            base_color=factor,
            unlit=scene.unlit,
            double_sided=double_sided,
            wrap=mesh.metadata.get("wrap", (REPEAT, REPEAT)),
            **alpha,
        )


def _encoded_photograph(image: Image.Image) -> bytes:
    if image.has_transparency_data:
        return _encoded(image, "PNG", compress_level=1)
    return _encoded(Image.fromarray(rgba(image)[..., :3]), "JPEG", quality=_JPEG_QUALITY)


def _encoded(image: Image.Image, kind: str, **options: int) -> bytes:
    stream = io.BytesIO()
    image.save(stream, format=kind, **options)
    return stream.getvalue()


@contextmanager
def _replacing_folder(folder: Path, names: list[str]) -> Iterator[Path]:
    """Yield a temporary folder beside `folder`; on success rename it to `folder`, on any error remove it."""
    if folder.exists() and (not folder.is_dir() or {path.name for path in folder.iterdir()} - set(names)):
        raise InputError(f"{folder}: expected no folder, or a scene of {', '.join(names)}, found other files")
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    previous = folder.with_name(f".{folder.name}.{os.getpid()}.old")
    temporary.mkdir(parents=True, exist_ok=True)
    try:
        yield temporary
        if folder.exists():  # two renames: a folder cannot be replaced in one step
            folder.rename(previous)
        temporary.rename(folder)
        shutil.rmtree(previous, ignore_errors=True)
    finally:
        if previous.exists() and not folder.exists():
            previous.rename(folder)
        shutil.rmtree(temporary, ignore_errors=True)
