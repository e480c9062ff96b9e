"""Published numbers are recorded numbers: no number, ours or the paper's, changes without a failing test."""

import hashlib
import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from zerobev.benchmarks.run import recorded_benchmark
from zerobev.config import SCALES
from zerobev.evaluation.metrics import Counts
from zerobev.evaluation.real_homes import METHODS
from zerobev.experiments.looks import recorded_looks
from zerobev.experiments.recorded import (
    recorded_cameras,
    recorded_homes,
    recorded_motion,
    recorded_unseen,
    recorded_walks,
)
from zerobev.experiments.registry import EXPERIMENTS
from zerobev.experiments.run_records import RunStore
from zerobev.experiments.runs import recorded
from zerobev.experiments.workspace import Workspace
from zerobev.inference.shipped_weights import ROWS
from zerobev.report.claims import compare, judge
from zerobev.report.own_rows import OWN_CLAIMS
from zerobev.report.page import TABLES as TITLES
from zerobev.report.paper import CLAIMS, RATIOS, TABLES
from zerobev.report.tables import table

from support.paths import ROOT, SHARED
from support.records import run_record

REPORTS = [ROOT / "reports" / scale for scale in SCALES if (ROOT / "reports" / scale / "records").is_dir()]
PAPER = SHARED / "paper/zero-bev.tex"
LABELS = ("results_main", "models", "re_models", "data_gen", "data_type")
#: SHA-256 of the published numbers, computed when they were compared with the paper's source.
PUBLISHED = "be36107f51292f5f2da4f5924f6a063a2d62f084141e0b4d0bc44922f9250994"


@pytest.mark.parametrize("report", REPORTS, ids=lambda report: report.name)
def test_records_are_as_they_were_written(report: Path):
    """`store.write(store.find(key), store.maps(key))` seals a record."""
    store = RunStore(report)
    keys = [path.stem for path in sorted((report / "records").glob("*.json"))]
    assert keys and [key for key in keys if not store.is_sealed(key)] == []


def test_a_seal_is_broken_by_the_last_digit_of_one_number(tmp_path: Path):
    counts = Counts(np.arange(16).reshape(2, 8), np.full((2, 8), 20))
    config = {"train": {"steps": 3, "rate": 1e-3}, "bands": (0.0, 0.8)}
    record = run_record("c-0", counts, config=config, cost={"seconds": 1.5}, history={"loss": [0.5, 0.1]})
    store, maps = RunStore(tmp_path), np.ones((2, 8, 5, 5), bool)
    store.write(record, maps)
    assert store.is_sealed("c-0") and store.find("c-0").sha256 == record.sha256
    text = store.path("c-0").read_text()
    for number in re.finditer(r"\d(?=[,}\]])", text):
        store.path("c-0").write_text(text[: number.start()] + str((int(number[0]) + 1) % 10) + text[number.end() :])
        assert not store.is_sealed("c-0"), number
    store.path("c-0").write_text(text)
    assert store.is_sealed("c-0")
    np.savez(tmp_path / "gallery/c-0.npz", maps=np.packbits(maps, axis=-1), cells=5)  # without a seal
    assert np.array_equal(store.maps("c-0"), maps) and not store.is_sealed("c-0")


@pytest.mark.parametrize(
    ("read", "starts_with"),
    [
        (recorded_benchmark, "zerobev.benchmarks.run.measure"),
        (recorded_motion, "zerobev.experiments.recorded.ensure_homes"),
        (recorded_unseen, "zerobev.experiments.recorded.ensure_homes"),
        (recorded_cameras, "zerobev.experiments.recorded.ensure_homes"),
        (recorded_homes, "zerobev.experiments.recorded.ensure_homes"),
        (lambda _: recorded_looks(), "zerobev.experiments.looks.ensure_homes"),
        (recorded_walks, "zerobev.experiments.recorded.ensure_homes"),
    ],
)
def test_measurements_were_made_by_this_code(monkeypatch, read, starts_with: str):
    """Otherwise a notebook measures again, and its figures differ from the committed ones."""

    def unexpected(*_, **__) -> None:
        raise AssertionError("found no record of this code and these weights, expected a committed one")

    monkeypatch.setattr(starts_with, unexpected)
    assert len(read(Workspace("reduced")))


