"""The networks: from a photograph and zero-shot images to maps."""

from zerobev.models.zero_bev import BevModel, Projection, ZeroBEV

__all__ = ["BevModel", "Projection", "ZeroBEV"]
