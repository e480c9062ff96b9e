"""Records: one committed JSON file per result, with its configuration, origin and cost.

A number in a table comes from a record; a record comes from a command. All recorded results (runs, the depth
estimator, benchmark, motion, unseen modalities) are of this form and are read and written here.
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

#: Raised by the reading of JSON that is no record.
NO_RECORD = (OSError, ValueError, KeyError, TypeError, RecursionError)


@dataclass(frozen=True)
class Record:
    """A result, the configuration that it depends on, and where it comes from; all of it plain data."""

    key: str  #: name and fingerprint of the configuration
    config: dict[str, Any]  #: everything that the result depends on
    origin: dict[str, Any]  #: git revision, versions, device
    cost: dict[str, float]  #: seconds; of trainings also the process's peak memory so far, MB
    result: dict[str, Any]

    @property
    def sha256(self) -> str:
        """Of the whole record; stored with the maps of a run, so that a number changed later is found."""
        # `default`: values that are not JSON fail when the file is written, after the maps
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


def find(path: Path, kind: type[R], key: str, config: Mapping[str, Any] | None = None) -> R | None:
    """The record in `path`; None if it has to be made.

    It has to be made if it is missing, is older than a call for fresh results, has another key, or was made with
    another value of a field that has its default today.

    config: of today; without it, only the key is compared
    Raises `InputError` for a file that is no such record.
    """
    if not path.exists() or not is_fresh(path):
        return None
    try:
        record = kind.from_json(json.loads(path.read_text()))
    except NO_RECORD as error:
        found = f"{type(error).__name__}: {error}" if not isinstance(error, InputError) else error
        raise InputError(f"{path}: expected a record, found {found}") from None
    if record.key != key or (config is not None and not matches(record.config, config)):
        return None
    return record


def write(path: Path, record: Record) -> None:
    """Write a record, whole or not at all."""
    write_json(path, asdict(record))


def recorded(path: Path, name: str, config: Mapping[str, Any], compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The result of `compute`, read from the record in `path`, or computed now (on the CPU) and recorded.

    Computed or read, the result is what JSON gives back, keys in the order of the file: tables made of it look the
    same both times.

    config: everything that the result depends on; a record of another configuration is replaced
    Raises `InputError` for a file that is no record.
    """
    key = key_of(name, config)
    if (record := find(path, Record, key, config)) is None:
        revision, started = git_revision(), time.monotonic()
        result = compute()
        cost = {"seconds": round(time.monotonic() - started, 1)}
        write(path, Record(key, plain(config), origin("cpu", revision), cost, result))
        record = Record.from_json(json.loads(path.read_text()))
    return record.result


def is_fresh(path: Path) -> bool:
    """Whether a file is younger than the call for fresh results, `make reproduce FRESH=1`, if there was one."""
    return path.stat().st_mtime >= float(os.environ.get("ZEROBEV_FRESH", 0))
