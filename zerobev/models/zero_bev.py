"""The Zero-BEV network (paper, Section 3.3 and supplement, "Zero-BEV base model") and its checkpoint.

photograph -> backbone --.
                          concatenate -> pyramid -> one transformer a depth band -> map features -> U-Net -> logits
zero-shot  -> zero CNN --'
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple, Self

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from zerobev.config import CameraConfig, ModelConfig
from zerobev.errors import InputError
from zerobev.models.backbone import ZeroCNN, rgb_backbone
from zerobev.models.band_transformer import BandAttention, BandTransformer
from zerobev.models.decoder import BevDecoder
from zerobev.models.polar import PolarToCartesian, band_rows
from zerobev.models.pyramid import FeaturePyramid
from zerobev.storage import replacing

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

#: Zero-shot images that pass the network together, at most (a batch with more samples passes whole).
IMAGES_A_PASS = 16


class Projection(NamedTuple):
    """What the network predicts, before the FOV mask."""

    zero_logits: Tensor  #: (B, K, M, M), one map a zero-shot image
    aux_logits: Tensor | None  #: (B, len(aux), M, M), or None where the model has no auxiliary output


class RgbEncoder(nn.Module):
    """Normalise the photograph as ImageNet is and extract its four maps."""

    def __init__(self, model: ModelConfig):
        super().__init__()
        self.network = rgb_backbone(model)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)

    def forward(self, rgb: Tensor) -> tuple[Tensor, ...]:
        """(B, 3, H, W) float32 in [0, 1] -> maps (B, channels[b], R_b, C_b), finest first."""
        return self.network((rgb - self.mean) / self.std).feature_maps


class FpvToBev(nn.Module):
    """Four pyramid maps to one map of BEV features: a transformer and a resampling a depth band, stacked far to near.

    The finest map feeds the farthest band. `bands` and `resamplers` are near band first, as the configuration is.
    """

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__()
        rows = band_rows(camera, model.band_edges_m)
        strides = [model.stem_stride * 2**b for b in range(len(rows))][::-1]
        self.bands = nn.ModuleList(
            BandTransformer(
                model.width, model.heads, hidden, model.layers, model.dropout, -(-camera.fpv_px // stride), len(r)
            )
            for r, stride, hidden in zip(rows, strides, model.ffn)
        )
        self.resamplers = nn.ModuleList(PolarToCartesian(camera, r, stride) for r, stride in zip(rows, strides))

    @property
    def valid(self) -> Tensor:
        """(M, M) bool: the cells that an image column sees."""
        return torch.cat([resampler.valid for resampler in reversed(self.resamplers)])

    def forward(self, maps: list[Tensor]) -> Tensor:
        """Maps (N, width, R_b, C_b), finest first -> BEV features (N, width, M, M), zero outside `valid`."""
        bands = []
        for features, band, resampler in zip(maps, reversed(self.bands), reversed(self.resamplers)):
            rays = band(columns(features)).unflatten(0, (len(features), -1))  # N C P d
            bands.append(resampler(rays)[0])
        return torch.cat(bands, dim=1).permute(0, 3, 1, 2)

    def attention(self, maps: list[Tensor]) -> list[BandAttention]:
        """The attention of every band, near band first; the batch of its tensors is N * C, image column fastest."""
        return [band.attend(columns(features))[1] for band, features in zip(self.bands, reversed(maps))]


def columns(features: Tensor) -> Tensor:
    """(N, d, R, C) -> image columns as sequences, (N * C, R, d)."""
    return features.permute(0, 3, 2, 1).flatten(0, 1)


class BevModel(nn.Module):
    """A network that its class, a camera and a configuration describe wholly, with its checkpoint."""

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__()
        self.camera, self.config = camera, model

    def save(self, path: Path) -> None:
        """Write one safetensors file: the weights, with the class and configuration as JSON in its metadata."""
        described = {"class": type(self).__name__, "camera": asdict(self.camera), "model": asdict(self.config)}
        tensors = {name: tensor.contiguous() for name, tensor in self.state_dict().items()}
        with replacing(path) as temporary:
            save_file(tensors, temporary, metadata={"zerobev": json.dumps(described, sort_keys=True)})

    @classmethod
    def load(cls, path: Path) -> Self:
        """The network saved in `path`, on the CPU, in evaluation mode; nothing else is needed.

        Raises `InputError` where the file cannot be read, is not a checkpoint of this class, or does not hold exactly
        the weights of its own configuration.
        """
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        except (OSError, SafetensorError) as error:
            raise InputError(f"{path}: expected a safetensors checkpoint, found: {error}") from error
        try:
            described = json.loads(metadata["zerobev"])
            camera = CameraConfig(**described["camera"])
            model = ModelConfig(**{k: tuple(v) if isinstance(v, list) else v for k, v in described["model"].items()})
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{path}: expected the network's configuration in the metadata, found: {error!r}"
            ) from error
        if described["class"] != cls.__name__:
            raise InputError(f"{path}: expected a checkpoint of {cls.__name__}, found one of {described['class']}")
        network = cls(camera, model)
        try:
            network.load_state_dict(tensors)
        except RuntimeError as error:
            found = " ".join(str(error).split())
            raise InputError(f"{path}: expected the weights of its configuration, found: {found}") from error
        return network.eval()


class ZeroBEV(BevModel):
    """Zero-BEV base model (paper, Fig. 2c): project any zero-shot image to the map, given the photograph.

    The photograph's features are computed once; each zero-shot image then goes its own way through the zero CNN and
    everything behind it, so the maps of several images do not depend on each other. The auxiliary logits are the mean
    over these passes: with one image, as in training, they are the pass's own, and the order of images is of no effect.
    """

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__(camera, model)
        self.backbone = RgbEncoder(model)
        self.zero_cnn = ZeroCNN(model.zero_channels, model.stem_stride)
        self.pyramid = FeaturePyramid(tuple(map(sum, zip(model.channels, model.zero_channels))), model.width)
        self.bands = FpvToBev(camera, model)
        self.decoder = BevDecoder(model.width, model.decoder_channels, 1 + len(model.aux))

    def forward(self, rgb: Tensor, zero: Tensor) -> Projection:
        """Photograph (B, 3, H, W) float32 in [0, 1], zero-shot images (B, K, H, W) float32 -> `Projection`."""
        self.check(rgb, zero)
        rgb_maps = self.backbone(rgb)
        parts = zero.split(max(1, IMAGES_A_PASS // len(zero)), dim=1)
        logits = torch.cat([self.project(rgb_maps, part) for part in parts], dim=1)  # B K 1+aux M M
        return Projection(logits[:, :, 0], logits[:, :, 1:].mean(1) if self.config.aux else None)

    def project(self, rgb_maps: tuple[Tensor, ...], zero: Tensor) -> Tensor:
        """Maps of B photographs, zero-shot images (B, K, H, W) -> logits (B, K, 1 + len(aux), M, M)."""
        features = self.bands(self.pyramid(self.fpv_maps(rgb_maps, zero)))
        return self.decoder(features).unflatten(0, zero.shape[:2])

    def fpv_maps(self, rgb_maps: tuple[Tensor, ...], zero: Tensor) -> list[Tensor]:
        """Concatenate the photograph's maps with those of each zero-shot image, (B * K, channels, R_b, C_b)."""
        zero_maps = self.zero_cnn(zero.flatten(0, 1)[:, None])
        shared = [features.repeat_interleave(zero.shape[1], 0) for features in rgb_maps]
        return [torch.cat(pair, dim=1) for pair in zip(shared, zero_maps)]

    def attention(self, rgb: Tensor, zero: Tensor) -> list[BandAttention]:
        """Attention of the pass of B photographs and zero-shot images (B, 1, H, W), near band first.

        The first axis of each tensor is B * C, image column fastest; `cross[-1].unflatten(0, (B, -1))[b, c, :, p]` is
        what position p (map row `band_rows(...)[band][p]`) of the ray of column c attends to, top row first.
        """
        self.check(rgb, zero)
        return self.bands.attention(self.pyramid(self.fpv_maps(self.backbone(rgb), zero)))

    def check(self, rgb: Tensor, zero: Tensor) -> None:
        """Raise `InputError` unless both inputs have the size that the camera states."""
        side = self.camera.fpv_px
        for name, images, channels in (("rgb", rgb, 3), ("zero", zero, zero.shape[1] if zero.dim() == 4 else "K")):
            if tuple(images.shape) != (len(rgb), channels, side, side):
                raise InputError(
                    f"{name}: expected ({len(rgb)}, {channels}, {side}, {side}), found {tuple(images.shape)}"
                )
