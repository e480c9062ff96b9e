"""Progress of long work: on a terminal, or in the file named by `ZEROBEV_PROGRESS`; never in a notebook."""

import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

T = TypeVar("T")


def progress(items: Iterable[T], title: str, unit: str, total: int, done: int = 0) -> Iterator[T]:
    """Yield `items` and show the number done out of `total` and the remaining time; `done` were done before."""
    log = os.environ.get("ZEROBEV_PROGRESS")
    if log:
        with Path(log).open("a") as file:
            yield from tqdm(items, title, total, initial=done, unit=unit, file=file, mininterval=2, ncols=80)
    else:
        yield from tqdm(items, title, total, initial=done, unit=unit, disable=not sys.stderr.isatty())
