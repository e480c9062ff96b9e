"""Atomic writes: every file is written under a temporary name and renamed when it is complete."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success rename it to `path`, on any error remove it.

    The parent folder is created. The temporary name keeps the suffix and contains the process id, so two processes can
    write the same file: the later rename wins. Permissions are those of a new file, whatever the writer sets: some
    libraries allow only the owner to read.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        temporary.touch()
        mode = temporary.stat().st_mode
        temporary.unlink()
        yield temporary
        temporary.chmod(mode)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, value: dict[str, Any] | list[Any]) -> None:
    """Write `value` as JSON, one line per entry, so that a diff of a committed file shows each changed entry."""
    if isinstance(value, dict):
        lines = [f"{json.dumps(key)}: {json.dumps(entry, sort_keys=True)}" for key, entry in sorted(value.items())]
        text = "{\n" + ",\n".join(lines) + "\n}\n"
    else:
        text = "[\n" + ",\n".join(json.dumps(entry, sort_keys=True) for entry in value) + "\n]\n"
    with replacing(path) as temporary:
        temporary.write_text(text)
