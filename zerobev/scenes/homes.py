"""Write a data set of generated homes, in HM3DSem layout.

Reads nothing; writes `train/`, `minival/` and `val/` with a folder per home into `--out`. Home n of a seed is the same
at every scale. Existing homes are not written again.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import joblib
import numpy as np

from zerobev.common.parallel import run_jobs
from zerobev.config import SCALES, Homes, SceneConfig, scale
from zerobev.scenes.hm3dsem import SceneFolders
from zerobev.scenes.hm3dsem_writer import write_dataset_config, write_scene
from zerobev.scenes.indoor import generate_home

# HM3D's numbering: training scenes from 0, the minival scenes (our validation) from 800, then the others
_FIRST = {"train": 0, "minival": 800, "val": 1000}
#: Start of a home's name, from which its kind is read. Only flats have names of `Scene.generated`.
_NAMES: dict[Homes, str] = {"flats": "Home", "varied": "Varied"}


def home_folders(root: Path, scenes: SceneConfig) -> SceneFolders:
    """The folders of the homes of each split, written or not."""

    def folders(part: str, count: int) -> tuple[Path, ...]:
        numbers = range(_FIRST[part], _FIRST[part] + count)
        return tuple(root / part / f"{n:05d}-{_NAMES[scenes.homes]}{n:07d}" for n in numbers)

    train, validation = folders("train", scenes.train), folders("minival", scenes.validation)
    return SceneFolders(train, validation, folders("val", scenes.test))


def ensure_home(folder: Path, seed: int) -> Path:
    """Generate and write the home of `folder`, unless it exists."""
    if not folder.exists():
        number, name = folder.name.split("-")
        homes: Homes = "varied" if name.startswith(_NAMES["varied"]) else "flats"
        write_scene(folder, generate_home(name, np.random.default_rng([seed, int(number)]), homes))
    return folder


def ensure_homes(folders: list[Path], seed: int, workers: int) -> None:
    """Generate the missing homes of `folders`, in parallel."""
    missing = [folder for folder in folders if not folder.exists()]
    jobs = (joblib.delayed(ensure_home)(folder, seed) for folder in missing)
    for _ in run_jobs(jobs, workers, "homes", len(missing)):
        pass


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `zerobev homes`."""
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write, in HM3DSem layout")
    parser.add_argument("--scale", default="reduced", help=f"one of {', '.join(SCALES)} (default: reduced)")
    parser.add_argument("--homes", default="flats", help="flats, or varied: many kinds of buildings (default: flats)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="processes (default: 1)")


def run(options: argparse.Namespace) -> None:
    """Write the homes of a scale."""
    split = home_folders(options.out, replace(scale(options.scale).scenes, homes=options.homes))
    folders = [*split.train, *split.validation, *split.test]
    ensure_homes(folders, options.seed, options.workers)
    write_dataset_config(options.out, folders)
