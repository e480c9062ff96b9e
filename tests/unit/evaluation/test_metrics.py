"""IoU against sums done by hand and against torchmetrics; bootstrap intervals against a known case."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torchmetrics.classification import MultilabelJaccardIndex

from zerobev.common.errors import InputError
from zerobev.evaluation.evaluate import evaluate, model_predictor
from zerobev.evaluation.metrics import (
    Counts,
    bootstrap_interval,
    class_iou,
    count,
    iou_per_class,
    pixel_iou,
    resampled_scenes,
)

SEEDS = st.integers(0, 2**32 - 1)


def maps(seed: int, images: int = 6, classes: int = 3, scenes: int = 2, cells: int = 5):
    """Random predictions that resemble the truth, a mask, and the scene of each image."""
    rng = np.random.default_rng(seed)
    shape = (images, classes, cells, cells)
    truth = rng.random(shape) < rng.random((1, classes, 1, 1))
    predicted = truth ^ (rng.random(shape) < 0.3)
    fov = rng.random((images, 1, cells, cells)) < 0.8
    scene = rng.integers(scenes, size=images)
    return (
        torch.from_numpy(predicted),
        torch.from_numpy(truth).float(),
        torch.from_numpy(fov).float(),
        torch.from_numpy(scene),
    )


def test_iou_by_hand():
    """Two scenes, two classes, images of 2 x 2 cells; the lower right cell of the second is outside the FOV."""
    predicted = torch.tensor([[[[1, 1], [0, 0]], [[0, 0], [0, 0]]], [[[1, 0], [0, 1]], [[0, 1], [1, 1]]]]).bool()
    truth = torch.tensor([[[[1, 0], [1, 0]], [[0, 0], [0, 0]]], [[[1, 0], [0, 0]], [[0, 1], [0, 0]]]])
    fov = torch.tensor([[[[1, 1], [1, 1]]], [[[1, 1], [1, 0]]]])
    counts = count(predicted, truth, fov, torch.tensor([0, 1]), 2)
    assert counts.intersection.tolist() == [[1, 0], [1, 1]]
    assert counts.union.tolist() == [[3, 0], [1, 2]]
    assert counts.iou_per_class() == pytest.approx([2 / 4, 1 / 2])
    assert counts.class_iou() == pytest.approx(0.5)
    assert counts.pixel_iou() == pytest.approx(3 / 6)


def test_class_iou_ignores_area_and_pixel_iou_does_not():
    """A class that is absent everywhere counts in neither."""
    counts = Counts(np.array([[90, 0, 0]]), np.array([[100, 10, 0]]))
    assert counts.class_iou() == pytest.approx((0.9 + 0) / 2)
    assert counts.pixel_iou() == pytest.approx(90 / 110)
    assert np.isnan(counts.iou_per_class()).tolist() == [False, False, True]
    assert np.isnan(Counts.empty(2, 3).class_iou())
    assert np.isnan(Counts.empty(2, 3).pixel_iou())


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_agrees_with_torchmetrics(seed):
    """With cells outside the FOV as `ignore_index`; torchmetrics scores an absent class 0."""
    predicted, truth, fov, scene = maps(seed)
    counts = count(predicted, truth, fov, scene, 2)
    ours = np.nan_to_num(counts.iou_per_class())
    metric = MultilabelJaccardIndex(3, average="none", ignore_index=-1)
    marked = torch.where(fov.expand_as(truth) > 0, truth, -1).int()
    np.testing.assert_allclose(ours, metric(predicted.float(), marked).numpy(), atol=1e-6)
    micro = MultilabelJaccardIndex(3, average="micro", ignore_index=-1)
    np.testing.assert_allclose(counts.pixel_iou(), micro(predicted.float(), marked).numpy(), atol=1e-6)
    for one in range(2):
        if (scene == one).any():
            metric.reset()
            expected = metric(predicted[scene == one].float(), marked[scene == one]).numpy()
            alone = np.nan_to_num(iou_per_class(counts.intersection[one], counts.union[one]))
            np.testing.assert_allclose(alone, expected, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_properties_of_counts(seed):
    predicted, truth, fov, scene = maps(seed)
    counts = count(predicted, truth, fov, scene, 2)
    iou = counts.iou_per_class()
    assert ((iou >= 0) & (iou <= 1) | np.isnan(iou)).all()
    assert count(truth > 0, predicted.float(), fov, scene, 2) == counts, "symmetric"
    perfect = count(truth > 0, truth, fov, scene, 2)
    assert (perfect.intersection == perfect.union).all()
    outside = fov.expand_as(truth) == 0
    assert count(predicted ^ outside, truth, fov, scene, 2) == counts, "predictions outside the FOV do not count"
    assert count(predicted, torch.where(outside, 1 - truth, truth), fov, scene, 2) == counts, "nor does the truth"
    order = torch.from_numpy(np.random.default_rng(seed).permutation(len(scene)))
    assert count(predicted[order], truth[order], fov[order], scene[order], 2) == counts, "any order"
    parts = [count(predicted[i::2], truth[i::2], fov[i::2], scene[i::2], 2) for i in range(2)]
    assert parts[0] + parts[1] == counts, "merged or at once"
    assert Counts.from_json(json.loads(json.dumps(counts.to_json()))) == counts


def test_scenes_are_kept_apart():
    predicted, truth, fov, _ = maps(0)
    first = count(predicted, truth, fov, torch.zeros(6), 2)
    second = count(predicted, truth, fov, torch.ones(6), 2)
    assert (first.union[1] == 0).all()
    assert (first.union[0] == second.union[1]).all()


@pytest.mark.parametrize(
    "bad",
    [
        {"intersection": [[3]], "union": [[2]]},
        {"intersection": [[1, 2]], "union": [[2]]},
        {"intersection": [[0.5]], "union": [[2.0]]},
        {"intersection": [[1]]},
        {"intersection": [[1], [1, 2]], "union": [[1]]},
        None,
    ],
)
def test_bad_counts(bad):
    with pytest.raises(InputError, match="counts: expected"):
        Counts.from_json(bad)


def test_bad_maps():
    predicted, truth, fov, scene = maps(0)
    with pytest.raises(InputError, match=r"scene: expected ids in \[0, 1\)"):
        count(predicted, truth, fov, scene, 1)
    with pytest.raises(InputError, match="predicted: expected the target's shape"):
        count(predicted[:, :1], truth, fov, scene, 2)
    with pytest.raises(InputError, match="expected the shape"):
        Counts.empty(2, 3) + Counts.empty(1, 3)


def batches_of(seed: int):
    _, truth, fov, scene = maps(seed, images=8)
    generator = torch.Generator().manual_seed(seed)
    logits = torch.randn(truth.shape, generator=generator)
    whole = {"rgb": logits, "zero": logits, "target": truth, "fov": fov, "scene": scene}
    return logits, whole, [{name: value[i : i + 3] for name, value in whole.items()} for i in (0, 3, 6)]


def test_evaluate_thresholds_probabilities():
    """White is a probability above one half; binary maps are not changed; batches may have any size."""
    logits, whole, batches = batches_of(0)
    expected = count(logits > 0, whole["target"], whole["fov"], whole["scene"], 2)
    assert evaluate(lambda batch: batch["rgb"], batches, 2, 3) == expected
    assert evaluate(lambda batch: batch["rgb"] > 0, batches, 2, 3) == expected
    undecided = evaluate(lambda batch: torch.zeros_like(batch["target"]), batches, 2, 3)
    assert undecided.intersection.sum() == 0, "a probability of exactly one half is no detection"


def test_model_predictor():
    """A model runs in evaluation mode, without a graph, on both images."""

    class Halved(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.ones(()))
            self.dropout = nn.Dropout(0.5)

        def forward(self, rgb, zero):
            logits = self.weight * self.dropout(rgb + zero)
            assert not logits.requires_grad
            return type("Maps", (), {"zero_logits": logits})

    logits, whole, batches = batches_of(1)
    expected = count(logits > 0, whole["target"], whole["fov"], whole["scene"], 2)
    assert evaluate(model_predictor(Halved().train(), "cpu"), batches, 2, 3) == expected


def scenes_with(rng: np.random.Generator, mean: float, scenes: int = 40) -> Counts:
    """One class, unions of 1000 cells in each scene, so that IoU is the mean of independent scene scores."""
    scores = rng.normal(mean, 0.1, size=scenes).clip(0, 1)
    return Counts((1000 * scores).astype(np.int64)[:, None], np.full((scenes, 1), 1000))


def test_90_percent_intervals_cover_the_true_mean_in_90_percent_of_experiments():
    """Slightly less with few scenes."""
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(200):
        low, high = bootstrap_interval([scenes_with(rng, 0.5)], class_iou, rng, draws=300)
        assert high - low == pytest.approx(2 * 1.645 * 0.1 / np.sqrt(40), rel=0.5)
        inside += low <= 0.4995 <= high
    assert 0.82 <= inside / 200 <= 0.95


def test_difference_is_paired():
    """Two methods that differ by .02 in every scene: the sign is certain, although scenes vary far more."""
    rng = np.random.default_rng(1)
    theirs = scenes_with(rng, 0.5)
    ours = Counts(theirs.intersection + 20, theirs.union)
    mine, others = resampled_scenes([[ours], [theirs]], pixel_iou, rng, draws=300)
    assert mine - others == pytest.approx(np.full(300, 0.02))
    alone = bootstrap_interval([ours], pixel_iou, rng)
    assert alone[1] - alone[0] > 0.03


def test_seeds_are_drawn_and_averaged():
    """Seeds at .4, .5 and .6 in every scene: 1 mean of three in 27 is .4, below 5 %, 4 in 27 are .433 or less."""
    rng = np.random.default_rng(2)
    seeds = [Counts(np.full((6, 2), cells), np.full((6, 2), 1000)) for cells in (400, 500, 600)]
    low, high = bootstrap_interval(seeds, iou_per_class, rng, draws=4000)
    assert low == pytest.approx([1.3 / 3] * 2) and high == pytest.approx([1.7 / 3] * 2)  # classes keep their axis
    ((mean,), (alone,)) = (resampled_scenes([counts], class_iou, rng, 4000) for counts in (seeds, seeds[:1]))
    assert mean.mean() == pytest.approx(0.5, abs=0.003) and np.unique(alone) == pytest.approx([0.4])
    with pytest.raises(InputError, match="expected the same scenes"):
        bootstrap_interval([seeds[0], Counts.empty(3, 2)], class_iou, rng)


def test_seeds_of_two_rows_are_drawn_apart():
    """Each row's two seeds are .4 and .6: the difference is -.2, -.1, 0, .1 or .2, though both have the same seeds."""
    seeds = [Counts(np.full((6, 1), cells), np.full((6, 1), 1000)) for cells in (400, 600)]
    first, second = resampled_scenes([seeds, seeds], pixel_iou, np.random.default_rng(5), 2000)
    assert np.unique((first - second).round(3)) == pytest.approx([-0.2, -0.1, 0, 0.1, 0.2])


def test_interval_is_reproducible():
    counts = scenes_with(np.random.default_rng(3), 0.5)
    first, second = (bootstrap_interval([counts], class_iou, np.random.default_rng(4)) for _ in range(2))
    assert first == second
