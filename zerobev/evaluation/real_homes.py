"""Evaluate the shipped weights, or other ones, on a folder of homes.

Reads homes in HM3DSem layout: a data set, one of its parts such as `val/`, or one scene. Prints IoU, depth errors and
the homes that fail most, and writes all of it with `--json`. The networks were trained only on generated homes, so all
annotated scenes of the folder are test scenes. Views are rendered, not stored. Rows: P^-1 with true depth (a.1) and
with estimated depth (a.2); the shipped networks, residual ones also without depth (.none), with the depth of a depth
camera (.sensor, see `data.sensor_depth`) and with true depth (.true); floor over the whole field of view (constant).
With `--weights`, the row of the networks is `own`.
"""

import argparse
import sys
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from zerobev.common.errors import InputError, attempt
from zerobev.common.progress import progress
from zerobev.common.storage import write_json
from zerobev.config import LABELS, CameraConfig, TextureConfig
from zerobev.data.samples import as_float, class_masks, collate, view_sample
from zerobev.data.sensor_depth import fused, sensor_depth, with_measured
from zerobev.data.views import ViewSource
from zerobev.evaluation.evaluate import evaluate
from zerobev.evaluation.metrics import Counts, bootstrap_interval, class_iou, pixel_iou
from zerobev.evaluation.other_cameras import POSES, cameras_table, evaluate_cameras
from zerobev.geometry.projection import inverse_project
from zerobev.inference.pretrained import GEOMETRIC
from zerobev.inference.projector import Projector, load
from zerobev.inference.shipped_weights import ROWS, run_of, shipped
from zerobev.models.depth import estimate
from zerobev.models.variants import VARIANTS
from zerobev.scenes.readers import list_scenes, read_scene
from zerobev.training.loader import Batch

ORACLE, CONSTANT, OWN = "a.1", "constant", "own"
_DEPTHS = {"none": "no depth", "sensor": "a depth camera", "true": "true depth"}


def methods(residual: Mapping[str, bool]) -> dict[str, str]:
    """Row -> title. residual: network -> whether it is a residual one."""
    return {
        ORACLE: "P^-1 with true depth",
        GEOMETRIC: "P^-1 with estimated depth",
        **{row: f"Zero-BEV ({row})" for row in residual},
        **{
            f"{row}.{depth}": f"Zero-BEV ({row}) with {text}"
            for row, reads_depth in residual.items()
            if reads_depth
            for depth, text in _DEPTHS.items()
        },
        CONSTANT: "floor over the whole field of view",
    }


#: Row -> title, of the shipped networks.
METHODS = methods({row: VARIANTS[row][1].get("residual", False) for row in ROWS})
_TITLES = METHODS | methods({OWN: True})
_FLOOR = LABELS.index("floor")
_WORST = 3  # homes that are discussed
# from here on, a property of a home counts as a reason of its failure
_FLOOR_OFF, _DEPTH_OFF, _DARK, _NEAR_M = 0.1, 0.15, 0.25, 1.5
_LOST, _FOUND = 0.25, 0.1  # a class is lost below this fraction of P^-1's IoU with true depth, if that is not small


@dataclass(frozen=True)
class DepthReport:
    """Estimated depth in the views of a home, and what may explain its errors."""

    relative: float  #: mean of absolute difference over true depth
    mad_m: float  #: mean absolute difference, metres
    floor_ratio: float  #: median of estimated over true depth on the floor; NaN without visible floor
    brightness: float  #: mean of the photographs, in [0, 1]
    median_m: float  #: median of true depth, metres

    def reasons(self) -> str:
        """Probable reasons of wrong maps, in words."""
        found = []
        if abs(self.floor_ratio - 1) > _FLOOR_OFF:
            found.append(f"estimated depth puts the floor at {self.floor_ratio:.2f} of its distance")
        elif self.relative > _DEPTH_OFF:
            found.append(f"estimated depth is {self.relative:.0%} off, on walls and objects: the floor is right")
        if self.brightness < _DARK:
            found.append(f"the photographs are dark (mean brightness {self.brightness:.2f})")
        if self.median_m < _NEAR_M:
            found.append(f"most surfaces are near (median {self.median_m:.1f} m), so little floor is in view")
        return "; ".join(found) or "no reason found in estimated depth, light or distances"


@dataclass(frozen=True)
class HomeResult:
    """Counts of one home per row of `methods`, each with one scene, and its depth."""

    counts: dict[str, Counts]
    depth: DepthReport

    def lost_classes(self, row: str) -> list[str]:
        """The classes that P^-1 with true depth finds, and a row hardly."""
        true, predicted = (self.counts[name].iou_per_class() for name in (ORACLE, row))
        return [name for name, a, b in zip(LABELS, true, predicted) if a > _FOUND and b < _LOST * a]


