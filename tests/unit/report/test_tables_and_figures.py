"""Tables, verdicts and figures from records with known numbers; the averages of the paper."""

import re

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb

from zerobev.config import LABELS, NO_LABEL, CameraConfig
from zerobev.evaluation.metrics import Counts
from zerobev.report.claims import judge
from zerobev.report.figures import COLORS, flat, label_image, maps_image, top_view
from zerobev.report.own_rows import OWN_CLAIMS
from zerobev.report.paper import CLAIMS, TABLES
from zerobev.report.tables import Checks, scoreboard, table, verdict_table

from support.paths import ROOT
from support.records import record, run_record
from support.scenes import box, build, room

ROWS = TABLES[1]


def test_printed_averages_are_means_of_the_printed_classes():
    for number, rows in TABLES.items():
        for name, row in rows.items():
            assert len(row.per_class) == len(LABELS) and (row.table, row.row) == (number, name)
            # both sides are rounded to a tenth
            assert row.class_iou == pytest.approx(np.mean(row.per_class), abs=0.1), (number, name)


def test_rows_that_the_paper_prints_twice_are_equal():
    for name in ("c", "d"):
        copies = [rows[name] for rows in TABLES.values() if name in rows]
        assert len(copies) >= 3
        assert len({(row.per_class, row.class_iou, row.pixel_iou) for row in copies}) == 1


def test_table_by_hand():
    """Two seeds and two scenes of equal size: IoU is the mean over both."""
    low, high = [10, 20, 30, 40, 50, 60, 70, 80], [30, 20, 30, 40, 50, 60, 70, 90]
    records = [record("c", [low, low]), record("c", [low, high], seed=1)]
    found = table(1, records)
    assert list(found.columns) == [*LABELS, "class avg.", "pixel avg."]
    assert [key[::2] for key in found.index] == [
        (row, source) for row in ROWS for source in (("paper", "ours") if row == "c" else ("paper",))
    ]
    paper, ours = (found.xs(("c", source), level=("row", "source")).iloc[0] for source in ("paper", "ours"))
    assert paper.tolist() == [*ROWS["c"].per_class, 24.2, 58.2]
    # second seed: wall (10 + 30) / 2, tv (80 + 90) / 2; then the mean of both seeds
    assert ours.tolist() == pytest.approx([15, 20, 30, 40, 50, 60, 70, 82.5, 45.9, 45.9])


def test_pixel_average_depends_on_area_and_class_average_does_not():
    union = np.array([[100, 900, 0, 0, 0, 0, 0, 0]])
    counts = Counts(union * [[1, 0, 0, 0, 0, 0, 0, 0]], union)
    one = run_record("c-0", counts)
    ours = table(1, [one]).xs(("c", "ours"), level=("row", "source")).iloc[0]
    assert ours["class avg."] == 50 and ours["pixel avg."] == 10
    assert ours[["wall", "floor"]].tolist() == [100, 0] and ours[list(LABELS[2:])].isna().all()


def test_table_follows_every_count_and_row(monkeypatch):
    base = [[10.0] * 8, [20.0] * 8]
    before = table(1, [record("c", base), record("d", base[::-1])])
    for scene, column in ((0, 0), (1, 7)):
        changed = np.array(base)
        changed[scene, column] += 5
        after = table(1, [record("c", changed), record("d", base[::-1])])
        differs = (before != after) & ~(before.isna() & after.isna())
        rows, columns = np.nonzero(differs.to_numpy())
        assert {before.index[i][::2] for i in rows} == {("c", "ours")}
        assert {before.columns[j] for j in columns} == {LABELS[column], "class avg.", "pixel avg."}
    better = record("d", [[50.0] * 8] * 2)
    swapped = table(1, [record("d", base), record("c", [[50.0] * 8] * 2)])
    assert not table(1, [record("c", base), better]).equals(swapped)
    published = table(1, [])
    monkeypatch.setitem(TABLES, 1, {**ROWS, "c": ROWS["d"], "d": ROWS["c"]})
    assert not published.equals(table(1, []))


