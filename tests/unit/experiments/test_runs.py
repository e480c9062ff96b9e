"""Runs and their records, end to end at a tiny scale: one training home, four steps."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from zerobev.common.errors import InputError
from zerobev.common.keys import plain
from zerobev.common.locks import locked
from zerobev.config import LABELS, SCALES, SceneConfig, TextureConfig, TrainConfig
from zerobev.data.samples import as_float, semantic_batches
from zerobev.experiments import launch, runs
from zerobev.experiments.depth_pretraining import DepthPretraining
from zerobev.experiments.gallery import gallery
from zerobev.experiments.registry import EXPERIMENTS, experiment
from zerobev.experiments.runs import InTurn, Run, recorded, records_of
from zerobev.experiments.spot_check import spot_check
from zerobev.experiments.workspace import Workspace
from zerobev.geometry.projection import inverse_project
from zerobev.models import BevModel, ZeroBEV
from zerobev.models.variants import VARIANTS
from zerobev.report.paper import TABLES
from zerobev.training.losses import dice_loss

PROJECTION, ESTIMATED, ZERO_BEV, RESIDUAL = (EXPERIMENTS[row] for row in ("a.1", "a.2", "c", "d"))
TINY = replace(
    SCALES["smoke"],
    name="tiny",
    scenes=SceneConfig(train=1, validation=1, test=2, views=3),
    train=TrainConfig(steps=4, learning_rate=1e-3, decay_every=2, validate_every=2, batch=2),
    depth=TrainConfig(steps=4, learning_rate=1e-3, decay_every=2, validate_every=2, batch=2),
    texture=TextureConfig(tiles=2, tile_px=128),
)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """The root of a workspace in which four rows are recorded."""
    root = tmp_path_factory.mktemp("root")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SCALES, "tiny", TINY)
        workspace = Workspace("tiny", root=root)
        for recorded in (PROJECTION, ESTIMATED, ZERO_BEV, RESIDUAL):
            Run(recorded, workspace).record()
    return root


@pytest.fixture
def workspace(root, monkeypatch):
    monkeypatch.setitem(SCALES, "tiny", TINY)
    return Workspace("tiny", root=root)


def test_a_record_is_read_until_a_fresh_one_is_asked_for(workspace, monkeypatch):
    run = Run(PROJECTION, workspace)
    path = run.store.path(run.key)
    before = path.stat().st_mtime_ns
    first = run.record()
    assert path.stat().st_mtime_ns == before
    monkeypatch.setenv("ZEROBEV_FRESH", str(before / 1e9 + 0.001))
    again = run.record()
    assert path.stat().st_mtime_ns != before
    assert again.counts == first.counts


def test_every_row_of_every_table_is_a_run_and_each_run_is_one_row():
    rows = [row for table in TABLES.values() for row in table]
    assert set(rows) <= set(EXPERIMENTS)
    own = {"f", "f.r", "c.fixed", "c.mesh", "c.once", "c.paper"}
    assert {row for row in EXPERIMENTS if row not in rows} == own
    trained = [e for e in EXPERIMENTS.values() if e.network]
    assert len({replace(e, row="") for e in EXPERIMENTS.values()}) == len(EXPERIMENTS)
    assert {e.network for e in trained} == set(VARIANTS)
    # only networks that are not zero-shot are trained on classes, and only the oracle is tested with true depth
    assert {e.row for e in trained if e.stream == "classes"} == {"b.1", "b.2", "b.3"}
    assert [e.row for e in EXPERIMENTS.values() if e.test_depth == "true"] == ["a.1"]
    with pytest.raises(InputError, match=r"row: expected one of a\.1, .*, found 'z'"):
        experiment("z")


def test_a_misspelt_depth_stream_or_split_is_an_error(workspace):
    """True depth in place of misspelt estimated depth would make the row an oracle."""
    for field, value in (
        ("test_depth", "predicted"),
        ("test_depth", "mixed"),
        ("train_depth", ("true", "estimate")),
        ("stream", "texture"),
    ):
        with pytest.raises(InputError, match=f"{field}: expected one of .*, found"):
            replace(RESIDUAL, **{field: value})
    run = Run(RESIDUAL, workspace)
    with pytest.raises(InputError, match="depth: expected one of true, estimated, mixed, found 'predicted'"):
        run.views("test", "predicted")
    with pytest.raises(InputError, match="split: expected one of train, validation, test, found 'val'"):
        workspace.views("val")


@pytest.mark.parametrize("row, predicted", [("a.1", False), ("a.2", True)])
def test_projections_use_the_depth_of_their_row(workspace, row, predicted):
    """Row (a.2) must never read true depth: its counts are those of estimated depth, view by view."""
    test, camera = workspace.views("test"), workspace.scale.camera
    estimator = DepthPretraining(workspace).estimator
    intersection, union = np.zeros((2, 8), int), np.zeros((2, 8), int)
    for batch in semantic_batches(test, camera, batch=1):
        with torch.inference_mode():
            depth = estimator(batch["rgb"]).half().float() if predicted else batch["depth"]
        found = inverse_project(batch["zero"], depth, camera)[0].numpy() > 0
        inside, truth = batch["fov"][0].numpy() > 0, batch["target"][0].numpy() > 0
        scene = int(batch["scene"])
        intersection[scene] += (found & truth & inside).sum(axis=(1, 2))
        union[scene] += ((found | truth) & inside).sum(axis=(1, 2))
    counts = Run(experiment(row), workspace).record().counts
    # the size of a batch may change the last digit of a depth
    assert abs(counts.intersection - intersection).max() <= (2 if predicted else 0)
    assert abs(counts.union - union).max() <= (2 if predicted else 0)
    assert counts.pixel_iou() > (0.0 if predicted else 0.1)


def test_each_row_is_trained_on_its_own_auxiliary_maps(workspace, monkeypatch):
    """The auxiliary loss of a batch compares with the channels of the row."""
    objectives = {}
    monkeypatch.setattr(BevModel, "save", lambda *_: None)  # the recorded weights stay
    monkeypatch.setattr(
        runs, "train", lambda model, *arguments, objective, **named: objectives.update(pair=(model, objective))
    )
    for row, channels in {"c": [0, 1], "c.I": [0], "c.II": [1]}.items():
        run = Run(EXPERIMENTS[row], workspace)
        run.train()
        model, objective = objectives["pair"]
        batch = as_float(run.source("train", "true", 0).batch(0))
        with torch.no_grad():
            logits = model(batch["rgb"], batch["zero"]).aux_logits
            expected = dice_loss(logits.sigmoid(), batch["aux"][:, channels], batch["fov"])
            assert torch.allclose(objective(model, batch).aux, expected)


def test_the_papers_choices_are_one_row_away_from_ours(workspace):
    ours, paper = (Run(EXPERIMENTS[row], workspace).config for row in ("c", "c.paper"))
    reduced = SCALES["reduced"]
    assert EXPERIMENTS["c.paper"].texture(reduced).scales == (1.0, 1.0) != EXPERIMENTS["c"].texture(reduced).scales
    empty = {row: EXPERIMENTS[row].empty_fraction(reduced) for row in ("c", "c.paper", "b.2")}
    assert empty["c"] > 0 == empty["c.paper"] == empty["b.2"]
    extruded = {row: EXPERIMENTS[row].extruded_fraction(reduced) for row in ("c", "c.paper", "c.mesh")}
    assert extruded["c"] > 0 == extruded["c.paper"] == extruded["c.mesh"]
    assert (
        EXPERIMENTS["c"].model(reduced).foreground_prior < 0.5 == EXPERIMENTS["c.paper"].model(reduced).foreground_prior
    )
    assert EXPERIMENTS["c"].model(reduced).ground_start and not EXPERIMENTS["c.paper"].model(reduced).ground_start
    assert ours["model"] == paper["model"]  # this scale makes the paper's choices


def test_stages_of_depth_follow_each_other(workspace):
    truth, predicted = (Run(RESIDUAL, workspace).source("train", depth, 0) for depth in ("true", "estimated"))
    assert not torch.equal(truth.batch(0)["depth"], predicted.batch(0)["depth"])
    assert torch.equal(truth.batch(0)["zero"], predicted.batch(0)["zero"])
    both = InTurn([truth, predicted], steps=5)
    for step, source in enumerate([truth, truth, truth, predicted, predicted]):
        assert torch.equal(both.batch(step)["depth"], source.batch(step)["depth"]), step


def test_every_network_starts_from_the_depth_estimators_backbone(workspace, monkeypatch):
    pretraining = DepthPretraining(workspace)
    weights = pretraining.estimator.backbone.state_dict()
    started = {}
    monkeypatch.setattr(BevModel, "save", lambda *_: None)  # the recorded weights stay
    monkeypatch.setattr(runs, "train", lambda model, *arguments, **named: started.update(model=model))
    for row in VARIANTS:
        Run(EXPERIMENTS[row], workspace).train()
        first = started["model"].backbone.state_dict()
        same = [torch.equal(weights[name], first[name]) for name in first if not name.endswith("num_batches_tracked")]
        assert len(same) > 20 and all(same), row


def test_the_depth_estimator_is_recorded_and_read(workspace, monkeypatch):
    monkeypatch.setattr(DepthPretraining, "_compute", lambda self: pytest.fail("trained again"))
    record = DepthPretraining(workspace).record
    assert set(record.result["errors"]) == {"mad_m", "relative"} and record.result["errors"]["mad_m"] > 0
    assert record.result["history"]["step"][-1] == 4
    monkeypatch.setitem(SCALES, "tiny", replace(TINY, depth=replace(TINY.depth, steps=5)))
    changed = DepthPretraining(Workspace("tiny", root=workspace.reports.parents[1]))
    assert changed.key != record.key


def test_records_of_rows_are_those_of_every_recorded_seed(workspace):
    assert [(r.row, r.seed) for r in recorded(["c", "a.1", "e", "c"], workspace)] == [("c", 0), ("a.1", 0)]
    second = Run(PROJECTION, workspace, seed=1)
    changed = replace(Run(PROJECTION, workspace).record(), key=second.key, config=plain(second.config))
    second.store.write(changed, np.zeros((1, 8, 20, 20), bool))
    try:
        found = records_of(["a.1", "a.2"], workspace)
        assert [(r.row, r.seed) for r in found] == [("a.1", 0), ("a.1", 1), ("a.2", 0)]
    finally:
        second.store.path(second.key).unlink()


def test_a_record_holds_configuration_origin_and_cost(workspace):
    record = Run(ZERO_BEV, workspace).record()
    assert record.config["train"]["steps"] == 4 and record.config["data"]["scenes"]["views"] == 3
    assert record.origin["device"] == "cpu" and "torch" in record.origin["versions"]
    assert record.cost["train_seconds"] > 0 and record.cost["peak_memory_mb"] > 100
    assert len(record.scenes) == len(record.counts.union) == 2
    assert record.history["step"][-1] == 4 and record.history["validation"][-1] is not None


def test_the_key_follows_what_a_run_depends_on_and_nothing_else(workspace, monkeypatch):
    projection, learned = (Run(e, workspace).key for e in (PROJECTION, ZERO_BEV))
    assert Run(ZERO_BEV, workspace, seed=1).key != learned
    monkeypatch.setitem(SCALES, "tiny", replace(TINY, train=replace(TINY.train, steps=5)))
    changed = Workspace("tiny", root=workspace.reports.parents[1])
    assert Run(ZERO_BEV, changed).key != learned
    assert Run(PROJECTION, changed).key == projection
    monkeypatch.setitem(SCALES, "tiny", replace(TINY, camera=replace(TINY.camera, hfov_deg=80.0)))
    changed = Workspace("tiny", root=workspace.reports.parents[1])
    assert Run(PROJECTION, changed).key != projection


def test_counts_of_parts_tell_what_is_projected_from_what_is_inferred(workspace):
    """P^-1 with true depth fills the seen cells of the floor, and no others."""
    oracle, network = (Run(row, workspace).record() for row in (PROJECTION, ZERO_BEV))
    for record in (oracle, network):
        assert sum((part.iou for part in record.parts.values()), record.counts.empty(2, 8)) == record.counts
        for part in record.parts.values():
            assert (part.iou.intersection == part.recall.intersection).all()
            assert (part.recall.union <= part.iou.union).all()
    floor = LABELS.index("floor")
    recalled = {name: part.recall.iou_per_class()[floor] for name, part in oracle.parts.items()}
    assert recalled["seen"] > 0.85 and recalled["between"] == recalled["hidden"] == 0
    assert all(oracle.parts[name].iou.intersection.sum() == 0 for name in ("between", "hidden"))
    targets = [{name: part.recall.union for name, part in record.parts.items()} for record in (oracle, network)]
    assert all((targets[0][name] == targets[1][name]).all() for name in targets[0])


def test_the_gallery_holds_the_predictions_of_the_saved_weights(workspace):
    record = Run(ZERO_BEV, workspace).record()
    views = gallery(workspace)
    maps = Run(ZERO_BEV, workspace).store.maps(record.key)
    assert maps.shape == (6, 8, 20, 20) and views["bev_label"].shape == (6, 20, 20)
    assert not (maps & ~views["fov"][:, None]).any()
    model = ZeroBEV.load(Run(ZERO_BEV, workspace).weights)
    batch = next(iter(semantic_batches(workspace.views("test"), workspace.scale.camera, batch=6)))
    logits = model(batch["rgb"], batch["zero"]).zero_logits
    assert ((logits > 0).numpy() & views["fov"][:, None] == maps).mean() > 0.999


def test_training_never_opens_a_test_scene(workspace, monkeypatch, tmp_path):
    asked = []
    views = Workspace.views
    monkeypatch.setattr(Workspace, "views", lambda self, part, scenes=None: asked.append(part) or views(self, part))
    shutil.rmtree(Run(RESIDUAL, workspace).folder)
    Run(RESIDUAL, workspace).train()
    assert set(asked) == {"train", "validation"}
    split = workspace.split
    assert not {*split.train, *split.validation} & {*split.test}


def test_spot_check_agrees_only_with_an_unchanged_record(workspace):
    assert spot_check(workspace, "a.1").agrees
    path = Run(PROJECTION, workspace).store.path(Run(PROJECTION, workspace).key)
    original = path.read_text()
    record = json.loads(original)
    counts = record["result"]["counts"]
    counts["intersection"] = [[cells // 2 for cells in scene] for scene in counts["intersection"]]
    path.write_text(json.dumps(record))
    try:
        with pytest.raises(InputError, match="parts: expected the sum of their counts"):
            spot_check(workspace, "a.1")
        del record["result"]["parts"]
        path.write_text(json.dumps(record))
        changed = spot_check(workspace, "a.1")
        assert not changed.agrees and "DOES NOT AGREE" in str(changed)
    finally:
        path.write_text(original)
    with pytest.raises(InputError, match=r"expected one of the recorded rows a\.1, a\.2, c, d, found 'z'"):
        spot_check(workspace, "z")


def test_a_recorded_row_needs_no_data(workspace, monkeypatch, capsys):
    run = Run(PROJECTION, workspace)
    run.record()
    monkeypatch.setattr(launch, "_prepare", None)
    launch._compute_one(run, None)
    assert f"{run.key}.json: IoU in percent" in capsys.readouterr().out


def test_a_training_is_not_computed_twice_at_a_time(workspace, monkeypatch):
    run = Run(ZERO_BEV, workspace)
    monkeypatch.setenv("ZEROBEV_FRESH", "9e9")  # no record is new enough
    for folder in run.folder, workspace.runs / run.pretraining.key:
        refused = pytest.raises(InputError, match=f"{folder}: expected no other process with this run, found one")
        with locked(folder, "work"), refused:
            run.record() if folder == run.folder else run.pretraining.record


def test_a_scale_for_any_camera_and_depth(tmp_path, monkeypatch):
    """As `deploy`, at a tiny size: heights, looks, cameras, objects, mixed depth, and depth bounded by the floor."""
    deploy = SCALES["deploy"]
    tiny = replace(
        TINY,
        scenes=replace(deploy.scenes, train=1, validation=1, test=2, views=6),
        model=replace(TINY.model, seen=True, floor_depth=True),
        augment=deploy.augment,
        objects_fraction=deploy.objects_fraction,
        mixed_depth=True,
    )
    monkeypatch.setitem(SCALES, "tiny", tiny)
    workspace = Workspace("tiny", root=tmp_path)
    records = {row: Run(EXPERIMENTS[row], workspace).record() for row in ("a.1", "c", "d")}
    view = workspace.views("train").locate(0)[1]
    assert 0.3 <= view.height_m <= 1.8 and view.height_m != tiny.camera.height_m
    # P^-1 with true depth is right from every height
    assert records["a.1"].counts.pixel_iou() > 0.2
    assert records["d"].config["mixed_depth"] and "mixed_depth" not in records["c"].config
    residual = Run(EXPERIMENTS["d"], workspace)
    assert residual.experiment.stages(tiny) == ("mixed",)
    assert (
        ZeroBEV.load(residual.weights).config.measured
        and not ZeroBEV.load(Run(EXPERIMENTS["c"], workspace).weights).config.measured
    )
    batch = residual.source("train", "mixed", 0).batch(0)
    assert batch["height"].shape == (2,) and batch["rgb"].dtype == torch.uint8
    assert batch["depth"].shape[1] == 2 and set(batch["depth"][:, 1].unique().tolist()) <= {0.0, 1.0}
    again = residual.source("train", "mixed", 0).batch(0)
    assert all(torch.equal(batch[name], again[name]) for name in batch)
    # (d) starts from (c)
    start, first = Run(EXPERIMENTS["c"], workspace), {}
    assert start.start is None and records["d"].config["start"] == start.key
    monkeypatch.setattr(BevModel, "save", lambda *_: None)  # the recorded weights stay
    monkeypatch.setattr(runs, "train", lambda model, *_, **__: first.update(model.state_dict()))
    residual.train()
    assert all(torch.equal(first[name], weight) for name, weight in load_file(start.weights).items())
    # runs side by side find it trained
    made = []
    with monkeypatch.context() as patch:
        patch.setattr(Run, "trained", lambda run: made.append(run.name))
        launch._train_starts([Run(PROJECTION, workspace), start, residual, Run(EXPERIMENTS["f.r"], workspace)])
    assert made == ["c seed 0"]
    # without weights (c) is trained first
    shutil.move(start.weights, tmp_path / "c.safetensors")
    monkeypatch.setattr(
        runs, "train", lambda _, data, *__, **___: pytest.fail(f"trains with {data.batch(0)['depth'].shape}")
    )
    with pytest.raises(pytest.fail.Exception, match=r"trains with .*\[2, 1, 32, 32\]"):
        residual.train()


def test_a_scene_folder_that_is_missing_is_named(tmp_path):
    with pytest.raises(InputError, match=r"expected a folder in HM3DSem layout, found nothing at .*nowhere"):
        Workspace("smoke", str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="expected one of smoke, reduced, deploy, paper, found 'huge'"):
        Workspace("huge")
