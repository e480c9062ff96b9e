"""Differences, trends, curves and sentences from records with known numbers."""

import numpy as np
import pandas as pd
import pytest

from zerobev.config import LABELS
from zerobev.report.claims import VERDICTS, judge
from zerobev.report.findings import (
    class_gains,
    flow_outcome,
    gain,
    learning_table,
    listed,
    lost_objects,
    outcomes,
    painted,
    slope,
)
from zerobev.report.names import named
from zerobev.report.own_rows import OWN_CLAIMS
from zerobev.report.paper import CLAIMS
from zerobev.report.reasons import REASONS

from support.records import record

BASE = np.full((6, 8), 30.0)
ONE = np.eye(8)


def test_gain_per_class_and_its_sign():
    chair, tv = LABELS.index("chair"), LABELS.index("tv")
    records = [record("c", BASE + 4 * ONE[chair] - 8 * ONE[tv]), record("a.2", BASE)]
    frame = class_gains("c", "a.2", records, 1)
    assert frame["ours"].tolist() == pytest.approx([0, 0, 4, 0, 0, 0, 0, -8, -0.5, -0.5])
    assert frame.loc["wall", "paper"] == pytest.approx(-1.7) and frame.loc["pixel avg.", "paper"] == pytest.approx(18.5)
    assert [gain("c", "a.2", name, records).sign for name in ("chair", "tv", "bed")] == [1, -1, 0]
    assert gain("c", "d", "class", records) is None
    assert str(gain("c", "a.2", "chair", records)) == "+4.0 points (90 % interval +4.0 to +4.0)"
    assert class_gains("c", "a.2", records, 6)["paper"].isna().all()


def test_slope_is_that_of_a_line():
    position = {"c.10": 1.0, "c": 2.0, "c.30": 3.0}
    records = [record(row, BASE + 1.5 * x) for row, x in position.items()]
    assert slope(position, "class", records).value == pytest.approx(1.5)
    assert slope(position, "class", records[:2]) is None


def test_a_sentence_per_claim_with_both_numbers_and_the_reason_of_its_verdict():
    claims = [claim for claim in CLAIMS if claim.id in ("3.1", "3.2", "4.1")]
    worse = [record("d", BASE), record("d.gt", BASE + 2)]
    (line,) = outcomes(claims, worse).data.splitlines()
    assert line.startswith("- **3.1 does not hold:**") and "-2.0 points (-2.0 to -2.0); the paper's is +0.2" in line
    assert line.endswith(REASONS["3.1"]["does not hold"])
    (line,) = outcomes(claims, [record("d", BASE + 2), record("d.gt", BASE)]).data.splitlines()
    assert line.startswith("- **3.1 holds:**") and line.endswith("the paper's is +0.2.")
    mixed = BASE + np.array([1, -1, 1, -1, 1, -1.0])[:, None]
    (line,) = outcomes(claims, [record("d", mixed), record("d.predicted", BASE)]).data.splitlines()
    assert line.startswith("- **3.2 undecided:**") and "includes zero and the paper's number" in line


def test_reasons_are_of_claims_and_verdicts():
    assert set(REASONS) <= {claim.id for claim in (*CLAIMS, *OWN_CLAIMS)}
    assert {verdict for reasons in REASONS.values() for verdict in reasons} <= set(VERDICTS)


def test_learning_table_compares_the_halves_of_a_training():
    one = record("c", BASE)
    one.result["history"] = {"step": [1, 100, 150, 200, 300], "validation": [None, 0.8, None, 0.6, 0.5]}
    frame = learning_table([one, record("a.1", BASE)])
    assert list(frame.index) == [named("c")]
    # halfway, at step 150, the line from 0.8 to 0.6 has 0.7
    assert frame.iloc[0].tolist() == pytest.approx([300, 0.8, 0.7, 0.5, 2.0])


def test_painted_is_a_percentage_of_the_cells_in_view():
    fov = np.array([[[True, True], [True, False]]])
    truth = np.zeros((1, 8, 2, 2), bool)
    truth[0, 1] = True
    frame = painted({"c": ~truth}, truth, fov)
    assert frame.loc["truth", ["wall", "floor", "all"]].tolist() == [0, 100, 100]
    assert frame.loc[named("c"), ["wall", "floor", "all"]].tolist() == [100, 0, 700]


@pytest.mark.parametrize(
    "shift, words",
    [(-0.3, "**beats** no motion"), (0.3, "**is worse than** no motion"), (0, "**cannot be told from** no motion")],
)
def test_flow_is_compared_with_no_motion(shift, words):
    lines = [
        {"flow": flow, "pair": pair, "row": row, "start": 0.5, "motion": 0.4 + (shift if row == "d" else 0)}
        for flow in ("tvl1", "true") for pair in range(5) for row in ("still", "d")
    ]  # fmt: skip
    text = flow_outcome(pd.DataFrame(lines))
    assert text.count(words) == 2 and f"{0.4 + shift:.2f} m against 0.40 m" in text
    assert ("0.50 m from its true place" in text) == (shift >= 0)


def test_lost_objects_names_the_classes_with_a_loss():
    records = [record("c", BASE - 8 * ONE[LABELS.index("tv")]), record("a.2", BASE)]
    assert "tv (22.0 against 30.0)" in lost_objects(records) and "bed" not in lost_objects(records)
    assert "loses no class" in lost_objects([record("c", BASE), record("a.2", BASE)])


def test_listed():
    assert [listed(names) for names in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == [
        "none",
        "a",
        "a and b",
        "a, b and c",
    ]


def test_a_judged_claim_and_its_gain_agree():
    records = [record("c", BASE + 1.26), record("-", BASE)]
    verdict = judge(next(claim for claim in CLAIMS if claim.id == "2.1"), records)
    assert verdict.ours == pytest.approx(gain("c", "-", "class", records).value, abs=0.05)
