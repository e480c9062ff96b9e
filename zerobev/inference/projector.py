"""The trained networks, ready for use: `zerobev.load().project(rgb, modality)`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor, nn

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.data.sensor_depth import completed
from zerobev.geometry.cameras import Camera
from zerobev.geometry.projection import fov_mask, inverse_project
from zerobev.inference.arrays import checked_image
from zerobev.inference.bev_map import BevArrows, BevMap
from zerobev.inference.flow import Flow
from zerobev.inference.measured_depth import MAX_MEDIAN_M, checked_depth
from zerobev.inference.modality import BinaryImages, Modality, Names
from zerobev.inference.pinhole import PinholeView
from zerobev.inference.plain_arrays import kind_of
from zerobev.inference.shipped_weights import DEPTH, ROWS, shipped
from zerobev.models import TIM, VPN, BevModel, load_model
from zerobev.models.decoder import resize
from zerobev.models.depth import DepthEstimator, DepthNet

#: The networks' camera: level, 0.88 m above the floor, 79 degrees.
LEVEL = Camera()
#: The row without a network: P^-1 with estimated depth.
GEOMETRIC = "a.2"
#: Maximum number of binary images per call; the features of all of them are in memory at the same time.
MAX_IMAGES = 2048


@dataclass(frozen=True, eq=False)
class Projector:
    """A network, or P^-1, with its camera and a depth estimator, on the CPU.

    Raises `InputError` for a network or estimator on another device.
    """

    row: str  #: of Tables 1 and 2, or the path of the checkpoint
    camera: CameraConfig
    network: BevModel | None  #: None: P^-1 (row (a.2))
    estimator: DepthEstimator

    def __post_init__(self) -> None:
        for name, module in (("network", self.network), ("estimator", self.estimator)):
            devices = {p.device.type for p in module.parameters()} if isinstance(module, nn.Module) else set()
            if devices - {"cpu"}:
                raise InputError(
                    f"{name}: expected on the CPU, found on {min(devices - {'cpu'})}: move it by .to('cpu')"
                )

    @overload
    def project(
        self, rgb: Any, modality: Flow, camera: Camera = ..., depth: None = ..., names: None = ...
    ) -> BevArrows: ...

    @overload
    def project(
        self, rgb: Any, modality: Any, camera: Camera = ..., depth: Any = ..., names: Names = ...
    ) -> BevMap: ...

    def project(
        self, rgb: Any, modality: Any, camera: Camera = LEVEL, depth: Any = None, names: Names = None
    ) -> BevMap | BevArrows:
        """Project a modality of a photograph to the map of the 5 m in front of its camera.

        rgb: (H, W, 3) uint8, or floating point in [0, 1], of any size up to `reader.MAX_MEGAPIXELS`; or an image file
            (path, bytes, open file, PIL image), see `zerobev.inference.reader`
        modality: of the same size, one of
            - `Masks`, `Labels`, `Probabilities`: one map per mask, label, image
            - `Boxes`: one map per detection, with its label and score
            - `Flow`: arrows
            - another `Modality`
            - an array of an unambiguous kind: bool (H, W) or (K, H, W) masks; integers (H, W) labels; floating point
              (H, W) or (K, H, W) probabilities. See `plain_arrays.kind_of` for ambiguous arrays.
        camera: of the photograph; the map is that of the level camera at its place and heading
        depth: (H, W) floating point, planar depth of each pixel from a sensor, metres; 0 or NaN for no value. Estimated
            depth, scaled to the sensor's, replaces missing values. Used by P^-1, by residual networks, and for the
            field of view; not possible for `Flow`, which has two photographs
        names: of the masks, labels or images of an array; default: the numbers

        The network's camera is level, 0.88 m above the floor, with a field of view of 79 degrees. Photographs are
        resampled to this view, see `zerobev.inference.pinhole`: parts outside of it are cropped. Parts of the view
        without photograph get the colours at its border, have empty masks, and are outside the map's field of view.
        Maps of empty masks are empty.

        Returns a `BevArrows` for `Flow`, else a `BevMap`. Raises `InputError` for wrong shapes, types or ranges, NaN,
        empty input, ambiguous arrays, and more than `MAX_IMAGES` binary images (eight per image of real values).
        """
        photograph = checked_image(rgb)
        shape = photograph.shape[:2]
        kind = _kind(modality, shape, names)
        layers = kind.layers(shape)
        if depth is not None and any(layer.photograph is not None for layer in layers):
            raise InputError(f"depth: expected none for {type(kind).__name__}, found depth of one of two photographs")
        measured = None if depth is None else checked_depth(depth, shape)
        frames = (photograph if layer.photograph is None else layer.photograph for layer in layers)
        return kind.result(tuple(self._maps(frame, layer, camera, measured) for frame, layer in zip(frames, layers)))

    def depth(self, rgb: Any, camera: Camera = LEVEL, depth: Any = None) -> np.ndarray:
        """Planar depth in the network's camera, (S, S) float32, metres; 0 outside the photograph.

        depth: of a sensor, see `project`; without it, all depth is estimated
        """
        photograph = checked_image(rgb)
        measured = None if depth is None else checked_depth(depth, photograph.shape[:2])
        view = PinholeView(photograph.shape[:2], camera, self.camera)
        with torch.inference_mode():
            return self._depth(photograph, camera, view, measured)[0, 0].numpy()

    def _depth(self, photograph: np.ndarray, source: Camera, view: PinholeView, measured: np.ndarray | None) -> Tensor:
        """(1, 1, S, S) metres: measured, and estimated where no value was measured."""
        covered = torch.from_numpy(view.covered)
        if measured is None:
            return self._estimated(photograph, source, view) * covered
        known = view.depth(measured)
        if not (known > 0)[view.covered].all():
            known = completed(known, self._estimated(photograph, source, view)[0, 0].numpy())
        return torch.from_numpy(known)[None, None] * covered

    def _estimated(self, photograph: np.ndarray, source: Camera, view: PinholeView) -> Tensor:
        """(1, 1, S, S) metres; the estimator's input has its `side_px`, if it has one."""
        side = self.camera.fpv_px
        # at most the resolution of the photograph, which the estimator enlarges smoothly
        input_px = min(getattr(self.estimator, "side_px", side), view.resolution_px)
        if input_px > side:
            fine_view = PinholeView(photograph.shape[:2], source, replace(self.camera, fpv_px=input_px))
        else:
            fine_view = view
        depth = _checked_estimate(self.estimator(_batch(fine_view.photograph(photograph))), fine_view.covered.shape)
        return resize(depth, (side, side))

    @torch.inference_mode()
    def _maps(
        self, photograph: np.ndarray, images: BinaryImages, source: Camera, measured: np.ndarray | None
    ) -> BevMap:
        view = PinholeView(photograph.shape[:2], source, self.camera)
        if (count := len(images.labels) * images.levels) > MAX_IMAGES:
            raise InputError(f"modality: expected {MAX_IMAGES} binary images at most, found {count}")
        zero = torch.from_numpy(np.stack([view.mask(image) for image in images.images])).float()
        rgb = _batch(view.photograph(photograph))
        depth = self._depth(photograph, source, view, measured)
        maps = torch.zeros(2, len(zero), self.camera.bev_px, self.camera.bev_px)  # values and evidence
        filled = zero.flatten(1).any(dim=1)
        if filled.any():
            maps[:, filled] = torch.stack(self._values_and_evidence(rgb, zero[filled], depth, source.height_m))
        values, evidence = maps.unflatten(1, (-1, images.levels)).mean(dim=2).numpy()
        fov = fov_mask(depth[0, 0].numpy(), self.camera.at_height(source.height_m))
        return BevMap(values, images.labels, evidence, fov, self.camera, images.scores)

    def _values_and_evidence(self, rgb: Tensor, zero: Tensor, depth: Tensor, height_m: float) -> tuple[Tensor, Tensor]:
        """Images (K, S, S) of one photograph -> (K, M, M) `BevMap.values` and `BevMap.evidence`."""
        heights = torch.tensor([height_m])
        if self.network is None:
            values = inverse_project(zero[None], depth, self.camera, heights)[0]
            return values, values
        with_empty = torch.cat([zero, torch.zeros_like(zero[:1])])[None]
        logits = self.network(rgb, with_empty, depth, heights).zero_logits[0]
        return logits[:-1].sigmoid(), (logits[:-1] - logits[-1]).clamp(min=0)

    def predict(self, batch: Mapping[str, Tensor]) -> Tensor:
        """A batch of `data.samples` -> maps (B, K, M, M) bool, for `evaluation.evaluate`; with estimated depth."""
        depth, heights = self.estimator(batch["rgb"]), batch.get("height")
        if self.network is None:
            return inverse_project(batch["zero"], depth, self.camera, heights) > 0.5
        return self.network(batch["rgb"], batch["zero"], depth, heights).zero_logits > 0


