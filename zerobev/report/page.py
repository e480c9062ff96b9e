"""Write all tables, verdicts and figures of a report, and one page that shows them.

Reads the records of `reports/<report>/`; writes `index.html`, `tables/*.csv`, `claims.json`, `ratios.json` and
`figures/*.png` there. No row is computed: a row without a record shows only the paper's numbers.
"""

import argparse
import base64
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jinja2
import matplotlib

matplotlib.use("Agg")  # figures go to files; no display is needed

import matplotlib.pyplot as plt
import nbformat
import pandas as pd

from zerobev.common.paths import PACKAGE_PARENT
from zerobev.common.storage import replacing, write_json
from zerobev.experiments.gallery import gallery
from zerobev.experiments.registry import EXPERIMENTS
from zerobev.experiments.run_records import RunRecord, RunStore
from zerobev.experiments.runs import SEEDS, recorded
from zerobev.experiments.workspace import Workspace, add_workspace_arguments
from zerobev.report.claims import VERDICTS, Verdict, compare, judge
from zerobev.report.figures import averages_figure, gallery_figure, scoreboard_figure
from zerobev.report.notebooks import NOTEBOOKS
from zerobev.report.own_rows import OWN_CLAIMS
from zerobev.report.paper import CLAIMS, RATIOS
from zerobev.report.tables import NOTEBOOKS as NOTEBOOK_OF
from zerobev.report.tables import cost_table, table

#: number -> title; table 6 is not in the paper
TABLES = {
    1: "Table 1: zero-shot projection of semantic classes",
    2: "Table 2: variants of the network, and the max-pooling attention (f)",
    3: "Table 3: depth in training the residual variant",
    4: "Table 4: fraction of white in the textures",
    5: "Table 5: how the training data are made",
    6: "Table 6, not in the paper: size, surface and number of textures",
}
_SHOWN = ("a.1", "a.2", "b.3", "c", "d", "f", "f.r")  #: rows of the gallery, if they are recorded


def write_summary(workspace: Workspace) -> Path:
    """Write all files; returns the path of the page."""
    records = recorded(EXPERIMENTS, workspace)
    verdicts = [judge(claim, records) for claim in (*CLAIMS, *OWN_CLAIMS)]
    ratios = [compare(ratio, records) for ratio in RATIOS]
    tables = {number: table(number, records) for number in TABLES}
    folder = workspace.reports
    write_json(folder / "claims.json", [asdict(verdict) for verdict in verdicts])
    write_json(folder / "ratios.json", ratios)
    for number, frame in tables.items():
        with replacing(folder / "tables" / f"table{number}.csv") as temporary:
            frame.to_csv(temporary)
    of_paper = Counter(verdict.verdict for verdict in verdicts if verdict.paper is not None)
    page = _template().render(
        report=folder.name,
        scale=workspace.scale,
        rows=len({record.row for record in records}),
        seeds=sorted({record.seed for record in records}),
        counted={name: of_paper[name] for name in VERDICTS if of_paper[name]},
        verdicts=sorted(verdicts, key=lambda verdict: verdict.table),
        scoreboard=_scoreboard(verdicts, folder),
        notebooks={_title(path): _link(path, folder) for path in sorted(NOTEBOOKS.glob("*.ipynb"))},
        ratios=ratios,
        tables=[_table(number, frame, records, folder) for number, frame in tables.items()],
        gallery=_gallery(workspace, records),
        modalities=_any_modality(workspace),
        costs=cost_table(records).to_html(border=0),
    )
    path = folder / "index.html"
    with replacing(path) as temporary:
        temporary.write_text(page + "\n", encoding="utf-8")
    return path


@dataclass(frozen=True)
class Figure:
    """A figure of the page."""

    source: str  #: path, relative to the page
    text: str


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("zerobev.report", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["signed"] = lambda value: "" if value is None else f"{value:+.1f}"
    environment.filters["css"] = lambda verdict: verdict.replace(" ", "-")
    return environment.get_template("page.html.j2")


def _title(notebook: Path) -> str:
    """The first heading of a notebook."""
    return str(nbformat.read(notebook, as_version=4).cells[0].source.splitlines()[0].removeprefix("# "))


def _link(notebook: Path, folder: Path) -> str:
    """A notebook of the checkout, relative to the page."""
    return Path(os.path.relpath(notebook, folder)).as_posix()


def _scoreboard(verdicts: Sequence[Verdict], folder: Path) -> Figure | None:
    if all(verdict.ours is None for verdict in verdicts):
        return None
    return _save(scoreboard_figure(verdicts), folder, "claims", "Difference per claim, ours and the paper's")


def _table(number: int, frame: pd.DataFrame, records: Sequence[RunRecord], folder: Path) -> dict[str, Any]:
    """A table for the page: number, title, columns, lines and figure."""
    lines = [
        {
            "row": row,
            "method": method,
            "source": source,
            "cells": ["" if pd.isna(value) else f"{value:.1f}" for value in values],
        }
        for (row, method, source), values in zip(frame.index, frame.to_numpy())
    ]
    mine = [record for record in records if record.row in frame.index.get_level_values("row")]
    figure = None
    if mine:
        figure = _save(
            averages_figure(number, mine), folder, f"table{number}", f"Table {number}: both averages, 90 % intervals"
        )
    columns = ("row", "method", "", *frame.columns)
    notebook = _link(NOTEBOOKS / f"{NOTEBOOK_OF[number]}.ipynb", folder)
    parts = {"number": number, "title": TABLES[number], "columns": columns, "lines": lines, "figure": figure}
    return {**parts, "notebook": notebook}


def _gallery(workspace: Workspace, records: Sequence[RunRecord]) -> Figure | None:
    store = RunStore(workspace.reports)
    keys = {record.row: record.key for record in records if record.seed == SEEDS[0]}
    shown = {row: store.maps(keys[row]) for row in _SHOWN if row in keys}
    if not shown:
        return None
    figure = gallery_figure(gallery(workspace), shown)
    return _save(figure, workspace.reports, "gallery", "Eight views of test homes, spread evenly")


def _any_modality(workspace: Workspace) -> list[Figure]:
    """The figures of the last executed copy of notebook 11, each with its heading."""
    name = "11_any_modality.ipynb"
    executed = [folder / name for folder in (workspace.reports / "notebooks", PACKAGE_PARENT / "notebooks")]
    found = next((path for path in executed if path.exists()), None)
    if found is None:
        return []
    notebook = nbformat.read(found, as_version=4)
    figures: list[Figure] = []
    heading = ""
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            heading = next((line[3:] for line in cell.source.splitlines() if line.startswith("## ")), heading)
            continue
        for output in cell.outputs:
            if "image/png" not in output.get("data", {}):
                continue
            path = workspace.reports / "figures" / f"any_modality_{len(figures)}.png"
            with replacing(path) as temporary:
                temporary.write_bytes(base64.b64decode(output.data["image/png"]))
            figures.append(Figure(f"figures/{path.name}", heading))
    return figures


def _save(figure: plt.Figure, folder: Path, name: str, text: str) -> Figure:
    with replacing(folder / "figures" / f"{name}.png") as temporary:
        figure.savefig(temporary, dpi=110, bbox_inches="tight", metadata={"Software": None})
    plt.close(figure)
    return Figure(f"figures/{name}.png", text)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev summary`."""
    add_workspace_arguments(parser)


def run(options: argparse.Namespace) -> None:
    """Write the page and print its path."""
    print(f"tables, verdicts and figures: {write_summary(Workspace(options.scale, options.scenes))}")
