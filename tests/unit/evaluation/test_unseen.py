"""Modalities beyond the classes: masks of image and map against each other, and counts by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from zerobev.config import LABELS, CameraConfig, TextureConfig
from zerobev.data.views import View, ViewSource
from zerobev.evaluation import unseen
from zerobev.evaluation.metrics import Counts
from zerobev.evaluation.unseen import MODALITIES, evaluate_unseen, unseen_masks, unseen_table
from zerobev.geometry.projection import cells_of_pixels
from zerobev.scenes.hm3dsem_writer import write_scene

from support.scenes import build, furnished

CAMERA = CameraConfig(fpv_px=64, bev_px=40)


@pytest.fixture(scope="module")
def views() -> tuple[list[View], np.ndarray]:
    source = ViewSource(build(furnished()), CAMERA, TextureConfig(), np.random.default_rng(0))
    return [source.draw() for _ in range(6)], source.scene.instance_label


def test_masks_of_image_and_map_agree_on_common_surfaces(views):
    """A pixel and its cell with the same texel must agree in object, label, and so on."""
    seen = dict.fromkeys(MODALITIES, 0)
    for number, view in enumerate(views[0]):
        masks = unseen_masks(view, views[1], CAMERA, np.random.default_rng(number))
        cell = cells_of_pixels(torch.from_numpy(view.depth), CAMERA).numpy()
        on_map = cell < 40**2
        texels = view.bev_texel.reshape(-1, 3)[cell[on_map]]
        same = (view.fpv_texel[on_map] == texels).all(-1) & (texels[:, 0] >= 0)
        for name in set(MODALITIES) - {"outlines"}:  # edges differ between image and map
            fpv, bev = (images.reshape(len(images), -1) for images in masks[name])
            agree = fpv[:, on_map.ravel()][:, same] == bev[:, cell[on_map]][:, same]
            assert agree.mean() > 0.995, name  # a texel of 1 cm may cross an edge
            seen[name] += int(fpv.any()) + int(bev.any())
        assert masks["outlines"][0].shape == (1, 64, 64) and masks["outlines"][1].shape == (1, 40, 40)
    assert min(seen[name] for name in set(MODALITIES) - {"outlines"}) > 0


def test_masks_by_hand(views):
    view = views[0][0]
    masks = unseen_masks(view, views[1], CAMERA, np.random.default_rng(0))
    labels = masks["random labels"]
    for images, texel in zip(labels, (view.fpv_texel, view.bev_texel)):
        assert np.array_equal(images.sum(axis=0), texel[..., 0] >= 0)  # one label per surface pixel
    other = unseen_masks(view, views[1], CAMERA, np.random.default_rng(1))["random labels"]
    assert 0.5 < (other[0] != labels[0]).any(axis=0).mean() < 0.95  # three in four change
    seats = np.isin(views[1][view.bev_instance], [LABELS.index(n) for n in ("chair", "sofa", "bed", "toilet")])
    assert np.array_equal(masks["to sit on"][1][0], seats)
    assert not (masks["to put things on"][1][0] & (view.bev_height > 1.1)).any()
    floor = views[1][view.bev_instance] == LABELS.index("floor")
    assert not any((masks[name][1] & floor).any() for name in ("instances", "outlines", "to put things on"))


def test_counts_are_sums_over_the_masks_of_a_modality(tmp_path, monkeypatch):
    write_scene(tmp_path / "00001-HomeA", build(furnished()))
    answers = {"a.2": lambda b: b["target"] > 0.5, "c": lambda b: b["target"] < 0, "d": lambda b: b["target"] >= 0}
    monkeypatch.setattr(unseen, "ROWS", ("c", "d"))
    monkeypatch.setattr(unseen, "load", lambda row: SimpleNamespace(camera=CAMERA, predict=answers[row]))
    counts = evaluate_unseen([tmp_path / "00001-HomeA"], views=3)
    assert np.array_equal(counts["a.2"].intersection, counts["a.2"].union)
    assert not counts["c"].intersection.any() and np.array_equal(counts["c"].union, counts["a.2"].union)
    assert np.array_equal(counts["d"].intersection, counts["a.2"].union)
    # all white: each mask of a modality counts the whole field of view once
    area = counts["d"].union[0] / counts["d"].union[0, MODALITIES.index("to sit on")]
    assert area[MODALITIES.index("random labels")] == 4 and area[MODALITIES.index("outlines")] == 1
    assert list(unseen_table(counts)["(a.2)"].str[:5]) == ["100.0"] * len(MODALITIES)


def test_a_view_without_objects_counts_none():
    ends = np.array([0, 1, 5, 6])
    cells = np.arange(7)[None]
    assert unseen._summed(cells, ends).tolist() == [[0, 0, 1 + 2 + 3 + 4, 5, 6]]
    assert Counts(*(unseen._summed(cells, ends) for _ in range(2))).union.shape == (1, len(MODALITIES))
