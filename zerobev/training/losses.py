"""The Dice loss and its combination over the two streams (paper, supplement, "Losses and Metrics")."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, distributed

from zerobev.common.errors import InputError
from zerobev.config import AUX
from zerobev.models.base import MapLogits

_EPSILON = 1e-6  # keeps the Dice ratio of an empty class finite


class Losses(NamedTuple):
    """Scalars of one batch."""

    total: Tensor  #: the objective
    main: Tensor  #: of the evaluated output; for Zero-BEV the zero-shot map
    aux: Tensor | None = None  #: of the auxiliary maps


def dice_loss(probabilities: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Soft Dice loss, averaged over classes (paper, supplement, "Losses").

    Sums per class are over all images and cells, so images without the class, or with little of it, have little weight.
    A class absent from the whole batch has loss 1 for any prediction, without gradient. With several processes the sums
    are over the images of all processes: the loss, and the gradient after averaging by DistributedDataParallel, are
    those of one process with the whole batch.

    probabilities: (B, K, M, M) in [0, 1]
    target: (B, K, M, M) in {0, 1}
    mask: (B, 1, M, M) in {0, 1}; cells with 0 are left out
    Returns a scalar float32 in [0, 1], also under autocast. Raises `InputError` if the shapes differ.
    """
    if probabilities.shape != target.shape:
        raise InputError(
            f"probabilities: expected the target's shape {tuple(target.shape)}, found {tuple(probabilities.shape)}"
        )
    with torch.autocast(probabilities.device.type, enabled=False):
        predicted, truth = probabilities.float() * mask.float(), target.float() * mask.float()
        both = (truth * predicted).sum(dim=(0, 2, 3))  # K
        either = (truth + predicted).sum(dim=(0, 2, 3))  # K
        both, either = _over_processes(torch.stack((both, either)))
        return 1 - (2 * both / (either + _EPSILON)).mean()


def zero_bev_loss(
    predicted: MapLogits, batch: Mapping[str, Tensor], alpha: float, aux: tuple[str, ...] = AUX
) -> Losses:
    """Weighted Dice losses: (1 - alpha) * main maps + alpha * auxiliary maps; main maps alone without auxiliary maps.

    If the model returns maps before the U-Net, their loss is added with the weight of the main maps: its gradient
    reaches the geometry directly.

    batch: `target` (B, K, M, M); `aux` (B, 2, M, M) in the order of `AUX`, for auxiliary maps; `fov` (B, 1, M, M)
    alpha: in [0, 1]
    aux: names of the auxiliary maps of the model, its `config.aux`
    """
    zero = dice_loss(predicted.zero_logits.float().sigmoid(), batch["target"], batch["fov"])
    minimised = zero
    if predicted.pooled is not None:
        minimised = zero + dice_loss(predicted.pooled, batch["target"], batch["fov"])
    if predicted.aux_logits is None:
        return Losses(minimised, zero)
    true_aux = batch["aux"][:, [AUX.index(name) for name in aux]]
    aux_loss = dice_loss(predicted.aux_logits.float().sigmoid(), true_aux, batch["fov"])
    return Losses((1 - alpha) * minimised + alpha * aux_loss, zero, aux_loss)


def _over_processes(sums: Tensor) -> Tensor:
    """Sums over all processes; gradients are scaled so that their mean over processes is the true gradient."""
    if not distributed.is_initialized():
        return sums
    everywhere = sums.detach().clone()
    distributed.all_reduce(everywhere)
    scaled = distributed.get_world_size() * sums
    return scaled + (everywhere - scaled.detach())
