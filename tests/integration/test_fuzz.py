"""For any file or argument a parser returns a result or raises `InputError`, within bounds of time and memory.

Some 13,400 inputs: valid ones with bytes flipped, cut short, or with a field of their JSON replaced, and ones that are
odd from the start. Every input has 20 s, and memory for 3 GiB more than the process has.
"""

import copy
import io
import json
import resource
import shutil
import signal
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import zerobev
from zerobev.common.errors import InputError
from zerobev.evaluation.metrics import Counts
from zerobev.experiments.run_records import RunRecord, RunStore
from zerobev.inference.image_view import MAX_IMAGES
from zerobev.scenes.hm3dsem import FIRST_LINE, read_instances, read_scene
from zerobev.scenes.hm3dsem_writer import write_scene

from support.glb import GlbFile, encoded
from support.records import run_record
from support.scenes import box, build, room

_SECONDS, _BYTES = 20, 3 << 30
#: Replacements of a JSON field.
ODD = [None, True, -1, 0, 1, 2, 3, 4, 5, 255, 65536, 2**31, 2**63, 10**30, 0.5, 1e308, float("nan"), float("inf")]
ODD += ["", "x", "SCALAR", "VEC2", "VEC4", "MAT4", 5120, 5121, 5122, 5123, 5125, 5126, [], [0], [[]], [None], {}]
ODD += [
    {"index": 0},
    {"a": None},
    [1e300] * 3,
    [0.0] * 16,
    list(range(40)),
    "data:application/octet-stream;base64,AAAA",
]


class Hang(BaseException):
    """An input took too long; no parser catches it."""


@pytest.fixture(autouse=True)
def bounded() -> Iterator[None]:
    """Limit time and memory during a test."""

    def stop(*_: object) -> None:
        raise Hang

    torch.set_num_threads(1)
    before, handler = resource.getrlimit(resource.RLIMIT_AS), signal.signal(signal.SIGALRM, stop)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _BYTES, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)
    signal.signal(signal.SIGALRM, handler)


def fuzz(make: Callable[[Random], Any], examples: int, parse: Callable[[Any], Any]) -> Counter[str]:
    """Numbers of inputs that were read, and refused in one line and not for lack of memory.

    Hypothesis draws the seed of an input alone: that is a hundred times faster than to draw every byte.
    """
    seen: Counter[str] = Counter()

    @settings(max_examples=examples)
    @given(st.integers(0, 2**32 - 1))
    def run(seed: int) -> None:
        value = make(Random(seed))
        signal.setitimer(signal.ITIMER_REAL, _SECONDS)
        try:
            parse(value)
            seen["read"] += 1
        except InputError as error:
            cause: BaseException | None = error
            while cause is not None:
                assert not isinstance(cause, MemoryError)
                cause = cause.__cause__ or cause.__context__
            assert str(error) and "\n" not in str(error)
            seen["refused"] += 1
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)

    run()
    return seen


# --- damage to inputs -----------------------------------------------------------------------------------------------


def flipped(rng: Random, content: bytes, among: int | None = None) -> bytes:
    """Up to four bytes replaced, of the first `among` or of all."""
    changed = bytearray(content)
    for _ in range(rng.randint(1, 4)):
        changed[rng.randrange(min(among or len(content), len(content)))] = rng.choice((0, 255, rng.randrange(256)))
    return bytes(changed)


def cut(rng: Random, content: bytes) -> bytes:
    return content[: rng.randrange(len(content))]


