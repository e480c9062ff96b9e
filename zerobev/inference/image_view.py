"""A photograph as a network sees it: everything that depends on the photograph alone, for any number of modalities."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import torch
from torch import Tensor

from zerobev.common.errors import InputError
from zerobev.geometry.cameras import Camera
from zerobev.geometry.projection import cells_of_pixels, fov_mask, pooled_in_cells
from zerobev.inference.bev_map import BevArrows, BevMap
from zerobev.inference.image_depth import channels_first, image_depths
from zerobev.inference.modality import BinaryImages, Modality, Names, Result
from zerobev.inference.pinhole import PinholeView
from zerobev.inference.plain_arrays import kind_of
from zerobev.models.base import Features

if TYPE_CHECKING:
    from zerobev.inference.projector import Projector

#: Maximum number of binary images per photograph and call; the features of all of them are in memory at the same time.
MAX_IMAGES = 2048


@dataclass(frozen=True, eq=False)
class ImageView:
    """A photograph, seen by a projector; made by `Projector.view`.

    It is never changed, so several threads may project with one view at the same time.
    """

    projector: "Projector"
    camera: Camera  #: of the photograph
    shape: tuple[int, int]  #: (H, W) of the photograph
    pinhole: PinholeView  #: from the photograph to the network's camera
    depth: np.ndarray  #: (S, S) float32, planar depth in the network's camera, metres; 0 outside the photograph
    fov: np.ndarray  #: (M, M) bool, as in `BevMap`
    is_measured: bool  #: some of the depth is a sensor's
    features: Features  #: of the network, for one image; of P^-1 the cell of each pixel
    empty: Tensor | None  #: (1, 1, M, M) logits of an image without white; None: P^-1

    @overload
    def project(self, modality: Modality[Result], names: Names = ...) -> Result: ...

    @overload
    def project(self, modality: Any, names: Names = ...) -> BevMap: ...

    def project(self, modality: Any, names: Names = None) -> BevMap | BevArrows:
        """Project a modality of the photograph; arguments, result and errors as of `Projector.project`.

        Only `Flow` with a second photograph computes that one's view again in each call.
        """
        kind = kind_for(modality, self.shape, names)
        layers = layers_of(kind, self.shape, self.is_measured)
        views = [
            self if layer.photograph is None else self.projector.view(layer.photograph, self.camera) for layer in layers
        ]
        # a call of the network per layer: a batch of layers would hold the features of a photograph twice
        return kind.result(tuple(bev for one in zip(views, layers) for bev in project_layers([one])))


def kind_for(modality: Any, shape: tuple[int, int], names: Names) -> Modality[Any]:
    """The modality with its names, or the kind of a plain array. Raises `InputError`, see `Projector.project`."""
    if isinstance(names, Camera):
        raise InputError("names: expected names, found a camera: a photograph of another camera needs its own view")
    if not isinstance(modality, Modality):
        return kind_of(modality, shape, names)
    if names is None:
        return modality
    if getattr(modality, "names", ()) is not None:
        raise InputError(f"names: expected none for {type(modality).__name__}, which contains its names")
    return replace(modality, names=names)  # type: ignore[type-var]  # a dataclass with a field of this name


def layers_of(kind: Modality[Any], shape: tuple[int, int], is_measured: bool) -> tuple[BinaryImages, ...]:
    """The sets of binary images of a modality. Raises `InputError` for too many, and for depth of one of two images."""
    layers = kind.layers(shape)
    if is_measured and any(layer.photograph is not None for layer in layers):
        raise InputError(f"depth: expected none for {type(kind).__name__}, found depth of one of two photographs")
    if (count := max(len(layer.labels) * layer.levels for layer in layers)) > MAX_IMAGES:
        raise InputError(f"modality: expected {MAX_IMAGES} binary images at most, found {count}")
    return layers


@torch.inference_mode()
def image_views(
    projector: "Projector", photographs: Sequence[np.ndarray], camera: Camera, measured: Sequence[np.ndarray | None]
) -> list[ImageView]:
    """The views of photographs (H, W, 3) in [0, 1], in one call of the network; for the other arguments see `view`."""
    network, target = projector.network, projector.camera
    views = [PinholeView(photograph.shape[:2], camera, target) for photograph in photographs]
    depths = image_depths(projector.estimator, photographs, views, measured, camera, target)
    depth = torch.from_numpy(depths).to(projector.device)
    heights = torch.full((len(views),), camera.height_m, device=projector.device)
    empty: list[Tensor | None] = [None] * len(views)
    if network is None:
        features: Features = (cells_of_pixels(depth[:, 0], target, heights),)
    else:
        seen = channels_first([view.photograph(photograph) for view, photograph in zip(views, photographs)])
        features = network.encode(seen.to(projector.device, projector.dtype), depth, heights)
        black = torch.zeros(len(views), 1, *seen.shape[2:], device=projector.device, dtype=projector.dtype)
        empty = list(network.decode(features, black).zero_logits.float().split(1))
    return [
        ImageView(
            projector=projector,
            camera=camera,
            shape=photographs[n].shape[:2],
            pinhole=view,
            depth=depths[n, 0],
            fov=fov_mask(depths[n, 0], target.at_height(camera.height_m)),
            is_measured=measured[n] is not None,
            features=tuple(tensor[n : n + 1] for tensor in features),
            empty=empty[n],
        )
        for n, view in enumerate(views)
    ]


@torch.inference_mode()
def project_layers(pairs: Sequence[tuple[ImageView, BinaryImages]]) -> list[BevMap]:
    """One map per view and set of binary images, in one call of the network; all views have the same projector.

    Empty images have empty maps. The others are stacked; where sets differ in size, empty images fill the stack.
    """
    projector = pairs[0][0].projector
    stacks = [np.stack([view.pinhole.mask(image) for image in layer.images]) for view, layer in pairs]
    filled = [stack.any(axis=(1, 2)) for stack in stacks]
    side, count = projector.camera.bev_px, max(int(one.sum()) for one in filled)
    maps = [np.zeros((2, len(stack), side, side), np.float32) for stack in stacks]  # values and evidence
    if count:
        zero = torch.zeros(len(pairs), count, *stacks[0].shape[1:])
        for images, stack, one in zip(zero, stacks, filled):
            images[: one.sum()] = torch.from_numpy(stack[one])
        found = _values_and_evidence([view for view, _ in pairs], zero)
        for target, one, projected in zip(maps, filled, found):
            target[:, one] = projected[:, : one.sum()]
    results = []
    for (view, layer), stacked in zip(pairs, maps):
        values, evidence = stacked.reshape(2, -1, layer.levels, side, side).mean(axis=2)
        results.append(BevMap(values, layer.labels, evidence, view.fov.copy(), projector.camera, layer.scores))
    return results


def _values_and_evidence(views: Sequence[ImageView], zero: Tensor) -> np.ndarray:
    """Images (B, K, S, S) of B views -> (B, 2, K, M, M) float32, `BevMap.values` and `BevMap.evidence`."""
    projector = views[0].projector
    features = views[0].features if len(views) == 1 else tuple(map(torch.cat, zip(*(view.features for view in views))))
    if projector.network is None:
        values = pooled_in_cells(zero.to(projector.device), features[0], projector.camera.bev_px)
        return torch.stack([values, values], dim=1).cpu().numpy()
    logits = projector.network.decode(features, zero.to(projector.device, projector.dtype)).zero_logits.float()
    empty = torch.cat([view.empty for view in views if view.empty is not None])
    return torch.stack([logits.sigmoid(), (logits - empty).clamp(min=0)], dim=1).cpu().numpy()
