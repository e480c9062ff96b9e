"""Locks of folders: one process at a time works in a folder."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from zerobev.common.errors import InputError


@contextmanager
def locked(folder: Path, work: str) -> Iterator[None]:
    """Lock `folder`, made if missing, for this process; its end, also a kill, frees it.

    work: name of the work in the message
    Raises `InputError` at once if another process has locked it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / ".lock", blocking=False):
            yield
    except Timeout:
        raise InputError(f"{folder}: expected no other {work}, found one at work") from None
