"""Streams of samples: functions of seed and step, aligned by texels, independent of the scene's classes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage

from zerobev.common.errors import InputError
from zerobev.config import LABELS, CameraConfig, TextureConfig
from zerobev.data.samples import (
    DepthProjSamples,
    ModSemSamples,
    SampleStream,
    SemanticSamples,
    SynthSamples,
    as_float,
    collate,
    extruded_texels,
    semantic_batches,
    semantic_sample,
    view_sample,
)
from zerobev.data.shards import Shard, write_shard
from zerobev.data.textures import MODSEM_DRAWS, TextureBank
from zerobev.data.view_set import ViewSet
from zerobev.data.views import View, ViewSource
from zerobev.geometry.projection import cells_of_pixels, inverse_project, map_points

from support.scenes import build, furnished, room

CAMERA = CameraConfig(fpv_px=24, bev_px=20)
TEXTURE = TextureConfig(tiles=4)
COUNTS = (5, 3)
STREAMS = ("synth", "paper", "modsem", "depth", "semantic")


@pytest.fixture(scope="module")
def bank() -> TextureBank:
    """Blobs of about 15 texels, 20 % white."""
    noise = np.random.default_rng(0).standard_normal((4, 128, 128))
    smooth = np.array([ndimage.gaussian_filter(tile, 5, mode="wrap") for tile in noise])
    return TextureBank(smooth > np.quantile(smooth, 0.8, axis=(1, 2), keepdims=True), TEXTURE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    for number, (things, count) in enumerate(zip((furnished(), room((6, 4, 2.5))), COUNTS)):
        scene = build(things, name=f"scene{number}")
        source = ViewSource(scene, CAMERA, TEXTURE, np.random.default_rng(number))
        write_shard(folder / f"{number}.h5", scene, [source.draw() for _ in range(count)], CAMERA, TEXTURE, 0)
    return folder


@pytest.fixture
def views(folder) -> ViewSet:
    return ViewSet([Shard(folder / f"{number}.h5", CAMERA, TEXTURE) for number in range(2)])


def stream(
    name: str, views: ViewSet, bank: TextureBank, seed: int = 1, batch: int = 6, empty_fraction: float = 0.0
) -> SampleStream:
    if name in ("synth", "paper"):
        return SynthSamples(views, bank, CAMERA, seed, batch, empty_fraction, fresh=name == "synth")
    kind = {"modsem": ModSemSamples, "depth": DepthProjSamples, "semantic": SemanticSamples}[name]
    return kind(views, CAMERA, seed, batch, empty_fraction)


def views_of_samples(views: ViewSet, samples: list[dict]) -> list[View]:
    """The view of each sample."""
    view_of = {view.rgb.tobytes(): view for _, view in (views.locate(i) for i in range(len(views)))}
    assert len(view_of) == len(views)
    rgb = [np.moveaxis(sample["rgb"], 0, -1) for sample in samples]
    return [view_of[image.tobytes()] for image in rgb]


def same(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_view_set_indexes_its_shards_in_order(views):
    assert len(views) == sum(COUNTS)
    located = [views.locate(index) for index in range(len(views))]
    assert [shard for shard, _ in located] == [0] * 5 + [1] * 3
    for index, (shard, view) in enumerate(located):
        assert np.array_equal(view.rgb, views.shards[shard].view(index - 5 * shard).rgb)


@pytest.mark.parametrize("name", STREAMS)
def test_batch_has_the_documented_form(views, bank, name):
    batch = stream(name, views, bank).batch(0)
    modalities = len(LABELS) if name == "semantic" else 1
    shapes = {name: (tuple(tensor.shape), tensor.dtype) for name, tensor in batch.items()}
    assert shapes == {
        "rgb": ((6, 3, 24, 24), torch.uint8),
        "zero": ((6, modalities, 24, 24), torch.bool),
        "depth": ((6, 1, 24, 24), torch.float32),
        "target": ((6, modalities, 20, 20), torch.bool),
        "aux": ((6, 2, 20, 20), torch.bool),
        "fov": ((6, 1, 20, 20), torch.bool),
        "scene": ((6,), torch.int64),
    }
    floats = as_float(batch)
    assert {tensor.dtype for name, tensor in floats.items() if name != "scene"} == {torch.float32}
    for image in ("zero", "target", "aux", "fov"):
        assert set(floats[image].unique().tolist()) == {0.0, 1.0}
    assert np.array_equal(floats["rgb"].numpy(), batch["rgb"].numpy().astype(np.float32) / 255)
    assert 0.5 < floats["rgb"].max() <= 1


@pytest.mark.parametrize("name", STREAMS)
def test_batch_is_a_function_of_seed_and_step(views, bank, name):
    first = stream(name, views, bank, batch=4)
    in_order = [first.batch(step) for step in range(4)]
    fresh = stream(name, views, bank, batch=4)
    for step in (3, 0, 2, 1):
        assert same(fresh.batch(step), in_order[step])
    assert not same(stream(name, views, bank, seed=2, batch=4).batch(0), in_order[0])


@pytest.mark.parametrize("world_size", [2, 3])
@pytest.mark.parametrize("name", STREAMS)
def test_ranks_share_a_batch_without_overlap(views, bank, name, world_size):
    whole = stream(name, views, bank).batch(1)
    parts = [stream(name, views, bank).batch(1, rank, world_size) for rank in range(world_size)]
    for tensor in whole:
        together = torch.stack([part[tensor] for part in parts], dim=1).flatten(0, 1)
        assert torch.equal(together, whole[tensor])


@pytest.mark.parametrize("name", STREAMS)
def test_every_epoch_is_a_permutation_of_the_views(views, bank, name):
    data = stream(name, views, bank, seed=3)
    index_of = {views.locate(i)[1].rgb.tobytes(): i for i in range(len(views))}
    assert len(index_of) == len(views)
    order = []
    for i in range(3 * len(views)):
        sample = data.sample(i)
        rgb = np.moveaxis(sample["rgb"], 0, -1)
        order.append(index_of[rgb.tobytes()])
        assert sample["scene"] == (order[-1] >= COUNTS[0])
    epochs = np.array(order).reshape(3, -1)
    assert (np.sort(epochs, axis=1) == np.arange(len(views))).all()
    assert len({tuple(epoch) for epoch in epochs}) == 3


@pytest.mark.parametrize("name", ["synth", "paper", "modsem"])
def test_the_same_texel_has_the_same_value_in_image_and_map(views, bank, name):
    """P1: one texture on the surfaces, looked up twice."""
    samples = [stream(name, views, bank).sample(i) for i in range(4 * len(views))]
    shared = 0
    for sample, view in zip(samples, views_of_samples(views, samples)):
        texel = np.concatenate([view.fpv_texel.reshape(-1, 3), view.bev_texel.reshape(-1, 3)])
        value = np.concatenate([sample["zero"].ravel(), sample["target"].ravel()])
        unique, inverse = np.unique(texel, axis=0, return_inverse=True)
        count, white = np.bincount(inverse.ravel()), np.bincount(inverse.ravel(), weights=value)
        assert np.isin(white / count, (0, 1)).all()
        assert not white[unique[:, 0] < 0].any()  # no texture without a surface
        in_map = np.unique(view.bev_texel.reshape(-1, 3), axis=0)
        in_image = np.unique(view.fpv_texel.reshape(-1, 3), axis=0)
        shared += len(in_map) + len(in_image) - len(unique)
    assert shared > 10


def test_in_the_papers_mode_a_scene_has_one_texture(views, bank):
    """Views are the same in every epoch, texels in every view; other scenes and seeds differ."""
    bank = TextureBank(bank.tiles, replace(bank.config, scales=(1, 5)))

    def white(seed: int) -> dict[tuple, set]:
        """Values at each (scene, texel) in three epochs."""
        values: dict[tuple, set] = {}
        data = stream("paper", views, bank, seed)
        samples = [data.sample(i) for i in range(3 * len(views))]
        for sample, view in zip(samples, views_of_samples(views, samples)):
            for texel, value in zip(view.fpv_texel.reshape(-1, 3).tolist(), sample["zero"].ravel().tolist()):
                values.setdefault((int(sample["scene"]), *texel), set()).add(value)
        return values

    first, other = white(0), white(1)
    assert all(len(values) == 1 for values in first.values())
    assert 0.1 < np.mean([first[texel] != other[texel] for texel in first]) < 0.9
    places = [texel[1:] for texel in first if texel[0] == 0 and (1, *texel[1:]) in first]
    assert 0.1 < np.mean([first[0, *place] != first[1, *place] for place in places]) < 0.9
    # a new texture per sample differs between epochs
    fresh = stream("synth", views, bank)
    samples = [fresh.sample(i) for i in range(2 * len(views))]
    zeros = {view.rgb.tobytes(): [] for view in views_of_samples(views, samples)}
    for sample, view in zip(samples, views_of_samples(views, samples)):
        zeros[view.rgb.tobytes()].append(sample["zero"])
    assert all(not np.array_equal(*pair) for pair in zeros.values())


@pytest.mark.parametrize("name", ["synth", "modsem", "depth"])
def test_the_configured_fraction_of_samples_is_empty(views, bank, name):
    """In the image and on the map; the others are those of a stream without empty samples."""
    plain, emptied = stream(name, views, bank), stream(name, views, bank, empty_fraction=0.3)
    pairs = [(plain.sample(i), emptied.sample(i)) for i in range(200)]
    empty = [not (new["zero"].any() or new["target"].any()) and old["zero"].any() for old, new in pairs]
    assert 0.2 < np.mean(empty) < 0.4
    unchanged = [name for name in pairs[0][0] if name not in ("zero", "target")]
    for (old, new), is_empty in zip(pairs, empty):
        assert all(np.array_equal(old[name], new[name]) for name in (unchanged if is_empty else old))


def test_modsem_shows_one_of_the_draws_at_random(views, bank):
    rng = np.random.default_rng(0)
    fpv, bev = rng.integers(0, 256, (24, 24), np.uint8), rng.integers(0, 256, (20, 20), np.uint8)
    view = replace(views.locate(0)[1], fpv_modsem=fpv, bev_modsem=bev)
    draws = [(fpv >> bit & 1, bev >> bit & 1) for bit in range(MODSEM_DRAWS)]
    shown = np.zeros(MODSEM_DRAWS, int)
    for _ in range(400):
        zero, target = stream("modsem", views, bank).pair(view, 0, rng)
        shown += [np.array_equal(zero[0], image) and np.array_equal(target[0], map_) for image, map_ in draws]
    assert shown.sum() == 400 and shown.min() > 25


def test_modsem_is_white_on_instances_only(views, bank):
    data = stream("modsem", views, bank)
    samples = [data.sample(i) for i in range(5 * len(views))]
    for sample, view in zip(samples, views_of_samples(views, samples)):
        assert not sample["zero"][0][view.fpv_instance == 0].any()
        assert not sample["target"][0][view.bev_instance == 0].any()
        assert sample["zero"].any() and sample["target"].any()


def test_depth_proj_is_the_projection_of_its_rectangles(views, bank):
    batch = as_float(stream("depth", views, bank, batch=20).batch(0))
    assert torch.equal(batch["target"], inverse_project(batch["zero"], batch["depth"], CAMERA))
    assert (batch["target"] <= batch["fov"]).all()  # no evidence outside of the field of view
    assert len({image.numpy().tobytes() for image in batch["zero"]}) == 20


def test_semantic_samples_are_those_of_the_evaluation(views, bank):
    batch = as_float(stream("semantic", views, bank, batch=len(views)).batch(0))
    evaluated = next(semantic_batches(views, CAMERA, len(views)))
    order = [(evaluated["rgb"] == rgb).flatten(1).all(dim=1).nonzero().item() for rgb in batch["rgb"]]
    assert sorted(order) == list(range(len(views)))
    assert same(batch, {name: tensor[order] for name, tensor in evaluated.items()})


def test_the_first_views_of_each_scene_are_the_same_views(views):
    """The first 4 views of shards with 5 and 3 views are 0-3 and 5-7, with their replaced depth."""
    maps = [np.full((count, 24, 24), 1.0 + i, np.float32) for i, count in enumerate(COUNTS)]
    for some in (views.with_depth(maps).first(4), views.first(4).with_depth(maps)):
        assert len(some) == 7 and len(some.first(None)) == 7
        for place, whole in enumerate([0, 1, 2, 3, 5, 6, 7]):
            (scene, view), (same_scene, given) = some.locate(place), views.locate(whole)
            assert scene == same_scene and np.array_equal(view.rgb, given.rgb)
            assert (view.depth == 1 + scene).all()


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_depth_may_be_replaced(views, bank, dtype):
    rng = np.random.default_rng(0)
    maps = [rng.uniform(0.5, 6, (count, 24, 24)).astype(dtype) for count in COUNTS]
    predicted = views.with_depth(maps)
    for i in range(len(views)):
        (scene, view), (same_scene, given) = predicted.locate(i), views.locate(i)
        assert scene == same_scene and view.depth.dtype == np.float32
        assert np.array_equal(view.depth, maps[scene][i - scene * COUNTS[0]])
        assert np.array_equal(view.rgb, given.rgb) and not np.array_equal(view.depth, given.depth)
    batch, given = (as_float(stream("depth", each, bank).batch(0)) for each in (predicted, views))
    assert torch.equal(batch["target"], inverse_project(batch["zero"], batch["depth"], CAMERA))
    assert torch.equal(batch["zero"], given["zero"]) and not torch.equal(batch["target"], given["target"])
    with pytest.raises(InputError, match=r"depth maps: expected \[5, 3\] views per shard, found \[3, 5\]"):
        views.with_depth(maps[::-1])
    with pytest.raises(InputError, match=r"depth maps: expected views of \(24, 24\), found \(20, 24\)"):
        views.with_depth([map_[:, :20] for map_ in maps]).locate(0)


def test_textures_are_independent_of_the_scene(folder, bank):
    """P3: over many draws all classes and all cells of the map have the texture's white fraction."""
    views = ViewSet([Shard(folder / "0.h5", CAMERA, TEXTURE)])
    draws = 400
    label = views.shards[0].instance_label
    data = stream("synth", views, bank, seed=0)
    index_of = {views.locate(i)[1].depth.tobytes(): i for i in range(len(views))}
    white: dict[int, list[np.ndarray]] = {i: [] for i in range(len(views))}
    for i in range(draws):
        sample = data.sample(i)
        white[index_of[sample["depth"][0].tobytes()]].append(sample["target"][0])
    for i, maps in white.items():
        maps = np.array(maps)
        assert len({m.tobytes() for m in maps}) > 0.95 * len(maps)  # one view, another texture each time
        view = views.locate(i)[1]
        surface = view.bev_texel[..., 0] >= 0
        assert maps[:, surface].mean() == pytest.approx(0.2, abs=0.03)
        of_cell = label[view.bev_instance]
        for value in np.unique(of_cell[surface]):
            on = surface & (of_cell == value)
            if on.sum() < 5 or (surface & ~on).sum() < 5:
                continue
            contrast = maps[:, on].mean(axis=1) - maps[:, surface & ~on].mean(axis=1)
            assert abs(contrast.mean()) < 4 * contrast.std() / np.sqrt(len(contrast))


