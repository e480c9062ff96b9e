"""pyrender, imported after what it needs of the environment is set: take it from here."""

import os

import numpy as np

# pyrender chooses its platform on import: without this it looks for a window; a user's own choice stands
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
# it imports pyglet, for a viewer that is not used here, and pyglet fails where only a part of X11 is installed
os.environ.setdefault("PYGLET_HEADLESS", "true")
# pyrender 0.1.45 still asks for the spelling that NumPy 2 removed
if not hasattr(np, "infty"):
    vars(np)["infty"] = np.inf

from OpenGL.plugins import FormatHandler

# PyOpenGL 3.1.0, which pyrender asks for, knows a reference to a C value by the name that it had before Python 3.12
FormatHandler("ctypesparameter", "OpenGL.arrays.ctypesparameters.CtypesParameterHandler", ["_ctypes.CArgObject"])

import pyrender

__all__ = ["pyrender"]
