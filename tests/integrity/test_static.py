"""Static checks: style, types, layers, length of files, and no code execution when files are loaded."""

import ast
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from support.paths import ROOT

SOURCES = sorted((ROOT / "zerobev").rglob("*.py"))
#: Per file. The longest ones hold one idea each: a training loop, texture banks.
MAX_LINES = 340


@pytest.mark.parametrize("command", ["ruff check .", "ruff format --check .", "mypy", "lint-imports --no-cache"])
def test_the_checkers_find_nothing(command: str):
    """Their settings are in pyproject.toml."""
    name, *arguments = command.split()
    checker = Path(sys.executable).with_name(name)
    found = subprocess.run([checker, *arguments], cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout + found.stderr


def test_the_spelling_is_right():
    """Of code, documents and the Markdown of notebooks; its settings are in pyproject.toml."""
    checker = Path(sys.executable).with_name("codespell")
    found = subprocess.run([checker], cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout + found.stderr
    prose = "\n".join(
        cell.source
        for path in sorted((ROOT / "notebooks").glob("*.ipynb"))
        for cell in nbformat.read(path, as_version=4).cells
    )
    found = subprocess.run([checker, "-"], cwd=ROOT, input=prose, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout + found.stderr


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_file_is_short(path: Path):
    assert len(path.read_text().splitlines()) <= MAX_LINES


def unsafe_loads(source: str) -> list[str]:
    """Calls that could execute code from a file; ruff's S301 finds calls of pickle."""
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    found = [(ast.unparse(call.func), {ast.unparse(word) for word in call.keywords}) for call in calls]
    return [
        name
        for name, words in found
        if "allow_pickle=True" in words or (name == "torch.load" and "weights_only=True" not in words)
    ]


def test_only_data_is_loaded():
    assert unsafe_loads("torch.load(f, weights_only=True); np.load(f)") == []
    assert unsafe_loads("torch.load(f); np.load(f, allow_pickle=True)") == ["torch.load", "np.load"]
    assert [(path, call) for path in SOURCES for call in unsafe_loads(path.read_text())] == []
