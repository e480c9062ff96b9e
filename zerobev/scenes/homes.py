"""Write a data set of generated homes, in HM3DSem layout.

Reads nothing; writes `train/`, `minival/` and `val/` with a folder per home into `--out`. Home n of a seed is the same
at every scale. Existing homes are not written again.
"""

import argparse
from pathlib import Path

import joblib
import numpy as np

from zerobev.common.parallel import run_jobs
from zerobev.config import SCALES, SceneConfig, scale
from zerobev.scenes.hm3dsem import SceneFolders
from zerobev.scenes.hm3dsem_writer import write_dataset_config, write_scene
from zerobev.scenes.indoor import generate_home

# HM3D's numbering: training scenes from 0, the minival scenes (our validation) from 800, then the others
_FIRST = {"train": 0, "minival": 800, "val": 1000}


def home_folders(root: Path, scenes: SceneConfig) -> SceneFolders:
    """The folders of the homes of each split, written or not."""

    def folders(part: str, count: int) -> tuple[Path, ...]:
        return tuple(root / part / f"{n:05d}-Home{n:07d}" for n in range(_FIRST[part], _FIRST[part] + count))

    train, validation = folders("train", scenes.train), folders("minival", scenes.validation)
    return SceneFolders(train, validation, folders("val", scenes.test))


def ensure_home(folder: Path, seed: int) -> Path:
    """Generate and write the home of `folder`, unless it exists."""
    if not folder.exists():
        number = int(folder.name.split("-")[0])
        home = generate_home(folder.name.split("-")[1], np.random.default_rng([seed, number]))
        write_scene(folder, home)
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
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="processes (default: 1)")


def run(options: argparse.Namespace) -> None:
    """Write the homes of a scale."""
    split = home_folders(options.out, scale(options.scale).scenes)
    folders = [*split.train, *split.validation, *split.test]
    ensure_homes(folders, options.seed, options.workers)
    write_dataset_config(options.out, folders)
