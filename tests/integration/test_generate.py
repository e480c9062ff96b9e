"""Generation: the same bytes for any workers, no repeated work, and detection of damage."""

import gc
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from dask.distributed import LocalCluster

from zerobev import cli
from zerobev.common.errors import InputError
from zerobev.config import CameraConfig, TextureConfig, scale
from zerobev.data import generate as generation
from zerobev.data.generate import generate, shard_path, verify
from zerobev.data.shards import Shard, checksum
from zerobev.data.views import ViewSource
from zerobev.scenes.hm3dsem import read_scene
from zerobev.scenes.hm3dsem_writer import write_scene

from support.paths import ROOT
from support.scenes import build, furnished, room

CAMERA = CameraConfig(fpv_px=16, bev_px=10)
TEXTURE = TextureConfig()
SEED, VIEWS = 5, 3


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> list[Path]:
    """Two scenes in HM3DSem layout."""
    root = tmp_path_factory.mktemp("scenes")
    found = [root / "00001-AAAAAAAAAAA", root / "00002-BBBBBBBBBBB"]
    write_scene(found[0], build(furnished()))
    write_scene(found[1], build(room((6, 4, 2.5))))
    return found


@pytest.fixture(scope="module")
def recorded(folders, tmp_path_factory) -> Path:
    """The shards of both scenes, recorded in one process."""
    out = tmp_path_factory.mktemp("recorded")
    assert generate(folders, out, VIEWS, CAMERA, TEXTURE, SEED) == {}
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_contents_of_the_manifest(recorded):
    manifest = json.loads((recorded / "manifest.json").read_text())
    names = ["00001-AAAAAAAAAAA.h5", "00002-BBBBBBBBBBB.h5"]
    assert {name: entry["sha256"] for name, entry in manifest.pop("shards").items()} == {
        name: checksum(recorded / name) for name in names
    }
    assert manifest == {"camera": asdict(CAMERA), "modsem_share": 0.3, "seed": SEED, "views": VIEWS}
    assert [len(Shard(recorded / name, CAMERA, TEXTURE)) for name in names] == [VIEWS, VIEWS]
    assert sorted(contents(recorded)) == [*names, "manifest.json"]


def test_seed_of_a_scene_is_in_the_manifest(folders, recorded):
    entry = json.loads((recorded / "manifest.json").read_text())["shards"]["00002-BBBBBBBBBBB.h5"]
    source = ViewSource(read_scene(folders[1]), CAMERA, TEXTURE, np.random.default_rng(entry["seed"]))
    shard = Shard(recorded / "00002-BBBBBBBBBBB.h5", CAMERA, TEXTURE)
    assert all(np.array_equal(source.draw().pose, shard.view(index).pose) for index in range(VIEWS))


def test_four_workers_write_the_same_bytes(folders, recorded, tmp_path):
    assert generate(folders, tmp_path, VIEWS, CAMERA, TEXTURE, SEED, workers=4) == {}
    assert contents(tmp_path) == contents(recorded)


def test_a_scene_does_not_depend_on_the_others(folders, recorded, tmp_path):
    generate(folders[1:], tmp_path, VIEWS, CAMERA, TEXTURE, SEED)
    name = f"{folders[1].name}.h5"
    assert (tmp_path / name).read_bytes() == (recorded / name).read_bytes()


def test_equal_scenes_have_different_poses(folders, tmp_path):
    twin = tmp_path / "00009-AAAAAAAAAAA"
    twin.symlink_to(folders[0])
    generate([folders[0], twin], tmp_path / "out", VIEWS, CAMERA, TEXTURE, SEED)
    first, second = (Shard(shard_path(folder, tmp_path / "out"), CAMERA, TEXTURE) for folder in (folders[0], twin))
    assert np.abs(first.view(0).pose - second.view(0).pose).max() > 0.01


