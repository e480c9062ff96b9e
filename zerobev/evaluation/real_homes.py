"""Evaluate the shipped weights on a folder of homes.

Reads homes in HM3DSem layout; prints a table and writes the counts with `--json`. The networks were trained only on
generated homes, so all annotated scenes of the folder are test scenes. Views are rendered, not stored. Rows as in
Table 1: P^-1 with true depth (a.1) and with estimated depth (a.2), and the shipped networks.
"""

import argparse
import sys
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from zerobev.common.errors import InputError, attempt
from zerobev.common.progress import progress
from zerobev.common.storage import write_json
from zerobev.config import LABELS, CameraConfig, TextureConfig
from zerobev.data.samples import as_float, class_masks, collate, view_sample
from zerobev.data.views import ViewSource
from zerobev.evaluation.evaluate import Predictor, evaluate
from zerobev.evaluation.metrics import Counts, bootstrap_interval, class_iou, pixel_iou
from zerobev.geometry.projection import inverse_project
from zerobev.inference.projector import GEOMETRIC, load
from zerobev.inference.shipped_weights import ROWS, run_of, shipped
from zerobev.scenes.readers import find_scenes, read_scene

ORACLE = "a.1"
METHODS = {ORACLE: "P^-1 with true depth", GEOMETRIC: "P^-1 with estimated depth"} | {
    row: f"Zero-BEV ({row})" for row in ROWS
}


def render_views(folder: Path, number: int, views: int, camera: CameraConfig, seed: int) -> dict[str, Tensor]:
    """`views` random views of a scene as one batch, with the eight classes as modalities; `scene` is `number`."""
    scene = read_scene(folder)
    rng = np.random.default_rng([seed, zlib.crc32(folder.name.encode())])
    source = ViewSource(scene, camera, TextureConfig(), rng)
    drawn = [source.draw() for _ in range(views)]
    return as_float(
        collate([view_sample(view, camera, number, *class_masks(view, scene.instance_label)) for view in drawn])
    )


def evaluate_homes(folders: list[Path], views: int, seed: int = 0) -> tuple[dict[str, Counts], dict[str, str]]:
    """Intersections and unions per row of `METHODS`, on `views` views per scene.

    Returns the counts without the scenes that failed, and the messages of these, by name.
    Raises `InputError` if all scenes fail.
    """
    if views < 1:
        raise InputError(f"views: expected 1 or more, found {views}")
    projectors = {row: load(row) for row in (GEOMETRIC, *ROWS)}
    camera = projectors[GEOMETRIC].camera
    methods: dict[str, Predictor] = {ORACLE: lambda batch: inverse_project(batch["zero"], batch["depth"], camera) > 0}
    methods |= {row: projector.predict for row, projector in projectors.items()}
    total = {row: Counts.empty(len(folders), len(LABELS)) for row in METHODS}
    broken: dict[str, str] = {}

    def home_counts(number: int, folder: Path) -> dict[str, Counts]:
        batch = render_views(folder, number, views, camera, seed)
        return {row: evaluate(predict, [batch], len(folders), len(LABELS)) for row, predict in methods.items()}

    for number, folder in enumerate(progress(folders, "homes", "home", len(folders))):
        found = attempt(partial(home_counts, number, folder))
        if isinstance(found, InputError):
            broken[folder.name] = str(found)
            continue
        for row, one in found.items():
            total[row] += one
    if len(broken) == len(folders):
        raise InputError("; ".join(f"{name}: {message}" for name, message in broken.items()))
    good = [number for number, folder in enumerate(folders) if folder.name not in broken]
    return {row: Counts(c.intersection[good], c.union[good]) for row, c in total.items()}, broken


def results_table(counts: dict[str, Counts]) -> pd.DataFrame:
    """IoU in percent, one line per row; averages with 90 % intervals over scenes."""
    lines = []
    for row, one in counts.items():
        averages = []
        for statistic in (class_iou, pixel_iou):
            low, high = bootstrap_interval([one], statistic, np.random.default_rng(0))
            averages.append(f"{100 * one.value(statistic):.1f} [{100 * low:.1f}, {100 * high:.1f}]")
        lines.append((row, METHODS[row], *(100 * one.iou_per_class()).round(1), *averages))
    return pd.DataFrame(lines, columns=["row", "method", *LABELS, "class avg.", "pixel avg."]).set_index("row")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev evaluate`."""
    parser.add_argument("--scenes", type=Path, required=True, metavar="DIR", help="folder in HM3DSem layout")
    parser.add_argument("--views", type=int, default=40, help="per scene (default: 40)")
    parser.add_argument("--seed", type=int, default=0, help="of the poses")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the counts of every scene there")


def run(options: argparse.Namespace) -> None:
    """Evaluate and print the table; exit code 1 if a scene was skipped."""
    found = find_scenes(options.scenes)
    by_name = {folder.name: folder for folders in found.values() for folder in folders}
    folders = [by_name[name] for name in sorted(by_name)]
    torch.manual_seed(0)
    counts, broken = evaluate_homes(folders, options.views, options.seed)
    names = [folder.name for folder in folders if folder.name not in broken]
    print(f"{len(names)} homes, {options.views} views each; IoU in percent [90 % interval over homes]")
    print(results_table(counts).to_string())
    if options.json:
        rows = {
            row: {
                "class_iou": one.class_iou(),
                "pixel_iou": one.pixel_iou(),
                "weights": run_of(shipped(row)) if row in ROWS else None,
                **one.to_json(),
            }
            for row, one in counts.items()
        }
        write_json(options.json, {"scenes": names, "views": options.views, "seed": options.seed, "rows": rows})
    if broken:
        sys.exit("\n".join(f"skipped {name}: {message}" for name, message in broken.items()))
