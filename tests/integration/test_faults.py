"""Kills, full disks and homes that are none: what was whole stays whole, and the next call makes up for the rest."""

import contextlib
import faulthandler
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from zerobev import cli
from zerobev.common.errors import InputError
from zerobev.common.locks import locked
from zerobev.common.storage import write_json
from zerobev.config import SCALES, AgentConfig, CameraConfig, TextureConfig, TrainConfig
from zerobev.data import generate as generation
from zerobev.data.generate import generate, verify
from zerobev.data.shards import write_shard
from zerobev.data.textures import TextureBank
from zerobev.data.views import View, ViewSource
from zerobev.evaluation import real_homes
from zerobev.evaluation.metrics import Counts
from zerobev.experiments.run_records import RunStore
from zerobev.models import build as build_network
from zerobev.rendering.poses import navigable_floor
from zerobev.scenes.hm3dsem import read_scene
from zerobev.scenes.hm3dsem_writer import write_scene
from zerobev.scenes.scene import Scene
from zerobev.training.losses import Losses
from zerobev.training.train import train

from support.records import run_record
from support.scenes import box, build, furnished, room

CAMERA, TEXTURE = CameraConfig(fpv_px=16, bev_px=10), TextureConfig(tiles=2)
NOISE = np.random.default_rng(0).random((2, 128, 128))


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)  # a fork has no others


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build(furnished())


@pytest.fixture(scope="module")
def views(scene: Scene) -> list[View]:
    source = ViewSource(scene, CAMERA, TEXTURE, np.random.default_rng(0))
    return [source.draw() for _ in range(4)]


def _record(folder: Path, version: int, *_: object) -> None:
    counts = Counts(np.full((500, 8), version), np.full((500, 8), 9))
    RunStore(folder).write(run_record("c-0", counts), np.random.default_rng(version).random((9, 8, 40, 40)) < 0.5)


def _home(folder: Path, version: int, scene: Scene, _: list[View]) -> None:
    write_scene(folder / "00001-AAAAAAAAAAA", replace(scene, vertices=scene.vertices + version))


def _shard(folder: Path, version: int, scene: Scene, views: list[View]) -> None:
    write_shard(folder / "a.h5", scene, views[version:], CAMERA, TEXTURE, version)


def _bank(folder: Path, version: int, *_: object) -> None:
    TextureBank(0.5 + 0.1 * version < NOISE, TEXTURE).save(folder / "bank.npz")


def _network(folder: Path, version: int, *_: object) -> None:
    torch.manual_seed(version)
    build_network("c", SCALES["smoke"].camera, SCALES["smoke"].model).save(folder / "model.safetensors")


def _json(folder: Path, version: int, *_: object) -> None:
    write_json(folder / "a.json", {str(i): version for i in range(3000)})


#: Everything that is written and kept, in its version 0 or 1.
WRITERS: dict[str, Callable[..., None]] = {
    "record": _record,
    "home": _home,
    "shard": _shard,
    "textures": _bank,
    "network": _network,
    "JSON": _json,
}
#: How a process may end that could not write. HDF5 crashes one that goes on without having closed its file, one way or
#: another: which one depends on what lies in memory.
CRASHES = (-signal.SIGSEGV, -signal.SIGBUS, -signal.SIGABRT)
FAILED = {name: (1, *CRASHES) if name == "shard" else (1,) for name in WRITERS}


