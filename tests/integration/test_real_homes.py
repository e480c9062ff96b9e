"""The shipped weights on a folder of homes: against recorded shards of the same views, and as a command."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from zerobev import cli
from zerobev.common.errors import InputError
from zerobev.config import LABELS, TextureConfig
from zerobev.data.generate import generate_shard
from zerobev.data.samples import semantic_batches
from zerobev.data.shards import Shard
from zerobev.data.view_set import ViewSet
from zerobev.evaluation.evaluate import evaluate, model_predictor
from zerobev.evaluation.metrics import Counts
from zerobev.evaluation.real_homes import METHODS, DepthReport, HomeResult, Results, evaluate_homes, render_views
from zerobev.geometry.projection import inverse_project
from zerobev.inference.projector import load
from zerobev.inference.shipped_weights import ROWS, run_of, shipped
from zerobev.models import load_model
from zerobev.scenes.hm3dsem_writer import write_scene
from zerobev.scenes.readers import list_scenes

from support.paths import REAL_HOMES
from support.scenes import build, furnished


@pytest.fixture(scope="module")
def homes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two annotated homes, in two splits."""
    torch.set_num_threads(1)
    root = tmp_path_factory.mktemp("homes")
    write_scene(root / "val/00001-HomeA", build(furnished()))
    write_scene(root / "train/00002-HomeB", build(furnished()[:8]))
    return root


@pytest.fixture(scope="module")
def results(homes: Path) -> Results:
    lines: list[str] = []
    found = evaluate_homes([homes / "val/00001-HomeA", homes / "train/00002-HomeB"], 3, seed=5, report=lines.append)
    assert not found.broken
    assert [line.split(":")[0] for line in lines] == ["[1/2] 00001-HomeA", "[2/2] 00002-HomeB"]
    return found


@pytest.fixture(scope="module")
def counts(results: Results) -> dict[str, Counts]:
    return results.counts


def test_counts_are_those_of_recorded_shards(homes, counts, tmp_path):
    model = load_model(shipped(ROWS[0]))
    folders = [homes / "val/00001-HomeA", homes / "train/00002-HomeB"]
    paths = [generate_shard(folder, tmp_path, 3, model.camera, TextureConfig(), 5) for folder in folders]
    views = ViewSet([Shard(path, model.camera, TextureConfig()) for path in paths])
    recorded = {
        "a.1": lambda batch: inverse_project(batch["zero"], batch["depth"], model.camera) > 0,
        ROWS[0]: model_predictor(model, "cpu"),
    }
    for row, projector in recorded.items():
        expected = evaluate(projector, semantic_batches(views, model.camera, 3), 2, len(LABELS))
        assert expected.union.sum() > 0
        for name in ("intersection", "union"):  # rounding may move a cell over one half
            assert np.abs(getattr(expected, name) - getattr(counts[row], name)).sum() <= 2


def test_every_row_is_another_method(counts):
    residual = [row + depth for row in ("f.r", "d") for depth in (".none", ".sensor", ".true")]
    assert list(counts) == list(METHODS) == ["a.1", "a.2", "c", "f.r", "d", *residual, "constant"]
    unions = [tuple(one.union.ravel()) for one in counts.values()]
    assert len(set(unions)) == len(unions)
    # true depth knows the visible floor; estimated depth on coloured boxes does not
    assert counts["a.1"].pixel_iou() > counts["a.2"].pixel_iou()
    assert counts["d.true"].pixel_iou() > counts["d.sensor"].pixel_iou() > counts["d"].pixel_iou()
    constant = counts["constant"].iou_per_class()
    assert constant[LABELS.index("floor")] > 0 and np.nansum(constant) == constant[LABELS.index("floor")]