def test_resumed_run_repeats_nothing_and_equals_an_uninterrupted_one(folders, recorded, tmp_path, monkeypatch):
    def killed(folder, *args):
        if folder == folders[1]:
            raise KeyboardInterrupt
        return attempt(folder, *args)

    attempt = generation._attempt
    monkeypatch.setattr(generation, "_attempt", killed)
    with pytest.raises(KeyboardInterrupt):
        generate(folders, tmp_path, VIEWS, CAMERA, TEXTURE, SEED)
    monkeypatch.undo()
    first = shard_path(folders[0], tmp_path)
    assert sorted(contents(tmp_path)) == [first.name]
    written = first.stat()
    assert generate(folders, tmp_path, VIEWS, CAMERA, TEXTURE, SEED) == {}
    assert contents(tmp_path) == contents(recorded)
    assert (first.stat().st_mtime_ns, first.stat().st_ino) == (written.st_mtime_ns, written.st_ino)
    assert generate(folders, tmp_path, VIEWS, CAMERA, TEXTURE, SEED) == {}  # complete


OTHER_RUNS = [
    (VIEWS + 1, CAMERA, TEXTURE, SEED),
    (VIEWS, replace(CAMERA, bev_px=11), TEXTURE, SEED),
    (VIEWS, CAMERA, replace(TEXTURE, modsem_fraction=0.2), SEED),
    (VIEWS, CAMERA, TEXTURE, 6),
]


@pytest.mark.parametrize("run", OTHER_RUNS)
def test_shards_of_another_run_are_refused(folders, recorded, tmp_path, run):
    before = contents(recorded)
    with pytest.raises(InputError, match=r"manifest\.json: expected a manifest of .*, found one of "):
        generate(folders, recorded, *run)
    assert contents(recorded) == before
    # without a manifest, as after a kill
    shard = tmp_path / f"{folders[0].name}.h5"
    shard.write_bytes((recorded / shard.name).read_bytes())
    broken = generate(folders[:1], tmp_path, *run)
    assert list(broken) == [folders[0].name]
    assert "expected" in broken[folders[0].name] and str(shard) in broken[folders[0].name]
    assert shard.read_bytes() == (recorded / shard.name).read_bytes()
    assert json.loads((tmp_path / "manifest.json").read_text())["shards"] == {}


def meshes_alive() -> int:
    return sum(type(thing) is trimesh.Scene for thing in gc.get_objects())


def test_a_worker_frees_its_scenes(folders, tmp_path):
    """Meshes have reference cycles, and hold the images of their textures."""
    gc.collect()
    before = meshes_alive()
    gc.disable()
    try:
        generate(folders, tmp_path, VIEWS, CAMERA, TEXTURE, SEED)
        assert meshes_alive() == before
    finally:
        gc.enable()


def test_generating_some_scenes_leaves_the_others_in_the_manifest(folders, recorded, tmp_path):
    for part in (folders[1:], folders[:1], folders[1:]):
        assert generate(part, tmp_path, VIEWS, CAMERA, TEXTURE, SEED) == {}
    assert contents(tmp_path) == contents(recorded)


def flip_a_bit(shard: Path) -> None:
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 4
    shard.write_bytes(content)


def truncate(shard: Path) -> None:
    shard.write_bytes(shard.read_bytes()[:-1])


def exchange(shard: Path) -> None:
    """The manifest, with the checksums of two shards exchanged."""
    path = shard.with_name("manifest.json")
    manifest = json.loads(path.read_text())
    first, second = manifest["shards"].values()
    first["sha256"], second["sha256"] = second["sha256"], first["sha256"]
    path.write_text(json.dumps(manifest))


def rewrite(shard: Path, **changed) -> None:
    path = shard.with_name("manifest.json")
    path.write_text(json.dumps({**json.loads(path.read_text()), **changed}))


