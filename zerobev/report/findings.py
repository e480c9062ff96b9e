"""Numbers behind the notebooks' sections on results: differences, trends and training curves, from the records."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from IPython.display import Markdown
from matplotlib.figure import Figure

from zerobev.config import LABELS
from zerobev.evaluation.metrics import DRAWS, INTERVAL
from zerobev.experiments.run_records import RunRecord
from zerobev.report.claims import Measure, Verdict, judge, measured, published
from zerobev.report.names import named
from zerobev.report.paper import TABLES, Ordering, Similar
from zerobev.report.reasons import REASONS


@dataclass(frozen=True)
class Estimate:
    """A number in IoU points with its 90 % interval over test homes and seeds."""

    value: float
    low: float
    high: float

    @property
    def sign(self) -> int:
        """1 or -1 if the whole interval is on one side of zero, else 0."""
        return int(self.low > 0) - int(self.high < 0)

    def __str__(self) -> str:
        return f"{self.value:+.1f} points (90 % interval {self.low:+.1f} to {self.high:+.1f})"


def _estimate(rows: Sequence[str], metric: str, measure: Measure, records: Sequence[RunRecord]) -> Estimate | None:
    found = measured(rows, metric, measure, records)
    return None if found is None else Estimate(*(100 * value for value in found))


def gain(better: str, worse: str, metric: str, records: Sequence[RunRecord]) -> Estimate | None:
    """Difference of two rows; None if a row has no record.

    metric: see `zerobev.report.paper.Claim`
    """
    return _estimate((better, worse), metric, lambda values: values[..., 0] - values[..., 1], records)


def slope(position: Mapping[str, float], metric: str, records: Sequence[RunRecord]) -> Estimate | None:
    """Least-squares slope of the metric over the positions of rows, per unit of position; None without a record."""
    x = np.array(list(position.values())) - np.mean(list(position.values()))
    return _estimate(list(position), metric, lambda values: values @ x / (x @ x), records)


def class_gains(better: str, worse: str, records: Sequence[RunRecord], number: int) -> pd.DataFrame:
    """Difference of two rows of a table per class and in both averages: the paper's, ours, and our interval."""
    lines = {}
    of_paper = TABLES.get(number, {})
    for metric in (*LABELS, "class", "pixel"):
        paper = np.nan
        if {better, worse} <= set(of_paper):
            paper = published(of_paper[better], metric) - published(of_paper[worse], metric)
        ours = gain(better, worse, metric, records) or Estimate(np.nan, np.nan, np.nan)
        lines[f"{metric} avg." if metric in ("class", "pixel") else metric] = (paper, ours.value, ours.low, ours.high)
    frame = pd.DataFrame(lines, index=["paper", "ours", "low", "high"]).T.round(1)
    return frame.rename_axis(f"({better}) - ({worse})")


def listed(names: Sequence[str]) -> str:
    """`a, b and c`; `none` if there is none."""
    names = list(names)
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]])) or "none"


def outcomes(claims: Sequence[Ordering | Similar], records: Sequence[RunRecord]) -> Markdown:
    """The verdict on each claim as a sentence, with our number, the paper's, and the reason if one is known."""
    lines = []
    for claim in claims:
        v = judge(claim, records)
        if v.ours is None:
            continue
        kind = "difference" if isinstance(claim, Ordering) else f"spread, with a limit of {claim.points:g},"
        paper = "" if v.paper is None else f"; the paper's is {v.paper:+.1f}"
        why = REASONS.get(claim.id, {}).get(v.verdict, _undecided(claim, v) if v.verdict == "undecided" else "")
        lines.append(
            f"- **{claim.id} {v.verdict}:** {claim.text.rstrip('.')}. Our {kind} is {v.ours:+.1f} points "
            f"({v.low:+.1f} to {v.high:+.1f}){paper}. {why}".rstrip()
        )
    return Markdown("\n".join(lines))


def _undecided(claim: Ordering | Similar, verdict: Verdict) -> str:
    """What the interval of an undecided claim includes."""
    border = "zero" if isinstance(claim, Ordering) else "the limit"
    if verdict.paper is None or verdict.low is None or verdict.high is None:
        return f"The interval includes {border}."
    if verdict.low <= verdict.paper <= verdict.high:
        return f"The interval includes {border} and the paper's number: more homes or seeds would decide."
    return f"The interval includes {border}, but not the paper's number."


