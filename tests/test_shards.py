"""Shards: what is written is read, the same seed gives the same bytes, and nothing half-done is left behind."""

import json
import pickle
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scenes_for_tests import build, furnished, room

from zerobev.config import CameraConfig, scale
from zerobev.errors import InputError, run_command
from zerobev.scenes.hm3dsem_writer import write_scene
from zerobev.scenes.scene import Scene
from zerobev.sensors.cameras import Pose
from zerobev.sensors.gbuffer import RayCaster
from zerobev.sensors.photograph import Photographer
from zerobev.streams import generate as generation
from zerobev.streams.generate import generate, shard_path
from zerobev.streams.projection import fov_mask
from zerobev.streams.shards import Shard, checksum, write_shard
from zerobev.streams.views import View, ViewSource

CAMERA = CameraConfig(fpv_px=16, bev_px=10)
SEED, VIEWS = 5, 3


def views_of(scene: Scene, seed: int = 0, count: int = VIEWS) -> list[View]:
    source = ViewSource(scene, CAMERA, np.random.default_rng(seed))
    return [source.draw() for _ in range(count)]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build(furnished())


@pytest.fixture(scope="module")
def views(scene) -> list[View]:
    return views_of(scene)


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
    assert generate(folders, out, VIEWS, CAMERA, SEED) == {}
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_views_come_back_as_they_were(scene, views, tmp_path):
    write_shard(tmp_path / "a.h5", scene, views, CAMERA, SEED)
    shard = Shard(tmp_path / "a.h5", CAMERA)
    assert (shard.scene, shard.charts, len(shard)) == ("test", 2, VIEWS)
    assert np.array_equal(shard.instance_label, scene.instance_label)
    assert shard.instance_label.dtype == np.int8
    for index, view in enumerate(views):
        read = shard.view(index)
        for field in fields(View):
            written, found = getattr(view, field.name), getattr(read, field.name)
            assert np.array_equal(written, found) and written.dtype == found.dtype, field.name


def test_fields_have_the_documented_types(views):
    expected = {
        "rgb": ((16, 16, 3), "uint8"),
        "depth": ((16, 16), "float32"),
        "fpv_texel": ((16, 16, 3), "int16"),
        "fpv_instance": ((16, 16), "uint16"),
        "bev_texel": ((10, 10, 3), "int16"),
        "bev_instance": ((10, 10), "uint16"),
        "bev_height": ((10, 10), "float32"),
        "fov": ((10, 10), "bool"),
        "pose": ((4,), "float64"),
    }
    arrays = {field.name: getattr(views[0], field.name) for field in fields(View)}
    assert {name: (array.shape, array.dtype.name) for name, array in arrays.items()} == expected


def test_a_view_is_what_the_sensors_see_at_its_pose(scene, views):
    caster, photographer = RayCaster(scene), Photographer(scene, CAMERA)
    for view in views:
        pose = Pose(*view.pose)
        fpv, bev = caster.fpv(pose, CAMERA), caster.bev(pose, CAMERA)
        assert np.array_equal(view.depth, fpv.distance) and np.array_equal(view.bev_height, bev.distance)
        assert np.array_equal(view.fpv_texel, fpv.texel) and np.array_equal(view.bev_texel, bev.texel)
        assert np.array_equal(view.fpv_instance, fpv.instance) and np.array_equal(view.bev_instance, bev.instance)
        assert np.array_equal(view.fov, fov_mask(fpv.distance, CAMERA))
        assert np.array_equal(view.rgb, photographer.take(pose))


def test_poses_that_see_too_little_are_refused(scene):
    views = views_of(scene, count=20)
    assert min(view.fov.mean() for view in views) >= 0.1
    with pytest.raises(InputError, match=r"scene test: .*10% of the map.*50 poses"):
        views_of(build(room((1.3, 1.3, 2.5))))


def test_a_shard_travels_to_another_process_while_open(scene, views, tmp_path):
    write_shard(tmp_path / "a.h5", scene, views, CAMERA, SEED)
    shard = Shard(tmp_path / "a.h5", CAMERA)
    first = shard.view(0)
    assert np.array_equal(pickle.loads(pickle.dumps(shard)).view(0).rgb, first.rgb)


