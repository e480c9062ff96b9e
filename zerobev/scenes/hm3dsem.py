"""Reader of HM3DSem v0.2: finds scenes, splits them, and reads one as a `Scene`.

A data set is a folder with `train`, `val` and optionally `minival`; a scene is a folder `NNNNN-HASH` in one of them,
with `HASH.glb` (the photograph), `HASH.semantic.glb` (the annotation) and `HASH.semantic.txt` (the names). Variants
with Basis textures are ignored. `hm3dsem_writer` writes the same format.
"""

import logging
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from zerobev.common.errors import InputError
from zerobev.config import Split, one_of
from zerobev.scenes.categories import label_of
from zerobev.scenes.charts import Charts
from zerobev.scenes.extents import check_extents
from zerobev.scenes.glb import RAW_UV, placed_meshes, read_glb
from zerobev.scenes.scene import Instance, Scene

log = logging.getLogger("zerobev.scenes")

FIRST_LINE = "HM3D Semantic Annotations"
_SPLITS = ("train", "val", "minival")
_MINIVAL = ("00800", "00802", "00803", "00808")
_ROW = re.compile(r'([0-9]{1,5}),([0-9A-Fa-f]{6}),"(.*)",(-?[0-9]{1,9})')
_ROW_FORM = 'id,RRGGBB,"name",region'
_MAX_ID = 65535
_MAX_ROWS_SHOWN = 5  # bad rows in a message


@dataclass(frozen=True)
class SceneFolders:
    """Folders of the scenes for training, validation and test; each sorted by name."""

    train: tuple[Path, ...]
    validation: tuple[Path, ...]
    test: tuple[Path, ...]

    def of(self, split: Split) -> tuple[Path, ...]:
        """The folders of one split."""
        return {"train": self.train, "validation": self.validation, "test": self.test}[one_of("split", split, Split)]


def hash_of(folder: Path) -> str:
    """The part of a scene folder's name in its files' names; a folder name of another form is an `InputError`."""
    match = re.fullmatch(r"[0-9]{5}-(\w+)", Path(folder).name)
    if match is None:
        raise InputError(f"{folder}: expected a scene folder named NNNNN-HASH, found {Path(folder).name!r}")
    return match[1]


def find_scenes(root: Path) -> dict[str, list[Path]]:
    """The annotated scene folders in `train`, `val` and `minival` of `root`, sorted by name; lists may be empty.

    A scene is annotated if it has both semantic files. If none is found, it is an `InputError`.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root}: expected a dataset folder, found {'a file' if root.exists() else 'nothing'}")
    folders = {split: sorted((root / split).glob("[0-9]*-*")) for split in _SPLITS}
    found = {split: [folder for folder in folders[split] if _is_annotated(folder)] for split in _SPLITS}
    if not any(found.values()):
        count = sum(map(len, folders.values()))
        expected = "train, val or minival with scenes NNNNN-HASH that have .semantic.glb and .semantic.txt"
        raise InputError(f"{root}: expected {expected}, found {count} scene folders, none of them annotated")
    return found


def list_scenes(root: Path) -> list[Path]:
    """All annotated scene folders at `root`, sorted by name: of a data set, of one of its parts, or the scene itself.

    Raises `InputError` if there is none.
    """
    root = Path(root)
    alone = [root] if root.is_dir() and _is_annotated(root) else []
    found = alone or [folder for folder in sorted(root.glob("[0-9]*-*")) if _is_annotated(folder)]
    if not found:
        by_name = {folder.name: folder for folders in find_scenes(root).values() for folder in folders}
        found = [by_name[name] for name in sorted(by_name)]
    return found


def split_scenes(root: Path) -> SceneFolders:
    """Split the scenes of `root` as the paper does, or by name if that is not possible.

    The paper's split (section "Experimental Results"): training on `train`; validation on the four annotated scenes of
    `minival` (taken from `val` if that folder is missing); test on the rest of `val`.

    If one of the three would be empty, all scenes are sorted by name: of n scenes the last max(1, n // 5) are for test,
    the one before them for validation, and the others for training. Of two scenes the training scene is also the
    validation scene, with other views. One scene is an `InputError`.
    """
    found = find_scenes(root)
    validation = found["minival"] or [folder for folder in found["val"] if folder.name[:5] in _MINIVAL]
    names = {folder.name for folder in validation}
    test = [folder for folder in found["val"] if folder.name not in names]
    if found["train"] and validation and test:
        return SceneFolders(tuple(found["train"]), tuple(validation), tuple(test))
    by_name = {folder.name: folder for split in _SPLITS for folder in found[split]}
    scenes = tuple(by_name[name] for name in sorted(by_name))
    if len(scenes) < 2:
        raise InputError(f"{root}: expected at least two annotated scenes, for training and for test, found one")
    tests = max(1, len(scenes) // 5)
    if len(scenes) == 2:
        return SceneFolders(scenes[:1], scenes[:1], scenes[1:])
    return SceneFolders(scenes[: -tests - 1], scenes[-tests - 1 : -tests], scenes[-tests:])


def read_scene(folder: Path) -> Scene:
    """The scene in `folder`, named after it.

    Faces are in the file's order, charts in the order of their first face. Texels with a colour of no instance get id
    0; on more than 5 % of the surface they are an `InputError`. So are a mesh of the annotation without a texture (it
    defines the atlas), a broken or missing file, and a scene that is not in metres with z up (`check_extents`).
    """
    folder = Path(folder)
    stem = hash_of(folder)
    instances, bad_rows = read_instances(folder / f"{stem}.semantic.txt")
    path = folder / f"{stem}.semantic.glb"
    annotation = read_glb(path)
    atlas = _read_atlas(path, annotation, instances, bad_rows)
    photograph_path = folder / f"{stem}.glb"
    photograph = read_glb(photograph_path)
    unlit = any(mesh.metadata["unlit"] for mesh in photograph.geometry.values())
    for mesh in photograph.geometry.values():
        image = _texture(mesh)
        if image is not None:
            _check_texture(photograph_path, image)
    scene = Scene(name=folder.name, **atlas, instances=instances, photograph=photograph, unlit=unlit)
    check_extents(scene, path, photograph_path)
    return scene


def read_instances(path: Path) -> tuple[tuple[Instance, ...], int]:
    """The rows of a `.semantic.txt`, sorted by id, with the labels of their names; and the number of left-out rows.

    The first line is `HM3D Semantic Annotations`, each further line `id,RRGGBB,"name",region`; names may contain commas
    and quotes. Ids are 1 to 65535; ids and colours are unique, and black means "unknown".

    A row of another form, or with the id of an earlier row, is left out; two rows with the same colour are both left
    out. Their surfaces have id 0, "unknown". One warning on the log "zerobev.scenes" lists them. A file without a good
    row, without the first line, or that cannot be read, is an `InputError`.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="surrogateescape").split("\n")
    except OSError as error:
        raise InputError(f"{path}: expected a list of instances, found {error.strerror}") from error
    if lines[0].rstrip() != FIRST_LINE:
        raise InputError(f"{path}, line 1: expected {FIRST_LINE!r}, found {lines[0][:80]!r}")
    instances: dict[int, Instance] = {}
    id_of_color: dict[tuple[int, int, int], int] = {(0, 0, 0): 0}
    bad = []
    for number, line in enumerate(lines[1:], start=2):
        row = line.strip()
        if not row:
            continue
        instance = _instance(row)
        if instance is not None and instances.get(instance.id) == instance:
            continue  # an exact duplicate
        if instance is None or instance.id in instances or instance.color in id_of_color:
            bad.append(f"line {number}, {row.encode(errors='backslashreplace').decode()[:80]!r}")
            if instance is not None:
                instances.pop(id_of_color.get(instance.color, 0), None)
            continue
        id_of_color[instance.color] = instance.id
        instances[instance.id] = instance
    if bad:
        expected = f"{_ROW_FORM} with UTF-8, an id from 1 to {_MAX_ID}, and ids and colors not used twice"
        more = f" and {len(bad) - _MAX_ROWS_SHOWN} more" if len(bad) > _MAX_ROWS_SHOWN else ""
        message = f"{path}: expected {expected}, found {'; '.join(bad[:_MAX_ROWS_SHOWN])}{more}"
        if not instances:
            raise InputError(message)
        log.warning("%s: their surfaces are unknown", message)
    return tuple(instances[key] for key in sorted(instances)), len(bad)


