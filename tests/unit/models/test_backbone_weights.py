"""Pretrained weights: the names of torchvision's networks, and refusal of weights that do not fit."""

import re
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from transformers import ResNetConfig, ResNetForImageClassification

from zerobev.common.errors import InputError
from zerobev.config import SCALES
from zerobev.models.backbone import RgbEncoder
from zerobev.models.backbone_weights import load_backbone, torchvision_name

SMOKE, PAPER = SCALES["smoke"].model, SCALES["paper"].model
SMALL = replace(SMOKE, depths=(2, 1, 2, 1), channels=(16, 32, 48, 64), stem_channels=16, stem_stride=4)
SMALL_BOTTLENECK = replace(SMALL, block="bottleneck", channels=(32, 64, 96, 128))


@pytest.fixture(autouse=True)
def seeded():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def encoder(model=SMALL) -> RgbEncoder:
    """An encoder in evaluation mode, with batch-norm statistics other than 0 and 1."""
    network = RgbEncoder(model).eval()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            for values in (module.weight, module.bias, module.running_mean, module.running_var):
                torch.nn.init.uniform_(values, 0.5, 1.5)
    return network


def torchvision_weights(network: RgbEncoder) -> dict[str, torch.Tensor]:
    """The weights with torchvision's names, and its classifier."""
    weights = {torchvision_name(name): tensor.clone() for name, tensor in network.network.state_dict().items()}
    return weights | {"fc.weight": torch.zeros(10, 4), "fc.bias": torch.zeros(10)}


