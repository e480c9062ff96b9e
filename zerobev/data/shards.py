"""Shards: one HDF5 file per scene with its views, written atomically and read view by view."""

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from zerobev.common.errors import InputError
from zerobev.common.keys import matches, plain
from zerobev.common.storage import replacing
from zerobev.config import CameraConfig, TextureConfig
from zerobev.data.views import View
from zerobev.scenes.scene import Scene

_FIELDS = tuple(field.name for field in fields(View))


def recorded_with(camera: CameraConfig, texture: TextureConfig) -> dict[str, Any]:
    """The settings on which views depend: the camera, and the white fraction of *Mod. Sem.* textures."""
    return {"camera": camera, "modsem_share": texture.modsem_fraction}


def write_shard(
    path: Path, scene: Scene, views: Iterable[View], camera: CameraConfig, texture: TextureConfig, seed: int
) -> None:
    """Write `views` (at least one) of `scene` to `path`, one by one; if a view fails, no file is left."""
    with replacing(path) as temporary, h5py.File(temporary, "w", track_order=True) as file:
        for index, view in enumerate(_checked_for_space(views, path.parent)):
            values = tuple(getattr(view, name) for name in _FIELDS)
            if index == 0:
                record = np.dtype([(name, value.dtype, value.shape) for name, value in zip(_FIELDS, values)])
                # One record and one chunk per view: a training sample reads one random view in one call.
                # lzf's output is not reproducible; gzip takes three times as long to read.
                storage = {"maxshape": (None,), "chunks": (1,), "compression": hdf5plugin.Zstd(clevel=3)}
                table = file.create_dataset("views", (0,), record, **storage)
            table.resize(index + 1, axis=0)
            table[index] = np.array(values, record)
        file["instance_label"] = scene.instance_label
        file.attrs["scene"] = scene.name
        file.attrs["charts"] = len(scene.chart_instance)
        file.attrs["recorded_with"] = json.dumps(plain(recorded_with(camera, texture)))
        file.attrs["seed"] = seed


def _checked_for_space(views: Iterable[View], folder: Path) -> Iterator[View]:
    """HDF5 aborts the process when the disk fills up, so free space is checked before each write."""
    for view in views:
        needed = (1 << 20) + 2 * sum(getattr(view, name).nbytes for name in _FIELDS)
        if (free := shutil.disk_usage(folder).free) < needed:
            raise InputError(f"{folder}: expected {needed >> 10} KiB of free disk for a view, found {free >> 10} KiB")
        yield view


class Shard:
    """Reads a shard. Each process opens the file at its first use, so that a `Shard` can be sent to other processes.

    Raises `InputError` for a file that is missing, damaged, or recorded with another camera or *Mod. Sem.* fraction.
    """

    def __init__(self, path: Path, camera: CameraConfig, texture: TextureConfig) -> None:
        self.path = Path(path)
        try:
            with h5py.File(self.path) as file:
                found = json.loads(file.attrs["recorded_with"])
                self.scene = str(file.attrs["scene"])
                self.charts = int(file.attrs["charts"])
                self.seed = int(file.attrs["seed"])
                self.instance_label = file["instance_label"][:]
                self._length = len(file["views"])
        except (OSError, KeyError, ValueError) as error:
            raise InputError(f"{path}: expected a shard of views, found {_short(error)}") from None
        expected = recorded_with(camera, texture)
        if not matches(found, expected):
            raise InputError(f"{path}: expected views recorded with {plain(expected)}, found {found}")
        self._views: h5py.Dataset | None = None
        self._opened_by = 0  # id of the process; a forked one must not use its parent's file

    def __len__(self) -> int:
        return self._length

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_views": None}

    def view(self, index: int) -> View:
        """View `index`."""
        try:
            if self._views is None or self._opened_by != os.getpid():
                # no chunk cache: a view is read once per epoch, and the cache takes megabytes per shard
                self._views, self._opened_by = h5py.File(self.path, rdcc_nbytes=0)["views"], os.getpid()
            record = np.empty(1, self._views.dtype)
            space = self._views.id.get_space()
            space.select_hyperslab((index,), (1,))
            # read with the file's own type: HDF5 converts to NumPy's field by field, which triples the time
            self._views.id.read(h5py.h5s.create_simple((1,)), space, record, self._views.id.get_type())
            return View(**{name: record[0][name] for name in _FIELDS})
        except (OSError, KeyError) as error:
            raise InputError(f"{self.path}: expected view {index}, found {_short(error)}") from None


def checksum(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _short(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
