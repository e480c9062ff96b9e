"""Verdicts on claims, and quotients of rows, from records with known numbers."""

import numpy as np
import pytest

from zerobev.common.errors import InputError
from zerobev.config import LABELS
from zerobev.report.claims import compare, judge
from zerobev.report.paper import CLAIMS, RATIOS, TABLES, Ordering, Ratio, Similar

from support.records import record

CLAIM = Ordering("1.5", "class", "better", "d", "c")


def test_every_claim_names_rows_of_its_table_and_holds_in_the_paper():
    assert len({claim.id for claim in CLAIMS}) == len(CLAIMS)
    for claim in CLAIMS:
        verdict = judge(claim, [])
        assert verdict.verdict == "not run" and verdict.table == claim.table
        assert verdict.paper > 0 if isinstance(claim, Ordering) else verdict.paper == pytest.approx(claim.points / 2)
        assert verdict.ours is verdict.low is verdict.high is None


@pytest.mark.parametrize(
    "gain, expected",
    [([5, 6, 4, 5, 7, 5], "holds"), ([-5, -6, -4, -5, -7, -5], "does not hold"), ([5, -6, 4, -5, 7, -4], "undecided")],
)
@pytest.mark.parametrize("metric", ["class", "pixel", "floor", "objects"])
def test_verdicts_on_orderings(gain, expected, metric):
    worse = np.linspace(20, 40, 6)[:, None] + np.zeros(8)
    better = worse + np.array(gain)[:, None]
    records = [record("c", worse), record("d", better)]
    claim = Ordering("1.0", metric, "text", "d", "c")
    verdict = judge(claim, records)
    assert verdict.verdict == expected
    assert verdict.ours == pytest.approx(np.mean(gain), abs=0.06)
    assert min(gain) <= verdict.low <= verdict.ours <= verdict.high <= max(gain)
    objects = [np.mean(TABLES[1][row].per_class[2:]) for row in ("d", "c")]
    published = {"class": 3.5, "pixel": 0.7, "floor": -0.2, "objects": objects[0] - objects[1]}[metric]
    assert verdict.paper == pytest.approx(published, abs=0.06)
    assert verdict == judge(claim, records)  # deterministic


@pytest.mark.parametrize(
    "offsets, expected", [((0, 0.5, 0.2), "holds"), ((0, 3, 1), "does not hold"), ((1, 0, 0.9), "holds")]
)
def test_verdicts_on_similar_rows_compare_the_lowest_and_the_highest(offsets, expected):
    base = np.linspace(20, 40, 6)[:, None] + np.zeros(8)
    rows = ("c.10", "c.25", "c")
    records = [record(row, base + offset) for row, offset in zip(rows, offsets)]
    verdict = judge(Similar("4.1", "class", "text", rows, 1.4), records)
    assert (verdict.verdict, verdict.ours) == (expected, pytest.approx(max(offsets), abs=0.06))


def test_rows_whose_spread_straddles_the_limit_are_undecided():
    base = np.full((6, 8), 30.0)
    noise = np.array([4, -2, 4, -2, 4, 0])[:, None]
    claim = Similar("2.3", "class", "text", ("c.I", "c.II"), 0.8)
    assert judge(claim, [record("c.I", base), record("c.II", base + noise)]).verdict == "undecided"


def test_verdict_on_one_class_uses_that_class():
    worse = np.full((6, 8), 30.0)
    better = worse + 5 * np.eye(8)[LABELS.index("floor")] - 5 * np.eye(8)[LABELS.index("bed")]
    records = [record("c", worse), record("d", better)]
    found = {m: judge(Ordering("1.0", m, "", "d", "c"), records).verdict for m in ("floor", "bed", "wall", "objects")}
    assert found == {"floor": "holds", "bed": "does not hold", "wall": "undecided", "objects": "does not hold"}


@pytest.mark.parametrize("gains, expected", [((9, 3), "holds"), ((9, -3), "undecided"), ((-9, -3), "does not hold")])
def test_verdict_is_on_all_seeds(gains, expected):
    base = np.full((6, 8), 30.0)
    records = [record("c", base), *(record("d", base + gain, seed=seed) for seed, gain in enumerate(gains))]
    verdict = judge(CLAIM, records)
    assert verdict.ours == pytest.approx(np.mean(gains)) and verdict.verdict == expected
    assert (verdict.low, verdict.high) == (min(gains), max(gains))


def test_records_of_other_rows_change_nothing():
    base = np.full((6, 8), 30.0)
    records = [record("c", base), record("d", base + 5)]
    assert judge(CLAIM, [*records, record("a.1", base + 20)]) == judge(CLAIM, records)


def test_runs_on_other_test_scenes_are_not_compared():
    base = np.full((2, 8), 30.0)
    other = record("d", base + 5)
    other.scenes[:] = other.scenes[::-1]
    with pytest.raises(InputError, match="expected runs on the same test scenes"):
        judge(CLAIM, [record("c", base), other])


def test_ratios():
    base = np.linspace(20, 40, 6)[:, None] + np.zeros(8)
    records = [record("a.1", base), record("c", base * 0.75)]
    found = compare(Ratio("c", "a.1", "pixel"), records)
    assert (found["ours"], found["low"], found["high"]) == (
        pytest.approx(0.75),
        pytest.approx(0.75),
        pytest.approx(0.75),
    )
    # as in the paper's text, to two digits
    published = [round(compare(ratio, [])["paper"], 2) for ratio in RATIOS]
    assert published == [0.74, 1.36, 0.84, 1.38, 0.8, 0.85, 0.91, 0.86]
    assert compare(RATIOS[2], records)["ours"] is None
