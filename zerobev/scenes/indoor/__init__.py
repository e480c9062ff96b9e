"""Procedural homes in place of HM3DSem: furnished, annotated, with baked light and a UV atlas of 1 cm texels."""

from zerobev.scenes.indoor.home import generate_home

__all__ = ["generate_home"]
