"""Zero-shot networks in two parts: all that depends on the RGB image alone, and the rest."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from zerobev.common.errors import InputError
from zerobev.config import SCALES
from zerobev.models import build
from zerobev.models.base import ZeroShotModel

SMOKE = SCALES["smoke"]
ROWS = ["-", "c", "d", "e", "f", "f.r"]


@pytest.fixture(autouse=True)
def seeded():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def network(row: str) -> ZeroShotModel:
    net = build(row, SMOKE.camera, replace(SMOKE.model, seen=True)).eval()
    assert isinstance(net, ZeroShotModel)
    return net


def inputs(batch: int, k: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    zero, depth = (torch.rand(batch, k, 32, 32) > 0.7).float(), 0.3 + 4 * torch.rand(batch, 1, 32, 32)
    return torch.rand(batch, 3, 32, 32), zero, depth, torch.linspace(0.3, 1.8, batch)


@torch.no_grad()
@pytest.mark.parametrize("row", ROWS)
def test_features_of_an_image_serve_any_zero_shot_images(row):
    """Also those of one image, cut from a batch; the parts that see the RGB image are not called again."""
    net, (rgb, zero, depth, height_m) = network(row), inputs(3, 20)
    whole = net(rgb, zero, depth, height_m)
    features = net.encode(rgb, depth, height_m)
    calls = []
    for part in (net.backbone, *([net.gates] if row[0] == "f" else [])):
        part.register_forward_hook(lambda *_: calls.append(1))
    for ours, theirs in zip(net.decode(features, zero), whole):
        assert ours is theirs is None or torch.equal(ours, theirs)
    for image in range(3):
        one = tuple(tensor[image : image + 1] for tensor in features)
        for k in (0, 7):
            found = net.decode(one, zero[image : image + 1, k : k + 1]).zero_logits
            torch.testing.assert_close(found[0, 0], whole.zero_logits[image, k], atol=1e-5, rtol=1e-5)
    assert not calls


@torch.no_grad()
@pytest.mark.parametrize("row", ["c", "d", "e", "f", "f.r"])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_only_rounds(row, dtype):
    """Depth stays in float32: cells of pixels are the same."""
    net, (rgb, zero, depth, height_m) = network(row), inputs(2, 3)
    whole = net(rgb, zero, depth, height_m).zero_logits
    half = net.to(dtype)
    features = half.encode(rgb.to(dtype), depth, height_m)
    logits = half.decode(features, zero.to(dtype)).zero_logits
    assert logits.dtype == dtype
    step = torch.finfo(dtype).eps
    assert (logits.float() - whole).abs().mean() < 4 * step * whole.abs().mean()


def test_features_and_images_of_other_batches_are_refused():
    net, (rgb, zero, depth, _) = network("d"), inputs(2, 3)
    features = net.encode(rgb, depth)
    with pytest.raises(InputError, match=r"zero: expected \(2, 3, 32, 32\), found \(3, 3, 32, 32\)"):
        net.decode(features, torch.cat([zero, zero[:1]]))
    with pytest.raises(InputError, match=r"depth: expected \(2, 1, 32, 32\), found None"):
        net.encode(rgb)
    with pytest.raises(InputError, match=r"depth: expected \(2, 1, 32, 32\), found \(1, 1, 32, 32\)"):
        net.encode(rgb, depth[:1])
