"""Folders of data, caches and reports: in the checkout, or in the user's folder if the package is installed."""

import os
from pathlib import Path

from zerobev.common.errors import InputError

#: Folder of the package: a checkout, or the site-packages of an environment.
PACKAGE_PARENT = Path(__file__).resolve().parents[2]
_CHECKOUT = ("pyproject.toml", "Makefile", "notebooks")


def checkout() -> Path | None:
    """Folder of the project; None for an installed package."""
    return PACKAGE_PARENT if all((PACKAGE_PARENT / name).exists() for name in _CHECKOUT) else None


def zerobev_home() -> Path:
    """Folder of `.cache` and `reports`, an absolute path; it may not exist yet.

    By priority: the environment variable `ZEROBEV_HOME`, the checkout, the working folder.
    Raises `InputError` if `ZEROBEV_HOME` is a file.
    """
    chosen = os.environ.get("ZEROBEV_HOME")
    if chosen:
        folder = Path(chosen).expanduser().resolve()
        if folder.exists() and not folder.is_dir():
            raise InputError(f"ZEROBEV_HOME: expected a folder, found a file at {folder}")
        return folder
    return checkout() or Path.cwd()


def report_name(scale: str, scenes: Path | None) -> str:
    """Name of the folder in `reports/`: the scale's name, or `<scale>-<folder>-scenes` for scenes from a folder."""
    return scale if scenes is None else f"{scale}-{scenes.resolve().name}-scenes"
