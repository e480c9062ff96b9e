"""IoU of the shipped networks with photographs of many cameras: heights, pitches, and fields of view.

The same poses in test homes are photographed by each camera. A photograph that is levelled covers only a part of the
network's view; cells are evaluated in the field of view of that part. For another height, the alternative to stretching
the photograph is to scale the scene about the camera: a camera at height h sees what a camera at .88 m sees in a scene
that is .88 / h times as large. The photograph then stays as it is, and the map is scaled instead. Both are evaluated on
the cells that the scaled map has.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from zerobev.common.progress import progress
from zerobev.config import LABELS, AgentConfig, CameraConfig
from zerobev.evaluation.metrics import Counts, bootstrap_interval, class_iou, count, pixel_iou
from zerobev.geometry.cameras import Camera, Pose
from zerobev.geometry.projection import fov_mask
from zerobev.inference.masks import Masks
from zerobev.inference.pinhole import PinholeView
from zerobev.inference.pretrained import GEOMETRIC
from zerobev.inference.projector import LEVEL, Projector, load
from zerobev.inference.shipped_weights import ROWS
from zerobev.rendering.gbuffer import RayCaster
from zerobev.rendering.photograph import Photographer
from zerobev.rendering.poses import navigable_floor
from zerobev.scenes.readers import read_scene

#: Name of a setting of `Camera` -> its values; the others are those of the networks' camera.
CAMERAS: dict[str, tuple[float, ...]] = {
    "height_m": (0.3, 0.5, 0.88, 1.2, 1.5, 1.8),
    "pitch_deg": (-30.0, -20.0, -10.0, 0.0, 8.0, 15.0),
    "hfov_deg": (50.0, 65.0, 79.0, 95.0, 110.0),
}
ORACLE = "a.1"  #: P^-1 with true depth
SCALED = ".scaled"  #: suffix of rows with a scaled scene instead of a stretched photograph
COMMON = ".common"  #: suffix of rows with a stretched photograph, on the cells of the scaled ones
POSES = 8  #: per home
_PHOTOGRAPH_PX = 192
_TRIES = 200


@dataclass(frozen=True)
class CameraPose(Pose):
    """A pose of a tilted camera, whose images are not stretched."""

    camera: Camera = LEVEL

    @property
    def world_R_camera(self) -> np.ndarray:
        """(3, 3) float64, as in `Pose`."""
        return super().world_R_camera @ self.camera.level_R_camera

    def stretch(self, camera: CameraConfig) -> float:
        """1: images have square pixels."""
        return 1.0


@dataclass(frozen=True, eq=False)
class CameraView:
    """A photograph with its masks and depth, and the true map. P pixels and M cells per side, K classes."""

    camera: Camera
    rgb: np.ndarray  #: (P, P, 3) uint8
    depth: np.ndarray  #: (P, P) float32, planar depth, metres
    masks: np.ndarray  #: (K, P, P) bool
    target: np.ndarray  #: (K, M, M) bool
    fov: np.ndarray  #: (M, M) bool: field of view of the part of the network's view that the photograph covers


class CameraStudio:
    """Photographs one scene with any camera from the same poses.

    network: the networks' camera
    """

    def __init__(self, folder: Path, network: CameraConfig, rng: np.random.Generator) -> None:
        self._scene, self._network = read_scene(folder), network
        self._photographers: dict[CameraConfig, Photographer] = {}
        self._caster = RayCaster(self._scene)
        floor = navigable_floor(self._scene, AgentConfig(), rng)
        #: poses at which the network's camera sees enough of the map, see `AgentConfig.min_view`
        self.poses = [pose for pose in (floor.draw(rng) for _ in range(_TRIES)) if self._sees_enough(pose)][:POSES]

    def take(self, pose: Pose, camera: Camera) -> CameraView:
        """The view of a camera at the place and heading of `pose`."""
        place = (pose.x, pose.y, pose.floor_z, pose.yaw, camera.height_m)
        lens = replace(self._network, fpv_px=_PHOTOGRAPH_PX, hfov_deg=camera.hfov_deg or self._network.hfov_deg)
        tilted, level = CameraPose(*place, camera=camera), Pose(*place)
        if lens not in self._photographers:
            self._photographers[lens] = Photographer(self._scene, lens)
        label = self._scene.instance_label
        fpv, bev = self._caster.fpv(tilted, lens), self._caster.bev(level, self._network)
        classes = np.arange(len(LABELS))[:, None, None]
        covered = PinholeView((_PHOTOGRAPH_PX, _PHOTOGRAPH_PX), camera, self._network).covered
        seen = np.where(covered, self._caster.fpv(level, self._network).distance, np.float32(0))
        return CameraView(
            camera,
            self._photographers[lens].take(tilted),
            fpv.distance,
            label[fpv.instance] == classes,
            label[bev.instance] == classes,
            fov_mask(seen, self._network.at_height(camera.height_m)),
        )

    def _sees_enough(self, pose: Pose) -> bool:
        depth = self._caster.fpv(pose, self._network).distance
        return bool(fov_mask(depth, self._network).mean() >= AgentConfig().min_view)


@dataclass(frozen=True)
class ScaledCells:
    """The map of a scene that is scaled about the camera, as a map of the scene.

    The cell at (x, y) has the value of the scaled map at (x, y) times `factor`, if that is on the map.
    """

    network: CameraConfig
    factor: float  #: height of the network's camera over that of the photograph's

    @cached_property
    def _source(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column in the scaled map of each row and column; out of range if it is not on that map."""
        side = self.network.bev_px
        from_camera = (np.arange(side) + 0.5) * self.factor
        column = np.floor((np.arange(side) + 0.5 - side / 2) * self.factor + side / 2).astype(int)
        return side - 1 - np.floor(from_camera).astype(int)[::-1], column

    @property
    def on_map(self) -> np.ndarray:
        """(M, M) bool: cells that are on the scaled map."""
        row, column = ((of >= 0) & (of < self.network.bev_px) for of in self._source)
        return row[:, None] & column

    def resampled(self, maps: np.ndarray) -> np.ndarray:
        """Scaled maps (K, M, M) bool -> maps of the scene (K, M, M) bool, empty where they are unknown."""
        row, column = (np.clip(of, 0, self.network.bev_px - 1) for of in self._source)
        return maps[:, row[:, None], column] & self.on_map


