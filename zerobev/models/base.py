"""What every network has in common: its configuration, its checkpoint, and what those that predict maps return.

A network is described wholly by its class, a camera and a `ModelConfig`; a checkpoint holds all three and the weights.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, Self

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from zerobev.common.errors import InputError
from zerobev.common.storage import replacing
from zerobev.config import AUX, CameraConfig, ModelConfig
from zerobev.models.backbone import RgbEncoder

#: Zero-shot images that pass a network together, at most (a batch with more samples passes whole).
IMAGES_PER_PASS = 16


class MapLogits(NamedTuple):
    """What a network predicts, before the FOV mask."""

    zero_logits: Tensor  #: (B, K, M, M): one map a zero-shot image, or one a class
    aux_logits: Tensor | None  #: (B, len(aux), M, M), or None where the network has no auxiliary output
    pooled: Tensor | None = None  #: (B, K, M, M) in [0, 1]: the maps before the U-Net, of a network that has them


class BevModel(nn.Module):
    """A network with its configuration.

    Those that predict maps are called as `model(rgb, zero, depth)` and return a `MapLogits`; each reads what it needs
    of rgb (B, 3, H, W) in [0, 1], zero (B, K, H, W) and depth (B, 1, H, W) in metres, all float32.

    Raises `InputError` for auxiliary maps that do not exist.
    """

    backbone: RgbEncoder  #: every network has one

    def __init__(self, camera: CameraConfig, model: ModelConfig):
        super().__init__()
        if tuple(name for name in AUX if name in model.aux) != tuple(model.aux):
            raise InputError(f"aux: expected maps among {AUX}, in this order, found {model.aux}")
        self.camera, self.config = camera, model

    def check(self, **images: tuple[Tensor | None, int | None]) -> int:
        """The batch size, once every image has the camera's size and its number of channels (None: any number).

        Raises `InputError` that names the first image that does not.
        """
        side, batch = self.camera.fpv_px, 0  # 0: not known yet
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

    def check_inputs(self, rgb: Tensor, zero: Tensor, depth: Tensor | None) -> None:
        """`check` of what a zero-shot network is called with; depth counts in the residual variants alone."""
        read = {"depth": (depth, 1)} if self.config.residual else {}
        self.check(rgb=(rgb, 3), zero=(zero, None), **read)

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
        described = description(path)
        if described["class"] != cls.__name__:
            raise InputError(f"{path}: expected a checkpoint of {cls.__name__}, found one of {described['class']}")
        try:
            camera = CameraConfig(**described["camera"])
            fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in described["model"].items()}
            network = cls(camera, ModelConfig(**fields))
        except Exception as error:  # sizes that are none let every layer fail in its own way
            found = f"{type(error).__name__}: {error}"
            raise InputError(f"{path}: expected the network's configuration in the metadata, found: {found}") from error
        try:
            network.load_state_dict(load_file(path))
        except RuntimeError as error:
            found = " ".join(str(error).split())
            raise InputError(f"{path}: expected the weights of its configuration, found: {found}") from error
        return network.eval()


def description(path: Path) -> dict[str, Any]:
    """What a checkpoint says of its network: `class` (its name), `camera` and `model` (fields and values).

    Raises `InputError` where the file cannot be read or says nothing.
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
