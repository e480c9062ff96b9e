"""Which runs the tables need, as data, and the one way to get a run's record: read it, or compute it."""

import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from zerobev.config import LABELS
from zerobev.learning.evaluate import Projector, evaluate, model_projector
from zerobev.learning.train import History, train
from zerobev.models.zero_bev import ZeroBEV
from zerobev.records import Record, RecordStore, git_revision, origin, peak_memory_mb
from zerobev.streams.projection import project
from zerobev.streams.tuples import SynthTuples, ViewSet, collate, semantic_batches, semantic_sample
from zerobev.workspace import Workspace, fingerprint

#: Raised by hand whenever training or evaluation change what they compute: older records are then left aside.
RECIPE_VERSION = 1

GALLERY_VIEWS = 8
VALIDATION_BATCHES = 4
_EVALUATION_BATCH = 16


@dataclass(frozen=True)
class Experiment:
    """One row of a table."""

    row: str  #: the paper's letter
    method: str  #: "projection" (P^-1 with GT depth) or "zero_bev"


#: The rows of Table 1 that are built.
TABLE_1 = (Experiment("a.1", "projection"), Experiment("c", "zero_bev"))


def run(experiment: Experiment, workspace: Workspace, seed: int = 0) -> Record:
    """The record of an experiment: read where there is one, else computed and kept.

    A computation that was killed goes on where it was. Training takes the training and validation scenes;
    the test scenes are touched once, by the weights that validated best.
    """
    store = RecordStore(workspace.reports)
    return store.find(run_key(experiment, workspace, seed)) or compute(experiment, workspace, seed, store)


def run_key(experiment: Experiment, workspace: Workspace, seed: int) -> str:
    """Name of a run: row, seed, and the fingerprint of all it depends on."""
    return f"{experiment.row}-seed{seed}-{fingerprint(_config(experiment, workspace))}"


def _config(experiment: Experiment, workspace: Workspace) -> dict[str, Any]:
    config = {"experiment": asdict(experiment), "data": workspace.identity, "recipe": RECIPE_VERSION}
    if experiment.method == "zero_bev":
        scale = workspace.scale
        config |= {"model": asdict(scale.model), "train": asdict(scale.train), "texture": workspace.texture_identity}
    return config


def compute(experiment: Experiment, workspace: Workspace, seed: int, store: RecordStore) -> Record:
    """Train, evaluate and keep the record in `store`, whether there is one or not."""
    key = run_key(experiment, workspace, seed)
    revision = git_revision()  # of the code that is at work now, whatever is committed in the meantime
    test = workspace.views("test")
    history: History | None = None
    if experiment.method == "projection":
        projector: Projector = _gt_projector(workspace)
        device = "cpu"
    else:
        model, history = _train(workspace, seed, key)
        device = next(model.parameters()).device.type
        projector = model_projector(model, device)
    trained = time.monotonic()
    counts = evaluate(
        projector, semantic_batches(test, workspace.scale.camera, _EVALUATION_BATCH), len(test.shards), len(LABELS)
    )
    record = Record(
        key=key,
        row=experiment.row,
        seed=seed,
        config=_config(experiment, workspace),
        origin=origin(device, revision),
        cost={
            "train_seconds": round(history.seconds if history else 0.0, 1),
            "evaluate_seconds": round(time.monotonic() - trained, 1),
            "peak_memory_mb": peak_memory_mb(),
        },
        scenes=[shard.scene for shard in test.shards],
        counts=counts,
        history=_curves(history),
    )
    store.write(record, _gallery_maps(projector, test, workspace))
    # the record is complete: a later call for a fresh one starts from the first step
    (workspace.runs / key / "checkpoint.pt").unlink(missing_ok=True)
    return record


def _gt_projector(workspace: Workspace) -> Projector:
    """Row (a.1): P^-1 with the simulator's depth."""
    return lambda batch: project(batch["zero"], batch["depth"], workspace.scale.camera) > 0


def _train(workspace: Workspace, seed: int, key: str) -> tuple[ZeroBEV, History]:
    """A model with its best weights; also written to the run's folder as `model.safetensors`."""
    scale = workspace.scale
    torch.manual_seed(seed)
    model = ZeroBEV(scale.camera, scale.model)
    folder = workspace.runs / key
    bank = workspace.bank()
    data = SynthTuples(workspace.views("train"), bank, scale.camera, seed, scale.train.batch)
    # one fixed seed for all runs: their validation scores are then comparable
    held_out = SynthTuples(workspace.views("validation"), bank, scale.camera, 0, scale.train.batch)
    validation = [held_out.batch(step) for step in range(VALIDATION_BATCHES)]
    history = train(model, data, validation, scale.train, folder, seed, key=key)
    model.save(folder / "model.safetensors")
    return model, history


def _curves(history: History | None) -> dict[str, list[float]]:
    """Columns of the history, thinned to about a hundred entries beside those at validations."""
    if history is None:
        return {}
    stride = max(len(history.entries) // 100, 1)
    kept = [entry for i, entry in enumerate(history.entries) if i % stride == 0 or entry.validation is not None]
    return {name: [asdict(entry)[name] for entry in kept] for name in ("step", "loss", "main", "aux", "validation")}


def gallery(workspace: Workspace) -> dict[str, np.ndarray]:
    """Inputs and truth of the views that every record keeps its predictions for, spread evenly over the test views.

    rgb (N, H, H, 3) uint8; fpv_label (N, H, H) and bev_label (N, M, M) int8; fov (N, M, M) bool.
    """
    store = RecordStore(workspace.reports)
    name = f"views-{fingerprint(workspace.identity)}"
    if (found := store.gallery(name)) is None:
        views = workspace.views("test")
        located = [views.locate(i) for i in gallery_indices(views)]
        labels = [views.shards[shard].instance_label for shard, _ in located]
        store.write_gallery(
            name,
            rgb=np.stack([view.rgb for _, view in located]),
            fpv_label=np.stack([label[view.fpv_instance] for label, (_, view) in zip(labels, located)]),
            bev_label=np.stack([label[view.bev_instance] for label, (_, view) in zip(labels, located)]),
            fov=np.stack([view.fov for _, view in located]),
        )
        found = store.gallery(name)
    return found


def gallery_indices(views: ViewSet) -> list[int]:
    """Indices of the gallery's views."""
    return np.linspace(0, len(views) - 1, min(GALLERY_VIEWS, len(views))).round().astype(int).tolist()


def _gallery_maps(projector: Projector, test: ViewSet, workspace: Workspace) -> np.ndarray:
    batch = collate([semantic_sample(test, i, workspace.scale.camera) for i in gallery_indices(test)])
    with torch.inference_mode():
        maps = projector(batch).cpu()
    inside = batch["fov"] > 0.5
    return ((maps if maps.dtype == torch.bool else maps > 0) & inside).numpy()
