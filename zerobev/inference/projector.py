"""The trained networks, ready for use: `zerobev.load().project(rgb, modality)`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Self, overload

import numpy as np
import torch
from torch import Tensor

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.geometry.cameras import Camera
from zerobev.geometry.projection import inverse_project
from zerobev.inference.arrays import checked_image
from zerobev.inference.bev_map import BevArrows, BevMap
from zerobev.inference.image_depth import image_depths
from zerobev.inference.image_view import ImageView, image_views, kind_for, layers_of, project_layers
from zerobev.inference.measured_depth import checked_depth
from zerobev.inference.modality import Modality, Names, Result
from zerobev.inference.pinhole import PinholeView
from zerobev.inference.placement import placed, placement
from zerobev.inference.pretrained import Parts, load_parts, save_parts
from zerobev.inference.shipped_weights import ROWS
from zerobev.models.base import ZeroShotModel
from zerobev.models.depth import DepthEstimator, estimate

#: The networks' camera: level, 0.88 m above the floor, 79 degrees.
LEVEL = Camera()


@dataclass(frozen=True, eq=False)
class Projector:
    """A network, or P^-1, with its camera and a depth estimator.

    It is never changed, so several threads may use it at the same time. Networks compute where and in the precision in
    which their parameters are, see `to`; images and results are on the CPU.
    """

    row: str  #: of Tables 1 and 2, or the path of the checkpoint
    camera: CameraConfig
    network: ZeroShotModel | None  #: None: P^-1 (row (a.2))
    estimator: DepthEstimator

    @classmethod
    def from_pretrained(cls, source: str | Path, estimator: DepthEstimator | None = None) -> Self:
        """The projector in a folder of `save_pretrained`, in such a repository of the Hugging Face hub, or shipped.

        source: a folder, a repository "OWNER/NAME", or a name as of `zerobev.load`
        estimator: of depth, in place of the folder's
        Raises `InputError` if there is none, and as `zerobev.load`.
        """
        return cls._of(load_parts(source, estimator, hub=True))

    @classmethod
    def _of(cls, parts: Parts) -> Self:
        return cls(parts.row, parts.camera, parts.network, parts.estimator)

    def save_pretrained(self, folder: str | Path) -> None:
        """Write `config.json`, `model.safetensors` (of networks) and `depth.safetensors` for `from_pretrained`.

        Raises `InputError` for a depth model of another library, which has files of its own, and for a folder that
        cannot be written.
        """
        save_parts(Path(folder), Parts(Path(self.row).name, self.camera, self.network, self.estimator))

    @property
    def device(self) -> torch.device:
        """Of the network; of the depth estimator for P^-1."""
        return self._placement[0]

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the network; of the depth estimator for P^-1."""
        return self._placement[1]

    @property
    def _placement(self) -> tuple[torch.device, torch.dtype]:
        return placement(self.estimator if self.network is None else self.network)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """A copy of this projector on another device or in another precision; None: unchanged.

        dtype: torch.float32, torch.bfloat16 or torch.float16, of network and depth estimator. Depth, logits and results
            are float32 in any case.
        A depth estimator that is no torch module stays as it is: its input is then on the CPU, in float32.
        Raises `InputError` for another type, and for a device that torch cannot use here.
        """
        network, estimator = placed(self.network, device, dtype), placed(self.estimator, device, dtype)
        return replace(self, network=network, estimator=estimator)

    def view(self, rgb: Any, camera: Camera = LEVEL, depth: Any = None) -> ImageView:
        """A photograph with all that depends on it alone: features, depth, field of view. Arguments as of `project`.

        `view.project(modality)` then costs a fraction of `project(rgb, modality)`, with the same result.
        """
        return self._views([rgb], camera, [depth])[0]

    def _views(self, images: Sequence[Any], camera: Camera, depths: Sequence[Any]) -> list[ImageView]:
        photographs = [checked_image(image) for image in images]
        measured = [_measured(depth, photograph) for depth, photograph in zip(depths, photographs)]
        return image_views(self, photographs, camera, measured)

    @overload
    def project(
        self, rgb: Any, modality: Modality[Result], camera: Camera = ..., depth: Any = ..., names: Names = ...
    ) -> Result: ...

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
            field of view; not possible for `Flow` with two photographs
        names: of the masks, labels or images of an array; default: the numbers

        The network's camera is level, 0.88 m above the floor, with a field of view of 79 degrees. Photographs are
        resampled to this view, see `zerobev.inference.pinhole`: parts outside of it are cropped. Parts of the view
        without photograph get the colours at its border, have empty masks, and are outside the map's field of view.
        Maps of empty masks are empty. For several modalities of one photograph see `view`.

        Returns a `BevArrows` for `Flow`, else a `BevMap`. Raises `InputError` for wrong shapes, types or ranges, NaN,
        empty input, ambiguous arrays, and more than `MAX_IMAGES` binary images (eight per image of real values).
        """
        return self.view(rgb, camera, depth).project(modality, names)

    @overload
    def project_batch(
        self, images: Sequence[Any], modalities: Sequence[Modality[Result]], camera: Camera = ...
    ) -> list[Result]: ...

    @overload
    def project_batch(
        self, images: Sequence[Any], modalities: Sequence[Any], camera: Camera = ...
    ) -> list[BevMap | BevArrows]: ...

    def project_batch(self, images: Sequence[Any], modalities: Sequence[Any], camera: Camera = LEVEL) -> list[Any]:
        """As `project`, of one modality per photograph, in one call of the network; for GPUs.

        All photographs are of one camera; sizes may differ. Results are in the order of `images`. Modalities should
        have about the same number of binary images: each photograph costs as much as the one with most.
        """
        if len(images) != len(modalities) or not len(images):
            found = f"{len(modalities)} for {len(images)} images"
            raise InputError(f"modalities: expected one per image, and an image at least, found {found}")
        photographs = [checked_image(image) for image in images]
        kinds = [kind_for(modality, one.shape[:2], None) for modality, one in zip(modalities, photographs)]
        layers = [layers_of(kind, one.shape[:2], False) for kind, one in zip(kinds, photographs)]
        flat = [(one, layer) for one, layers_of_one in zip(photographs, layers) for layer in layers_of_one]
        frames = [one if layer.photograph is None else layer.photograph for one, layer in flat]
        views = image_views(self, frames, camera, [None] * len(frames))
        maps = iter(project_layers(list(zip(views, (layer for _, layer in flat)))))
        return [kind.result(tuple(islice(maps, len(layer)))) for kind, layer in zip(kinds, layers)]

    def depth(self, rgb: Any, camera: Camera = LEVEL, depth: Any = None) -> np.ndarray:
        """Planar depth in the network's camera, (S, S) float32, metres; 0 outside the photograph.

        depth: of a sensor, see `project`; without it, all depth is estimated
        """
        photograph = checked_image(rgb)
        view, measured = PinholeView(photograph.shape[:2], camera, self.camera), _measured(depth, photograph)
        with torch.inference_mode():
            return image_depths(self.estimator, [photograph], [view], [measured], camera, self.camera)[0, 0]

    def predict(self, batch: Mapping[str, Tensor]) -> Tensor:
        """A batch of `data.samples` -> maps (B, K, M, M) bool, for `evaluation.evaluate`; with estimated depth."""
        rgb, zero = (batch[name].to(self.device, self.dtype) for name in ("rgb", "zero"))
        heights = batch["height"].to(self.device) if "height" in batch else None
        depth = estimate(self.estimator, batch["rgb"].to(*placement(self.estimator)), heights).float()
        depth = depth.to(self.device)
        if self.network is None:
            return inverse_project(zero, depth, self.camera, heights) > 0.5
        return self.network(rgb, zero, depth, heights).zero_logits > 0


def load(source: str | Path = ROWS[-1], estimator: DepthEstimator | None = None) -> Projector:
    """A projector with shipped weights, or with your own.

    source: a shipped row (`shipped_weights.ROWS`), "a.2" for the projection P^-1, one of their names
        (`pretrained.NAMES`), the path of a checkpoint, or a folder of `Projector.save_pretrained`
    estimator: of metric depth, for the field of view, P^-1 and residual networks; default: the shipped one, or that of
        the folder
    Raises `InputError` for an unknown row, for a file other than a zero-shot network, and if the depth estimator does
    not fit the network's camera.
    """
    return Projector._of(load_parts(source, estimator))


def _measured(depth: Any, photograph: np.ndarray) -> np.ndarray | None:
    return None if depth is None else checked_depth(depth, photograph.shape[:2])
