"""A run: one row of a table with one seed, from its configuration to its record.

With several processes (`accelerate launch`), all share training and evaluation, and rank 0 writes.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from zerobev.common.keys import plain
from zerobev.config import LABELS, CameraConfig, Depth, Split, one_of
from zerobev.data.samples import (
    Augment,
    DepthProjSamples,
    ModSemSamples,
    SemanticPass,
    SemanticSamples,
    SynthSamples,
    as_float,
    collate,
    semantic_sample,
)
from zerobev.data.view_set import ViewSet
from zerobev.evaluation.evaluate import Predictor, evaluate_parts, model_predictor
from zerobev.evaluation.metrics import Counts
from zerobev.experiments import versions
from zerobev.experiments.depth_pretraining import DepthPretraining
from zerobev.experiments.gallery import gallery_indices
from zerobev.experiments.provenance import git_revision, origin, peak_memory_mb
from zerobev.experiments.records import key_of
from zerobev.experiments.registry import Experiment, experiment
from zerobev.experiments.run_records import RunRecord, RunStore
from zerobev.experiments.workspace import Workspace
from zerobev.geometry.projection import inverse_project
from zerobev.models.backbone_weights import load_backbone
from zerobev.models.base import BevModel
from zerobev.models.variants import VARIANTS, build
from zerobev.models.vpn import VPN
from zerobev.training.distributed import rank_and_world_size
from zerobev.training.history import History
from zerobev.training.loader import Batch, Source, batches
from zerobev.training.monitor import maps_figure
from zerobev.training.train import dice_objective, train

#: Seeds of the reference runs; only the first is computed if it is missing.
SEEDS = (0, 1, 2)
VALIDATION_BATCHES = 4
_EVALUATION_BATCH = 16


@dataclass(frozen=True)
class Run:
    """An experiment on the data of a workspace with one seed."""

    experiment: Experiment
    workspace: Workspace
    seed: int = 0

    @cached_property
    def config(self) -> dict[str, Any]:
        """Everything that the result depends on; entries may be dataclasses."""
        wanted, workspace, scale = self.experiment, self.workspace, self.workspace.scale
        config: dict[str, Any] = {"experiment": wanted, "seed": self.seed, "data": workspace.data_config}
        config |= {"recipe": versions.RECIPE, "test_views": scale.test_views}
        if wanted.network is not None or wanted.test_depth == "estimated":
            config["depth"] = self.pretraining.key
        if wanted.network is not None:
            config |= {"model": wanted.model(scale), "backbone": self.backbone, "train": scale.train}
            config |= {"texture": workspace.texture_config(wanted.texture(scale))}
            config |= {"empty_fraction": wanted.empty_fraction(scale)}
            config |= {"extruded_fraction": wanted.extruded_fraction(scale), "augment": scale.augment}
            if scale.objects_fraction and wanted.stream == "synth":
                config |= {"objects_fraction": scale.objects_fraction}
            if self.start is not None:
                config |= {"mixed_depth": versions.MIXED_DEPTH, "start": self.start.key}
        return config

    @property
    def name(self) -> str:
        """Row and seed."""
        return f"{self.experiment.row} seed {self.seed}"

    @cached_property
    def key(self) -> str:
        """Row, seed, and fingerprint of the configuration."""
        return key_of(f"{self.experiment.row}-seed{self.seed}", self.config)

    @property
    def store(self) -> RunStore:
        """The records of the workspace's report."""
        return RunStore(self.workspace.reports)

    @property
    def folder(self) -> Path:
        """Folder of checkpoint, logs and weights."""
        return self.workspace.runs / self.key

    @property
    def weights(self) -> Path:
        """File of the trained network; missing until it is trained on this machine."""
        return self.folder / "model.safetensors"

    @cached_property
    def pretraining(self) -> DepthPretraining:
        """The workspace's depth estimator."""
        return DepthPretraining(self.workspace)

    @property
    def backbone(self) -> str:
        """Source of the initial weights of the RGB backbone; "" is the depth estimator."""
        scale = self.workspace.scale
        is_vpn = self.experiment.network is not None and VARIANTS[self.experiment.network][0] is VPN
        return scale.vpn_backbone if is_vpn else scale.backbone

    @cached_property
    def start(self) -> "Run | None":
        """The run whose weights this one starts from; None: the weights are drawn, apart from the RGB backbone's.

        Residual networks of mixed depth start from (c): without depth they are then as good as it is.
        """
        if self.experiment.network is None or not (self.workspace.scale.mixed_depth and self.experiment.reads_depth):
            return None
        return Run(experiment("c"), self.workspace, self.seed)

    def recorded(self) -> RunRecord | None:
        """Its record; None if it has to be computed."""
        return self.store.find(self.key, self.config)

    def record(self) -> RunRecord:
        """Its record: read, or computed now.

        An interrupted computation continues from its checkpoint. Training uses the training and validation scenes; the
        weights with the best validation score are evaluated once on the test scenes.
        """
        return self.recorded() or self.compute(self.store)

    def compute(self, store: RunStore) -> RunRecord:
        """Train, evaluate and write the record into `store`, even if it exists.

        Raises `InputError` if another process computes this run.
        """
        with self.workspace.alone(self.key):
            return self._compute(store)

    def _compute(self, store: RunStore) -> RunRecord:
        revision = git_revision()  # of the running code, before later commits
        camera = self.workspace.scale.camera
        history: History | None = None
        if self.experiment.network is None:
            predict, device = _projection(camera), "cpu"
        else:
            model, history = self.train()
            device = next(model.parameters()).device.type
            predict = model_predictor(model, device)
        estimated = self.experiment.reads_depth and self.experiment.test_depth == "estimated"
        test = self.views("test", "estimated" if estimated else "true")
        trained = time.monotonic()
        chosen = test.first(self.workspace.scale.test_views)
        passed = SemanticPass(chosen, camera, _EVALUATION_BATCH, self.workspace.visibility("test"))
        rank, world_size = rank_and_world_size()
        drawn = batches(passed, range(rank, len(passed), world_size), torch.device(device))
        parts = evaluate_parts(predict, drawn, len(test.shards), len(LABELS))
        counts = sum((part.iou for part in parts.values()), Counts.empty(len(test.shards), len(LABELS)))
        cost = {
            "train_seconds": round(history.seconds if history else 0.0, 1),
            "evaluate_seconds": round(time.monotonic() - trained, 1),
            "peak_memory_mb": peak_memory_mb(),
        }
        result = {
            "scenes": [shard.scene for shard in test.shards],
            "counts": counts.to_json(),
            "parts": {
                name: {"iou": part.iou.to_json(), "recall": part.recall.to_json()} for name, part in parts.items()
            },
            "history": history.curves() if history else {},
        }
        record = RunRecord(self.key, plain(self.config), origin(device, revision), cost, result)
        if rank > 0:
            return record
        batch = as_float(collate([semantic_sample(test, i, camera) for i in gallery_indices(test)]))
        with torch.inference_mode():
            maps = predict(batch).cpu()
        store.write(record, ((maps if maps.dtype == torch.bool else maps > 0) & (batch["fov"] > 0.5)).numpy())
        # the record is complete: a later computation starts from the first step
        (self.folder / "checkpoint.pt").unlink(missing_ok=True)
        return record

    def train(self) -> tuple[BevModel, History]:
        """The network with its best weights, and its training history; the network is also written to `weights`.

        The RGB backbone starts from pretrained weights, the rest from the seed or from `start`. Validation uses the
        stream of training, the depth of the last stage and a fixed seed, so that scores of runs are comparable.
        """
        wanted, scale, config = self.experiment, self.workspace.scale, self.workspace.scale.train
        assert wanted.network is not None  # P^-1 is not trained
        torch.manual_seed(self.seed)
        model = build(wanted.network, scale.camera, wanted.model(scale))
        load_backbone(model.backbone, self.backbone or self.pretraining.weights)
        if self.start is not None:
            model.load_common(self.start.trained())
        data = InTurn([self.source("train", depth, self.seed) for depth in wanted.stages(scale)], config.steps)
        held_out = self.source("validation", wanted.stages(scale)[-1], seed=0)
        validation = [held_out.batch(step) for step in range(VALIDATION_BATCHES)]
        objective = dice_objective(config.alpha, model.config.aux)
        history = train(
            model,
            data,
            validation,
            config,
            self.folder,
            self.seed,
            key=self.key,
            objective=objective,
            picture=maps_figure,
        )
        if rank_and_world_size()[0] == 0:
            model.save(self.weights)
        return model, history

    def trained(self) -> Path:
        """`weights`, after a training if the file is missing.

        Raises `InputError` if another process computes this run.
        """
        if not self.weights.exists():
            with self.workspace.alone(self.key):
                self.train()
        return self.weights

    def source(self, split: Split, depth: Depth, seed: int) -> Source:
        """Training samples of a split."""
        wanted, workspace, scale = self.experiment, self.workspace, self.workspace.scale
        views = self.views(split, depth)
        augment = workspace.augmentation if split == "train" else None
        common = (scale.camera, seed, scale.train.batch, wanted.empty_fraction(scale), augment)
        if wanted.stream == "synth":
            bank = workspace.bank(wanted.texture(scale))
            return SynthSamples(
                views, bank, *common, wanted.fresh, wanted.extruded_fraction(scale), scale.objects_fraction
            )
        kinds: dict[str, Callable[[ViewSet, CameraConfig, int, int, float, Augment | None], Source]]
        kinds = {"modsem": ModSemSamples, "depthproj": DepthProjSamples, "classes": SemanticSamples}
        return kinds[wanted.stream](views, *common)

    def views(self, split: Split, depth: Depth) -> ViewSet:
        """The views of a split with true or estimated depth, or with both, to be mixed."""
        one_of("depth", depth, Depth)
        if depth == "mixed":
            return self.pretraining.mixed_views(split)
        return self.workspace.views(split) if depth == "true" else self.pretraining.views(split)


