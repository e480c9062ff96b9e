"""pyrender, imported after its environment is set, and the one OpenGL context of a process."""

import atexit
import functools
import os
from typing import Any

import numpy as np

from zerobev.common.errors import SetupError

# pyrender chooses its platform on import: without this it looks for a window; a user's own choice stands
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
# it imports pyglet, for a viewer that is not used here, and pyglet fails where only a part of X11 is installed
os.environ.setdefault("PYGLET_HEADLESS", "true")
# pyrender 0.1.45 still asks for the spelling that NumPy 2 removed
if not hasattr(np, "infty"):
    vars(np)["infty"] = np.inf

#: Debian's names of the packages that a platform needs.
_PACKAGES = {"egl": "libegl1 libgl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}


def _setup_error(error: Exception) -> SetupError:
    """One line: what is missing, and the remedy for the platform that is set."""
    platform, device = os.environ["PYOPENGL_PLATFORM"], os.environ.get("EGL_DEVICE_ID")
    expected = f"PYOPENGL_PLATFORM: expected {' or '.join(_PACKAGES)}, and OpenGL that works"
    if platform not in _PACKAGES:
        return SetupError(f"{expected}, found {platform!r}")
    found = f"{platform} with {type(error).__name__}: {' '.join(str(error).split())}"
    remedy = f"install {_PACKAGES[platform]} (Debian's packages)"
    if platform == "egl" and device is not None:
        remedy = f"set EGL_DEVICE_ID to a device that is there, or to none (found {device!r}), or {remedy}"
    if platform == "osmesa":
        remedy += ", or set PYOPENGL_PLATFORM=egl"
    return SetupError(f"{expected}, found {found}; {remedy}")


class _Missing:
    """In place of pyrender where it cannot be imported: any use raises the `SetupError`."""

    def __init__(self, error: Exception) -> None:
        self._error = error

    def __getattr__(self, name: str) -> Any:
        raise _setup_error(self._error)


try:
    from OpenGL.plugins import FormatHandler

    # PyOpenGL 3.1.0, which pyrender asks for, has the name that a reference to a C value had before Python 3.12
    FormatHandler("ctypesparameter", "OpenGL.arrays.ctypesparameters.CtypesParameterHandler", ["_ctypes.CArgObject"])

    import pyrender
except Exception as error:  # without the platform's library, PyOpenGL raises ImportError, AttributeError, OSError, ...
    pyrender = _Missing(error)


@functools.cache
def renderer() -> "pyrender.OffscreenRenderer":
    """The process's one renderer: closing one of several would take the display from the others.

    Raises `SetupError`, with the remedy, where no OpenGL context can be made.
    """
    try:
        made = pyrender.OffscreenRenderer(1, 1)
        from zerobev.rendering.shaders import SurfaceRenderer  # it builds on pyrender, which may be missing

        made._renderer = SurfaceRenderer(1, 1)
    except SetupError:
        raise
    except Exception as error:  # of pyrender, PyOpenGL or ctypes
        raise _setup_error(error) from error
    atexit.register(made.delete)
    return made


__all__ = ["pyrender", "renderer"]
