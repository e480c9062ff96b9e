"""glTF's numbers, textures and nodes against closed forms of the specification."""

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from zerobev.common.errors import InputError
from zerobev.scenes.glb import RAW_UV, TINT, read_glb
from zerobev.scenes.gltf import CLAMP, MIRROR, REPEAT, rgba
from zerobev.scenes.hm3dsem import FIRST_LINE, read_scene
from zerobev.scenes.scene import texel_of_uv

from support.glb import GlbFile, encoded

SQUARE = np.array([(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0)], float)
UV = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
COLORS = np.array([(200, 30, 40), (30, 200, 40), (40, 30, 200), (220, 210, 20)], np.uint8)
#: Ids 1 to 4 in a grid of texels.
IDS = np.random.default_rng(0).integers(1, 5, (6, 8))
ROWS = "".join('{},{:02X}{:02X}{:02X},"thing {}",0\n'.format(n, *color, n) for n, color in enumerate(COLORS, 1))


def grid() -> bytes:
    return encoded(COLORS[IDS - 1])


def read(glb: GlbFile, folder: Path) -> list:
    return list(read_glb(glb.save(folder / "a.glb")).geometry.values())


def scene_of(glb: GlbFile, root: Path, rows: str = ROWS) -> Any:
    """A scene with `glb` as annotation and photograph."""
    folder = root / "00001-Test"
    folder.mkdir(exist_ok=True)
    for name in ("Test.semantic.glb", "Test.glb"):
        glb.save(folder / name)
    (folder / "Test.semantic.txt").write_text(f"{FIRST_LINE}\n{rows}")
    return read_scene(folder)


def simple(uv: Any = UV, sampler: dict | None = None, image: bytes | None = None, **material: Any) -> GlbFile:
    glb = GlbFile()
    glb.place(glb.quad(SQUARE, uv, glb.material(image or grid(), sampler, **material)))
    return glb


@pytest.mark.parametrize(
    ("kind", "normalized", "value"),
    [
        ("u1", True, lambda n: n / 255),
        ("u2", True, lambda n: n / 65535),
        ("i1", True, lambda n: np.maximum(n / 127, -1)),
        ("i2", True, lambda n: np.maximum(n / 32767, -1)),
        ("u1", False, lambda n: n),
        ("i2", False, lambda n: n),
    ],
)
def test_integers(tmp_path: Path, kind: str, normalized: bool, value: Any) -> None:
    """Integers as UV coordinates, positions and colours; the last are always normalized."""
    ends = np.iinfo(kind)
    stored = np.random.default_rng(0).integers(ends.min, ends.max, (4, 3), endpoint=True)
    stored[0] = ends.min, ends.max, 0
    glb = GlbFile()
    primitive = glb.quad(SQUARE, glb.array(stored[:, :2], kind, normalized=normalized), glb.material(grid()))
    primitive["attributes"]["POSITION"] = glb.array(stored, kind, normalized=normalized)
    if kind.startswith("u"):
        primitive["attributes"]["COLOR_0"] = glb.array(stored, kind, normalized=True)
    glb.place(primitive)
    (mesh,) = read(glb, tmp_path)
    np.testing.assert_array_equal(mesh.vertex_attributes[RAW_UV], np.float32(value(stored[:, :2])))
    np.testing.assert_array_equal(mesh.vertices, np.float32(value(stored)))
    if kind.startswith("u"):
        tint = mesh.vertex_attributes[TINT]
        np.testing.assert_array_equal(tint[:, :3], np.float32(stored / ends.max))
        assert (tint[:, 3] == 1).all()


