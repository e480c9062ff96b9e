"""HM3DSem's format: round trips, real scenes, and the errors for broken files."""

import dataclasses
import json
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from zerobev.common.errors import InputError
from zerobev.config import LABELS, NO_LABEL
from zerobev.scenes.glb import placed_meshes, read_glb
from zerobev.scenes.hm3dsem import FIRST_LINE, read_instances, read_scene, split_scenes
from zerobev.scenes.hm3dsem_writer import srgb_to_linear, write_dataset_config, write_scene
from zerobev.scenes.indoor import generate_home
from zerobev.scenes.indoor.plan import draw_plan
from zerobev.scenes.scene import Instance, Scene

from support.paths import REAL_HOMES, ROOT

REAL = sorted(REAL_HOMES.glob("val/*-*"))
needs_homes = pytest.mark.skipif(not REAL, reason="needs the two real homes in HM3DSem layout")
ARRAYS = ("vertices", "faces", "face_uv", "face_chart", "double_sided")


def quads(*corners: list[tuple[float, float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of quads, four vertices and two faces each."""
    first = 4 * np.arange(len(corners))[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return np.array(corners, np.float32).reshape(-1, 3), faces.astype(np.int32)


@pytest.fixture
def scene() -> Scene:
    """A floor and a chair's seat on one chart, a wall on another; arbitrary float32 UV coordinates."""
    vertices, faces = quads(
        [(0, 0, 0), (2, 0, 0), (2, 3, 0), (0, 3, 0)],
        [(0.1, 0.1, 0.5), (0.7, 0.1, 0.5), (0.7, 0.6, 0.5), (0.1, 0.6, 0.5)],
        [(0, 3, 0), (2, 3, 0), (2, 3, 2.5), (0, 3, 2.5)],
    )
    boxes = np.array([[0.01, 0.02, 0.6, 0.97], [0.7, 0.03, 0.98, 0.3], [0.0, 0.0, 1.0, 0.4]])
    left, top, right, bottom = np.random.default_rng(0).uniform(0, 1e-3, boxes.shape).T + boxes.T * 0.999
    uv = np.stack([[left, top], [right, top], [right, bottom], [left, bottom]]).transpose(2, 0, 1).astype(np.float32)
    charts = (np.zeros((30, 40), np.uint16), np.zeros((7, 5), np.uint16))
    charts[0][:, :25], charts[0][:12, 27:], charts[1][:3] = 1, 7, 300
    instances = (
        Instance(1, (0x23, 0x69, 0x4C), "wooden floor", 0, LABELS.index("floor")),
        Instance(7, (0, 0, 1), 'chair, "antique"', 0, NO_LABEL),
        Instance(300, (255, 3, 254), "wall", 2, LABELS.index("wall")),
    )
    image = Image.fromarray(np.full((8, 8, 3), (200, 100, 50), np.uint8))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    visual = trimesh.visual.TextureVisuals(uv=uv.reshape(-1, 2) * [1, -1] + [0, 1], material=material)
    photograph = trimesh.Scene(trimesh.Trimesh(vertices, faces, visual=visual, process=False))
    face_chart = np.array([0, 0, 0, 0, 1, 1], np.int16)
    face_uv = uv.reshape(-1, 2)[faces]
    return Scene(
        "00001-Test", vertices, faces, face_uv, face_chart, charts, instances, photograph, False, np.zeros(6, bool)
    )


def chunks(path: Path) -> tuple[dict, bytearray]:
    """The JSON header and the binary chunk of a GLB file, read without the code under test."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), bytearray(content[28 + size :])


def edit_glb(path: Path, edit: Callable[[dict, bytearray], None]) -> None:
    """Change the JSON header and the binary chunk of a GLB file in place."""
    header, binary = chunks(path)
    edit(header, binary)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    parts = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts)


def vertex_colors(path: Path) -> np.ndarray:
    """(V, 4) uint16 `COLOR_0` of all meshes of a GLB file, read without the code under test."""
    header, binary = chunks(path)
    colors = []
    for mesh in header["meshes"]:
        accessor = header["accessors"][mesh["primitives"][0]["attributes"]["COLOR_0"]]
        assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
        start = header["bufferViews"][accessor["bufferView"]]["byteOffset"]
        colors.append(np.frombuffer(binary, "<u2", 4 * accessor["count"], start).reshape(-1, 4))
    return np.concatenate(colors)


@pytest.mark.parametrize(("unlit", "double_sided"), [(False, [0, 0, 1, 1, 0, 0]), (True, [0] * 6), (True, [1] * 6)])
def test_a_scene_is_read_as_written(scene: Scene, tmp_path: Path, unlit: bool, double_sided: list[int]) -> None:
    scene = dataclasses.replace(scene, unlit=unlit, double_sided=np.array(double_sided, bool))
    write_scene(tmp_path / scene.name, scene)
    back = read_scene(tmp_path / scene.name)
    for name in ARRAYS:
        found, expected = getattr(back, name), getattr(scene, name)
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected, err_msg=name)
    for found, expected in zip(back.chart_instance, scene.chart_instance, strict=True):
        assert found.dtype == np.uint16
        np.testing.assert_array_equal(found, expected)
    assert back.instances == scene.instances
    assert (back.name, back.unlit) == (scene.name, unlit)
    np.testing.assert_array_equal(back.face_instance, [1, 1, 7, 7, 300, 300])
    (mesh, vertices, faces), *none = placed_meshes(back.photograph)
    assert not none
    np.testing.assert_array_equal(vertices[faces], scene.vertices[scene.faces])
    np.testing.assert_allclose(mesh.visual.uv, scene.photograph.dump()[0].visual.uv, atol=1e-6)
    photographed = mesh.visual.material.baseColorTexture
    assert photographed.format == "JPEG"
    np.testing.assert_allclose(np.asarray(photographed), np.full((8, 8, 3), (200, 100, 50)), atol=3)
    assert bool(mesh.visual.material.doubleSided) == any(double_sided)


def test_files_follow_the_format(scene: Scene, tmp_path: Path) -> None:
    write_scene(tmp_path / scene.name, scene)
    path = tmp_path / scene.name / "Test.semantic.glb"
    header, annotation = chunks(path)[0], read_glb(path)
    assert header["samplers"] == [{"magFilter": 9728, "minFilter": 9728, "wrapS": 33071, "wrapT": 33071}]
    assert all(texture["sampler"] == 0 for texture in header["textures"])
    assert all("KHR_materials_unlit" in material["extensions"] for material in header["materials"])
    assert header["extensionsUsed"] == ["KHR_materials_unlit"]
    assert [image["mimeType"] for image in header["images"]] == ["image/png"] * 2
    texture = next(iter(annotation.geometry.values())).visual.material.baseColorTexture
    np.testing.assert_array_equal(np.asarray(texture)[0, [0, 26, 39]], [[0x23, 0x69, 0x4C], [0, 0, 0], [0, 0, 1]])
    # glTF's own formula at three bytes: the linear branch, the power branch, and white
    colors = vertex_colors(path)
    np.testing.assert_array_equal(
        colors[[0, 4, 8], 2], [round(65535 * ((0x4C / 255 + 0.055) / 1.055) ** 2.4), 20, 64952]
    )
    np.testing.assert_array_equal(colors[:, 3], 65535)
    text = (tmp_path / scene.name / "Test.semantic.txt").read_text()
    assert text.splitlines()[:3] == [FIRST_LINE, '1,23694C,"wooden floor",0', '7,000001,"chair, "antique"",0']
    again = tmp_path / "again" / scene.name
    write_scene(again, scene)
    for file in again.iterdir():
        assert file.read_bytes() == (tmp_path / scene.name / file.name).read_bytes()


def test_shared_vertices_and_mixed_charts(scene: Scene, tmp_path: Path) -> None:
    """A vertex with two UV coordinates is split; faces are grouped by chart, in their order within it."""
    faces = scene.faces.copy()
    faces[4:] = [[3, 2, 10], [3, 10, 11]]  # the wall uses two of the floor's vertices
    order = np.array([4, 0, 2, 5, 3, 1])
    mixed = dataclasses.replace(
        scene, faces=faces[order], face_uv=scene.face_uv[order], face_chart=scene.face_chart[order]
    )
    write_scene(tmp_path / scene.name, mixed)
    back = read_scene(tmp_path / scene.name)
    grouped = np.argsort(mixed.face_chart, kind="stable")
    np.testing.assert_array_equal(back.vertices[back.faces], mixed.vertices[mixed.faces[grouped]])
    for name in ("face_uv", "face_chart", "face_instance"):
        np.testing.assert_array_equal(getattr(back, name), getattr(mixed, name)[grouped])
    assert len(back.vertices) == 12


def test_a_vertex_of_two_instances_has_two_colors(scene: Scene, tmp_path: Path) -> None:
    chart = np.ones((30, 40), np.uint16)
    chart[15:] = 7
    write_scene(tmp_path / scene.name, dataclasses.replace(scene, chart_instance=(chart, *scene.chart_instance[1:])))
    back = read_scene(tmp_path / scene.name)
    np.testing.assert_array_equal(back.face_instance, [1, 7, 1, 1, 300, 300])
    color = {instance.id: srgb_to_linear(np.array([*instance.color, 255])) for instance in scene.instances}
    found = vertex_colors(tmp_path / scene.name / "Test.semantic.glb")[back.faces]
    for corners, owner in zip(found, back.face_instance):
        np.testing.assert_array_equal(corners, [color[owner]] * 3)


def test_uv_beyond_a_clamped_texture_is_unchanged(scene: Scene, tmp_path: Path) -> None:
    """Clamping is per point: clamped corners would stretch the texture over the face."""
    wide = scene.face_uv * 3 - np.float32(1)
    write_scene(tmp_path / scene.name, dataclasses.replace(scene, face_uv=wide))
    np.testing.assert_array_equal(read_scene(tmp_path / scene.name).face_uv, wide)


def test_equal_charts_stay_separate(scene: Scene, tmp_path: Path) -> None:
    write_scene(tmp_path / scene.name, dataclasses.replace(scene, chart_instance=scene.chart_instance[:1] * 2))
    back = read_scene(tmp_path / scene.name)
    assert len(back.chart_instance) == 2
    np.testing.assert_array_equal(back.face_chart, scene.face_chart)


def test_node_transforms(scene: Scene, tmp_path: Path) -> None:
    """A moved, mirrored mesh is at its place and shows its front."""
    write_scene(tmp_path / scene.name, scene)

    def place(header: dict, _: bytearray) -> None:
        header["nodes"][0] |= {"translation": [1, 2, 3], "scale": [-1, 2, 1]}

    edit_glb(tmp_path / scene.name / "Test.semantic.glb", place)
    back = read_scene(tmp_path / scene.name)
    np.testing.assert_allclose(back.vertices[:8], scene.vertices[:8] * [-1, 2, 1] + [1, 2, 3], rtol=1e-6)
    np.testing.assert_array_equal(back.vertices[8:], scene.vertices[8:])
    a, b, c = np.moveaxis(back.vertices[back.faces[:4]], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    np.testing.assert_array_equal(back.face_instance, scene.face_instance)


def test_plain_photographs(scene: Scene, tmp_path: Path) -> None:
    """Meshes without a texture keep their colour, of the material or of the vertices."""
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 51, 0, 255])
    )
    ball = trimesh.creation.icosphere(subdivisions=0)
    ball.visual.vertex_colors = np.arange(48).reshape(12, 4) * 5
    write_scene(tmp_path / scene.name, dataclasses.replace(scene, photograph=trimesh.Scene([box, ball])))
    first, second = (mesh for mesh, _, _ in placed_meshes(read_scene(tmp_path / scene.name).photograph))
    np.testing.assert_array_equal(first.visual.material.main_color, [255, 51, 0, 255])
    np.testing.assert_array_equal(second.visual.vertex_colors, ball.visual.vertex_colors)


def test_an_earlier_scene_is_replaced_atomically(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / scene.name
    write_scene(folder, scene)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    with pytest.raises(AttributeError):
        write_scene(folder, dataclasses.replace(scene, photograph=None))
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    assert list(tmp_path.iterdir()) == [folder]
    with monkeypatch.context() as patched:
        move = Path.rename
        patched.setattr(Path, "rename", lambda path, to: 1 / 0 if path.suffix == ".part" else move(path, to))
        with pytest.raises(ZeroDivisionError):
            write_scene(folder, scene)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    write_scene(folder, dataclasses.replace(scene, vertices=scene.vertices + 1))
    np.testing.assert_array_equal(read_scene(folder).vertices, scene.vertices + 1)
    assert list(tmp_path.iterdir()) == [folder]
    (folder / "Test.basis.navmesh").touch()
    with pytest.raises(InputError, match="other files"):
        write_scene(folder, scene)
    assert len(list(folder.iterdir())) == 4


def test_scenes_that_cannot_be_written(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="NNNNN-HASH"):
        write_scene(tmp_path / "Test", scene)
    broken = dataclasses.replace(scene.instances[0], name="two\nlines")
    with pytest.raises(InputError, match=r"instance 1: .*one line"):
        write_scene(tmp_path / scene.name, dataclasses.replace(scene, instances=(broken, *scene.instances[1:])))
    assert not list(tmp_path.iterdir())


def _positions_nan(header: dict, binary: bytearray) -> None:
    struct.pack_into("<f", binary, 8, float("nan"))


def _image_damaged(header: dict, binary: bytearray) -> None:
    view = header["bufferViews"][header["images"][0]["bufferView"]]
    start = view["byteOffset"] + 45  # after the image's header, so that only decoding fails
    binary[start : start + view["byteLength"] - 45] = bytes(view["byteLength"] - 45)


def _image_cut_short(header: dict, _: bytearray) -> None:
    header["bufferViews"][header["images"][0]["bufferView"]]["byteLength"] -= 6


def _image_unknown(header: dict, binary: bytearray) -> None:
    binary[header["bufferViews"][header["images"][0]["bufferView"]]["byteOffset"]] = 0


def _face_out_of_range(header: dict, binary: bytearray) -> None:
    accessor = header["accessors"][header["meshes"][0]["primitives"][0]["indices"]]
    struct.pack_into("<I", binary, header["bufferViews"][accessor["bufferView"]]["byteOffset"], 999)


EDITS = {
    "finite": _positions_nan,
    "readable textures": _image_damaged,
    "PNG or JPEG": _image_unknown,
    "does not exist": _face_out_of_range,
    "no triangles|no mesh": lambda header, _: [header.pop(key) for key in ("meshes", "nodes", "scenes")],
    "texture and UV": lambda header, _: header["meshes"][1]["primitives"][0].pop("material"),
    "UV coordinates on every mesh": lambda header, _: header["meshes"][0]["primitives"][0]["attributes"].pop(
        "TEXCOORD_0"
    ),
    "KeyError": lambda header, _: header["accessors"][0].pop("count"),
    "rows of 3 numbers": lambda header, _: header["accessors"][0].update(count=10**6),
}


@pytest.mark.parametrize("expected", EDITS)
def test_a_damaged_mesh_is_named(scene: Scene, tmp_path: Path, expected: str) -> None:
    write_scene(tmp_path / scene.name, scene)
    edit_glb(tmp_path / scene.name / "Test.semantic.glb", EDITS[expected])
    with pytest.raises(InputError, match=rf"Test\.semantic\.glb: expected .*({expected})") as caught:
        read_scene(tmp_path / scene.name)
    assert "\n" not in str(caught.value)


def test_a_damaged_photograph_is_named(scene: Scene, tmp_path: Path) -> None:
    write_scene(tmp_path / scene.name, scene)
    edit_glb(tmp_path / scene.name / "Test.glb", _image_cut_short)
    with pytest.raises(InputError, match=r"Test\.glb: expected readable textures"):
        read_scene(tmp_path / scene.name)


@pytest.mark.parametrize("name", ["Test.glb", "Test.semantic.glb"])
@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda content: b"", "found 0 bytes"),
        (lambda content: b"<html>not a home at all</html>", "start with b'<htm'"),
        (lambda content: content[:-1], r"expected \d+ bytes, by its header, found \d+"),
        (lambda content: content[:30], r"expected \d+ bytes, by its header, found 30"),
        (lambda content: content + b"\0", r"expected \d+ bytes, by its header, found \d+"),
        (lambda content: content[:4] + b"\1" + content[5:], "found version 1"),
        (lambda content: content[:20] + b"]" + content[21:], "JSON"),
        (None, "No such file"),
    ],
)
def test_a_damaged_file_is_named(
    scene: Scene, tmp_path: Path, name: str, damage: Callable[[bytes], bytes] | None, expected: str
) -> None:
    write_scene(tmp_path / scene.name, scene)
    path = tmp_path / scene.name / name
    content = path.read_bytes()
    path.unlink()
    if damage:
        path.write_bytes(damage(content))
    with pytest.raises(InputError, match=f"{name}: .*{expected}") as caught:
        read_scene(tmp_path / scene.name)
    assert "\n" not in str(caught.value)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_any_damage_is_read_or_named(scene: Scene, tmp_path: Path, data: st.DataObject) -> None:
    folder = tmp_path / scene.name
    write_scene(folder, scene)
    path = folder / data.draw(st.sampled_from(["Test.glb", "Test.semantic.glb"]))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        back = read_scene(folder)
    except InputError as error:
        assert str(path.name) in str(error)
        assert "\n" not in str(error)
    else:
        assert np.isfinite(back.face_uv).all()
        assert len(back.face_instance) == len(back.faces)


def listed(tmp_path: Path, *rows: str, first: str = FIRST_LINE) -> tuple[Instance, ...]:
    path = tmp_path / "names.semantic.txt"
    path.write_text("\n".join([first, *rows]), encoding="utf-8")
    return read_instances(path)[0]


def test_rows_of_instances(tmp_path: Path) -> None:
    rows = ['313,23694c,"refrigerator cabinet",9', '2,0000FF,"chair, with "quotes", and 1,2",0', ""]
    assert listed(tmp_path, *rows) == (
        Instance(2, (0, 0, 255), 'chair, with "quotes", and 1,2', 0, NO_LABEL),
        Instance(313, (0x23, 0x69, 0x4C), "refrigerator cabinet", 9, NO_LABEL),
    )
    assert listed(tmp_path, '1,000001,"armchair",-1')[0].label == LABELS.index("chair")
    assert listed(tmp_path) == ()


CHAIR = Instance(1, (0x23, 0x69, 0x4C), "chair", 0, LABELS.index("chair"))
BED = Instance(2, (0x23, 0x69, 0x4D), "bed", 0, LABELS.index("bed"))
GOOD = ['1,23694C,"chair",0', '2,23694D,"bed",0']


@pytest.mark.parametrize(
    ("row", "remaining"),
    [
        ('7,ABCDEF,"sofa"', [CHAIR, BED]),
        ("7,ABCDEF,sofa,0", [CHAIR, BED]),
        ('7,ABCDE,"sofa",0', [CHAIR, BED]),
        ('7,GGGGGG,"sofa",0', [CHAIR, BED]),
        ('0,ABCDEF,"sofa",0', [CHAIR, BED]),
        ('65536,ABCDEF,"sofa",0', [CHAIR, BED]),
        ('7,000000,"sofa",0', [CHAIR, BED]),
        ('1,ABCDEF,"sofa",0', [CHAIR, BED]),  # the id of another colour
        ('7,23694C,"sofa",0', [BED]),  # the surface is ambiguous
        ('1,23694C,"sofa",0', [BED]),
        ('7,ABCDEF,"caf\udce9",0', [CHAIR, BED]),  # a byte that is not UTF-8
    ],
)
def test_a_bad_row_is_reported_and_its_surface_unknown(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, row: str, remaining: list[Instance]
) -> None:
    path = tmp_path / "names.semantic.txt"
    path.write_bytes("\n".join([FIRST_LINE, *GOOD, "", row]).encode(errors="surrogateescape"))
    assert list(read_instances(path)[0]) == remaining
    (record,) = caplog.records
    assert record.getMessage().startswith(f'{path}: expected id,RRGGBB,"name",region')
    assert "found line 5, " in record.getMessage() and "\n" not in record.getMessage()
    assert record.getMessage().endswith("their surfaces are unknown")
    path.write_bytes("\n".join([FIRST_LINE, row]).encode(errors="surrogateescape"))
    if row.startswith(("1,", "7,23")):
        assert len(read_instances(path)[0]) == 1
    else:
        with pytest.raises(InputError, match=r"names\.semantic\.txt: .*found line 2, "):
            read_instances(path)


def test_texels_of_a_bad_row_have_no_instance(scene: Scene, tmp_path: Path) -> None:
    write_scene(tmp_path / scene.name, scene)
    path = tmp_path / scene.name / "Test.semantic.txt"
    path.write_text(path.read_text().replace("7,000001", "7,00001"))
    np.testing.assert_array_equal(read_scene(tmp_path / scene.name).face_instance, [1, 1, 0, 0, 300, 300])


def test_many_bad_rows_are_one_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert len(listed(tmp_path, *GOOD, *["nonsense"] * 9)) == 2
    assert [record.getMessage().count("'nonsense'") for record in caplog.records] == [5]
    assert "and 4 more" in caplog.text


def test_a_row_that_is_repeated_is_one_instance(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert list(listed(tmp_path, *GOOD, GOOD[0])) == [CHAIR, BED]
    assert not caplog.records


def test_a_bad_list_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="line 1: expected 'HM3D Semantic Annotations', found '1,"):
        listed(tmp_path, first='1,23694C,"chair",0')
    with pytest.raises(InputError, match=r"names\.semantic\.txt.*No such file"):
        read_instances(tmp_path / "other" / "names.semantic.txt")


almost_row = st.from_regex(r'\A[0-9]{0,6},[0-9A-G]{5,7},"?[^\n]{0,5}"?,-?[0-9]{0,2}\Z')


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(st.binary(), st.lists(st.one_of(almost_row, st.text())).map(lambda r: "\n".join(r).encode())))
def test_any_text_gives_instances_or_an_input_error(tmp_path: Path, body: bytes) -> None:
    path = tmp_path / "names.semantic.txt"
    path.write_bytes(FIRST_LINE.encode() + b"\n" + body)
    try:
        instances, _ = read_instances(path)
    except InputError as error:
        assert str(path) in str(error)
        assert "\n" not in str(error)
    else:
        ids = [instance.id for instance in instances]
        assert ids == sorted(set(ids))
        assert len({instance.color for instance in instances}) == len(ids)


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(st.characters(codec="utf-8", exclude_characters="\r\n")))
def test_every_name_of_one_line_is_read_as_written(scene: Scene, tmp_path: Path, name: str) -> None:
    instance = dataclasses.replace(scene.instances[0], name=name)
    write_scene(tmp_path / scene.name, dataclasses.replace(scene, instances=(instance, *scene.instances[1:])))
    assert read_instances(tmp_path / scene.name / "Test.semantic.txt")[0][0].name == name


def dataset(root: Path, *scenes: str, annotated: bool = True) -> Path:
    for scene in scenes:
        (root / scene).mkdir(parents=True)
        stem = scene.partition("-")[2]
        (root / scene / f"{stem}.basis.glb").touch()
        for kind in ("glb", "txt") if annotated else ():
            (root / scene / f"{stem}.semantic.{kind}").touch()
    return root


def names(folders: tuple[Path, ...]) -> list[str]:
    return [folder.parent.name + "/" + folder.name[:5] for folder in folders]


def test_the_official_split(tmp_path: Path) -> None:
    root = dataset(tmp_path, "train/00006-b", "train/00002-a", *(f"val/{n:05d}-v" for n in range(800, 812)))
    dataset(root, "train/00009-unannotated", "val/00899-unannotated", annotated=False)
    split = split_scenes(root)
    assert names(split.train) == ["train/00002", "train/00006"]
    assert names(split.validation) == ["val/00800", "val/00802", "val/00803", "val/00808"]
    assert names(split.test) == [f"val/{n:05d}" for n in (801, 804, 805, 806, 807, 809, 810, 811)]


def test_minival_is_validation_and_never_test(tmp_path: Path) -> None:
    root = dataset(tmp_path, "train/00006-b", "minival/00800-a", "val/00800-a", "val/00802-c", "minival/00850-d")
    split = split_scenes(root)
    assert names(split.validation) == ["minival/00800", "minival/00850"]
    assert names(split.test) == ["val/00802"]


@pytest.mark.parametrize(
    ("count", "train", "validation", "test"),
    [(2, [0], [0], [1]), (3, [0], [1], [2]), (10, list(range(7)), [7], [8, 9])],
)
def test_few_scenes_are_split_by_name(
    tmp_path: Path, count: int, train: list[int], validation: list[int], test: list[int]
) -> None:
    split = split_scenes(dataset(tmp_path, *(f"val/{n:05d}-v" for n in range(900, 900 + count))))
    numbers = [[int(folder.name[:5]) - 900 for folder in part] for part in (split.train, split.validation, split.test)]
    assert numbers == [train, validation, test]


def test_a_folder_without_scenes_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere: expected a dataset folder, found nothing"):
        split_scenes(tmp_path / "nowhere")
    dataset(tmp_path, "val/00001-a", annotated=False)
    with pytest.raises(InputError, match="found 1 scene folders, none of them annotated"):
        split_scenes(tmp_path)
    dataset(tmp_path, "val/00002-b")
    with pytest.raises(InputError, match=r"at least.*found one"):
        split_scenes(tmp_path)
    with pytest.raises(InputError, match="NNNNN-HASH"):
        read_scene(tmp_path)


def test_dataset_config(tmp_path: Path) -> None:
    write_dataset_config(tmp_path, [tmp_path / "val/00905-B", tmp_path / "train/00003-A"])
    config = json.loads((tmp_path / "hm3d_annotated_basis.scene_dataset_config.json").read_text())
    assert config["stages"]["paths"][".glb"] == ["train/00003-A/A.glb", "val/00905-B/B.glb"]
    assert config["stages"]["default_attributes"]["up"] == [0, 0, 1]


@needs_homes
def test_dataset_config_of_the_real_homes(tmp_path: Path) -> None:
    write_dataset_config(tmp_path, [tmp_path / home.relative_to(REAL_HOMES) for home in REAL])
    (file,) = tmp_path.iterdir()
    assert json.loads(file.read_text()) == json.loads((REAL_HOMES / file.name).read_text())


@needs_homes
@pytest.mark.parametrize("folder", REAL, ids=lambda folder: folder.name)
def test_real_homes(folder: Path, tmp_path: Path) -> None:
    home = read_scene(folder)
    stem = folder.name.partition("-")[2]
    assert len(home.instances) == (folder / f"{stem}.semantic.txt").read_text().strip().count("\n")
    present = {LABELS[i.label] for i in home.instances if i.label != NO_LABEL}
    assert {"wall", "floor", "chair", "plant"} <= present
    assert home.double_sided.all()
    assert not home.unlit

    # both colour conventions agree on the instance for more than 99.9 % of the surface: chart rows point down
    a, b, c = np.moveaxis(home.vertices[home.faces].astype(float), 1, 0)
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    color = np.zeros((len(home.instance_label), 3), int)
    for instance in home.instances:
        color[instance.id] = srgb_to_linear(np.array(instance.color))
    painted = vertex_colors(folder / f"{stem}.semantic.glb")[home.faces[:, 0], :3]
    agree = (color[home.face_instance] == painted).all(axis=1)
    assert area[agree].sum() > 0.999 * area.sum()

    label = home.instance_label[home.face_instance]
    floor = label == LABELS.index("floor")
    structural = np.isin(home.face_instance, [i.id for i in home.instances if i.name == "floor"])
    assert floor[structural].all()
    level = np.abs(home.vertices[home.faces[structural]][..., 2]).max(axis=1) < 0.05
    horizontal = np.abs(normal[structural, 2]) > 0.99 * area[structural]
    assert area[structural][level & horizontal].sum() > 0.99 * area[structural].sum()
    ceiling = np.isin(home.face_instance, [i.id for i in home.instances if i.name == "ceiling"])
    assert home.vertices[home.faces[ceiling]][..., 2].min() > 2

    write_scene(tmp_path / folder.name, home)
    back = read_scene(tmp_path / folder.name)
    np.testing.assert_array_equal(back.vertices[back.faces], home.vertices[home.faces])
    for name in ("face_uv", "face_chart", "face_instance"):
        np.testing.assert_array_equal(getattr(back, name), getattr(home, name))
    assert back.instances == home.instances


def refined(scene: Scene, cuts: int) -> Scene:
    """The same surface with every triangle cut into `cuts`^2 ones, in annotation and photograph."""
    i, j = np.array([(i, j) for i in range(cuts + 1) for j in range(cuts + 1 - i)]).T
    index = {place: k for k, place in enumerate(zip(i.tolist(), j.tolist()))}
    upright = [(index[a, b], index[a + 1, b], index[a, b + 1]) for a in range(cuts) for b in range(cuts - a)]
    turned = [(index[a + 1, b], index[a + 1, b + 1], index[a, b + 1]) for a in range(cuts) for b in range(cuts - 1 - a)]
    weight, small = np.stack([cuts - i - j, i, j], axis=1).astype(np.float32) / cuts, np.array(upright + turned)
    vertices = weight @ scene.vertices[scene.faces]
    uv = weight @ scene.face_uv
    photograph = trimesh.Scene()
    for chart, mesh in enumerate(scene.photograph.geometry.values()):
        on = scene.face_chart == chart
        faces = len(weight) * np.arange(on.sum())[:, None, None] + small
        visual = trimesh.visual.TextureVisuals(uv[on].reshape(-1, 2) * [1, -1] + [0, 1], material=mesh.visual.material)
        cut = trimesh.Trimesh(vertices[on].reshape(-1, 3), faces.reshape(-1, 3), visual=visual, process=False)
        photograph.add_geometry(cut, geom_name=f"chart{chart}")
    faces = len(weight) * np.arange(len(scene.faces))[:, None, None] + small
    return dataclasses.replace(
        scene,
        vertices=vertices.reshape(-1, 3),
        faces=faces.reshape(-1, 3).astype(np.int32),
        face_uv=uv[:, small].reshape(-1, 3, 2),
        face_chart=np.repeat(scene.face_chart, len(small)),
        photograph=photograph,
    )


LOOK = """
import sys
from pathlib import Path
import numpy as np
from zerobev.config import CameraConfig
from zerobev.scenes.hm3dsem import read_scene
from zerobev.geometry.cameras import Pose
from zerobev.rendering.gbuffer import RayCaster
from zerobev.rendering.photograph import Photographer

camera, pose = CameraConfig(fpv_px=64, bev_px=40), Pose(*map(float, sys.argv[3:]))
scene = read_scene(Path(sys.argv[1]))
caster = RayCaster(scene)
photograph = Photographer(scene, camera).take(pose)
status = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
peak_kib = int(status["VmHWM"].split()[0])
seen = {"fpv": caster.fpv(pose, camera).instance, "bev": caster.bev(pose, camera).instance}
np.savez(sys.argv[2], faces=len(scene.faces), rgb=photograph, peak_kib=peak_kib, **seen)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux to measure peak memory")
def test_a_million_triangles_fit_into_four_gib(tmp_path: Path) -> None:
    """A finely cut home is read, cast and photographed in a separate process, and looks like the plain home."""
    rng = np.random.default_rng(4)
    home = generate_home("00000-Home", rng)
    x0, y0, x1, y1 = draw_plan(np.random.default_rng(4))[0].inner
    place = ((x0 + x1) / 2, (y0 + y1) / 2, 0.0, 0.4)
    seen = {}
    for name, scene in (("plain", home), ("fine", refined(home, 9))):
        write_scene(tmp_path / name / home.name, scene)
        out = tmp_path / f"{name}.npz"
        arguments = [str(tmp_path / name / home.name), str(out), *map(str, place)]
        subprocess.run([sys.executable, "-c", LOOK, *arguments], check=True, cwd=ROOT)
        seen[name] = np.load(out)
    assert seen["fine"]["faces"] == 81 * len(home.faces) >= 1_000_000
    assert seen["fine"]["peak_kib"] < 4 * 2**20
    for sensor in ("fpv", "bev"):
        assert (seen["fine"][sensor] == seen["plain"][sensor]).mean() > 0.99
        assert len(np.unique(seen["fine"][sensor])) > 5
    difference = np.abs(seen["fine"]["rgb"].astype(int) - seen["plain"]["rgb"])
    assert np.mean(difference.max(axis=-1) <= 8) > 0.97
    assert seen["fine"]["rgb"].std() > 10
