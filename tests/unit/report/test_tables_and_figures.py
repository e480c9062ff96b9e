"""Tables, verdicts and figures from records with known numbers; the averages of the paper."""

import re

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb
from matplotlib.text import Text

from zerobev.config import LABELS, NO_LABEL, CameraConfig
from zerobev.evaluation.metrics import Counts
from zerobev.report.claims import judge
from zerobev.report.figures import (
    COLORS,
    OUTSIDE,
    averages_figure,
    flat,
    gallery_figure,
    label_image,
    maps_image,
    mask_image,
    scoreboard_figure,
    top_view,
)
from zerobev.report.names import NAMES, named
from zerobev.report.own_rows import OWN_CLAIMS, OWN_ROWS
from zerobev.report.paper import CLAIMS, TABLES
from zerobev.report.tables import Checks, counted, order_of, rows_of, scoreboard, table, verdict_table

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
    assert len({tuple(color) for color in image[0].tolist()} | {rgb(OUTSIDE)}) == 10
    inside = np.arange(9)[None] % 2 == 0
    masked = label_image(label, inside)
    assert (masked[~inside] == rgb(OUTSIDE)).all() and np.array_equal(masked[inside], image[inside])


def test_colors_of_masks():
    image = mask_image(np.array([[True, False, True, False]]), np.array([[True, True, False, False]]), "#ff0000")
    assert image[0].tolist() == [[255, 0, 0], [0, 0, 0], [*rgb(OUTSIDE)], [*rgb(OUTSIDE)]]


def test_no_marker_and_no_text_of_the_figures_is_lost():
    """Text has at least 8 points, markers lie inside the axes, and the legend names every colour."""
    base = np.linspace(20, 40, 6)[:, None] + np.zeros(8)
    records = [record(row, base + shift) for row, shift in (("c", 0.0), ("d.I", 0.4), ("d", 60.0))]
    verdicts = [judge(claim, records) for claim in CLAIMS]
    views = {"rgb": np.zeros((1, 4, 4, 3), np.uint8), "fpv_label": np.zeros((1, 4, 4), int)}
    views |= {"bev_label": np.zeros((1, 4, 4), int), "fov": np.ones((1, 4, 4), bool)}
    gallery = gallery_figure(views, {"c": np.zeros((1, 8, 4, 4), bool)})
    for figure in (averages_figure(2, records), scoreboard_figure(verdicts), gallery):
        figure.draw_without_rendering()
        assert min(text.get_fontsize() for text in figure.findobj(Text) if text.get_text()) >= 8
        for axes in figure.axes:
            (left, right), (bottom, top) = sorted(axes.get_xlim()), sorted(axes.get_ylim())
            for line in axes.lines:
                if line.get_marker() not in ("None", None, ""):
                    x, y = (np.asarray(values, float) for values in line.get_data())
                    assert ((left <= x) & (x <= right) & (bottom <= y) & (y <= top)).all()
    assert [text.get_text() for text in gallery.legends[0].get_texts()] == [*LABELS, "no class", "outside the view"]
    plt.close("all")


def test_every_row_of_a_table_has_a_name():
    assert {row for number in (*TABLES, *OWN_ROWS) for row in rows_of(number)} == set(NAMES)
    assert (named("c"), named("c", letter=False), named("x"), named("x", letter=False)) == (
        "(c) Zero-BEV",
        "Zero-BEV",
        "(x)",
        "(x)",
    )


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
    checks.holds("sum", "2", 1 + 1, 1 + 1 == 2)
    checks.note("order", "c > d", "c = d", "undecided")
    checks.note("size", "above 3", 2, 2 > 3)
    with pytest.raises(AssertionError, match="product: expected 5, found 6"):
        checks.holds("product", "5", 6, False)
    expected = pd.DataFrame(
        {
            "expected": ["2", "c > d", "above 3"],
            "found": ["2", "c = d", "2"],
            "verdict": ["holds", "undecided", "does not hold"],
        },
        index=pd.Index(["sum", "order", "size"], name="claim"),
    )
    pd.testing.assert_frame_equal(checks.table(), expected, check_dtype=False)


def test_checks_show_the_numbers_of_verdicts():
    base = np.full((6, 8), 30.0)
    checks = Checks()
    checks.judged([judge(claim, [record("c", base), record("d", base + 5)]) for claim in CLAIMS[4:6]])
    lines = checks.table().to_numpy().tolist()
    assert lines[0] == ["+3.5 points in the paper", "+5.0 points (+5.0 to +5.0)", "holds"]
    assert lines[1] == ["+3.0 points in the paper", "", "not run"]


@pytest.mark.parametrize(
    "value, text", [(0, "below 1e-6"), (3e-9, "below 1e-6"), (-0.02, "below 1e-1"), (2e-6, "below 1e-5")]
)
def test_order_of_a_small_number(value, text):
    assert order_of(value) == text
    assert order_of(9e-7, 1e-5) == order_of(2e-6, 1e-5) == "below 1e-5"


def test_scoreboard_links_every_claim_to_an_existing_notebook():
    verdicts = [judge(claim, [record("c", [[30.0] * 8] * 3)]) for claim in (*CLAIMS, *OWN_CLAIMS)]
    _, _, *lines = scoreboard(verdicts).data.splitlines()
    ids = [line.split("|")[1].strip() for line in lines]
    assert sorted(ids) == sorted(verdict.id for verdict in verdicts)
    assert [id.split(".")[0] for id in ids] == sorted(id.split(".")[0] for id in ids)
    assert counted(verdicts) == f"{len(verdicts)} are not run"
    for line in lines:
        (link,) = re.findall(r"\]\((.*?)\)", line)
        assert (ROOT / "notebooks" / link).is_file()
        assert "**not run**" in line


def test_flat_image_has_one_grey_per_mask():
    masks = np.zeros((2, 1, 3), bool)
    masks[0, 0, :2] = masks[1, 0, 1:] = True
    assert flat(masks).tolist() == [[1.0, 1.0, 0.4]]
    assert not flat(masks[:0]).any() and flat(masks[:0]).shape == (1, 3)