def paths(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """The paths of all fields of a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, entry in items:
        yield (*path, name)
        yield from paths(entry, (*path, name))


def edited(rng: Random, value: Any) -> Any:
    """JSON with one or two fields replaced or removed."""
    value = copy.deepcopy(value)
    for _ in range(rng.randint(1, 2)):
        *path, name = rng.choice(list(paths(value)) or [(None,)])
        parent = value
        for step in path:
            parent = parent[step]
        if name is None:
            return None
        if rng.random() < 0.2:
            del parent[name]
        else:
            parent[name] = copy.deepcopy(rng.choice(ODD))
    return value


def any_json(rng: Random, depth: int = 3) -> Any:
    kind = rng.randrange(3 if depth else 1)
    if kind == 0:
        return copy.deepcopy(rng.choice(ODD))
    parts = [any_json(rng, depth - 1) for _ in range(rng.randrange(4))]
    return parts if kind == 1 else {rng.choice(("intersection", "union", "key", "")): part for part in parts}


def any_text(rng: Random, most: int) -> str:
    letters = 'abc019,"\\-\n\r\t\0 \u2028\ufeff\ud7ff\U0001f600é#{}[]'
    return "".join(rng.choice(letters) for _ in range(rng.randint(0, most)))


# --- scenes --------------------------------------------------------------------------------------------------------


def any_list(rng: Random) -> bytes:
    """A list of instances with mostly valid parts."""

    def odd(good: str, most: int = 8) -> str:
        return any_text(rng, most) if rng.random() < 0.1 else good

    first = odd(FIRST_LINE, 30)
    rows = []
    for _ in range(rng.randrange(4)):
        number, color, region = rng.randint(0, 70000), rng.randrange(1 << 24), rng.randint(-2, 99)
        name = rng.choice(("wall", "tv", 'a "b", c', "", any_text(rng, 6)))
        rows.append(f'{odd(str(number))},{odd(f"{color:06X}")},"{name}",{odd(str(region))}')
    content = "\n".join((first, *rows)).encode() or b"\n"
    return rng.choice((content, content, content, flipped(rng, content), rng.randbytes(rng.randrange(60))))


def test_lists_of_instances(tmp_path: Path) -> None:
    path = tmp_path / "a.semantic.txt"

    def parse(content: bytes) -> None:
        path.write_bytes(content)
        found, _ = read_instances(path)
        assert [i.id for i in found] == sorted({i.id for i in found})
        assert len({i.color for i in found} - {(0, 0, 0)}) == len(found)

    seen = fuzz(any_list, 3000, parse)
    assert min(seen["read"], seen["refused"]) > 300


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("home") / "00001-AAAAAAAAAAA"
    write_scene(folder, build([*room((1, 1, 1)), box("bed", (0.2, 0.2, 0), (0.6, 0.6, 0.3))]))
    return folder


NAMES = ("AAAAAAAAAAA.glb", "AAAAAAAAAAA.semantic.glb")


@contextmanager
def changed(folder: Path, name: str) -> Iterator[tuple[bytes, Callable[[bytes], None]]]:
    """A file of a scene, and a function that reads the scene with other bytes in that file."""
    whole = (folder / name).read_bytes()

    def parse(content: bytes) -> None:
        (folder / name).write_bytes(content)
        scene = read_scene(folder)
        assert scene.faces.min() >= 0 and scene.faces.max() < len(scene.vertices)
        assert np.isfinite(scene.vertices).all() and scene.face_uv.shape == (len(scene.faces), 3, 2)
        assert len(scene.face_instance) == len(scene.faces)

    try:
        yield whole, parse
    finally:
        (folder / name).write_bytes(whole)


def with_header(whole: bytes, edit: Callable[[dict], Any]) -> bytes:
    """A GLB file with another header."""
    size = struct.unpack_from("<I", whole, 12)[0]
    text = json.dumps(edit(json.loads(whole[20 : 20 + size]))).encode()
    text += b" " * (-len(text) % 4)
    length = 20 + len(text) + len(whole) - 20 - size
    return struct.pack("<4sIIII", b"glTF", 2, length, len(text), 0x4E4F534A) + text + whole[20 + size :]


@pytest.mark.parametrize("name", NAMES)
def test_bytes_of_glb_files(home: Path, name: str) -> None:
    def make(rng: Random, whole: bytes) -> bytes:
        # the first bytes hold lengths and the header, the most sensitive part
        return rng.choice((flipped(rng, whole), flipped(rng, whole, 4000), cut(rng, whole), rng.randbytes(40)))

    with changed(home, name) as (whole, parse):
        seen = fuzz(lambda rng: make(rng, whole), 400, parse)
    assert seen["read"] > 20 and seen["refused"] > 100


@pytest.mark.parametrize("name", NAMES)
def test_headers_of_glb_files(home: Path, name: str) -> None:
    with changed(home, name) as (whole, parse):
        seen = fuzz(lambda rng: with_header(whole, lambda header: edited(rng, header)), 800, parse)
    assert min(seen["read"], seen["refused"]) > 80


@pytest.fixture(scope="module")
def rich_home(home: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with all supported features of glTF, among them a repeated texture and glass."""
    folder = tmp_path_factory.mktemp("rich") / home.name
    shutil.copytree(home, folder)
    color = [int(pair, 16) for pair in ("5D", "7F", "33")]
    (folder / NAMES[1].replace(".glb", ".txt")).write_text(f'{FIRST_LINE}\n1,5D7F33,"wall",0\n')
    image = encoded(np.tile(np.uint8([*color, 90]), (4, 4, 1)))
    square, uv = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]), np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    for name in NAMES:
        glb = GlbFile()
        transform = {"KHR_texture_transform": {"offset": [0.5, 2], "rotation": 0.3, "scale": [3, 2], "texCoord": 1}}
        material = glb.material(image, {"wrapS": 33648, "wrapT": 10497}, info={"extensions": transform})
        masked = glb.material(image, factor=[1, 0.5, 1, 0.9], alphaMode="MASK", alphaCutoff=0.2)
        glass = glb.material(image, alphaMode="BLEND")
        sets = {"TEXCOORD_1": glb.array(uv * 255, "u1", normalized=True)}
        wall = glb.quad(square, uv, material, COLOR_0=glb.array(uv.repeat(2, axis=1) * 65535, "u2"), **sets)
        sparse = {"count": 1, "indices": {"bufferView": glb.view(b"\1"), "componentType": 5121}}
        sparse["values"] = {"bufferView": glb.view(np.float32([1, 0, 0]).tobytes())}
        glb.header["accessors"][wall["attributes"]["POSITION"]]["sparse"] = sparse
        instances = {"TRANSLATION": glb.array([(0, 0, 1), (0, 0, 2)]), "SCALE": glb.array([(1, 1, 1), (-1, 1, 1)])}
        instances["ROTATION"] = glb.array([(0, 0, 0, 127)] * 2, "i1", normalized=True)
        glb.place(wall, extensions={"EXT_mesh_gpu_instancing": {"attributes": instances}})
        strip = glb.quad(square, uv, masked) | {"mode": 5}
        glb.place(strip, matrix=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 2, 0, 0, 1])
        glb.place(glb.quad(square, uv, glass) | {"mode": 6}, rotation=[0, 0, 0, 1], scale=[1, 1, 2])
        glb.header["extensionsRequired"] = ["EXT_mesh_gpu_instancing", "KHR_texture_transform"]
        glb.save(folder / name)
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_all_supported_features_of_gltf(rich_home: Path, name: str) -> None:
    """Accessors, samplers, materials, instances and nodes with odd fields: read, or refused in one line."""
    with changed(rich_home, name) as (whole, parse):
        parse(whole)
        seen = fuzz(lambda rng: with_header(whole, lambda header: edited(rng, header)), 400, parse)
    assert min(seen["read"], seen["refused"]) > 20


