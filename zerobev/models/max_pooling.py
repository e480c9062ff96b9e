"""Zero-BEV with an attention that max-pools: variant (f), not in the paper.

RGB image -> backbone -> pyramid -> gates, one per pixel and position of its ray
                           :          :
                           :          :-- noisy OR with the unprocessed zero-shot image -> embedding --.
                           '----------'-- mean, weighted with the gates -> map features -------------- + -> U-Net

The paper's supplement calls max-pooling along the vertical the open point of its Theorem 3.1: attention averages, and
an average of binary values is not a maximum. An OR over binary gates is.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from zerobev.config import CameraConfig, ModelConfig
from zerobev.models.backbone import RgbEncoder
from zerobev.models.base import IMAGES_PER_PASS, Features, MapLogits, ZeroShotModel, in_passes, projected_maps
from zerobev.models.decoder import BevDecoder
from zerobev.models.polar import PolarToCartesian, floor_row
from zerobev.models.pyramid import FeaturePyramid

#: Initial logits of gates fall by 1 over this fraction of the image's height, away from the row of the floor.
_FLOOR_WIDTH = 1 / 32
#: Minimum of these initial logits: gates with lower ones would stay closed.
_MIN_LOGIT = -4.0


def closing(logits: Tensor) -> Tensor:
    """-log(1 - g) of gates g = sigmoid(logits), in the type of the logits, also under autocast."""
    with torch.autocast(logits.device.type, enabled=False):
        return F.softplus(logits)


def binary_or(gates: Tensor, values: Tensor) -> Tensor:
    """`noisy_or` for binary values: one matrix product for all modalities.

    gates: (..., P, R), `closing` of their logits
    values: (..., R, K) of K modalities, 0 or 1; a value in between counts as this fraction of a pixel,
        1 - prod_y (1 - g_y)^h_y
    Returns (..., P, K) float32 in [0, 1].
    """
    with torch.autocast(gates.device.type, enabled=False):
        closed = -(gates @ values.to(gates.dtype))  # log (1 - g h) = h log (1 - g)
    return -torch.expm1(closed.float())


def noisy_or(logits: Tensor, values: Tensor) -> Tensor:
    """1 - prod_y (1 - g_y h_y) for gates g = sigmoid(logits) and values h in [0, 1], per modality.

    For binary gates and values this is the maximum over the pixels with an open gate. In general it lies between the
    maximum of g_y h_y and their sum, and is monotone in every value.

    logits: (..., P, R) of P positions over R pixels
    values: (..., R, K) of K modalities
    Returns (..., P, K) in [0, 1].
    """
    if bool(((values == 0) | (values == 1)).all()):
        return binary_or(closing(logits), values)
    gates = logits.sigmoid().float().clamp(max=1 - 1e-6)
    closed = torch.stack([torch.log1p(-gates * h[..., None, :]).sum(-1) for h in values.unbind(-1)], dim=-1)
    return -torch.expm1(closed.float())


class Gates(nn.Module):
    """Logits per pixel of the RGB image and position of its column's ray: is the pixel projected to the position?

    A logit is the sum of a value from the pixel's features and a trained prior of its row. The prior starts at the
    projection of a flat floor.
    """

    def __init__(self, camera: CameraConfig, width: int, stride: int):
        super().__init__()
        self.side, self.stride = camera.fpv_px, stride
        self.head = nn.Conv2d(width, camera.bev_px * stride**2, 1)  # per pixel under a feature
        nn.init.normal_(self.head.weight, std=0.3 * width**-0.5)
        nn.init.zeros_(self.head.get_parameter("bias"))
        away = torch.arange(camera.fpv_px) - floor_row(camera, range(camera.bev_px), 1)[:, None]
        self.prior = nn.Parameter((-away.abs() / (_FLOOR_WIDTH * camera.fpv_px)).clamp(min=_MIN_LOGIT).float())  # P H

    def forward(self, features: Tensor) -> Tensor:
        """Finest features (B, width, R, C) -> logits (B, W, P, H); position p is map row p, top row first."""
        logits = self.head(features).unflatten(1, (-1, self.stride, self.stride))  # B P s s R C
        fine = logits.permute(0, 5, 3, 1, 4, 2).flatten(4).flatten(1, 2)[:, : self.side, :, : self.side]  # B W P H
        return fine + self.prior.to(fine.dtype)


class MaxPoolZeroBEV(ZeroShotModel):
    """Geometry from the RGB image alone; zero-shot values are pooled to the map before any network processes them.

    Every pixel of the zero-shot image has its own gates, so the pooled map has the resolution of the image. The U-Net
    then completes hidden parts; its input also contains the RGB features on the map. Gates do not depend on the
    zero-shot images and are computed once for all of them.
    """

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__(camera, model)
        rows, stride = range(camera.bev_px), model.stem_stride
        self.backbone = RgbEncoder(model)
        self.pyramid = FeaturePyramid(model.channels, model.width, outputs=1)
        self.gates = Gates(camera, model.width, stride)
        self.resample_pixels = PolarToCartesian(camera, rows, 1)
        self.resample_features = PolarToCartesian(camera, rows, stride)
        self.values = nn.Conv2d(model.width, model.width, 1)
        self.embedding = nn.Conv2d(1 + model.residual * projected_maps(model), model.width, 1)
        with torch.no_grad():
            self.embedding.weight.mul_(model.residual_init_gain)
        self.decoder = BevDecoder(model.width, model.decoder_channels, 1 + len(model.aux))

    def image_features(self, rgb: Tensor) -> Features:
        """`closing` of the gates (B, W, P, H), and features on the map (B, width, M, M)."""
        (features,) = self.pyramid(self.backbone(rgb))
        gates = self.gates(features)
        return closing(gates), self.map_features(features, gates)

    def project_images(self, features: Features, zero: Tensor, projected: Tensor | None) -> MapLogits:
        """As `ZeroShotModel.project_images`."""
        gates, map_features = features
        pooled = binary_or(gates, zero.permute(0, 3, 2, 1))  # B W P K
        pooled = self.resample_pixels(pooled)[0].permute(0, 3, 1, 2)  # B K M M
        maps = pooled[:, :, None] if projected is None else torch.cat([pooled[:, :, None], projected], dim=2)
        embedded = self.embedding(maps.flatten(0, 1).to(zero.dtype)).unflatten(0, zero.shape[:2])
        inputs = (map_features[:, None] + embedded).flatten(0, 1)
        parts = in_passes(inputs, max(zero.shape[0], IMAGES_PER_PASS))
        logits = torch.cat([self.decoder(part) for part in parts])
        logits = logits.unflatten(0, zero.shape[:2])
        return MapLogits(logits[:, :, 0], logits[:, :, 1:].mean(1) if self.config.aux else None, pooled)

    def map_features(self, features: Tensor, gates: Tensor) -> Tensor:
        """RGB features (B, d, R, C) on the map, (B, d, M, M): their mean, weighted with the gates."""
        stride, side = self.config.stem_stride, gates.shape[-1]
        values = F.pad(self.values(features), (0, 0, 0, 0, 0, 1), value=1.0)  # the last channel sums the weights
        per_pixel = values.permute(0, 3, 2, 1).repeat_interleave(stride, 2)[:, :, :side]  # B C H d+1
        sums = gates[:, ::stride].to(values.dtype).sigmoid() @ per_pixel  # B C P d+1
        means = sums[..., :-1] / (sums[..., -1:] + 0.01 * stride)
        return self.resample_features(means)[0].permute(0, 3, 1, 2)
