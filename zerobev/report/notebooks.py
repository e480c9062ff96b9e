"""Run the whole workbook.

Reads `notebooks/` and the records of `reports/<report>/`; writes executed copies and their HTML into
`reports/<report>/notebooks/`, and messages of kernels into `reports/<report>/logs/`. Notebooks run in order, with scale
and scenes as parameters; missing rows of the tables are computed before, side by side. After an interruption the same
command continues with the recorded results.
"""

import argparse
import base64
import contextlib
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import nbformat
import papermill
from nbclient.exceptions import DeadKernelError
from nbconvert import HTMLExporter
from nbformat import NotebookNode
from papermill.exceptions import PapermillExecutionError

from zerobev.common.errors import InputError
from zerobev.common.locks import locked
from zerobev.common.paths import PACKAGE_PARENT, report_name, zerobev_home
from zerobev.common.storage import replacing
from zerobev.config import SCALES, one_of

NOTEBOOKS = PACKAGE_PARENT / "notebooks"
_WORK = "run of this report"


class NotebookError(Exception):
    """A notebook failed, or a row that it reads; the message names the notebook, the cell and the error."""


def kernel_settings() -> dict[str, str]:
    """Environment variables of notebook kernels; the folders they name are made.

    They select this environment's kernel, figures inside the notebook, the package and `zerobev_home()`. Jupyter,
    IPython and matplotlib read and write inside `zerobev_home()`: the user's settings do not change outputs, and the
    home directory may be read-only.
    """
    own = {
        "JUPYTER_CONFIG_DIR": "jupyter/config",
        "JUPYTER_DATA_DIR": "jupyter/data",
        "JUPYTER_RUNTIME_DIR": "jupyter/runtime",
        "IPYTHONDIR": "ipython",
        "MPLCONFIGDIR": "matplotlib",
    }
    cache = zerobev_home() / ".cache"
    for folder in own.values():
        (cache / folder).mkdir(parents=True, exist_ok=True)
    return {
        **{variable: str(cache / folder) for variable, folder in own.items()},
        "JUPYTER_PATH": str(Path(sys.prefix) / "share" / "jupyter"),
        "ZEROBEV_HOME": str(zerobev_home()),
        "PYTHONPATH": os.pathsep.join([str(PACKAGE_PARENT), *filter(None, [os.environ.get("PYTHONPATH")])]),
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
        # progress bars use no Jupyter widgets
        "PYTHONWARNINGS": "ignore:IProgress not found",
        "TOKENIZERS_PARALLELISM": os.environ.get("TOKENIZERS_PARALLELISM", "false"),
    }


@contextlib.contextmanager
def environment(variables: dict[str, str]) -> Iterator[None]:
    """Set environment variables, which kernels inherit, and restore all variables at the end."""
    before = dict(os.environ)
    os.environ.update(variables)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextlib.contextmanager
def shown_progress(file: Path) -> Iterator[None]:
    """Kernels write the progress of long work to `file`; it is copied to the terminal, if there is one."""
    file.write_text("")
    done = threading.Event()
    terminal = os.dup(2)

    def follow() -> None:
        with file.open("rb") as written:
            while not done.wait(0.5):
                os.write(terminal, written.read())

    follower = threading.Thread(target=follow, daemon=True)
    with environment({"ZEROBEV_PROGRESS": str(file)}):
        if sys.stderr.isatty():
            follower.start()
        try:
            yield
        finally:
            done.set()
            if follower.is_alive():
                follower.join()
            os.close(terminal)


@contextlib.contextmanager
def standard_error_in(log: Path) -> Iterator[None]:
    """Redirect file descriptor 2 of this process, and of kernels it starts, to the end of `log`."""
    sys.stderr.flush()
    terminal = os.dup(2)
    with log.open("ab") as file:
        os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        sys.stderr.flush()
        os.dup2(terminal, 2)
        os.close(terminal)


