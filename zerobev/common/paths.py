"""Folders of data, caches and reports: those of the checkout, or a folder of the user if the package is installed."""

import os
from pathlib import Path

from zerobev.common.errors import InputError

#: The folder that holds the package: a checkout, or the site-packages of an environment.
PACKAGE_PARENT = Path(__file__).resolve().parents[2]
_CHECKOUT = ("pyproject.toml", "Makefile", "notebooks")


def checkout() -> Path | None:
    """The project's folder that holds the package; None for an installed package."""
    return PACKAGE_PARENT if all((PACKAGE_PARENT / name).exists() for name in _CHECKOUT) else None


def zerobev_home() -> Path:
    """The folder of `.cache` and `reports`, an absolute path; it may not exist yet.

    In this order: the environment variable `ZEROBEV_HOME`; the checkout that holds the package; the working folder.
    Raises `InputError` where `ZEROBEV_HOME` is a file.
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