@dataclass(frozen=True)
class Results:
    """The results of all homes that could be evaluated, by name, and the failures of the others."""

    homes: dict[str, HomeResult]
    broken: dict[str, str]
    row: str = ROWS[-1]  #: the network whose failures are discussed

    @property
    def counts(self) -> dict[str, Counts]:
        """Counts per row of `methods`, a scene per home."""
        rows = next(iter(self.homes.values())).counts
        per_row = {row: [home.counts[row] for home in self.homes.values()] for row in rows}
        return {
            row: Counts(
                np.concatenate([one.intersection for one in counts]), np.concatenate([one.union for one in counts])
            )
            for row, counts in per_row.items()
        }

    def worst(self) -> list[str]:
        """A line for each of the homes in which the network is worst, relative to the oracle (a.1)."""

        def share(home: HomeResult) -> float:
            return home.counts[self.row].class_iou() / max(home.counts[ORACLE].class_iou(), 1e-9)

        lines = []
        for name, home in sorted(self.homes.items(), key=lambda item: share(item[1]))[:_WORST]:
            lost = f"; lost classes: {', '.join(names)}" if (names := home.lost_classes(self.row)) else ""
            lines.append(
                f"{name}: ({self.row}) has {share(home):.2f} of ({ORACLE})'s class IoU{lost}; {home.depth.reasons()}"
            )
        return lines

    def to_json(self) -> dict[str, Any]:
        """Averages, counts per home in the order of `scenes`, and depth errors, as plain data."""
        rows = {
            row: {
                "class_iou": one.class_iou(),
                "pixel_iou": one.pixel_iou(),
                "weights": run_of(shipped(network)) if (network := _network_of(row)) in ROWS else None,
                **one.to_json(),
            }
            for row, one in self.counts.items()
        }
        by_home = {name: asdict(home.depth) for name, home in self.homes.items()}
        means = {name: float(np.mean([one[name] for one in by_home.values()])) for name in ("relative", "mad_m")}
        return {"scenes": list(self.homes), "rows": rows, "depth": {**means, "by_home": by_home}}


def _network_of(row: str) -> str:
    """The row without the kind of its depth."""
    stem, _, kind = row.rpartition(".")
    return stem if kind in _DEPTHS else row


def render_views(folder: Path, views: int, camera: CameraConfig, seed: int) -> dict[str, Tensor]:
    """`views` random views of a scene as one batch, with the eight classes as modalities.

    `sensor` (B, 1, H, H) float32 is the depth of a depth camera, metres, 0 for no value.
    """
    scene = read_scene(folder)
    rng = np.random.default_rng([seed, zlib.crc32(folder.name.encode())])
    source = ViewSource(scene, camera, TextureConfig(), rng)
    drawn = [source.draw() for _ in range(views)]
    batch = as_float(
        collate([view_sample(view, camera, 0, *class_masks(view, scene.instance_label)) for view in drawn])
    )
    noise = rng.spawn(1)[0]
    measured = np.stack([sensor_depth(view.depth, view.rgb, noise)[None] for view in drawn])
    return batch | {"sensor": torch.from_numpy(measured)}


def evaluate_homes(
    folders: Iterable[Path],
    views: int,
    seed: int = 0,
    report: Callable[[str], None] = print,
    weights: str | Path | None = None,
) -> Results:
    """All rows of `methods` on `views` views per scene.

    report: gets a line per finished home
    weights: a network with its depth estimator, as of `zerobev.load`; None: the shipped ones
    Raises `InputError` if all scenes fail, and for weights without a network.
    """
    if views < 1:
        raise InputError(f"views: expected 1 or more, found {views}")
    folders = list(folders)
    projectors = {row: load(row) for row in ROWS} if weights is None else {OWN: load(weights)}
    if any(projector.network is None for projector in projectors.values()):
        raise InputError(f"weights: expected a network, found P^-1 ({weights})")
    row = list(projectors)[-1]
    homes: dict[str, HomeResult] = {}
    broken: dict[str, str] = {}
    for number, folder in enumerate(progress(folders, "homes", "home", len(folders)), start=1):
        found = attempt(partial(_home_result, folder, views, seed, projectors))
        if isinstance(found, InputError):
            broken[folder.name] = str(found)
            report(f"[{number}/{len(folders)}] {folder.name}: skipped: {found}")
            continue
        homes[folder.name] = found
        shown = found.counts[row]
        iou = f"({row}) class {100 * shown.class_iou():.1f}, pixel {100 * shown.pixel_iou():.1f}"
        report(f"[{number}/{len(folders)}] {folder.name}: {iou}; depth {found.depth.relative:.0%} off")
    if len(broken) == len(folders):
        raise InputError("; ".join(f"{name}: {message}" for name, message in broken.items()))
    return Results(homes, broken, row)