def predictions(
    view: CameraView, projectors: Mapping[str, Projector], network: CameraConfig
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Row, maps (K, M, M) bool and evaluated cells (M, M) bool of each method; projectors by row."""
    masks, camera = Masks(view.masks, channels="first"), view.camera
    is_other_height = camera.height_m != network.height_m
    scaled = ScaledCells(network, network.height_m / camera.height_m)
    yield ORACLE, projectors[GEOMETRIC].project(view.rgb, masks, camera, view.depth).maps, view.fov
    for row, projector in projectors.items():
        maps = projector.project(view.rgb, masks, camera).maps
        yield row, maps, view.fov
        if is_other_height and row in ROWS:
            of_scaled = projector.project(view.rgb, masks, replace(camera, height_m=network.height_m)).maps
            yield row + COMMON, maps, view.fov & scaled.on_map
            yield row + SCALED, scaled.resampled(of_scaled), view.fov & scaled.on_map


#: Name and value of the setting that differs -> row -> counts.
CameraCounts = dict[tuple[str, float], dict[str, Counts]]


def evaluate_cameras(folders: Iterable[Path], seed: int = 0) -> CameraCounts:
    """Counts of P^-1 with true (a.1) and estimated depth (a.2) and of the shipped networks, for each of `CAMERAS`.

    folders: scenes in HM3DSem layout, with `POSES` poses each
    Raises `InputError` for a scene that cannot be read.
    """
    folders = list(folders)
    projectors = {row: load(row) for row in (GEOMETRIC, *ROWS)}
    network = projectors[GEOMETRIC].camera
    total: CameraCounts = {(name, value): {} for name, values in CAMERAS.items() for value in values}
    for number, folder in enumerate(progress(folders, "homes", "home", len(folders))):
        studio = CameraStudio(folder, network, np.random.default_rng([seed, number]))
        for pose in studio.poses:
            for (name, value), counts in total.items():
                view = studio.take(pose, replace(LEVEL, **{name: value}))
                for row, maps, cells in predictions(view, projectors, network):
                    predicted, target, inside = (torch.from_numpy(of)[None] for of in (maps, view.target, cells[None]))
                    found = count(predicted, target, inside, torch.tensor([number]), len(folders))
                    counts[row] = counts.get(row, Counts.empty(len(folders), len(LABELS))) + found
    return total


def cameras_table(counts: CameraCounts) -> pd.DataFrame:
    """Class and pixel IoU in percent with 90 % intervals over homes: one line per camera and row."""
    lines = []
    for (name, value), rows in counts.items():
        for row, one in rows.items():
            cells = []
            for statistic in (class_iou, pixel_iou):
                interval = bootstrap_interval([one], statistic, np.random.default_rng(0))
                cells += [100 * float(one.value(statistic)), *(100 * float(end) for end in interval)]
            lines.append((name, value, row, *cells))
    ends = [f"{kind} {end}".strip() for kind in ("class", "pixel") for end in ("", "low", "high")]
    return pd.DataFrame(lines, columns=["setting", "value", "row", *ends])
