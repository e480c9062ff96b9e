"""Dependencies: each import is declared in the group of its room; pins and ranges agree."""

import ast
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import nbformat
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from support.paths import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DISTRIBUTIONS = packages_distributions()
#: Group -> the groups that it includes.
INCLUDED = {
    "core": (),
    "export": ("core",),
    "scenes": ("core",),
    "workbook": ("core", "export", "scenes"),
    "dev": ("core", "export", "scenes", "workbook"),
}
GROUPS = tuple(INCLUDED)
#: Module or room of zerobev -> group; all others are core.
GROUP_OF = {
    "inference.export": "export",
    **dict.fromkeys(["common.parallel", "scenes", "rendering", "data", "evaluation"], "scenes"),
    **dict.fromkeys(["common.locks", "interactive", "training", "experiments", "benchmarks", "report"], "workbook"),
}
#: Commands and plug-ins without an import.
TOOLS = {"ipykernel", "jupyterlab", "nbval", "ruff", "mypy", "coverage", "import-linter", "codespell", "setuptools"}
TOOLS |= {"onnx", "onnxscript"}  # torch imports them


def requirements(group: str) -> dict[str, Requirement]:
    """Name -> requirement of a group, without the groups that it includes."""
    lines = PROJECT["dependencies"] if group == "core" else PROJECT["optional-dependencies"][group]
    found = {canonicalize_name(Requirement(line).name): Requirement(line) for line in lines}
    found.pop("zerobev", None)
    return found


def declared(group: str) -> set[str]:
    """Names of all distributions of an installation with a group."""
    return {name for one in (*INCLUDED[group], group) for name in requirements(one)}


def imported(source: str) -> set[str]:
    """Full names of all modules that `source` imports, also in functions; `from a import b` gives a and a.b.

    Without imports for type checkers, which are not loaded.
    """
    names: set[str] = set()
    waiting: list[ast.AST] = [ast.parse(source)]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            waiting += ast.iter_child_nodes(node)
    return names


def distributions(names: set[str]) -> set[str]:
    """Distributions of imported modules, without the standard library, zerobev and the tests."""
    roots = {name.partition(".")[0] for name in names} - sys.stdlib_module_names - {"zerobev", "support"}
    return {canonicalize_name(DISTRIBUTIONS[root][0]) for root in roots}


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): imported(path.read_text()) for path in sorted((ROOT / "zerobev").rglob("*.py"))}


def group_of(module: str) -> str:
    inside = module.partition(".")[2]
    return GROUP_OF.get(inside) or GROUP_OF.get(inside.partition(".")[0], "core")


@cache
def needed(module: str) -> frozenset[str]:
    """The modules of zerobev that are loaded with `module`, including itself and its parents."""
    loaded, waiting = set(), [module]
    while waiting:
        name = waiting.pop()
        if name not in loaded and name in MODULES:
            loaded.add(name)
            waiting += [name.rpartition(".")[0], *MODULES[name]]
    return frozenset(loaded)


@pytest.mark.parametrize("module", MODULES)
def test_imports_of_a_module_are_declared(module: str):
    names = {name for one in needed(module) for name in MODULES[one]}
    assert distributions(names) <= declared(group_of(module))


def test_imports_of_tests_and_notebooks_are_declared():
    tests = {name for path in (ROOT / "tests").rglob("*.py") for name in imported(path.read_text())}
    assert distributions(tests) <= declared("dev")
    cells = [cell for path in (ROOT / "notebooks").glob("*.ipynb") for cell in nbformat.read(path, as_version=4).cells]
    code = {name for cell in cells if cell.cell_type == "code" for name in imported(cell.source)}
    assert distributions(code) <= declared("workbook")


@pytest.mark.parametrize("group", GROUPS[:-1])
def test_declared_dependencies_are_used(group: str):
    used = {name for module, names in MODULES.items() if group_of(module) == group for name in names}
    assert set(requirements(group)) - TOOLS <= distributions(used)


def test_pins_and_ranges_agree():
    lines = (line.partition("#")[0].strip() for line in (ROOT / "environment.txt").read_text().splitlines())
    pins = {canonicalize_name(Requirement(line).name): Requirement(line) for line in lines if line}
    ranges = {name: one for group in GROUPS for name, one in requirements(group).items()}
    assert set(pins) == set(ranges)
    for name, pin in pins.items():
        (exact,) = pin.specifier
        assert exact.operator == "==" and exact.version in ranges[name].specifier, pin
        assert pin.extras == ranges[name].extras, pin
