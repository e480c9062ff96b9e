"""Occupancy grids, read by the rules of nav2's `map_server`, independently of the writer."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.inference import BevMap
from zerobev.mapping import HomeMap, Pose2D

CAMERA = CameraConfig(fpv_px=8, bev_px=4, bev_extent_m=4.0)


class Served:
    """An occupancy grid as `map_server` serves it: data from the lowest row up; 100 occupied, 0 free, -1 unknown."""

    def __init__(self, path: Path) -> None:
        settings = yaml.safe_load(path.read_text())
        assert settings["mode"] == "trinary" and settings["negate"] == 0
        with Image.open(path.parent / settings["image"]) as image:
            assert image.format == "PPM" and image.mode == "L"
            occupancy = (255 - np.asarray(image, float)) / 255
        data = np.full(occupancy.shape, -1)
        data[occupancy < settings["free_thresh"]] = 0
        data[occupancy > settings["occupied_thresh"]] = 100
        self.data, self.cell_m, self.origin = data[::-1], settings["resolution"], settings["origin"]

    def at(self, x: float, y: float) -> int:
        """The value at a point of the world."""
        column, row = ((value - start) / self.cell_m for value, start in zip((x, y), self.origin))
        return int(self.data[math.floor(row), math.floor(column)])


def home() -> HomeMap:
    """A camera at (3, 2) that looks along +y, 1 m of floor, then a wall across the right half, then nothing."""
    values = np.zeros((2, 4, 4), np.float32)
    values[0, 2:] = 1
    values[1, 2, 2:] = 1
    home = HomeMap((-1, 1, 6, 9), 0.5)
    home.add(BevMap(values, ("floor", "wall"), values, np.ones((4, 4), bool), CAMERA), Pose2D(3, 2, math.pi / 2))
    return home


def test_map_server_reads_the_cells_where_they_are(tmp_path):
    home().save_nav2(tmp_path / "maps/home", free="floor", occupied=["wall"])
    served = Served(tmp_path / "maps/home.yaml")
    assert served.origin == [-1, 1, 0] and served.cell_m == 0.5 and served.data.shape == (16, 14)
    assert served.at(3.2, 2.5) == served.at(1.1, 3.9) == 0
    assert served.at(3.2, 3.5) == served.at(4.9, 3.1) == 100  # floor and wall
    assert served.at(3.2, 4.5) == -1  # in view, but neither
    assert served.at(3.2, 1.5) == served.at(5.5, 2.5) == -1  # never in view
    assert [int((served.data == value).sum()) for value in (0, 100)] == [(8 - 2) * 4, 2 * 4]


def test_the_values_are_those_of_map_saver(tmp_path):
    home().save_nav2(tmp_path / "home.yaml", free="floor", occupied="wall")
    data = (tmp_path / "home.pgm").read_bytes()
    assert data.startswith(b"P5\n14 16\n255\n") and len(data) == len(b"P5\n14 16\n255\n") + 14 * 16
    assert set(data[13:]) == {0, 205, 254}


@pytest.mark.parametrize("broken", ["home.yaml", "home.pgm"])
def test_a_map_is_written_whole_or_not_at_all(tmp_path, monkeypatch, broken: str):
    home().save_nav2(tmp_path / "home", free="floor", occupied="wall")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for name in ("write_text", "write_bytes"):
        write = getattr(Path, name)

        def interrupted(path: Path, content, write=write) -> None:
            write(path, content[:20])
            if path.suffix == Path(broken).suffix:
                raise PermissionError(13, "Permission denied")

        monkeypatch.setattr(Path, name, interrupted)
    with pytest.raises(InputError, match="expected a file that can be written, found: Permission denied"):
        home().save_nav2(tmp_path / "home", free="wall", occupied="floor")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("path", "free", "occupied", "message"),
    [
        ("home.pgm", "floor", "wall", r"path: expected a name that ends in \.yaml, found .*home\.pgm"),
        ("home", "ground", "wall", "layer: expected one of floor, wall, found 'ground'"),
        ("home", "floor", ("wall", "sofa"), "layer: expected one of floor, wall, found 'sofa'"),
        ("home", ("floor", "wall"), "wall", "occupied: expected layers other than the free ones, found 'wall' in both"),
        ("file/home", "floor", "wall", "file/home.yaml: expected a file that can be written, found: "),
    ],
)
def test_bad_input_is_named_and_nothing_is_written(tmp_path, path, free, occupied, message: str):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=message):
        home().save_nav2(tmp_path / path, free, occupied)
    assert [file.name for file in tmp_path.iterdir()] == ["file"]
