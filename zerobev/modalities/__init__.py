"""What people want on a map: masks, labels, values, boxes, flow; each becomes binary images, and maps come back."""

from zerobev.modalities.bev_map import BevArrows, BevMap
from zerobev.modalities.boxes import Boxes
from zerobev.modalities.detector import HubDetector
from zerobev.modalities.flow import Flow
from zerobev.modalities.projector import Projector, load

__all__ = ["BevArrows", "BevMap", "Boxes", "Flow", "HubDetector", "Projector", "load"]
