"""Runs and their records, end to end on a scale of its own: two training homes, four steps."""

import json
from dataclasses import replace

import numpy as np
import pytest

from zerobev.config import SCALES, SceneConfig, TextureConfig, TrainConfig
from zerobev.errors import InputError
from zerobev.experiments import TABLE_1, gallery, run, run_key
from zerobev.models import ZeroBEV
from zerobev.records import RecordStore
from zerobev.spot_check import spot_check
from zerobev.streams.projection import project
from zerobev.streams.tuples import semantic_batches
from zerobev.workspace import Workspace

PROJECTION, ZERO_BEV = TABLE_1
TINY = replace(
    SCALES["smoke"],
    name="tiny",
    scenes=SceneConfig(train=1, validation=1, test=2, views=3),
    train=TrainConfig(steps=4, learning_rate=1e-3, decay_every=2, validate_every=2, batch=2),
    texture=TextureConfig(tiles=2, tile_px=128),
)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A workspace's root with both rows recorded."""
    root = tmp_path_factory.mktemp("root")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SCALES, "tiny", TINY)
        workspace = Workspace("tiny", root=root)
        for experiment in TABLE_1:
            run(experiment, workspace)
    return root


@pytest.fixture
def workspace(root, monkeypatch):
    monkeypatch.setitem(SCALES, "tiny", TINY)
    return Workspace("tiny", root=root)


def test_a_record_is_read_and_not_computed_again_until_a_fresh_one_is_asked_for(workspace, monkeypatch):
    path = RecordStore(workspace.reports).path(run_key(PROJECTION, workspace, 0))
    before = path.stat().st_mtime_ns
    first = run(PROJECTION, workspace)
    assert path.stat().st_mtime_ns == before
    monkeypatch.setenv("ZEROBEV_FRESH", str(before / 1e9 + 0.001))
    again = run(PROJECTION, workspace)
    assert path.stat().st_mtime_ns != before
    assert again.counts == first.counts


def test_row_a1_is_the_projection_with_true_depth_and_counts_follow_by_hand(workspace):
    test, camera = workspace.views("test"), workspace.scale.camera
    intersection, union = np.zeros((2, 8), int), np.zeros((2, 8), int)
    for batch in semantic_batches(test, camera, batch=1):
        predicted = project(batch["zero"], batch["depth"], camera)[0].numpy() > 0
        inside, truth = batch["fov"][0].numpy() > 0, batch["target"][0].numpy() > 0
        scene = int(batch["scene"])
        intersection[scene] += (predicted & truth & inside).sum(axis=(1, 2))
        union[scene] += ((predicted | truth) & inside).sum(axis=(1, 2))
    counts = run(PROJECTION, workspace).counts
    assert np.array_equal(counts.intersection, intersection)
    assert np.array_equal(counts.union, union)
    assert counts.pixel_iou() > 0.1


def test_the_record_says_where_it_comes_from(workspace):
    record = run(ZERO_BEV, workspace)
    assert record.config["train"]["steps"] == 4 and record.config["data"]["scenes"]["views"] == 3
    assert record.origin["device"] == "cpu" and "torch" in record.origin["versions"]
    assert record.cost["train_seconds"] > 0 and record.cost["peak_memory_mb"] > 100
    assert len(record.scenes) == len(record.counts.union) == 2
    assert record.history["step"][-1] == 4 and record.history["validation"][-1] is not None


def test_the_key_follows_what_a_run_depends_on_and_nothing_else(workspace, monkeypatch):
    projection, learned = (run_key(e, workspace, 0) for e in TABLE_1)
    assert run_key(ZERO_BEV, workspace, 1) != learned
    monkeypatch.setitem(SCALES, "tiny", replace(TINY, train=replace(TINY.train, steps=5)))
    changed = Workspace("tiny", root=workspace.reports.parents[1])
    assert run_key(ZERO_BEV, changed, 0) != learned
    assert run_key(PROJECTION, changed, 0) == projection
    monkeypatch.setitem(SCALES, "tiny", replace(TINY, camera=replace(TINY.camera, hfov_deg=80.0)))
    changed = Workspace("tiny", root=workspace.reports.parents[1])
    assert run_key(PROJECTION, changed, 0) != projection


def test_the_gallery_holds_what_the_kept_weights_predict(workspace):
    record = run(ZERO_BEV, workspace)
    views = gallery(workspace)
    maps = RecordStore(workspace.reports).maps(record.key)
    assert maps.shape == (6, 8, 20, 20) and views["bev_label"].shape == (6, 20, 20)
    assert not (maps & ~views["fov"][:, None]).any()
    model = ZeroBEV.load(workspace.runs / record.key / "model.safetensors")
    batch = next(iter(semantic_batches(workspace.views("test"), workspace.scale.camera, batch=6)))
    logits = model(batch["rgb"], batch["zero"]).zero_logits
    assert ((logits > 0).numpy() & views["fov"][:, None] == maps).mean() > 0.999


def test_training_never_opens_a_test_scene(workspace, monkeypatch, tmp_path):
    asked = []
    views = Workspace.views
    monkeypatch.setattr(Workspace, "views", lambda self, part, scenes=None: asked.append(part) or views(self, part))
    from zerobev import experiments

    experiments._train(workspace, 0, "train-only")
    assert set(asked) == {"train", "validation"}
    split = workspace.split
    assert not {*split.train, *split.validation} & {*split.test}


def test_spot_check_agrees_with_an_honest_record_and_not_with_a_changed_one(workspace):
    assert spot_check(workspace, "a.1").agrees
    path = RecordStore(workspace.reports).path(run_key(PROJECTION, workspace, 0))
    honest = path.read_text()
    record = json.loads(honest)
    record["counts"]["intersection"] = [[cells // 2 for cells in scene] for scene in record["counts"]["intersection"]]
    path.write_text(json.dumps(record))
    try:
        changed = spot_check(workspace, "a.1")
        assert not changed.agrees and "DOES NOT AGREE" in str(changed)
    finally:
        path.write_text(honest)
    with pytest.raises(InputError, match=r"expected one of the recorded rows a\.1, c, found 'z'"):
        spot_check(workspace, "z")


def test_a_scene_folder_that_is_missing_is_named(tmp_path):
    with pytest.raises(InputError, match=r"expected a folder in HM3DSem layout, found nothing at .*nowhere"):
        Workspace("smoke", str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="expected one of smoke, reduced, paper, found 'huge'"):
        Workspace("huge")
