"""Modalities on which no network was trained, against their true maps from the G-buffer (paper, Section 4).

The paper's tables measure semantic classes. Any other property of surfaces can be projected too, and the G-buffer of
the map gives its true map: single objects, their outlines, labels without meaning, and uses of surfaces for a robot.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from skimage.segmentation import find_boundaries

from zerobev.common.progress import progress
from zerobev.config import LABELS, NO_LABEL, CameraConfig, TextureConfig
from zerobev.data.samples import Pair, as_float, collate, view_sample
from zerobev.data.views import View, ViewSource
from zerobev.evaluation.evaluate import evaluate
from zerobev.evaluation.metrics import Counts, bootstrap_interval, iou_per_class
from zerobev.geometry.projection import map_points
from zerobev.inference.pretrained import GEOMETRIC
from zerobev.inference.projector import load
from zerobev.inference.shipped_weights import ROWS
from zerobev.scenes.readers import read_scene

MODALITIES = (
    "instances",  # objects of the six classes without wall and floor, one mask each
    "outlines",  # edges of objects, next to a pixel or cell of another object
    "random labels",  # surface blocks of half a metre with one of four random labels, one mask per label
    "to sit on",  # chairs, sofas, beds and toilets in one mask
    "to put things on",  # surfaces of objects 0.4 to 1.1 m above the floor
)
VIEWS = 10  # per home
_MIN_PX = 20  # of an instance's mask
_BLOCK = 50  # side of a block with one random label, texels of 1 cm
_LABELS = 4
_SURFACE_M = (0.4, 1.1)
_STRUCTURE = ("wall", "floor")
_SEATS = ("chair", "sofa", "bed", "toilet")


def unseen_masks(
    view: View, instance_label: np.ndarray, camera: CameraConfig, rng: np.random.Generator
) -> dict[str, Pair]:
    """Masks of each modality of a view: (K, H, H) and (K, M, M) bool, K per modality; `rng` draws the random labels."""
    labels = instance_label[view.fpv_instance], instance_label[view.bev_instance]
    ids, pixels = np.unique(view.fpv_instance, return_counts=True)
    structure = [LABELS.index(name) for name in _STRUCTURE]
    standing = (pixels >= _MIN_PX) & ~np.isin(instance_label[ids], [NO_LABEL, *structure])
    table = rng.integers(_LABELS, size=(61, 61, 61))  # is repeated every 61 blocks
    heights = map_points(torch.from_numpy(view.depth), camera)[..., 2].numpy(), view.bev_height
    nothing = view.fpv_texel[..., 0] < 0, view.bev_texel[..., 0] < 0
    images = []
    for instance, texel, label, height, empty in zip(
        (view.fpv_instance, view.bev_instance), (view.fpv_texel, view.bev_texel), labels, heights, nothing
    ):
        block = table[texel[..., 0] % 61, texel[..., 1] // _BLOCK % 61, texel[..., 2] // _BLOCK % 61]
        furniture = ~np.isin(label, structure) & ~empty
        images.append(
            {
                "instances": instance == ids[standing][:, None, None],
                "outlines": (find_boundaries(instance, mode="inner") & furniture)[None],
                "random labels": (block == np.arange(_LABELS)[:, None, None]) & ~empty,
                "to sit on": np.isin(label, [LABELS.index(name) for name in _SEATS])[None],
                "to put things on": (furniture & (height > _SURFACE_M[0]) & (height < _SURFACE_M[1]))[None],
            }
        )
    return {name: (images[0][name], images[1][name]) for name in MODALITIES}


def evaluate_unseen(folders: Iterable[Path], views: int = VIEWS) -> dict[str, Counts]:
    """Intersections and unions of the projection (a.2) and the shipped networks, one column per modality.

    folders: scenes in HM3DSem layout, rendered at `views` random poses each
    Raises `InputError` for a scene that cannot be read.
    """
    folders = list(folders)
    projectors = {row: load(row) for row in (GEOMETRIC, *ROWS)}
    camera = projectors[GEOMETRIC].camera
    total = {row: Counts.empty(len(folders), len(MODALITIES)) for row in projectors}
    for number, folder in enumerate(progress(folders, "homes", "home", len(folders))):
        scene = read_scene(folder)
        rng = np.random.default_rng([0, number])
        source = ViewSource(scene, camera, TextureConfig(), rng)
        for _ in range(views):
            view = source.draw()
            masks = unseen_masks(view, scene.instance_label, camera, rng)
            zero, target = (np.concatenate(images) for images in zip(*masks.values()))
            batch = as_float(collate([view_sample(view, camera, number, zero, target)]))
            ends = np.cumsum([len(images) for images, _ in masks.values()])[:-1]
            for row, projector in projectors.items():
                counts = evaluate(projector.predict, [batch], len(folders), len(zero))
                total[row] += Counts(*(_summed(cells, ends) for cells in (counts.intersection, counts.union)))
    return total


def _summed(cells: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Counts (S, K) of masks -> (S, modalities): sums over the masks of each modality, which may have none."""
    return np.stack([mine.sum(axis=1) for mine in np.split(cells, ends, axis=1)], axis=1)


def unseen_table(counts: Mapping[str, Counts]) -> pd.DataFrame:
    """IoU in percent with 90 % intervals over homes: one line per modality, one column per row."""
    cells = {}
    for row, one in counts.items():
        low, high = bootstrap_interval([one], iou_per_class, np.random.default_rng(0))
        cells[f"({row})"] = [
            f"{100 * value:.1f} [{100 * a:.1f}, {100 * b:.1f}]" for value, a, b in zip(one.iou_per_class(), low, high)
        ]
    return pd.DataFrame(cells, index=pd.Index(MODALITIES, name="modality"))