def torchvision_forward(weights: dict[str, torch.Tensor], rgb: torch.Tensor, bottleneck: bool) -> list[torch.Tensor]:
    """torchvision's ResNet from its weights' names: the output of each stage."""

    def conv(x: torch.Tensor, conv_name: str, norm_name: str, stride: int) -> torch.Tensor:
        kernel = weights[f"{conv_name}.weight"]
        x = F.conv2d(x, kernel, stride=stride, padding=kernel.shape[-1] // 2)
        mean, var, gain, bias = (
            weights[f"{norm_name}.{name}"] for name in ("running_mean", "running_var", "weight", "bias")
        )
        return F.batch_norm(x, mean, var, gain, bias)

    x = F.max_pool2d(conv(rgb, "conv1", "bn1", 2).relu(), 3, 2, 1)
    stages = []
    for stage in (1, 2, 3, 4):
        for block in range(len({name.split(".")[1] for name in weights if name.startswith(f"layer{stage}.")})):
            at, stride = f"layer{stage}.{block}", 2 if stage > 1 and block == 0 else 1
            last = 3 if bottleneck else 2
            strided = 2 if bottleneck else 1  # the 3x3 convolution of a bottleneck, the first one of a basic block
            y = x
            for i in range(1, last + 1):
                y = conv(y, f"{at}.conv{i}", f"{at}.bn{i}", stride if i == strided else 1)
                y = y.relu() if i < last else y
            if f"{at}.downsample.0.weight" in weights:
                x = conv(x, f"{at}.downsample.0", f"{at}.downsample.1", stride)
            x = (x + y).relu()
        stages.append(x)
    return stages


@pytest.mark.parametrize("model", [SMALL, SMALL_BOTTLENECK], ids=["basic", "bottleneck"])
def test_torchvision_weights_give_torchvision_s_output(model, tmp_path):
    weights = torchvision_weights(encoder(model))
    torch.save(weights, tmp_path / "resnet.pth")
    loaded = encoder(model)
    load_backbone(loaded, tmp_path / "resnet.pth")
    rgb = torch.rand(2, 3, 64, 64)
    with torch.no_grad():
        expected = torchvision_forward(weights, (rgb - loaded.mean) / loaded.std, model.block == "bottleneck")
        for ours, theirs in zip(loaded(rgb), expected):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def test_the_names_of_a_resnet_50():
    with torch.device("meta"):
        names = {torchvision_name(name) for name in RgbEncoder(PAPER).network.state_dict()}
    norm = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
    expected = {"conv1.weight", *(f"bn1.{kind}" for kind in norm)}
    for stage, blocks in enumerate((3, 4, 6, 3), start=1):
        for block in range(blocks):
            at = f"layer{stage}.{block}"
            for i in (1, 2, 3):
                expected |= {f"{at}.conv{i}.weight", *(f"{at}.bn{i}.{kind}" for kind in norm)}
            if block == 0:
                expected |= {f"{at}.downsample.0.weight", *(f"{at}.downsample.1.{kind}" for kind in norm)}
    assert names == expected
    assert len(expected) == 318  # torchvision's resnet50 has 320 entries, two of them the classifier's


@pytest.mark.parametrize("form", ["torchvision", "checkpoint", "folder", "task folder"])
def test_every_source_replaces_all_weights(form, tmp_path):
    first, second = encoder(), RgbEncoder(SMALL)
    path = tmp_path / {"torchvision": "net.pth", "checkpoint": "net.safetensors"}.get(form, "net")
    if form == "torchvision":
        torch.save(torchvision_weights(first), path)
    elif form == "checkpoint":
        tensors = {f"backbone.{name}": tensor for name, tensor in first.state_dict().items()}
        save_file({k: t.contiguous() for k, t in tensors.items()} | {"head.weight": torch.zeros(1)}, path)
    elif form == "folder":
        first.network.save_pretrained(path)
    else:
        settings = {name: value for name, value in first.network.config.to_dict().items() if name != "model_type"}
        whole = ResNetForImageClassification(ResNetConfig(**settings))
        whole.resnet.load_state_dict(first.network.state_dict(), strict=False)
        whole.save_pretrained(path)
    load_backbone(second, path)
    for name, tensor in first.state_dict().items():
        if not name.endswith("num_batches_tracked"):
            torch.testing.assert_close(second.state_dict()[name], tensor, rtol=0, atol=0)


@pytest.mark.parametrize("name", ["conv1.weight", "layer1.1.bn2.running_var", "layer3.0.downsample.0.weight"])
def test_a_weight_that_is_missing_or_misshapen_is_named(name, tmp_path):
    weights, path, target = torchvision_weights(encoder()), tmp_path / "resnet.pth", encoder()
    before = {key: tensor.clone() for key, tensor in target.state_dict().items()}
    shape = tuple(weights[name].shape)
    for broken, found in (
        ({k: v for k, v in weights.items() if k != name}, "none of this name"),
        (weights | {name: torch.zeros(7, 1)}, "(7, 1)"),
    ):
        torch.save(broken, path)
        message = f"{path}: expected the weight {name} of shape {shape}, found {found}"
        with pytest.raises(InputError, match=f"^{re.escape(message)}$"):
            load_backbone(target, path)
    assert all(torch.equal(before[key], tensor) for key, tensor in target.state_dict().items())


def test_a_deeper_network_is_refused(tmp_path):
    torch.save(torchvision_weights(encoder(replace(SMALL, depths=(2, 1, 3, 1)))), tmp_path / "deep.pth")
    with pytest.raises(InputError, match=r"deep\.pth: .*found 10 more, such as layer3\.2\.bn1\.bias"):
        load_backbone(encoder(), tmp_path / "deep.pth")


def test_old_files_without_counters_are_accepted(tmp_path):
    weights = {k: v for k, v in torchvision_weights(encoder()).items() if "num_batches" not in k}
    torch.save(weights, tmp_path / "old.pth")
    target = encoder()
    load_backbone(target, tmp_path / "old.pth")
    assert torch.equal(target.network.embedder.embedder.normalization.bias, weights["bn1.bias"])


def test_a_folder_without_a_weight_is_refused(tmp_path):
    network = encoder().network
    lost = "encoder.stages.2.layers.0.shortcut.convolution.weight"
    network.save_pretrained(tmp_path, state_dict={k: v for k, v in network.state_dict().items() if k != lost})
    with pytest.raises(InputError, match=rf"{re.escape(str(tmp_path))}: .*{re.escape(lost)}"):
        load_backbone(encoder(), tmp_path)


class Code:
    """Unpickling must not run this."""

    def __reduce__(self):
        return (pytest.fail, ("code in the file was run",))


@pytest.mark.parametrize("content", ["nothing", "garbage", "code", "list", "nested"])
def test_files_without_weights_are_refused(content, tmp_path):
    path = tmp_path / "resnet.pth"
    if content == "garbage":
        path.write_bytes(b"weights")
    elif content != "nothing":
        torch.save(
            {"code": Code(), "list": [1], "nested": {"state_dict": {"conv1.weight": torch.zeros(1)}}}[content], path
        )
    with pytest.raises(InputError, match=re.escape(str(path))):
        load_backbone(encoder(), path)


@pytest.mark.parametrize("name", ["net.safetensors", "folder"])
def test_a_missing_source_is_named(name, tmp_path):
    with pytest.raises(InputError, match=re.escape(str(tmp_path / name))):
        load_backbone(encoder(), tmp_path / name)
