"""The feature pyramid (Lin et al. 2017): the same width at every stride, with the context of coarser maps."""

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor, nn


class FeaturePyramid(nn.Module):
    """1x1 laterals, top-down nearest upsampling, 3x3 outputs; all maps get `width` channels, sizes are kept.

    outputs: number of output maps, the finest ones; None: all
    """

    def __init__(self, channels: tuple[int, ...], width: int, outputs: int | None = None):
        super().__init__()
        self.laterals = nn.ModuleList(nn.Conv2d(c, width, 1) for c in channels)
        self.outputs = nn.ModuleList(nn.Conv2d(width, width, 3, padding=1) for _ in channels[:outputs])
        for layer in (*self.laterals, *self.outputs):
            nn.init.kaiming_uniform_(layer.weight, a=1)
            nn.init.zeros_(layer.bias)

    def forward(self, maps: Sequence[Tensor], first: Sequence[Tensor] | None = None) -> list[Tensor]:
        """Maps (N, channels[b], R_b, C_b), finest first, each half the size of the last -> (N, width, R_b, C_b).

        first: `first_laterals` (B, width, R_b, C_b), if `maps` have only the other channels; each is added to N / B
            consecutive maps. Laterals are linear, so this is the pyramid of all channels.
        """
        if first is None:
            merged = [lateral(features) for lateral, features in zip(self.laterals, maps)]
        else:
            merged = []
            for m, weight, shared in zip(maps, self._parameter("weight"), first):
                own = F.conv2d(m, weight[:, -m.shape[1] :]).unflatten(0, (shared.shape[0], -1))
                merged.append((own + shared[:, None]).flatten(0, 1))
        for fine in range(len(merged) - 2, -1, -1):
            rows, columns = merged[fine].shape[-2:]
            # doubled and cropped, not stretched: coarse pixel i matches fine pixels 2i and 2i + 1 at odd sizes, too
            doubled = F.interpolate(merged[fine + 1], scale_factor=2, mode="nearest")
            merged[fine] = merged[fine] + doubled[..., :rows, :columns]
        return [output(features) for output, features in zip(self.outputs, merged)]  # the finest ones

    def first_laterals(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """The laterals' part from their first input channels, with the bias: (B, width, R_b, C_b)."""
        parts = zip(maps, self._parameter("weight"), self._parameter("bias"))
        return [F.conv2d(m, weight[:, : m.shape[1]], bias) for m, weight, bias in parts]

    def _parameter(self, name: str) -> list[nn.Parameter]:
        return [layer.get_parameter(name) for layer in self.laterals]
