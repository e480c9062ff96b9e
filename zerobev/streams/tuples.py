"""Views -> tuples (I_rgb, I_zero, M_zero, M_aux): the streams that networks are trained and tested on.

Batches are dicts of float32 tensors (B samples, K modalities, H pixels and M cells a side):
`rgb` (B, 3, H, H) in [0, 1]; `zero` (B, K, H, H) and `target` (B, K, M, M) in {0, 1}; `aux` (B, 2, M, M)
obstacles and navigable space; `fov` (B, 1, M, M) mask; `depth` (B, 1, H, H) metres; and `scene` (B,) int64.
"""

from collections.abc import Iterator

import numpy as np
import torch

from zerobev.config import LABELS, CameraConfig
from zerobev.streams.shards import Shard
from zerobev.streams.textures import TextureBank
from zerobev.streams.views import View

Sample = dict[str, np.ndarray]


class ViewSet:
    """The views of several shards under one index."""

    def __init__(self, shards: list[Shard]) -> None:
        self.shards = shards
        self._start = np.cumsum([0, *(len(shard) for shard in shards)])

    def __len__(self) -> int:
        return int(self._start[-1])

    def locate(self, index: int) -> tuple[int, View]:
        """Number of the shard that holds view `index`, and the view."""
        shard = int(np.searchsorted(self._start, index, side="right")) - 1
        return shard, self.shards[shard].view(index - int(self._start[shard]))


class SynthTuples:
    """Endless training tuples with a fresh *Synth* texture for every sample (paper, Section 3.2).

    Sample i is a function of (seed, i) alone: training may stop at any step and go on, or be spread over
    processes, and sees the same data. Each pass over the views is in a new random order.
    """

    def __init__(self, views: ViewSet, bank: TextureBank, camera: CameraConfig, seed: int, batch: int) -> None:
        self._views = views
        self._bank = bank
        self._camera = camera
        self._seed = seed
        self._batch = batch
        self._epoch = -1

    def batch(self, step: int, rank: int = 0, ranks: int = 1) -> dict[str, torch.Tensor]:
        """The batch of a training step; with several ranks each gets every `ranks`-th sample of it."""
        first = step * self._batch
        return collate([self.sample(i) for i in range(first + rank, first + self._batch, ranks)])

    def sample(self, index: int) -> Sample:
        """Tuple number `index`."""
        epoch, position = divmod(index, len(self._views))
        shard, view = self._views.locate(int(self._order(epoch)[position]))
        draw = self._bank.draw(np.random.default_rng([self._seed, 1, index]), self._views.shards[shard].charts)
        zero = self._bank.look_up(view.fpv_texel, draw)
        target = self._bank.look_up(view.bev_texel, draw)
        return view_sample(view, self._camera, shard, zero[None], target[None])


    def _order(self, epoch: int) -> np.ndarray:
        """The order of the views in a pass over them; kept until another pass is asked for."""
        if self._epoch != epoch:
            self._epoch = epoch
            self._permutation = np.random.default_rng([self._seed, 0, epoch]).permutation(len(self._views))
        return self._permutation


def semantic_batches(views: ViewSet, camera: CameraConfig, batch: int) -> Iterator[dict[str, torch.Tensor]]:
    """All views once, in order, with the eight classes as modalities (K = 8, in the order of `LABELS`)."""
    for first in range(0, len(views), batch):
        yield collate([semantic_sample(views, i, camera) for i in range(first, min(first + batch, len(views)))])


def semantic_sample(views: ViewSet, index: int, camera: CameraConfig) -> Sample:
    """View number `index` with the masks of the eight classes in FPV and in BEV."""
    shard, view = views.locate(index)
    label = views.shards[shard].instance_label
    classes = np.arange(len(LABELS))[:, None, None]
    return view_sample(view, camera, shard, label[view.fpv_instance] == classes, label[view.bev_instance] == classes)


def view_sample(view: View, camera: CameraConfig, scene: int, zero: np.ndarray, target: np.ndarray) -> Sample:
    """What every stream takes from a view, around the modality images `zero` (K, H, H) and `target` (K, M, M)."""
    surface = view.bev_texel[..., 0] >= 0
    obstacle = surface & (view.bev_height > camera.obstacle_m)
    return {
        "rgb": np.moveaxis(view.rgb, -1, 0).astype(np.float32) / 255,
        "depth": view.depth[None].astype(np.float32),
        "zero": zero.astype(np.float32),
        "target": target.astype(np.float32),
        "aux": np.stack([obstacle, surface & ~obstacle]).astype(np.float32),
        "fov": view.fov[None].astype(np.float32),
        "scene": np.int64(scene),
    }


def collate(samples: list[Sample]) -> dict[str, torch.Tensor]:
    """Stack samples into a batch."""
    return {name: torch.from_numpy(np.stack([sample[name] for sample in samples])) for name in samples[0]}