IMPOSSIBLE = {
    "a node that is its own child": lambda h: h["nodes"][0].update(children=[0]),
    "two nodes that are each other's": lambda h: [h["nodes"][i].update(children=[1 - i]) for i in (0, 1)],
    "zeros for positions": lambda h: h["accessors"].__setitem__(
        0, {"count": 10**9, "componentType": 5126, "type": "VEC3"}
    ),
    "sparse zeros": lambda h: h["accessors"].__setitem__(
        0, {"count": 10**9, "componentType": 5126, "type": "VEC3", "sparse": {"count": 0, "indices": {}, "values": {}}}
    ),
    "overlapping rows": lambda h: h["bufferViews"][0].update(byteStride=1) or h["accessors"][0].update(count=10**9),
    "rows far apart": lambda h: h["bufferViews"][0].update(byteStride=2**62),
    "faces below zero": lambda h: (
        h["accessors"].append({**h["accessors"][0], "componentType": 5122})
        or h["meshes"][0]["primitives"][0].update(indices=len(h["accessors"]) - 1)
    ),
    "UV of three coordinates": lambda h: h["meshes"][0]["primitives"][0]["attributes"].update(TEXCOORD_0=0),
    "positions of two": lambda h: h["meshes"][0]["primitives"][0]["attributes"].update(POSITION=1),
    "an image that is none": lambda h: h["images"][0].update(bufferView=0),
}


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_headers_with_impossible_values(home: Path, what: str) -> None:
    def edit(header: dict) -> dict:
        IMPOSSIBLE[what](header)
        return header

    with changed(home, NAMES[1]) as (whole, parse):
        seen = fuzz(lambda _: with_header(whole, edit), 1, parse)
    assert seen["refused"] == 1


