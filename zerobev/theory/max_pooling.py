"""How well can anything linear max-pool (paper, supplement, "Non-linear pooling to the ground")?

An attention that does not see the values is linear in them, whatever its queries, keys and heads. A cell is the maximum
of `inside` pixels; `outside` more pixels are in the column. Values are binary, independent of each other and of
geometry, and white with probability `white`: then all errors are known in closed form.

With q = 1 - white, the maximum t of N pixels has E t = 1 - q^N; t h_y = h_y for a pixel inside, while a pixel outside
is independent of t.
"""

import numpy as np
import torch
from torch import Tensor


def expected_error(weights: Tensor, gamma: Tensor, white: float) -> Tensor:
    """Mean squared error of sum_y w_y h_y as the maximum over gamma, exact and not sampled.

    weights: (..., R), attention for example; gamma: (..., R) bool. Returns (...) of the dtype of `weights`.
    """
    mean = 1 - (1 - white) ** gamma.sum(-1).to(weights.dtype)
    together = white * (weights * gamma).sum(-1) + white * mean * (weights * ~gamma).sum(-1)  # E t (w h)
    square = white * (1 - white) * weights.square().sum(-1) + (white * weights.sum(-1)).square()  # E (w h)^2
    return mean - 2 * together + square


def best_linear(inside: int, outside: int, white: float) -> tuple[np.ndarray, float]:
    """The weights (inside + outside,) of the least error among all linear operators, and that error.

    By symmetry the weights inside are equal, and those outside: 2 x 2 normal equations. Pixels outside have a weight,
    too, since their average stands in for a constant.
    """
    count = np.array([inside, outside], float)
    mean = 1 - (1 - white) ** inside
    normal = white * (1 - white) * np.diag(count) + white**2 * np.outer(count, count)
    share = np.linalg.lstsq(normal, white * count * [1.0, mean], rcond=None)[0]
    weights = np.repeat(share, [inside, outside])
    return weights, _error(weights, inside, white)


def best_attention(inside: int, outside: int, white: float) -> tuple[np.ndarray, float]:
    """The same among the weights that an attention can have with identity values: not negative, with sum 1."""
    if not outside:
        weights = np.full(inside, 1 / inside)
    else:
        # the error is a parabola of the share that stays inside, with its vertex here
        share = ((1 - white) ** (inside - 1) + 1 / outside) / (1 / inside + 1 / outside)
        share = min(share, 1.0)
        weights = np.repeat([share / inside, (1 - share) / outside], [inside, outside])
    return weights, _error(weights, inside, white)


def worst_case(inside: int) -> float:
    """The least error that a linear operator can have on its worst binary values: (N - 1) / (N + 1).

    One white pixel leaves 1 - w_y, all white leave |sum w - 1|; equal weights of 2 / (N + 1) balance the two.
    """
    return (inside - 1) / (inside + 1)


def worst_case_attention(inside: int) -> float:
    """The same with weights that sum to 1: one white pixel is shown as 1 / N, so that 1 - 1 / N is missing."""
    return 1 - 1 / inside


def _error(weights: np.ndarray, inside: int, white: float) -> float:
    gamma = torch.arange(len(weights)) < inside
    return float(expected_error(torch.from_numpy(weights), gamma, white))
