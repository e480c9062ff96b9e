"""Tables of the notebooks and the page of results, from records and the paper's numbers."""

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from IPython.display import Markdown

from zerobev.config import LABELS
from zerobev.experiments.run_records import RunRecord
from zerobev.report.claims import Verdict
from zerobev.report.own_rows import OWN_ROWS
from zerobev.report.paper import TABLES

#: Notebook of each table; table 6 is not in the paper.
NOTEBOOKS = {
    1: "05_table1_zero_shot",
    2: "06_table2_model_variants",
    3: "07_table3_residual_depth",
    4: "08_table4_data_density",
    5: "09_table5_data_generation",
    6: "09_table5_data_generation",
}

# no truncated claims
pd.set_option("display.max_colwidth", None)


def table(number: int, records: Sequence[RunRecord]) -> pd.DataFrame:
    """A table of the paper with our rows below its rows, IoU in percent; ours are means over seeds.

    Rows of `report.own_rows` follow. A row of the paper without a record has only the paper's numbers.
    """
    lines = []
    for letter, method in rows_of(number).items():
        if (row := TABLES.get(number, {}).get(letter)) is not None:
            lines.append((letter, method, "paper", *row.per_class, row.class_iou, row.pixel_iou))
        mine = [record.counts for record in records if record.row == letter]
        if mine:
            per_class = np.mean([counts.iou_per_class() for counts in mine], axis=0)
            averages = np.mean([[counts.class_iou(), counts.pixel_iou()] for counts in mine], axis=0)
            lines.append((letter, method, "ours", *(100 * per_class), *(100 * averages)))
    columns = ["row", "method", "source", *LABELS, "class avg.", "pixel avg."]
    return pd.DataFrame(lines, columns=columns).set_index(["row", "method", "source"]).round(1)


def rows_of(number: int) -> dict[str, str]:
    """Row -> method of a table: the paper's rows, then rows of `zerobev.report.own_rows`."""
    published = {letter: row.method for letter, row in TABLES.get(number, {}).items()}
    return published | OWN_ROWS.get(number, {})


def cost_table(records: Sequence[RunRecord]) -> pd.DataFrame:
    """Seed, device, steps, cost and revision of each run, from its record."""
    columns = ["row", "seed", "device", "steps", "train [s]", "evaluate [s]", "memory [MB]", "test homes", "revision"]
    lines = [
        (
            *(r.row, r.seed, r.origin.get("device"), r.config.get("train", {}).get("steps", 0)),
            *(r.cost.get(name) for name in ("train_seconds", "evaluate_seconds", "peak_memory_mb")),
            *(len(r.scenes), r.origin.get("revision")),
        )
        for r in records
    ]
    return pd.DataFrame(lines, columns=columns).set_index(["row", "seed"])


def verdict_table(verdicts: Sequence[Verdict]) -> pd.DataFrame:
    """Claims and verdicts for a notebook; differences in IoU points."""
    frame = pd.DataFrame([vars(verdict) for verdict in verdicts]).set_index("id").drop(columns="table")
    return frame.astype({"paper": float, "ours": float, "low": float, "high": float})


def scoreboard(verdicts: Sequence[Verdict]) -> Markdown:
    """All claims by table, with verdicts and links to their notebooks; differences in IoU points."""
    lines = ["| | claim | paper | ours | 90 % interval | verdict | |", "|---|---|---|---|---|---|---|"]
    for v in sorted(verdicts, key=lambda v: v.table):
        paper, ours = ("" if value is None else f"{value:+.1f}" for value in (v.paper, v.ours))
        interval = "" if v.low is None else f"{v.low:+.1f} to {v.high:+.1f}"
        link = f"[notebook {int(NOTEBOOKS[v.table][:2])}]({NOTEBOOKS[v.table]}.ipynb)"
        lines.append(f"| {v.id} | {v.claim} | {paper} | {ours} | {interval} | **{v.verdict}** | {link} |")
    return Markdown("\n".join(lines))


def counted(verdicts: Sequence[Verdict]) -> str:
    """The number of claims per verdict, such as "9 hold, 7 are undecided, 3 do not hold"."""
    words = {"holds": "hold", "undecided": "are undecided", "does not hold": "do not hold", "not run": "are not run"}
    numbers = {word: sum(v.verdict == name for v in verdicts) for name, word in words.items()}
    return ", ".join(f"{number} {word}" for word, number in numbers.items() if number)


def order_of(value: float, least: float = 1e-6) -> str:
    """An error as the power of ten above it, at least `least`, so that rounding on another machine does not change it.

    least: a power of ten, above errors of rounding
    """
    return f"below 1e{math.floor(math.log10(max(abs(value), 0.5 * least))) + 1}"


class Checks:
    """The checks of a notebook, for its closing table."""

    def __init__(self) -> None:
        self._rows: list[tuple[str, str, str, str]] = []

    def holds(self, claim: str, expected: str, found: object, condition: bool) -> None:
        """Assert `condition`, which must hold on any machine, and note it with the value that was found."""
        assert condition, f"{claim}: expected {expected}, found {found}"
        self._rows.append((claim, expected, str(found), "holds"))

    def note(self, claim: str, expected: str, found: object, verdict: str | bool) -> None:
        """Note the verdict on a claim that may or may not hold, with the value that was found."""
        if isinstance(verdict, bool | np.bool_):
            verdict = "holds" if verdict else "does not hold"
        self._rows.append((claim, expected, str(found), verdict))

    def judged(self, verdicts: Sequence[Verdict]) -> None:
        """Note verdicts on claims about tables: the paper's number as expectation, ours with its interval."""
        for v in verdicts:
            expected = "above zero" if v.paper is None else f"{v.paper:+.1f} points in the paper"
            found = "" if v.ours is None else f"{v.ours:+.1f} points ({v.low:+.1f} to {v.high:+.1f})"
            self.note(v.claim, expected, found, v.verdict)

    def table(self) -> pd.DataFrame:
        """Claim, expectation, value and verdict of each check."""
        return pd.DataFrame(self._rows, columns=["claim", "expected", "found", "verdict"]).set_index("claim")
