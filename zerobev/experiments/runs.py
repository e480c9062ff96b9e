"""The one way to get a run's record: read it, or compute it.

Under `accelerate launch` the processes share training and evaluation, and the first one writes.
"""

import argparse
import contextlib
import fcntl
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from accelerate import PartialState

from zerobev.common.errors import run_command
from zerobev.common.parallel import cluster
from zerobev.config import LABELS, SCALES, CameraConfig, Scale
from zerobev.data.samples import (
    DepthProjSamples,
    ModSemSamples,
    SemanticPass,
    SemanticSamples,
    SynthSamples,
    ViewSet,
    collate,
    semantic_sample,
)
from zerobev.evaluation.evaluate import Predictor, evaluate, model_predictor
from zerobev.experiments.depth_pretraining import DepthPretraining
from zerobev.experiments.gallery import gallery_indices
from zerobev.experiments.records import Record, RecordStore, git_revision, origin, peak_memory_mb
from zerobev.experiments.registry import EXPERIMENTS, Experiment, experiment
from zerobev.experiments.workspace import ROOT, Workspace, fingerprint
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

#: Raised by hand whenever training or evaluation change what they compute: older records are then left aside.
RECIPE_VERSION = 4

#: Of the reference runs; the first one is computed where it is missing.
SEEDS = (0, 1, 2)
VALIDATION_BATCHES = 4
_EVALUATION_BATCH = 16


def run(experiment: Experiment, workspace: Workspace, seed: int = 0) -> Record:
    """The record of an experiment: read where there is one, else computed and kept.

    A computation that was killed goes on where it was. Training takes the training and validation scenes;
    the test scenes are touched once, by the weights that validated best.
    """
    store = RecordStore(workspace.reports)
    return store.find(run_key(experiment, workspace, seed)) or compute(experiment, workspace, seed, store)


def recorded(rows: Iterable[str], workspace: Workspace) -> list[Record]:
    """The records of rows, with every seed of `SEEDS` that there is; nothing is computed."""
    store = RecordStore(workspace.reports)
    keys = [run_key(EXPERIMENTS[row], workspace, seed) for row in dict.fromkeys(rows) for seed in SEEDS]
    return [record for record in map(store.find, keys) if record is not None]


def records_of(rows: Iterable[str], workspace: Workspace) -> list[Record]:
    """As `recorded`, after the first seed of each row was computed where it was missing."""
    rows = list(rows)
    for row in rows:
        run(EXPERIMENTS[row], workspace, SEEDS[0])
    return recorded(rows, workspace)


def run_key(experiment: Experiment, workspace: Workspace, seed: int) -> str:
    """Name of a run: row, seed, and the fingerprint of all it depends on."""
    return f"{experiment.row}-seed{seed}-{fingerprint(_config(experiment, workspace))}"


def _config(experiment: Experiment, workspace: Workspace) -> dict[str, Any]:
    scale = workspace.scale
    config = {"experiment": asdict(experiment), "data": workspace.identity, "recipe": RECIPE_VERSION}
    config["test_views"] = scale.test_views
    if experiment.network is not None or experiment.test_depth == "predicted":
        config["depth"] = DepthPretraining(workspace).key
    if experiment.network is not None:
        texture = workspace.texture_identity(experiment.texture(scale))
        config |= {"model": asdict(experiment.model(scale)), "backbone": _backbone(experiment.network, scale)}
        config |= {"train": asdict(scale.train), "texture": texture}
        config |= {"blank": experiment.empty_fraction(scale), "upright": experiment.extruded_fraction(scale)}
    return config


def compute(experiment: Experiment, workspace: Workspace, seed: int, store: RecordStore) -> Record:
    """Train, evaluate and keep the record in `store`, whether there is one or not.

    Several processes train and evaluate together; all return the record, the first one keeps it.
    """
    key = run_key(experiment, workspace, seed)
    revision = git_revision()  # of the code that is at work now, whatever is committed in the meantime
    pretraining = DepthPretraining(workspace)
    history: History | None = None
    if experiment.network is None:
        predict: Predictor = _projection(workspace)
        device = "cpu"
    else:
        model, history = train_run(experiment, workspace, seed, key)
        device = next(model.parameters()).device.type
        predict = model_predictor(model, device)
    predicted = experiment.reads_depth and experiment.test_depth == "predicted"
    test = pretraining.views("test") if predicted else workspace.views("test")
    trained = time.monotonic()
    views = test.first(workspace.scale.test_views)
    passed = SemanticPass(views, workspace.scale.camera, _EVALUATION_BATCH)
    rank, ranks = rank_and_world_size()
    drawn = batches(passed, range(rank, len(passed), ranks), torch.device(device))
    counts = evaluate(predict, drawn, len(test.shards), len(LABELS))
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
        history=history.curves() if history else {},
    )
    if rank_and_world_size()[0] > 0:
        return record
    batch = collate([semantic_sample(test, i, workspace.scale.camera) for i in gallery_indices(test)])
    with torch.inference_mode():
        maps = predict(batch).cpu()
    store.write(record, ((maps if maps.dtype == torch.bool else maps > 0) & (batch["fov"] > 0.5)).numpy())
    # the record is complete: a later call for a fresh one starts from the first step
    (workspace.runs / key / "checkpoint.pt").unlink(missing_ok=True)
    return record


def _projection(workspace: Workspace) -> Predictor:
    """Rows (a): P^-1 with the depth that the batch brings."""
    return lambda batch: inverse_project(batch["zero"], batch["depth"], workspace.scale.camera) > 0


