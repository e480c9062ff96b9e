"""Records: one committed JSON file per result, with its configuration, origin and cost.

A number in a table comes from a record; a record comes from a command. All recorded results have this form: runs, the
depth estimator, benchmark, motion, unseen modalities.
"""

import hashlib
import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

from zerobev.common.errors import InputError
from zerobev.common.keys import fingerprint, matches, plain
from zerobev.common.storage import write_json
from zerobev.experiments.provenance import git_revision, origin

#: Errors of reading a file that is no record.
NO_RECORD = (OSError, ValueError, KeyError, TypeError, RecursionError)


@dataclass(frozen=True)
class Record:
    """A result with its configuration, origin and cost, as plain data."""

    key: str  #: name and fingerprint of the configuration
    config: dict[str, Any]  #: everything that the result depends on
    origin: dict[str, Any]  #: git revision, versions, device
    cost: dict[str, float]  #: seconds; for trainings also the peak memory of the process so far, MB
    result: dict[str, Any]

    @property
    def sha256(self) -> str:
        """SHA-256 of the whole record; stored with the maps of a run, so that later changes are detected."""
        # `default`: a value that is not JSON raises when the file is written, after the maps
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True, default=str).encode()).hexdigest()

    @classmethod
    def from_json(cls, value: Any) -> Self:
        """The inverse of `asdict`; raises one of `NO_RECORD` for anything else."""
        kinds = {"key": str} | dict.fromkeys(("config", "origin", "cost", "result"), dict)
        for name, kind in kinds.items():
            if type(value[name]) is not kind:
                raise InputError(f"{name}: expected {kind.__name__}, found {type(value[name]).__name__}")
        record = cls(**value)
        record.check()
        return record

    def check(self) -> None:
        """Raise one of `NO_RECORD` if the result is not of this kind of record."""


R = TypeVar("R", bound=Record)


def key_of(name: str, config: Mapping[str, Any]) -> str:
    """Key of a result: its name and the fingerprint of its configuration, which may hold dataclasses."""
    return f"{name}-{fingerprint(config)}"


def read(path: Path, kind: type[R]) -> R | None:
    """The record in `path`; None if it is missing or, with `make reproduce FRESH=1`, older than that call.

    Raises `InputError` for a file that is no such record.
    """
    fresh_since = float(os.environ.get("ZEROBEV_FRESH", 0))
    if not path.exists() or path.stat().st_mtime < fresh_since:
        return None
    try:
        return kind.from_json(json.loads(path.read_text()))
    except NO_RECORD as error:
        found = f"{type(error).__name__}: {error}" if not isinstance(error, InputError) else error
        raise InputError(f"{path}: expected a record, found {found}") from None


def find(path: Path, key: str, config: Mapping[str, Any]) -> Record | None:
    """The record in `path` of today's configuration; None if it has to be made.

    It has to be made if it is missing, has another key, or stores another value for a field that has its default today.
    """
    record = read(path, Record)
    return record if record and record.key == key and matches(record.config, config) else None


def write(path: Path, record: Record) -> None:
    """Write a record; an interrupted write leaves no file."""
    write_json(path, asdict(record))


def recorded(
    path: Path, name: str, config: Mapping[str, Any], compute: Callable[[], dict[str, Any]], device: str
) -> dict[str, Any]:
    """The result of `compute`: read from the record in `path`, or computed now and recorded.

    A computed result is read back from its file, so that its types and the order of its keys are the same both times.

    config: everything that the result depends on; a record of another configuration is replaced
    device: type of the device that `compute` uses, such as "cpu"; stored in the record
    Raises `InputError` for a file that is no record.
    """
    key = key_of(name, config)
    if (record := find(path, key, config)) is None:
        revision, started = git_revision(), time.monotonic()
        result = compute()
        cost = {"seconds": round(time.monotonic() - started, 1)}
        write(path, Record(key, plain(config), origin(device, revision), cost, result))
        record = Record.from_json(json.loads(path.read_text()))
    return record.result
