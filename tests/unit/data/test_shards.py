"""Shards: round trip, same bytes for the same seed, and no partial files."""

import pickle
import time
from dataclasses import fields, replace

import h5py
import numpy as np
import pytest

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig, TextureConfig
from zerobev.data.shards import Shard, checksum, write_shard
from zerobev.data.views import View, ViewSource
from zerobev.geometry.cameras import Pose
from zerobev.geometry.projection import fov_mask
from zerobev.rendering.gbuffer import RayCaster
from zerobev.rendering.photograph import Photographer
from zerobev.scenes.scene import Scene

from support.scenes import build, furnished, room

CAMERA = CameraConfig(fpv_px=16, bev_px=10)
TEXTURE = TextureConfig()
SEED, VIEWS = 5, 3


def views_of(scene: Scene, seed: int = 0, count: int = VIEWS) -> list[View]:
    source = ViewSource(scene, CAMERA, TEXTURE, np.random.default_rng(seed))
    return [source.draw() for _ in range(count)]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build(furnished())


@pytest.fixture(scope="module")
def views(scene) -> list[View]:
    return views_of(scene)


def test_views_come_back_as_they_were(scene, views, tmp_path):
    write_shard(tmp_path / "a.h5", scene, views, CAMERA, TEXTURE, SEED)
    shard = Shard(tmp_path / "a.h5", CAMERA, TEXTURE)
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
        "fpv_modsem": ((16, 16), "uint8"),
        "bev_texel": ((10, 10, 3), "int16"),
        "bev_instance": ((10, 10), "uint16"),
        "bev_modsem": ((10, 10), "uint8"),
        "bev_height": ((10, 10), "float32"),
        "fov": ((10, 10), "bool"),
        "pose": ((4,), "float64"),
    }
    arrays = {field.name: getattr(views[0], field.name) for field in fields(View)}
    assert {name: (array.shape, array.dtype.name) for name, array in arrays.items()} == expected


def test_a_view_agrees_with_the_sensors_at_its_pose(scene, views):
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


def test_a_preview_refuses_the_same_poses_as_a_large_image(scene):
    """Up to the image's border: centres of a preview's larger pixels are farther inside."""
    camera = replace(CAMERA, fpv_px=200)
    source, caster, rng = (
        ViewSource(scene, camera, TEXTURE, np.random.default_rng(0)),
        RayCaster(scene),
        np.random.default_rng(1),
    )
    seen, taken = [], []
    for _ in range(60):
        pose = source.floor.draw(rng)
        seen.append(fov_mask(caster.fpv(pose, camera).distance, camera).mean())
        taken.append(source.at(pose) is not None)
    seen, taken = np.array(seen), np.array(taken)
    assert 10 < taken.sum() < 50
    assert taken[seen >= 0.12].all() and not taken[seen < 0.1].any()


def test_an_open_shard_can_be_sent_to_another_process(scene, views, tmp_path):
    write_shard(tmp_path / "a.h5", scene, views, CAMERA, TEXTURE, SEED)
    shard = Shard(tmp_path / "a.h5", CAMERA, TEXTURE)
    first = shard.view(0)
    assert np.array_equal(pickle.loads(pickle.dumps(shard)).view(0).rgb, first.rgb)


def test_views_are_not_cached(scene, views, tmp_path):
    """HDF5's chunk cache takes megabytes per open shard."""
    write_shard(tmp_path / "a.h5", scene, views, CAMERA, TEXTURE, SEED)
    shard = Shard(tmp_path / "a.h5", CAMERA, TEXTURE)
    shard.view(0)
    _, cached_bytes, _ = shard._views.id.get_access_plist().get_chunk_cache()
    assert cached_bytes == 0


def test_same_seed_same_bytes_at_any_time(scene, views, tmp_path):
    write_shard(tmp_path / "a.h5", scene, views, CAMERA, TEXTURE, SEED)
    other = views_of(scene, seed=1)
    write_shard(tmp_path / "c.h5", scene, other, CAMERA, TEXTURE, SEED)
    time.sleep(1.1)  # HDF5 can store times, in seconds
    first = checksum(tmp_path / "a.h5")
    assert first != checksum(tmp_path / "c.h5")
    noise = np.random.default_rng(0)
    for _ in range(20):  # independent of earlier compression and of the memory's content
        noisy = [replace(view, depth=noise.random(view.depth.shape, np.float32)) for view in other]
        write_shard(tmp_path / "c.h5", scene, noisy, CAMERA, TEXTURE, SEED)
        write_shard(tmp_path / "b.h5", scene, views_of(scene), CAMERA, TEXTURE, SEED)
        assert checksum(tmp_path / "b.h5") == first


def test_a_view_that_fails_leaves_nothing(scene, views, tmp_path):
    def failing():
        yield views[0]
        raise InputError("no more views")

    with pytest.raises(InputError, match="no more views"):
        write_shard(tmp_path / "a.h5", scene, failing(), CAMERA, TEXTURE, SEED)
    assert list(tmp_path.iterdir()) == []


def test_files_that_are_not_shards_of_this_camera(scene, views, tmp_path):
    path = tmp_path / "a.h5"
    with pytest.raises(InputError, match=r"a\.h5: expected a shard of views, found .*"):
        Shard(path, CAMERA, TEXTURE)
    write_shard(path, scene, views, CAMERA, TEXTURE, SEED)
    with pytest.raises(InputError, match=r"a\.h5: expected views .*'hfov_deg': 60, .*found .*'hfov_deg': 79"):
        Shard(path, replace(CAMERA, hfov_deg=60), TEXTURE)
    with pytest.raises(InputError, match=r"a\.h5: expected views .*'modsem_share': 0.2.*found .*'modsem_share': 0.3"):
        Shard(path, CAMERA, replace(TEXTURE, modsem_fraction=0.2))
    assert (
        len(Shard(path, CAMERA, replace(TEXTURE, white_fraction=0.1))) == VIEWS
    )  # views do not depend on *Synth* textures
    whole = path.read_bytes()
    for length in (0, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"a\.h5: expected a shard of views"):
            Shard(path, CAMERA, TEXTURE)
    for content in (b"not HDF5", b""):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"a\.h5: expected a shard of views"):
            Shard(path, CAMERA, TEXTURE)
    with h5py.File(path, "w") as file:
        file.attrs["camera"] = "{"
    with pytest.raises(InputError, match=r"a\.h5: expected a shard of views"):
        Shard(path, CAMERA, TEXTURE)


def test_damaged_view_is_named(scene, views, tmp_path):
    path = tmp_path / "a.h5"
    write_shard(path, scene, views, CAMERA, TEXTURE, SEED)
    with h5py.File(path) as file:
        chunk = file["views"].id.get_chunk_info(1)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset : chunk.byte_offset + chunk.size] = b"\xff" * chunk.size
    path.write_bytes(content)
    shard = Shard(path, CAMERA, TEXTURE)
    shard.view(0)
    with pytest.raises(InputError, match=r"a\.h5: expected view 1, found "):
        shard.view(1)
