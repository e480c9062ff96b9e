"""Feature extractors on the first-person side: the ResNet of the RGB image and the small CNN of the zero-shot image.

Paper, supplement, "Feature extractor". Both give four maps per image at the same four strides, to be concatenated
(Eq. 5 concatenates the images themselves). Every layer reduces a size n to ceil(n / 2), so both extractors agree at odd
sizes, too.
"""

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import ResNetBackbone, ResNetConfig

from zerobev.common.errors import InputError
from zerobev.config import ModelConfig

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def resnet(
    in_channels: int,
    stem_channels: int,
    channels: tuple[int, ...],
    depths: tuple[int, ...],
    block: str = "basic",
    max_pool: bool = True,
) -> ResNetBackbone:
    """A ResNet with random weights; its output has one map per stage (`.feature_maps`, finest first).

    The stem is a 7x7 convolution with stride 2; with `max_pool` a 3x3 max-pool halves the map again. The first stage
    keeps the size, each later stage halves it. Parameter names are those of the `transformers` library, so the weights
    of `microsoft/resnet-50` fit at the paper's scale.
    """
    config = ResNetConfig(
        num_channels=in_channels,
        embedding_size=stem_channels,
        hidden_sizes=list(channels),
        depths=list(depths),
        layer_type=block,
        out_features=[f"stage{i + 1}" for i in range(len(channels))],
    )
    network = ResNetBackbone(config)
    if not max_pool:
        network.embedder.pooler = nn.Identity()
    return network


class RgbEncoder(nn.Module):
    """ResNet of the RGB image, normalised as in ImageNet; maps at strides `model.stem_stride` * (1, 2, 4, 8).

    Raises `InputError` for a stem stride other than 2 and 4.
    """

    mean: Tensor  #: (3, 1, 1)
    std: Tensor  #: (3, 1, 1)

    def __init__(self, model: ModelConfig):
        super().__init__()
        if model.stem_stride not in (2, 4):
            raise InputError(f"stem_stride: expected 2 or 4, found {model.stem_stride}")
        max_pool = model.stem_stride == 4
        self.network = resnet(3, model.stem_channels, model.channels, model.depths, model.block, max_pool)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)
        # all maps then have this layout, which saves a fifth of a step on a CPU; torch's stub lacks the argument
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, rgb: Tensor) -> tuple[Tensor, ...]:
        """(B, 3, H, W) float32 in [0, 1] -> maps (B, channels[b], R_b, C_b), finest first."""
        return self.network((rgb - self.mean) / self.std).feature_maps


class ZeroCNN(nn.Module):
    """Zero-shot image at the sizes of the backbone's maps: four 3x3 convolutions of stride 2, with ReLU.

    At stem stride 2 this is the network of the paper's supplement, with maps at strides 2, 4, 8, 16. The paper also
    states backbone maps at strides 4 to 32, out of reach for four such layers. At stem stride 4 the image is therefore
    first folded, 2 x 2 pixels into 4 channels, which halves its size without loss.

    There is no normalisation: the scale of the input carries information, and empty images are common.

    gain: factor on the initial weights of the first layer, and thereby on all maps; the features of a sparse image are
        small beside those of the RGB image
    """

    def __init__(self, channels: tuple[int, ...], stem_stride: int, in_channels: int = 1, gain: float = 1.0):
        super().__init__()
        self.fold = stem_stride // 2
        widths = (in_channels * self.fold**2, *channels)
        layers = [nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairwise(widths)]
        for layer in layers:
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.get_parameter("bias"))
        with torch.no_grad():
            layers[0].weight.mul_(gain)
        self.layers = nn.ModuleList(layers)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, zero: Tensor) -> list[Tensor]:
        """(N, in_channels, H, W) -> maps (N, channels[b], ceil(H / stride_b), ceil(W / stride_b)), finest first."""
        height, width = zero.shape[-2:]
        padded = F.pad(zero, (0, -width % self.fold, 0, -height % self.fold))
        features = F.pixel_unshuffle(padded, self.fold)
        maps = []
        for layer in self.layers:
            features = layer(features).relu()
            maps.append(features)
        return maps
