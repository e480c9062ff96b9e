"""The attention of a trained network against gamma (paper, Section 3.3 and Theorem 3.1).

The correct attention of a visible map cell is known: the pixels of its image column whose points lie in the cell. A
hidden cell has no such pixel; the network can infer it only from the rest of the column.
"""

from collections.abc import Iterator

import pandas as pd
import torch
import torch.nn.functional as F
from torch import Tensor

from zerobev.models.polar import band_rows
from zerobev.models.zero_bev import ZeroBEV
from zerobev.theory.correspondence import positions


@torch.no_grad()
def attended(net: ZeroBEV, rgb: Tensor, zero: Tensor, depth: Tensor, floor: Tensor) -> pd.DataFrame:
    """Fraction of the last layer's attention on the true pixels; for hidden cells, on floor pixels.

    Three kinds of cells: "floor" cells show only floor, "raised" cells also an object. "hidden" cells contain no pixel
    of their column, some pixel of the column lies farther away, and floor at their distance would be inside the image.
    A feature counts as true if one of its pixels does.

    rgb: (B, 3, H, W); zero: (B, 1, H, W) zero-shot images, another input of the attention
    depth: (B, H, W) true planar depth, metres; floor: (B, H, W) bool, floor pixels
    Returns one line per band (0 is nearest), head and kind of cell: the mean fraction over cells (column `share`), the
    fraction of a uniform attention (`uniform`), and the number of `cells`.
    """
    camera, position = net.camera, positions(depth, net.camera)
    nearest_m = 2 * camera.height_m * camera.focal_px / camera.fpv_px  # floor at the lower edge of the image
    lines = []
    for band, (cross, rows, stride) in enumerate(_bands(net, rgb, zero)):
        row = torch.tensor(rows)[:, None, None]
        falls = position[:, None] == row  # B P H W
        true = _under_features(falls, stride)  # B C P R
        raised = _under_features(falls & ~floor[:, None], stride).any(-1)
        farther = (position[:, None] < row).any(2, keepdim=True).expand(-1, -1, stride, -1)
        in_image = (camera.bev_px - row.flatten() - 0.5) * camera.cell_m > nearest_m
        hidden = ~true.any(-1) & _under_features(farther, stride)[..., 0] & in_image
        on_floor = _under_features(floor[:, None], stride).expand_as(true)
        kinds = {"floor": (true.any(-1) & ~raised, true), "raised": (raised, true), "hidden": (hidden, on_floor)}
        for head, weights in enumerate(cross.unbind(2)):
            for kind, (cells, target) in kinds.items():
                fractions = (float((w * target).sum(-1)[cells].mean()) for w in (weights, 1 / target.shape[-1]))
                lines.append((band, head, kind, *fractions, int(cells.sum())))
    columns = ["band", "head", "cells are", "share", "uniform", "cells"]
    return pd.DataFrame(lines, columns=columns).set_index(columns[:3])


@torch.no_grad()
def column_attention(net: ZeroBEV, rgb: Tensor, zero: Tensor, column: int) -> Tensor:
    """Attention of the ray of one image column: (heads, M, H), map rows over image rows; sums to 1 over H.

    rgb: (1, 3, H, W); zero: (1, 1, H, W); column: image column, pixels. The pixels of a feature have equal parts of its
    weight.
    """
    bands = [
        cross[0, column // stride].repeat_interleave(stride, -1)[..., : rgb.shape[-2]] / stride
        for cross, _, stride in _bands(net, rgb, zero)
    ]
    return torch.cat(bands[::-1], dim=1)


def _bands(net: ZeroBEV, rgb: Tensor, zero: Tensor) -> Iterator[tuple[Tensor, range, int]]:
    """Cross-attention (B, C, heads, P, R), map rows and stride of each band, near band first."""
    rows = band_rows(net.camera, net.config.band_edges_m)
    for number, band in enumerate(net.attention(rgb, zero)):
        stride = net.config.stem_stride * 2 ** (len(rows) - 1 - number)
        yield band.cross[-1].unflatten(0, (len(rgb), -1)), rows[number], stride


def _under_features(pixels: Tensor, stride: int) -> Tensor:
    """(B, P, H, W) bool -> (B, C, P, R): whether any pixel of a feature is set."""
    return F.max_pool2d(pixels.float(), stride, ceil_mode=True).bool().permute(0, 3, 1, 2)
