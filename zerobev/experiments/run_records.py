"""Records of runs: intersections and unions per test scene, and the maps predicted for the gallery."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from zerobev.common.errors import InputError
from zerobev.common.keys import matches
from zerobev.common.storage import replacing
from zerobev.evaluation.evaluate import PartCounts
from zerobev.evaluation.metrics import Counts
from zerobev.experiments.records import Record, read, write


class RunRecord(Record):
    """The record of one run: a row of a table with one seed."""

    @property
    def row(self) -> str:
        """Row of the tables."""
        return self.config["experiment"]["row"]

    @property
    def seed(self) -> int:
        """Seed of weights and samples."""
        return self.config["seed"]

    @property
    def scenes(self) -> list[str]:
        """Test scenes, in the order of the counts."""
        return self.result["scenes"]

    @cached_property
    def counts(self) -> Counts:
        """Intersections and unions per test scene and class."""
        return Counts.from_json(self.result["counts"])

    @cached_property
    def parts(self) -> dict[str, PartCounts]:
        """Counts per part of the maps, see `data.visibility`; empty in records without them."""
        return {
            name: PartCounts(*(Counts.from_json(part[kind]) for kind in ("iou", "recall")))
            for name, part in self.result.get("parts", {}).items()
        }

    @property
    def history(self) -> dict[str, list[float | None]]:
        """Training curves by name; empty if nothing is trained."""
        return self.result["history"]

    def check(self) -> None:
        """Raise `InputError`, `KeyError` or `TypeError` if the result is none of a run."""
        if type(self.row) is not str or type(self.seed) is not int or type(self.history) is not dict:
            raise InputError("expected a row, a seed and a history, found other types")
        names = [name for name in self.scenes if isinstance(name, str)]
        if (
            self.parts
            and sum((part.iou for part in self.parts.values()), Counts.empty(*self.counts.union.shape)) != self.counts
        ):
            raise InputError("parts: expected the sum of their counts to be all counts, found others")
        if not len(names) == len(self.scenes) == len(self.counts.union):
            raise InputError(f"scenes: expected a name for each of {len(self.counts.union)}, found {len(names)}")


class RunStore:
    """The records of runs of one report, in its folders `records` and `gallery`."""

    def __init__(self, reports: Path) -> None:
        self._records = reports / "records"
        self._gallery = reports / "gallery"

    def path(self, key: str) -> Path:
        """The file of a run's record."""
        return self._records / f"{key}.json"

    def find(self, key: str, config: Mapping[str, Any] | None = None) -> RunRecord | None:
        """The record of a run; None if it has to be made.

        config: today's configuration; a record with another value for a field that has its default today is not found
        Raises `InputError` for a file that is no record of this run.
        """
        path = self.path(key)
        record = read(path, RunRecord)
        if record is not None and record.key != key:
            raise InputError(f"{path}: expected a record of {key}, found one of {record.key}")
        if record is None or (config is not None and not matches(record.config, config)):
            return None
        return record

    def write(self, record: RunRecord, maps: np.ndarray) -> None:
        """Write a record and its maps of the gallery's views, (views, classes, M, M) bool."""
        with replacing(self._maps_path(record.key)) as temporary:
            packed = np.packbits(maps, axis=-1)
            np.savez_compressed(temporary, maps=packed, cells=maps.shape[-1], record=record.sha256)
        # the record comes last: if it exists, the run is complete
        write(self.path(record.key), record)

    def maps(self, key: str) -> np.ndarray:
        """The maps of the gallery's views, (views, classes, M, M) bool."""
        path = self._maps_path(key)
        found = _arrays(path, "the maps of a run")
        try:
            packed, cells = found["maps"], int(found["cells"])
            if packed.ndim != 4 or packed.shape[-1] != -(-cells // 8):
                raise ValueError(f"maps {packed.shape} for {cells} cells per row")
            return np.unpackbits(packed, axis=-1, count=cells).astype(bool)
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path}: expected the maps of a run, found {error!r}") from None

    def is_sealed(self, key: str) -> bool:
        """Whether a record is unchanged since it was written: the file of its maps holds its SHA-256."""
        record, sealed = self.find(key), _arrays(self._maps_path(key), "the maps of a run").get("record")
        return record is not None and sealed is not None and str(sealed) == record.sha256

    def write_gallery(self, name: str, **arrays: np.ndarray) -> None:
        """Write the inputs of the gallery's views."""
        with replacing(self._gallery / f"{name}.npz") as temporary:
            np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]  # as in `BevMap.save`

    def gallery(self, name: str) -> dict[str, np.ndarray] | None:
        """The inputs of the gallery's views; None if they have to be made."""
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
    except Exception as error:  # NumPy, zipfile and zlib raise many types for damaged files
        found = " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError(f"{path}: expected {expected}, found {found}") from None
