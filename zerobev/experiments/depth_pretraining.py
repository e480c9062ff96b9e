"""The depth estimator of a scale: trained once, recorded, and used by every learned method.

It serves twice. Its depth is that of the projection (a.2) and of the residual models; and the weights of its RGB
backbone are where the backbone of every learned method starts, in place of ImageNet's.
"""

import json
import shutil
import time
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from zerobev.common.errors import InputError
from zerobev.common.storage import replacing, write_json
from zerobev.data.samples import ViewSet
from zerobev.experiments.records import git_revision, is_fresh, origin, peak_memory_mb
from zerobev.experiments.workspace import Workspace, fingerprint
from zerobev.models.depth import DepthNet
from zerobev.training.depth import depth_errors, predict_depth, train_depth
from zerobev.training.distributed import rank_and_world_size

#: Raised by hand whenever depth training changes what it computes.
DEPTH_VERSION = 1

#: What the network is made of, among the fields of `ModelConfig`.
_FIELDS = ("width", "block", "depths", "channels", "stem_channels", "stem_stride")

_SEED = 0  # one estimator serves all seeds of all runs


class DepthPretraining:
    """The depth estimator of a workspace, read where it is recorded, else trained and kept.

    Its record `reports/<scale>/depth.json` (key, configuration, errors on the test views, cost) and its weights beside
    it are committed, so that nobody has to train it again; training that was killed goes on where it was.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._weights = workspace.reports / "depth.safetensors"
        scale = workspace.scale
        self.config: dict[str, Any] = {
            "version": DEPTH_VERSION,
            "data": workspace.identity,
            "model": {name: getattr(scale.model, name) for name in _FIELDS},
            "train": asdict(scale.depth),
        }

    @property
    def key(self) -> str:
        """Name of the run: the fingerprint of all it depends on is part of it."""
        return f"depth-seed{_SEED}-{fingerprint(self.config)}"

    @property
    def weights(self) -> Path:
        """The file of its weights, trained now if it is not there."""
        _ = self.record  # made now if there is none
        return self._weights

    @cached_property
    def record(self) -> dict[str, Any]:
        """What the run measured: `mad_m` and `relative` errors on the test views, cost, origin, training curves."""
        path = self._workspace.reports / "depth.json"
        if path.exists() and self._weights.exists() and is_fresh(path):
            try:
                found = json.loads(path.read_text())
                if found["key"] == self.key:
                    return found
            except (ValueError, KeyError, TypeError) as error:
                raise InputError(f"{path}: expected the record of a depth estimator, found {error}") from None
        record = self._compute()
        if rank_and_world_size()[0] == 0:
            write_json(path, record)
        return record

    @cached_property
    def estimator(self) -> DepthNet:
        """The trained network, on the CPU, in evaluation mode."""
        return DepthNet.load(self.weights)

    def views(self, part: str) -> ViewSet:
        """The views of a split with predicted depth in place of the true one; it is predicted once and kept."""
        views = self._workspace.views(part)
        folder = self._workspace.cache / self.key / part
        paths = [folder / f"{shard.path.stem}.npy" for shard in views.shards]
        for path, shard in zip(paths, views.shards):
            if not path.exists():
                (maps,) = predict_depth(self.estimator, ViewSet([shard]))
                with replacing(path) as temporary, temporary.open("wb") as file:
                    np.save(file, maps)
        return views.with_depth([np.load(path, mmap_mode="r") for path in paths])

    def _compute(self) -> dict[str, Any]:
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
        )
        trained = time.monotonic()
        device = next(network.parameters()).device.type
        errors = depth_errors(network, workspace.views("test"), device)
        if rank_and_world_size()[0] == 0:  # of several processes
            network.cpu().save(self._weights)
        shutil.rmtree(workspace.cache / self.key, ignore_errors=True)  # depth that earlier weights predicted
        (workspace.runs / self.key / "checkpoint.pt").unlink(missing_ok=True)
        return {
            "key": self.key,
            "config": self.config,
            "origin": origin(device, revision),
            "cost": {
                "train_seconds": round(history.seconds, 1),
                "evaluate_seconds": round(time.monotonic() - trained, 1),
                "peak_memory_mb": peak_memory_mb(),
            },
            "errors": {name: round(value, 4) for name, value in asdict(errors).items()},
            "history": history.curves(),
        }