def test_depth_errors_and_reasons(homes, results):
    """Against the estimator itself on the same views; an estimate of half the floor's distance is named as reason."""
    batch = render_views(homes / "val/00001-HomeA", 3, load("a.2").camera, 5)
    estimated = load("a.2").estimator(batch["rgb"]).detach()
    known, report = batch["depth"] > 0, results.homes["00001-HomeA"].depth
    error = ((estimated - batch["depth"]).abs() / batch["depth"])[known].mean()
    assert report.relative == pytest.approx(float(error), rel=1e-4)
    floor = known & (batch["zero"][:, [LABELS.index("floor")]] > 0)
    assert report.floor_ratio == pytest.approx(float((estimated / batch["depth"])[floor].median()), rel=1e-4)
    seen = np.full((1, 8), 100)
    result = HomeResult(
        {
            "a.1": Counts(np.array([[50, 50, 50, 50, 9, 0, 50, 50]]), seen),
            "d": Counts(np.array([[50, 13, 12, 0, 0, 0, 50, 50]]), seen),
        },
        results.homes["00001-HomeA"].depth,
    )
    assert result.lost_classes("d") == ["chair", "sofa"]
    good = DepthReport(relative=0.1, mad_m=0.2, floor_ratio=1.0, brightness=0.5, median_m=2.0)
    assert good.reasons() == "no reason found in estimated depth, light or distances"
    assert "puts the floor at 0.50 of its distance" in replace(good, floor_ratio=0.5, relative=0.5).reasons()
    assert "35% off, on walls and objects" in replace(good, relative=0.35).reasons()
    assert "dark" in replace(good, brightness=0.1).reasons() and "near" in replace(good, median_m=1.0).reasons()


def test_the_command_takes_every_home_and_skips_broken_ones_loudly(homes, tmp_path, capsys):
    for folder in (homes / "val/00001-HomeA", homes / "train/00002-HomeB"):
        target = tmp_path / "some" / folder.parent.name
        target.mkdir(parents=True)
        (target / folder.name).symlink_to(folder)
    broken = tmp_path / "some/val/00003-HomeC"
    broken.mkdir()
    for kind in ("glb", "semantic.glb", "semantic.txt"):
        (broken / f"HomeC.{kind}").write_text("nothing")
    with pytest.raises(SystemExit, match=r"skipped 00003-HomeC: .*expected"):
        cli.main(
            ["evaluate", "--scenes", str(tmp_path / "some"), "--views", "1", "--json", str(tmp_path / "found.json")]
        )
    shown = capsys.readouterr().out
    assert "2 homes, 1 views each" in shown and "[3/3] 00003-HomeC: skipped" in shown
    assert shown.count("has ") == 2  # both homes are discussed
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["scenes"] == ["00001-HomeA", "00002-HomeB"] and set(found["rows"]) == set(METHODS)
    assert set(found["depth"]["by_home"]) == set(found["scenes"]) and found["depth"]["relative"] > 0
    for row, entry in found["rows"].items():
        counts = Counts.from_json(entry)
        assert counts.union.shape == (2, 8) and entry["class_iou"] == counts.class_iou()
        (weights,) = [one for one in ROWS if row in (one, f"{one}.none", f"{one}.sensor", f"{one}.true")] or [None]
        assert entry["weights"] == (run_of(shipped(weights)) if weights else None)


def test_other_weights_are_evaluated_alike(homes, results, tmp_path):
    """Those of (d), from a folder, have the counts of the shipped ones."""
    model = load("d")
    model.save_pretrained(tmp_path / "same")
    found = evaluate_homes([homes / "val/00001-HomeA"], 3, seed=5, report=lambda line: None, weights=tmp_path / "same")
    home = results.homes["00001-HomeA"]
    assert list(found.counts) == ["a.1", "a.2", "own", "own.none", "own.sensor", "own.true", "constant"]
    for row in ("own", "own.none", "own.sensor", "own.true"):
        assert found.counts[row] == home.counts[row.replace("own", "d")]
    assert found.homes["00001-HomeA"].depth == home.depth and "(own) has " in found.worst()[0]
    with pytest.raises(InputError, match=r"weights: expected a network, found P\^-1"):
        evaluate_homes([homes / "val/00001-HomeA"], 1, weights="a.2")


def test_a_data_set_a_part_of_it_or_a_scene_are_accepted(homes, tmp_path):
    a, b = homes / "val/00001-HomeA", homes / "train/00002-HomeB"
    assert list_scenes(homes) == [a, b] and list_scenes(homes / "val") == [a] and list_scenes(b) == [b]
    with pytest.raises(InputError, match="expected train, val or minival"):
        list_scenes(tmp_path)


def test_nothing_to_evaluate_is_refused(homes):
    with pytest.raises(InputError, match="views: expected 1 or more, found 0"):
        evaluate_homes([homes / "val/00001-HomeA"], views=0)


def test_real_homes():
    folder = REAL_HOMES / "val/00903-Sh3dStudioA"
    if not folder.is_dir():
        pytest.skip(f"no development homes at {REAL_HOMES}")
    torch.set_num_threads(1)
    found = evaluate_homes([folder], views=4)
    floor = LABELS.index("floor")
    # also without depth
    assert not found.broken and all(one.iou_per_class()[floor] > 0.2 for one in found.counts.values())
