"""The trained networks, ready for use: `zerobev.load().project(rgb, modality)`."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.geometry.projection import fov_mask, inverse_project
from zerobev.inference.bev_map import BevArrows, BevMap
from zerobev.inference.boxes import Boxes
from zerobev.inference.flow import Flow
from zerobev.inference.images import BinaryImages, Names, binary_images
from zerobev.inference.pinhole import PinholeView
from zerobev.inference.shipped_weights import DEPTH, ROWS, shipped
from zerobev.models import TIM, VPN, BevModel, load_model
from zerobev.models.depth import DepthEstimator, DepthNet

#: The row that is not trained: P^-1 with estimated depth.
GEOMETRIC = "a.2"
#: Binary images that one call takes; a network holds the features of all of them at once.
MAX_IMAGES = 2048


@dataclass(frozen=True, eq=False)
class Projector:
    """A network, or P^-1, with the depth estimator and the camera it belongs to."""

    row: str  #: of Tables 1 and 2, or the file that it comes from
    camera: CameraConfig
    network: BevModel | None  #: None: P^-1 (row (a.2))
    estimator: DepthEstimator

    def project(
        self, rgb: np.ndarray, modality: Any, hfov_deg: float = 79.0, names: Names = None
    ) -> BevMap | BevArrows:
        """Project what is known in a photograph to the map of the 5 m in front of its camera.

        rgb: (H, W, 3) uint8, or floating point in [0, 1], of any size
        modality: of the same size, one of
            - bool (H, W) or (K, H, W): masks
            - integers (H, W): a label map; every label from 0 up becomes a map, with one pass of RGB features
            - floating point (H, W) or (K, H, W) in [0, 1]: real values, see `zerobev.inference.images`
            - `Boxes`: one map a detection, with its label and score
            - `Flow`, or floating point (H, W, 2), pixels right and down: arrows
        hfov_deg: the photograph's horizontal field of view; its pixels are square
        names: of masks or of labels; default: their numbers

        The network's camera is level, 0.88 m above the floor, and sees 79 degrees; a photograph is resampled to it. Of
        that view, what the photograph does not cover goes on with the colours at its border, masks are empty there, and
        the map ends; what lies outside is cut off.
        A photograph taken from another height, or tilted, gives maps that are off by as much as that moves the floor in
        the image. Maps of empty masks are empty.

        Returns a `BevMap`, or `BevArrows` for flow. Raises `InputError` for wrong shapes, types or ranges, NaN, input
        that is empty, and more than `MAX_IMAGES` binary images (real values are eight each).
        """
        photograph = checked_image(rgb)
        shape = photograph.shape[:2]
        if not isinstance(modality, Boxes | Flow):
            modality = _array(modality, "modality")
            if modality.shape == (*shape, 2):
                modality = Flow.of(modality)
        if isinstance(modality, Flow):
            after = photograph if modality.after is None else checked_image(modality.after)
            if after.shape != photograph.shape:
                raise InputError(f"after: expected the first frame's shape {photograph.shape}, found {after.shape}")
            starts, ends = modality.discs(shape)
            return BevArrows(self._maps(photograph, starts, hfov_deg), self._maps(after, ends, hfov_deg))
        images = modality.images(shape) if isinstance(modality, Boxes) else binary_images(modality, shape, names)
        return self._maps(photograph, images, hfov_deg)

    def depth(self, rgb: np.ndarray, hfov_deg: float = 79.0) -> np.ndarray:
        """Estimated planar depth in the network's camera, (S, S) float32, metres; 0 where nothing is covered."""
        photograph = checked_image(rgb)
        view = PinholeView(photograph.shape[:2], hfov_deg, self.camera)
        with torch.inference_mode():
            return self._depth(_batch(view.photograph(photograph)), view)[0, 0].numpy()

    def _depth(self, rgb: Tensor, view: PinholeView) -> Tensor:
        return self.estimator(rgb) * torch.from_numpy(view.covered)

    @torch.inference_mode()
    def _maps(self, photograph: np.ndarray, images: BinaryImages, hfov_deg: float) -> BevMap:
        view = PinholeView(photograph.shape[:2], hfov_deg, self.camera)
        if (count := len(images.labels) * images.levels) > MAX_IMAGES:
            raise InputError(f"modality: expected {MAX_IMAGES} binary images at most, found {count}")
        zero = torch.from_numpy(np.stack([view.mask(image) for image in images.images])).float()
        rgb = _batch(view.photograph(photograph))
        depth = self._depth(rgb, view)
        maps = torch.zeros(2, len(zero), self.camera.bev_px, self.camera.bev_px)  # values and evidence
        filled = zero.flatten(1).any(dim=1)
        if filled.any():
            maps[:, filled] = torch.stack(self._values_and_evidence(rgb, zero[filled], depth))
        values, evidence = maps.unflatten(1, (-1, images.levels)).mean(dim=2).numpy()
        fov = fov_mask(depth[0, 0].numpy(), self.camera)
        return BevMap(values, images.labels, evidence, fov, self.camera, images.scores)

    def _values_and_evidence(self, rgb: Tensor, zero: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Images (K, S, S) of one photograph -> (K, M, M) probabilities, and the rise of logits over an empty image."""
        if self.network is None:
            values = inverse_project(zero[None], depth, self.camera)[0]
            return values, values
        with_empty = torch.cat([zero, torch.zeros_like(zero[:1])])[None]
        logits = self.network(rgb, with_empty, depth).zero_logits[0]
        return logits[:-1].sigmoid(), (logits[:-1] - logits[-1]).clamp(min=0)

    def predict(self, batch: Mapping[str, Tensor]) -> Tensor:
        """A batch of `data.samples` -> maps (B, K, M, M) bool, as `evaluation.evaluate` takes them.

        Depth is estimated; the batch's own, which is true, is not read.
        """
        depth = self.estimator(batch["rgb"])
        if self.network is None:
            return inverse_project(batch["zero"], depth, self.camera) > 0.5
        return self.network(batch["rgb"], batch["zero"], depth).zero_logits > 0


def load(source: str | Path = ROWS[-1], estimator: DepthEstimator | None = None) -> Projector:
    """A projector, from weights that ship with the package or from a checkpoint of your own.

    source: a shipped row (`shipped_weights.ROWS`), "a.2" for the projection P^-1, or the path of a checkpoint
    estimator: of metric depth, for the field of view, P^-1 and residual networks; default: the one that ships
    Raises `InputError` for an unknown row, a file that is no network for zero-shot projection, and where the shipped
    depth estimator does not fit the network's camera.
    """
    depth = DepthNet.load(shipped(DEPTH)) if estimator is None else estimator
    if source == GEOMETRIC:
        return Projector(GEOMETRIC, DepthNet.load(shipped(DEPTH)).camera, None, depth)
    network = load_model(shipped(str(source)) if source in ROWS else _existing(source))
    if isinstance(network, VPN | TIM | DepthNet):
        raise InputError(f"{source}: expected a zero-shot network, found {type(network).__name__}")
    if isinstance(depth, DepthNet) and depth.camera.fpv_px != network.camera.fpv_px:
        sides = f"{network.camera.fpv_px} px, found one for {depth.camera.fpv_px} px"
        raise InputError(f"estimator: expected a depth estimator for images of {sides}")
    return Projector(str(source), network.camera, network, depth)


def checked_image(rgb: Any) -> np.ndarray:
    """(H, W, 3) uint8, or floating point in [0, 1] -> float32 in [0, 1]; all else is an `InputError`."""
    array = _array(rgb, "rgb")
    if array.ndim != 3 or array.shape[-1] != 3 or not array.size:
        raise InputError(f"rgb: expected (H, W, 3), found {array.shape}")
    if array.dtype == np.uint8:
        return array.astype(np.float32) / 255
    if array.dtype.kind != "f":
        raise InputError(f"rgb: expected uint8 or floating point, found {array.dtype}")
    if not np.isfinite(array).all():
        raise InputError("rgb: expected values in [0, 1], found NaN or infinity")
    if array.min() < 0 or array.max() > 1:
        raise InputError(f"rgb: expected values in [0, 1], found {array.min():g} to {array.max():g}")
    return array.astype(np.float32)


def _array(value: Any, name: str) -> np.ndarray:
    try:
        return np.asarray(value)
    except (ValueError, TypeError, RuntimeError, OverflowError):
        raise InputError(f"{name}: expected an array, found {type(value).__name__} that is none") from None


def _batch(photograph: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(photograph, -1, 0)))[None]


def _existing(source: str | Path) -> Path:
    if not Path(source).is_file():
        rows = ", ".join((GEOMETRIC, *ROWS))
        raise InputError(f"source: expected one of {rows} or the path of a checkpoint, found {str(source)!r}")
    return Path(source)
