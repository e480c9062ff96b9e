"""Photographs of other cameras: masks against true maps, and the map of a scaled scene in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from zerobev.config import LABELS, CameraConfig
from zerobev.evaluation import other_cameras
from zerobev.evaluation.other_cameras import CameraStudio, ScaledCells
from zerobev.geometry.cameras import Camera
from zerobev.inference.masks import Masks
from zerobev.inference.pretrained import GEOMETRIC
from zerobev.inference.projector import load
from zerobev.scenes.hm3dsem_writer import write_scene

from support.scenes import build, furnished

NETWORK = CameraConfig(fpv_px=64, bev_px=40)
FLOOR = LABELS.index("floor")


@pytest.fixture(scope="module")
def studio(tmp_path_factory) -> CameraStudio:
    folder = tmp_path_factory.mktemp("home") / "00000-Test"
    write_scene(folder, build(furnished()))
    return CameraStudio(folder, NETWORK, np.random.default_rng(0))


@pytest.mark.parametrize(
    "camera",
    [
        Camera(),
        Camera(height_m=0.4),
        Camera(height_m=1.6),
        Camera(pitch_deg=-25),
        Camera(pitch_deg=12, roll_deg=5, height_m=1.2),
        Camera(hfov_deg=55),
        Camera(hfov_deg=105),
    ],
)
def test_true_depth_puts_masks_of_any_camera_at_their_true_places(studio, camera):
    projector = load(GEOMETRIC)
    found = wrong = recalled = total = 0
    for pose in studio.poses:
        view = studio.take(pose, camera)
        maps = projector.project(view.rgb, Masks(view.masks, channels="first"), camera, view.depth).maps
        # a projected point may fall just beside the edge of its surface
        near = binary_dilation(view.target[FLOOR], iterations=1)
        found, wrong = found + maps[FLOOR].sum(), wrong + (maps[FLOOR] & ~near).sum()
        recalled, total = recalled + (maps[FLOOR] & view.fov).sum(), total + (view.target[FLOOR] & view.fov).sum()
    assert found > 200 and wrong < 0.04 * found  # under furniture, which the map shows
    assert recalled > 0.3 * total  # of the floor in the field of view; the rest is hidden, or between rows of pixels


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_a_point_of_a_scaled_scene_is_at_scaled_coordinates(factor):
    cells = ScaledCells(NETWORK, factor)
    right, forward = 1.3, 1.9  # of a point of the scene
    side, cell = NETWORK.bev_px, NETWORK.cell_m

    def index(x: float, y: float) -> tuple[int, int, int]:
        return 0, side - 1 - int(y // cell), int((x + 2.5) // cell)

    scaled = np.zeros((1, side, side), bool)
    if factor * forward < 5 and factor * right < 2.5:
        scaled[index(factor * right, factor * forward)] = True
    found = cells.resampled(scaled)
    assert found[index(right, forward)] == scaled.any()
    rows, columns = np.nonzero(cells.on_map)
    reach = min(5.0, 5.0 / factor)
    assert (side - rows.min()) * cell == pytest.approx(reach) and np.ptp(columns) + 1 == round(reach / cell)


def test_the_part_outside_a_narrow_photograph_is_not_evaluated(studio):
    pose = studio.poses[0]
    wide, narrow = (studio.take(pose, replace(Camera(), hfov_deg=hfov)).fov for hfov in (79.0, 50.0))
    assert narrow.sum() < wide.sum() and not (narrow & ~wide).any()


def test_counts_are_per_camera_row_and_home(studio, tmp_path, monkeypatch):
    write_scene(tmp_path / "00000-Test", build(furnished()))
    monkeypatch.setattr(other_cameras, "CAMERAS", {"height_m": (0.88, 1.4)})
    monkeypatch.setattr(other_cameras, "POSES", 2)
    counts = other_cameras.evaluate_cameras([tmp_path / "00000-Test"])
    as_trained, higher = counts["height_m", 0.88], counts["height_m", 1.4]
    assert {row.split(".")[-1] for row in set(higher) - set(as_trained)} == {"common", "scaled"}
    for row in (row for row in higher if row.endswith(".scaled")):
        assert (higher[row].union <= higher[row.replace("scaled", "common")].union.sum() * 4).all()
        assert higher[row].union.sum() > 0
    table = other_cameras.cameras_table(counts)
    assert len(table) == len(as_trained) + len(higher) and table[["class", "pixel"]].notna().all(axis=None)
