"""The form of the committed notebooks; nbval checks their outputs (`pytest --nbval notebooks`)."""

import ast
import base64
import io
import re
import statistics
from collections.abc import Callable
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output
from PIL import Image

from support.paths import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
#: Calls that draw: matplotlib, or a function of the library with "figure" or "grid" in its name.
DRAWS = re.compile(r"\bplt\.(?!rc|style|close)|\bfigure\b *[.=]|\bgrid\(|\.(?:imshow|plot)\(")
LINK = re.compile(r"""\]\((?!https?:|#)([^)#\s]+)|href=['"](?!https?:|#)([^'"#]+)""")
ABSOLUTE_PATH = re.compile(r"(?<![\w.:/<])/(?:home|root|tmp|work|usr|opt|var|mnt|data|srv|Users|private)\b|\b[A-Z]:\\")
IGNORING = {f"NBVAL_{mark}" for mark in ("IGNORE_OUTPUT", "SKIP", "RAISES_EXCEPTION")}
IGNORING |= {"PYTEST_VALIDATE_IGNORE_OUTPUT", "RAISES_EXCEPTION"}


def code_cells(notebook: NotebookNode) -> list[NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def tags(cell: NotebookNode) -> list[str]:
    return cell.metadata.get("tags", [])


def links(text: str) -> set[str]:
    """Targets of links in Markdown and HTML, without links to other sites and within a page."""
    return {markdown or link for markdown, link in LINK.findall(text)}


def outputs(notebook: NotebookNode) -> list[NotebookNode]:
    return [output for cell in code_cells(notebook) for output in cell.outputs]


def images(cell: NotebookNode) -> list[np.ndarray]:
    """The PNG images in the output of a cell, (H, W, C) uint8."""
    shown = [output.data["image/png"] for output in cell.outputs if "image/png" in output.get("data", {})]
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(image)))) for image in shown]


def ignores_output(cell: NotebookNode) -> bool:
    """Whether a tag or a comment excludes the outputs of a cell from nbval."""
    marks = {tag.upper().replace("-", "_") for tag in tags(cell)}
    marks |= {line.strip(" #") for line in cell.source.splitlines() if line.lstrip().startswith("#")}
    return bool(marks & IGNORING)


def makefile_parameters() -> dict[str, str]:
    """Defaults of the parameters in the Makefile."""
    found = re.findall(r"^(SCALE|SCENES) \?=[ ]*(\S*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert len(found) == 2
    return dict(found)


def valid_format(notebook: NotebookNode) -> None:
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"


def executed_from_top_to_bottom(notebook: NotebookNode) -> None:
    code = code_cells(notebook)
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))


def has_clean_outputs(notebook: NotebookNode) -> None:
    assert outputs(notebook)
    assert not [output for output in outputs(notebook) if output.output_type == "error"]
    assert not [output for output in outputs(notebook) if output.get("name") == "stderr"]
    texts = [output.get("data", {}).get("text/plain", "") for output in outputs(notebook)]
    assert not [text for text in texts if re.search(r" at 0x[0-9a-f]+>", text)]  # an address, another one in each run


def every_figure_is_shown(notebook: NotebookNode) -> None:
    for cell in code_cells(notebook):
        text = [output.data.get("text/plain", "") for output in cell.outputs if "data" in output]
        if DRAWS.search(cell.source) or any(line.startswith("<Figure") for line in text):
            assert images(cell), f"no picture below: {cell.source}"
        assert all(image.std(axis=(0, 1)).any() for image in images(cell)), f"an empty picture below: {cell.source}"


def has_the_parameters_of_the_command(notebook: NotebookNode) -> None:
    assert not [cell for cell in notebook.cells if "injected-parameters" in tags(cell)]
    (cell,) = [cell for cell in notebook.cells if "parameters" in tags(cell)]
    statements = ast.parse(cell.source).body
    assert all(isinstance(statement, ast.Assign) and len(statement.targets) == 1 for statement in statements)
    assert {s.targets[0].id: ast.literal_eval(s.value) for s in statements} == makefile_parameters()
    assert cell is code_cells(notebook)[0]


