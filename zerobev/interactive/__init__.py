"""Projection by hand, in JupyterLab: `zerobev.playground()`."""

from zerobev.interactive.widget import Playground, playground

__all__ = ["Playground", "playground"]
