"""Records: what a run measured and where it came from, one committed JSON file each.

A number in a table comes from a record; a record comes from a command. Beside the counts of every test
scene a record holds configuration, seed, recipe version, git revision, library versions, device and time.
"""

import hashlib
import json
import os
import platform
import re
import resource
import subprocess
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from zerobev.common.errors import InputError
from zerobev.common.storage import replacing, write_json
from zerobev.evaluation.metrics import Counts

# what reading JSON raises for a file that is something else
_NO_RECORD = (OSError, ValueError, KeyError, TypeError, RecursionError)


@dataclass(frozen=True)
class Record:
    """One run: a row of a table with one seed."""

    key: str
    row: str
    seed: int
    config: dict[str, Any]  #: everything the run depends on; its fingerprint is part of the key
    origin: dict[str, Any]  #: git revision, versions, device
    cost: dict[str, float]  #: seconds of training and evaluation; the process's peak memory so far, MB
    scenes: list[str]  #: test scenes, in the order of the counts
    counts: Counts
    history: dict[str, list[float | None]]  #: training curves by name, empty for a method that is not trained

    @property
    def sha256(self) -> str:
        """Of all that the record says; its maps carry it, so that a number that is changed later does not pass."""
        # `default`: what is no JSON fails where it is written, after the maps
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True, default=str).encode()).hexdigest()

    def to_json(self) -> dict[str, Any]:
        """Plain data, for a file."""
        return {**asdict(self), "counts": self.counts.to_json()}

    @classmethod
    def from_json(cls, value: Any) -> "Record":
        """The inverse of `to_json`; raises `InputError`, `KeyError` or `TypeError` for anything else."""
        kinds = {"key": str, "row": str, "seed": int, "scenes": list}
        kinds |= dict.fromkeys(("config", "origin", "cost", "history"), dict)
        for name, kind in kinds.items():
            if type(value[name]) is not kind:
                raise InputError(f"{name}: expected {kind.__name__}, found {type(value[name]).__name__}")
        record = cls(**{**value, "counts": Counts.from_json(value["counts"])})
        scenes = [name for name in record.scenes if isinstance(name, str)]
        if not len(scenes) == len(record.scenes) == len(record.counts.union):
            raise InputError(f"scenes: expected a name for each of {len(record.counts.union)}, found {len(scenes)}")
        return record


class RecordStore:
    """The records of one report, in its folders `records` and `gallery`."""

    def __init__(self, reports: Path) -> None:
        self._records = reports / "records"
        self._gallery = reports / "gallery"

    def path(self, key: str) -> Path:
        """Where the record of a run belongs."""
        return self._records / f"{key}.json"

    def find(self, key: str) -> Record | None:
        """The record of a run, or None where it has to be made: missing, or older than a call for fresh ones.

        Raises `InputError` for a file that is no record.
        """
        path = self.path(key)
        if not path.exists() or not is_fresh(path):
            return None
        try:
            return Record.from_json(json.loads(path.read_text()))
        except _NO_RECORD as error:
            raise InputError(f"{path}: expected a record of a run, found {error}") from None

    def write(self, record: Record, maps: np.ndarray) -> None:
        """Keep a record, and the maps it predicted for the gallery, (views, classes, M, M) bool."""
        with replacing(self._maps_path(record.key)) as temporary:
            packed = np.packbits(maps, axis=-1)
            np.savez_compressed(temporary, maps=packed, cells=maps.shape[-1], record=record.sha256)
        # the record last: where it is, all of the run is
        write_json(self.path(record.key), record.to_json())

    def maps(self, key: str) -> np.ndarray:
        """The maps of the gallery's views, (views, classes, M, M) bool."""
        path = self._maps_path(key)
        found = _arrays(path, "the maps of a run")
        try:
            packed, cells = found["maps"], int(found["cells"])
            if packed.ndim != 4 or packed.shape[-1] != -(-cells // 8):
                raise ValueError(f"maps {packed.shape} for {cells} cells a row")
            return np.unpackbits(packed, axis=-1, count=cells).astype(bool)
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path}: expected the maps of a run, found {error!r}") from None

    def is_sealed(self, key: str) -> bool:
        """Whether a record is the one that its maps were written with, to the last digit."""
        record, sealed = self.find(key), _arrays(self._maps_path(key), "the maps of a run").get("record")
        return record is not None and sealed is not None and str(sealed) == record.sha256

    def write_gallery(self, name: str, **arrays: np.ndarray) -> None:
        """Keep the inputs of the gallery's views."""
        with replacing(self._gallery / f"{name}.npz") as temporary:
            np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]  # as in `BevMap.save`

    def gallery(self, name: str) -> dict[str, np.ndarray] | None:
        """The inputs of the gallery's views, or None where they have to be made."""
        path = self._gallery / f"{name}.npz"
        if not path.exists():
            return None
        return _arrays(path, "the gallery's views")

    def _maps_path(self, key: str) -> Path:
        return self._gallery / f"{key}.npz"


def _arrays(path: Path, expected: str) -> dict[str, np.ndarray]:
    try:
        with np.load(path) as file:
            return dict(file)
    except Exception as error:  # of a damaged file NumPy and zipfile raise nearly everything there is
        found = " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError(f"{path}: expected {expected}, found {found}") from None


def cached(path: Path, identity: dict[str, Any], compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What `compute` makes of `identity`: read from `path` where it is recorded there, else computed and recorded.

    The result is what JSON makes of it, keys in order, the first time, too: what is shown of it stays the same.

    identity: all that the result depends on, plain data; a record of another identity is replaced
    Raises `InputError` for a file that is no such record.
    """
    if path.exists() and is_fresh(path):
        try:
            found = json.loads(path.read_text())
            if found["identity"] == identity:
                return found["result"]
        except _NO_RECORD as error:
            raise InputError(f"{path}: expected a record, found {error!r}") from None
    revision, started = git_revision(), time.monotonic()
    result = compute()
    made = {"origin": origin("cpu", revision), "seconds": round(time.monotonic() - started, 1)}
    write_json(path, {"identity": identity, **made, "result": result})
    return json.loads(path.read_text())["result"]


def is_fresh(path: Path) -> bool:
    """Whether a file is younger than the call for fresh results, `make reproduce FRESH=1`, if there was one."""
    return path.stat().st_mtime >= float(os.environ.get("ZEROBEV_FRESH", 0))


def git_revision(code: Path = Path(__file__).parents[1]) -> str:
    """The commit that `code` is checked out at, with "-dirty" where it differs; "unknown" outside a checkout.

    Reports and notebooks may differ: a reproduction writes them.
    """
    commands = ["describe", "--always", "--abbrev=12"], ["status", "--porcelain", "."]
    found = [subprocess.run(["git", *c], cwd=code, capture_output=True, text=True, check=False) for c in commands]
    revision, changes = (ended.stdout.strip() for ended in found)
    return (revision + "-dirty" if changes else revision) or "unknown"


def origin(device: str, revision: str) -> dict[str, Any]:
    """Where and with what a run is made."""
    packages = ("torch", "numpy", "transformers", "accelerate", "embreex", "pyrender", "scikit-image")
    return {
        "revision": revision,
        "python": platform.python_version(),
        "versions": {name: version(name) for name in packages},
        "device": device,
        "cores": os.cpu_count(),
    }


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text()) if status.exists() else None
    if found:  # Linux; `getrusage` would count the process that started this one, too
        return round(int(found[1]) / 1024, 1)
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)