def learning_table(records: Sequence[RunRecord]) -> pd.DataFrame:
    """Validation loss of each trained row, mean over seeds: first, halfway, last; and whether it was still falling.

    The last column is the change from halfway to the end relative to the change from the first to halfway.
    """
    lines = {}
    for row in dict.fromkeys(record.row for record in records):
        curves = [_validation(record) for record in records if record.row == row and record.history]
        if not curves:
            continue
        first, middle, last = np.mean([(y[0], np.interp(x[-1] / 2, x, y), y[-1]) for x, y in curves], axis=0)
        late = (middle - last) / (first - middle) if first > middle else np.nan
        steps = int(np.mean([x[-1] for x, _ in curves]))
        lines[named(row)] = (steps, first, middle, last, late)
    columns = ["steps", "first", "halfway", "last", "later gain / earlier gain"]
    return pd.DataFrame(lines, index=columns).T.astype({"steps": int}).round(3)


def learning_figure(records: Sequence[RunRecord]) -> Figure:
    """Validation loss over training steps of each trained row, mean over seeds, relative to its first value."""
    figure, axes = plt.subplots(figsize=(7, 3.2))
    styles = [(marker, line) for line in ("-", "--") for marker in "osD^vP*"]
    rows = [row for row in dict.fromkeys(r.row for r in records) if any(r.row == row and r.history for r in records)]
    for row, (marker, line) in zip(rows, styles):
        curves = [_validation(record) for record in records if record.row == row]
        mean = np.mean([y / y[0] for _, y in curves], axis=0)
        axes.plot(curves[0][0], mean, linestyle=line, marker=marker, markersize=5, clip_on=False, label=named(row))
    axes.set(xlabel="training step", ylabel="validation loss / its first value")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    axes.grid(alpha=0.3)
    figure.tight_layout()
    return figure


def _validation(record: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    """Steps and validation losses of a run."""
    pairs = zip(record.history["step"], record.history["validation"])
    step, loss = np.array([(step, loss) for step, loss in pairs if step is not None and loss is not None]).T
    return step, loss


def painted(maps: Mapping[str, np.ndarray], truth: np.ndarray, fov: np.ndarray) -> pd.DataFrame:
    """Percent of the cells in view that each row marks, per class; the last line is the truth.

    maps: row -> (N, K, M, M) bool
    truth: (N, K, M, M) bool
    fov: (N, M, M) bool
    """
    everything = {**{named(row): found for row, found in maps.items()}, "truth": truth}
    fractions = {name: 100 * (found & fov[:, None]).sum((0, 2, 3)) / fov.sum() for name, found in everything.items()}
    frame = pd.DataFrame(fractions, index=LABELS).T
    frame["all"] = frame.sum(axis=1)
    return frame.round(1)


def flow_outcome(errors: pd.DataFrame, row: str = "d") -> str:
    """Whether the arrows of a row are closer to the true motion than no motion, as sentences.

    errors: see `zerobev.evaluation.motion.evaluate_motion`
    """
    words = {1: "beats", 0: "cannot be told from", -1: "is worse than"}
    found, place = {}, np.nan
    for flow in ("tvl1", "true"):
        motion = errors[errors["flow"] == flow].pivot(index="pair", columns="row", values="motion").dropna()
        gains = (motion["still"] - motion[row]).to_numpy()
        draws = np.random.default_rng(0).choice(gains, (DRAWS, len(gains))).mean(axis=1)
        sign = Estimate(float(gains.mean()), *np.quantile(draws, INTERVAL)).sign
        means = f"{motion[row].mean():.2f} m against {motion['still'].mean():.2f} m"
        found[flow] = (f"**{words[sign]}** no motion: {means}", sign)
        place = errors[(errors["flow"] == flow) & (errors["row"] == row)]["start"].mean()
    text = f"With estimated flow, {named(row)} {found['tvl1'][0]} of mean error. With true flow, it {found['true'][0]}."
    if min(sign for _, sign in found.values()) < 1:
        text += " Start and end of an arrow are projected one by one, and with true flow a start is "
        text += f"{place:.2f} m from its true place. Probable remedies: larger images and a finer map."
    return text


def lost_objects(records: Sequence[RunRecord], row: str = "c", against: str = "a.2") -> str:
    """The classes that a row loses to another row, as a sentence."""
    frame = class_gains(row, against, records, 1).loc[list(LABELS)]
    lost = frame.index[frame["high"] < 0]
    iou = {
        r: dict(zip(LABELS, np.mean([100 * one.counts.iou_per_class() for one in records if one.row == r], axis=0)))
        for r in (row, against)
    }
    sizes = listed([f"{name} ({iou[row][name]:.1f} against {iou[against][name]:.1f})" for name in lost])
    if not len(lost):
        return f"{named(row)} loses no class to {named(against)}."
    return (
        f"{named(row)} is worse than {named(against)} on {sizes}, IoU in percent. Small objects cover few pixels of an "
        "image and few cells of a map, and a cell counts only if its probability is above one half. Probable remedies: "
        "larger images and longer training."
    )
