"""The error of linear operators that imitate max-pooling (paper, supplement, "Non-linear pooling to the ground").

An attention computed without the values is linear in them. A cell is the maximum of `inside` pixels; its column has
`outside` other pixels. Values are binary, independent of each other and of geometry, and white with probability
`white`: all errors have closed forms.

With q = 1 - white, the maximum t of N pixels has E t = 1 - q^N; t h_y = h_y for a pixel inside, while a pixel outside
is independent of t.
"""

import numpy as np
import torch
from torch import Tensor


def expected_error(weights: Tensor, gamma: Tensor, white: float) -> Tensor:
    """Expected squared error of sum_y w_y h_y against the maximum over gamma, in closed form.

    weights: (..., R), for example attention; gamma: (..., R) bool. Returns (...) of the dtype of `weights`.
    """
    mean = 1 - (1 - white) ** gamma.sum(-1).to(weights.dtype)
    together = white * (weights * gamma).sum(-1) + white * mean * (weights * ~gamma).sum(-1)  # E t (w h)
    square = white * (1 - white) * weights.square().sum(-1) + (white * weights.sum(-1)).square()  # E (w h)^2
    return mean - 2 * together + square


def best_linear(inside: int, outside: int, white: float) -> tuple[np.ndarray, float]:
    """The weights (inside + outside,) of the linear operator with the smallest error, and this error.

    By symmetry all weights inside are equal, and all weights outside: 2 x 2 normal equations. Pixels outside have a
    weight because their average replaces a constant term.
    """
    count = np.array([inside, outside], float)
    mean = 1 - (1 - white) ** inside
    normal = white * (1 - white) * np.diag(count) + white**2 * np.outer(count, count)
    solution = np.linalg.lstsq(normal, white * count * [1.0, mean], rcond=None)[0]
    weights = np.repeat(solution, [inside, outside])
    return weights, _error(weights, inside, white)


def best_attention(inside: int, outside: int, white: float) -> tuple[np.ndarray, float]:
    """As `best_linear`, for the weights of an attention with identity values: non-negative, with sum 1."""
    if not outside:
        weights = np.full(inside, 1 / inside)
    else:
        # the vertex of the error, a parabola in the sum of the weights inside
        fraction = ((1 - white) ** (inside - 1) + 1 / outside) / (1 / inside + 1 / outside)
        fraction = min(fraction, 1.0)
        weights = np.repeat([fraction / inside, (1 - fraction) / outside], [inside, outside])
    return weights, _error(weights, inside, white)


def worst_case(inside: int) -> float:
    """The smallest maximum error of a linear operator over all binary values: (N - 1) / (N + 1).

    One white pixel has the error 1 - w_y, all white pixels |sum w - 1|; equal weights 2 / (N + 1) balance the two.
    """
    return (inside - 1) / (inside + 1)


def worst_case_attention(inside: int) -> float:
    """As `worst_case`, with weights that sum to 1: one white pixel gives 1 / N, an error of 1 - 1 / N."""
    return 1 - 1 / inside


def _error(weights: np.ndarray, inside: int, white: float) -> float:
    gamma = torch.arange(len(weights)) < inside
    return float(expected_error(torch.from_numpy(weights), gamma, white))
