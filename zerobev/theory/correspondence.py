"""gamma, the true correspondence of ray positions and image rows (paper, supplement, "Proof of Theorem 3.1").

An image column and its ray lie in one vertical plane. Position p of the ray is map row p, top row first: an interval of
planar depth. The depth of a pixel alone therefore gives its position.
"""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import fpv_rays
from zerobev.geometry.projection import map_points
from zerobev.models.band_transformer import sinusoids
from zerobev.models.fpv_to_bev import columns

_WIDTH = 64  # sines and cosines per number of `point_features`


def positions(depth: Tensor, camera: CameraConfig) -> Tensor:
    """Ray position of each pixel; P = `bev_px` for none.

    depth: (..., H, W) planar depth, metres, 0 if unknown. Points above `max_height_m` or beyond the map have no
    position. Returns (..., H, W) int64 in [0, P].
    """
    position = camera.bev_px - 1 - torch.floor(depth / camera.cell_m).long()
    low = map_points(depth, camera)[..., 2] < camera.max_height_m
    return torch.where((depth > 0) & low & (position >= 0), position, camera.bev_px)


def correspondence(depth: Tensor, camera: CameraConfig) -> Tensor:
    """The indicator of gamma per image column: which image rows fall into which position.

    depth: (B, H, W) metres. Returns (B * W, P, H) bool, image column fastest.
    """
    position = positions(depth, camera).transpose(-2, -1).flatten(0, 1)  # B*W H
    return position[:, None] == torch.arange(camera.bev_px)[:, None]


def uniform_attention(gamma: Tensor) -> Tensor:
    """The attention that average-pools: the indicator (..., P, R) divided by its number of pixels, float32.

    The weights of a position without pixels are 0, which a softmax cannot give.
    """
    return gamma / gamma.sum(-1, keepdim=True).clamp(min=1)


def uncertain_correspondence(depth: Tensor, sigma_m: float, camera: CameraConfig) -> Tensor:
    """Probability that a pixel falls into a position, for a depth with a normal error.

    depth: (B, H, W) metres; sigma_m: standard deviation, > 0. Returns (B * W, P, H) float64.
    """
    upward = -torch.as_tensor(fpv_rays(camera))[..., 1]  # rise of a ray per metre of depth
    rise = camera.max_height_m - camera.height_m
    highest = torch.where(upward > 0, rise / upward.clamp(min=1e-9), torch.inf)  # H W: points beyond are too high
    edges = torch.arange(camera.bev_px, -1, -1, dtype=torch.float64)[:, None, None, None] * camera.cell_m
    below = torch.special.ndtr((edges.minimum(highest) - depth.double()) / sigma_m)  # P+1 B H W
    return (below[:-1] - below[1:]).permute(1, 3, 0, 2).flatten(0, 1)


def pool(values: Tensor, depth: Tensor, camera: CameraConfig, reduce: str) -> Tensor:
    """Pool images to rays by geometry, without attention: the reference for the theorem.

    values: (B, K, H, W); depth: (B, H, W) metres; reduce: "mean", "amax" or "sum"
    Returns (B * W, P, K), 0 at positions without pixels.
    """
    batch, modalities, _, width = values.shape
    position = positions(depth, camera)[:, None].expand_as(values)
    pooled = values.new_zeros(batch, modalities, camera.bev_px + 1, width)
    pooled = pooled.scatter_reduce(2, position, values, reduce, include_self=False)[:, :, :-1]
    return columns(pooled)


def point_features(depth: Tensor, camera: CameraConfig) -> Tensor:
    """Features of an ideal backbone: planar depth and height of each pixel's point, encoded.

    64 sines and cosines encode each of the two, the finest with one period per map cell. depth: (B, H, W) metres.
    Returns image columns (B * W, H, 128) float32.
    """
    cells = map_points(depth, camera)[..., 1:] / camera.cell_m
    encoded = sinusoids(2 * torch.pi * cells.flatten(), _WIDTH)
    return encoded.unflatten(0, cells.shape).flatten(-2).transpose(1, 2).flatten(0, 1)


class Columns(NamedTuple):
    """N image columns of R rows, with their correspondence to rays of P positions."""

    features: Tensor  #: (N, R, F) float32, input of the keys
    gamma: Tensor  #: (N, P, R) bool

    @classmethod
    def of(cls, depth: Tensor, camera: CameraConfig) -> Self:
        """The columns of depth images (B, H, W), metres, with `point_features` and `correspondence`."""
        return cls(point_features(depth, camera), correspondence(depth, camera))
