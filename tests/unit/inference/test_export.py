"""ONNX files against torch, and the README's program without torch."""

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch
from PIL import Image

import zerobev
from zerobev import cli
from zerobev.common.errors import InputError
from zerobev.config import SCALES
from zerobev.inference.export import TOLERANCE, export_onnx
from zerobev.inference.shipped_weights import ROWS
from zerobev.models import build
from zerobev.models.base import BevModel, ZeroShotModel
from zerobev.models.depth import DepthNet

from support.paths import ROOT

SMOKE = SCALES["smoke"]
MODEL = replace(SMOKE.model, layers=1, seen=True, measured=True, floor_depth=True)
#: Imports of torch fail.
WITHOUT_TORCH = "import sys; sys.modules['torch'] = None\n"


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def network(row: str) -> BevModel:
    return (DepthNet(SMOKE.camera, MODEL) if row == "depth" else build(row, SMOKE.camera, MODEL)).eval()


@pytest.mark.slow
@pytest.mark.parametrize("row", ["d", "f.r", "depth"])
def test_a_file_has_the_outputs_of_torch_for_any_number_of_images(row, tmp_path):
    """More images than a pass has, and cameras of several heights. (c) and (f) are parts of (d) and (f.r)."""
    net = network(row)
    export_onnx(net, tmp_path / "net.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "net.onnx", providers=["CPUExecutionProvider"])
    for batch, images in ((1, 1), (1, 40), (3, 1), (2, 5)):
        rgb, zero = torch.rand(batch, 3, 32, 32), (torch.rand(batch, images, 32, 32) > 0.7).float()
        metres, measured = 0.3 + 4 * torch.rand(batch, 1, 32, 32), (torch.rand(batch, 1, 32, 32) > 0.5).float()
        depth, height_m = torch.cat([metres, measured], dim=1), torch.linspace(0.3, 1.8, batch)
        if isinstance(net, ZeroShotModel):
            inputs = {"rgb": rgb, "zero": zero}
            if net.config.residual:
                inputs |= {"depth": depth, "height_m": height_m}
            with torch.no_grad():
                expected = net(rgb, zero, depth, height_m).zero_logits
        else:
            inputs = {"rgb": rgb}
            with torch.no_grad():
                expected = net(rgb)
        assert {one.name for one in session.get_inputs()} == set(inputs)
        (found,) = session.run(None, {name: tensor.numpy() for name, tensor in inputs.items()})
        np.testing.assert_allclose(found, expected, atol=1e-4, rtol=1e-4)


def test_networks_that_cannot_be_exported_are_named(tmp_path, monkeypatch):
    path = tmp_path / "net.onnx"
    with pytest.raises(InputError, match="network: expected float32 on the CPU, found cpu torch"):
        export_onnx(network("c").bfloat16(), path)
    with pytest.raises(InputError, match="network: expected a zero-shot network or the package's DepthNet, found VPN"):
        export_onnx(network("b.1"), path)
    with pytest.raises(SystemExit, match=r"^error: --row: expected a network, found P\^-1 \(inverse-projection\)"):
        cli.main(["export", "--row", "inverse-projection", "--out", str(path)])

    def unsupported(*_, **__):
        raise torch.onnx.OnnxExporterError("No ONNX function found for aten.svd\nmore")

    monkeypatch.setattr(torch.onnx, "export", unsupported)
    with pytest.raises(InputError, match=r"network: expected operations that ONNX has, found ZeroBEV .*: No ONNX func"):
        export_onnx(network("c"), path)
    assert not path.exists()


@pytest.mark.slow
def test_a_file_that_differs_from_torch_is_not_written(tmp_path, monkeypatch):
    class Other(onnxruntime.InferenceSession):
        def run(self, *arguments):
            return [output + 2 * TOLERANCE * np.abs(output).max() for output in super().run(*arguments)]

    monkeypatch.setattr(onnxruntime, "InferenceSession", Other)
    with pytest.raises(InputError, match=r"depth: expected torch's up to 0\.0001, found a difference of"):
        export_onnx(network("depth"), tmp_path / "net.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_readme_s_program_without_torch(tmp_path):
    """Its photograph and mask are those that `zerobev` gives to the network, and its map is the network's."""
    readme = (ROOT / "README.md").read_text()
    (program,) = (block for block in re.findall(r"(?:^(?: {4}.*)?\n)+", readme, re.M) if "onnxruntime" in block)
    lines = [line.removeprefix("    ") for line in program.strip("\n").splitlines()]
    assert len(lines) <= 30
    model = zerobev.load(ROWS[0])
    side = model.camera.fpv_px
    rng = np.random.default_rng(0)
    rgb = np.kron(rng.integers(0, 256, (8, 12, 3)), np.ones((30, 30, 1))).astype(np.uint8)
    mask = np.zeros(rgb.shape[:2], bool)
    mask[130:220, 60:200] = True
    Image.fromarray(rgb).save(tmp_path / "photo.png")
    Image.fromarray(mask).save(tmp_path / "chair.png")
    cli.main(["export", "--row", ROWS[0], "--out", str(tmp_path / "zero-bev.onnx")])
    saved = "\nnp.savez('found.npz', rgb=rgb, zero=zero, values=values)\n"
    program = WITHOUT_TORCH + "\n".join(lines) + saved
    found = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    found = np.load(tmp_path / "found.npz")
    view = model.view(rgb, zerobev.Camera(66))
    assert np.abs(found["rgb"][0].transpose(1, 2, 0) - view.pinhole.photograph(rgb / 255)).mean() < 0.005
    assert found["zero"].shape == (1, 1, side, side)
    assert (found["zero"][0, 0] != view.pinhole.mask(mask)).mean() < 0.005
    with torch.inference_mode():
        zero = torch.from_numpy(found["zero"])
        expected = model.network(torch.from_numpy(found["rgb"]), zero).zero_logits.sigmoid()
    np.testing.assert_allclose(found["values"], expected, atol=1e-4)
