"""The U-Net on the map, across rays (paper, supplement, "U-Net/BEV decoder"; Philion and Fidler 2020)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from zerobev.models.backbone import resnet


def convolution(in_channels: int, out_channels: int) -> nn.Sequential:
    """3x3 convolution, batch norm, ReLU; the size is kept."""
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 3, padding=1, bias=False), nn.BatchNorm2d(out_channels), nn.ReLU()
    )


def resize(images: Tensor, size: Sequence[int]) -> Tensor:
    """Images (N, C, h, w) resampled to `size` (H, W), bilinear, with the same image edges."""
    return F.interpolate(images, size=tuple(size), mode="bilinear", align_corners=False)


class BevDecoder(nn.Module):
    """7x7 stride-2 stem without max-pool, three ResNet-18 stages, and two steps up, as in Lift-Splat-Shoot.

    The first step resizes the coarsest map to the size of the first stage's map and concatenates the two. The second
    step resizes to full size and adds the input, so every resolution has a skip.
    """

    def __init__(self, width: int, channels: tuple[int, int, int], out_channels: int):
        super().__init__()
        self.encoder = resnet(width, channels[0], channels, depths=(2, 2, 2), max_pool=False)
        self.up = nn.Sequential(convolution(channels[0] + channels[2], width), convolution(width, width))
        self.full = convolution(width, width // 2)
        self.head = nn.Conv2d(width // 2, out_channels, 1)

    def forward(self, features: Tensor) -> Tensor:
        """Map features (N, width, M, M) -> logits (N, out_channels, M, M)."""
        fine, _, coarse = self.encoder(features).feature_maps
        merged = self.up(torch.cat([resize(coarse, fine.shape[-2:]), fine], dim=1))
        return self.head(self.full(resize(merged, features.shape[-2:]) + features))
