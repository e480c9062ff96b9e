"""The workbook's command and the Makefile in front of it, on notebooks written for the purpose."""

import base64
import fcntl
import os
import re
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from zerobev import cli
from zerobev.common.errors import InputError
from zerobev.common.paths import report_name
from zerobev.report import notebooks as workbook
from zerobev.report.notebooks import NotebookError, kernel_settings, refresh, reproduce

from support.paths import ROOT

PARAMETERS = 'SCALE = "reduced"\nSCENES = ""'


def write_notebook(path: Path, *sources: str) -> None:
    """A notebook with a title, the parameters cell and one code cell a source."""
    metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    cells = [new_markdown_cell("# Title"), new_code_cell(PARAMETERS, metadata={"tags": ["parameters"]})]
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(new_notebook(cells=cells + [new_code_cell(source) for source in sources], metadata=metadata), path)


def printed(notebook: Path) -> str:
    """Everything a notebook printed to stdout."""
    cells = nbformat.read(notebook, as_version=4).cells
    outputs = [output for cell in cells if cell.cell_type == "code" for output in cell.outputs]
    return "".join(output.text for output in outputs if output.get("name") == "stdout")


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, Path]:
    return {"notebooks": tmp_path / "notebooks", "reports": tmp_path / "reports"}


class Rows:
    """Stands in for the process that computes rows: how it was called, with which settings, and how it ends."""

    def __init__(self) -> None:
        self.called: list[tuple[str, ...]] = []
        self.settings: list[dict[str, str]] = []
        self.code = 0

    def __call__(self, command: list[str]) -> subprocess.Popen:
        self.called.append(tuple(command[1:]))
        self.settings.append(dict(os.environ))
        return subprocess.Popen(["sh", "-c", f"exit {self.code}"])


@pytest.fixture(autouse=True)
def rows(monkeypatch: pytest.MonkeyPatch) -> Rows:
    rows = Rows()
    monkeypatch.setattr(workbook, "subprocess", SimpleNamespace(Popen=rows))
    return rows


def test_parameters_settings_and_this_environment_reach_every_notebook(folders, rows, tmp_path, monkeypatch, capfd):
    other = tmp_path / "user/kernels/python3/kernel.json"  # a kernel of the same name that the user has registered
    other.parent.mkdir(parents=True)
    other.write_text('{"argv": ["/bin/false"], "display_name": "other", "language": "python"}')
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path / "user"))
    homes, textures = tmp_path / "my homes", tmp_path / "dtd"
    homes.mkdir()
    textures.mkdir()
    show = "import os, sys, zerobev\nprint(SCALE, SCENES, os.getcwd(), sys.executable, sep='|')"
    variables = f"print(float(os.environ['ZEROBEV_FRESH']) > {time.time()}, os.environ['ZEROBEV_TEXTURES'], sep='|')"
    write_notebook(folders["notebooks"] / "00_first.ipynb", show, variables)
    write_notebook(folders["notebooks"] / "01_second.ipynb", "print('aside', file=__import__('sys').stderr); 1")

    report = reproduce("smoke", homes, textures, fresh=True, **folders)

    assert report == folders["reports"] / "smoke-my homes-scenes"
    expected = f"smoke|{homes}|{ROOT}|{sys.executable}\nTrue|{textures}\n"
    assert printed(report / "notebooks/00_first.ipynb") == expected
    assert expected in (report / "logs/00_first.log").read_text()
    assert "aside\n" in (report / "logs/01_second.log").read_text()
    assert "my homes" in (report / "notebooks/00_first.html").read_text()
    assert {path.suffix for path in (report / "notebooks").iterdir()} == {".ipynb", ".html"}
    shown = capfd.readouterr()
    lines = shown.out.splitlines()
    assert not shown.err
    assert [line.split()[:2] for line in lines] == [
        ["[1/2]", "00_first"],
        ["[2/2]", "01_second"],
        ["total", lines[2].split()[1]],
    ]
    assert "ZEROBEV_FRESH" not in os.environ
    # the same settings reach the rows, before the notebooks
    assert rows.called == [("-m", "zerobev", "run", "--all", "--scale", "smoke", "--scenes", str(homes))]
    (settings,) = rows.settings
    assert settings["ZEROBEV_TEXTURES"] == str(textures) and float(settings["ZEROBEV_FRESH"]) < time.time()


def test_no_notebook_is_executed_after_a_row_that_failed(folders, rows):
    write_notebook(folders["notebooks"] / "00_first.ipynb", "1")
    rows.code = 1
    with pytest.raises(NotebookError, match="rows of the tables: expected all to be computed, found some that failed"):
        reproduce("smoke", **folders)
    assert not (folders["reports"] / "smoke/notebooks").exists()


def test_a_failing_notebook_ends_the_run_in_one_clear_line(folders, monkeypatch, capfd):
    stale = folders["reports"] / "smoke/notebooks/01_bad.ipynb"
    write_notebook(stale)
    write_notebook(folders["notebooks"] / "00_good.ipynb", "print(SCALE)")
    write_notebook(
        folders["notebooks"] / "01_bad.ipynb", "1 + 1", "\nerror = 0.5\nassert error < 0.1, f'{error} m\\nor so'", "2"
    )
    write_notebook(folders["notebooks"] / "02_never.ipynb", "print('never')")
    monkeypatch.setattr(workbook, "reproduce", partial(reproduce, **folders))

    with pytest.raises(SystemExit) as stopped:
        cli.main(["reproduce", "--scale", "smoke"])

    log = folders["reports"] / "smoke/logs/01_bad.log"
    message = "01_bad.ipynb, code cell 3 (`error = 0.5`): AssertionError: 0.5 m"
    assert str(stopped.value) == f"\nerror: {message}\n  log: {log}"
    assert "Traceback" in log.read_text() and "Traceback" not in "".join(capfd.readouterr())
    kept = sorted(path.name for path in stale.parent.iterdir())
    assert kept == ["00_good.html", "00_good.ipynb"]


