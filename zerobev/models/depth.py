"""Metric depth from one photograph: our own small network, and any depth model of the `transformers` library.

The paper estimates depth with a DPT of 123 M parameters, fine-tuned to metres (supplement, "Finetuning monocular depth
estimation"). Our own network is one of this project's RGB backbones with a light decoder, so that training it also
pretrains the backbone of every other network.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Protocol, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import AutoModelForDepthEstimation, PreTrainedModel
from transformers.image_processing_base import ImageProcessingMixin
from transformers.utils import IMAGE_PROCESSOR_NAME, cached_file

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig, ModelConfig
from zerobev.geometry.cameras import fpv_rays
from zerobev.models.backbone import IMAGENET_MEAN, IMAGENET_STD, RgbEncoder
from zerobev.models.base import BevModel
from zerobev.models.decoder import convolution, upsample

#: Nothing that `DepthNet` predicts is farther than this, metres.
FARTHEST_M = 50.0


class DepthEstimator(Protocol):
    """What estimates depth: a module, called as `estimator(rgb)`."""

    def __call__(self, rgb: Tensor) -> Tensor:
        """(B, 3, H, W) float32 in [0, 1] -> planar depth (B, 1, H, W) float32, metres."""

    def to(self, device: torch.device | str) -> Self:
        """Itself, moved to a device."""

    def eval(self) -> Self:
        """Itself, in evaluation mode."""


class DepthNet(BevModel):
    """Backbone, top-down decoder, and one inverse depth a pixel; for images of the given camera.

    A plane's inverse depth is affine in image coordinates, which makes it what a convolution extrapolates best: floor,
    walls and ceiling are planes. The decoder is told the direction of each ray, without which it could
    not know how far the floor is that it sees at some row.
    """

    rays: Tensor  #: (1, 2, H, W)

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__(camera, model)
        self.backbone = RgbEncoder(model)
        self.laterals = nn.ModuleList(nn.Conv2d(channels + 2, model.width, 1) for channels in model.channels)
        self.merges = nn.ModuleList(convolution(model.width, model.width) for _ in model.channels)
        self.head = nn.Conv2d(model.width, model.stem_stride**2, 1)  # one a pixel under a cell of the finest map
        rays = torch.from_numpy(fpv_rays(camera)[..., :2]).float().permute(2, 0, 1)[None]
        self.register_buffer("rays", rays, persistent=False)

    def forward(self, rgb: Tensor) -> Tensor:
        """(B, 3, H, W) float32 in [0, 1] -> planar depth (B, 1, H, W) float32, metres, up to `FARTHEST_M`."""
        self.check(rgb=(rgb, 3))
        maps = self.backbone(rgb)
        merged: Tensor | None = None
        for features, lateral, merge in reversed(list(zip(maps, self.laterals, self.merges))):
            rays = F.adaptive_avg_pool2d(self.rays, features.shape[-2:]).expand(len(rgb), -1, -1, -1)
            own = lateral(torch.cat([features, rays.to(features.dtype)], dim=1))
            merged = merge(own if merged is None else own + upsample(merged, own))
        fine = F.pixel_shuffle(self.head(merged), self.config.stem_stride)[..., : rgb.shape[-2], : rgb.shape[-1]]
        return 1 / (F.softplus(fine.float()) + 1 / FARTHEST_M)


class HubDepth(nn.Module):
    """A depth model of the `transformers` library as a `DepthEstimator`.

    Photographs are normalised and resized (bilinear) to what the network takes, the depth is resized back. The size is
    the next multiple of the network's patch, 14 pixels for Depth Anything; the DPT hybrid takes its own size alone.
    """

    mean: Tensor  #: (3, 1, 1)
    std: Tensor  #: (3, 1, 1)

    def __init__(
        self,
        network: PreTrainedModel,
        mean: Iterable[float] = IMAGENET_MEAN,
        std: Iterable[float] = IMAGENET_STD,
    ):
        """network: returns `predicted_depth` in metres, or is to be fine-tuned to; mean, std: of its RGB input."""
        super().__init__()
        self.network = network
        self.register_buffer("mean", torch.tensor(list(mean)).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(list(std)).view(3, 1, 1), persistent=False)

    @classmethod
    def from_pretrained(cls, source: str | Path) -> Self:
        """The depth model in a folder or under a name on the Hugging Face hub, in evaluation mode.

        The image normalisation is that of the image processor beside it, if there is one, else ImageNet's.
        A DPT predicts metres only after fine-tuning (`zerobev.training.depth`); nothing in its files tells.
        Raises `InputError` where there is no depth model, and for a Depth Anything that is not metric.
        """
        try:
            network, report = AutoModelForDepthEstimation.from_pretrained(str(source), output_loading_info=True)
            processor = cached_file(str(source), IMAGE_PROCESSOR_NAME, _raise_exceptions_for_missing_entries=False)
            settings = ImageProcessingMixin.get_image_processor_dict(str(source))[0] if processor else {}
        except (OSError, ValueError, RuntimeError) as error:
            found = str(error).strip().splitlines()[0]
            raise InputError(f"{source}: expected a depth model of transformers, found: {found}") from error
        if report["missing_keys"]:
            raise InputError(f"{source}: expected the weight {min(report['missing_keys'])}, found none of this name")
        kind = getattr(network.config, "depth_estimation_type", "metric")
        if kind != "metric":
            raise InputError(f"{source}: expected a model of metric depth, found one of {kind} depth")
        mean, std = settings.get("image_mean") or IMAGENET_MEAN, settings.get("image_std") or IMAGENET_STD
        return cls(network, mean, std).eval()

    def forward(self, rgb: Tensor) -> Tensor:
        """(B, 3, H, W) float32 in [0, 1] -> planar depth (B, 1, H, W) float32, metres."""
        resized = _resized(rgb, self._input_size(*rgb.shape[-2:]))
        # never with `labels`: these networks compute no loss, and raise
        depth = self.network(pixel_values=(resized - self.mean) / self.std).predicted_depth
        return _resized(depth[:, None].float(), rgb.shape[-2:])

    def _input_size(self, height: int, width: int) -> tuple[int, int]:
        config = self.network.config
        if getattr(config, "is_hybrid", False):
            return _pair(config.image_size)
        backbone = getattr(config, "backbone_config", None)
        patch = _pair(getattr(backbone, "patch_size", None) or config.patch_size)
        return -(-height // patch[0]) * patch[0], -(-width // patch[1]) * patch[1]


def _pair(size: int | Iterable[int]) -> tuple[int, int]:
    height, width = (size, size) if isinstance(size, int) else size
    return height, width


def _resized(images: Tensor, size: tuple[int, ...]) -> Tensor:
    if tuple(images.shape[-2:]) == tuple(size):
        return images
    return F.interpolate(images, size=size, mode="bilinear", align_corners=False)
