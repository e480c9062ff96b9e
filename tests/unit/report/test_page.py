"""The page, tables and verdicts of a report."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from zerobev.config import LABELS
from zerobev.experiments.registry import EXPERIMENTS
from zerobev.experiments.workspace import Workspace
from zerobev.report import page as summary
from zerobev.report.claims import judge
from zerobev.report.notebooks import NOTEBOOKS
from zerobev.report.own_rows import OWN_CLAIMS, OWN_ROWS
from zerobev.report.page import write_summary
from zerobev.report.paper import CLAIMS, RATIOS, TABLES
from zerobev.report.tables import rows_of, table

from support.records import record

BASE = np.linspace(20, 40, 6)[:, None] + np.zeros(8)


class Tags(HTMLParser):
    """The nesting and the links of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []

    def handle_starttag(self, tag, attributes):
        self.sources += [value for name, value in attributes if name in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture
def report(tmp_path, monkeypatch):
    """A workspace with records of three rows, (c) with two seeds."""
    records = [record("a.1", BASE), record("c", BASE + 4), record("c", BASE + 6, seed=1), record("f", BASE + 9)]
    monkeypatch.setattr(summary, "recorded", lambda rows, workspace: records)
    monkeypatch.setattr(summary, "_gallery", lambda *_: None)
    workspace = Workspace("smoke", root=tmp_path)
    write_summary(workspace)
    return workspace.reports, records


def test_files_hold_the_numbers_of_the_records(report):
    folder, records = report
    for number in (*TABLES, 6):
        written = pd.read_csv(folder / f"tables/table{number}.csv", index_col=["row", "method", "source"])
        pd.testing.assert_frame_equal(written, table(number, records), check_dtype=False)
    claims = json.loads((folder / "claims.json").read_text())
    assert [claim["id"] for claim in claims] == [claim.id for claim in (*CLAIMS, *OWN_CLAIMS)]
    assert set(claims[0]) == {"id", "table", "claim", "paper", "ours", "low", "high", "verdict"}
    found = {claim["id"]: claim["verdict"] for claim in claims}
    assert found["1.4"] == found["2.f1"] == "holds" and found["1.5"] == "not run"
    ratios = json.loads((folder / "ratios.json").read_text())
    assert len(ratios) == len(RATIOS)
    first = ratios[0]
    assert (first["numerator"], first["denominator"], first["metric"]) == ("c", "a.1", "class")
    assert first["paper"] == pytest.approx(24.2 / 32.8, abs=1e-3) and first["ours"] == pytest.approx(35 / 30, abs=1e-2)


def test_page_is_well_formed_and_links_only_to_its_own_files(report):
    folder, _ = report
    text = (folder / "index.html").read_text()
    tags = Tags()
    tags.feed(text)
    assert tags.open == []
    files = [source for source in tags.sources if not source.startswith("#")]
    assert all((folder / source).is_file() for source in files)
    assert {f"#{name}" for name in re.findall(r" id='([^']+)'", text)} == set(tags.sources) - set(files)
    notebooks = {Path(source).name for source in files if source.endswith(".ipynb")}
    assert notebooks == {path.name for path in NOTEBOOKS.glob("*.ipynb")}
    assert {"figures/claims.png", *(f"tables/table{number}.csv" for number in (*TABLES, 6))} <= set(files)
    for verdict in (judge(claim, report[1]) for claim in CLAIMS):
        assert re.search(rf">{verdict.id}<.*?>{verdict.verdict}</td>", text)
    assert "not run" in text and "<td>35.0</td>" in text  # the mean of both seeds of (c)


def test_a_report_without_records_has_a_page(tmp_path):
    page = write_summary(Workspace("smoke", root=tmp_path))
    assert "No row is recorded" in page.read_text()
    assert len(pd.read_csv(page.parent / "tables/table1.csv")) == len(TABLES[1])


def test_own_rows_are_runs_and_own_claims_are_about_rows_of_their_table():
    for number, rows in OWN_ROWS.items():
        assert set(rows) <= set(EXPERIMENTS)
        assert set(summary.TABLES) == {*TABLES, *OWN_ROWS}
        for claim in (claim for claim in OWN_CLAIMS if claim.table == number):
            assert {claim.better, claim.worse} <= set(rows_of(number))
            verdict = judge(claim, [])
            assert verdict.verdict == "not run" and verdict.paper is None
    assert len({claim.id for claim in (*CLAIMS, *OWN_CLAIMS)}) == len(CLAIMS) + len(OWN_CLAIMS)
    frame = table(6, [record("c", BASE)])
    assert frame.index.tolist() == [("c", OWN_ROWS[6]["c"], "ours")]
    assert frame[list(LABELS)].to_numpy() == pytest.approx(np.full((1, 8), 30.0))
