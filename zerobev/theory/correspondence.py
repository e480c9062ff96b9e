"""gamma, the true correspondence of ray positions and image rows (paper, supplement, "Proof of Theorem 3.1").

A column of the image and its ray share a vertical plane. Position p of the ray is map row p, top row first: a slab of
planar depth. A pixel therefore falls into the position of its depth, wherever on the map's width its column lies.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import fpv_rays
from zerobev.geometry.projection import map_points
from zerobev.models.band_transformer import sinusoids
from zerobev.models.fpv_to_bev import columns


def positions(depth: Tensor, camera: CameraConfig) -> Tensor:
    """The ray position that each pixel falls into, P = `bev_px` where it falls into none.

    depth: (..., H, W) planar depth, metres, 0 for nothing seen. Points above `max_height_m` and beyond the map fall
    into none. Returns (..., H, W) int64 in [0, P].
    """
    position = camera.bev_px - 1 - torch.floor(depth / camera.cell_m).long()
    low = map_points(depth, camera)[..., 2] < camera.max_height_m
    return torch.where((depth > 0) & low & (position >= 0), position, camera.bev_px)


def correspondence(depth: Tensor, camera: CameraConfig) -> Tensor:
    """The indicator of gamma: which image rows fall into which position, column by column.

    depth: (B, H, W) metres. Returns (B * W, P, H) bool, image column fastest.
    """
    position = positions(depth, camera).transpose(-2, -1).flatten(0, 1)  # B*W H
    return position[:, None] == torch.arange(camera.bev_px)[:, None]


def uniform_attention(gamma: Tensor) -> Tensor:
    """The attention that average-pools: the indicator (..., P, R) over the number of its pixels, float32.

    A position that no pixel falls into attends to nothing: its weights are 0, which no softmax can give.
    """
    return gamma / gamma.sum(-1, keepdim=True).clamp(min=1)


def uncertain_correspondence(depth: Tensor, sigma_m: float, camera: CameraConfig) -> Tensor:
    """The probability that a pixel falls into a position, if its depth is known up to a normal error.

    depth: (B, H, W) metres; sigma_m: standard deviation, > 0. Returns (B * W, P, H) float64.
    """
    upward = -torch.as_tensor(fpv_rays(camera))[..., 1]  # metres that a ray rises for each metre of depth
    rise = camera.max_height_m - camera.height_m
    highest = torch.where(upward > 0, rise / upward.clamp(min=1e-9), torch.inf)  # H W: deeper points are too high
    edges = torch.arange(camera.bev_px, -1, -1, dtype=torch.float64)[:, None, None, None] * camera.cell_m
    below = torch.special.ndtr((edges.minimum(highest) - depth.double()) / sigma_m)  # P+1 B H W
    return (below[:-1] - below[1:]).permute(1, 3, 0, 2).flatten(0, 1)


def pool(values: Tensor, depth: Tensor, camera: CameraConfig, reduce: str) -> Tensor:
    """Pool images to the rays, pixel by pixel and without any attention: what the theorem is checked against.

    values: (B, K, H, W); depth: (B, H, W) metres; reduce: "mean", "amax" or "sum"
    Returns (B * W, P, K), 0 where no pixel falls.
    """
    batch, modalities, _, width = values.shape
    place = positions(depth, camera)[:, None].expand_as(values)
    pooled = values.new_zeros(batch, modalities, camera.bev_px + 1, width)
    pooled = pooled.scatter_reduce(2, place, values, reduce, include_self=False)[:, :, :-1]
    return columns(pooled)


def point_features(depth: Tensor, camera: CameraConfig, width: int = 64) -> Tensor:
    """What a backbone would have to read off a photograph: planar depth and height of each pixel's point, encoded.

    Each is encoded with `width` sines and cosines, the finest with one period a map cell. depth: (B, H, W) metres.
    Returns image columns (B * W, H, 2 * width) float32.
    """
    cells = map_points(depth, camera)[..., 1:] / camera.cell_m
    encoded = sinusoids(2 * torch.pi * cells.flatten(), width)
    return encoded.unflatten(0, cells.shape).flatten(-2).transpose(1, 2).flatten(0, 1)


class Columns(NamedTuple):
    """N image columns of R rows, and where they fall on rays of P positions."""

    features: Tensor  #: (N, R, F) float32: what the keys see
    gamma: Tensor  #: (N, P, R) bool