def load(source: str | Path = ROWS[-1], estimator: DepthEstimator | None = None) -> Projector:
    """A projector with shipped weights, or from your checkpoint.

    source: a shipped row (`shipped_weights.ROWS`), "a.2" for the projection P^-1, or the path of a checkpoint
    estimator: of metric depth, for the field of view, P^-1 and residual networks; default: the shipped one
    Raises `InputError` for an unknown row, for a file other than a zero-shot network, and if the shipped depth
    estimator does not fit the network's camera.
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


def _kind(modality: Any, shape: tuple[int, int], names: Names) -> Modality[Any]:
    if not isinstance(modality, Modality):
        return kind_of(modality, shape, names)
    if names is None:
        return modality
    if getattr(modality, "names", ()) is not None:
        raise InputError(f"names: expected none for {type(modality).__name__}, which contains its names")
    return replace(modality, names=names)  # type: ignore[type-var]  # a dataclass with a field of this name


def _checked_estimate(depth: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Output of an estimator, (1, 1, S, S). Raises `InputError` if it cannot be metres."""
    expected = (1, 1, *shape)
    if tuple(depth.shape) != expected:
        raise InputError(f"estimator: expected depth {expected}, found {tuple(depth.shape)}")
    if not (torch.isfinite(depth).all() and (depth >= 0).all()):
        raise InputError("estimator: expected finite depth from 0 up, found NaN, infinity or less")
    if (median := float(depth.median())) > MAX_MEDIAN_M:
        raise InputError(f"estimator: expected depth in metres, found a median of {median:g}: millimetres?")
    return depth


def _batch(photograph: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(photograph, -1, 0)))[None]


def _existing(source: str | Path) -> Path:
    if not Path(source).is_file():
        rows = ", ".join((GEOMETRIC, *ROWS))
        raise InputError(f"source: expected one of {rows} or the path of a checkpoint, found {str(source)!r}")
    return Path(source)
