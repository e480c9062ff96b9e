"""Pretrained weights for the RGB backbone: from ImageNet as in the paper, or from our own depth pretraining."""

import pickle
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from transformers import ResNetModel

from zerobev.common.errors import InputError, first_line
from zerobev.models.backbone import RgbEncoder

Weights = Mapping[str, Tensor]

_CLASSIFIER = re.compile(r"fc\.(weight|bias)")  # of torchvision, beside the backbone
_PREFIX = "backbone.network."  # of the backbone in our checkpoints
#: Missing in older files; batch norms with a momentum do not use it.
_COUNTER = "num_batches_tracked"
_STAGE = re.compile(r"encoder\.stages\.(\d+)\.|layer(\d+)\.")
_BLOCK = re.compile(
    r"encoder\.stages\.(\d+)\.layers\.(\d+)\.(?:shortcut|layer\.(\d+))\.(convolution|normalization)\.(\w+)"
)


def load_backbone(backbone: RgbEncoder, source: str | Path) -> None:
    """Replace the weights and batch-norm statistics of `backbone` by those in `source`.

    source: one of
        `*.pth`: a state dict of a torchvision ResNet (only tensors are unpickled);
        `*.safetensors`: a checkpoint of one of our networks, for example a `DepthNet`; only its backbone is read;
        a folder, or a name on the Hugging Face hub such as `microsoft/resnet-50`: a ResNet of `transformers`.
        Stages beyond those of `backbone` are ignored.

    Raises `InputError`, with `backbone` unchanged, if `source` cannot be read, lacks a weight of the backbone, has a
    weight of another shape, or has additional weights in a stage of the backbone.
    """
    weights, named = _read(source)
    network = backbone.network
    own = {name: tensor for name, tensor in network.state_dict().items() if not name.endswith(_COUNTER)}
    for name, tensor in own.items():
        expected = f"{source}: expected the weight {named(name)} of shape {tuple(tensor.shape)}"
        if named(name) not in weights:
            raise InputError(f"{expected}, found none of this name")
        if (found := tuple(weights[named(name)].shape)) != tuple(tensor.shape):
            raise InputError(f"{expected}, found {found}")
    stages = len(network.encoder.stages)
    more = sorted(name for name in weights.keys() - {named(name) for name in own} if _stage(name) < stages)
    if more:
        raise InputError(f"{source}: expected {len(own)} weights, found {len(more)} more, such as {more[0]}")
    network.load_state_dict({name: weights[named(name)] for name in own}, strict=False)


def torchvision_name(name: str) -> str:
    """torchvision's name of a parameter or buffer of a `transformers` ResNet.

    Both count blocks from 0; torchvision counts stages and the convolutions of a block from 1.
    """
    if name.startswith("embedder.embedder."):
        module, kind = name.split(".")[-2:]
        return f"{'conv1' if module == 'convolution' else 'bn1'}.{kind}"
    found = _BLOCK.fullmatch(name)
    assert found, f"{name}: expected a weight of a ResNet"
    stage, block, position, module, kind = found.groups()
    is_convolution = module == "convolution"
    if position is None:
        layer = f"downsample.{0 if is_convolution else 1}"
    else:
        layer = f"{'conv' if is_convolution else 'bn'}{int(position) + 1}"
    return f"layer{int(stage) + 1}.{block}.{layer}.{kind}"


def _stage(name: str) -> int:
    """Stage of a weight, from 0, in either naming; -1 for the stem and for other names."""
    found = _STAGE.search(name)
    if found is None:
        return -1
    ours, torchvisions = found.groups()
    return int(ours) if ours else int(torchvisions) - 1


def _read(source: str | Path) -> tuple[Weights, Callable[[str], str]]:
    """Weights of the backbone by their names in the file, and the function our name -> name in the file."""
    suffix = Path(source).suffix
    if suffix == ".pth":
        weights, named = _torchvision(Path(source)), torchvision_name
    elif suffix == ".safetensors":
        weights, named = _checkpoint(Path(source)), lambda name: _PREFIX + name
    else:
        weights, named = _transformers(source), lambda name: name
    return {name: tensor for name, tensor in weights.items() if not name.endswith(_COUNTER)}, named


def _torchvision(path: Path) -> Weights:
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, pickle.UnpicklingError) as error:
        raise InputError(f"{path}: expected a state dict of a ResNet, found: {first_line(error)}") from error
    if not isinstance(weights, Mapping) or not all(isinstance(tensor, Tensor) for tensor in weights.values()):
        raise InputError(f"{path}: expected a state dict, names and tensors, found another {type(weights).__name__}")
    return {name: tensor for name, tensor in weights.items() if not _CLASSIFIER.fullmatch(name)}


def _checkpoint(path: Path) -> Weights:
    try:
        weights = load_file(path)
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: expected a safetensors checkpoint, found: {first_line(error)}") from error
    return {name: tensor for name, tensor in weights.items() if name.startswith(_PREFIX)}


def _transformers(source: str | Path) -> Weights:
    try:
        network, report = ResNetModel.from_pretrained(str(source), output_loading_info=True)
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise InputError(f"{source}: expected a ResNet of transformers, found: {first_line(error)}") from error
    # the library only warns of missing weights and leaves them random
    missing = sorted(name for name in report["missing_keys"] if not name.endswith(_COUNTER))
    if missing:
        raise InputError(f"{source}: expected the weight {missing[0]}, found none of this name")
    return network.state_dict()
