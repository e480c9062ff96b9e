"""The Zero-BEV network (paper, Section 3.3 and supplement, "Zero-BEV base model" and "Zero-BEV, residual variant").

RGB image -> backbone --.
                         concatenate -> pyramid -> one transformer per depth band -> map features -> U-Net -> logits
zero-shot -> zero CNN --'                                                                 :
    '------- P^-1 with depth, max-pooling to the ground -> embedding  (residual) .........'
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from zerobev.config import CameraConfig, ModelConfig
from zerobev.models.backbone import RgbEncoder, ZeroCNN
from zerobev.models.band_transformer import BandAttention
from zerobev.models.base import IMAGES_PER_PASS, Features, MapLogits, ZeroShotModel, in_passes, projected_maps
from zerobev.models.decoder import BevDecoder
from zerobev.models.fpv_to_bev import FpvToBev
from zerobev.models.pyramid import FeaturePyramid


class ZeroBEV(ZeroShotModel):
    """Zero-BEV (paper, Fig. 2c; with `residual` 2d): project any zero-shot image to the map, given the RGB image.

    Eq. 5 concatenates the two images; as in the supplement, the two feature maps of each stride are concatenated here.
    RGB features are computed once. Each zero-shot image then has a separate pass through the zero CNN and all later
    parts, so its map does not depend on other images. The auxiliary logits are the mean over these passes (one pass in
    training), and do not depend on the order of images.
    """

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__(camera, model)
        self.backbone = RgbEncoder(model)
        self.zero_cnn = ZeroCNN(model.zero_channels, model.stem_stride, gain=model.zero_init_gain)
        self.pyramid = FeaturePyramid(tuple(map(sum, zip(model.channels, model.zero_channels))), model.width)
        self.bands = FpvToBev(camera, model)
        if model.residual:
            self.embedding = nn.Conv2d(projected_maps(model), model.width, 1)
            with torch.no_grad():
                self.embedding.weight.mul_(model.residual_init_gain)
        self.decoder = BevDecoder(model.width, model.decoder_channels, 1 + len(model.aux))

    def image_features(self, rgb: Tensor) -> Features:
        """The RGB part of the pyramid's laterals, see `rgb_laterals`."""
        return tuple(self.rgb_laterals(rgb))

    def project_images(self, features: Features, zero: Tensor, projected: Tensor | None) -> MapLogits:
        """As `ZeroShotModel.project_images`, in passes of few images."""
        images = [zero] if projected is None else [zero, projected]
        parts = zip(*(in_passes(image, max(1, IMAGES_PER_PASS // zero.shape[0]), dim=1) for image in images))
        logits = torch.cat([self.pass_images(features, *part) for part in parts], dim=1)  # B K 1+aux M M
        return MapLogits(logits[:, :, 0], logits[:, :, 1:].mean(1) if self.config.aux else None)

    def pass_images(self, laterals: Sequence[Tensor], zero: Tensor, projected: Tensor | None = None) -> Tensor:
        """`rgb_laterals` of B images, zero-shot images (B, K, H, W) -> logits (B, K, 1 + len(aux), M, M).

        projected: as of `project_images`
        """
        features, _ = self.bands(self.fpv_maps(laterals, zero))
        if projected is not None:
            features = features + self.embedding(projected.flatten(0, 1))
        return self.decoder(features).unflatten(0, zero.shape[:2])

    def rgb_laterals(self, rgb: Tensor) -> list[Tensor]:
        """The part of the pyramid's laterals that depends on the RGB images alone, (B, width, R_b, C_b)."""
        return self.pyramid.first_laterals(self.backbone(rgb))

    def fpv_maps(self, laterals: Sequence[Tensor], zero: Tensor) -> list[Tensor]:
        """The pyramid of RGB features concatenated with those of each zero-shot image: (B * K, width, R_b, C_b)."""
        return self.pyramid(self.zero_cnn(zero.flatten(0, 1)[:, None]), laterals)

    def attention(self, rgb: Tensor, zero: Tensor) -> list[BandAttention]:
        """Attention for B RGB images and zero-shot images (B, 1, H, W), near band first.

        The first axis of each tensor is B * C, image column fastest. `cross[-1].unflatten(0, (B, -1))[b, c, :, p]` are
        the weights, per head and image row (top first), of position p (map row `band_rows(...)[band][p]`) of column c.
        """
        self.check(rgb=(rgb, 3), zero=(zero, 1))
        return self.bands(self.fpv_maps(self.rgb_laterals(rgb), zero))[1]
