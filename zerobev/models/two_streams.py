"""Zero-BEV with the inductive bias (paper, Section 3.4, Eqs. 6 and 7; supplement, "Zero-BEV with inductive bias").

RGB image -> backbone -> pyramid -> transformers ---> map features -> U-Net -> auxiliary logits
                                         : attention                    = (shared weights)
zero-shot -> zero CNN ------------> weighted sums --> map features -> U-Net -> zero-shot logits
"""

import torch
from torch import Tensor, nn

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig, ModelConfig
from zerobev.models.backbone import RgbEncoder, ZeroCNN
from zerobev.models.band_transformer import BandAttention
from zerobev.models.base import IMAGES_PER_PASS, Features, MapLogits, ZeroShotModel, in_passes
from zerobev.models.decoder import BevDecoder
from zerobev.models.fpv_to_bev import FpvToBev, reweigh
from zerobev.models.pyramid import FeaturePyramid


class TwoStreamZeroBEV(ZeroShotModel):
    """Two streams with one attention (paper, Fig. 2e): geometry comes from the RGB image alone.

    The RGB stream is a transformer. The zero-shot stream uses the attention weights of the RGB stream's last
    cross-attention, with the zero CNN's columns as values; an output projection merges the heads and gives the width of
    the map. The two U-Nets share all weights and have separate output channels. Attention does not depend on the
    zero-shot images and is computed once for all of them.

    Raises `InputError` for a configuration without auxiliary maps: only these train the RGB stream's values.
    """

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__(camera, model)
        if not model.aux:
            raise InputError("aux: expected at least one map for the RGB stream to predict, found none")
        self.backbone = RgbEncoder(model)
        self.zero_cnn = ZeroCNN(model.zero_channels, model.stem_stride, gain=model.zero_init_gain)
        self.pyramid = FeaturePyramid(model.channels, model.width)
        self.bands = FpvToBev(camera, model)
        self.outs = nn.ModuleList(nn.Linear(c, model.width) for c in reversed(model.zero_channels))  # near band first
        self.decoder = BevDecoder(model.width, model.decoder_channels, 1 + len(model.aux))

    def image_features(self, rgb: Tensor) -> Features:
        """Features on the map (B, width, M, M); then per band, near first, attention (B, C, heads, P, R)."""
        rgb_features, attention = self.bands(self.pyramid(self.backbone(rgb)))
        return rgb_features, *(band.cross[-1].unflatten(0, (rgb.shape[0], -1)) for band in attention)

    def project_images(self, features: Features, zero: Tensor, projected: Tensor | None) -> MapLogits:
        """As `ZeroShotModel.project_images`, without P^-1."""
        rgb_features, *attention = features
        batch = rgb_features.shape[0]
        zero_maps = self.zero_cnn(zero.flatten(0, 1)[:, None])[::-1]  # near band first
        zero_rays = [out(reweigh(cross.flatten(0, 1), m)) for out, cross, m in zip(self.outs, attention, zero_maps)]
        zero_features = self.bands.to_map(zero_rays)
        # in training both streams are one batch: one set of batch statistics, as in evaluation
        both = in_passes(torch.cat([rgb_features, zero_features]), max(2 * batch, IMAGES_PER_PASS))
        logits = torch.cat([self.decoder(part) for part in both])
        return MapLogits(logits[batch:, 0].unflatten(0, zero.shape[:2]), logits[:batch, 1:])

    def attention(self, rgb: Tensor, zero: Tensor | None = None) -> list[BandAttention]:
        """Attention for B RGB images, near band first, laid out as `ZeroBEV.attention`; `zero` is not used."""
        self.check(rgb=(rgb, 3))
        return self.bands(self.pyramid(self.backbone(rgb)))[1]
