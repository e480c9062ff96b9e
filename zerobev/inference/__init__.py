"""What people want on a map: masks, labels, values, boxes, flow; each becomes binary images, and maps come back."""

from zerobev.inference.bev_map import BevArrows, BevMap
from zerobev.inference.boxes import Boxes
from zerobev.inference.detector import HubDetector
from zerobev.inference.flow import Flow
from zerobev.inference.projector import Projector, load

__all__ = ["BevArrows", "BevMap", "Boxes", "Flow", "HubDetector", "Projector", "load"]
