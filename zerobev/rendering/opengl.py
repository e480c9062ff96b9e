"""pyrender, imported after its environment is set, and the process's only OpenGL context."""

import atexit
import functools
import os
from typing import Any

import numpy as np

from zerobev.common.errors import SetupError

# pyrender selects its platform at import; the default needs a window; a value set by the user has priority
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
# pyrender imports pyglet for its viewer, and pyglet fails if X11 is partly installed
os.environ.setdefault("PYGLET_HEADLESS", "true")
# pyrender 0.1.45 uses a name that NumPy 2 removed
if not hasattr(np, "infty"):
    vars(np)["infty"] = np.inf

#: Platform -> required Debian packages.
_PACKAGES = {"egl": "libegl1 libgl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}


def _setup_error(error: Exception) -> SetupError:
    """One line: the missing part, and the remedy for the selected platform."""
    platform, device = os.environ["PYOPENGL_PLATFORM"], os.environ.get("EGL_DEVICE_ID")
    expected = f"PYOPENGL_PLATFORM: expected {' or '.join(_PACKAGES)}, and OpenGL that works"
    if platform not in _PACKAGES:
        return SetupError(f"{expected}, found {platform!r}")
    found = f"{platform} with {type(error).__name__}: {' '.join(str(error).split())}"
    remedy = f"install {_PACKAGES[platform]} (Debian's packages)"
    if platform == "egl" and device is not None:
        remedy = f"set EGL_DEVICE_ID to an existing device, or to none (found {device!r}), or {remedy}"
    if platform == "osmesa":
        remedy += ", or set PYOPENGL_PLATFORM=egl"
    return SetupError(f"{expected}, found {found}; {remedy}")


class _Missing:
    """Replaces pyrender if its import fails: any use raises the `SetupError`."""

    def __init__(self, error: Exception) -> None:
        self._error = error

    def __getattr__(self, name: str) -> Any:
        raise _setup_error(self._error)


try:
    from OpenGL.plugins import FormatHandler

    # PyOpenGL 3.1.0, which pyrender requires, has the name of C references before Python 3.12
    FormatHandler("ctypesparameter", "OpenGL.arrays.ctypesparameters.CtypesParameterHandler", ["_ctypes.CArgObject"])

    import pyrender
except Exception as error:  # PyOpenGL raises ImportError, AttributeError, OSError, ... if a library is missing
    pyrender = _Missing(error)


@functools.cache
def renderer() -> "pyrender.OffscreenRenderer":
    """The process's only renderer: if there were several, closing one would break the others.

    Raises `SetupError`, with the remedy, if no OpenGL context can be created.
    """
    try:
        made = pyrender.OffscreenRenderer(1, 1)
        from zerobev.rendering.shaders import SurfaceRenderer  # imports pyrender, which may be missing

        made._renderer = SurfaceRenderer(1, 1)
    except SetupError:
        raise
    except Exception as error:  # pyrender, PyOpenGL and ctypes raise many kinds of error
        raise _setup_error(error) from error
    atexit.register(made.delete)
    return made


__all__ = ["pyrender", "renderer"]
