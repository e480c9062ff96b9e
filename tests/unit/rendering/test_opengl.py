"""Machines without a platform for OpenGL: one line with the remedy."""

import os
import re
import subprocess
import sys

import pytest

from support.paths import ROOT

CALL = """
from zerobev.common.errors import run_command

def main():
    from zerobev.config import CameraConfig
    from zerobev.rendering import rerender
    from zerobev.rendering.photograph import render, pyrender
    render(pyrender.Scene(), 0, 8)

run_command(main)
"""


@pytest.mark.parametrize(
    ("environment", "remedy"),
    [
        ({"__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent"}, "install libegl1 libgl1 libgl1-mesa-dri"),
        ({"EGL_DEVICE_ID": "99"}, "set EGL_DEVICE_ID to an existing device"),
        ({"EGL_DEVICE_ID": "first"}, "set EGL_DEVICE_ID to an existing device"),
        ({"PYOPENGL_PLATFORM": "osmesa"}, "install libosmesa6 .* or set PYOPENGL_PLATFORM=egl"),
        ({"PYOPENGL_PLATFORM": "window"}, "expected egl or osmesa, .* found 'window'"),
    ],
    ids=str,
)
def test_the_remedy_is_named(environment: dict[str, str], remedy: str) -> None:
    call = [sys.executable, "-c", CALL]
    ended = subprocess.run(
        call, capture_output=True, text=True, cwd=ROOT, env={**os.environ, **environment}, check=False
    )
    if ended.returncode == 0:
        pytest.skip("this machine has the platform")
    assert ended.returncode == 1
    assert ended.stderr.count("\n") == 1 and ended.stderr.startswith("error: PYOPENGL_PLATFORM: expected egl or osmesa")
    assert re.search(remedy, ended.stderr)