def test_same_seed_same_bytes_at_any_time(scene, views, tmp_path):
    write_shard(tmp_path / "a.h5", scene, views, CAMERA, SEED)
    time.sleep(1.1)  # HDF5 keeps times in seconds, where it is let
    write_shard(tmp_path / "b.h5", scene, views_of(scene), CAMERA, SEED)
    write_shard(tmp_path / "c.h5", scene, views_of(scene, seed=1), CAMERA, SEED)
    first, again, other = (checksum(tmp_path / f"{name}.h5") for name in "abc")
    assert first == again != other


def test_a_view_that_fails_leaves_nothing(scene, views, tmp_path):
    def failing():
        yield views[0]
        raise InputError("no more views")

    with pytest.raises(InputError, match="no more views"):
        write_shard(tmp_path / "a.h5", scene, failing(), CAMERA, SEED)
    assert list(tmp_path.iterdir()) == []


def test_files_that_are_no_shard_of_this_camera(scene, views, tmp_path):
    path = tmp_path / "a.h5"
    with pytest.raises(InputError, match=r"a\.h5: expected a shard of views, found .*"):
        Shard(path, CAMERA)
    write_shard(path, scene, views, CAMERA, SEED)
    with pytest.raises(InputError, match=r"a\.h5: expected views of CameraConfig\(fpv_px=16, .*hfov_deg=60"):
        Shard(path, replace(CAMERA, hfov_deg=60))
    whole = path.read_bytes()
    for length in (0, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"a\.h5: expected a shard of views"):
            Shard(path, CAMERA)
    for content in (b"not HDF5", b""):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"a\.h5: expected a shard of views"):
            Shard(path, CAMERA)
    with h5py.File(path, "w") as file:
        file.attrs["camera"] = "{"
    with pytest.raises(InputError, match=r"a\.h5: expected a shard of views"):
        Shard(path, CAMERA)


def test_damaged_view_is_named(scene, views, tmp_path):
    path = tmp_path / "a.h5"
    write_shard(path, scene, views, CAMERA, SEED)
    with h5py.File(path) as file:
        chunk = file["views"].id.get_chunk_info(1)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset : chunk.byte_offset + chunk.size] = b"\xff" * chunk.size
    path.write_bytes(content)
    shard = Shard(path, CAMERA)
    shard.view(0)
    with pytest.raises(InputError, match=r"a\.h5: expected view 1, found "):
        shard.view(1)


def test_manifest_names_the_shards_that_are_there(recorded):
    manifest = json.loads((recorded / "manifest.json").read_text())
    names = ["00001-AAAAAAAAAAA.h5", "00002-BBBBBBBBBBB.h5"]
    assert manifest == {"seed": SEED, "views": VIEWS, "shards": {n: checksum(recorded / n) for n in names}}
    assert [len(Shard(recorded / name, CAMERA)) for name in names] == [VIEWS, VIEWS]
    assert sorted(contents(recorded)) == [*names, "manifest.json"]


def test_two_workers_write_the_same_bytes(folders, recorded, tmp_path):
    assert generate(folders, tmp_path, VIEWS, CAMERA, SEED, workers=2) == {}
    assert contents(tmp_path) == contents(recorded)


def test_a_scene_does_not_depend_on_the_others(folders, recorded, tmp_path):
    generate(folders[1:], tmp_path, VIEWS, CAMERA, SEED)
    name = f"{folders[1].name}.h5"
    assert (tmp_path / name).read_bytes() == (recorded / name).read_bytes()


def test_scenes_that_are_alike_are_seen_from_other_poses(folders, tmp_path):
    twin = tmp_path / "00009-AAAAAAAAAAA"
    twin.symlink_to(folders[0])
    generate([folders[0], twin], tmp_path / "out", VIEWS, CAMERA, SEED)
    first, second = (Shard(shard_path(folder, tmp_path / "out"), CAMERA) for folder in (folders[0], twin))
    assert np.abs(first.view(0).pose - second.view(0).pose).max() > 0.01


