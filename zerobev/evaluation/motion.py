"""Flow on the map against true motion.

In a generated home, an object moves between two photographs of a fixed camera, so the motion of its pixels on the map
is known. Rows are projections: P^-1 with estimated depth (a.2), and the shipped networks.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from scipy.stats import bootstrap

from zerobev.common.progress import progress
from zerobev.config import AgentConfig, CameraConfig
from zerobev.geometry.projection import map_points
from zerobev.inference.bev_map import BevArrows
from zerobev.inference.flow import MIN_PX, Flow, flow_field
from zerobev.inference.pretrained import GEOMETRIC
from zerobev.inference.projector import Projector, load
from zerobev.inference.shipped_weights import ROWS
from zerobev.rendering.gbuffer import RayCaster
from zerobev.rendering.photograph import Photographer
from zerobev.rendering.poses import navigable_floor
from zerobev.scenes.moving import movable, moved
from zerobev.scenes.readers import read_scene
from zerobev.scenes.scene import Scene

#: Side of the photographs; flow needs a higher resolution than the networks.
PHOTOGRAPH_PX = 256
_SHIFT_M = (0.2, 0.6)  # range of an object's motion
_AREA = (0.01, 0.4)  # range of an object's area, as a fraction of the photograph
_SPACING_PX = 16  # of vectors
_TRIES = 100


@dataclass(frozen=True, eq=False)
class MovingPair:
    """Two photographs between which one object moves, P x P pixels each."""

    first: np.ndarray  #: (P, P, 3) uint8
    second: np.ndarray  #: (P, P, 3) uint8
    on_object: np.ndarray  #: (P, P) bool: pixels of `first` on the object
    point_m: np.ndarray  #: (P, P, 2) float64: map position of each pixel of `first`, right and forward
    flow_px: np.ndarray  #: (P, P, 2) float64: true flow, right and down
    motion_m: np.ndarray  #: (2,) float64: true motion on the map, right and forward


def moving_pair(scene: Scene, camera: CameraConfig, rng: np.random.Generator) -> MovingPair | None:
    """A random object of a generated home, moved by a random shift along the floor in view of a random camera.

    The object stays visible from above, so that it neither enters a wall nor leaves the map. None if no such motion is
    found.
    """
    fine = replace(camera, fpv_px=PHOTOGRAPH_PX)
    ids, caster = movable(scene), RayCaster(scene)
    floor = navigable_floor(scene, AgentConfig(), rng)
    for _ in range(_TRIES if ids else 0):
        pose = floor.draw(rng)
        area = {i: np.mean(caster.fpv(pose, camera).instance == i) for i in ids}
        seen = [i for i in ids if _AREA[0] < area[i] < _AREA[1]]
        if not seen:
            continue
        chosen = int(rng.choice(seen))
        angle, length = rng.uniform(-np.pi, np.pi), rng.uniform(*_SHIFT_M)
        motion = length * np.array([np.cos(angle), np.sin(angle), 0.0])
        after = moved(scene, chosen, pose.world_R_map @ motion)
        caster_after = RayCaster(after)
        cells = [np.sum(one.bev(pose, camera).instance == chosen) for one in (caster, caster_after)]
        visible = np.mean(caster_after.fpv(pose, camera).instance == chosen)
        if cells[0] < 3 or cells[1] < 0.9 * cells[0] or visible < area[chosen] / 2:
            continue
        seen_first = caster.fpv(pose, fine)
        points = map_points(torch.from_numpy(seen_first.distance).double(), fine).numpy()
        on_object = seen_first.instance == chosen
        first, second = (Photographer(one, fine).take(pose) for one in (scene, after))
        flow = true_flow(points, motion, fine) * on_object[..., None]
        return MovingPair(first, second, on_object, points[..., :2], flow, motion[:2])
    return None


def true_flow(points: np.ndarray, motion: np.ndarray, camera: CameraConfig) -> np.ndarray:
    """Points (H, W, 3) in the map frame that move by `motion` (3,), metres -> (H, W, 2) pixels right and down."""
    pixels = []
    for x, y, z in (np.moveaxis(points, -1, 0), np.moveaxis(points + motion, -1, 0)):
        depth = np.where(y > 0, y, np.nan)
        pixels.append(camera.focal_px * np.stack([x, camera.height_m - z], axis=-1) / depth[..., None])
    return np.nan_to_num(pixels[1] - pixels[0])


def arrow_errors(projector: Projector, pair: MovingPair, field: np.ndarray) -> pd.DataFrame | None:
    """Errors of the arrows of a flow field that start on the object; None if no vector on it is a pixel long.

    field: (P, P, 2) floating point, pixels right and down
    Returns one line per vector, metres: distances of `start` and `end` to their true positions, and of `motion` to the
    true motion. An arrow without a position on the map has NaN.
    """
    on_object = np.where(pair.on_object[..., None], field, 0).astype(np.float64)
    grid = slice(_SPACING_PX // 2, None, _SPACING_PX)  # of `Flow.of`
    if np.linalg.norm(on_object[grid, grid], axis=-1).max() < MIN_PX:
        return None
    flow = Flow.of(on_object, pair.second, _SPACING_PX)
    arrows = projector.project(pair.first, flow)
    assert isinstance(arrows, BevArrows)  # as of every flow
    column, row = np.floor(flow.start_px).astype(int).T
    start = pair.point_m[row, column]
    predicted = {"start": arrows.start_m - start, "end": arrows.end_m - start - pair.motion_m}
    predicted["motion"] = arrows.end_m - arrows.start_m - pair.motion_m
    return pd.DataFrame({name: np.linalg.norm(error, axis=1) for name, error in predicted.items()})


def evaluate_motion(pairs: Iterable[MovingPair]) -> pd.DataFrame:
    """Mean errors per pair: columns pair, flow ("true" or "tvl1"), row, vectors, missing, start, end, motion.

    The row "still" is an arrow of length zero at the true position; its error is the length of the motion.
    """
    projectors = {row: load(row) for row in (GEOMETRIC, *ROWS)}
    lines = []
    for number, pair in enumerate(pairs):
        fields = {"true": pair.flow_px, "tvl1": flow_field(pair.first, pair.second)}
        length = float(np.linalg.norm(pair.motion_m))
        for flow, field in fields.items():
            lines.append((number, flow, "still", 0, 0.0, 0.0, length, length))
            for row, projector in projectors.items():
                errors = arrow_errors(projector, pair, field)
                if errors is not None:
                    missing = errors["motion"].isna().mean()
                    lines.append((number, flow, row, len(errors), missing, *errors.mean()))
    columns = ["pair", "flow", "row", "vectors", "missing", "start", "end", "motion"]
    return pd.DataFrame(lines, columns=columns)


def motion_table(errors: pd.DataFrame) -> pd.DataFrame:
    """Means over pairs, in metres, with 90 % bootstrap intervals over pairs; one line per flow and row."""
    lines = []
    for (flow, row), group in errors.groupby(["flow", "row"], sort=False):
        cells = []
        for name in ("start", "end", "motion"):
            values = group[name].dropna().to_numpy()
            if len(values) < 2 or not np.ptp(values):
                cells.append(f"{values.mean():.2f}" if len(values) else "")
                continue
            interval = bootstrap(
                (values,), np.mean, confidence_level=0.9, method="percentile", rng=np.random.default_rng(0)
            ).confidence_interval
            cells.append(f"{values.mean():.2f} [{interval.low:.2f}, {interval.high:.2f}]")
        lines.append((flow, row, len(group), int(group["vectors"].sum()), round(group["missing"].mean(), 2), *cells))
    columns = ["flow", "row", "pairs", "vectors", "missing", "start [m]", "end [m]", "motion [m]"]
    return pd.DataFrame(lines, columns=columns).set_index(["flow", "row"])


def moving_pairs(folders: list[Path], count: int, seed: int) -> Iterator[MovingPair]:
    """`count` pairs, one per home; homes without a visible motion are skipped."""
    found = 0
    rng, camera = np.random.default_rng(seed), load(GEOMETRIC).camera
    for folder in progress(folders, "homes", "home", len(folders)):
        if found == count:
            return
        pair = moving_pair(read_scene(folder), camera, rng)
        if pair is not None:
            yield pair
            found += 1
