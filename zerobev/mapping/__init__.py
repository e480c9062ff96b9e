"""A map of a home, fused from the maps of a walk through it."""

from zerobev.mapping.home_map import HomeMap
from zerobev.mapping.pose import Pose2D

__all__ = ["HomeMap", "Pose2D"]
