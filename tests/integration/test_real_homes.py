"""The shipped weights on a folder of homes: against recorded shards of the same views, and as a command."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from zerobev import cli
from zerobev.common.errors import InputError
from zerobev.config import LABELS, TextureConfig
from zerobev.data.generate import generate_shard
from zerobev.data.samples import ViewSet, semantic_batches
from zerobev.data.shards import Shard
from zerobev.evaluation.evaluate import evaluate, model_predictor
from zerobev.evaluation.metrics import Counts
from zerobev.evaluation.real_homes import METHODS, evaluate_homes
from zerobev.geometry.projection import inverse_project
from zerobev.inference.shipped_weights import ROWS, run_of, shipped
from zerobev.models import load_model
from zerobev.scenes.hm3dsem_writer import write_scene

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
def counts(homes: Path) -> dict[str, Counts]:
    found, broken = evaluate_homes([homes / "val/00001-HomeA", homes / "train/00002-HomeB"], views=3, seed=5)
    assert not broken
    return found


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
    assert list(counts) == list(METHODS) == ["a.1", "a.2", *ROWS]
    unions = [tuple(one.union.ravel()) for one in counts.values()]
    assert len(set(unions)) == len(unions)
    # true depth knows the visible floor; estimated depth on coloured boxes does not
    assert counts["a.1"].pixel_iou() > counts["a.2"].pixel_iou()


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
    assert "2 homes, 1 views each" in capsys.readouterr().out
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["scenes"] == ["00001-HomeA", "00002-HomeB"] and set(found["rows"]) == set(METHODS)
    for row, entry in found["rows"].items():
        counts = Counts.from_json(entry)
        assert counts.union.shape == (2, 8) and entry["class_iou"] == counts.class_iou()
        assert entry["weights"] == (run_of(shipped(row)) if row in ROWS else None)


def test_nothing_to_evaluate_is_refused(homes):
    with pytest.raises(InputError, match="views: expected 1 or more, found 0"):
        evaluate_homes([homes / "val/00001-HomeA"], views=0)


def test_real_homes():
    folder = REAL_HOMES / "val/00903-Sh3dStudioA"
    if not folder.is_dir():
        pytest.skip(f"no development homes at {REAL_HOMES}")
    torch.set_num_threads(1)
    counts, broken = evaluate_homes([folder], views=4)
    floor = LABELS.index("floor")
    assert not broken and all(one.iou_per_class()[floor] > 0.2 for one in counts.values())
