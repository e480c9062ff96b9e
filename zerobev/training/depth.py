"""Training, evaluation and use of depth estimators (paper, supplement, "Finetuning monocular depth estimation").

The paper's objective is the mean absolute difference in metres, for our own network and for fine-tuning. The relative
one weights near surfaces more.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from zerobev.config import TrainConfig
from zerobev.data.samples import Augment, Sample, as_float
from zerobev.data.view_set import ViewSampler, ViewSet
from zerobev.models.depth import DepthEstimator, estimate
from zerobev.training.history import History
from zerobev.training.loader import Batch
from zerobev.training.losses import Losses
from zerobev.training.train import Objective, train

_BATCH = 32  # images per forward pass
_NEAREST_M = 0.5  # nearer surfaces have the weight of this distance in the relative objective
#: Image (H, W, 3) uint8, depth (H, W) float32, metres, and height of the camera, metres, if it differs between views.
_Pair = tuple[np.ndarray, np.ndarray, float | None]


class DepthSamples:
    """Endless pairs of image and depth, half of them mirrored; each pass over the views has a new random order.

    Sample i is a function of (seed, i) alone.
    augment: changes each sample at random
    """

    def __init__(self, views: ViewSet, seed: int, batch: int, augment: Augment | None = None) -> None:
        self._views, self._seed, self._batch, self._augment = views, seed, batch, augment
        self._order = ViewSampler(len(views), seed)

    def batch(self, step: int, rank: int = 0, world_size: int = 1) -> dict[str, Tensor]:
        """`rgb` (B, 3, H, W) uint8 and `depth` (B, 1, H, W) float32, metres; see `training.loader.Source`.

        If views are from different heights, also `height` (B,) float32, metres.
        """
        first = step * self._batch
        return _collated([self.sample(i) for i in range(first + rank, first + self._batch, world_size)])

    def sample(self, index: int) -> _Pair:
        """Image, depth and height."""
        scene, view = self._views.locate(self._order[index])
        rng = np.random.default_rng([self._seed, 1, index])
        rgb, depth = view.rgb, view.depth
        mirrored = rng.random() < 0.5
        if self._augment:
            sample: Sample = {"rgb": np.moveaxis(rgb, -1, 0), "depth": depth[None]}
            sample = self._augment(sample, view, self._views.shards[scene].charts, rng)
            rgb, depth = np.moveaxis(np.asarray(sample["rgb"]), 0, -1), np.asarray(sample["depth"])[0]
        return (rgb[:, ::-1], depth[:, ::-1], view.height_m) if mirrored else (rgb, depth, view.height_m)


def depth_objective(model: nn.Module, batch: Batch) -> Losses:
    """Mean absolute difference over the pixels with known depth (above 0), metres."""
    return _mean_error(model, batch, torch.ones_like)


def relative_depth_objective(model: nn.Module, batch: Batch) -> Losses:
    """Mean relative difference over the pixels with known depth (not in the paper); at most twice that in metres."""
    return _mean_error(model, batch, lambda depth: 1 / depth.clamp(min=_NEAREST_M))


def _mean_error(model: nn.Module, batch: Batch, weight: Callable[[Tensor], Tensor]) -> Losses:
    """Mean of the absolute differences times a weight that depends on true depth."""
    valid = batch["depth"] > 0
    heights = (batch["height"],) if "height" in batch else ()
    error = (model(batch["rgb"], *heights).float() - batch["depth"]).abs() * weight(batch["depth"])
    loss = torch.where(valid, error, 0).sum() / valid.sum().clamp(min=1)
    return Losses(loss, loss)


def train_depth(
    model: nn.Module,
    views: ViewSet,
    validation: ViewSet,
    config: TrainConfig,
    folder: Path,
    seed: int,
    *,
    key: str,
    augment: Augment | None = None,
    objective: Objective = depth_objective,
    device: torch.device | str | None = None,
) -> History:
    """Train a `DepthEstimator` in place, to the weights with the best validation score (see `training.train`).

    augment: changes each training sample at random
    objective: `depth_objective` or `relative_depth_objective`; the score is its mean over `validation`
    validation: all its views, unmirrored
    """
    held_out = [_views_batch(validation, first) for first in range(0, len(validation), _BATCH)]
    data = DepthSamples(views, seed, config.batch, augment)
    return train(model, data, held_out, config, folder, seed, key=key, objective=objective, device=device)


@dataclass(frozen=True)
class DepthErrors:
    """Means over all pixels with known depth."""

    mad_m: float  #: mean absolute difference, metres
    relative: float  #: mean of absolute difference over true depth


def depth_errors(estimator: DepthEstimator, views: ViewSet, device: torch.device | str = "cpu") -> DepthErrors:
    """Depth errors on `views`, the two that the paper states for its estimator."""
    absolute = relative = pixels = 0.0
    for shard in views.shards:
        (predicted,) = predict_depth(estimator, ViewSet([shard]), device)
        for i, maps in enumerate(predicted):
            depth = shard.view(i).depth
            truth = depth[depth > 0].astype(np.float64)
            error = np.abs(maps[depth > 0] - truth)
            absolute, relative, pixels = absolute + error.sum(), relative + (error / truth).sum(), pixels + len(truth)
    return DepthErrors(absolute / pixels, relative / pixels)


@torch.inference_mode()
def predict_depth(estimator: DepthEstimator, views: ViewSet, device: torch.device | str = "cpu") -> list[np.ndarray]:
    """Estimated depth of all views: one (V, H, W) float16 array per shard, metres, for `ViewSet.with_depth`.

    The estimator is moved to `device` and put into evaluation mode; it computes in float32.
    """
    estimator = estimator.to(device).eval()
    maps = []
    for first in range(0, len(views), _BATCH):
        batch = {name: value.to(device) for name, value in _views_batch(views, first).items()}
        maps.append(estimate(estimator, batch["rgb"], batch.get("height"))[:, 0].half().cpu().numpy())
    ends = np.cumsum([len(shard) for shard in views.shards])
    return np.split(np.concatenate(maps), ends[:-1])


def _views_batch(views: ViewSet, first: int) -> dict[str, Tensor]:
    return as_float(_collated([_pair(views, i) for i in range(first, min(first + _BATCH, len(views)))]))


def _pair(views: ViewSet, index: int) -> _Pair:
    view = views.locate(index)[1]
    return view.rgb, view.depth, view.height_m


def _collated(pairs: list[_Pair]) -> dict[str, Tensor]:
    rgb, depth = np.stack([pair[0] for pair in pairs]), np.stack([pair[1] for pair in pairs])
    heights = [height for _, _, height in pairs if height is not None]
    return ({"height": torch.tensor(heights, dtype=torch.float32)} if heights else {}) | {
        "rgb": torch.from_numpy(np.ascontiguousarray(np.moveaxis(rgb, -1, 1))),
        "depth": torch.from_numpy(depth[:, None].astype(np.float32)),
    }
