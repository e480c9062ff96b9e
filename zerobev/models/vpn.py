"""VPN, the *View Parsing Network* (Pan et al. 2020): no camera geometry, trained on the target classes (row (b.1))."""

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from zerobev.config import LABELS, CameraConfig, ModelConfig
from zerobev.models.backbone import RgbEncoder
from zerobev.models.base import BevModel, MapLogits
from zerobev.models.decoder import convolution, resize

POOLED_SIDES = (1, 2, 3, 6)  #: of the pyramid pooling


class PyramidPooling(nn.Module):
    """Logits from a map and its averages over regions of several sizes (Zhao et al. 2017)."""

    def __init__(self, in_channels: int, width: int, out_channels: int, dropout: float):
        super().__init__()
        self.branches = nn.ModuleList(nn.Conv2d(in_channels, width, 1, bias=False) for _ in POOLED_SIDES)
        self.norms = nn.ModuleList(nn.BatchNorm2d(width) for _ in POOLED_SIDES)
        self.merge = convolution(in_channels + len(POOLED_SIDES) * width, width)
        self.dropout = nn.Dropout2d(dropout)
        self.head = nn.Conv2d(width, out_channels, 1)

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_channels, h, w) -> (N, out_channels, h, w)."""
        parts = [features]
        for side, branch, norm in zip(POOLED_SIDES, self.branches, self.norms):
            pooled = branch(F.adaptive_avg_pool2d(features, side))
            # normalised at full size: pooled to one region, a batch of one has a single value per channel
            parts.append(norm(resize(pooled, features.shape[-2:])).relu())
        return self.head(self.dropout(self.merge(torch.cat(parts, dim=1))))


class VPN(BevModel):
    """From an RGB image to maps of the eight classes, through fully connected layers from image to map positions.

    The same two layers transform every flattened channel of the backbone's third map to a coarse map from above.
    Pyramid pooling, twice as wide as the other networks, turns it into logits.
    """

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__(camera, model)
        self.backbone = RgbEncoder(replace(model, block="basic", depths=model.vpn_depths, channels=model.vpn_channels))
        positions = (-(-camera.fpv_px // (model.stem_stride * 4))) ** 2
        self.view = nn.Sequential(
            nn.Linear(positions, positions), nn.ReLU(), nn.Linear(positions, positions), nn.ReLU()
        )
        self.decoder = PyramidPooling(model.vpn_channels[-1], 2 * model.width, len(LABELS), model.dropout)

    def forward(
        self,
        rgb: Tensor,
        zero: Tensor | None = None,
        depth: Tensor | None = None,
        height_m: Tensor | None = None,
    ) -> MapLogits:
        """RGB (B, 3, H, W) in [0, 1], float32 -> logits (B, 8, M, M) in the order of `LABELS`."""
        self.check(rgb=(rgb, 3))
        features = self.backbone(rgb)[-1]
        from_above = self.view(features.flatten(2)).unflatten(2, features.shape[2:])
        return MapLogits(resize(self.decoder(from_above), (self.camera.bev_px, self.camera.bev_px)), None)
