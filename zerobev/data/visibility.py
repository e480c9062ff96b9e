"""Which cells of a view's map its image shows: the network copies some of them, and has to infer the others.

At a low resolution, rows of pixels on a distant floor are farther apart than cells of the map. A cell without a pixel
is therefore not always hidden: a finer image from the same pose may show it.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from zerobev.config import CameraConfig
from zerobev.data.shards import Shard
from zerobev.geometry.cameras import Pose
from zerobev.geometry.projection import inverse_project_mask
from zerobev.rendering.gbuffer import RayCaster
from zerobev.scenes.readers import read_scene
from zerobev.scenes.scene import Scene

#: "seen": at least one pixel of the image is in the cell; "between": only pixels of a finer image are, between the rows
#: and columns of the image; "hidden": neither.
Visibility = Literal["seen", "between", "hidden"]
VISIBILITY: tuple[Visibility, ...] = get_args(Visibility)

_MARGIN = 1.2  # rows of the finer image are closer than cells by this factor, on the floor at the far edge of the map


def visibility(scene: Scene, poses: Iterable[Pose], camera: CameraConfig) -> np.ndarray:
    """(V, M, M) uint8: index in `VISIBILITY` of each cell of the map at each pose, with true depth."""
    caster, found = RayCaster(scene), []
    for pose in poses:
        limits = camera if pose.height_m is None else camera.at_height(pose.height_m)
        shown = [_shown(caster, pose, replace(limits, fpv_px=side)) for side in (camera.fpv_px, _fine_px(camera))]
        found.append(np.where(shown[0], 0, np.where(shown[1], 1, 2)).astype(np.uint8))
    return np.stack(found)


def shard_visibility(scene_folder: Path, shard: Shard, views: int, camera: CameraConfig) -> np.ndarray:
    """`visibility` at the poses of a shard's first views. Raises `InputError` for a scene that cannot be read."""
    poses = [Pose(*shard.view(number).pose) for number in range(min(views, len(shard)))]
    return visibility(read_scene(scene_folder), poses, camera)


def _fine_px(camera: CameraConfig) -> int:
    # rows of the floor at distance z are z^2 / (focal length * height) apart
    focal_px = _MARGIN * camera.bev_extent_m**2 / (camera.height_m * camera.cell_m)
    return max(camera.fpv_px, math.ceil(camera.fpv_px * focal_px / camera.focal_px))


def _shown(caster: RayCaster, pose: Pose, camera: CameraConfig) -> np.ndarray:
    """(M, M) bool: cells with a pixel of an image of this size."""
    depth = caster.fpv(pose, camera).distance
    return inverse_project_mask(np.ones(depth.shape, bool), depth, camera)
