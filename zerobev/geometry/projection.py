"""P^-1: projection to the map with known depth, and the field of view on the map (paper, Sections 3 and 8).

Written in torch, since the residual model uses it inside the network; images come in batches.
"""

from functools import cache

import numpy as np
import torch
from scipy.spatial import ConvexHull

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import fpv_rays


@cache
def _slopes(camera: CameraConfig) -> np.ndarray:
    """(H,) float64: how far to the right a column looks, and a row down, at depth 1."""
    return fpv_rays(camera)[0, :, 0]


def map_coordinates(depth: torch.Tensor, camera: CameraConfig) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The coordinates of `map_points`, a tensor (..., H, W) each: x to the right, y forward, z above the floor, metres.

    depth: (..., H, W) planar depth, metres, of square images
    """
    slopes = torch.as_tensor(_slopes(camera), dtype=depth.dtype, device=depth.device)
    return slopes * depth, depth, camera.height_m - slopes[:, None] * depth


def map_points(depth: torch.Tensor, camera: CameraConfig) -> torch.Tensor:
    """Points seen by the pixels of `depth` in the map frame (x right, y forward, z above the floor).

    depth: (..., H, W) planar depth, metres. Returns (..., H, W, 3) of the same dtype, metres.
    """
    return torch.stack(map_coordinates(depth, camera), dim=-1)


def cells_of_pixels(depth: torch.Tensor, camera: CameraConfig) -> torch.Tensor:
    """Index row * M + column of the map cell that each pixel falls into; M * M where it falls into none.

    depth: (..., H, W) planar depth, metres, 0 for nothing seen. Points above `max_height_m` reach no cell.
    Returns (..., H, W) int64.
    """
    x, y, z = map_coordinates(depth, camera)
    side = camera.bev_px
    column = torch.floor((x + camera.bev_extent_m / 2) / camera.cell_m).long()
    row = side - 1 - torch.floor(y / camera.cell_m).long()
    on_map = (column >= 0) & (column < side) & (row >= 0) & (row < side)
    seen = (depth > 0) & (z < camera.max_height_m)
    return torch.where(on_map & seen, row * side + column, side * side)


def inverse_project(zero: torch.Tensor, depth: torch.Tensor, camera: CameraConfig) -> torch.Tensor:
    """P^-1 with max-pooling to the ground: a cell holds the largest value among the pixels that fall into it.

    Counting points in voxels, leaving out those above 2 m, summing over height and thresholding at zero
    (supplement, "residual variant") marks exactly the cells that some white pixel falls into, whatever the
    height of a voxel; the maximum over pixels is that, and serves values in [0, 1] as well.

    The paper's voxels are 100 x 100 x 100, so a column of them is a cell of its map of 100 x 100. With a smaller map,
    of 40 x 40 or 20 x 20 cells, columns may be cut finer than cells; it makes no difference where a cell is made of
    whole columns (20 does: 5 x 5 columns a cell), since a cell then holds a white point if and only if one of its
    columns does. 40 does not divide 100: a column of 5 cm that straddles the edge of two cells of 12.5 cm would have to
    be given to one of them, and would move a point by up to 2.5 cm for nothing. Points are therefore put into cells
    directly, at every size.

    zero: (B, K, H, W) values >= 0; depth: (B, 1, H, W) metres. Returns (B, K, M, M), 0 where no pixel falls.
    """
    batch, modalities = zero.shape[:2]
    side = camera.bev_px
    cells = cells_of_pixels(depth, camera).view(batch, 1, -1).expand(batch, modalities, -1)
    pooled = zero.new_zeros(batch, modalities, side * side + 1)
    pooled = pooled.scatter_reduce(2, cells, zero.flatten(2), reduce="amax")
    return pooled[..., :-1].view(batch, modalities, side, side)


def inverse_project_mask(mask: np.ndarray, depth: np.ndarray, camera: CameraConfig) -> np.ndarray:
    """`inverse_project` of one binary image, several times faster: the cells that a white pixel falls into.

    mask: (H, W) bool; depth: (H, W) float, metres. Returns (M, M) bool.
    """
    hit = np.zeros(camera.bev_px**2 + 1, bool)
    hit[cells_of_pixels(torch.from_numpy(depth), camera).numpy()[mask]] = True
    return hit[:-1].reshape(camera.bev_px, camera.bev_px)


def fov_mask(depth: np.ndarray, camera: CameraConfig) -> np.ndarray:
    """(M, M) bool: cells with their centre in the convex hull of all cells that the depth image reaches.

    depth: (H, W) float, metres. The mask is empty where no pixel reaches the map; one cell reached is one
    cell in the mask, since the hull is that of the cells' corners.
    """
    side = camera.bev_px
    on_map = inverse_project_mask(np.ones_like(depth, bool), depth, camera)
    row = np.flatnonzero(on_map.any(axis=1))
    if not len(row):
        return np.zeros((side, side), bool)
    # the hull is that of the first and the last cell of each row
    ends = on_map[row].argmax(axis=1), side - on_map[row, ::-1].argmax(axis=1)
    corners = np.concatenate([np.stack([column, row + dy], axis=1) for column in ends for dy in (0, 1)])
    planes = ConvexHull(corners).equations  # (edges, 3): a x + b y + c <= 0 inside
    centre = np.stack(np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5), axis=-1)
    return (centre @ planes[:, :2].T + planes[:, 2] <= 1e-9).all(axis=-1)