def contents(folder: Path) -> dict[str, bytes]:
    """What a reader finds: all files but those under a temporary name."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    named = {path.relative_to(folder).as_posix(): path for path in files}
    return {name: path.read_bytes() for name, path in named.items() if not name.startswith(".") and "/." not in name}


def in_a_child(work: Callable[[], None]) -> int:
    """How a process ends that does `work`: 0, 1 for an error, or the signal that killed it, below zero."""
    child = os.fork()
    if child == 0:
        code = 1
        with contextlib.suppress(BaseException):
            faulthandler.disable()
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            work()
            code = 0
        os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def limited(work: Callable[[], None], size: int, action: signal.Handlers) -> Callable[[], None]:
    """`work` that is killed, or gets an error, at byte number `size` of any file."""

    def bounded() -> None:
        signal.signal(signal.SIGXFSZ, action)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        work()

    return bounded


@pytest.mark.parametrize("name", WRITERS)
def test_killed_in_the_middle_of_a_file(name: str, scene: Scene, views: list[View], tmp_path: Path) -> None:
    """As by SIGKILL, at a given byte: nothing can be cleaned up."""
    write, old, new = WRITERS[name], tmp_path / "old", tmp_path / "new"
    write(old, 0, scene, views)
    write(new, 1, scene, views)
    versions = contents(old), contents(new)
    assert versions[0] != versions[1]
    sizes = [len(content) for content in versions[1].values()]
    for size in (min(sizes) // 2, max(sizes) // 2, max(sizes) - 1):
        ended = in_a_child(limited(lambda: write(old, 1, scene, views), size, signal.SIG_DFL))
        assert ended == -signal.SIGXFSZ
        found = contents(old)
        if name == "record":  # two files: the maps come first, and the record that says that they are there last
            assert found["records/c-0.json"] == versions[0]["records/c-0.json"]
        else:
            assert found == versions[0]
    write(old, 1, scene, views)
    assert contents(old) == versions[1]


def test_killed_between_two_names(scene: Scene, tmp_path: Path) -> None:
    """A home is replaced in two steps: after a kill between them it is missing, and is made again."""

    def die(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    _home(tmp_path, 0, scene, [])

    def work() -> None:
        rename = Path.rename
        Path.rename = lambda path, to: die() if path.suffix == ".part" else rename(path, to)
        _home(tmp_path, 1, scene, [])

    assert in_a_child(work) == -signal.SIGKILL
    assert contents(tmp_path) == {}
    _home(tmp_path, 1, scene, [])
    assert read_scene(tmp_path / "00001-AAAAAAAAAAA").vertices.min() == 1


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_may_not_grow(name: str, scene: Scene, views: list[View], tmp_path: Path) -> None:
    write = WRITERS[name]
    write(tmp_path, 0, scene, views)
    before = contents(tmp_path)
    size = min(map(len, before.values())) // 2
    assert in_a_child(limited(lambda: write(tmp_path, 1, scene, views), size, signal.SIG_IGN)) in FAILED[name]
    assert contents(tmp_path) == before
    assert not list(tmp_path.rglob(".*"))  # the half of it is gone, too


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 16 MB; mounting one takes root."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(folder)]
    mounted = sys.platform == "linux" and subprocess.run(command, capture_output=True, check=False).returncode == 0
    if not mounted:
        pytest.skip("no disk of 4 MB can be mounted here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk(name: str, scene: Scene, views: list[View], small_disk: Path) -> None:
    write, folder = WRITERS[name], small_disk / "files"
    write(folder, 0, scene, views)
    before = contents(folder)
    with (small_disk / "filler").open("wb", buffering=0) as filler, contextlib.suppress(OSError):
        while filler.write(bytes(4096)):
            pass
    assert in_a_child(lambda: write(folder, 1, scene, views)) == 1
    assert contents(folder) == before and not list(folder.rglob(".*"))
    (small_disk / "filler").unlink()
    write(folder, 1, scene, views)
    assert contents(folder).keys() == before.keys() and contents(folder) != before


def test_training_goes_on_after_a_full_disk(tmp_path: Path) -> None:
    class Samples:
        def batch(self, step: int, rank: int = 0, ranks: int = 1) -> dict[str, Tensor]:
            return {"x": torch.full((4, 50), float(step))}

    def objective(model: nn.Module, batch: dict[str, Tensor]) -> Losses:
        loss = model(batch["x"]).square().mean()
        return Losses(loss, loss, None)

    def run(folder: Path) -> None:
        config = TrainConfig(steps=6, learning_rate=1e-3, decay_every=3, validate_every=2, batch=4)
        torch.manual_seed(0)
        train(
            nn.Linear(50, 50),
            Samples(),
            [Samples().batch(0)],
            config,
            folder,
            0,
            key="k",
            objective=objective,
            device="cpu",
        )

    run(tmp_path / "whole")
    assert in_a_child(limited(lambda: run(tmp_path / "part"), 5000, signal.SIG_IGN)) == 1
    assert not list((tmp_path / "part").glob("*checkpoint*"))
    run(tmp_path / "part")
    weights = [(tmp_path / name / "best.safetensors").read_bytes() for name in ("whole", "part")]
    assert weights[0] == weights[1]


def test_a_process_that_is_killed_frees_its_folder(tmp_path: Path) -> None:
    def work() -> None:
        with locked(tmp_path, "work"):
            os.kill(os.getpid(), signal.SIGKILL)

    assert in_a_child(work) == -signal.SIGKILL
    with (
        locked(tmp_path, "work"),
        pytest.raises(InputError, match="no other work, found one"),
        locked(tmp_path, "work"),
    ):
        pass


# --- homes ---------------------------------------------------------------------------------------------------------


def _flattened(scene: Scene) -> Scene:
    """All triangles are points."""
    return replace(scene, vertices=np.zeros_like(scene.vertices))


def _with_nan(scene: Scene) -> Scene:
    vertices = scene.vertices.copy()
    vertices[3, 1] = np.nan
    return replace(scene, vertices=vertices)


def _times(scene: Scene, factor: float) -> Scene:
    photograph = scene.photograph.copy()
    photograph.apply_scale(factor)
    return replace(scene, vertices=scene.vertices * np.float32(factor), photograph=photograph)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def _spoil_images(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"IDAT", b"IDAt"))


def test_homes_that_are_none_are_skipped_and_named(tmp_path: Path) -> None:
    good = build(furnished())
    homes = {
        "00001-Good": (good, None, ""),
        "00002-NoFloor": (build([box("bed", (0, 0, 0), (2, 2, 0.5))]), None, "class floor, found none"),
        "00003-Flat": (_flattened(good), None, "class floor, found none"),
        "00004-NaN": (_with_nan(good), None, r"semantic\.glb: expected finite vertices"),
        "00005-Tiny": (build(room((0.4, 0.4, 2.5))), None, "of free floor, found none"),
        "00009-Cm": (_times(good, 100), None, "expected a home in metres, .* likely in centimetres"),
        "00006-Cut": (good, ("Cut.glb", _cut), r"Cut\.glb: expected \d+ bytes"),
        "00007-Image": (good, ("Image.semantic.glb", _spoil_images), r"semantic\.glb: expected a readable PNG"),
        "00008-Gone": (good, ("Gone.semantic.txt", Path.unlink), r"semantic\.txt: .*No such file"),
    }
    for name, (scene, damage, _) in homes.items():
        write_scene(tmp_path / name, scene)
        if damage:
            damage[1](tmp_path / name / damage[0])
    out = tmp_path / "out"
    problems = generate([tmp_path / name for name in homes], out, 1, CAMERA, TEXTURE, 0)
    assert list(problems) == list(homes)[1:]
    for name, message in problems.items():
        with pytest.raises(InputError, match=homes[name][2]):
            raise InputError(message)
        assert "\n" not in message
    assert list(json.loads((out / "manifest.json").read_text())["shards"]) == ["00001-Good.h5"]
    assert verify(out) == [] and [path.name for path in out.glob("*.h5")] == ["00001-Good.h5"]


@pytest.mark.parametrize("error", [IndexError("index 9"), MemoryError("10 GiB")])
def test_any_failure_of_a_home_is_its_own(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def read(folder: Path) -> Scene:
        if folder.name == "00002-Bad":
            raise error
        return read_scene(folder)

    for name in ("train/00001-Good", "train/00002-Bad", "minival/00800-Good", "val/00901-Good"):
        write_scene(tmp_path / "homes" / name, build(furnished()))
    cause = f"00002-Bad: {type(error).__name__}: {error}"
    monkeypatch.setattr(generation, "read_scene", read)
    monkeypatch.setattr(real_homes, "read_scene", read)
    commands = {
        "generate": ["--scale", "smoke", "--views", "1", "--out", str(tmp_path / "out")],
        "evaluate": ["--views", "1", "--json", str(tmp_path / "found.json")],
    }
    for command, options in commands.items():
        with pytest.raises(SystemExit) as ended:
            cli.main([command, "--scenes", str(tmp_path / "homes"), *options])
        assert ended.value.code == f"skipped {cause}"
    assert {path.name for path in tmp_path.glob("out/*/*.h5")} == {f"{n}-Good.h5" for n in ("00001", "00800", "00901")}
    assert json.loads((tmp_path / "found.json").read_text())["scenes"] == ["00001-Good", "00800-Good", "00901-Good"]
    assert "3 homes, 1 views each" in capsys.readouterr().out


def test_triangles_without_area_change_nothing(scene: Scene) -> None:
    """Scans are full of them."""
    count = len(scene.faces)
    faces = np.concatenate([scene.faces, scene.faces[:, [0, 0, 1]]])
    more = replace(
        scene,
        faces=faces,
        face_uv=np.concatenate([scene.face_uv] * 2),
        face_chart=np.concatenate([scene.face_chart] * 2),
    )
    assert len(more.face_instance) == 2 * count
    cells = [navigable_floor(one, AgentConfig(), np.random.default_rng(0)).cells for one in (scene, more)]
    assert np.array_equal(*cells) and len(cells[0]) > 100
    drawn = [ViewSource(one, CAMERA, TEXTURE, np.random.default_rng(1)).draw() for one in (scene, more)]
    assert np.array_equal(drawn[0].depth, drawn[1].depth) and np.array_equal(
        drawn[0].bev_instance, drawn[1].bev_instance
    )
