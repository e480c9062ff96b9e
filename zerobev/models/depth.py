"""Metric depth from one image: our own small network, and metric depth models of the `transformers` library.

The paper estimates depth with a DPT of 123 M parameters, fine-tuned to metres (supplement, "Finetuning monocular depth
estimation"). Our own network has the RGB backbone of the other networks and a light decoder, so its training also
pretrains their backbone.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from zerobev.common.errors import InputError, first_line
from zerobev.config import CameraConfig, ModelConfig
from zerobev.geometry.cameras import fpv_rays
from zerobev.models.backbone import IMAGENET_MEAN, IMAGENET_STD, RgbEncoder
from zerobev.models.base import BevModel
from zerobev.models.decoder import convolution, resize

if TYPE_CHECKING:
    from transformers import PreTrainedConfig, PreTrainedModel

#: Maximum depth that `DepthNet` predicts, metres.
FARTHEST_M = 50.0


class DepthEstimator(Protocol):
    """A module that estimates depth, called as `estimator(rgb)`.

    Optional attribute `side_px`: the preferred side of the square input image, if any size is accepted. `Projector`
    then resamples the photograph to up to that size instead of the size of the network's camera.
    """

    def __call__(self, rgb: Tensor, /) -> Tensor:
        """(B, 3, H, W) float32 in [0, 1] -> planar depth (B, 1, H, W) float32, metres."""

    def to(self, device: torch.device | str) -> Self:
        """Itself, moved to a device."""

    def eval(self) -> Self:
        """Itself, in evaluation mode."""


def estimate(estimator: DepthEstimator, rgb: Tensor, height_m: Tensor | None = None) -> Tensor:
    """Planar depth (B, 1, H, W) of images (B, 3, H, W), metres; only a `DepthNet` reads the heights (B,) of cameras."""
    return estimator(rgb, height_m) if isinstance(estimator, DepthNet) else estimator(rgb)


class DepthNet(BevModel):
    """Backbone, top-down decoder, and one inverse depth per pixel; for images of the given camera.

    Floor, walls and ceiling are planes; the inverse depth of a plane is affine in image coordinates, which convolutions
    extrapolate well. Ray directions are an input of the decoder, because the distance of the floor follows from the
    image row only for a known camera. With `ModelConfig.floor_depth`, the network predicts by how much a surface is in
    front of the floor: a level camera at a known height sees nothing behind it. Images from another height are
    stretched to the camera's floor, see `CameraConfig.at_height`; with `ModelConfig.own_rays` the directions are those
    before.
    """

    rays: Tensor  #: (1, 2, H, W)
    least: Tensor  #: (H, W) minimum of the inverse depth, 1 / metres

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__(camera, model)
        self.backbone = RgbEncoder(model)
        self.laterals = nn.ModuleList(nn.Conv2d(channels + 2, model.width, 1) for channels in model.channels)
        self.merges = nn.ModuleList(convolution(model.width, model.width) for _ in model.channels)
        self.head = nn.Conv2d(model.width, model.stem_stride**2, 1)  # one channel per pixel under a finest feature
        rays = torch.from_numpy(fpv_rays(camera)[..., :2]).float().permute(2, 0, 1)[None]
        self.register_buffer("rays", rays, persistent=False)
        least = torch.full((camera.fpv_px, camera.fpv_px), 1 / FARTHEST_M)
        if model.floor_depth:
            least = torch.maximum(least, rays[0, 1] / camera.height_m)
        self.register_buffer("least", least, persistent=False)

    def forward(self, rgb: Tensor, height_m: Tensor | None = None) -> Tensor:
        """(B, 3, H, W) float32 in [0, 1] -> planar depth (B, 1, H, W) float32, metres, up to `FARTHEST_M`.

        height_m: (B,) of the cameras, read with `ModelConfig.own_rays`; default: `camera.height_m`
        """
        self.check(rgb=(rgb, 3))
        own_rays = self.rays.expand(rgb.shape[0], -1, -1, -1)
        if self.config.own_rays and height_m is not None:
            stretch = height_m.to(self.rays.dtype) / self.camera.height_m
            own_rays = own_rays * torch.stack([torch.ones_like(stretch), stretch], dim=1)[..., None, None]
        maps = self.backbone(rgb)
        merged: Tensor | None = None
        for features, lateral, merge in reversed(list(zip(maps, self.laterals, self.merges))):
            rays = F.adaptive_avg_pool2d(own_rays, features.shape[-2:])
            fine = lateral(torch.cat([features, rays.to(features.dtype)], dim=1))
            merged = merge(fine if merged is None else fine + resize(merged, fine.shape[-2:]))
        pixels = F.pixel_shuffle(self.head(merged), self.config.stem_stride)[..., : rgb.shape[-2], : rgb.shape[-1]]
        return 1 / (F.softplus(pixels.float()) + self.least)


_MetricType = tuple[int | None, tuple[tuple[float, ...], tuple[float, ...]]]
_IMAGENET = (IMAGENET_MEAN, IMAGENET_STD)
_HALVES = ((0.5,) * 3, (0.5,) * 3)
_NONE = ((0.0,) * 3, (1.0,) * 3)
#: Types of the transformers library that predict metres: side of their square training images (None: as configured),
#: and mean and standard deviation of their input, unless set by an image processor.
METRIC_TYPES: dict[str, _MetricType] = {
    "depth_anything": (None, _IMAGENET),
    "dpt": (None, _IMAGENET),
    "glpn": (480, _NONE),
    "zoedepth": (None, _HALVES),
}
_REFUSED = {
    "depth_pro": "inverse depth that depends on the field of view",
    "prompt_depth_anything": "depth that is completed from a second, measured depth image",
    "chmv2": "heights of trees seen from above",
}


class HubDepth(nn.Module):
    """A metric depth model of the `transformers` library as a `DepthEstimator`.

    Images are resized (bilinear) to the side of the training images, `side_px`, and normalised; the depth is resized
    back.
    """

    mean: Tensor  #: (3, 1, 1)
    std: Tensor  #: (3, 1, 1)

    def __init__(
        self,
        network: "PreTrainedModel",
        mean: Iterable[float] | None = None,
        std: Iterable[float] | None = None,
    ):
        """Wrap a network, for example to fine-tune it; only `from_pretrained` checks that it predicts metres.

        network: of a type in `METRIC_TYPES`; returns `predicted_depth`
        mean, std: of its RGB input; default: the type's
        Raises `InputError` for another type.
        """
        super().__init__()
        side, defaults = _metric_type(network.config, "network")
        self.network = network
        self.side_px = side or _configured_side(network.config)
        for name, given, default in zip(("mean", "std"), (mean, std), defaults):
            self.register_buffer(name, torch.tensor(list(given or default)).view(3, 1, 1), persistent=False)

    @classmethod
    def from_pretrained(cls, source: str | Path, predicts_metres: bool = False) -> Self:
        """The depth model in a folder or under a name on the Hugging Face hub, in evaluation mode.

        predicts_metres: confirms that a DPT was fine-tuned to metres (`zerobev.training.depth`). Published DPTs predict
            relative inverse depth, and their files do not differ. Not needed for other types.
        The image normalisation is that of the image processor, if there is one, else the type's.
        Raises `InputError` if there is no depth model, for a type outside `METRIC_TYPES`, for a Depth Anything of
        relative depth, and for a DPT without `predicts_metres`.
        """
        # slow to import, and rarely needed
        from transformers import AutoConfig, AutoModelForDepthEstimation
        from transformers.image_processing_base import ImageProcessingMixin
        from transformers.utils import IMAGE_PROCESSOR_NAME, cached_file

        try:
            _check_metric(AutoConfig.from_pretrained(str(source)), str(source), predicts_metres)
            network, report = AutoModelForDepthEstimation.from_pretrained(str(source), output_loading_info=True)
            processor = cached_file(str(source), IMAGE_PROCESSOR_NAME, _raise_exceptions_for_missing_entries=False)
            settings = ImageProcessingMixin.get_image_processor_dict(str(source))[0] if processor else {}
        except InputError:
            raise
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(f"{source}: expected a depth model of transformers, found: {first_line(error)}") from error
        if report["missing_keys"]:
            raise InputError(f"{source}: expected the weight {min(report['missing_keys'])}, found none of this name")
        if settings.get("do_normalize") is False:
            settings |= {"image_mean": _NONE[0], "image_std": _NONE[1]}
        return cls(network, settings.get("image_mean"), settings.get("image_std")).eval()

    def forward(self, rgb: Tensor, height_m: Tensor | None = None) -> Tensor:
        """(B, 3, H, W) float32 in [0, 1] -> planar depth (B, 1, H, W) float32, metres; heights are not used."""
        resized = resize(rgb, (self.side_px, self.side_px))
        # without `labels`: most of these networks compute no loss and would raise
        depth = self.network(pixel_values=(resized - self.mean) / self.std).predicted_depth
        return resize(depth[:, None].float(), rgb.shape[-2:])


def _metric_type(config: "PreTrainedConfig", name: str) -> _MetricType:
    """The entry of `METRIC_TYPES` for a configuration; `name` is for the `InputError` of another type."""
    kind = config.model_type
    if kind not in METRIC_TYPES:
        reason = f", which predicts {_REFUSED[kind]}" if kind in _REFUSED else ""
        raise InputError(f"{name}: expected a model of metric depth ({', '.join(METRIC_TYPES)}), found {kind}{reason}")
    return METRIC_TYPES[kind]


def _check_metric(config: "PreTrainedConfig", source: str, predicts_metres: bool) -> None:
    _metric_type(config, source)
    if (predicted := getattr(config, "depth_estimation_type", "metric")) != "metric":
        raise InputError(f"{source}: expected a model of metric depth, found one of {predicted} depth")
    if config.model_type == "dpt" and not predicts_metres:
        choice = "pass predicts_metres=True if it was fine-tuned to metres"
        raise InputError(f"{source}: expected a model of metric depth, found a DPT, relative as published: {choice}")


def _configured_side(config: "PreTrainedConfig") -> int:
    """Side of the square training images of a network, or of its backbone, pixels."""
    size = getattr(getattr(config, "backbone_config", None), "image_size", None) or config.image_size
    return size if isinstance(size, int) else min(size)