def train_run(experiment: Experiment, workspace: Workspace, seed: int, key: str) -> tuple[BevModel, History]:
    """A network with its best weights; also written to the run's folder as `model.safetensors`.

    Its RGB backbone starts from the scale's pretrained weights, all else from the seed. Validation is on the stream
    that it is trained on, with the depth of the last stage, and with one fixed seed, so that scores of runs compare.
    """
    scale, config = workspace.scale, workspace.scale.train
    assert experiment.network is not None  # P^-1 is not trained
    torch.manual_seed(seed)
    model = build(experiment.network, scale.camera, experiment.model(scale))
    load_backbone(model.backbone, _backbone(experiment.network, scale) or DepthPretraining(workspace).weights)
    folder = workspace.runs / key
    stages = [stream(experiment, workspace, "train", depth, seed) for depth in _stages(experiment)]
    held_out = stream(experiment, workspace, "validation", _stages(experiment)[-1], seed=0)
    validation = [held_out.batch(step) for step in range(VALIDATION_BATCHES)]
    objective = dice_objective(config.alpha, model.config.aux)
    data = InTurn(stages, config.steps)
    history = train(model, data, validation, config, folder, seed, key=key, objective=objective, picture=maps_figure)
    if rank_and_world_size()[0] == 0:
        model.save(folder / "model.safetensors")
    return model, history


def _backbone(network: str, scale: Scale) -> str:
    """Where the first weights of its RGB backbone come from; empty: the depth estimator."""
    return scale.vpn_backbone if VARIANTS[network][0] is VPN else scale.backbone


def _stages(experiment: Experiment) -> tuple[str, ...]:
    return experiment.train_depth if experiment.reads_depth else ("gt",)


def stream(experiment: Experiment, workspace: Workspace, part: str, depth: str, seed: int) -> Source:
    """The tuples of a split that an experiment trains on; depth: "gt" or "predicted"."""
    views: ViewSet = DepthPretraining(workspace).views(part) if depth == "predicted" else workspace.views(part)
    scale = workspace.scale
    common = (scale.camera, seed, scale.train.batch, experiment.empty_fraction(scale))
    if experiment.stream == "synth":
        bank = workspace.bank(experiment.texture(scale))
        return SynthSamples(views, bank, *common, experiment.fresh, experiment.extruded_fraction(scale))
    kinds: dict[str, Callable[[ViewSet, CameraConfig, int, int, float], Source]]
    kinds = {"modsem": ModSemSamples, "depthproj": DepthProjSamples, "classes": SemanticSamples}
    return kinds[experiment.stream](views, *common)


class InTurn:
    """Training data of several stages, one after the other, each with an equal share of the steps."""

    def __init__(self, stages: list[Source], steps: int) -> None:
        self._stages, self._steps = stages, steps

    def batch(self, step: int, rank: int = 0, ranks: int = 1) -> Batch:
        """The batch of a step, from the stage that the step belongs to."""
        stage = self._stages[min(step * len(self._stages) // self._steps, len(self._stages) - 1)]
        return stage.batch(step, rank, ranks)


def main(root: Path = ROOT) -> None:
    """Parse the command line; compute a record where it is missing, alone or beside other processes of a launch."""
    parser = argparse.ArgumentParser(prog="python -m zerobev.experiments.runs", description=__doc__)
    parser.add_argument("--scale", default="reduced", help=f"one of {', '.join(SCALES)}")
    parser.add_argument("--row", required=True, help=f"one of {', '.join(EXPERIMENTS)}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenes", default="", metavar="DIR", help="HM3DSem scenes instead of generated homes")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a dask cluster that makes the views")
    options = parser.parse_args()
    wanted, workspace = experiment(options.row), Workspace(options.scale, options.scenes, root)
    with _one_at_a_time(workspace.cache), cluster(options.dask):
        _make_data(wanted, workspace)
    # only now do processes learn of each other: before, they would take each other's waiting for a failure
    state = PartialState(cpu=not torch.cuda.is_available())
    estimated = _estimated(wanted)
    if estimated or (wanted.network and not _backbone(wanted.network, workspace.scale)):
        pretraining = DepthPretraining(workspace)
        _ = pretraining.record  # trained by all, where it is missing
        state.wait_for_everyone()
        with _one_at_a_time(workspace.cache):
            for part in estimated:
                pretraining.views(part)
    record = run(wanted, workspace, options.seed)
    if state.is_main_process:
        iou = f"class {100 * record.counts.class_iou():.2f}, pixel {100 * record.counts.pixel_iou():.2f}"
        print(f"{RecordStore(workspace.reports).path(record.key)}: IoU in percent: {iou}")
    state.destroy_process_group()


def _make_data(wanted: Experiment, workspace: Workspace) -> None:
    """The views, and the textures, of a run."""
    for part in ("train", "validation", "test"):
        workspace.views(part)
    if wanted.network and wanted.stream == "synth":
        workspace.bank(wanted.texture(workspace.scale))


def _estimated(wanted: Experiment) -> list[str]:
    """The splits of which a run takes estimated depth."""
    if not wanted.reads_depth:
        return []
    stages = _stages(wanted)
    depths = {"train": stages, "validation": stages[-1:], "test": (wanted.test_depth,)}
    return [part for part, of_part in depths.items() if "predicted" in of_part]


@contextlib.contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Let the processes that see `folder` in one after the other: the first makes what the others then find."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "data.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


if __name__ == "__main__":
    run_command(main)
