"""From image columns to map rays: the transformer of one depth band.

Paper, Section 3.1, Eqs. 3 and 4, and supplement, "FPV to BEV transformers".

Columns are independent of each other and form the batch: N = B * C sequences of R image rows become N sequences of P
ray positions. The sequences are short, so attention is two plain matrix products, and its weights are returned.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

#: Initial factors for rays that start at the floor: on position encodings, and on weights of queries and keys.
_FLOOR_POSITION, _FLOOR_WEIGHT = 6.0, 1.5


def sinusoids(positions: Tensor, width: int) -> Tensor:
    """Positions (L,) encoded as (L, width) float32: sines on even, cosines on odd channels (Vaswani et al. 2017)."""
    position = positions.double()[:, None]
    rate = 10_000.0 ** (-torch.arange(0, width, 2, dtype=torch.float64) / width)
    return torch.stack([(position * rate).sin(), (position * rate).cos()], dim=-1).flatten(1).float()


class BandAttention(NamedTuple):
    """Attention weights of a band, one tensor per layer; sums over the last axis are 1 (alpha in the paper's Eq. 3).

    Ray self-attention of the first layer is the same for every column, so its N is 1.
    """

    columns: list[Tensor]  #: (N, heads, R, R) column self-attention
    rays: list[Tensor]  #: (N, heads, P, P) ray self-attention
    cross: list[Tensor]  #: (N, heads, P, R) of ray positions over image rows


class MultiHeadAttention(nn.Module):
    """Scaled dot-product attention with several heads; positions are added to queries and keys, not to values.

    `inputs` stacks the three input projections, so queries, keys and values are one matrix product. They are linear:
    projected positions are added to their output, and are thus computed once for all columns.
    """

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.width, self.heads = width, heads
        self.inputs = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    @torch.no_grad()
    def start_equal(self, weight: float) -> None:
        """Set the weight matrices of queries and keys to `weight` times the identity: equal positions then attract."""
        queries, keys, _ = self.inputs.weight.chunk(3)
        nn.init.eye_(queries).mul_(weight)
        keys.copy_(queries)

    def qkv(self, x: Tensor, position: Tensor, first: int, last: int) -> tuple[Tensor, ...]:
        """`(queries, keys, values)[first:last]` of x (N, L, d) at position (L, d): each (N, heads, L, d / heads)."""
        rows = slice(first * self.width, last * self.width)
        weight, bias = self.inputs.weight[rows], self.inputs.bias[rows]
        with_position = (min(last, 2) - first) * self.width
        shift = F.pad(F.linear(position, weight[:with_position]), (0, len(weight) - with_position))
        projected = F.linear(x, weight, bias) + shift
        return projected.unflatten(-1, (last - first, self.heads, -1)).permute(2, 0, 3, 1, 4).contiguous().unbind()

    def mix(self, queries: Tensor, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """The paper's Eqs. 3 and 4 per head -> (N, P, d), attention (N, heads, P, R)."""
        logits = queries * queries.shape[-1] ** -0.5 @ keys.transpose(-1, -2)
        with torch.autocast(logits.device.type, enabled=False):  # autocast would copy to float32 and back
            attention = logits.softmax(-1)
        return self.out((attention @ values).transpose(1, 2).flatten(2)), attention

    def within(self, x: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
        """Self-attention: x (N, L, d), position (L, d) -> (N, L, d), attention (N, heads, L, L)."""
        return self.mix(*self.qkv(x, position, 0, 3))

    def across(self, x: Tensor, position: Tensor, memory: Tensor, memory_position: Tensor) -> tuple[Tensor, Tensor]:
        """Cross-attention of x (N or 1, P, d) to memory (N, R, d) -> (N, P, d), attention (N, heads, P, R)."""
        return self.mix(*self.qkv(x, position, 0, 1), *self.qkv(memory, memory_position, 1, 3))


class FeedForward(nn.Sequential):
    """Linear, ReLU, dropout, linear."""

    def __init__(self, width: int, hidden: int, dropout: float):
        super().__init__(nn.Linear(width, hidden), nn.ReLU(), nn.Dropout(dropout), nn.Linear(hidden, width))


class EncoderLayer(nn.Module):
    """Post-norm layer of the column encoder: self-attention and feed-forward, each with a skip and a LayerNorm."""

    def __init__(self, width: int, heads: int, hidden: int, dropout: float):
        super().__init__()
        self.attention = MultiHeadAttention(width, heads)
        self.feed_forward = FeedForward(width, hidden, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        self.dropout = nn.Dropout(dropout)

    def forward(self, column: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
        """Column (N, R, d), position (R, d) -> column (N, R, d), attention (N, heads, R, R)."""
        mixed, attention = self.attention.within(column, position)
        column = self.norms[0](column + self.dropout(mixed))
        return self.norms[1](column + self.dropout(self.feed_forward(column))), attention


class DecoderLayer(nn.Module):
    """Post-norm layer of the ray decoder: ray self-attention, cross-attention to the column, feed-forward.

    The supplement lists two norms and adds tensors of different widths; this is the standard layer, with three norms.
    """

    def __init__(self, width: int, heads: int, hidden: int, dropout: float):
        super().__init__()
        self.self_attention = MultiHeadAttention(width, heads)
        self.cross_attention = MultiHeadAttention(width, heads)
        self.feed_forward = FeedForward(width, hidden, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3))
        self.dropout = nn.Dropout(dropout)

    def forward(
        self, ray: Tensor, ray_position: Tensor, column: Tensor, position: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Ray (N or 1, P, d), column (N, R, d) -> ray (N, P, d), ray attention, cross-attention (N, heads, P, R)."""
        mixed, ray_attention = self.self_attention.within(ray, ray_position)
        ray = self.norms[0](ray + self.dropout(mixed))
        mixed, cross = self.cross_attention.across(ray, ray_position, column, position)
        ray = self.norms[1](ray + self.dropout(mixed))
        return self.norms[2](ray + self.dropout(self.feed_forward(ray))), ray_attention, cross


class BandTransformer(nn.Module):
    """Column encoder and ray decoder of one band: columns of `rows` pixels to rays of `positions` cells.

    A ray starts as a trained embedding of its positions, the same for every column. It is therefore computed once, not
    N times, before the first cross-attention.

    floor_rows: (positions,) image row of the floor at each position. If given, training starts from the projection of a
        flat floor: each ray position has the encoding of its row, and queries and keys have equal weights, so that each
        position attends to its row. Short trainings need this: with diffuse attention, the Dice loss has its minimum at
        an all-white map.
    """

    position: Tensor  #: (rows, width)
    ray_position: Tensor  #: (positions, width)

    def __init__(
        self,
        width: int,
        heads: int,
        hidden: int,
        layers: int,
        dropout: float,
        rows: int,
        positions: int,
        floor_rows: Tensor | None = None,
    ):
        super().__init__()
        self.encoder = nn.ModuleList(EncoderLayer(width, heads, hidden, dropout) for _ in range(layers))
        decoder = [DecoderLayer(width, heads, hidden, dropout) for _ in range(layers)]
        self.decoder = nn.ModuleList(decoder)
        self.ray = nn.Parameter(torch.empty(positions, width))
        gain = 1.0 if floor_rows is None else _FLOOR_POSITION
        ray_rows = torch.arange(positions) if floor_rows is None else floor_rows
        self.register_buffer("position", gain * sinusoids(torch.arange(rows), width), persistent=False)
        self.register_buffer("ray_position", gain * sinusoids(ray_rows, width), persistent=False)
        for parameter in self.parameters():
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)
        if floor_rows is not None:
            nn.init.zeros_(self.ray)
            for layer in decoder:
                layer.cross_attention.start_equal(_FLOOR_WEIGHT)

    def forward(self, columns: Tensor) -> tuple[Tensor, BandAttention]:
        """Columns (N, R, d), top row first -> rays (N, P, d), and all attention weights."""
        attention = BandAttention([], [], [])
        for layer in self.encoder:
            columns, weights = layer(columns, self.position)
            attention.columns.append(weights)
        rays = self.ray[None]
        for layer in self.decoder:
            rays, ray_weights, cross_weights = layer(rays, self.ray_position, columns, self.position)
            attention.rays.append(ray_weights)
            attention.cross.append(cross_weights)
        return rays, attention
