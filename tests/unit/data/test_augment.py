"""Other heights, cameras and looks: against closed forms, and against the projection of photographs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from zerobev.config import LABELS, AugmentConfig, CameraConfig, TextureConfig
from zerobev.data.augment import Augmentation
from zerobev.data.coverage import _covered_by, other_camera
from zerobev.data.looks import _colors, new_look
from zerobev.data.samples import SynthSamples, class_masks, view_sample
from zerobev.data.sensor_depth import completed, mixed_depth
from zerobev.data.shards import Shard, write_shard
from zerobev.data.textures import TextureBank
from zerobev.data.view_set import ViewSet
from zerobev.data.views import View, ViewSource
from zerobev.geometry.cameras import Camera, fpv_rays
from zerobev.geometry.projection import inverse_project_mask
from zerobev.inference.pinhole import PinholeView
from zerobev.scenes.scene import Scene

from support.scenes import build, furnished

CAMERA = CameraConfig(fpv_px=48, bev_px=25)
TEXTURE = TextureConfig(tiles=4)
HEIGHTS = (0.3, 1.8)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build(furnished())


@pytest.fixture(scope="module")
def views(scene) -> list[View]:
    source = ViewSource(scene, CAMERA, TEXTURE, np.random.default_rng(0), HEIGHTS)
    return [source.draw() for _ in range(8)]


@pytest.fixture(scope="module")
def bank() -> TextureBank:
    noise = np.random.default_rng(0).standard_normal((4, 128, 128))
    smooth = np.array([ndimage.gaussian_filter(tile, 5, mode="wrap") for tile in noise])
    return TextureBank(smooth > np.quantile(smooth, 0.8, axis=(1, 2), keepdims=True), TEXTURE)


# --- heights ------------------------------------------------------------------------------------------------------


def test_from_every_height_the_floor_is_at_the_same_rows(scene, views):
    """The floor is a plane, so its depth follows from the row of the level camera at the configured height."""
    (floor,) = (instance.id for instance in scene.instances if instance.name == "floor")
    expected = CAMERA.height_m / np.maximum(fpv_rays(CAMERA)[..., 1], 1e-9)
    heights = [view.height_m for view in views]
    assert HEIGHTS[0] <= min(heights) < 0.8 and 1.0 < max(heights) <= HEIGHTS[1]
    for view in views:
        on_floor = view.fpv_instance == floor
        np.testing.assert_allclose(view.depth[on_floor], expected[on_floor], rtol=1e-4)


def test_from_every_height_points_have_their_place_on_the_map(scene, views):
    """P^-1 of each class is on, or beside, cells of that class or of a surface above it."""
    for view in views:
        zero, target = class_masks(view, scene.instance_label)
        for name in ("bed", "chair"):
            k = LABELS.index(name)
            found = inverse_project_mask(zero[k], view.depth, view.seen_by(CAMERA))
            near = ndimage.binary_dilation(target[k], iterations=1)
            assert (found & ~near).sum() <= 0.1 * max(found.sum(), 10)


def test_from_every_height_photograph_and_depth_agree(views):
    """The scene's photograph shows each instance in one colour, so colours change where instances do."""
    for view in views:
        for instance in np.unique(view.fpv_instance):
            inside = ndimage.binary_erosion(view.fpv_instance == instance, iterations=2)
            if inside.sum() > 20:
                assert view.rgb[inside].astype(float).std(axis=0).max() < 12


def test_the_limit_on_heights_is_that_of_the_room(views):
    """Points above two metres have no cell, from whatever height they are seen."""
    for view in views:
        height = view.height_m - fpv_rays(CAMERA)[..., 1] * (view.height_m / CAMERA.height_m) * view.depth
        for mask, expected in ((height > 2.02, False), (height < 1.98, True)):
            some = mask & (view.depth > 0) & (view.depth < 4) & (np.abs(fpv_rays(CAMERA)[..., 0] * view.depth) < 2.4)
            if some.any():
                assert inverse_project_mask(some, view.depth, view.seen_by(CAMERA)).any() == expected


