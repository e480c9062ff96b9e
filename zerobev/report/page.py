"""Write all tables, verdicts and figures of a report, and one page that shows them.

Reads the records of `reports/<report>/`; writes there `index.html`, readable without Jupyter, `tables/*.csv`,
`claims.json`, `ratios.json` and `figures/*.png`. Nothing is computed: a row without a record shows the paper's numbers
alone.
"""

import argparse
import base64
import html
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # pictures go to files, with or without a display

import matplotlib.pyplot as plt
import nbformat
import pandas as pd
from matplotlib.figure import Figure

from zerobev.common.paths import PACKAGE_PARENT
from zerobev.common.storage import replacing, write_json
from zerobev.config import SCALES
from zerobev.experiments.gallery import gallery
from zerobev.experiments.registry import EXPERIMENTS
from zerobev.experiments.run_records import RunRecord, RunStore
from zerobev.experiments.runs import SEEDS, recorded
from zerobev.experiments.workspace import Workspace
from zerobev.report.claims import Verdict, compare, judge
from zerobev.report.figures import averages_figure, gallery_figure
from zerobev.report.own_rows import OWN_CLAIMS
from zerobev.report.paper import CLAIMS, RATIOS
from zerobev.report.tables import cost_table, table

#: number -> title; table 6 is not in the paper
TABLES = {
    1: "Table 1: zero-shot projection of semantic classes",
    2: "Table 2: variants of the network, and the max-pooling attention (f)",
    3: "Table 3: depth in training the residual variant",
    4: "Table 4: share of white in the textures",
    5: "Table 5: how the zero-shot stream is made",
    6: "Beyond the paper: scale and freshness of the textures",
}
_SHOWN = ("a.1", "a.2", "b.3", "c", "d", "f", "f.r")  #: rows of the gallery, where they are recorded

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; color: #222 }
h1, h2 { line-height: 1.2 } h2 { margin-top: 2em; border-bottom: 1px solid #ccc }
table { border-collapse: collapse; font-size: 13px; margin: 1em 0; display: block; overflow-x: auto }
th, td { padding: .25em .6em; border-bottom: 1px solid #e5e5e5; text-align: right; white-space: nowrap }
th:first-child, td.text, th.text { text-align: left; white-space: normal }
tr.ours td { background: #eef4fb }
.holds { color: #1b7837 } .does-not-hold { color: #b2182b } .undecided { color: #946a00 } .not-run { color: #888 }
img { max-width: 100%; display: block; margin: 1em 0 }
"""


def write_summary(workspace: Workspace) -> Path:
    """Write everything; returns the path of the page."""
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
    sections = [_scoreboard(verdicts), "<h2>Ratios</h2>", _ratios(ratios)]
    for number, frame in tables.items():
        sections += [f"<h2>{TABLES[number]}</h2>", _results(frame)]
        mine = [record for record in records if record.row in frame.index.get_level_values("row")]
        if mine:
            sections.append(
                _picture(averages_figure(number, mine), folder, f"table{number}", "Averages, 90 % intervals")
            )
    sections += [
        "<h2>What it looks like</h2>",
        _gallery(workspace, records),
        *_any_modality(workspace),
        "<h2>Runs</h2><p>Memory is the peak of the process so far, which may have computed other rows before.</p>",
        cost_table(records).to_html(border=0),
    ]
    page = folder / "index.html"
    with replacing(page) as temporary:
        temporary.write_text(_page(workspace, records, sections), encoding="utf-8")
    return page


def _page(workspace: Workspace, records: Sequence[RunRecord], sections: Sequence[str]) -> str:
    camera, name = workspace.scale.camera, workspace.reports.name
    seeds = sorted({record.seed for record in records})
    return (
        f'<!doctype html>\n<html lang="en"><meta charset="utf-8"><title>Zero-BEV, {html.escape(name)}</title>\n'
        f"<style>{_STYLE}</style>\n<h1>Zero-BEV at scale {html.escape(workspace.scale.name)}</h1>\n"
        f"<p>Report <b>{html.escape(name)}</b>: images of {camera.fpv_px} x {camera.fpv_px} pixels, maps of "
        f"{camera.bev_px} x {camera.bev_px} cells over {camera.bev_extent_m:g} m, "
        f"{len({record.row for record in records})} rows, seeds {', '.join(map(str, seeds)) or 'none'}. "
        "IoU in percent. The paper's numbers come from scanned homes, 384 pixels and long training: compare orders and "
        "proportions, not values.</p>\n" + "\n".join(sections) + "\n</html>\n"
    )


def _scoreboard(verdicts: Sequence[Verdict]) -> str:
    paper = Counter(verdict.verdict for verdict in verdicts if verdict.paper is not None)
    order = [name for name in ("holds", "does not hold", "undecided", "not run") if paper[name]]
    counted = ", ".join(f"<span class='{_css(name)}'>{name}: {paper[name]}</span>" for name in order)
    heads = _heads(("id", "claim", "paper", "ours", "90 % interval"), text=2) + "<th class='text'>verdict</th>"
    lines = [
        f"<tr><td class='text'>{v.id}</td><td class='text'>{html.escape(v.claim)}</td><td>{_signed(v.paper)}</td>"
        f"<td>{_signed(v.ours)}</td><td>{'' if v.low is None else f'{v.low:+.1f} to {v.high:+.1f}'}</td>"
        f"<td class='text {_css(v.verdict)}'>{v.verdict}</td></tr>"
        for v in verdicts
    ]
    return (
        f"<h2>Claims</h2><p>The paper's {sum(paper.values())} claims - {counted}. Differences in IoU points, means "
        "over seeds, intervals from resampling test homes and seeds; claims without a number of the paper are ours.</p>"
        f"<table><tr>{heads}</tr>{''.join(lines)}</table>"
    )


def _results(frame: pd.DataFrame) -> str:
    lines = [
        f"<tr class='{source}'><td class='text'>({row})</td><td class='text'>{html.escape(method)}</td>"
        f"<td class='text'>{source}</td>"
        + "".join(f"<td>{'' if pd.isna(value) else f'{value:.1f}'}</td>" for value in values)
        + "</tr>"
        for (row, method, source), values in zip(frame.index, frame.to_numpy())
    ]
    return f"<table><tr>{_heads(('row', 'method', '', *frame.columns), text=3)}</tr>{''.join(lines)}</table>"


def _ratios(ratios: Sequence[dict[str, str | float | None]]) -> str:
    lines = [
        f"<tr><td class='text'>({r['numerator']}) / ({r['denominator']})</td><td class='text'>{r['metric']}</td>"
        f"<td>{r['paper']:.2f}</td>"
        + (
            "<td></td><td></td>"
            if r["ours"] is None
            else f"<td>{r['ours']:.2f}</td><td>{r['low']:.2f} to {r['high']:.2f}</td>"
        )
        + "</tr>"
        for r in ratios
    ]
    return (
        f"<table><tr>{_heads(('rows', 'IoU', 'paper', 'ours', '90 % interval'), text=2)}</tr>{''.join(lines)}</table>"
    )


def _gallery(workspace: Workspace, records: Sequence[RunRecord]) -> str:
    store = RunStore(workspace.reports)
    keys = {record.row: record.key for record in records if record.seed == SEEDS[0]}
    shown = {row: store.maps(keys[row]) for row in _SHOWN if row in keys}
    if not shown:
        return "<p>No row is recorded.</p>"
    figure = gallery_figure(gallery(workspace), shown)
    return _picture(figure, workspace.reports, "gallery", "Eight views of test homes, spread evenly")


def _any_modality(workspace: Workspace) -> list[str]:
    """The figures of notebook 11 as it was executed last, each under the heading that it stands under."""
    name = "11_any_modality.ipynb"
    executed = [folder / name for folder in (workspace.reports / "notebooks", PACKAGE_PARENT / "notebooks")]
    found = next((path for path in executed if path.exists()), None)
    sections, heading, count = ["<h2>Any modality</h2>"], "", 0
    if found is None:
        return [*sections, f"<p>Notebook {name} was not executed.</p>"]
    notebook = nbformat.read(found, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            heading = next((line[3:] for line in cell.source.splitlines() if line.startswith("## ")), heading)
            continue
        for output in cell.outputs:
            if "image/png" not in output.get("data", {}):
                continue
            path = workspace.reports / "figures" / f"any_modality_{count}.png"
            with replacing(path) as temporary:
                temporary.write_bytes(base64.b64decode(output.data["image/png"]))
            title, count = html.escape(heading), count + 1
            sections.append(f"<h3>{title}</h3><img src='figures/{path.name}' alt='{title}'>")
    return sections


def _picture(figure: Figure, folder: Path, name: str, text: str) -> str:
    with replacing(folder / "figures" / f"{name}.png") as temporary:
        figure.savefig(temporary, dpi=110, bbox_inches="tight", metadata={"Software": None})
    plt.close(figure)
    return f"<img src='figures/{name}.png' alt='{html.escape(text)}'>"


def _heads(names: Sequence[str], text: int) -> str:
    return "".join(f"<th{' class=text' if i < text else ''}>{html.escape(name)}</th>" for i, name in enumerate(names))


def _signed(value: float | None) -> str:
    return "" if value is None else f"{value:+.1f}"


def _css(verdict: str) -> str:
    return verdict.replace(" ", "-")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev summary`."""
    parser.add_argument("--scale", default="reduced", help=f"one of {', '.join(SCALES)} (default: reduced)")
    parser.add_argument("--scenes", default="", metavar="DIR", help="HM3DSem scenes instead of generated homes")


def run(options: argparse.Namespace) -> None:
    """Write the page and print its path."""
    print(f"tables, verdicts and figures: {write_summary(Workspace(options.scale, options.scenes))}")
