"""Common base of all networks: configuration, checkpoint, and output.

A checkpoint holds the class of a network, its camera, its `ModelConfig` and its weights, and needs nothing else.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from zerobev.common.errors import InputError
from zerobev.common.storage import replacing
from zerobev.config import AUX, CameraConfig, ModelConfig
from zerobev.geometry.projection import cells_of_pixels, pooled_in_cells
from zerobev.models.backbone import RgbEncoder

#: Maximum number of zero-shot images per forward pass; larger batches still pass whole.
IMAGES_PER_PASS = 16

#: Features of B images: tensors whose first axis is B. Their meaning belongs to the network's class.
Features = tuple[Tensor, ...]


class MapLogits(NamedTuple):
    """Output of a network, before the FOV mask."""

    zero_logits: Tensor  #: (B, K, M, M): one map per zero-shot image or per class
    aux_logits: Tensor | None  #: (B, len(aux), M, M); None without auxiliary output
    pooled: Tensor | None = None  #: (B, K, M, M) in [0, 1]: maps before the U-Net; only of `MaxPoolZeroBEV`


class BevModel(nn.Module):
    """A network with its configuration.

    Networks that predict maps are called as `model(rgb, zero, depth)` and return a `MapLogits`. Inputs, not all used by
    every network: rgb (B, 3, H, W) in [0, 1], zero (B, K, H, W), depth (B, 1 or 2, H, W), all float32. The first
    channel of depth is in metres. The second, used with `ModelConfig.measured`, is 1 where a sensor measured, and 0
    where depth is estimated or unknown; without it, nothing is measured. Zero-shot networks also take `height_m` (B,),
    the heights of the cameras of stretched images (`CameraConfig.at_height`).

    Raises `InputError` for unknown auxiliary maps.
    """

    backbone: RgbEncoder

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__()
        if tuple(name for name in AUX if name in model.aux) != tuple(model.aux):
            raise InputError(f"aux: expected maps among {AUX}, in this order, found {model.aux}")
        self.camera, self.config = camera, model

    def check(self, batch: int = 0, **images: tuple[Tensor | None, int | None]) -> int:
        """Check images against the camera's size and their numbers of channels (None: any); returns the batch size.

        batch: expected size; 0: that of the first image
        Raises `InputError` for the first image of another shape.
        """
        side = self.camera.fpv_px
        for name, (image, channels) in images.items():
            found = None if image is None else tuple(image.shape)
            if found is not None and len(found) == 4:
                batch, channels = (batch or found[0]), (channels or found[1])
            if image is not None and not image.is_floating_point():
                raise InputError(f"{name}: expected floating point, found {image.dtype}")
            if found is None or found != (batch, channels, side, side):
                expected = f"({batch or 'B'}, {channels or 'K'}, {side}, {side})"
                raise InputError(f"{name}: expected {expected}, found {found}")
        return batch

    def save(self, path: Path) -> None:
        """Write one safetensors file: the weights, with class and configuration as JSON in its metadata."""
        described = {"class": type(self).__name__, "camera": asdict(self.camera), "model": asdict(self.config)}
        tensors = {name: tensor.contiguous() for name, tensor in self.state_dict().items()}
        with replacing(path) as temporary:
            save_file(tensors, temporary, metadata={"zerobev": json.dumps(described, sort_keys=True)})

    def load_common(self, path: Path) -> None:
        """Replace the weights that the checkpoint `path` has with the same name and shape.

        Raises `InputError` if the file cannot be read, or has no such weight.
        """
        description(path)
        own = self.state_dict()
        common = {name: t for name, t in load_file(path).items() if name in own and own[name].shape == t.shape}
        if not common:
            raise InputError(f"{path}: expected weights of {type(self).__name__}, found none of its names and shapes")
        self.load_state_dict(common, strict=False)

    @classmethod
    def load(cls, path: Path) -> Self:
        """The network saved in `path`, on the CPU, in evaluation mode.

        Raises `InputError` if the file cannot be read, is not a checkpoint of this class, or does not hold exactly the
        weights of its configuration.
        """
        described = description(path)
        if described["class"] != cls.__name__:
            raise InputError(f"{path}: expected a checkpoint of {cls.__name__}, found one of {described['class']}")
        try:
            camera = CameraConfig(**described["camera"])
            fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in described["model"].items()}
            network = cls(camera, ModelConfig(**fields))
        except Exception as error:  # impossible sizes raise many kinds of error in the layers
            found = f"{type(error).__name__}: {error}"
            raise InputError(f"{path}: expected the network's configuration in the metadata, found: {found}") from error
        try:
            network.load_state_dict(load_file(path))
        except RuntimeError as error:
            found = " ".join(str(error).split())
            raise InputError(f"{path}: expected the weights of its configuration, found: {found}") from error
        return network.eval()


class ZeroShotModel(BevModel):
    """A network that projects any zero-shot image: `decode(encode(rgb, depth), zero)`.

    `encode` computes all that does not depend on the zero-shot images. Its result serves any number of calls of
    `decode`, for B images at once; `features[b : b + 1]` of each tensor are those of one image.
    """

    def forward(
        self, rgb: Tensor, zero: Tensor, depth: Tensor | None = None, height_m: Tensor | None = None
    ) -> MapLogits:
        """RGB (B, 3, H, W) in [0, 1], zero-shot images (B, K, H, W) in [0, 1], all float32 -> `MapLogits`.

        depth: (B, 1 or 2, H, W) metres, true or estimated, 0 for unknown; used only in the residual variant
        height_m: (B,) of the cameras, for the limit on heights of P^-1; default: `camera.height_m`
        """
        self.check(rgb=(rgb, 3), zero=(zero, None))
        return self.decode(self.encode(rgb, depth, height_m), zero)

    def encode(self, rgb: Tensor, depth: Tensor | None = None, height_m: Tensor | None = None) -> Features:
        """All features of B RGB images, for `decode`; arguments as of the call.

        Raises `InputError` for images of another shape or type, and in the residual variant for missing depth.
        """
        batch = self.check(rgb=(rgb, 3))
        if not self.config.residual:
            return self.image_features(rgb)
        masked = depth is not None and depth.ndim == 4 and depth.shape[1] == 2
        self.check(batch, depth=(depth, 2 if masked else 1))
        assert depth is not None  # as checked
        cells = cells_of_pixels(depth[:, 0], self.camera, height_m)
        images = [torch.ones_like(rgb[:, :1])] if self.config.seen else []
        if self.config.measured:
            images.append(depth[:, 1:].to(rgb.dtype) if masked else torch.zeros_like(rgb[:, :1]))
        maps = [pooled_in_cells(image, cells, self.camera.bev_px) for image in images]
        return cells, *maps, *self.image_features(rgb)

    def decode(self, features: Features, zero: Tensor) -> MapLogits:
        """Zero-shot images (B, K, H, W) of the images of `encode` -> `MapLogits`.

        Raises `InputError` for images of another shape or type.
        """
        self.check(features[0].shape[0], zero=(zero, None))
        if not self.config.residual:
            return self.project_images(features, zero, None)
        of_depth = projected_maps(self.config)
        (cells, *of_view), rest = features[:of_depth], features[of_depth:]
        projected = pooled_in_cells(zero, cells, self.camera.bev_px)
        maps = [projected, *(one.expand_as(projected) for one in of_view)]
        return self.project_images(rest, zero, torch.stack(maps, dim=2))

    def image_features(self, rgb: Tensor) -> Features:
        """The features of the RGB images, of at least one tensor, apart from those of depth."""
        raise NotImplementedError

    def project_images(self, features: Features, zero: Tensor, projected: Tensor | None) -> MapLogits:
        """As `decode`, from `image_features`.

        projected: (B, K, P, M, M), P^-1 of the zero-shot images, with `ModelConfig.seen` of the whole view, and with
            `measured` of its measured pixels; None: not the residual variant
        """
        raise NotImplementedError


def projected_maps(model: ModelConfig) -> int:
    """Number of maps by P^-1 that a residual network reads per zero-shot image."""
    return 1 + model.seen + model.measured


def in_passes(images: Tensor, size: int, dim: int = 0) -> Sequence[Tensor]:
    """Parts of at most `size` images along an axis; of an exported graph one part, whatever the number of images."""
    return (images,) if torch.compiler.is_exporting() else images.split(size, dim)


def description(path: Path) -> dict[str, Any]:
    """Metadata of a checkpoint: `class` (its name), `camera` and `model` (fields and values).

    Raises `InputError` if the file cannot be read or has no such metadata.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: expected a safetensors checkpoint, found: {error}") from error
    try:
        described = json.loads(metadata["zerobev"])
        return {name: described[name] for name in ("class", "camera", "model")}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected the network's configuration in the metadata, found: {error!r}") from error
