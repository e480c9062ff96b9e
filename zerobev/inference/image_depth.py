"""Depth of photographs in the network's view: estimated, and replaced by a sensor's where it has values."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.data.sensor_depth import fused, with_measured
from zerobev.geometry.cameras import Camera
from zerobev.inference.measured_depth import MAX_MEDIAN_M
from zerobev.inference.pinhole import PinholeView
from zerobev.inference.placement import placement
from zerobev.models.decoder import resize
from zerobev.models.depth import DepthEstimator, estimate


def image_depths(
    estimator: DepthEstimator,
    photographs: Sequence[np.ndarray],
    views: Sequence[PinholeView],
    measured: Sequence[np.ndarray | None],
    source: Camera,
    network: CameraConfig,
) -> np.ndarray:
    """Planar depth of B photographs (H, W, 3) in the network's camera, (B, 2, S, S) float32.

    Returns metres, 0 outside of the photographs; and 1 where they are a sensor's.
    views: of the photographs, from `source` to `network`
    measured: (H, W) float32 per photograph, see `checked_depth`; None: all depth is estimated
    The estimator is called once for all photographs whose input has the same size, and not at all for complete depth.
    Raises `InputError` if its output cannot be metres.
    """
    known = [None if depth is None else view.depth(depth) for depth, view in zip(measured, views)]
    missing = [n for n, depth in enumerate(known) if depth is None or not (depth > 0)[views[n].covered].all()]
    inputs = [_estimator_input(estimator, photographs[n], views[n], source, network) for n in missing]
    estimated = dict(zip(missing, _estimates(estimator, inputs, network.fpv_px, source.height_m)))
    depths = []
    for number, (depth, view) in enumerate(zip(known, views)):
        if depth is None:
            depths.append(with_measured(np.zeros_like(estimated[number]), estimated[number]) * view.covered)
        else:
            whole = fused(depth, estimated[number]) if number in estimated else with_measured(depth, depth)
            depths.append(whole * view.covered)
    return np.stack(depths)


def channels_first(photographs: Sequence[np.ndarray]) -> Tensor:
    """B images (S, S, 3) -> (B, 3, S, S)."""
    return torch.from_numpy(np.stack([np.moveaxis(photograph, -1, 0) for photograph in photographs]))


def _estimator_input(
    estimator: DepthEstimator, photograph: np.ndarray, view: PinholeView, source: Camera, network: CameraConfig
) -> np.ndarray:
    """The photograph at the estimator's `side_px`, if it has one, else at the network's size."""
    # at most the resolution of the photograph, which the estimator enlarges smoothly
    side = min(getattr(estimator, "side_px", network.fpv_px), view.resolution_px)
    if side > network.fpv_px:
        view = PinholeView(photograph.shape[:2], source, replace(network, fpv_px=side))
    return view.photograph(photograph)


def _estimates(estimator: DepthEstimator, inputs: Sequence[np.ndarray], side: int, height_m: float) -> list[np.ndarray]:
    """(side, side) float32 metres per input."""
    device, dtype = placement(estimator)
    depths: list[np.ndarray] = []
    for shape, group in groupby(inputs, lambda image: image.shape[:2]):
        batch = channels_first(list(group))
        depth = estimate(estimator, batch.to(device, dtype), torch.full((len(batch),), height_m, device=device))
        depth = depth.float().cpu()
        _check_estimate(depth, (len(batch), 1, *shape))
        depths.extend(resize(depth, (side, side))[:, 0].numpy())
    return depths


def _check_estimate(depth: Tensor, expected: tuple[int, ...]) -> None:
    """Raise `InputError` if the output of an estimator cannot be metres."""
    if tuple(depth.shape) != expected:
        raise InputError(f"estimator: expected depth {expected}, found {tuple(depth.shape)}")
    if not (torch.isfinite(depth).all() and (depth >= 0).all()):
        raise InputError("estimator: expected finite depth from 0 up, found NaN, infinity or less")
    if (median := float(depth.flatten(1).median(dim=1).values.max())) > MAX_MEDIAN_M:
        raise InputError(f"estimator: expected depth in metres, found a median of {median:g}: millimetres?")