def _home_result(folder: Path, views: int, seed: int, projectors: dict[str, Projector]) -> HomeResult:
    first, *_ = projectors.values()
    camera = first.camera
    batch = render_views(folder, views, camera, seed)
    with torch.inference_mode():
        estimated = estimate(first.estimator, batch["rgb"], batch.get("height"))
    true = batch["depth"].numpy()[:, 0]
    measured = [fused(*pair) for pair in zip(batch["sensor"].numpy()[:, 0], estimated.numpy()[:, 0])]
    depths = {
        "": estimated,
        ".none": torch.zeros_like(estimated),
        ".true": torch.from_numpy(with_measured(true, true)),
        ".sensor": torch.from_numpy(np.stack(measured)),
    }
    heights = batch.get("height")
    maps = {
        ORACLE: inverse_project(batch["zero"], batch["depth"], camera, heights) > 0,
        GEOMETRIC: inverse_project(batch["zero"], estimated, camera, heights) > 0,
        CONSTANT: torch.zeros_like(batch["target"], dtype=torch.bool),
    }
    maps[CONSTANT][:, _FLOOR] = True
    with torch.inference_mode():
        for row, projector in projectors.items():
            assert projector.network is not None  # as all shipped rows
            for suffix, depth in depths.items() if projector.network.config.residual else (("", estimated),):
                maps[row + suffix] = projector.network(batch["rgb"], batch["zero"], depth, heights).zero_logits > 0
    rows = methods({row: f"{row}.true" in maps for row in projectors})
    counts = {row: evaluate(partial(_given, maps[row]), [batch], 1, len(LABELS)) for row in rows}
    return HomeResult(counts, _depth_report(batch, estimated))


def _given(maps: Tensor, batch: Batch) -> Tensor:
    return maps


def _depth_report(batch: dict[str, Tensor], estimated: Tensor) -> DepthReport:
    truth, floor = batch["depth"], batch["zero"][:, [_FLOOR]] > 0
    known = truth > 0
    error = (estimated - truth).abs()[known].double()
    on_floor = (estimated / truth)[known & floor].double()
    return DepthReport(
        relative=float((error / truth[known]).mean()),
        mad_m=float(error.mean()),
        floor_ratio=float(on_floor.median()) if len(on_floor) else float("nan"),
        brightness=float(batch["rgb"].mean()),
        median_m=float(truth[known].median()),
    )


def results_table(counts: dict[str, Counts]) -> pd.DataFrame:
    """IoU in percent, one line per row; averages with 90 % intervals over scenes."""
    lines = []
    for row, one in counts.items():
        averages = []
        for statistic in (class_iou, pixel_iou):
            low, high = bootstrap_interval([one], statistic, np.random.default_rng(0))
            averages.append(f"{100 * one.value(statistic):.1f} [{100 * low:.1f}, {100 * high:.1f}]")
        lines.append((row, _TITLES[row], *(100 * one.iou_per_class()).round(1), *averages))
    return pd.DataFrame(lines, columns=["row", "method", *LABELS, "class avg.", "pixel avg."]).set_index("row")


def homes_table(homes: dict[str, HomeResult]) -> pd.DataFrame:
    """Per home: class IoU in percent of each row, relative depth error in percent, and floor ratio."""
    lines = {
        name: {row: round(100 * one.class_iou(), 1) for row, one in home.counts.items()}
        | {"depth error": round(100 * home.depth.relative, 1), "floor ratio": round(home.depth.floor_ratio, 2)}
        for name, home in homes.items()
    }
    return pd.DataFrame(lines).T.rename_axis("home")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev evaluate`."""
    parser.add_argument(
        "--scenes", type=Path, required=True, metavar="DIR", help="data set in HM3DSem layout, part of one, or a scene"
    )
    parser.add_argument("--views", type=int, default=40, help="per scene (default: 40)")
    parser.add_argument("--seed", type=int, default=0, help="of the poses")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all results there")
    parser.add_argument(
        "--weights",
        metavar="SOURCE",
        help="a checkpoint or a folder of save_pretrained, instead of the shipped weights",
    )
    parser.add_argument(
        "--cameras", action="store_true", help=f"other cameras at {POSES} poses per scene, see evaluation.other_cameras"
    )


def run(options: argparse.Namespace) -> None:
    """Evaluate and print the tables; exit code 1 if a scene was skipped."""
    torch.manual_seed(0)
    if options.cameras:
        if options.weights:
            raise InputError("--weights: expected none with --cameras, which takes the shipped weights")
        print(
            cameras_table(evaluate_cameras(list_scenes(options.scenes), options.seed)).round(1).to_string(index=False)
        )
        return
    report = partial(print, flush=True)
    results = evaluate_homes(list_scenes(options.scenes), options.views, options.seed, report, options.weights)
    print(f"\n{len(results.homes)} homes, {options.views} views each; IoU in percent [90 % interval over homes]")
    print(results_table(results.counts).to_string())
    print(
        "\nclass IoU per home, and estimated depth: mean relative error in percent, and on the floor, over true depth"
    )
    print(homes_table(results.homes).to_string())
    print("\nthe homes that fail most")
    print("\n".join(results.worst()))
    if options.json:
        write_json(options.json, {"views": options.views, "seed": options.seed, **results.to_json()})
    if results.broken:
        sys.exit("\n".join(f"skipped {name}: {message}" for name, message in results.broken.items()))
