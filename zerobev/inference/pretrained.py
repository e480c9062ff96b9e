"""Parts of a projector in files: the shipped ones, a checkpoint, or a folder as on the Hugging Face hub.

A folder has `config.json` with the row and the camera, `model.safetensors` (a checkpoint; not of P^-1) and
`depth.safetensors` (a checkpoint of our depth estimator; missing if another estimator has to be given).
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from zerobev.common.errors import InputError, first_line
from zerobev.common.storage import write_json
from zerobev.config import CameraConfig
from zerobev.inference.shipped_weights import DEPTH, ROWS, shipped
from zerobev.models import load_model
from zerobev.models.base import ZeroShotModel
from zerobev.models.depth import DepthEstimator, DepthNet

#: The row without a network: P^-1 with estimated depth.
GEOMETRIC = "a.2"
#: Name -> row of Tables 1 and 2, or beyond them.
NAMES = {
    "zero-bev": "c",
    "zero-bev-residual": "d",
    "zero-bev-max-pooling": "f.r",
    "inverse-projection": GEOMETRIC,
}
_CONFIG, _MODEL, _DEPTH = "config.json", "model.safetensors", "depth.safetensors"


@dataclass(frozen=True)
class Parts:
    """The fields of a `Projector`."""

    row: str
    camera: CameraConfig
    network: ZeroShotModel | None
    estimator: DepthEstimator


def shipped_names() -> tuple[str, ...]:
    """All names of shipped rows: those of the tables, then the descriptive ones."""
    rows = (GEOMETRIC, *ROWS)
    return (*rows, *(name for name, row in NAMES.items() if row in rows))


def load_parts(source: str | Path, estimator: DepthEstimator | None, hub: bool = False) -> Parts:
    """The parts under a name of `shipped_names`, in a checkpoint or in a folder; see `zerobev.load`.

    hub: any other source is a repository of the Hugging Face hub
    """
    is_name, is_file = str(source) in shipped_names(), Path(source).is_file()
    if not (is_name or is_file):
        if hub or Path(source).is_dir():
            return _from_folder(str(source), estimator)
        expected = f"one of {', '.join(shipped_names())}, the path of a checkpoint, or a folder of save_pretrained"
        raise InputError(f"source: expected {expected}, found {str(source)!r}")
    row = NAMES.get(str(source), str(source)) if is_name else str(source)
    default = DepthNet.load(shipped(DEPTH))
    estimator = default if estimator is None else estimator
    if row == GEOMETRIC:
        return Parts(row, default.camera, None, estimator)
    network = _network(shipped(row) if is_name else Path(source))
    return _checked(Parts(row, network.camera, network, estimator))


def save_parts(folder: Path, parts: Parts) -> None:
    """Write the files of a folder. Raises `InputError`, see `Projector.save_pretrained`."""
    if not isinstance(parts.estimator, DepthNet):
        found = f"{type(parts.estimator).__name__}, which has files of its own"
        raise InputError(f"estimator: expected the package's DepthNet, found {found}")
    try:
        if parts.network is not None:
            parts.network.save(folder / _MODEL)
        parts.estimator.save(folder / _DEPTH)
        write_json(folder / _CONFIG, {"library_name": "zerobev", "row": parts.row, "camera": asdict(parts.camera)})
    except (FileExistsError, NotADirectoryError, PermissionError) as error:
        raise InputError(f"{folder}: expected a folder that can be written, found: {error.strerror}") from None


def _from_folder(source: str, estimator: DepthEstimator | None) -> Parts:
    config = _file(source, _CONFIG)
    try:
        described = json.loads(config.read_text())
        row, camera = str(described["row"]), CameraConfig(**described["camera"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{config}: expected the row and the camera of a projector, found: {error!r}") from None
    network = None if row == GEOMETRIC else _network(_file(source, _MODEL))
    if network is not None and network.camera != camera:
        raise InputError(f"{config}: expected the camera of {_MODEL}, {network.camera}, found {camera}")
    estimator = DepthNet.load(_file(source, _DEPTH)) if estimator is None else estimator
    return _checked(Parts(row, camera, network, estimator))


def _file(source: str, name: str) -> Path:
    """A file of a local folder, or of a repository of the hub."""
    expected = f"{source}: expected a folder of save_pretrained with {name}, found"
    if Path(source).is_dir():
        if not (path := Path(source) / name).is_file():
            raise InputError(f"{expected} none")
        return path
    from transformers.utils import cached_file  # slow to import, and rarely needed

    try:
        return Path(cached_file(source, name))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{expected}: {first_line(error)}") from None


def _network(path: Path) -> ZeroShotModel:
    network = load_model(path)
    if not isinstance(network, ZeroShotModel):
        raise InputError(f"{path}: expected a zero-shot network, found {type(network).__name__}")
    return network


def _checked(parts: Parts) -> Parts:
    """The parts. Raises `InputError` if our own estimator does not take images of their camera."""
    side, estimator = parts.camera.fpv_px, parts.estimator
    if isinstance(estimator, DepthNet) and estimator.camera.fpv_px != side:
        found = f"one for {estimator.camera.fpv_px} px"
        raise InputError(f"estimator: expected a depth estimator for images of {side} px, found {found}")
    return parts
