"""The package as others install it: the wheel, in a fresh environment that has its core dependencies alone."""

import os
import shutil
import subprocess
import sys
import zipfile
from email.parser import Parser
from importlib.metadata import distribution
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from PIL import Image

import zerobev

from support.paths import ROOT

PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
#: What projection has to do without.
OTHERS = ("OpenGL", "pyrender", "trimesh", "embreex", "h5py", "joblib", "dask", "accelerate")
PROJECT = f"""
import json, sys
import numpy as np
import zerobev
rgb, mask = np.load("rgb.npy"), np.load("mask.npy")
np.save("values.npy", zerobev.load().project(rgb, mask).values)
from importlib.util import find_spec
found = [name for name in {OTHERS} if find_spec(name)]
print(json.dumps([zerobev.__file__, found]))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from a copy: a build leaves folders in its source."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(ROOT / "zerobev", source / "zerobev", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = ["wheel", str(source), "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(folder)]
    subprocess.run([*PIP, *build], check=True)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory) -> Path:
    """A new environment with the wheel, and links to the distributions that its metadata asks for."""
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    install = ["--python", str(folder / "bin/python"), "install", "--no-deps", "--no-index", str(wheel)]
    subprocess.run([*PIP, *install], check=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    for name in required(metadata(wheel).get_all("Requires-Dist")):
        files = distribution(name).files or []
        for top in {file.parts[0] for file in files} - {"..", "__pycache__"}:
            if not (packages / top).exists():
                (packages / top).symlink_to(distribution(name).locate_file(top))
    return folder


def metadata(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return Parser().parsestr(archive.read(name).decode())


def required(lines: list[str]) -> set[str]:
    """Names of the distributions that requirements ask for, and of those that these ask for, without extras."""
    found: set[str] = set()
    waiting = [Requirement(line) for line in lines]
    while waiting:
        requirement = waiting.pop()
        wanted = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if wanted and requirement.name not in found:
            found.add(requirement.name)
            waiting += [Requirement(line) for line in distribution(requirement.name).requires or []]
    return found


def run(command: list[str | Path], folder: Path) -> str:
    """Output of a command that sees neither the checkout nor the variables of this process."""
    bare = {"PATH": os.defpath, "HOME": str(folder), "OMP_NUM_THREADS": "1"}
    ended = subprocess.run(command, cwd=folder, env=bare, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def test_the_wheel_holds_the_package_its_weights_and_one_version(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    weights = {path.name for path in (ROOT / "zerobev/inference/shipped").glob("*.safetensors")}
    assert weights and {Path(name).name for name in names if name.endswith(".safetensors")} == weights
    files = {path.relative_to(ROOT) for path in (ROOT / "zerobev").rglob("*") if "__pycache__" not in path.parts}
    assert {str(file) for file in files if file.suffix} <= set(names)
    assert "zerobev/py.typed" in names
    assert {name.partition("/")[0] for name in names} == {"zerobev", f"zerobev-{zerobev.__version__}.dist-info"}
    assert metadata(wheel)["Version"] == zerobev.__version__


def test_the_installed_package_projects_an_image_as_the_checkout_does(environment, tmp_path):
    rng = np.random.default_rng(0)
    rgb, mask = rng.integers(0, 256, (60, 80, 3), np.uint8), rng.random((60, 80)) < 0.5
    np.save(tmp_path / "rgb.npy", rgb)
    np.save(tmp_path / "mask.npy", mask)
    printed = run([environment / "bin/python", "-c", PROJECT], tmp_path)
    assert str(environment) in printed and printed.endswith(", []]\n")
    np.testing.assert_allclose(np.load(tmp_path / "values.npy"), zerobev.load().project(rgb, mask).values, atol=1e-5)


def test_the_command_projects_a_file_and_writes_beside_it_alone(environment, tmp_path):
    before = sorted(path.relative_to(environment) for path in environment.rglob("*") if "__pycache__" not in path.parts)
    Image.new("RGB", (80, 60), (90, 120, 150)).save(tmp_path / "photograph.jpg")
    Image.new("L", (80, 60), 255).save(tmp_path / "all.png")
    options = ["photograph.jpg", "--masks", "all.png", "--out", "map.png"]
    assert "all" in run([environment / "bin/zerobev", "project", *options], tmp_path)
    assert {"map.png", "map.npz", "photograph.jpg", "all.png"} == {
        path.name for path in tmp_path.iterdir() if not path.name.startswith(".")
    }
    after = sorted(path.relative_to(environment) for path in environment.rglob("*") if "__pycache__" not in path.parts)
    assert after == before