def test_textures_that_no_reader_should_open(home: Path) -> None:
    """PostScript, which is a program, and sides beyond the type of texel indices."""

    def file(image: Image.Image, kind: str) -> bytes:
        stream = io.BytesIO()
        image.save(stream, kind)
        return stream.getvalue()

    with changed(home, NAMES[1]) as (whole, parse):
        for content in (file(Image.new("RGB", (4, 4)), "EPS"), file(Image.new("RGB", (40000, 1)), "PNG")):
            size, binary = struct.unpack_from("<I", whole, 12)[0], len(whole) - 28

            def edit(header: dict, at: int = binary - size, content: bytes = content) -> dict:
                view = {"buffer": 0, "byteOffset": at, "byteLength": len(content)}
                header["bufferViews"].append(view)
                for image in header["images"]:
                    image["bufferView"] = len(header["bufferViews"]) - 1
                header["buffers"][0]["byteLength"] = at + len(content)
                return header

            longer = bytearray(whole + content)
            struct.pack_into("<I", longer, 20 + size, binary - size + len(content))
            seen = fuzz(lambda _, longer=bytes(longer), edit=edit: with_header(longer, edit), 1, parse)
            assert seen["refused"] == 1


# --- records -------------------------------------------------------------------------------------------------------


def record() -> RunRecord:
    counts = Counts(np.arange(16).reshape(2, 8), np.full((2, 8), 20))
    config = {"train": {"steps": 3}, "bands": [0.0, 0.8]}
    parts = {"origin": {"revision": "a"}, "cost": {"train_seconds": 1.5}, "history": {"loss": [0.5]}}
    return run_record("c-0", counts, config=config, **parts)


def test_records(tmp_path: Path) -> None:
    store = RunStore(tmp_path)
    store.write(record(), np.ones((2, 8, 5, 5), bool))
    path = store.path("c-0")
    whole = path.read_bytes()
    value = json.loads(whole)
    deep = (b"[" * 100_000, b'{"a":' * 100_000, b"1" * 10_000, b'"\\ud800"', b"\xff\xfe", b"")

    def make(rng: Random) -> bytes:
        kind = rng.randrange(20)
        if kind < 8:
            return json.dumps(edited(rng, value)).encode()
        if kind < 14:
            return flipped(rng, whole)
        return json.dumps(any_json(rng)).encode() if kind < 18 else rng.choice((*deep, cut(rng, whole)))

    def parse(content: bytes) -> None:
        path.write_bytes(content)
        found = store.find("c-0")
        assert len(found.scenes) == len(found.counts.union)
        assert not store.is_sealed("c-0") or found == record()

    seen = fuzz(make, 2000, parse)
    assert min(seen["read"], seen["refused"]) > 100
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match=r"c-0\.json: expected a record, found .*directory"):
        store.find("c-0")