@pytest.mark.parametrize("view", [True, False])
def test_sparse_accessors(tmp_path: Path, view: bool) -> None:
    glb = simple()
    accessor = glb.header["accessors"][glb.header["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    expected = SQUARE.copy() if view else np.zeros((4, 3))
    expected[[1, 3]] = [(5, 6, 7), (8, 9, 10)]
    if not view:
        del accessor["bufferView"]
    accessor["sparse"] = {
        "count": 2,
        "indices": {"bufferView": glb.view(bytes([1, 3])), "componentType": 5121},
        "values": {"bufferView": glb.view(expected[[1, 3]].astype("<f4").tobytes())},
    }
    np.testing.assert_array_equal(read(glb, tmp_path)[0].vertices, expected)


def test_interleaved_vertices(tmp_path: Path) -> None:
    """Alternating positions and UV coordinates in one buffer view."""
    glb = simple()
    rows = np.concatenate([SQUARE, UV[::-1]], axis=1).astype("<f4")
    view = glb.view(rows.tobytes(), byteStride=20)
    attributes = glb.header["meshes"][0]["primitives"][0]["attributes"]
    for name, offset in (("POSITION", 0), ("TEXCOORD_0", 12)):
        glb.header["accessors"][attributes[name]] |= {"bufferView": view, "byteOffset": offset}
    (mesh,) = read(glb, tmp_path)
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.vertex_attributes[RAW_UV], UV[::-1])


def rolled(faces: Any) -> set:
    """Triangles with their smallest corner first, for comparison."""
    return {tuple(np.roll(face, -int(np.argmin(face))).tolist()) for face in np.asarray(faces)}


@pytest.mark.parametrize(
    ("mode", "indices", "faces"),
    [
        (4, [0, 1, 2, 0, 2, 3], [(0, 1, 2), (0, 2, 3)]),
        (5, [0, 1, 3, 2], [(0, 1, 3), (1, 2, 3)]),
        (5, [0, 1, 1, 3, 2], [(1, 3, 2)]),
        (6, [0, 1, 2, 3], [(0, 1, 2), (0, 2, 3)]),
        (6, None, [(0, 1, 2), (0, 2, 3)]),
        (5, None, [(0, 1, 2), (1, 3, 2)]),
    ],
)
def test_strips_and_fans(tmp_path: Path, mode: int, indices: list | None, faces: list) -> None:
    """Winding alternates in a strip; points and lines are ignored."""
    glb = simple()
    primitive = glb.header["meshes"][0]["primitives"][0]
    primitive["mode"] = mode
    del primitive["indices"]
    if indices is not None:
        primitive["indices"] = glb.array(indices, "u1")
    for other in (0, 1, 2, 3):
        glb.header["meshes"][0]["primitives"].append({**primitive, "mode": other})
    (mesh,) = read(glb, tmp_path)
    assert rolled(mesh.faces) == rolled(faces)


def test_nodes(tmp_path: Path) -> None:
    """Matrix and TRS nest; a mirrored node keeps its front; only the default scene is read."""
    glb = simple()
    glb.header["nodes"][0] |= {"translation": [1, 2, 3], "rotation": [0, 0, 0.5**0.5, 0.5**0.5], "scale": [2, -1, 1]}
    matrix = np.array([[0, 0, 1, 5], [1, 0, 0, 6], [0, 1, 0, 7], [0, 0, 0, 1.0]])
    parent = glb.add("nodes", matrix=matrix.T.ravel().tolist(), children=[0])
    other = glb.add("nodes", mesh=0)
    glb.header |= {"scenes": [{"nodes": [other]}, {"nodes": [parent]}], "scene": 1}
    (mesh,) = read(glb, tmp_path)
    x, y, z = SQUARE.T
    local = np.stack([y + 1, 2 * x + 2, z + 3], axis=1)  # (2 x, -y) rotated by a quarter turn: (y, 2 x)
    np.testing.assert_allclose(mesh.vertices, local @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-6)
    assert rolled(mesh.faces) == rolled([(2, 1, 0), (3, 2, 0)])
    glb.header["nodes"][parent]["children"] = [0, 0]
    with pytest.raises(InputError, match="a tree of nodes, found node 0 in two places"):
        read(glb, tmp_path)


@pytest.mark.parametrize("required", [True, False])
def test_instances(tmp_path: Path, required: bool) -> None:
    glb = simple()
    places, sizes = np.array([(1, 0, 0), (0, 3, 0), (0, 0, 9)]), np.array([(1, 1, 1), (2, 2, 2), (-1, 1, 1)])
    turns = np.array([(0, 0, 0, 127), (0, 0, 127, 0), (0, 0, 0, 127)])
    attributes = {"TRANSLATION": glb.array(places), "ROTATION": glb.array(turns, "i1", normalized=True)}
    attributes["SCALE"] = glb.array(sizes)
    glb.header["nodes"][0] |= {"translation": [10, 0, 0]}
    glb.header["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    glb.header["extensionsRequired" if required else "extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    (mesh,) = read(glb, tmp_path)
    half_turn = np.array([(1, 1, 1), (-1, -1, 1), (1, 1, 1)])
    expected = [SQUARE * size * turn + place + (10, 0, 0) for size, turn, place in zip(sizes, half_turn, places)]
    np.testing.assert_allclose(mesh.vertices, np.concatenate(expected), atol=1e-5)
    np.testing.assert_array_equal(np.sign(mesh.face_normals[:, 2]), 1)


def test_texture_transforms(tmp_path: Path) -> None:
    """Scale, then rotation (u towards -v), then offset; the transform chooses the set of coordinates."""
    transform = {"offset": [0.3, -0.2], "rotation": 0.7, "scale": [2.0, 0.5], "texCoord": 1}
    glb = simple(info={"texCoord": 7, "extensions": {"KHR_texture_transform": transform}})
    other = np.random.default_rng(0).random((4, 2))
    glb.header["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_1"] = glb.array(other)
    u, v = 2.0 * other[:, 0], 0.5 * other[:, 1]
    cosine, sine = np.cos(0.7), np.sin(0.7)
    expected = np.stack([cosine * u + sine * v + 0.3, -sine * u + cosine * v - 0.2], axis=1)
    np.testing.assert_allclose(read(glb, tmp_path)[0].vertex_attributes[RAW_UV], expected, atol=1e-6)
    # the example in the extension's text: the lower left quadrant
    quarter = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    glb = simple(info={"extensions": {"KHR_texture_transform": quarter}})
    uv = read(glb, tmp_path)[0].vertex_attributes[RAW_UV]
    np.testing.assert_allclose([uv.min(axis=0), uv.max(axis=0)], [(0, 0.5), (0.5, 1)], atol=1e-6)


def wrapped(texel: np.ndarray, size: int, mode: int) -> np.ndarray:
    """The texel of an image for a texel index beyond its border."""
    if mode == CLAMP:
        return np.clip(texel, 0, size - 1)
    if mode == REPEAT:
        return texel % size
    return np.minimum(texel % (2 * size), 2 * size - 1 - texel % (2 * size))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from([CLAMP, REPEAT, MIRROR]),
    st.sampled_from([CLAMP, REPEAT, MIRROR]),
    st.tuples(st.floats(-5, 5, width=16), st.floats(-5, 5, width=16)),
    st.tuples(st.floats(-3, 3, width=16), st.floats(-3, 3, width=16)),
)
def test_wrap_modes(tmp_path: Path, across: int, down: int, corner: tuple, size: tuple) -> None:
    """Each point of a face has the instance of its sampler's nearest texel."""
    uv = np.array(corner) + UV * size
    scene = scene_of(simple(uv, {"wrapS": across, "wrapT": down}), tmp_path)
    weight = np.random.default_rng(0).dirichlet(np.ones(3), 500)
    for face in range(2):
        at = weight @ scene.face_uv[face].astype(float)
        image = scene.chart_instance[scene.face_chart[face]]
        found = image[texel_of_uv(at, image.shape)]
        texel = weight @ uv[[[0, 1, 2], [0, 2, 3]][face]] * (8, 6)
        clear = (np.abs(texel - np.rint(texel)) > 0.11).all(axis=1)
        column, row = (wrapped(np.floor(texel[:, k]).astype(int), n, m) for k, n, m in ((0, 8, across), (1, 6, down)))
        np.testing.assert_array_equal(found[clear], IDS[row, column][clear])


def test_a_file_without_sampler_repeats(tmp_path: Path) -> None:
    scene = scene_of(simple(UV + np.array([3, -2])), tmp_path)
    np.testing.assert_array_equal(scene.face_uv[0], UV[:3])
    np.testing.assert_array_equal(scene.chart_instance[0], IDS)


def test_too_many_repetitions_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"at most 32767 texels per side, found 8 repeated 5000 times"):
        scene_of(simple(UV * 5000), tmp_path)
    plain = encoded(np.full((6, 8, 3), COLORS[0]))
    scene = scene_of(simple(UV * 5000, image=plain), tmp_path)
    assert (scene.face_instance == 1).all()


