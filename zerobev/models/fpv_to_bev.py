"""From image features to map features: a transformer and a resampling per depth band.

Paper, supplement, "FPV to BEV transformers". The finest map is the input of the farthest band.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig, ModelConfig
from zerobev.models.band_transformer import BandAttention, BandTransformer
from zerobev.models.polar import PolarToCartesian, band_rows, floor_row


class FpvToBev(nn.Module):
    """Four pyramid maps to one map of BEV features, bands stacked far to near.

    `bands` and `resamplers` are near band first, as in the configuration. Raises `InputError` if the numbers of bands
    and maps differ.
    """

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__()
        rows = band_rows(camera, model.band_edges_m)
        if len(rows) != len(model.ffn):
            raise InputError(f"band_edges_m: expected {len(model.ffn) + 1} depths, found {model.band_edges_m}")
        strides = [model.stem_stride * 2**b for b in range(len(rows))][::-1]
        self.bands = nn.ModuleList(
            BandTransformer(
                model.width,
                model.heads,
                hidden,
                model.layers,
                model.dropout,
                -(-camera.fpv_px // stride),
                len(r),
                floor_row(camera, r, stride) if model.ground_start else None,
            )
            for r, stride, hidden in zip(rows, strides, model.ffn)
        )
        self.resamplers = nn.ModuleList(PolarToCartesian(camera, r, stride) for r, stride in zip(rows, strides))

    @property
    def valid(self) -> Tensor:
        """(M, M) bool: the cells inside the image columns' field of view."""
        return torch.cat([resampler.get_buffer("valid") for resampler in reversed(self.resamplers)])

    def forward(self, maps: Sequence[Tensor]) -> tuple[Tensor, list[BandAttention]]:
        """Maps (N, width, R_b, C_b), finest first -> BEV features (N, width, M, M), and the attention of every band.

        Features are zero outside `valid`. Attention is near band first; the batch of its tensors is N * C, image column
        fastest.
        """
        rays, attention = zip(*(band(columns(m)) for band, m in zip(self.bands, reversed(maps))))
        return self.to_map([r.unflatten(0, (maps[0].shape[0], -1)) for r in rays]), list(attention)

    def to_map(self, rays: Sequence[Tensor]) -> Tensor:
        """Rays (N, C_b, P_b, d) of each band, near band first -> features (N, d, M, M)."""
        bands = [resampler(r)[0] for resampler, r in zip(self.resamplers, rays)]
        return torch.cat(bands[::-1], dim=1).permute(0, 3, 1, 2)


def reweigh(cross: Tensor, values: Tensor) -> Tensor:
    """Cross-attention with identity values (paper, Eq. 7): image columns summed with the weights of another stream.

    The channels are divided among the heads, as in other multi-head attention.

    cross: (B * C, heads, P, R) attention of B RGB images, image column fastest
    values: (B * K, d, R, C) maps of K zero-shot images per RGB image
    Returns rays (B * K, C, P, d).
    """
    cross = cross.unflatten(0, (-1, values.shape[-1]))  # B C heads P R
    values = values.unflatten(1, (cross.shape[2], -1)).unflatten(0, (cross.shape[0], -1))  # B K heads e R C
    return torch.einsum("bchpr,bkherc->bkcphe", cross, values).flatten(-2).flatten(0, 1)


def columns(features: Tensor) -> Tensor:
    """(N, d, R, C) -> image columns as sequences, (N * C, R, d)."""
    return features.permute(0, 3, 2, 1).flatten(0, 1)