def _instance(row: str) -> Instance | None:
    """The instance of one row of a `.semantic.txt`, or None for a row of another form."""
    match = _ROW.fullmatch(row)
    is_utf8 = not any("\ud800" <= character <= "\udfff" for character in row)
    if match is None or not is_utf8 or not 1 <= int(match[1]) <= _MAX_ID:
        return None
    red, green, blue = bytes.fromhex(match[2])
    return Instance(int(match[1]), (red, green, blue), match[3], int(match[4]), label_of(match[3]))


def _is_annotated(folder: Path) -> bool:
    stem = folder.name.partition("-")[2]
    return all((folder / f"{stem}.semantic.{kind}").is_file() for kind in ("glb", "txt"))


def _read_atlas(path: Path, annotation: trimesh.Scene, instances: tuple[Instance, ...], bad_rows: int) -> dict:
    """The fields of a `Scene` from the annotation's mesh and textures."""
    id_of_color = np.zeros(1 << 24, np.uint16)
    for instance in instances:
        red, green, blue = instance.color
        id_of_color[red | green << 8 | blue << 16] = instance.id
    charts = Charts(path, id_of_color, bad_rows)
    vertices, faces, double_sided = [], [], []
    count = 0
    for mesh, positions, triangles in placed_meshes(annotation):
        image = _texture(mesh)
        raw_uv = mesh.vertex_attributes.get(RAW_UV)
        if image is None or raw_uv is None:
            raise InputError(f"{path}: expected a texture and UV coordinates on every mesh, found one without")
        vertices.append(positions)
        faces.append((triangles + count).astype(np.int32))
        charts.add(image, mesh.metadata["wrap"], np.asarray(raw_uv, np.float32)[triangles])
        double_sided.append(np.full(len(triangles), bool(mesh.visual.material.doubleSided)))
        count += len(positions)
    world, corners = np.concatenate(vertices), np.concatenate(faces)
    sided = np.concatenate(double_sided)
    return {"vertices": world, "faces": corners, "double_sided": sided, **charts.build(world[corners])}


def _texture(mesh: trimesh.Geometry) -> Image.Image | None:
    return getattr(getattr(getattr(mesh, "visual", None), "material", None), "baseColorTexture", None)


def _check_texture(path: Path, image: Image.Image) -> None:
    try:
        image.load()
    except Exception as error:  # PIL raises many kinds of error for a damaged image
        raise InputError(f"{path}: expected readable textures, found one that is not: {error}") from error
