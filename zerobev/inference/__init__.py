"""Projection of any modality of a photograph: masks, labels, probabilities, boxes, flow."""

from zerobev.geometry.cameras import Camera
from zerobev.inference.bev_map import BevArrows, BevMap
from zerobev.inference.boxes import Boxes
from zerobev.inference.detector import HubDetector
from zerobev.inference.flow import Flow
from zerobev.inference.image_view import ImageView
from zerobev.inference.labels import Labels
from zerobev.inference.masks import Masks
from zerobev.inference.modality import Modality
from zerobev.inference.probabilities import Probabilities
from zerobev.inference.projector import Projector, load
from zerobev.inference.reader import read_image, read_labels, read_mask

__all__ = [
    "BevArrows",
    "BevMap",
    "Boxes",
    "Camera",
    "Flow",
    "HubDetector",
    "ImageView",
    "Labels",
    "Masks",
    "Modality",
    "Probabilities",
    "Projector",
    "load",
    "read_image",
    "read_labels",
    "read_mask",
]
