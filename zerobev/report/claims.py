"""Verdicts on the paper's claims, computed from our records: holds, does not hold, or undecided.

Claims are about the sign of a gain or the spread of several rows, not about absolute numbers, since the scenes differ.
A verdict uses means over seeds with a 90 % bootstrap interval over test scenes and seeds.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Literal, get_args

import numpy as np

from zerobev.common.errors import InputError
from zerobev.config import LABELS
from zerobev.evaluation.metrics import DRAWS, INTERVAL, Statistic, class_iou, iou_per_class, pixel_iou, resampled_scenes
from zerobev.experiments.run_records import RunRecord
from zerobev.report.paper import CLAIMS, TABLES, Ordering, Ratio, Row, Similar

_OBJECTS = [LABELS.index(name) for name in LABELS if name not in ("wall", "floor")]

#: From the statistic of each row of a claim, (..., rows), to the number to be judged, (...).
Measure = Callable[[np.ndarray], np.ndarray]


VerdictName = Literal["holds", "does not hold", "undecided", "not run"]
VERDICTS: tuple[VerdictName, ...] = get_args(VerdictName)


@dataclass(frozen=True)
class Verdict:
    """A claim, and the result of our records."""

    id: str
    table: int
    claim: str
    paper: float | None  #: IoU points; None if the paper has no such row
    ours: float | None
    low: float | None  #: 90 % interval over test scenes and seeds
    high: float | None
    verdict: VerdictName


def judge(claim: Ordering | Similar, records: Sequence[RunRecord]) -> Verdict:
    """The verdict on a claim of the paper or of `zerobev.report.own_rows`.

    An ordering holds if the interval of the paired gain lies above zero, and does not hold if it lies below. A
    similarity holds if the interval of the rows' spread lies below the claim's `points`, and does not hold if it lies
    above. All else is undecided. Records of other rows are ignored.

    Raises `InputError` for records of different test scenes.
    """
    rows, measure = _judged(claim)
    of_paper = TABLES.get(claim.table, {})
    paper = None
    if set(rows) <= set(of_paper):
        paper = round(float(measure(np.array([published(of_paper[row], claim.metric) for row in rows]))), 1)
    text = f"{_named(claim)}: {claim.text}"
    found = measured(rows, claim.metric, measure, records)
    if found is None:
        return Verdict(claim.id, claim.table, text, paper, None, None, None, "not run")
    ours, low, high = (round(100 * value, 1) for value in found)
    lowest, highest = 100 * found[1], 100 * found[2]  # the verdict is on values before rounding
    verdict: VerdictName
    if isinstance(claim, Ordering):
        verdict = "holds" if lowest > 0 else "does not hold" if highest < 0 else "undecided"
    else:
        verdict = "holds" if highest < claim.points else "does not hold" if lowest > claim.points else "undecided"
    return Verdict(claim.id, claim.table, text, paper, ours, low, high, verdict)


def limit_of(verdict: Verdict) -> float | None:
    """The limit of a verdict on a spread, IoU points; None for a verdict on an ordering."""
    claims = {claim.id: claim for claim in CLAIMS}
    claim = claims.get(verdict.id)
    return claim.points if isinstance(claim, Similar) else None


def compare(ratio: Ratio, records: Sequence[RunRecord]) -> dict[str, str | float | None]:
    """A quotient of two rows in the paper and here, with our 90 % interval; None if a row has no record."""
    rows = (ratio.numerator, ratio.denominator)
    of_paper = [published(TABLES[1][row], ratio.metric) for row in rows]
    found = measured(rows, ratio.metric, lambda values: values[..., 0] / values[..., 1], records)
    ours, low, high = (None, None, None) if found is None else (round(value, 3) for value in found)
    return {**asdict(ratio), "paper": round(of_paper[0] / of_paper[1], 3), "ours": ours, "low": low, "high": high}


def _judged(claim: Ordering | Similar) -> tuple[tuple[str, ...], Measure]:
    """The rows of a claim, and the number to be judged."""
    if isinstance(claim, Ordering):
        return (claim.better, claim.worse), lambda values: values[..., 0] - values[..., 1]
    return claim.rows, lambda values: values.max(axis=-1) - values.min(axis=-1)


def _named(claim: Ordering | Similar) -> str:
    if isinstance(claim, Ordering):
        return f"({claim.better}) > ({claim.worse}), {claim.metric} IoU"
    return f"{', '.join(f'({row})' for row in claim.rows)} within {claim.points} points, {claim.metric} IoU"


def measured(
    rows: Sequence[str], metric: str, measure: Measure, records: Sequence[RunRecord]
) -> tuple[float, float, float] | None:
    """A number of several rows and the ends of its 90 % interval, IoU in [0, 1]; None if a row has no record.

    metric: see `zerobev.report.paper.Claim`
    Raises `InputError` for records of different test scenes.
    """
    runs = {row: [record for record in records if record.row == row] for row in rows}
    if not all(runs.values()):
        return None
    if len({tuple(run.scenes) for found in runs.values() for run in found}) > 1:
        raise InputError(f"records of {' and '.join(rows)}: expected runs on the same test scenes, found others")
    statistic = _statistic(metric)
    counts = [[run.counts for run in runs[row]] for row in rows]
    whole = measure(np.array([np.mean([one.value(statistic) for one in seeds]) for seeds in counts]))
    draws = measure(np.stack(resampled_scenes(counts, statistic, np.random.default_rng(0), DRAWS), axis=-1))
    low, high = np.nanquantile(draws, INTERVAL)
    return float(whole), float(low), float(high)


def published(row: Row, metric: str) -> float:
    """The paper's IoU of a row, in percent; for "objects" the mean over the six object classes."""
    if metric in LABELS:
        return row.per_class[LABELS.index(metric)]
    if metric == "objects":
        return float(np.mean([row.per_class[i] for i in _OBJECTS]))
    return row.class_iou if metric == "class" else row.pixel_iou


def _statistic(metric: str) -> Statistic:
    if metric in LABELS:
        column = LABELS.index(metric)
        return lambda intersection, union: iou_per_class(intersection, union)[..., column]
    if metric == "objects":
        return lambda intersection, union: class_iou(intersection[..., _OBJECTS], union[..., _OBJECTS])
    return {"class": class_iou, "pixel": pixel_iou}[metric]