def is_plain_python(notebook: NotebookNode) -> None:
    """No magics, shell commands or classes; no `;` at the end, which hides a value in Jupyter but not in nbval."""
    for cell in code_cells(notebook):
        nodes = list(ast.walk(ast.parse(cell.source)))
        assert not [node for node in nodes if isinstance(node, ast.ClassDef)]
        assert "get_ipython" not in cell.source and not cell.source.rstrip().endswith(";")


def contains_no_machine_paths(notebook: NotebookNode) -> None:
    texts = [cell.source for cell in notebook.cells]
    for output in outputs(notebook):
        texts += [output.get("text", ""), *(str(v) for k, v in output.get("data", {}).items() if "image" not in k)]
    for text in texts:
        assert not ABSOLUTE_PATH.search(text) and str(ROOT) not in text and str(Path.home()) + "/" not in text
        assert "../" not in text and '"./' not in text


def cells_are_short(notebook: NotebookNode) -> None:
    lines = [len(cell.source.splitlines()) for cell in code_cells(notebook)]
    assert statistics.median(lines) <= 5 and max(lines) <= 25


def prose_precedes_every_code_cell(notebook: NotebookNode) -> None:
    words = []
    for before, cell in zip([None, *notebook.cells], notebook.cells):
        if cell.cell_type == "code":
            assert before is not None and before.cell_type == "markdown" and before.source.strip(), cell.source
            words.append(len(before.source.split()))
    assert 20 <= statistics.median(words) <= 120


def states_its_time(notebook: NotebookNode) -> None:
    assert "**Time.**" in notebook.cells[0].source


def every_link_is_a_file(notebook: NotebookNode) -> None:
    texts = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    texts += [output.data.get("text/html", "") for output in outputs(notebook) if "data" in output]
    for link in set().union(*map(links, texts)):
        assert (ROOT / "notebooks" / link).is_file(), link


def sections(notebook: NotebookNode) -> list[str]:
    """The headings of second level."""
    texts = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    return [line[3:] for text in texts for line in text.splitlines() if line.startswith("## ")]


def ends_with_a_table_of_checks(notebook: NotebookNode) -> None:
    """Only exercises follow it."""
    assert [name for name in sections(notebook) if name != "Exercises"][-1:] == ["What we checked"]


def exercises_have_a_hint_and_a_folded_solution(notebook: NotebookNode) -> None:
    """Two or three exercises, if there are any; each is a question with a hint, then a hidden cell."""
    if "Exercises" not in sections(notebook):
        return
    (start,) = [i for i, cell in enumerate(notebook.cells) if cell.source.startswith("## Exercises")]
    questions, solutions = notebook.cells[start::2], notebook.cells[start + 1 :: 2]
    assert len(questions) == len(solutions) in (2, 3)
    for number, (question, solution) in enumerate(zip(questions, solutions), start=1):
        assert f"**{number}.**" in question.source and "<details><summary>Hint</summary>" in question.source
        assert solution.cell_type == "code" and solution.metadata.get("jupyter", {}).get("source_hidden")


CHECKS = (
    valid_format,
    executed_from_top_to_bottom,
    has_clean_outputs,
    every_figure_is_shown,
    has_the_parameters_of_the_command,
    is_plain_python,
    contains_no_machine_paths,
    cells_are_short,
    prose_precedes_every_code_cell,
    states_its_time,
    every_link_is_a_file,
    ends_with_a_table_of_checks,
    exercises_have_a_hint_and_a_folded_solution,
)


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(path: Path, check: Callable[[NotebookNode], None]):
    check(nbformat.read(path, as_version=4))


def test_few_outputs_are_ignored():
    cells = [cell for path in NOTEBOOKS for cell in code_cells(nbformat.read(path, as_version=4))]
    assert sum(map(ignores_output, cells)) < 0.05 * len(cells)