# --- cameras ------------------------------------------------------------------------------------------------------


@given(
    st.builds(
        Camera,
        hfov_deg=st.floats(50, 110),
        height_m=st.floats(*HEIGHTS),
        pitch_deg=st.floats(-30, 15),
        roll_deg=st.floats(-5, 5).filter(bool),
    )
)
def test_the_covered_part_is_that_of_a_levelled_photograph(other):
    shape = (240, 320)
    covered, nearest = _covered_by(other, shape, CAMERA, other.height_m / CAMERA.height_m)
    expected = PinholeView(shape, other, CAMERA).covered
    # centres of pixels against half of their area
    assert (covered != expected).mean() < 0.03
    side = CAMERA.fpv_px
    own = np.arange(side * side).reshape(side, side)
    assert np.array_equal(nearest[covered], own[covered])
    border = ndimage.binary_dilation(covered, iterations=2)
    assert border.ravel()[nearest[~covered]].sum() >= 0.9 * (~covered).sum()


def test_a_level_camera_of_the_same_field_covers_everything():
    assert _covered_by(Camera(), (480, 480), CAMERA, 1.0)[0].all()
    covered, _ = _covered_by(Camera(), (480, 480), CAMERA, 1.8 / CAMERA.height_m)
    assert covered[24].all() and not covered[:8].any() and not covered[-8:].any()


def test_cameras_cover_a_third_or_more_and_differ():
    rng = np.random.default_rng(0)
    fractions = [other_camera(CAMERA, 1.0, rng)[0].mean() for _ in range(30)]
    assert min(fractions) > 0.3 and np.ptp(fractions) > 0.3


# --- looks --------------------------------------------------------------------------------------------------------


def test_colours_are_constant_on_an_instance_and_independent_of_its_class(views):
    rng = np.random.default_rng(0)
    factor = _colors(views[0].fpv_instance, rng)
    for instance in np.unique(views[0].fpv_instance):
        assert len(np.unique(factor[views[0].fpv_instance == instance], axis=0)) == 1
    permuted = views[0].fpv_instance[::-1]
    assert np.array_equal(_colors(permuted, np.random.default_rng(0)), factor[::-1])


