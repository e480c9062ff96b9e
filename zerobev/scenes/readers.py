"""Readers of data sets. A new data set is a module with the functions of `Reader`, and one line here."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from zerobev.scenes import hm3dsem
from zerobev.scenes.hm3dsem import SceneFolders
from zerobev.scenes.scene import Scene


class Reader(Protocol):
    """The functions of a data set's module; they raise `InputError` for broken or missing files."""

    def find_scenes(self, root: Path) -> dict[str, list[Path]]:
        """The scene folders at `root` in each official part of the data set, sorted by name."""

    def list_scenes(self, root: Path) -> list[Path]:
        """All scene folders at `root`, sorted by name: of a data set, of one of its parts, or the scene itself."""

    def split_scenes(self, root: Path) -> SceneFolders:
        """The scene folders at `root` for training, validation and test."""

    def read_scene(self, folder: Path) -> Scene:
        """The scene in `folder`, named after it."""


#: name -> test of a folder (of a data set or a scene), and reader; the first match is used. HM3DSem matches every
#: folder and stays last: its errors name the missing files.
READERS: dict[str, tuple[Callable[[Path], bool], Reader]] = {
    "HM3DSem": (lambda folder: True, hm3dsem),
}


def find_scenes(root: Path) -> dict[str, list[Path]]:
    """As `Reader.find_scenes`, with the reader of `root`."""
    return _reader(root).find_scenes(root)


def list_scenes(root: Path) -> list[Path]:
    """As `Reader.list_scenes`, with the reader of `root`."""
    return _reader(root).list_scenes(root)


def split_scenes(root: Path) -> SceneFolders:
    """As `Reader.split_scenes`, with the reader of `root`."""
    return _reader(root).split_scenes(root)


def read_scene(folder: Path) -> Scene:
    """As `Reader.read_scene`, with the reader of `folder`."""
    return _reader(folder).read_scene(folder)


def _reader(folder: Path) -> Reader:
    return next(reader for matches, reader in READERS.values() if matches(Path(folder)))
