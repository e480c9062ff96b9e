"""From polar rays to the Cartesian map: the part of the geometry that is known and not learnt.

An image column u, in pixels from the left edge of the image, sees the points x = z (u - W / 2) / focal at every planar
depth z. A cell of the map in column c and row r has its centre at

    x = (c + 1/2) cell - extent / 2,    z = (M - r - 1/2) cell,    so it lies in u = W / 2 + focal x / z.

The positions on a ray are the map's own rows of planar depth z, as in Saha et al. (2022), so resampling a band is an
interpolation along the image columns, another one for each row. It is linear, hence a fixed matrix a row: one batched
matrix product, whose gradient is another one, without scattered additions, and the same on every run.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig


def band_rows(camera: CameraConfig, edges_m: tuple[float, ...]) -> list[range]:
    """The map rows of each depth band, near band first; band b covers depths `edges_m[b]` to `edges_m[b + 1]`.

    Edges are rounded to whole cells. Raises `InputError` unless they rise from 0 to the map's extent and leave every
    band a row.
    """
    cells = [round(edge / camera.cell_m) for edge in edges_m]
    if cells[0] != 0 or cells[-1] != camera.bev_px or any(a >= b for a, b in pairwise(cells)):
        raise InputError(
            f"band_edges_m: expected depths that rise from 0 to {camera.bev_extent_m} m by at least one cell of "
            f"{camera.cell_m:g} m, found {edges_m}"
        )
    return [range(camera.bev_px - far, camera.bev_px - near) for near, far in pairwise(cells)]


def image_column(camera: CameraConfig, rows: range) -> Tensor:
    """The image column u that sees each cell centre of map rows `rows`: (P, M) float64, pixels from the left edge."""
    cell = camera.cell_m
    x = (torch.arange(camera.bev_px, dtype=torch.float64) + 0.5) * cell - camera.bev_extent_m / 2  # M
    z = (camera.bev_px - torch.tensor(rows, dtype=torch.float64) - 0.5) * cell  # P
    return camera.fpv_px / 2 + camera.focal_px * x / z[:, None]


def floor_row(camera: CameraConfig, rows: range, stride: int) -> Tensor:
    """The row of a feature map, as a real number, that sees the floor at the depth of each map row: (P,) float64.

    The camera does not pitch, so that floor at depth z is seen at image row H / 2 + focal height / z in every column.
    Floor below the image is taken for its last row.
    """
    z = (camera.bev_px - torch.tensor(rows, dtype=torch.float64) - 0.5) * camera.cell_m
    v = camera.fpv_px / 2 + camera.focal_px * camera.height_m / z
    return (v / stride - 0.5).clamp(max=-(-camera.fpv_px // stride) - 1)


class PolarToCartesian(nn.Module):
    """Resample one band of polar rays to the cells of map rows `rows`, linearly between the centres of feature columns.

    Feature column i of a map with stride s has its centre at image column u = s (i + 1/2), as with
    `align_corners=False`; beyond the outermost centres their values go on to the image's edge. Cells that no image
    column sees are zero.
    """

    weights: Tensor  #: (P, M, C)
    valid: Tensor  #: (P, M) bool

    def __init__(self, camera: CameraConfig, rows: range, stride: int):
        super().__init__()
        u = image_column(camera, rows)
        columns = -(-camera.fpv_px // stride)
        position = (u / stride - 0.5).clamp(0, columns - 1)  # in feature columns
        valid = (u >= 0) & (u <= camera.fpv_px)
        # A linear interpolation gives column i the weight of a hat of half-width 1 around it.
        weights = (1 - (position[..., None] - torch.arange(columns)).abs()).clamp(min=0) * valid[..., None]
        self.register_buffer("weights", weights.float(), persistent=False)
        self.register_buffer("valid", valid, persistent=False)

    def forward(self, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Rays (B, C, P, d), position p on map row `rows[p]` -> features (B, P, M, d), validity mask (P, M) bool."""
        return self.weights.to(rays.dtype) @ rays.transpose(1, 2), self.valid
