"""The map of a whole home after a walk through it, against its true map.

A camera is carried through all rooms (`rendering.walks`). The maps of its views are fused with `mapping.HomeMap`, at
their true poses or at those of an odometry that drifts. The true map is cast from above over the whole home, by the
rules of the views' true maps.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from zerobev.common.progress import progress
from zerobev.config import LABELS, AgentConfig, CameraConfig
from zerobev.data.samples import as_float
from zerobev.data.sensor_depth import fused, sensor_depth
from zerobev.evaluation.home_scores import HomeScores
from zerobev.evaluation.real_homes import METHODS, ORACLE
from zerobev.geometry.cameras import Pose
from zerobev.geometry.projection import fov_mask, inverse_project
from zerobev.inference.bev_map import BevMap
from zerobev.inference.pretrained import GEOMETRIC
from zerobev.inference.projector import load
from zerobev.inference.shipped_weights import ROWS
from zerobev.mapping.grid import Grid
from zerobev.mapping.home_map import HomeMap
from zerobev.mapping.pose import Pose2D
from zerobev.models import BevModel
from zerobev.rendering.gbuffer import RayCaster
from zerobev.rendering.photograph import Photographer
from zerobev.rendering.poses import navigable_floor
from zerobev.rendering.walks import walk
from zerobev.scenes.readers import read_scene
from zerobev.scenes.scene import Scene

#: Row -> title.
WALK_ROWS = {
    ORACLE: METHODS[ORACLE],
    GEOMETRIC: METHODS[GEOMETRIC],
    f"{GEOMETRIC}.sensor": "P^-1 with a depth camera",
    **{row: METHODS[row] for row in (*ROWS, "d.sensor")},
}
#: Numbers of views after which maps are compared.
STAGES = (1, 2, 5, 10, 20, 40, 60, 80, 100)
#: Cells that are compared: all in a field of view so far; those of them without a pixel of any view, which P^-1 cannot
#: know; all in the box around the home.
CELLS = ("viewed", "unseen", "home")
#: Error of the odometry per step, relative to its length; error of its heading, degrees per metre.
DRIFT, DRIFT_DEG = 0.02, 1.0

_CHUNK = 10  # views per pass through a network


class Case(NamedTuple):
    """What a score is of."""

    row: str  #: of `WALK_ROWS`
    poses: str  #: "exact" or "drifting"
    views: int
    cells: str  #: of `CELLS`

    @classmethod
    def parse(cls, text: str) -> Self:
        """The inverse of its values separated by spaces."""
        row, poses, views, cells = text.split()
        return cls(row, poses, int(views), cells)


@dataclass(frozen=True, eq=False)
class Walk:
    """N views of a walk, S pixels per side, and the true map of the home."""

    poses: list[Pose2D]
    #: `rgb` (N, 3, S, S) uint8; `zero` (N, 8, S, S) bool: the classes; `depth` (N, 1, S, S) float32, metres, and
    #: `sensor`, the same from a depth camera, 0 for no value
    views: dict[str, Tensor]
    camera: CameraConfig
    grid: Grid  #: of the home with a margin
    box: np.ndarray  #: (R, C) bool: the home without the margin
    truth: np.ndarray  #: (8, R, C) bool

    def fused(self, maps: Iterable[BevMap], poses: Iterable[Pose2D]) -> Iterator[HomeMap]:
        """The map of the home after each view; all are the same object."""
        home = HomeMap(self.grid.extent, self.grid.cell_m)
        for bev, pose in zip(maps, poses):
            home.add(bev, pose)
            yield home


def record_walk(scene: Scene, camera: CameraConfig, views: int, rng: np.random.Generator) -> Walk:
    """Render a walk through a scene. Raises `InputError` for a scene without a floor to walk on."""
    poses = walk(scene, navigable_floor(scene, AgentConfig(), rng), views)
    caster, photographer = RayCaster(scene), Photographer(scene, camera)
    classes = np.arange(len(LABELS), dtype=np.int8)[:, None, None]
    images: dict[str, list[np.ndarray]] = {name: [] for name in ("rgb", "zero", "depth", "sensor")}
    for pose in poses:
        seen, rgb = caster.fpv(pose, camera), photographer.take(pose)
        images["rgb"].append(np.moveaxis(rgb, -1, 0))
        images["zero"].append(scene.instance_label[seen.instance] == classes)
        images["depth"].append(seen.distance[None])
        images["sensor"].append(sensor_depth(seen.distance, rgb, rng)[None])
    corner = scene.vertices[scene.faces][..., :2].astype(np.float64)
    low, high = corner.min(axis=(0, 1)), corner.max(axis=(0, 1))
    margin = camera.bev_extent_m  # drifting poses may leave the home
    grid = Grid.of((*(low - margin), *(high + margin)), camera.cell_m)
    x, y = grid.centres
    return Walk(
        poses=[Pose2D(pose.x, pose.y, pose.yaw) for pose in poses],
        views={name: torch.from_numpy(np.stack(each)) for name, each in images.items()},
        camera=camera,
        grid=grid,
        box=((y > low[1]) & (y < high[1]))[:, None] & ((x > low[0]) & (x < high[0])),
        truth=scene.instance_label[instances_from_above(caster, camera, grid, poses[0].floor_z)] == classes,
    )


def instances_from_above(caster: RayCaster, camera: CameraConfig, grid: Grid, floor_z: float) -> np.ndarray:
    """(R, C) uint16: instance ids on the true map of a whole grid, by the rules of `RayCaster.bev`."""
    rows, columns = grid.shape
    cells = max(rows, columns)
    side = cells * grid.cell_m
    # a square map from the grid's upper left corner on: its camera faces +y, from the middle of the lower edge
    pose = Pose(grid.x0 + side / 2, grid.extent[3] - side, floor_z, np.pi / 2)
    return caster.bev(pose, replace(camera, bev_px=cells, bev_extent_m=side)).instance[:rows, :columns]


def drifting(poses: Iterable[Pose2D], rng: np.random.Generator) -> list[Pose2D]:
    """Poses of an odometry that starts at the first pose and adds up steps with errors.

    A step of d metres has independent normal errors: `DRIFT` * d of both coordinates, `DRIFT_DEG` * d of the turn.
    """
    poses = list(poses)
    found = poses[:1]
    for before, after in pairwise(poses):
        step = complex(after.x - before.x, after.y - before.y)
        measured = step + complex(*rng.normal(0, DRIFT * abs(step), 2))
        moved = measured * np.exp(1j * (found[-1].yaw - before.yaw))
        turn = after.yaw - before.yaw + rng.normal(0, np.radians(DRIFT_DEG) * abs(step))
        yaw = float(np.angle(np.exp(1j * (found[-1].yaw + turn))))
        found.append(Pose2D(found[-1].x + moved.real, found[-1].y + moved.imag, yaw))
    return found


def walk_maps(walked: Walk, rows: Collection[str] = tuple(WALK_ROWS)) -> dict[str, list[BevMap]]:
    """The maps of each view per row of `WALK_ROWS`, with the eight classes as layers.

    Fields of view are those of the row's depth. Maps of P^-1 contain cells with a pixel alone, so that the others stay
    unknown.
    """
    estimator = load(GEOMETRIC).estimator
    with torch.inference_mode():
        estimated = torch.cat([estimator(as_float(part)["rgb"]) for part in _chunks(walked.views)])
    pairs = zip(walked.views["sensor"].numpy()[:, 0], estimated.numpy()[:, 0])
    measured = torch.from_numpy(np.stack([fused(*pair) for pair in pairs]))
    found = {}
    for row in rows:
        name = row.removesuffix(".sensor")
        depth = walked.views["depth"] if row == ORACLE else measured if name != row else estimated
        if name in (ORACLE, GEOMETRIC):
            zero = walked.views["zero"].float()
            values = inverse_project(zero, depth[:, :1], walked.camera)
            fov = inverse_project(torch.ones_like(depth[:, :1]), depth[:, :1], walked.camera)[:, 0].numpy() > 0
        else:
            network = load(name).network
            assert network is not None  # as of all shipped rows
            values = _predicted(network, walked.views | {"depth": depth})
            fov = np.stack([fov_mask(one[0], walked.camera) for one in depth.numpy()])
        found[row] = [BevMap(one, LABELS, one, mask, walked.camera) for one, mask in zip(values.numpy(), fov)]
    return found


@torch.inference_mode()
def _predicted(network: BevModel, views: Mapping[str, Tensor]) -> Tensor:
    """(N, 8, M, M) probabilities; 0 for classes without a pixel, as in `Projector.project`."""
    side = network.camera.bev_px
    values = torch.zeros(*views["zero"].shape[:2], side, side)
    for number, part in enumerate(map(as_float, _chunks(views))):
        filled = part["zero"].flatten(2).any(dim=2)
        used = filled.any(dim=0)  # classes that no view of the chunk contains need no pass
        logits = network(part["rgb"], part["zero"][:, used], part["depth"]).zero_logits
        values[number * _CHUNK :][: len(filled), used] = logits.sigmoid() * filled[:, used, None, None]
    return values


def _chunks(views: Mapping[str, Tensor]) -> Iterator[dict[str, Tensor]]:
    for start in range(0, len(views["rgb"]), _CHUNK):
        yield {name: images[start : start + _CHUNK] for name, images in views.items()}


def score_walk(walked: Walk, stages: Collection[int], rng: np.random.Generator) -> dict[Case, HomeScores]:
    """The scores of one home in all cases; `rng` draws the drift."""
    maps = walk_maps(walked)
    true_fov = [fov_mask(depth[0], walked.camera) for depth in walked.views["depth"].numpy()]
    in_view = [replace(bev, fov=fov) for bev, fov in zip(maps[ORACLE], true_fov)]
    viewed, seen = ([home.viewed for home in walked.fused(each, walked.poses)] for each in (in_view, maps[ORACLE]))
    found = {}
    for track, poses in {"exact": walked.poses, "drifting": drifting(walked.poses, rng)}.items():
        for row, each in maps.items():
            for number, home in enumerate(walked.fused(each, poses)):
                if number + 1 not in stages:
                    continue
                regions = viewed[number], viewed[number] & ~seen[number], walked.box
                predicted = np.stack(list(home.maps.values()))
                for cells, region in zip(CELLS, regions):
                    found[Case(row, track, number + 1, cells)] = HomeScores.of(predicted, walked.truth, region)
    return found


def evaluate_walks(folders: Iterable[Path], stages: Collection[int] = STAGES, seed: int = 0) -> dict[Case, HomeScores]:
    """The scores of walks with as many views as the last stage, over all homes.

    folders: scenes in HM3DSem layout
    Raises `InputError` for a scene that cannot be read or has no floor to walk on.
    """
    folders = list(folders)
    camera = load(GEOMETRIC).camera
    homes = []
    for number, folder in enumerate(progress(folders, "walks", "home", len(folders))):
        rng = np.random.default_rng([seed, number])
        homes.append(score_walk(record_walk(read_scene(folder), camera, max(stages), rng), stages, rng))
    return {case: HomeScores.joined([home[case] for home in homes]) for case in homes[0]}


def walks_table(scores: Mapping[Case, HomeScores]) -> pd.DataFrame:
    """One line per case, by number of views: its fields, and `miou` and `bf1`, means over classes in percent."""
    lines = [(*case, *(100 * float(np.nanmean(m)) for m in (s.iou(), s.boundary_f1()))) for case, s in scores.items()]
    return pd.DataFrame(lines, columns=[*Case._fields, "miou", "bf1"]).sort_values("views", kind="stable")