DAMAGES = {
    "bit": (flip_a_bit, 1, "expected SHA-256 .*, found "),
    "cut": (truncate, 1, "expected SHA-256 .*, found "),
    "missing": (Path.unlink, 1, "expected a shard, found nothing"),
    "foreign": (lambda shard: shard.with_name("a.h5").write_bytes(b""), 1, "a.h5: .*found another one"),
    "sums": (exchange, 2, "expected SHA-256 .*, found "),
    "seed": (lambda shard: rewrite(shard, seed=9), 2, "expected 3 views with seed 9, found 3 with seed 5"),
    "views": (lambda shard: rewrite(shard, views=4), 2, "expected 4 views with seed 5, found 3"),
    "share": (lambda shard: rewrite(shard, modsem_share=0.5), 2, "expected views .*'modsem_share': 0.5"),
    "camera": (lambda shard: rewrite(shard, camera=asdict(CAMERA) | {"bev_px": 9}), 2, "expected views .*'bev_px': 9"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_verify_finds(damage, recorded, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(recorded, out)
    assert verify(out) == []
    do, count, message = DAMAGES[damage]
    do(out / "00002-BBBBBBBBBBB.h5")
    problems = verify(out)
    assert len(problems) == count
    assert all(re.search(message, problem) and str(out) in problem for problem in problems)


@pytest.mark.parametrize("content", [None, "", "[]", "{}", '{"camera": {}}', '{"camera": 3, "shards": {}}'])
def test_invalid_manifests(content, folders, recorded, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(recorded, out)
    (out / "manifest.json").unlink()
    if content is not None:
        (out / "manifest.json").write_text(content)
    with pytest.raises(InputError, match=r"manifest\.json: expected a manifest of shards, found "):
        verify(out)


def test_a_damaged_shard_does_not_change_the_manifest(folders, recorded, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(recorded, out)
    with h5py.File(out / f"{folders[1].name}.h5", "r+") as file:
        file["instance_label"][0] = 7  # valid HDF5
    manifest = (out / "manifest.json").read_bytes()
    problems = generate(folders, out, VIEWS, CAMERA, TEXTURE, SEED)
    assert list(problems) == [folders[1].name] and "expected SHA-256" in problems[folders[1].name]
    assert (out / "manifest.json").read_bytes() == manifest


def test_broken_scene_is_reported_and_skipped(folders, recorded, tmp_path):
    broken = tmp_path / "scenes/00003-CCCCCCCCCCC"
    write_scene(broken, build(room((3, 3, 2.5))))
    (broken / "CCCCCCCCCCC.semantic.txt").write_text("nonsense")
    problems = generate([broken, *folders], tmp_path / "out", VIEWS, CAMERA, TEXTURE, SEED)
    assert list(problems) == [broken.name]
    assert "CCCCCCCCCCC.semantic.txt" in problems[broken.name]
    assert contents(tmp_path / "out") == contents(recorded)


def test_number_of_views_has_to_be_positive(folders, tmp_path):
    problems = generate(folders, tmp_path, -1, CAMERA, TEXTURE, SEED)
    assert all("views: expected 1 or more, found -1" in message for message in problems.values())
    assert len(problems) == 2


@pytest.fixture
def homes(folders, tmp_path) -> Path:
    """Five homes for training, one for validation, one for the test."""
    numbers = {"train": range(5), "minival": [800], "val": [900]}
    for split, of in numbers.items():
        (tmp_path / "homes" / split).mkdir(parents=True)
        for number in of:
            name = f"{number:05d}-AAAAAAAAAAA"
            (tmp_path / "homes" / split / name).symlink_to(folders[0])
    return tmp_path / "homes"


def call(*arguments: object) -> None:
    cli.main(["generate", *map(str, arguments)])


def test_killed_run_is_resumed_without_repetition(homes, tmp_path, monkeypatch):
    unbroken, out, log = tmp_path / "unbroken", tmp_path / "out", tmp_path / "log"
    options = ["--scenes", str(homes), "--scale", "smoke", "--views", "25", "--out"]
    call(*options, unbroken)
    again = [sys.executable, "-m", "zerobev", "generate", *options, str(out), "--workers", "2"]
    killed = subprocess.Popen(again, cwd=ROOT, start_new_session=True, stdout=subprocess.DEVNULL)
    while len(there := list(out.glob("train/[!.]*.h5"))) < 2:
        assert killed.poll() is None
        time.sleep(0.01)
    os.killpg(killed.pid, signal.SIGKILL)  # including the workers
    killed.wait()
    there = list(out.glob("train/[!.]*.h5"))
    assert 2 <= len(there) < 5 and not list(out.rglob("manifest.json"))
    (out / "train/.00004-AAAAAAAAAAA.1.part.h5").write_bytes(b"half")  # as left by a kill
    finished = {path: path.stat() for path in there}
    subprocess.run(again, cwd=ROOT, check=True, env={**os.environ, "ZEROBEV_PROGRESS": str(log)}, timeout=300)
    for path, before in finished.items():
        assert (path.stat().st_mtime_ns, path.stat().st_ino) == (before.st_mtime_ns, before.st_ino)
    for part in ("train", "validation", "test"):
        assert contents(out / part) == contents(unbroken / part)
    # number of recorded shards of those missing, and the remaining time
    assert re.search(rf"views of train: 100%.*{5 - len(there)}/{5 - len(there)} \[\d+:\d+<\d+:\d+", log.read_text())


def test_a_dask_cluster_writes_the_same_bytes(homes, tmp_path, monkeypatch):
    options = ["--scenes", homes, "--scale", "smoke", "--views", 2, "--out"]
    call(*options, tmp_path / "here")
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        call(*options, tmp_path / "dask", "--dask", cluster.scheduler_address)
        tasks = cluster.scheduler.transition_counter
    assert tasks > 0  # the cluster did the work
    for part in ("train", "validation", "test"):
        assert contents(tmp_path / "dask" / part) == contents(tmp_path / "here" / part)


def test_command_verifies_every_split(homes, tmp_path, monkeypatch):
    out = tmp_path / "out"
    call("--scenes", homes, "--out", out, "--scale", "smoke", "--views", 2)
    call("--verify", "--out", out)
    truncate(out / "train/00003-AAAAAAAAAAA.h5")
    (out / "test/00900-AAAAAAAAAAA.h5").unlink()
    with pytest.raises(SystemExit, match=r"(?s)train/00003.*expected SHA-256.*test/00900.*found nothing"):
        call("--verify", "--out", out)
    with pytest.raises(
        SystemExit, match=r"^error: .*train/manifest\.json: expected a manifest of shards, found nothing"
    ):
        call("--verify", "--out", tmp_path / "nowhere")


def test_command_reports_a_broken_scene(homes, folders, tmp_path, monkeypatch):
    broken = homes / "train/00001-AAAAAAAAAAA"
    broken.unlink()
    shutil.copytree(folders[0], broken)
    (broken / "AAAAAAAAAAA.semantic.txt").write_text("nonsense")
    with pytest.raises(SystemExit, match=r"^skipped 00001-AAAAAAAAAAA: .*semantic\.txt.*expected") as stopped:
        call("--scenes", homes, "--out", tmp_path / "out", "--scale", "smoke", "--views", 2)
    assert stopped.value.code not in (0, None)
    assert len(list(tmp_path.glob("out/*/[!.]*.h5"))) == 6
    assert sorted(json.loads((tmp_path / "out/train/manifest.json").read_text())["shards"]) == [
        f"{number:05d}-AAAAAAAAAAA.h5" for number in (0, 2, 3, 4)
    ]


def test_invalid_dask_address(homes, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=r"^error: --dask: expected the address of a scheduler, found 'nonsense'"):
        call("--scenes", homes, "--out", tmp_path / "out", "--dask", "nonsense")


def test_command_records_every_split(folders, tmp_path, monkeypatch, capsys):
    """Of two scenes one is for training and validation, and one for test."""
    for split, folder in (("train", folders[0]), ("val", folders[1])):
        (tmp_path / "homes" / split).mkdir(parents=True)
        (tmp_path / "homes" / split / folder.name).symlink_to(folder)
    homes, out = tmp_path / "homes", tmp_path / "out"
    command = ["generate", "--scale", "smoke", "--views", "2", "--out", str(out), "--scenes"]
    cli.main([*command, str(homes)])
    first, second = (folder.name for folder in folders)
    shards = {path.relative_to(out).as_posix(): path for path in out.rglob("*.h5")}
    assert sorted(shards) == [f"test/{second}.h5", f"train/{first}.h5", f"validation/{first}.h5"]
    assert {len(Shard(path, scale("smoke").camera, scale("smoke").texture)) for path in shards.values()} == {2}
    with pytest.raises(SystemExit, match=r"^error: .*nowhere: expected .*, found nothing$"):
        cli.main([*command, str(tmp_path / "nowhere")])
