"""A data set of another layout, declared in one line, is found, split, read and recorded like HM3DSem."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig, TextureConfig
from zerobev.data.generate import generate
from zerobev.data.shards import Shard
from zerobev.experiments.workspace import Workspace
from zerobev.scenes import readers
from zerobev.scenes.hm3dsem import SceneFolders

from support.scenes import build, room

CAMERA, TEXTURE = CameraConfig(fpv_px=16, bev_px=20), TextureConfig()


def rooms_reader() -> SimpleNamespace:
    """A data set of folders `room-*`, each an empty room with its side in metres in a text file."""

    def find_scenes(root: Path) -> dict[str, list[Path]]:
        return {"all": sorted(root.glob("room-*"))}

    def split_scenes(root: Path) -> SceneFolders:
        train, validation, test = find_scenes(root)["all"]
        return SceneFolders((train,), (validation,), (test,))

    def read_scene(folder: Path):
        side = float((folder / "side.txt").read_text())
        return build(room((side, side, 2.5)), folder.name)

    return SimpleNamespace(find_scenes=find_scenes, split_scenes=split_scenes, read_scene=read_scene)


@pytest.fixture
def rooms(tmp_path, monkeypatch) -> Path:
    root = tmp_path / "rooms"
    for number in range(3):
        (root / f"room-{number}").mkdir(parents=True)
        (root / f"room-{number}/side.txt").write_text(str(4 + number))

    def matches(folder: Path) -> bool:
        return folder.name.startswith("room")

    monkeypatch.setattr(readers, "READERS", {"rooms": (matches, rooms_reader()), **readers.READERS})
    return root


def test_another_data_set_is_read_and_recorded(rooms, tmp_path):
    workspace = Workspace("smoke", str(rooms), root=tmp_path)
    assert workspace.split.test == (rooms / "room-2",)
    scene = workspace.scene("test", 0)
    assert scene.name == "room-2" and scene.vertices[:, 0].max() == 6
    files = {f"room-{number}/side.txt": 1 for number in range(3)}
    assert workspace.data_config["source"] == files  # other files, other views
    assert generate([rooms / "room-0"], tmp_path / "shards", 2, CAMERA, TEXTURE, seed=0) == {}
    assert len(Shard(tmp_path / "shards/room-0.h5", CAMERA, TEXTURE)) == 2


def test_hm3dsem_reads_all_other_folders(rooms, tmp_path):
    with pytest.raises(InputError, match="expected a scene folder named NNNNN-HASH, found 'elsewhere'"):
        readers.read_scene(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="expected a dataset folder, found nothing"):
        readers.find_scenes(tmp_path / "elsewhere")