def execute(notebook: Path, executed: Path, logs: Path, parameters: dict[str, str]) -> NotebookNode:
    """Execute `notebook` with `parameters` in `zerobev_home()`, and write it to `executed` if it succeeds.

    Output streams of cells, messages of the kernel, and the traceback of a failure go to `logs/<notebook>.log`.
    Raises `NotebookError`; then `executed` is unchanged.
    """
    logs.mkdir(parents=True, exist_ok=True)
    log = logs / f"{notebook.stem}.log"
    log.unlink(missing_ok=True)
    with replacing(executed) as unfinished, log.open("a") as streams:
        try:
            with standard_error_in(log):
                return papermill.execute_notebook(
                    notebook,
                    unfinished,
                    parameters,
                    kernel_name="python3",
                    language="python",
                    progress_bar=False,
                    stdout_file=streams,
                    stderr_file=streams,
                    cwd=zerobev_home(),
                    coalesce_streams=True,
                    store_widget_state=False,  # its keys are random, and pages with it load scripts from the internet
                )
        except PapermillExecutionError as error:
            streams.write(str(error))
            reason = f"{error.ename}: {(error.evalue.splitlines() or [''])[0]}"
        except DeadKernelError:
            reason = "the kernel died (see the log; out of memory?)"
        raise NotebookError(f"{notebook.name}, {_stopped_at(unfinished)}: {reason}\n  log: {log}")


def _stopped_at(unfinished: Path) -> str:
    """Number and first line of the last code cell that was started; the injected cell does not count."""
    code = [cell for cell in nbformat.read(unfinished, as_version=4).cells if cell.cell_type == "code"]
    code = [cell for cell in code if "injected-parameters" not in cell.metadata.get("tags", [])]
    started = [cell for cell in code if cell.metadata.papermill.start_time]
    if not started:
        return "before its first code cell"
    return f"code cell {len(started)} (`{started[-1].source.strip().splitlines()[0]}`)"


def write_page(notebook: NotebookNode, page: Path, log: Path) -> None:
    """Write an executed notebook as HTML; messages of the converter go to `log`."""
    with replacing(page) as unfinished, standard_error_in(log):
        unfinished.write_text(HTMLExporter().from_notebook_node(notebook)[0], encoding="utf-8")


def compute_rows(scale: str, scenes: str) -> None:
    """Compute the missing rows of all tables side by side, before the notebooks read them one by one.

    scenes: folder of HM3DSem scenes; "": generated homes
    Raises `NotebookError` if a row failed.
    """
    # in a process of its own: this one needs no torch
    command = [sys.executable, "-m", "zerobev", "run", "--all", "--scale", scale, "--scenes", scenes]
    with subprocess.Popen(command) as rows:  # unlike `subprocess.run`, it is not killed while it ends its processes
        if rows.wait() != 0:
            raise NotebookError("rows of the tables: expected all to be computed, found some that failed")


def _notebooks_in(folder: Path) -> list[Path]:
    found = sorted(folder.glob("*.ipynb"))
    if not found:
        raise InputError(f"{folder}: expected notebooks (*.ipynb), found none")
    return found


def _progress(notebooks: list[Path]) -> Iterator[Path]:
    """Yield each notebook; print its name at the start, its seconds at the end, and the total."""
    begin = time.monotonic()
    for number, notebook in enumerate(notebooks, start=1):
        start = time.monotonic()
        print(f"[{number}/{len(notebooks)}] {notebook.stem} ...", end="", flush=True)
        yield notebook
        print(f" {time.monotonic() - start:.1f} s", flush=True)
    print(f"total {time.monotonic() - begin:.1f} s")


