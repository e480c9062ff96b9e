"""The views of several shards under one index, and their order in training."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from zerobev.common.errors import InputError
from zerobev.data.shards import Shard
from zerobev.data.views import View


class ViewSet:
    """The views of several shards under one index: the first `max_views` of each shard, or all.

    depth: replaces the views' depth, see `with_depth`
    estimates: depth beside it, see `with_estimates`
    """

    def __init__(
        self,
        shards: list[Shard],
        max_views: int | None = None,
        depth: Sequence[np.ndarray] | None = None,
        estimates: Sequence[np.ndarray] | None = None,
    ) -> None:
        self.shards = shards
        self._max_views = max_views
        self._start = np.cumsum(
            [0, *(len(shard) if max_views is None else min(len(shard), max_views) for shard in shards)]
        )
        self._depth, self._estimates = depth, estimates

    def __len__(self) -> int:
        return int(self._start[-1])

    @property
    def depth_maps(self) -> Sequence[np.ndarray]:
        """The maps of `with_depth`. Raises `InputError` if the depth is the views' own."""
        if self._depth is None:
            raise InputError("depth maps: expected views with other depth, found none")
        return self._depth

    def first(self, max_views: int | None) -> "ViewSet":
        """The first `max_views` of these views per shard, or all."""
        return ViewSet(self.shards, self._max_views if max_views is None else max_views, self._depth, self._estimates)

    def with_depth(self, maps: Sequence[np.ndarray]) -> "ViewSet":
        """The same views with other depth, for example estimated depth.

        maps: one array-like (V, H, H) per shard, planar depth in metres, float16 or float32. It is read view by view
        and may be a memory-mapped file. Arrays that do not fit the shards are an `InputError`.
        """
        expected = [len(shard) for shard in self.shards]
        found = [len(shard_maps) for shard_maps in maps]
        if found != expected:
            raise InputError(f"depth maps: expected {expected} views per shard, found {found}")
        return ViewSet(self.shards, self._max_views, maps)

    def with_estimates(self, maps: Sequence[np.ndarray]) -> "ViewSet":
        """The same views, with estimated depth beside true depth, for `estimate`; `maps` as in `with_depth`."""
        checked = self.with_depth(maps)
        return ViewSet(self.shards, self._max_views, self._depth, checked._depth)

    def estimate(self, index: int) -> np.ndarray | None:
        """(H, H) float32, estimated depth of view `index`, metres; None without estimates."""
        if self._estimates is None:
            return None
        shard, number = self.place(index)
        return np.asarray(self._estimates[shard][number], np.float32)

    def place(self, index: int) -> tuple[int, int]:
        """Number of the shard that holds view `index`, and the view's number in it."""
        shard = int(np.searchsorted(self._start, index, side="right")) - 1
        return shard, index - int(self._start[shard])

    def locate(self, index: int) -> tuple[int, View]:
        """Number of the shard that holds view `index`, and the view."""
        shard, number = self.place(index)
        view = self.shards[shard].view(number)
        if self._depth is None:
            return shard, view
        depth = np.asarray(self._depth[shard][number], np.float32)
        if depth.shape != view.depth.shape:
            raise InputError(f"depth maps: expected views of {view.depth.shape}, found {depth.shape}")
        return shard, replace(view, depth=depth)


class ViewSampler:
    """The order of views in training: a new permutation per epoch, drawn from the seed."""

    def __init__(self, views: int, seed: int) -> None:
        self._views, self._seed = views, seed
        self._epoch = -1  # of `_permutation`

    def __getitem__(self, index: int) -> int:
        """The view of sample `index`."""
        epoch, position = divmod(index, self._views)
        if self._epoch != epoch:
            self._epoch = epoch
            self._permutation = np.random.default_rng([self._seed, 0, epoch]).permutation(self._views)
        return int(self._permutation[position])
