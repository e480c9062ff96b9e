"""Walks: the true map against single views, drift in closed form, networks against `project`, and the scores."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from zerobev.config import LABELS
from zerobev.evaluation import walks
from zerobev.evaluation.home_scores import HomeScores
from zerobev.evaluation.walks import (
    CELLS,
    WALK_ROWS,
    Case,
    Walk,
    drifting,
    instances_from_above,
    record_walk,
    score_walk,
    walk_maps,
    walks_table,
)
from zerobev.geometry.cameras import Pose
from zerobev.inference import BevMap, Masks, load
from zerobev.mapping import Pose2D
from zerobev.mapping.grid import Grid
from zerobev.rendering.gbuffer import RayCaster
from zerobev.scenes.scene import Scene

from support.scenes import box, build, room

VIEWS = 12


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def scene() -> Scene:
    things = [
        *room((9, 5, 2.5)),
        box("bed", (7.4, 2.8, 0), (8.9, 4.8, 0.5)),
        box("chair", (4.0, 3.3, 0), (4.6, 3.9, 0.8)),
        box("sofa", (6.5, 0.2, 0), (8.5, 1.1, 0.7)),
    ]
    return build(things)


@pytest.fixture(scope="module")
def walked(scene) -> Walk:
    return record_walk(scene, load("a.2").camera, VIEWS, np.random.default_rng(0))


def true_maps(scene: Scene, walked: Walk) -> list[BevMap]:
    """The true map of each view, in all of its cells."""
    caster, found = RayCaster(scene), []
    for pose in walked.poses:
        seen = caster.bev(Pose(pose.x, pose.y, 0.0, pose.yaw), walked.camera)
        label = scene.instance_label[seen.instance]
        values = (label == np.arange(len(LABELS))[:, None, None]).astype(np.float32)
        found.append(BevMap(values, LABELS, values, np.ones(label.shape, bool), walked.camera))
    return found


def test_the_true_map_is_that_of_a_view_on_the_same_grid(scene):
    caster, camera = RayCaster(scene), load("a.2").camera
    cell, side = camera.cell_m, camera.bev_px
    grid = Grid.of((-1, -1.5, 11, 7), cell)
    whole = instances_from_above(caster, camera, grid, 0.0)
    assert whole.shape == grid.shape and set(np.unique(whole)) == {0, *(i.id for i in scene.instances if i.id in whole)}
    row, column = 10, 7  # of the upper left cell of a view's map that faces +y
    pose = Pose(grid.x0 + (column + side / 2) * cell, grid.extent[3] - (row + side) * cell, 0.0, np.pi / 2)
    assert np.array_equal(whole[row : row + side, column : column + side], caster.bev(pose, camera).instance)


def test_fused_true_maps_are_the_true_map(scene, walked):
    """Up to the resampling of cells at an angle; with wrong poses they are not."""
    scores = {}
    for name, poses in {"exact": walked.poses, "mirrored": [replace(p, yaw=-p.yaw) for p in walked.poses]}.items():
        *_, home = walked.fused(true_maps(scene, walked), poses)
        predicted = np.stack(list(home.maps.values()))
        scores[name] = HomeScores.of(predicted, walked.truth, home.viewed & walked.box)
    present = walked.truth.any(axis=(1, 2))
    assert present.sum() == 4  # walls, seen from inside alone, have no upper side
    assert scores["exact"].iou()[present].min() > 0.8 and scores["exact"].boundary_f1()[present].min() > 0.95
    assert np.nanmean(scores["mirrored"].iou()) < 0.5


def test_an_odometry_without_errors_is_right_and_errors_add_up(monkeypatch):
    turns = [Pose2D(0, 0, 3.0), Pose2D(-0.5, 0, -3.0), Pose2D(-1, -0.1, -2.0), Pose2D(-1, 0.4, 1.5)]
    straight = [Pose2D(k * 0.5, 0, 0) for k in range(101)]
    ends = np.array([(p.x, p.y, p.yaw) for p in (drifting(straight, np.random.default_rng(k))[-1] for k in range(300))])
    # 100 steps: the heading has sqrt(100) times the error of a step; the error of position along the way adds up alike
    assert ends[:, 2].std() == pytest.approx(np.radians(0.5) * 10, rel=0.15)
    # across, the sum of all headings before: 0.5 m * 0.5 degrees * sqrt(sum of squares)
    across = 0.5 * np.radians(0.5) * np.sqrt(np.sum(np.arange(100) ** 2))
    assert ends[:, 1].std() == pytest.approx(np.hypot(across, 0.01 * 10), rel=0.15)
    assert abs(ends[:, 1].mean()) < across / 4
    monkeypatch.setattr(walks, "DRIFT", 0)
    monkeypatch.setattr(walks, "DRIFT_DEG", 0)
    for found, true in zip(drifting(turns, np.random.default_rng(0)), turns, strict=True):
        assert (found.x, found.y, found.yaw) == pytest.approx((true.x, true.y, true.yaw))


@pytest.mark.slow
def test_maps_are_those_of_project(walked):
    rows = [row for row in WALK_ROWS if row != "a.1"]
    maps = walk_maps(walked, rows)
    for number in (0, VIEWS - 1):
        view = {name: images[number].numpy() for name, images in walked.views.items()}
        for row in rows:
            depth = view["sensor"][0] if row.endswith(".sensor") else None
            rgb = np.moveaxis(view["rgb"], 0, -1)
            bev = load(row.removesuffix(".sensor")).project(rgb, Masks(view["zero"]), depth=depth)
            np.testing.assert_allclose(maps[row][number].values, bev.values, atol=1e-3)
            if not row.startswith("a."):  # whose maps are restricted to cells with a pixel
                assert np.array_equal(maps[row][number].fov, bev.fov)
            assert not (maps[row][number].fov & ~bev.fov).any()


@pytest.mark.slow
def test_scores_of_a_walk(walked, monkeypatch):
    scores = score_walk(walked, (1, VIEWS), np.random.default_rng(0))
    assert set(scores) == {
        Case(row, poses, views, cells)
        for row in WALK_ROWS for poses in ("exact", "drifting") for views in (1, VIEWS) for cells in CELLS
    }  # fmt: skip
    assert all(Case.parse(" ".join(map(str, case))) == case for case in scores)
    for case, score in scores.items():
        # true cells: both maps have the same ones, whatever the row and the poses
        alike = scores[case._replace(row="a.1", poses="exact")]
        assert np.array_equal(score.recall.union, alike.recall.union)
        if case.row == "a.1" and case.poses == "exact" and case.cells == "unseen":
            assert not score.precision.union.any()  # cells without a pixel stay unknown to P^-1
    oracle = [np.nanmean(scores[Case("a.1", "exact", views, "home")].iou()) for views in (1, VIEWS)]
    assert oracle[1] > 2 * oracle[0] > 0
    table = walks_table({case: scores[case] for case in sorted(scores, key=str)}).set_index(list(Case._fields))
    assert table.index.get_level_values("views").is_monotonic_increasing
    assert table.loc[("a.1", "exact", VIEWS, "home"), "miou"] == pytest.approx(100 * oracle[1])
    monkeypatch.setattr(walks, "walk_maps", lambda _: {"a.1": walk_maps(walked, ["a.1"])["a.1"]})
    again = score_walk(walked, (1, VIEWS), np.random.default_rng(0))
    assert all(score.to_json() == scores[case].to_json() for case, score in again.items())