def test_data_uris(tmp_path: Path) -> None:
    glb = simple()
    expected = read(glb, tmp_path)[0]
    data = "data:application/octet-stream;base64," + base64.b64encode(glb.binary).decode()
    glb.add("buffers", byteLength=len(glb.binary), uri=data)
    for view in glb.header["bufferViews"]:
        view["buffer"] = 1
    glb.header["images"][0] = {"uri": "data:image/png;base64," + base64.b64encode(grid()).decode()}
    (mesh,) = read(glb, tmp_path)
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    np.testing.assert_array_equal(rgba(mesh.visual.material.baseColorTexture)[..., :3], COLORS[IDS - 1])
    glb.header["images"][0]["uri"] = "texture.png"
    with pytest.raises(InputError, match=r"within the file or as data URI, found 'texture\.png'"):
        read(glb, tmp_path)


@pytest.mark.parametrize(
    "name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu", "ACME_new"]
)
def test_required_extensions_are_refused_by_name(tmp_path: Path, name: str) -> None:
    glb = simple()
    glb.header["extensionsUsed"] = [name]
    assert len(read(glb, tmp_path)) == 1
    glb.header["extensionsRequired"] = ["KHR_texture_transform", name]
    with pytest.raises(InputError, match=rf"a\.glb: expected no required extension but .*, found {name}$"):
        read(glb, tmp_path)


