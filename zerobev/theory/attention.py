"""The two-stream cross-attention of the paper's Eqs. 6 and 7 without a network, and its training on the aux stream."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from zerobev.theory.correspondence import Columns, uniform_attention

_WIDTH = 64  # of queries and keys
_MEASURED = 256  # columns on which a training measures the divergence
_EVERY = 10  # steps between two measurements

Stream = Callable[[Tensor, Tensor], Tensor]


class CrossAttention(nn.Module):
    """One layer with one head (paper, Eqs. 3 and 4); two streams of values share its attention (Eqs. 6 and 7).

    Each position has a trained query, in place of W_Q on a positional encoding. No backbone, feed-forward layer or
    normalisation.

    value: (A, A') channels of the aux stream's trained value projection; None: identity
    """

    def __init__(self, positions: int, features: int, rng: np.random.Generator, value: tuple[int, int] | None = None):
        super().__init__()
        self.queries = _normal((positions, _WIDTH), 1.0, rng)  # p W_Q
        self.keys = _normal((features, _WIDTH), features**-0.5, rng)  # W_K
        self.value = None if value is None else _normal(value, value[0] ** -0.5, rng)  # W_V

    def logits(self, features: Tensor) -> Tensor:
        """Columns (N, R, F) -> e of Eq. 3, (N, P, R)."""
        return self.queries @ (features @ self.keys).mT * self.queries.shape[-1] ** -0.5

    def attention(self, features: Tensor) -> Tensor:
        """Columns (N, R, F) -> alpha of Eq. 3, (N, P, R); sums to 1 over R."""
        return self.logits(features).softmax(-1)

    def aux(self, features: Tensor, values: Tensor) -> Tensor:
        """Eq. 6: values (N, R, A) -> rays (N, P, A')."""
        return self.attention(features) @ (values if self.value is None else values @ self.value)

    def zero(self, features: Tensor, values: Tensor) -> Tensor:
        """Eq. 7: values (N, R, K) of any modalities -> rays (N, P, K)."""
        return self.attention(features) @ values


class Progress(NamedTuple):
    """Curves of a training, one point every ten steps."""

    step: list[int]
    loss: list[float]
    divergence: list[float]  #: from gamma, see `divergence`


def train(
    net: CrossAttention,
    stream: Stream,
    columns: Columns,
    values: Tensor,
    target: Tensor,
    rng: np.random.Generator,
    steps: int = 200,
    batch: int = 96,
    learning_rate: float = 0.03,
) -> Progress:
    """Minimise the squared error of one stream at positions with pixels; changes the network in place.

    stream: `net.aux`, or another function of features (n, R, F) and values (n, R, A) that uses the network
    values: (N, R, A) of the image columns; target: (N, P, A') of their rays
    """
    adam = torch.optim.Adam(net.parameters(), learning_rate)
    decay = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: 1 - step / steps)
    progress = Progress([], [], [])
    for step in range(steps + 1):
        drawn = torch.from_numpy(rng.integers(len(values), size=batch))
        error = stream(columns.features[drawn], values[drawn]) - target[drawn]
        loss = error[columns.gamma[drawn].any(-1)].square().mean()
        if step % _EVERY == 0:
            progress.step.append(step)
            progress.loss.append(float(loss.detach()))
            progress.divergence.append(divergence(net, Columns(*(part[:_MEASURED] for part in columns))))
        if step < steps:
            adam.zero_grad()
            loss.backward()
            adam.step()
            decay.step()
    return progress


@torch.no_grad()
def divergence(net: CrossAttention, columns: Columns) -> float:
    """Mean `total_variation` over positions with pixels, in [0, 1]."""
    return float(total_variation(net.attention(columns.features), columns.gamma)[columns.gamma.any(-1)].mean())


def total_variation(attention: Tensor, gamma: Tensor) -> Tensor:
    """Half the L1 distance of attention (..., P, R) and gamma's uniform attention -> (..., P) in [0, 1].

    For values in [0, 1] it is the largest error that any modality can have at a position.
    """
    return (attention - uniform_attention(gamma)).abs().sum(-1) / 2


@torch.no_grad()
def zero_shot_error(net: CrossAttention, columns: Columns, values: Tensor, target: Tensor) -> float:
    """Root mean squared error of the zero-shot stream at positions with pixels.

    values: (N, R, K); target: (N, P, K)
    """
    error = net.zero(columns.features, values) - target
    return float(error[columns.gamma.any(-1)].square().mean().sqrt())


def _normal(shape: tuple[int, int], scale: float, rng: np.random.Generator) -> nn.Parameter:
    return nn.Parameter(torch.from_numpy(scale * rng.normal(size=shape)).float())
