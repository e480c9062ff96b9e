"""Shards: the views of one scene in one HDF5 file, written whole and read view by view."""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, fields
from pathlib import Path

import h5py
import numpy as np

from zerobev.config import CameraConfig
from zerobev.errors import InputError
from zerobev.scenes.scene import Scene
from zerobev.storage import replacing
from zerobev.streams.views import View

_FIELDS = tuple(field.name for field in fields(View))


def write_shard(path: Path, scene: Scene, views: Iterable[View], camera: CameraConfig, seed: int) -> None:
    """Write `views` of `scene` to `path`; nothing is left behind when a view fails."""
    rows = [tuple(getattr(view, name) for name in _FIELDS) for view in views]
    record = np.dtype([(name, value.dtype, value.shape) for name, value in zip(_FIELDS, rows[0])])
    with replacing(path) as temporary, h5py.File(temporary, "w", track_order=True) as file:
        # one record and one chunk a view: a training sample reads one view at random, in one call
        file.create_dataset("views", data=np.array(rows, record), chunks=(1,), compression="lzf")
        file["instance_label"] = scene.instance_label
        file.attrs["scene"] = scene.name
        file.attrs["charts"] = len(scene.chart_instance)
        file.attrs["camera"] = json.dumps(asdict(camera))
        file.attrs["seed"] = seed


class Shard:
    """Reads a shard. The file is opened on first use, so that a `Shard` may travel to a worker process.

    Raises `InputError` for a file that is missing, damaged, or recorded with another camera.
    """

    def __init__(self, path: Path, camera: CameraConfig) -> None:
        self.path = Path(path)
        try:
            with h5py.File(self.path) as file:
                recorded = json.loads(file.attrs["camera"])
                self.scene = str(file.attrs["scene"])
                self.charts = int(file.attrs["charts"])
                self.seed = int(file.attrs["seed"])
                self.instance_label = file["instance_label"][:]
                self._length = len(file["views"])
        except (OSError, KeyError, ValueError) as error:
            raise InputError(f"{path}: expected a shard of views, found {_short(error)}") from None
        if recorded != json.loads(json.dumps(asdict(camera))):
            raise InputError(f"{path}: expected views of {camera}, found {recorded}")
        self._views: h5py.Dataset | None = None

    def __len__(self) -> int:
        return self._length

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_views": None}

    def view(self, index: int) -> View:
        """View number `index`."""
        try:
            if self._views is None:
                self._views = h5py.File(self.path)["views"]
            record = self._views[index]
            return View(**{name: record[name] for name in _FIELDS})
        except (OSError, KeyError) as error:
            raise InputError(f"{self.path}: expected view {index}, found {_short(error)}") from None


def checksum(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _short(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