def test_verdict_table():
    base = np.full((6, 8), 30.0)
    records = [record("c", base), record("d", base + 5)]
    frame = verdict_table([judge(claim, records) for claim in CLAIMS])
    assert list(frame.index) == [claim.id for claim in CLAIMS]
    assert frame.loc["1.5", ["paper", "ours", "low", "high", "verdict"]].tolist() == [3.5, 5, 5, 5, "holds"]
    assert frame.loc["1.6", "verdict"] == "not run" and np.isnan(frame.loc["1.6", "ours"])
    assert all(frame[column].dtype == float for column in ("paper", "ours", "low", "high"))


def rgb(color: str) -> tuple[int, ...]:
    return tuple(round(255 * channel) for channel in to_rgb(color))


def test_colors_of_labels():
    label = np.array([[*range(len(LABELS)), NO_LABEL]], np.int8)
    image = label_image(label)
    assert image.dtype == np.uint8 and image.shape == (1, 9, 3)
    assert [tuple(color) for color in image[0, :8].tolist()] == [rgb(color) for color in COLORS]
    assert len({tuple(color) for color in image[0].tolist()} | {(255, 255, 255)}) == 10
    inside = np.arange(9)[None] % 2 == 0
    masked = label_image(label, inside)
    assert (masked[~inside] == 255).all() and np.array_equal(masked[inside], image[inside])


def test_maps_are_drawn_like_labels_with_the_floor_below():
    label = np.random.default_rng(0).integers(NO_LABEL, len(LABELS), (12, 12))
    fov = np.random.default_rng(1).random((12, 12)) < 0.7
    masks = label == np.arange(len(LABELS))[:, None, None]
    assert np.array_equal(maps_image(masks, fov), label_image(label, fov))
    everywhere = masks.copy()
    everywhere[LABELS.index("floor")] = True
    expected = np.where(label == NO_LABEL, LABELS.index("floor"), label)
    assert np.array_equal(maps_image(everywhere, fov), label_image(expected, fov))


def test_top_view_is_in_world_metres():
    label, extent = top_view(build([*room((6, 4, 2.5), corner=(1, -2, 0)), box("bed", (5, -1, 0), (6.5, 1, 0.5))]))
    assert extent == pytest.approx((1, 7, -2, 4))
    side = label.shape[0]
    rows, columns = np.indices(label.shape)
    x, y = 1 + (columns + 0.5) * 6 / side, 4 - (rows + 0.5) * 6 / side
    expected = np.where(y < 2, LABELS.index("floor"), NO_LABEL)
    expected[(x > 5) & (x < 6.5) & (y > -1) & (y < 1)] = LABELS.index("bed")
    assert (label != expected).mean() < 0.01
    assert CameraConfig(fpv_px=4, bev_px=4).extent == (-2.5, 2.5, 0.0, 5.0)


def test_checks_note_claims_that_hold_and_raise_for_others():
    checks = Checks()
    checks.holds("sum", "2", 1 + 1 == 2)
    checks.note("order", "c > d", "undecided")
    with pytest.raises(AssertionError, match="product: expected 5"):
        checks.holds("product", "5", False)
    expected = pd.DataFrame(
        {"expected": ["2", "c > d"], "verdict": ["holds", "undecided"]}, index=pd.Index(["sum", "order"], name="claim")
    )
    pd.testing.assert_frame_equal(checks.table(), expected, check_dtype=False)


def test_scoreboard_links_every_claim_to_an_existing_notebook():
    verdicts = [judge(claim, [record("c", [[30.0] * 8] * 3)]) for claim in (*CLAIMS, *OWN_CLAIMS)]
    _, _, *lines = scoreboard(verdicts).data.splitlines()
    assert [line.split("|")[1].strip() for line in lines] == [verdict.id for verdict in verdicts]
    for line in lines:
        (link,) = re.findall(r"\]\((.*?)\)", line)
        assert (ROOT / "notebooks" / link).is_file()
        assert "**not run**" in line


def test_flat_image_has_one_grey_per_mask():
    masks = np.zeros((2, 1, 3), bool)
    masks[0, 0, :2] = masks[1, 0, 1:] = True
    assert flat(masks).tolist() == [[1.0, 1.0, 0.4]]
    assert not flat(masks[:0]).any() and flat(masks[:0]).shape == (1, 3)
