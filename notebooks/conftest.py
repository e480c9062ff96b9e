"""Plain `pytest --nbval notebooks/` works from any folder: this environment's kernel, and only this environment's."""

import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from zerobev.report.notebooks import kernel_settings


def pytest_configure(config: pytest.Config) -> None:
    """Let nbval start the kernels of the Python that runs pytest, with the workbook's settings."""
    if config.option.nbval_kernel_name is None:
        config.option.nbval_current_env = True
    os.environ.pop("ZEROBEV_FRESH", None)
    os.environ.update(kernel_settings())