REFUSED = {
    "data that is not compressed, found none for accessor 0": lambda h: h["accessors"][0].pop("bufferView"),
    "a PNG or JPEG for texture 0, found KHR_texture_basisu": lambda h: h["textures"].__setitem__(
        0, {"extensions": {"KHR_texture_basisu": {"source": 0}}}
    ),
    "an index below 1 into meshes, found -1": lambda h: h["nodes"][0].update(mesh=-1),
    "rigid meshes, found a skin": lambda h: h["nodes"][0].update(skin=0),
    "rigid meshes, found a morph target": lambda h: h["meshes"][0].update(weights=[0.5]),
    "without TEXCOORD_3": lambda h: h["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"].update(texCoord=3),
    "wrap modes": lambda h: h["samplers"][0].update(wrapS=33069),
    "alpha mode": lambda h: h["materials"][0].update(alphaMode="GLASS"),
    "a mode from 0 to 6": lambda h: h["meshes"][0]["primitives"][0].update(mode=7),
    "triangles of three vertices, found 5": lambda h: h["accessors"][1].update(count=5),
}


@pytest.mark.parametrize("expected", REFUSED)
def test_refused_files(tmp_path: Path, expected: str) -> None:
    glb = simple(sampler={})
    primitive = glb.header["meshes"][0]["primitives"][0]
    order = [primitive["attributes"]["POSITION"], primitive["indices"], primitive["attributes"]["TEXCOORD_0"]]
    glb.header["accessors"] = [glb.header["accessors"][n] for n in order]
    primitive |= {"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1}
    REFUSED[expected](glb.header)
    with pytest.raises(InputError, match=expected):
        read(glb, tmp_path)


def test_lossy_annotations_are_refused(tmp_path: Path) -> None:
    """Colours of no row are unknown; on more than 5 % of the surface they are an error."""
    large = COLORS[IDS - 1].repeat(16, axis=0).repeat(16, axis=1)
    few, many = large.copy(), large.copy()
    rng = np.random.default_rng(0)
    for image, share in ((few, 0.02), (many, 0.12)):
        image[rng.random(image.shape[:2]) < share] ^= 1
    scene = scene_of(simple(image=encoded(few)), tmp_path)
    assert 0.01 < (scene.chart_instance[0] == 0).mean() < 0.03
    blurred = Image.fromarray(large).resize((24, 18), Image.Resampling.BICUBIC)
    for image in (encoded(large, "JPEG", quality=95), encoded(many), encoded(blurred)):
        with pytest.raises(InputError, match=r"found others on \d+% of the surface: the texture was compressed with"):
            scene_of(simple(image=image), tmp_path)
    with pytest.raises(InputError, match="or the list is another home's"):
        scene_of(simple(), tmp_path, '1,010203,"wall",0\n')
    black = encoded(np.zeros((6, 8, 3), np.uint8))  # "unknown", by the format
    assert not scene_of(simple(image=black), tmp_path).face_instance.any()


def test_images_of_every_mode(tmp_path: Path) -> None:
    """Grey of 16 bits is rounded to 8, not clipped; palettes and alpha keep their colours."""
    deep = np.array([[0, 20 * 257, 128 * 257 + 100, 65535]], np.uint16)
    with Image.open(io.BytesIO(encoded(deep))) as image:
        np.testing.assert_array_equal(rgba(image)[0, :, 0], [0, 20, 128, 255])
    palette = Image.fromarray(COLORS[IDS - 1]).quantize(8)
    glb = simple(image=encoded(palette))
    np.testing.assert_array_equal(scene_of(glb, tmp_path).chart_instance[0], IDS)
    clear = np.dstack([COLORS[IDS - 1], np.zeros(IDS.shape, np.uint8)])
    np.testing.assert_array_equal(scene_of(simple(image=encoded(clear)), tmp_path).chart_instance[0], IDS)
