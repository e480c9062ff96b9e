"""Procedural homes that stand in for HM3DSem: furnished, annotated, with baked light and a 1 cm UV atlas."""

from zerobev.scenes.indoor.home import generate_home

__all__ = ["generate_home"]