def test_a_look_is_a_function_of_its_generator(views, bank):
    first, again, other = (new_look(views[0], bank, 2, CAMERA, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first.dtype == np.uint8 and first.shape == views[0].rgb.shape
    assert np.array_equal(first, again) and np.abs(first.astype(int) - other).mean() > 5


# --- samples ------------------------------------------------------------------------------------------------------


def sample_of(view: View, scene: Scene) -> dict:
    return view_sample(view, CAMERA, 0, *class_masks(view, scene.instance_label))


def test_each_change_has_its_own_effect(scene, views, bank):
    view, rng = views[0], np.random.default_rng(0)
    before = sample_of(view, scene)
    looks = Augmentation(AugmentConfig(looks=1), CAMERA, bank)(before, view, 2, rng)
    assert [name for name in before if not np.array_equal(before[name], looks[name])] == ["rgb"]
    mirror = Augmentation(AugmentConfig(mirrored=1), CAMERA, bank)
    twice = mirror(mirror(before, view, 2, rng), view, 2, rng)
    assert all(np.array_equal(before[name], twice[name]) for name in before)
    cameras = Augmentation(AugmentConfig(cameras=1), CAMERA, bank)(before, view, 2, rng)
    assert {name for name in before if not np.array_equal(before[name], cameras[name])} <= {
        "rgb",
        "zero",
        "depth",
        "fov",
    }
    assert (cameras["zero"] <= before["zero"]).all() and (cameras["fov"] <= before["fov"]).all()
    assert not cameras["zero"][:, cameras["depth"][0] == 0].any()


def test_a_mirrored_sample_is_that_of_a_mirrored_room(scene, views, bank):
    """P^-1 and mirroring commute, apart from points on the border of two cells."""
    mirror = Augmentation(AugmentConfig(mirrored=1), CAMERA, bank)
    for view in views:
        before = sample_of(view, scene)
        after = mirror(before, view, 2, np.random.default_rng(0))
        for name in ("target", "aux", "fov"):
            assert np.array_equal(after[name], before[name][..., ::-1])
        for k in range(len(LABELS)):
            camera = view.seen_by(CAMERA)
            direct = inverse_project_mask(after["zero"][k], after["depth"][0], camera)
            mirrored = inverse_project_mask(before["zero"][k], before["depth"][0], camera)[:, ::-1]
            assert (direct != mirrored).sum() <= 0.02 * direct.size


def test_objects_are_white_as_a_whole(scene, views, bank, tmp_path):
    write_shard(tmp_path / "a.h5", scene, views, CAMERA, TEXTURE, 0)
    shards = ViewSet([Shard(tmp_path / "a.h5", CAMERA, TEXTURE)])
    stream = SynthSamples(shards, bank, CAMERA, 0, 4, objects_fraction=1.0)
    seen = set()
    for index in range(30):
        view = next(v for v in views if np.array_equal(v.rgb, np.moveaxis(stream.sample(index)["rgb"], 0, -1)))
        sample = stream.sample(index)
        for image, instances in ((sample["zero"][0], view.fpv_instance), (sample["target"][0], view.bev_instance)):
            white = np.unique(instances[image])
            assert not np.isin(instances[~image], white).any() and 0 not in white
            seen |= set(white.tolist())
    assert len(seen) > 5


# --- depth of any quality -----------------------------------------------------------------------------------------


def test_depth_of_any_quality_occurs():
    rng = np.random.default_rng(0)
    depth, estimated = np.full((48, 48), 2.0, np.float32), np.full((48, 48), 3.0, np.float32)
    grey, kinds = np.full((48, 48, 3), 128, np.uint8), []
    for _ in range(400):
        found, measured = mixed_depth(depth, estimated, grey, rng)
        if np.array_equal(found, depth):
            assert measured.all()
            kinds.append("true")
        elif found.min() == found.max() and found.min() >= 3:  # errors are exaggerated, never reduced
            assert found.max() <= 2 * (3 / 2) ** 1.6 + 1e-6
            assert not measured.any()
            kinds.append("estimated")
        elif not found.any():
            assert not measured.any()
            kinds.append("none")
        else:
            kinds.append("holes" if (found == 0).any() else "completed")
            assert 0 < measured.mean() < 1 and not (measured[found == 0]).any()
            assert kinds[-1] == "completed" or np.array_equal(measured, found > 0)
            assert np.abs(found[found > 0] - 2).max() < 0.2  # the estimate is scaled to the measurement
    assert all(kinds.count(kind) > 15 for kind in ("true", "estimated", "none", "holes", "completed"))


def test_too_few_values_do_not_scale_an_estimate():
    known, estimated = np.zeros((48, 48), np.float32), np.full((48, 48), 3.0, np.float32)
    known[0, :5] = 1.0
    np.testing.assert_array_equal(completed(known, estimated), np.where(known > 0, 1, 3))


def test_estimates_are_beside_the_true_depth(scene, views, bank, tmp_path):
    """Textures keep their true place, and the depth of a sample is true, estimated, or between."""
    write_shard(tmp_path / "a.h5", scene, views, CAMERA, TEXTURE, 0)
    shards = ViewSet([Shard(tmp_path / "a.h5", CAMERA, TEXTURE)])
    mixed = shards.with_estimates([np.stack([view.depth + 1 for view in views])])
    plain, other = (SynthSamples(of, bank, CAMERA, 0, 4) for of in (shards, mixed))
    for index in range(6):
        a, b = plain.sample(index), other.sample(index)
        assert np.array_equal(a["zero"], b["zero"]) and np.array_equal(a["target"], b["target"])
    assert any(not np.array_equal(plain.sample(i)["depth"][0], other.sample(i)["depth"][0]) for i in range(6))