# Tests of the checks: a sound notebook passes all checks, and each spoiled copy fails its own.


def exercise(number: int, heading: str = "") -> list[NotebookNode]:
    question = f"{heading}**{number}.** {'word ' * 30}<details><summary>Hint</summary>word</details>"
    folded = {"jupyter": {"source_hidden": True}}
    return [new_markdown_cell(question), new_code_cell("2", execution_count=3 + number, metadata=folded)]


def sound_notebook() -> NotebookNode:
    buffer = io.BytesIO()
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(buffer, "png")
    figure = {"text/plain": "<Figure size 4x4>", "image/png": base64.b64encode(buffer.getvalue()).decode()}
    prose = "word " * 30
    return new_notebook(
        metadata={"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}},
        cells=[
            new_markdown_cell(f"[first](00_tour.ipynb) **Time.** {prose}"),
            new_code_cell('SCALE = "reduced"\nSCENES = ""', execution_count=1, metadata={"tags": ["parameters"]}),
            new_markdown_cell(prose + "</div> and/or https://example.org/data/x"),
            new_code_cell("figure = grid(SCALE)", execution_count=2, outputs=[new_output("display_data", figure)]),
            new_markdown_cell("## What we checked\n" + prose),
            new_code_cell("1", execution_count=3, outputs=[new_output("execute_result", {"text/plain": "1"})]),
            *exercise(1, "## Exercises\n"),
            *exercise(2),
        ],
    )


def set_source(index: int, source: str) -> Callable[[NotebookNode], None]:
    return lambda notebook: notebook.cells[index].update(source=source)


def set_output(index: int, *made: NotebookNode) -> Callable[[NotebookNode], None]:
    return lambda notebook: notebook.cells[index].update(outputs=list(made))


SPOILED = (
    (valid_format, lambda notebook: notebook.cells[0].update(cell_type="prose")),
    (executed_from_top_to_bottom, lambda notebook: notebook.cells[5].update(execution_count=7)),
    (has_clean_outputs, lambda notebook: [cell.update(outputs=[]) for cell in code_cells(notebook)]),
    (has_clean_outputs, set_output(5, new_output("error", ename="ValueError", evalue="", traceback=[]))),
    (has_clean_outputs, set_output(5, new_output("stream", name="stderr", text="warning"))),
    (has_clean_outputs, set_output(5, new_output("execute_result", {"text/plain": "<Legend at 0x7f1d067e6a50>"}))),
    (every_figure_is_shown, set_output(3)),
    (every_figure_is_shown, set_output(5, new_output("display_data", {"text/plain": "<Figure size 1x1>"}))),
    (has_the_parameters_of_the_command, set_source(1, 'SCALE = "smoke"\nSCENES = ""')),
    (has_the_parameters_of_the_command, set_source(1, 'SCALE = str("reduced")\nSCENES = ""')),
    (has_the_parameters_of_the_command, lambda notebook: notebook.cells[1].metadata.update(tags=[])),
    (
        has_the_parameters_of_the_command,
        lambda notebook: notebook.cells[5].metadata.update(tags=["injected-parameters"]),
    ),
    (is_plain_python, set_source(5, "%matplotlib inline")),
    (is_plain_python, set_source(5, "!ls")),
    (is_plain_python, set_source(5, "if True:\n    class Local: ...")),
    (is_plain_python, set_source(5, "plt.plot([0, 1]);")),
    (contains_no_machine_paths, set_source(5, 'open("/data/homes")')),
    (contains_no_machine_paths, set_source(5, 'open("../homes")')),
    (contains_no_machine_paths, set_output(5, new_output("stream", text="in /tmp/kernel_1"))),
    (cells_are_short, set_source(5, "1\n" * 29)),
    (cells_are_short, lambda notebook: [cell.update(source="1\n" * 6) for cell in code_cells(notebook)]),
    (prose_precedes_every_code_cell, lambda notebook: notebook.cells.pop(2)),
    (prose_precedes_every_code_cell, lambda notebook: [cell.update(source="Now:") for cell in notebook.cells[::2]]),
    (states_its_time, set_source(0, "Zero-BEV")),
    (every_link_is_a_file, set_source(0, "[gone](99_gone.ipynb)")),
    (every_link_is_a_file, set_output(5, new_output("display_data", {"text/html": "<a href='99.ipynb'>9</a>"}))),
    (ends_with_a_table_of_checks, set_source(4, "The end.")),
    (ends_with_a_table_of_checks, set_source(8, "## More")),
    (exercises_have_a_hint_and_a_folded_solution, lambda notebook: notebook.cells[7].metadata.clear()),
    (exercises_have_a_hint_and_a_folded_solution, set_source(8, "**2.** No hint")),
    (exercises_have_a_hint_and_a_folded_solution, lambda notebook: notebook.cells.__delitem__(slice(8, 10))),
)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_a_sound_notebook_passes(check: Callable[[NotebookNode], None]):
    check(sound_notebook())


@pytest.mark.parametrize(("check", "spoil"), SPOILED, ids=lambda value: getattr(value, "__name__", ""))
def test_a_spoiled_notebook_fails(check: Callable[[NotebookNode], None], spoil: Callable[[NotebookNode], None]):
    notebook = sound_notebook()
    spoil(notebook)
    with pytest.raises((AssertionError, ValueError, SyntaxError, nbformat.ValidationError)):
        check(notebook)


@pytest.mark.parametrize("tag", ["nbval-ignore-output", "nbval-skip", "raises-exception"])
def test_ignored_outputs_are_counted(tag: str):
    assert ignores_output(new_code_cell("1", metadata={"tags": [tag]}))
    assert ignores_output(new_code_cell("  # NBVAL_IGNORE_OUTPUT\n1"))
    assert not ignores_output(new_code_cell("1  # NBVAL_IGNORE_OUTPUT", metadata={"tags": ["parameters"]}))


def test_readme_and_tour_link_to_every_notebook():
    readme = links((ROOT / "README.md").read_text())
    assert {f"notebooks/{path.name}" for path in NOTEBOOKS} <= readme
    tour = links(nbformat.read(NOTEBOOKS[0], as_version=4).cells[0].source)
    assert tour == {path.name for path in NOTEBOOKS[1:]}


@pytest.mark.parametrize("number", range(len(NOTEBOOKS)))
def test_a_notebook_links_to_its_neighbours(number: int):
    last = nbformat.read(NOTEBOOKS[number], as_version=4).cells[0].source.splitlines()[-1]
    neighbours = [NOTEBOOKS[number - 1].name] if number else []
    neighbours += [path.name for path in NOTEBOOKS[number + 1 : number + 2]]
    assert links(last) == {*neighbours, *([NOTEBOOKS[0].name] if number else [])}


def anchors(markdown: str) -> set[str]:
    """The names that GitHub gives to headings."""
    headings = re.findall(r"^#+ (.+)$", markdown, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_links_of_the_documents_lead_somewhere(name: str):
    text = (ROOT / name).read_text()
    assert all((ROOT / link).exists() for link in links(text))
    assert set(re.findall(r"\]\(#([^)]+)\)", text)) <= anchors(text)


def test_anchors_are_those_of_github():
    assert anchors("# Your own: image?\ntext\n## A-b c") == {"your-own-image", "a-b-c"}


def test_the_readme_shows_the_tours_first_picture():
    assert "](reports/tour.png)" in (ROOT / "README.md").read_text()
    shown = [
        output for output in outputs(nbformat.read(NOTEBOOKS[0], as_version=4)) if "image/png" in output.get("data", {})
    ]
    assert (ROOT / "reports" / "tour.png").read_bytes() == base64.b64decode(shown[0].data["image/png"])