def test_classes_are_disjoint_and_agree_with_the_labels(views):
    batches = list(semantic_batches(views, CAMERA, 3))
    assert [len(batch["scene"]) for batch in batches] == [3, 3, 2]
    whole = {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}
    assert whole["scene"].tolist() == [0] * 5 + [1] * 3
    seen = set()
    for i in range(len(views)):
        shard, view = views.locate(i)
        of_instance = views.shards[shard].instance_label
        for name, instance in (("zero", view.fpv_instance), ("target", view.bev_instance)):
            masks = whole[name][i]
            assert masks.shape[0] == len(LABELS) and (masks.sum(dim=0) <= 1).all()
            label = np.where(masks.sum(dim=0) > 0, masks.argmax(dim=0), -1)
            assert np.array_equal(label, of_instance[instance])
            seen |= {LABELS[value] for value in np.unique(label) if value >= 0}
    assert seen == {"wall", "floor", "bed", "chair", "tv"}
    assert same(as_float(collate([semantic_sample(views, 4, CAMERA)])), {name: whole[name][4:5] for name in whole})


def test_auxiliary_maps_split_the_surfaces_at_ten_centimetres():
    side = 4
    height = np.array([[0, 0.05, 0.0999, 0.1], [0.1001, 0.5, 2.0, -0.3], [0, 0, 0, 0], [0, 0, 0, 0]], np.float32)
    texel = np.zeros((side, side, 3), np.int16)
    texel[3] = -1
    image = np.zeros((side, side, 3), np.uint8)
    nothing = np.zeros((side, side))
    view = View(image, nothing, texel, nothing, nothing, texel, nothing, nothing, height, nothing > 0, np.zeros(4))
    sample = view_sample(view, CAMERA, 0, nothing[None], nothing[None])
    obstacles, navigable = sample["aux"]
    assert obstacles.tolist() == [[0, 0, 0, 0], [1, 1, 1, 0], [0] * 4, [0] * 4]
    assert navigable.tolist() == [[1, 1, 1, 1], [0, 0, 0, 1], [1] * 4, [0] * 4]


