"""P^-1: projection to the map with known depth, and the field of view on the map (paper, Sections 3 and 8).

Written in torch, since the residual model applies it to batches inside the network.
"""

import numpy as np
import torch
from scipy.spatial import ConvexHull

from zerobev.config import CameraConfig
from zerobev.geometry.cameras import column_slopes


def map_coordinates(depth: torch.Tensor, camera: CameraConfig) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """x to the right, y forward, z above the floor of the points seen by each pixel: (..., H, W) each, metres.

    depth: (..., H, W) planar depth, metres, of square images
    """
    slopes = torch.tensor(column_slopes(camera.fpv_px, camera.focal_px), dtype=depth.dtype, device=depth.device)
    return slopes * depth, depth, camera.height_m - slopes[:, None] * depth


def map_points(depth: torch.Tensor, camera: CameraConfig) -> torch.Tensor:
    """`map_coordinates` in one tensor: points in the map frame, (..., H, W, 3) of the dtype of `depth`, metres."""
    return torch.stack(map_coordinates(depth, camera), dim=-1)


def cells_of_pixels(depth: torch.Tensor, camera: CameraConfig, height_m: torch.Tensor | None = None) -> torch.Tensor:
    """Index row * M + column of the map cell of each pixel; M * M for "no cell".

    depth: (..., H, W) planar depth, metres; 0: nothing seen
    height_m: (...) heights of the cameras of images that are stretched to `camera`; default: its own, see
        `CameraConfig.at_height`
    Points at or above `max_height_m` have no cell. Returns (..., H, W) int64.
    """
    x, y, z = map_coordinates(depth, camera)
    side = camera.bev_px
    column = torch.floor((x + camera.bev_extent_m / 2) / camera.cell_m).long()
    row = side - 1 - torch.floor(y / camera.cell_m).long()
    on_map = (column >= 0) & (column < side) & (row >= 0) & (row < side)
    limit: float | torch.Tensor = camera.max_height_m
    if height_m is not None:
        limit = (camera.max_height_m * camera.height_m / height_m)[..., None, None]
    seen = (depth > 0) & (z < limit)
    return torch.where(on_map & seen, row * side + column, side * side)


def inverse_project(
    zero: torch.Tensor, depth: torch.Tensor, camera: CameraConfig, height_m: torch.Tensor | None = None
) -> torch.Tensor:
    """P^-1 with max-pooling to the ground: the value of a cell is the maximum over its pixels; 0 without a pixel.

    The paper counts points in voxels, drops those above 2 m, sums over height and thresholds at zero (supplement,
    "residual variant"). This marks the cells of white pixels, for every voxel height. The maximum over pixels gives the
    same cells, and also works for values in [0, 1].

    The paper's 100 x 100 x 100 voxels match its map of 100 x 100 cells. At every map size, points are assigned to cells
    directly. For 20 x 20 cells of 5 x 5 voxel columns each, the voxels would give the same map. For 40 x 40 cells of
    12.5 cm, columns of 5 cm would straddle cell edges and displace points by up to 2.5 cm.

    zero: (B, K, H, W) values >= 0
    depth: (B, 1, H, W) metres
    height_m: (B,) heights of the cameras, see `cells_of_pixels`
    Returns (B, K, M, M).
    """
    return pooled_in_cells(zero, cells_of_pixels(depth[:, 0], camera, height_m), camera.bev_px)


def pooled_in_cells(zero: torch.Tensor, cells: torch.Tensor, side: int) -> torch.Tensor:
    """Maximum of the values (B, K, H, W) over the pixels of each cell, (B, K, M, M) for `side` M; 0 without a pixel.

    cells: (B, H, W) of `cells_of_pixels`
    """
    batch, modalities = zero.shape[:2]
    pooled = zero.new_zeros(batch, modalities, side * side + 1)
    index = cells.flatten(1)[:, None].expand(batch, modalities, -1)
    pooled = pooled.scatter_reduce(2, index, zero.flatten(2), reduce="amax")
    return pooled[..., :-1].unflatten(2, (side, side))


def inverse_project_mask(mask: np.ndarray, depth: np.ndarray, camera: CameraConfig) -> np.ndarray:
    """`inverse_project` of one binary image, several times faster.

    mask: (H, W) bool
    depth: (H, W) float, metres
    Returns (M, M) bool: the cells of white pixels.
    """
    hit = np.zeros(camera.bev_px**2 + 1, bool)
    hit[cells_of_pixels(torch.from_numpy(depth), camera).numpy()[mask]] = True
    return hit[:-1].reshape(camera.bev_px, camera.bev_px)


def fov_mask(depth: np.ndarray, camera: CameraConfig) -> np.ndarray:
    """(M, M) bool: cells with their centre in the convex hull of the corners of all cells with a pixel.

    depth: (H, W) float, metres
    The mask is empty if no pixel has a cell.
    """
    side = camera.bev_px
    on_map = inverse_project_mask(np.ones_like(depth, bool), depth, camera)
    row = np.flatnonzero(on_map.any(axis=1))
    if not len(row):
        return np.zeros((side, side), bool)
    # the first and the last cell of each row have the same hull as all cells
    ends = on_map[row].argmax(axis=1), side - on_map[row, ::-1].argmax(axis=1)
    corners = np.concatenate([np.stack([column, row + dy], axis=1) for column in ends for dy in (0, 1)])
    planes = ConvexHull(corners).equations  # (edges, 3): a x + b y + c <= 0 inside
    centre = np.stack(np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5), axis=-1)
    return (centre @ planes[:, :2].T + planes[:, 2] <= 1e-9).all(axis=-1)
