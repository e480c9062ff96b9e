"""From polar rays to the Cartesian map: the known part of the geometry, without parameters.

Image column u, in pixels from the left edge of the image, contains the points x = z (u - W / 2) / focal at planar depth
z. A map cell with its centre at x to the right and z forward is therefore in column u = W / 2 + focal x / z.

Positions on a ray are map rows of planar depth z, as in Saha et al. (2022). Resampling a band is thus a linear
interpolation along the image columns per row, a fixed matrix per row: one batched matrix product. Its gradient is
another matrix product, without scattered additions, and deterministic.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.geometry.cameras import bev_cell_centres


def band_rows(camera: CameraConfig, edges_m: tuple[float, ...]) -> list[range]:
    """Map rows of each depth band, near band first; band b covers depths `edges_m[b]` to `edges_m[b + 1]`.

    Edges are rounded to whole cells. Raises `InputError` unless they rise from 0 to the map's extent, by at least a row
    per band.
    """
    cells = [round(edge / camera.cell_m) for edge in edges_m]
    if cells[0] != 0 or cells[-1] != camera.bev_px or any(a >= b for a, b in pairwise(cells)):
        raise InputError(
            f"band_edges_m: expected depths that rise from 0 to {camera.bev_extent_m} m by at least one cell of "
            f"{camera.cell_m:g} m, found {edges_m}"
        )
    return [range(camera.bev_px - far, camera.bev_px - near) for near, far in pairwise(cells)]


def image_column(camera: CameraConfig, rows: range) -> Tensor:
    """Image column u of each cell centre of map rows `rows`: (P, M) float64, pixels from the left edge."""
    x, z = (torch.as_tensor(axis[rows]) for axis in bev_cell_centres(camera))
    return camera.fpv_px / 2 + camera.focal_px * x / z


def floor_row(camera: CameraConfig, rows: range, stride: int) -> Tensor:
    """Row of a feature map, as a real number, with the floor at the depth of each map row: (P,) float64.

    The camera is level, so the floor at depth z is at image row H / 2 + focal height / z in every column. Floor below
    the image counts as its last row.
    """
    z = torch.as_tensor(bev_cell_centres(camera)[1][rows, 0])
    v = camera.fpv_px / 2 + camera.focal_px * camera.height_m / z
    return (v / stride - 0.5).clamp(max=-(-camera.fpv_px // stride) - 1)


class PolarToCartesian(nn.Module):
    """Resample one band of polar rays to the cells of map rows `rows`, linearly between the centres of feature columns.

    Feature column i of a map with stride s has its centre at image column u = s (i + 1/2), as with
    `align_corners=False`; the outermost values extend to the image's edge. Cells outside the image are zero.
    """

    weights: Tensor  #: (P, M, C)
    valid: Tensor  #: (P, M) bool

    def __init__(self, camera: CameraConfig, rows: range, stride: int):
        super().__init__()
        u = image_column(camera, rows)
        columns = -(-camera.fpv_px // stride)
        position = (u / stride - 0.5).clamp(0, columns - 1)  # in feature columns
        valid = (u >= 0) & (u <= camera.fpv_px)
        # linear interpolation: the weight of column i is a hat function of half-width 1 around it
        weights = (1 - (position[..., None] - torch.arange(columns)).abs()).clamp(min=0) * valid[..., None]
        self.register_buffer("weights", weights.float(), persistent=False)
        self.register_buffer("valid", valid, persistent=False)

    def forward(self, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Rays (B, C, P, d), position p on map row `rows[p]` -> features (B, P, M, d), validity mask (P, M) bool."""
        return self.weights.to(rays.dtype) @ rays.transpose(1, 2), self.valid