def test_a_dead_kernel_is_reported_with_its_cell(folders):
    write_notebook(folders["notebooks"] / "00_dies.ipynb", "import os", "os._exit(9)")
    with pytest.raises(NotebookError, match=r"00_dies.ipynb, code cell 3 \(`os._exit\(9\)`\): the kernel died"):
        reproduce("smoke", **folders)
    assert not list((folders["reports"] / "smoke/notebooks").iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scale": "tiny"}, "scale: expected one of smoke, reduced, deploy, paper, found 'tiny'"),
        ({"scale": "smoke", "scenes": Path("no/such")}, "scenes: expected a folder, found nothing at no/such"),
        ({"scale": "smoke", "textures": Path(__file__)}, f"textures: expected a folder, found a file at {__file__}"),
        ({"scale": "smoke"}, "expected notebooks"),
    ],
)
def test_bad_input_is_refused_before_anything_starts(arguments, message, folders):
    with pytest.raises(InputError, match=re.escape(message)):
        reproduce(**arguments, **folders)
    assert not folders["reports"].exists()


def test_a_second_run_of_the_same_report_stops(folders):
    write_notebook(folders["notebooks"] / "00_first.ipynb", "1")
    logs = folders["reports"] / "smoke/logs"
    logs.mkdir(parents=True)
    with (logs / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="found one at work"):
            reproduce("smoke", **folders)
    assert not (folders["reports"] / "smoke/notebooks").exists()


def test_refreshing_keeps_the_first_picture_for_the_readme(folders):
    draw = "import matplotlib.pyplot as plt\nlines = plt.plot([0, {0}])\nfigure = plt.gcf()"
    write_notebook(folders["notebooks"] / "00_tour.ipynb", draw.format(1), draw.format(2))
    write_notebook(folders["notebooks"] / "01_next.ipynb", draw.format(3))

    refresh(**folders)

    first = nbformat.read(folders["notebooks"] / "00_tour.ipynb", as_version=4).cells[2].outputs[0]
    assert (folders["reports"] / "tour.png").read_bytes() == base64.b64decode(first.data["image/png"])


def test_refreshing_twice_gives_the_same_bytes_and_a_failure_changes_none(folders):
    good, bad = folders["notebooks"] / "00_good.ipynb", folders["notebooks"] / "01_bad.ipynb"
    write_notebook(good, "for i in range(200):\n    print(i, flush=True)")
    write_notebook(bad, "1 / 0")
    before = bad.read_bytes()
    with pytest.raises(NotebookError, match="ZeroDivisionError: division by zero"):
        refresh(**folders)
    assert bad.read_bytes() == before
    first = good.read_bytes()
    bad.unlink()
    refresh(**folders)
    assert good.read_bytes() == first
    code = [cell for cell in nbformat.read(good, as_version=4).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == [1, 2] and len(code[1].outputs) == 1
    assert b"papermill" not in first and sys.version.split()[0].encode() not in first


def test_plain_nbval_finds_a_changed_output_from_any_folder_without_a_home(folders, tmp_path):
    write_notebook(
        folders["notebooks"] / "00_good.ipynb", "import matplotlib.pyplot as plt\n_ = plt.plot([0, 1])", "1 + 1"
    )
    refresh(**folders)
    good = (folders["notebooks"] / "00_good.ipynb").read_text()
    assert '"image/png"' in good
    (folders["notebooks"] / "01_changed.ipynb").write_text(good.replace('"2"\n', '"3"\n'))
    settings = (ROOT / "notebooks/conftest.py").read_text().replace("Path(__file__)", f"Path({str(ROOT / 'x/y')!r})")
    (folders["notebooks"] / "conftest.py").write_text(settings)
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--nbval", str(folders["notebooks"])]
    bare = {"PATH": os.defpath, "HOME": "/nonexistent"}
    checked = subprocess.run(command, cwd=tmp_path, env=bare, capture_output=True, text=True)
    assert "1 failed, 5 passed" in checked.stdout and "01_changed.ipynb::Cell 2" in checked.stdout


def test_kernels_write_inside_the_repository_alone():
    cache = [value for key, value in kernel_settings().items() if key.endswith("DIR")]
    assert len(cache) == 5 and all(Path(folder).is_relative_to(ROOT / ".cache") for folder in cache)


def test_report_name():
    assert report_name("paper", None) == "paper"
    assert report_name("reduced", Path("/data/homes/../hm3d/")) == "reduced-hm3d-scenes"


def test_make_help_lists_every_target():
    help_ = subprocess.run(["make", "-C", str(ROOT), "help"], capture_output=True, text=True, check=True).stdout
    targets = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE).group(1).split()
    listed = [line.split()[1] for line in help_.splitlines() if line.startswith("make ")]
    assert {"reproduce", "test", "lab", "help"} <= set(targets)
    assert sorted(listed) == sorted(targets) and max(map(len, help_.splitlines())) <= 120