def test_counts() -> None:
    def make(rng: Random) -> Any:
        shape = range(rng.randrange(1, 4))
        rows = [[rng.randrange(9) for _ in shape] for _ in shape]
        valid = {"intersection": rows, "union": [[cells + 1 for cells in row] for row in rows]}
        return rng.choice((valid, edited(rng, valid), edited(rng, valid), any_json(rng)))

    seen = fuzz(make, 2000, lambda value: Counts.from_json(value).to_json())
    assert min(seen["read"], seen["refused"]) > 300


_TYPES = ["bool", "u1", "i1", "i2", "u2", "i4", "i8", "u8", "f2", "f4", "f8", ">f4", ">i2", "g", "c8", "U2", "S1"]
_TYPES += ["O", "M8[s]", "m8[s]", [("a", "f4")]]
_SHAPES = [(), (0,), (3,), (8, 9), (6, 8), (2, 8, 8), (0, 8, 8), (8, 8, 2), (8, 8, 3), (8, 8, 4), (8, 0, 3), (1, 1, 3)]
_SHAPES += [(1, 1), (3, 8, 8, 1), (1, 200, 3), (200, 1, 3), (9, 1, 1), (1, 8, 8), (8, 8), (8, 8)]
_FILLS = [0, 1, 0.5, -1, 2, 255, 1e-30, 1e30, float("nan"), float("inf"), -float("inf")]


def odd_array(rng: Random) -> np.ndarray:
    """An array of any type and of few shapes, with values of all magnitudes."""
    with np.errstate(all="ignore"):
        array = np.zeros(rng.choice(_SHAPES), rng.choice(_TYPES))
        if array.dtype.kind in "biufcg" and array.size:
            array[...] = np.asarray(rng.choice(_FILLS[: rng.choice((2, 11))])).astype(array.dtype)
            array.reshape(-1)[: array.size // 2] = np.asarray(rng.choice(_FILLS[: rng.choice((2, 11))])).astype(
                array.dtype
            )
    return array


def test_maps(tmp_path: Path) -> None:
    store = RunStore(tmp_path)
    store.write(record(), np.ones((2, 8, 5, 5), bool))
    path = tmp_path / "gallery/c-0.npz"
    whole = path.read_bytes()

    def make(rng: Random) -> bytes:
        kind, stream = rng.randrange(5), io.BytesIO()
        if kind < 2:
            return flipped(rng, whole)
        if kind == 2:
            np.save(stream, odd_array(rng))
        else:
            maps = rng.choice((np.full((2, 8, 5, 1), 7, np.uint8), odd_array(rng)))
            np.savez(stream, maps=maps, cells=rng.choice((5, -5, 8, 10**12, 2**62, 0.5, odd_array(rng))))
        return rng.choice((stream.getvalue(), stream.getvalue(), cut(rng, whole)))

    def parse(content: bytes) -> None:
        path.write_bytes(content)
        assert store.maps("c-0").dtype == bool

    seen = fuzz(make, 1200, parse)
    assert seen["read"] > 30 and seen["refused"] > 500


# --- project() -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def projector() -> zerobev.Projector:
    return zerobev.load("c")


_RGB = np.random.default_rng(0).integers(0, 255, (8, 8, 3), np.uint8)
_MASKS = np.zeros((2, 8, 8), bool)
_MASKS[0, 4:] = True
_NOTHING = [None, 0, "x", [[1], [1, 2]], {}, object(), 1 + 2j, b"", [[[10**400]]], np.ma.masked, Image]
_ANGLES = [79.0, 40, np.float32(66), np.int64(90), 1e-320, 179.9999999, 180, 0, -1, float("nan"), float("inf"), True]
_NAMES = [["a"], ["a", "b"], {0: "a", 1: "b"}, "ab", {}, {1}, 7, (None, None), [[], {}], np.ones(2)]


