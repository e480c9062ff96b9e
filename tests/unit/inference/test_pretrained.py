"""`from_pretrained`, `save_pretrained`, and names: the same weights, or one clear line."""

import json

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import zerobev
from zerobev.common.errors import InputError
from zerobev.config import SCALES
from zerobev.inference.pretrained import GEOMETRIC, NAMES, shipped_names
from zerobev.inference.shipped_weights import ROWS
from zerobev.models import build
from zerobev.models.depth import DepthNet

SMOKE = SCALES["smoke"]
RGB = np.random.default_rng(0).integers(0, 256, (50, 60, 3), dtype=np.uint8)
MASK = np.ones((50, 60), bool)


def projector(row: str) -> zerobev.Projector:
    torch.manual_seed(0)
    network = None if row == GEOMETRIC else build(row, SMOKE.camera, SMOKE.model).eval()
    return zerobev.Projector(row, SMOKE.camera, network, DepthNet(SMOKE.camera, SMOKE.model).eval())


@pytest.mark.parametrize("row", [GEOMETRIC, "c", "f.r"])
@pytest.mark.parametrize("read", [zerobev.Projector.from_pretrained, zerobev.load])
def test_a_saved_projector_is_read_again(row, read, tmp_path):
    model = projector(row)
    model.save_pretrained(tmp_path / "own")
    files = {"config.json", "depth.safetensors"} | ({"model.safetensors"} if row != GEOMETRIC else set())
    assert {path.name for path in (tmp_path / "own").iterdir()} == files
    again = read(tmp_path / "own")
    assert (again.row, again.camera) == (row, model.camera)
    np.testing.assert_array_equal(again.project(RGB, MASK).values, model.project(RGB, MASK).values)
    other = DepthNet(SMOKE.camera, SMOKE.model).eval()
    (tmp_path / "own/depth.safetensors").unlink()
    assert read(tmp_path / "own", other).estimator is other
    with pytest.raises(InputError, match=r"own: expected a folder of save_pretrained with depth\.safetensors, found"):
        read(tmp_path / "own")


def test_a_checkpoint_s_path_stays_on_this_machine(tmp_path):
    model = projector("c")
    model.network.save(tmp_path / "mine.safetensors")
    loaded = zerobev.load(tmp_path / "mine.safetensors", model.estimator)
    loaded.to(dtype=torch.bfloat16).save_pretrained(tmp_path / "own")
    assert json.loads((tmp_path / "own/config.json").read_text())["row"] == "mine.safetensors"
    again = zerobev.load(tmp_path / "own")
    assert again.dtype == torch.float32
    for name, tensor in model.network.state_dict().items():
        rounded = tensor.bfloat16() if tensor.is_floating_point() else tensor
        assert torch.equal(again.network.state_dict()[name], rounded.to(tensor.dtype))


def test_each_shipped_row_has_its_name():
    for name, row in NAMES.items():
        if row not in (GEOMETRIC, *ROWS):
            assert name not in shipped_names()
            with pytest.raises(InputError, match=f"source: expected one of a.2, .*, found '{name}'"):
                zerobev.load(name)
            continue
        one, other = zerobev.load(name), zerobev.Projector.from_pretrained(row)
        assert one.row == other.row == row and one.camera == other.camera
        if one.network is not None:
            for ours, theirs in zip(one.network.state_dict().values(), other.network.state_dict().values()):
                assert torch.equal(ours, theirs)


def broken(kind: str, folder) -> None:
    if kind == "text":
        (folder / "config.json").write_text("row: c")
    elif kind == "no row":
        (folder / "config.json").write_text("{}")
    elif kind == "camera":
        config = json.loads((folder / "config.json").read_text())
        config["camera"]["bev_px"] = 21
        (folder / "config.json").write_text(json.dumps(config))
    elif kind == "field":
        (folder / "config.json").write_text('{"row": "c", "camera": {"pixels": 32}}')
    elif kind == "weights":
        (folder / "model.safetensors").write_bytes(b"nothing")
    elif kind == "others":
        save_file({"weight": torch.zeros(1)}, folder / "model.safetensors")
    elif kind == "no zero-shot network":
        build("b.1", SMOKE.camera, SMOKE.model).save(folder / "model.safetensors")
    elif kind == "depth":
        DepthNet(SCALES["reduced"].camera, SCALES["reduced"].model).save(folder / "depth.safetensors")
    else:
        (folder / kind).unlink()


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("config.json", r"own: expected a folder of save_pretrained with config\.json, found none"),
        ("model.safetensors", r"own: expected a folder of save_pretrained with model\.safetensors, found none"),
        ("text", r"config\.json: expected the row and the camera of a projector, found: JSONDecodeError"),
        ("no row", r"config\.json: expected the row and the camera of a projector, found: KeyError\('row'\)"),
        ("field", r"config\.json: expected the row and the camera of a projector, found: TypeError"),
        ("camera", r"config\.json: expected the camera of model\.safetensors, .*bev_px=20.* found .*bev_px=21"),
        ("weights", r"model\.safetensors: expected a safetensors checkpoint, found"),
        ("others", r"model\.safetensors: expected the network's configuration in the metadata"),
        ("no zero-shot network", r"model\.safetensors: expected a zero-shot network, found VPN"),
        ("depth", r"estimator: expected a depth estimator for images of 32 px, found one for 64 px"),
    ],
)
def test_a_bad_folder_is_one_line(kind, message, tmp_path):
    projector("c").save_pretrained(tmp_path / "own")
    broken(kind, tmp_path / "own")
    with pytest.raises(InputError, match=message) as raised:
        zerobev.Projector.from_pretrained(tmp_path / "own")
    assert "\n" not in str(raised.value)


def test_a_repository_of_the_hub_is_read_as_a_folder(tmp_path, monkeypatch):
    model = projector("c")
    model.save_pretrained(tmp_path / "own")

    def cached_file(source, name):
        if source != "owner/name":
            raise OSError(f"{source} is not a repository\nmore")
        return str(tmp_path / "own" / name)

    monkeypatch.setattr("transformers.utils.cached_file", cached_file)
    again = zerobev.Projector.from_pretrained("owner/name")
    np.testing.assert_array_equal(again.project(RGB, MASK).values, model.project(RGB, MASK).values)
    with pytest.raises(InputError, match=r"other/name: expected a folder .* config\.json, found: other/name is not"):
        zerobev.Projector.from_pretrained("other/name")
    with pytest.raises(InputError, match=r"source: expected one of a\.2, .*, found 'owner/name'"):
        zerobev.load("owner/name")  # a misspelt row is no reason for a look-up


def test_what_cannot_be_saved_is_named(tmp_path):
    model = projector("c")
    lent = zerobev.Projector("c", model.camera, model.network, lambda rgb: rgb[:, :1])
    with pytest.raises(InputError, match="estimator: expected the package's DepthNet, found function, which has files"):
        lent.save_pretrained(tmp_path / "own")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file: expected a folder that can be written, found: "):
        model.save_pretrained(tmp_path / "file")