def test_auxiliary_maps_of_a_room(views):
    """The bed, the chair, the table and the television are obstacles; floor and rug are not."""
    for i in range(COUNTS[0]):
        _, view = views.locate(i)
        obstacles, navigable = semantic_sample(views, i, CAMERA)["aux"]
        surface = view.bev_texel[..., 0] >= 0
        assert np.array_equal(obstacles + navigable, surface)
        assert np.array_equal(obstacles > 0, np.isin(view.bev_instance, (7, 8, 9, 11)))


def test_extruded_textures_are_constant_along_the_vertical(views):
    seen = 0
    for index in range(len(views)):
        shard, view = views.locate(index)
        chart = views.shards[shard].charts
        fpv, bev = extruded_texels(view, CAMERA, chart)
        raised = bev[..., 0] == chart
        assert np.array_equal(raised, (view.bev_texel[..., 0] >= 0) & (view.bev_height > CAMERA.obstacle_m))
        assert np.array_equal(bev[~raised], view.bev_texel[~raised])
        height = map_points(torch.from_numpy(view.depth), CAMERA)[..., 2].numpy()
        painted = fpv[..., 0] == chart
        assert np.array_equal(fpv[~painted], view.fpv_texel[~painted])
        assert not painted[(height > CAMERA.max_height_m) | (height < CAMERA.obstacle_m)].any()
        # a raised pixel has the texel of its cell, up to the size of a cell, at any height
        cell = cells_of_pixels(torch.from_numpy(view.depth), CAMERA).numpy()
        both = painted & (cell < 20**2)
        both[both] = raised.ravel()[cell[both]]
        apart = fpv[both][:, 1:].astype(int) - bev.reshape(-1, 3)[cell[both]][:, 1:]
        assert (np.linalg.norm(apart, axis=1) <= 100 * CAMERA.cell_m / 2**0.5 + 2).all()
        seen += both.sum()
    assert seen > 100