def numbers(rng: Random, columns: int) -> Any:
    """Points or boxes, including invalid ones."""
    if rng.random() < 0.1:
        return rng.choice(_NOTHING)
    rows = range(rng.randrange(1, 4))
    return [sorted(rng.choice((rng.uniform(-9, 20), rng.choice(_FILLS))) for _ in range(columns)) for _ in rows]


def any_modality(rng: Random) -> Any:
    kind = rng.randrange(8)
    if kind < 3:
        return odd_array(rng)
    if kind == 3:
        return rng.choice((_MASKS, _MASKS[0]))
    if kind == 4:
        return rng.choice(_NOTHING)
    if kind < 7:
        corners = numbers(rng, 4)
        count = len(corners) if isinstance(corners, list) else 1
        labels, scores = rng.choice((["a"] * count, rng.choice(_NOTHING))), rng.choice(([0.5] * count, [2], [None]))
        return lambda: zerobev.Boxes(corners, labels, scores)
    return lambda: zerobev.Flow(numbers(rng, 2), numbers(rng, 2), rng.choice((None, _RGB, odd_array(rng))))


def test_arguments_of_project(projector: zerobev.Projector) -> None:
    def make(rng: Random) -> tuple:
        rgb = _RGB if rng.random() < 0.7 else rng.choice((odd_array(rng), rng.choice(_NOTHING)))
        angle = 79 if rng.random() < 0.5 else rng.choice((*_ANGLES, *_NOTHING))
        depth = None if rng.random() < 0.5 else rng.choice((odd_array(rng), rng.choice(_NOTHING), np.ones((8, 8))))
        return rgb, any_modality(rng), angle, depth, rng.choice((None, rng.choice(_NAMES)))

    def parse(arguments: tuple) -> None:
        rgb, modality, angle, depth, names = arguments
        camera = angle if isinstance(angle, list) else zerobev.Camera(hfov_deg=angle, pitch_deg=len(str(angle)))
        maps = projector.project(rgb, modality() if callable(modality) else modality, camera, depth, names)
        for bev in (maps.starts, maps.ends) if isinstance(maps, zerobev.BevArrows) else (maps,):
            assert np.isfinite(bev.values).all() and bev.values.min() >= 0 and bev.values.max() <= 1
            assert len(bev.values) == len(bev.labels)

    seen = fuzz(make, 2000, parse)
    assert seen["read"] > 50 and seen["refused"] > 1000


def test_valid_arguments_of_project_are_accepted(projector: zerobev.Projector) -> None:
    images = [_RGB, _RGB / 255, (_RGB / 255).astype(np.float16), (_RGB / 255).tolist(), np.asfortranarray(_RGB)]
    modalities = [_MASKS, _MASKS[0], _MASKS[0] + 1, _MASKS * 0.5, _MASKS.astype(">f4"), _MASKS[0].tolist()]
    modalities += [zerobev.Boxes([[0, 0, 1e300, 4]], ["a"], [1]), zerobev.Flow([[1, 1]], [[1e300, 2]])]
    for image, modality in zip(images * 2, modalities):
        projector.project(image, modality, zerobev.Camera(np.float32(66)))
    (wide,) = zerobev.Boxes([[0, 0, 1e300, 4]], ["a"], [1]).layers((8, 8))[0].images
    assert wide[:4].all() and not wide[4:].any()  # a box that ends far outside covers all up to the border


def test_too_many_images_are_refused(projector: zerobev.Projector) -> None:
    dot = np.ones((1, 1, 3), np.uint8)
    with pytest.raises(InputError, match=f"expected {MAX_IMAGES} binary images at most, found {MAX_IMAGES + 1}"):
        projector.project(dot, np.ones((MAX_IMAGES + 1, 1, 1), bool))
    with pytest.raises(InputError, match="binary images at most"):
        projector.project(dot, np.ones((10**6, 1, 1), np.float32))
    with pytest.raises(InputError, match=r"after: expected the first frame's shape \(8, 8, 3\), found \(9, 8, 3\)"):
        projector.project(_RGB, zerobev.Flow([[1, 1]], [[2, 2]], np.zeros((9, 8, 3))))
