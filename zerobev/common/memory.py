"""The C library's memory allocator."""

import ctypes
import sys
from typing import Any

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  #: glibc's malloc.h
_LARGEST_MMAP_THRESHOLD = 32 * 2**20  #: bytes; glibc before 2.35 refuses more


def keep_freed_memory() -> None:
    """Make glibc keep freed large blocks for reuse; other C libraries are left unchanged.

    Each training step allocates and frees the same large blocks. By default glibc returns them to the system, which
    maps and clears each page again: thousands of page faults per step.
    """
    mallopt = _glibc("mallopt")
    if mallopt and mallopt(_MMAP_THRESHOLD, _LARGEST_MMAP_THRESHOLD):
        mallopt(_TRIM_THRESHOLD, 2**31 - 1)


def return_freed_memory() -> None:
    """Make glibc return freed memory to the system; other C libraries are left unchanged."""
    if trim := _glibc("malloc_trim"):
        trim(0)


def _glibc(name: str) -> Any:
    """A function of glibc; None in other C libraries."""
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