def reproduce(
    scale: str,
    scenes: Path | None = None,
    textures: Path | None = None,
    fresh: bool = False,
    notebooks: Path = NOTEBOOKS,
    reports: Path | None = None,
) -> Path:
    """Compute the missing rows, execute every notebook of a folder in order of name, and return the report's folder.

    scale: name of a scale, the notebooks' parameter `SCALE`
    scenes: folder of HM3DSem scenes, the parameter `SCENES` as an absolute path; None (`""`): generated homes
    textures: folder of texture images, passed to kernels in the environment variable `ZEROBEV_TEXTURES`
    fresh: compute all records again; kernels ignore records older than `ZEROBEV_FRESH`, the time of this call in
        seconds since 1970
    reports: folder of the reports; default: `reports` in `common.paths.zerobev_home()`
    Raises `InputError` before anything is executed, `NotebookError` if a row fails or at the first notebook that fails.
    """
    one_of("scale", scale, SCALES)
    for name, folder in (("scenes", scenes), ("textures", textures)):
        if folder is not None and not folder.is_dir():
            raise InputError(
                f"{name}: expected a folder, found {'a file' if folder.exists() else 'nothing'} at {folder}"
            )
    sources = _notebooks_in(notebooks)
    parameters = {"SCALE": scale, "SCENES": "" if scenes is None else str(scenes.resolve())}
    variables = kernel_settings()
    if textures is not None:
        variables["ZEROBEV_TEXTURES"] = str(textures.resolve())
    if fresh:
        variables["ZEROBEV_FRESH"] = str(time.time())

    report = (reports or zerobev_home() / "reports") / report_name(scale, scenes)
    executed, logs = report / "notebooks", report / "logs"
    with locked(logs, _WORK), environment(variables):
        shutil.rmtree(executed, ignore_errors=True)  # of an earlier run
        compute_rows(scale, parameters["SCENES"])
        with shown_progress(logs / "progress.log"):
            for notebook in _progress(sources):
                copy = execute(notebook, executed / notebook.name, logs, parameters)
                write_page(copy, executed / f"{notebook.stem}.html", logs / f"{notebook.stem}.log")
    return report


def first_picture(notebook: NotebookNode) -> bytes | None:
    """The first figure of a notebook's outputs, as PNG; None if there is none."""
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    pictures = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    return base64.b64decode(pictures[0]) if pictures else None


def refresh(notebooks: Path = NOTEBOOKS, reports: Path = PACKAGE_PARENT / "reports") -> None:
    """Execute all notebooks of the folder with their own parameters, and replace each by its executed copy.

    Copies have no metadata of their execution, so equal outputs give equal files. The first figure of the first
    notebook, the tour, is copied to `reports/tour.png` for the README.
    """
    cache = zerobev_home() / ".cache/notebooks"
    with locked(cache, _WORK), environment(kernel_settings()):
        for notebook in _progress(_notebooks_in(notebooks)):
            copy = execute(notebook, cache / notebook.name, cache, {})
            copy.metadata = {"kernelspec": copy.metadata.kernelspec, "language_info": {"name": "python"}}
            for cell in copy.cells:
                kept = ("tags", "jupyter")  # "jupyter" folds the solutions of exercises
                cell.metadata = {name: cell.metadata[name] for name in kept if cell.metadata.get(name)}
            with replacing(notebook) as clean:
                nbformat.write(copy, clean)
    picture = first_picture(nbformat.read(_notebooks_in(notebooks)[0], as_version=4))
    if picture:
        with replacing(reports / "tour.png") as file:
            file.write_bytes(picture)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev reproduce`."""
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--scale", help=f"{', '.join(SCALES)}: run it at this scale into reports/")
    which.add_argument("--in-place", action="store_true", help="execute the committed notebooks again, in place")
    parser.add_argument("--scenes", type=Path, metavar="DIR", help="HM3DSem scenes instead of generated homes")
    parser.add_argument("--textures", type=Path, metavar="DIR", help="texture images for the zero-shot stream")
    parser.add_argument("--fresh", action="store_true", help="compute again what is already recorded")


def run(options: argparse.Namespace) -> None:
    """Run the workbook at a scale, or execute the committed notebooks in place."""
    try:
        if options.in_place:
            refresh()
        else:
            report = reproduce(options.scale, options.scenes, options.textures, options.fresh)
            print(f"notebooks and their HTML: {report / 'notebooks'}")
    except NotebookError as error:
        sys.exit(f"\nerror: {error}")