def test_the_page_of_results_holds_the_numbers_of_the_records():
    workspace = Workspace("reduced")
    records = recorded(EXPERIMENTS, workspace)
    verdicts = [asdict(judge(claim, records)) for claim in (*CLAIMS, *OWN_CLAIMS)]
    assert json.loads((workspace.reports / "claims.json").read_text()) == verdicts
    ratios = [compare(ratio, records) for ratio in RATIOS]
    assert json.loads((workspace.reports / "ratios.json").read_text()) == ratios
    for number in TITLES:
        written = pd.read_csv(workspace.reports / f"tables/table{number}.csv", index_col=["row", "method", "source"])
        pd.testing.assert_frame_equal(written, table(number, records), check_dtype=False)


def test_the_readme_holds_the_numbers_of_the_records():
    results = table(1, recorded(EXPERIMENTS, Workspace("reduced")))[["class avg.", "pixel avg."]].unstack("source")
    readme = (ROOT / "README.md").read_text()
    for (row, method), values in results.iterrows():
        cells = [f"{values[iou, 'ours']:.1f} ({values[iou, 'paper']:.1f})" for iou in ("class avg.", "pixel avg.")]
        assert f"| ({row}) | {method} | {cells[0]} | {cells[1]} |" in readme


def test_the_readme_holds_the_numbers_of_the_shipped_weights():
    found, readme = recorded_homes(Workspace("reduced")), (ROOT / "README.md").read_text()
    rows = found["rows"]
    assert f"estimated depth is {100 * found['depth']['relative']:.0f} % off on average" in readme
    for row in ("a.1", "a.2", *ROWS, "d.sensor", "d.true", "constant"):
        name = row if row == "constant" else f"({row})"
        averages = [f"{100 * rows[row][kind]:.1f}" for kind in ("class_iou", "pixel_iou")]
        assert f"| {name} | {METHODS[row]} | {averages[0]} | {averages[1]} |" in readme


def test_the_readme_holds_the_numbers_of_the_gpu():
    step = json.loads((ROOT / "reports/gpu.json").read_text())["paper"]
    milliseconds, memory = step["milliseconds"]["c"]["median"], step["memory_gb"]["c"]
    assert f"{step['samples']} samples: {milliseconds:.0f} ms and {memory:.1f} GB" in (ROOT / "README.md").read_text()


def test_the_comparison_with_other_code_says_how_it_was_made():
    peers = json.loads((ROOT / "reports/peers.json").read_text())
    assert set(peers) == {"date", "how", "sizes", "rows"} and re.fullmatch(r"\d{4}-\d{2}", peers["date"])
    assert peers["how"] and peers["sizes"] and peers["rows"]
    for row in peers["rows"]:
        assert set(row) - {"parameters_m"} == {"network", "measured", "precision", "batch", "low", "high"}
        assert all(row[name] for name in ("network", "measured", "precision", "batch"))
        assert 0 < row["low"] <= row["high"] and row.get("parameters_m", 1) > 0
    named = [(row["network"], row["measured"], row["precision"], row["batch"]) for row in peers["rows"]]
    assert len(set(named)) == len(named)


def test_published_numbers_are_unchanged():
    numbers = {
        number: {name: [*row.per_class, row.class_iou, row.pixel_iou] for name, row in rows.items()}
        for number, rows in TABLES.items()
    }
    assert hashlib.sha256(json.dumps(numbers).encode()).hexdigest() == PUBLISHED


@pytest.mark.skipif(not PAPER.is_file(), reason="needs the paper's LaTeX source")
def test_published_numbers_are_those_of_the_paper():
    source = re.sub(r"(?<!\\)%.*", "", PAPER.read_text())
    for (number, rows), label in zip(TABLES.items(), LABELS, strict=True):
        whole = source[: source.index(f"\\label{{tab:{label}}}")].rpartition("\\begin{tabular}")[2]
        found = []
        for line in whole.split("\\\\"):
            *_, before = cells = line.split("&")
            numbers = [re.findall(r"(?<![\d.])\d+\.\d(?!\d)", cell) for cell in cells[-10:]]
            if before and len(numbers) == 10 and all(len(one) == 1 for one in numbers):
                letter = re.search(r"\(([a-z-][.\dI]*)\)", cells[0])
                found.append((letter and letter[1], [float(one[0]) for one in numbers]))
        assert [values for _, values in found] == [[*r.per_class, r.class_iou, r.pixel_iou] for r in rows.values()]
        assert all(letter in (None, name) for (letter, _), name in zip(found, rows, strict=True)), number
