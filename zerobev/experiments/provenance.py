"""Origin of a result: revision, versions, device, memory."""

import os
import platform
import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = ("torch", "numpy", "transformers", "accelerate", "embreex", "pyrender", "scikit-image")


def git_revision(code: Path = Path(__file__).parents[1]) -> str:
    """The commit of the checkout, with "-dirty" if files below `code` differ; "unknown" if git does not track `code`.

    Other changes do not count: a reproduction writes reports and notebooks.
    """
    commands = ["describe", "--always", "--abbrev=12"], ["status", "--porcelain", "."], ["ls-files", "."]
    try:
        found = [subprocess.run(["git", *c], cwd=code, capture_output=True, text=True, check=False) for c in commands]
    except FileNotFoundError:  # no git
        return "unknown"
    revision, changes, tracked = (ended.stdout.strip() for ended in found)
    if not tracked:  # no repository, or an environment inside another project's repository
        return "unknown"
    return revision + "-dirty" if changes else revision


def origin(device: str, revision: str) -> dict[str, Any]:
    """Revision, Python and library versions, device and number of cores, as plain data."""
    return {
        "revision": revision,
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in _PACKAGES},
        "device": device,
        "cores": os.cpu_count(),
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "none"


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text()) if status.exists() else None
    if found:  # Linux, where `getrusage` includes the parent process's peak
        return round(int(found[1]) / 1024, 1)
    import resource  # Windows has none

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS, else KiB
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)
