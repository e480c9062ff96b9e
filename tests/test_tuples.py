"""Streams of tuples: functions of seed and step, aligned by the same texels, blind to what the scene means."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scenes_for_tests import build, furnished, room
from scipy import ndimage

from zerobev.config import LABELS, CameraConfig, TextureConfig
from zerobev.streams.shards import Shard, write_shard
from zerobev.streams.textures import TextureBank
from zerobev.streams.tuples import SynthTuples, ViewSet, collate, semantic_batches, semantic_sample, view_sample
from zerobev.streams.views import View, ViewSource

CAMERA = CameraConfig(fpv_px=24, bev_px=20)
COUNTS = (5, 3)


@pytest.fixture(scope="module")
def bank() -> TextureBank:
    """Blobs of some 15 texels, 20 % white."""
    noise = np.random.default_rng(0).standard_normal((4, 128, 128))
    smooth = np.array([ndimage.gaussian_filter(tile, 5, mode="wrap") for tile in noise])
    return TextureBank(smooth > np.quantile(smooth, 0.8, axis=(1, 2), keepdims=True), TextureConfig(tiles=4))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    for number, (things, count) in enumerate(zip((furnished(), room((6, 4, 2.5))), COUNTS)):
        scene = build(things, name=f"scene{number}")
        source = ViewSource(scene, CAMERA, np.random.default_rng(number))
        write_shard(folder / f"{number}.h5", scene, [source.draw() for _ in range(count)], CAMERA, 0)
    return folder


@pytest.fixture
def views(folder) -> ViewSet:
    return ViewSet([Shard(folder / f"{number}.h5", CAMERA) for number in range(2)])


def same(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_view_set_runs_through_its_shards(views):
    assert len(views) == sum(COUNTS)
    located = [views.locate(index) for index in range(len(views))]
    assert [shard for shard, _ in located] == [0] * 5 + [1] * 3
    for index, (shard, view) in enumerate(located):
        assert np.array_equal(view.rgb, views.shards[shard].view(index - 5 * shard).rgb)


def test_batch_has_the_documented_form(views, bank):
    batch = SynthTuples(views, bank, CAMERA, seed=0, batch=6).batch(0)
    shapes = {name: (tuple(tensor.shape), tensor.dtype) for name, tensor in batch.items()}
    assert shapes == {
        "rgb": ((6, 3, 24, 24), torch.float32),
        "zero": ((6, 1, 24, 24), torch.float32),
        "depth": ((6, 1, 24, 24), torch.float32),
        "target": ((6, 1, 20, 20), torch.float32),
        "aux": ((6, 2, 20, 20), torch.float32),
        "fov": ((6, 1, 20, 20), torch.float32),
        "scene": ((6,), torch.int64),
    }
    for name in ("zero", "target", "aux", "fov"):
        assert set(batch[name].unique().tolist()) <= {0.0, 1.0}
    assert batch["rgb"].min() >= 0 and 0.5 < batch["rgb"].max() <= 1


def test_batch_is_a_function_of_seed_and_step(views, bank):
    stream = SynthTuples(views, bank, CAMERA, seed=1, batch=4)
    in_order = [stream.batch(step) for step in range(4)]
    fresh = SynthTuples(views, bank, CAMERA, seed=1, batch=4)
    for step in (3, 0, 2, 1):
        assert same(fresh.batch(step), in_order[step])
    assert not same(in_order[0], in_order[2])  # the same views may come again, their textures never
    assert not same(SynthTuples(views, bank, CAMERA, seed=2, batch=4).batch(0), in_order[0])


@pytest.mark.parametrize("ranks", [2, 3])
def test_ranks_share_a_batch_without_overlap(views, bank, ranks):
    stream = SynthTuples(views, bank, CAMERA, seed=1, batch=6)
    whole, parts = stream.batch(1), [stream.batch(1, rank, ranks) for rank in range(ranks)]
    for name in whole:
        together = torch.stack([part[name] for part in parts], dim=1).flatten(0, 1)
        assert torch.equal(together, whole[name])


def test_every_epoch_is_a_permutation_of_the_views(views, bank):
    stream = SynthTuples(views, bank, CAMERA, seed=3, batch=1)
    index_of = {views.locate(i)[1].rgb.tobytes(): i for i in range(len(views))}
    assert len(index_of) == len(views)
    order = []
    for i in range(3 * len(views)):
        sample = stream.sample(i)
        rgb = np.round(np.moveaxis(sample["rgb"], 0, -1) * 255).astype(np.uint8)
        order.append(index_of[rgb.tobytes()])
        assert sample["scene"] == (order[-1] >= COUNTS[0])
    epochs = np.array(order).reshape(3, -1)
    assert (np.sort(epochs, axis=1) == np.arange(len(views))).all()
    assert len({tuple(epoch) for epoch in epochs}) == 3


def test_the_same_texel_has_the_same_value_in_image_and_map(views, bank):
    """P1: one texture on the surfaces, looked up twice."""
    stream = SynthTuples(views, bank, CAMERA, seed=0, batch=1)
    index_of = {views.locate(i)[1].depth.tobytes(): i for i in range(len(views))}
    shared = 0
    for i in range(4 * len(views)):
        sample = stream.sample(i)
        _, view = views.locate(index_of[sample["depth"][0].tobytes()])
        texel = np.concatenate([view.fpv_texel.reshape(-1, 3), view.bev_texel.reshape(-1, 3)])
        value = np.concatenate([sample["zero"].ravel(), sample["target"].ravel()])
        unique, inverse = np.unique(texel, axis=0, return_inverse=True)
        count, white = np.bincount(inverse.ravel()), np.bincount(inverse.ravel(), weights=value)
        assert np.isin(white / count, (0, 1)).all()
        assert not white[unique[:, 0] < 0].any()  # no surface, no texture
        in_map = np.unique(view.bev_texel.reshape(-1, 3), axis=0)
        in_image = np.unique(view.fpv_texel.reshape(-1, 3), axis=0)
        shared += len(in_map) + len(in_image) - len(unique)
    assert shared > 10


def test_textures_are_independent_of_the_scene(folder, bank):
    """P3: over many draws every class of the map, and every cell, is white as often as the texture is."""
    views = ViewSet([Shard(folder / "0.h5", CAMERA)])
    draws = 400
    label = views.shards[0].instance_label
    stream = SynthTuples(views, bank, CAMERA, seed=0, batch=1)
    index_of = {views.locate(i)[1].depth.tobytes(): i for i in range(len(views))}
    white: dict[int, list[np.ndarray]] = {i: [] for i in range(len(views))}
    for i in range(draws):
        sample = stream.sample(i)
        white[index_of[sample["depth"][0].tobytes()]].append(sample["target"][0])
    for i, maps in white.items():
        maps = np.array(maps)
        assert len({m.tobytes() for m in maps}) > 0.95 * len(maps)  # the same view, always another texture
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


def test_classes_are_disjoint_and_are_the_labels_of_what_is_seen(views):
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
    assert same(collate([semantic_sample(views, 4, CAMERA)]), {name: whole[name][4:5] for name in whole})


def test_auxiliary_maps_split_the_surfaces_at_ten_centimetres():
    side = 4
    height = np.array([[0, 0.05, 0.0999, 0.1], [0.1001, 0.5, 2.0, -0.3], [0, 0, 0, 0], [0, 0, 0, 0]], np.float32)
    texel = np.zeros((side, side, 3), np.int16)
    texel[3] = -1
    image = np.zeros((side, side, 3), np.uint8)
    nothing = np.zeros((side, side))
    view = View(image, nothing, texel, nothing, texel, nothing, height, nothing > 0, np.zeros(4))
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
