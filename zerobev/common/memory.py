"""The C library's memory allocator."""

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  #: glibc's malloc.h
_LARGEST_MMAP_THRESHOLD = 32 * 2**20  #: bytes; glibc before 2.35 refuses more


def keep_freed_memory() -> None:
    """Make glibc keep freed large blocks for reuse; other C libraries are left unchanged.

    Each training step allocates and frees the same large blocks. By default glibc returns them to the system, which
    maps and clears each page again: thousands of page faults per step.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt and mallopt(_MMAP_THRESHOLD, _LARGEST_MMAP_THRESHOLD):
        mallopt(_TRIM_THRESHOLD, 2**31 - 1)
