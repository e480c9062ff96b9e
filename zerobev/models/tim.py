"""TIM, *Translating Images into Maps* (Saha et al. 2022): Zero-BEV's parts trained on the target classes (row (b.2)).

With the segmentation as an additional input (row (b.3)) it has the same information as the zero-shot methods.
"""

import torch
from torch import Tensor

from zerobev.config import LABELS, CameraConfig, ModelConfig
from zerobev.models.backbone import RgbEncoder, ZeroCNN
from zerobev.models.band_transformer import BandAttention
from zerobev.models.base import BevModel, MapLogits
from zerobev.models.decoder import BevDecoder
from zerobev.models.fpv_to_bev import FpvToBev
from zerobev.models.pyramid import FeaturePyramid


class TIM(BevModel):
    """From an RGB image, and with `segmentation` the masks of the eight classes, to maps of these classes.

    One CNN, as wide as Zero-BEV's zero CNN and at its place in the network, has all masks as input.
    """

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__(camera, model)
        self.backbone = RgbEncoder(model)
        channels = model.channels
        if model.segmentation:
            self.zero_cnn = ZeroCNN(model.zero_channels, model.stem_stride, len(LABELS), model.zero_init_gain)
            channels = tuple(map(sum, zip(channels, model.zero_channels)))
        self.pyramid = FeaturePyramid(channels, model.width)
        self.bands = FpvToBev(camera, model)
        self.decoder = BevDecoder(model.width, model.decoder_channels, len(LABELS))

    def forward(
        self,
        rgb: Tensor,
        zero: Tensor | None = None,
        depth: Tensor | None = None,
        height_m: Tensor | None = None,
    ) -> MapLogits:
        """RGB (B, 3, H, W) in [0, 1], float32 -> logits (B, 8, M, M) in the order of `LABELS`.

        zero: (B, 8, H, W) masks of the classes in the order of `LABELS`; used only with `segmentation`
        """
        features, _ = self.bands(self.fpv_maps(rgb, zero))
        return MapLogits(self.decoder(features), None)

    def attention(self, rgb: Tensor, zero: Tensor | None = None) -> list[BandAttention]:
        """Attention for B RGB images, near band first, laid out as `ZeroBEV.attention`."""
        return self.bands(self.fpv_maps(rgb, zero))[1]

    def fpv_maps(self, rgb: Tensor, zero: Tensor | None) -> list[Tensor]:
        """The pyramid's maps (B, width, R_b, C_b), finest first."""
        if not self.config.segmentation:
            self.check(rgb=(rgb, 3))
            return self.pyramid(self.backbone(rgb))
        self.check(rgb=(rgb, 3), zero=(zero, len(LABELS)))
        return self.pyramid([torch.cat(pair, dim=1) for pair in zip(self.backbone(rgb), self.zero_cnn(zero))])
