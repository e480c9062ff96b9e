"""The depth estimator of a scale: trained once, recorded, and used by every learned method.

The projection (a.2) and the residual models read its depth. Every learned method starts from the weights of its RGB
backbone, in place of ImageNet's.
"""

import shutil
import time
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from zerobev.common.keys import plain
from zerobev.common.storage import replacing
from zerobev.config import Split
from zerobev.data.view_set import ViewSet
from zerobev.experiments import versions
from zerobev.experiments.provenance import git_revision, origin, peak_memory_mb
from zerobev.experiments.records import Record, find, key_of, write
from zerobev.experiments.workspace import Workspace
from zerobev.models.depth import DepthNet
from zerobev.training.depth import depth_errors, depth_objective, predict_depth, relative_depth_objective, train_depth
from zerobev.training.distributed import rank_and_world_size

#: The fields of `ModelConfig` that the network depends on.
_FIELDS = ("width", "block", "depths", "channels", "stem_channels", "stem_stride")
#: Further such fields, recorded where they differ from their defaults.
_LATER_FIELDS = ("floor_depth", "own_rays")

_SEED = 0  # one estimator serves all seeds of all runs


class DepthPretraining:
    """The depth estimator of a workspace: read if it is recorded, else trained and recorded.

    Its record `reports/<scale>/depth.json` and the weights beside it are committed. With settings that change the
    estimator, both go to the cache, and the committed files stay as they are.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        scale = workspace.scale
        self.config: dict[str, Any] = {
            "version": versions.DEPTH,
            "data": workspace.data_config,
            "model": {name: getattr(scale.model, name) for name in _FIELDS}
            | {name: getattr(scale.model, name) for name in _LATER_FIELDS if getattr(scale.model, name)},
            "train": scale.depth,
            "augment": scale.augment,
        } | ({"relative_depth": True} if scale.relative_depth else {})
        #: name of the run, with the fingerprint of its configuration
        self.key = key_of(f"depth-seed{_SEED}", self.config)
        self._folder = workspace.reports
        if workspace.has_settings and self.key != DepthPretraining(workspace.without_settings()).key:
            self._folder = workspace.runs / self.key

    @property
    def path(self) -> Path:
        """The file of its record."""
        return self._folder / "depth.json"

    @property
    def _weights(self) -> Path:
        return self._folder / "depth.safetensors"

    @property
    def weights(self) -> Path:
        """The file of its weights; the network is trained now if the file is missing."""
        _ = self.record
        return self._weights

    def recorded(self) -> Record | None:
        """Its record; None if the record or the weights are missing."""
        return find(self.path, self.key, self.config) if self._weights.exists() else None

    @cached_property
    def record(self) -> Record:
        """Its record. Result: errors `mad_m` and `relative` on the test views, and the training curves.

        Raises `InputError` if another process trains the estimator.
        """
        record = self.recorded()
        if record is None:
            with self._workspace.alone(self.key):
                record = self._compute()
                if rank_and_world_size()[0] == 0:
                    write(self.path, record)
        return record

    @cached_property
    def estimator(self) -> DepthNet:
        """The trained network, on the CPU, in evaluation mode."""
        return DepthNet.load(self.weights)

    def views(self, split: Split) -> ViewSet:
        """The views of a split, with estimated depth in place of true depth; estimates are cached."""
        views = self._workspace.views(split)
        folder = self._workspace.cache / self.key / split
        paths = [folder / f"{shard.path.stem}.npy" for shard in views.shards]
        for path, shard in zip(paths, views.shards):
            if not path.exists():
                (maps,) = predict_depth(self.estimator, ViewSet([shard]))
                with replacing(path) as temporary, temporary.open("wb") as file:
                    np.save(file, maps)
        return views.with_depth([np.load(path, mmap_mode="r") for path in paths])

    def mixed_views(self, split: Split) -> ViewSet:
        """The views of a split with true depth, and estimated depth beside it."""
        estimated = self.views(split)
        return self._workspace.views(split).with_estimates(estimated.depth_maps)

    def _compute(self) -> Record:
        workspace, scale = self._workspace, self._workspace.scale
        revision = git_revision()
        torch.manual_seed(_SEED)
        network = DepthNet(scale.camera, scale.model)
        history = train_depth(
            network,
            workspace.views("train"),
            workspace.views("validation"),
            scale.depth,
            workspace.runs / self.key,
            _SEED,
            key=self.key,
            augment=workspace.augmentation,
            objective=relative_depth_objective if scale.relative_depth else depth_objective,
        )
        trained = time.monotonic()
        device = next(network.parameters()).device.type
        errors = depth_errors(network, workspace.views("test"), device)
        if rank_and_world_size()[0] == 0:
            network.cpu().save(self._weights)
        shutil.rmtree(workspace.cache / self.key, ignore_errors=True)  # estimates of earlier weights
        (workspace.runs / self.key / "checkpoint.pt").unlink(missing_ok=True)
        cost = {
            "train_seconds": round(history.seconds, 1),
            "evaluate_seconds": round(time.monotonic() - trained, 1),
            "peak_memory_mb": peak_memory_mb(),
        }
        result = {
            "errors": {name: round(value, 4) for name, value in asdict(errors).items()},
            "history": history.curves(),
        }
        return Record(self.key, plain(self.config), origin(device, revision), cost, result)