def test_extruded_textures_are_fixed_in_the_world(views):
    _, view = views.locate(0)
    x, y, z, yaw = view.pose
    turned = extruded_texels(replace(view, pose=np.array([x, y, z, yaw + np.pi / 2])), CAMERA, 9)[1]
    moved = extruded_texels(replace(view, pose=np.array([x + 3, y - 2, z, yaw])), CAMERA, 9)[1]
    bev = extruded_texels(view, CAMERA, 9)[1]
    raised = bev[..., 0] == 9
    assert np.abs(moved[raised][:, 1:].astype(int) - bev[raised][:, 1:] - (300, -200)).max() <= 1
    first, last = np.argwhere(raised)[[0, -1]]
    along, after = (t[tuple(last)][1:].astype(int) - t[tuple(first)][1:] for t in (bev, turned))
    assert np.abs(after - (-along[1], along[0])).max() <= 2  # a quarter turn of the camera rotates the texels


def test_the_configured_fraction_of_samples_is_extruded(views, bank):
    plain, extruded = (SynthSamples(views, bank, CAMERA, 1, 6, extruded_fraction=fraction) for fraction in (0.0, 0.4))
    changed = [not np.array_equal(plain.sample(i)["zero"], extruded.sample(i)["zero"]) for i in range(200)]
    assert 0.3 < np.mean(changed) < 0.5
    fixed = SynthSamples(
        views, bank, CAMERA, 1, 6, fresh=False, extruded_fraction=0.5
    )  # with one texture per scene, per scene
    maps = {}
    for i in range(40):
        view = views_of_samples(views, [fixed.sample(i)])[0]
        maps.setdefault(view.rgb.tobytes(), set()).add(fixed.sample(i)["target"].tobytes())
    assert all(len(found) == 1 for found in maps.values())
