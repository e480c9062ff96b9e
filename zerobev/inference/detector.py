"""Object detectors of the `transformers` library."""

from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
import torch

from zerobev.common.errors import InputError, first_line
from zerobev.inference.boxes import Boxes

if TYPE_CHECKING:
    from transformers import BaseImageProcessor, PreTrainedModel


class HubDetector:
    """A detector with its image processor (DETR, YOLOS, RT-DETR, ...)."""

    def __init__(self, network: "PreTrainedModel", processor: "BaseImageProcessor", source: str) -> None:
        self._network, self._processor, self._source = network.eval(), processor, source

    @classmethod
    def from_pretrained(cls, source: str | Path) -> Self:
        """The detector in a folder or under a name on the Hugging Face hub.

        Raises `InputError` if there is none, or if weights or the image processor are missing.
        """
        from transformers import AutoImageProcessor, AutoModelForObjectDetection  # slow to import

        try:
            network, report = AutoModelForObjectDetection.from_pretrained(str(source), output_loading_info=True)
            processor = AutoImageProcessor.from_pretrained(str(source))
        except (OSError, ValueError, RuntimeError, ImportError) as error:
            found = first_line(error)
            raise InputError(f"{source}: expected an object detector of transformers, found: {found}") from error
        if report["missing_keys"]:
            raise InputError(f"{source}: expected the weight {min(report['missing_keys'])}, found none of this name")
        return cls(network, processor, str(source))

    @torch.inference_mode()
    def detect(self, rgb: np.ndarray, min_score: float = 0.5) -> Boxes:
        """The objects in a photograph (H, W, 3) uint8 with a score above `min_score`."""
        inputs = self._processor(images=rgb, return_tensors="pt")
        outputs = self._network(**inputs)
        (found,) = self._processor.post_process_object_detection(outputs, min_score, [rgb.shape[:2]])
        names = self._network.config.id2label
        labels = tuple(names.get(int(label), str(int(label))) for label in found["labels"])
        corners = found["boxes"].double().numpy()
        return Boxes(corners, labels, found["scores"].double().numpy(), self._source)