def test_resumed_run_redoes_nothing_and_equals_an_unbroken_one(folders, recorded, tmp_path, monkeypatch):
    def killed(folder, *args):
        if folder == folders[1]:
            raise KeyboardInterrupt
        return attempt(folder, *args)

    attempt = generation._attempt
    monkeypatch.setattr(generation, "_attempt", killed)
    with pytest.raises(KeyboardInterrupt):
        generate(folders, tmp_path, VIEWS, CAMERA, SEED)
    monkeypatch.undo()
    first = shard_path(folders[0], tmp_path)
    assert sorted(contents(tmp_path)) == [first.name]
    written = first.stat()
    assert generate(folders, tmp_path, VIEWS, CAMERA, SEED) == {}
    assert contents(tmp_path) == contents(recorded)
    assert (first.stat().st_mtime_ns, first.stat().st_ino) == (written.st_mtime_ns, written.st_ino)
    assert generate(folders, tmp_path, VIEWS, CAMERA, SEED) == {}  # nothing is left to do


def test_shards_of_another_run_are_not_taken_for_this_one(folders, recorded):
    before = contents(recorded)
    for views, camera, seed in (
        (VIEWS + 1, CAMERA, SEED),
        (VIEWS, replace(CAMERA, bev_px=11), SEED),
        (VIEWS, CAMERA, 6),
    ):
        broken = generate(folders, recorded, views, camera, seed)
        assert sorted(broken) == [folder.name for folder in folders]
        assert all("expected" in message and ".h5" in message for message in broken.values())
        assert {name: data for name, data in contents(recorded).items() if name != "manifest.json"} == {
            name: data for name, data in before.items() if name != "manifest.json"
        }
        assert json.loads((recorded / "manifest.json").read_text())["shards"] == {}
    assert generate(folders, recorded, VIEWS, CAMERA, SEED) == {}
    assert contents(recorded) == before


def test_broken_scene_is_reported_and_skipped(folders, recorded, tmp_path):
    broken = tmp_path / "scenes/00003-CCCCCCCCCCC"
    write_scene(broken, build(room((3, 3, 2.5))))
    (broken / "CCCCCCCCCCC.semantic.txt").write_text("nonsense")
    problems = generate([broken, *folders], tmp_path / "out", VIEWS, CAMERA, SEED)
    assert list(problems) == [broken.name]
    assert "CCCCCCCCCCC.semantic.txt" in problems[broken.name]
    assert contents(tmp_path / "out") == contents(recorded)


def test_number_of_views_has_to_be_positive(folders, tmp_path):
    problems = generate(folders, tmp_path, -1, CAMERA, SEED)
    assert all("views: expected 1 or more, found -1" in message for message in problems.values())
    assert len(problems) == 2


def test_command_records_every_split(folders, tmp_path, monkeypatch, capsys):
    """Two scenes are dealt out as one for training and validation, and one for test."""
    for split, folder in (("train", folders[0]), ("val", folders[1])):
        (tmp_path / "homes" / split).mkdir(parents=True)
        (tmp_path / "homes" / split / folder.name).symlink_to(folder)
    homes, out = tmp_path / "homes", tmp_path / "out"
    command = ["generate", "--scale", "smoke", "--views", "2", "--out", str(out), "--scenes"]
    monkeypatch.setattr(sys, "argv", [*command, str(homes)])
    run_command(generation.main)
    first, second = (folder.name for folder in folders)
    shards = {path.relative_to(out).as_posix(): path for path in out.rglob("*.h5")}
    assert sorted(shards) == [f"test/{second}.h5", f"train/{first}.h5", f"validation/{first}.h5"]
    assert {len(Shard(path, scale("smoke").camera)) for path in shards.values()} == {2}
    monkeypatch.setattr(sys, "argv", [*command, str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit, match=r"^error: .*nowhere: expected .*, found nothing$"):
        run_command(generation.main)
