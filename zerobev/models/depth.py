"""Metric depth from one photograph: our own small network, and metric depth models of the `transformers` library.

The paper estimates depth with a DPT of 123 M parameters, fine-tuned to metres (supplement, "Finetuning monocular depth
estimation"). Our own network is one of this project's RGB backbones with a light decoder, so that training it also
pretrains the backbone of every other network.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig, ModelConfig
from zerobev.geometry.cameras import fpv_rays
from zerobev.models.backbone import IMAGENET_MEAN, IMAGENET_STD, RgbEncoder
from zerobev.models.base import BevModel
from zerobev.models.decoder import convolution, upsample

if TYPE_CHECKING:
    from transformers import PreTrainedConfig, PreTrainedModel

#: Nothing that `DepthNet` predicts is farther than this, metres.
FARTHEST_M = 50.0


class DepthEstimator(Protocol):
    """A module that estimates depth, called as `estimator(rgb)`.

    One that takes any size may have an attribute `side_px`, the side of the square images that it is at home with.
    `Projector` then gives it the photograph in up to so many pixels, rather than in those of the network's camera.
    """

    def __call__(self, rgb: Tensor) -> Tensor:
        """(B, 3, H, W) float32 in [0, 1] -> planar depth (B, 1, H, W) float32, metres."""

    def to(self, device: torch.device | str) -> Self:
        """Itself, moved to a device."""

    def eval(self) -> Self:
        """Itself, in evaluation mode."""


class DepthNet(BevModel):
    """Backbone, top-down decoder, and one inverse depth per pixel; for images of the given camera.

    A plane's inverse depth is affine in image coordinates, which a convolution extrapolates well: floor, walls and
    ceiling are planes. The direction of each ray is an input of the decoder, because the distance of the floor follows
    from the image row only for a known camera.
    """

    rays: Tensor  #: (1, 2, H, W)

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__(camera, model)
        self.backbone = RgbEncoder(model)
        self.laterals = nn.ModuleList(nn.Conv2d(channels + 2, model.width, 1) for channels in model.channels)
        self.merges = nn.ModuleList(convolution(model.width, model.width) for _ in model.channels)
        self.head = nn.Conv2d(model.width, model.stem_stride**2, 1)  # one per pixel under a cell of the finest map
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


_IMAGENET = (tuple(IMAGENET_MEAN), tuple(IMAGENET_STD))
_HALVES = ((0.5,) * 3, (0.5,) * 3)
_NONE = ((0.0,) * 3, (1.0,) * 3)
#: Types of the transformers library that predict metres: side of a square input as in their training (None: as
#: configured), and mean and standard deviation of their input, where no image processor says otherwise.
METRIC_TYPES: dict[str, tuple[int | None, tuple[tuple[float, ...], tuple[float, ...]]]] = {
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

    Photographs are resized (bilinear) to the size that the network was trained for and normalised; the depth is resized
    back. `side_px` tells a caller that has the photograph in more pixels how many are of use.
    """

    mean: Tensor  #: (3, 1, 1)
    std: Tensor  #: (3, 1, 1)

    def __init__(
        self,
        network: "PreTrainedModel",
        mean: Iterable[float] | None = None,
        std: Iterable[float] | None = None,
    ):
        """Wrap a network, to fine-tune it for example; `from_pretrained` checks that one predicts metres.

        network: of a type in `METRIC_TYPES`; returns `predicted_depth`, in metres once it is used
        mean, std: of its RGB input; default: the type's
        Raises `InputError` for another type.
        """
        super().__init__()
        kind = network.config.model_type
        if kind not in METRIC_TYPES:
            raise InputError(f"network: {_expected_types()}, found {kind}{_reason(kind)}")
        side, defaults = METRIC_TYPES[kind]
        self.network = network
        self.side_px = side or _configured_side(network.config)
        for name, given, default in zip(("mean", "std"), (mean, std), defaults):
            self.register_buffer(name, torch.tensor(list(given or default)).view(3, 1, 1), persistent=False)

    @classmethod
    def from_pretrained(cls, source: str | Path, predicts_metres: bool = False) -> Self:
        """The depth model in a folder or under a name on the Hugging Face hub, in evaluation mode.

        predicts_metres: your word that a DPT does, after fine-tuning (`zerobev.training.depth`); as published it
            predicts relative inverse depth, and its files are the same. The other types state it.
        The image normalisation is that of the image processor beside it, if there is one, else the type's.
        Raises `InputError` where there is no depth model, for a type that is not in `METRIC_TYPES`, for a Depth
        Anything of relative depth, and for a DPT without `predicts_metres`.
        """
        # imported here: it takes seconds, and most projections need no such model
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
            found = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise InputError(f"{source}: expected a depth model of transformers, found: {found}") from error
        if report["missing_keys"]:
            raise InputError(f"{source}: expected the weight {min(report['missing_keys'])}, found none of this name")
        if settings.get("do_normalize") is False:
            settings |= {"image_mean": _NONE[0], "image_std": _NONE[1]}
        return cls(network, settings.get("image_mean"), settings.get("image_std")).eval()

    def forward(self, rgb: Tensor) -> Tensor:
        """(B, 3, H, W) float32 in [0, 1] -> planar depth (B, 1, H, W) float32, metres."""
        resized = _resized(rgb, (self.side_px, self.side_px))
        # never with `labels`: most of these networks compute no loss, and raise
        depth = self.network(pixel_values=(resized - self.mean) / self.std).predicted_depth
        return _resized(depth[:, None].float(), rgb.shape[-2:])


def _check_metric(config: "PreTrainedConfig", source: str, predicts_metres: bool) -> None:
    kind = config.model_type
    if kind not in METRIC_TYPES:
        raise InputError(f"{source}: {_expected_types()}, found {kind}{_reason(kind)}")
    if (predicted := getattr(config, "depth_estimation_type", "metric")) != "metric":
        raise InputError(f"{source}: expected a model of metric depth, found one of {predicted} depth")
    if kind == "dpt" and not predicts_metres:
        choice = "say predicts_metres=True where it was fine-tuned to metres"
        raise InputError(f"{source}: expected a model of metric depth, found a DPT, relative as published: {choice}")


def _expected_types() -> str:
    return f"expected a model of metric depth ({', '.join(METRIC_TYPES)})"


def _reason(kind: str) -> str:
    return f", which predicts {_REFUSED[kind]}" if kind in _REFUSED else ""


def _configured_side(config: "PreTrainedConfig") -> int:
    """Side of the square images that a network was trained for: of its backbone, in pixels."""
    size = getattr(getattr(config, "backbone_config", None), "image_size", None) or config.image_size
    return size if isinstance(size, int) else min(size)


def _resized(images: Tensor, size: tuple[int, ...]) -> Tensor:
    if tuple(images.shape[-2:]) == tuple(size):
        return images
    return F.interpolate(images, size=size, mode="bilinear", align_corners=False)