def recorded(rows: Iterable[str], workspace: Workspace) -> list[RunRecord]:
    """The existing records of rows, with all seeds of `SEEDS`; nothing is computed."""
    runs = [Run(experiment(row), workspace, seed) for row in dict.fromkeys(rows) for seed in SEEDS]
    return [record for record in (run.recorded() for run in runs) if record is not None]


def records_of(rows: Iterable[str], workspace: Workspace) -> list[RunRecord]:
    """As `recorded`, after the first seed of each row is computed if it is missing."""
    rows = list(rows)
    for row in rows:
        Run(experiment(row), workspace, SEEDS[0]).record()
    return recorded(rows, workspace)


class InTurn:
    """Training data in stages, one after the other, with the same number of steps each."""

    def __init__(self, stages: list[Source], steps: int) -> None:
        self._stages, self._steps = stages, steps

    def batch(self, step: int, rank: int = 0, world_size: int = 1) -> Batch:
        """The batch of a step, from the stage of that step."""
        stage = self._stages[min(step * len(self._stages) // self._steps, len(self._stages) - 1)]
        return stage.batch(step, rank, world_size)


def _projection(camera: CameraConfig) -> Predictor:
    """P^-1 with the depth of the batch, rows (a)."""
    return lambda batch: inverse_project(batch["zero"], batch["depth"], camera, batch.get("height")) > 0
