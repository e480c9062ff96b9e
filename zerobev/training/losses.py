"""The Dice loss and its combination over the two streams (paper, supplement, "Losses and Metrics")."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, distributed

from zerobev.common.errors import InputError
from zerobev.config import AUX

EPSILON = 1e-6  #: keeps the Dice ratio of an empty class finite


class Predicted(Protocol):
    """What a model returns: logits before the FOV mask."""

    zero_logits: Tensor  #: (B, K, M, M)
    aux_logits: Tensor | None  #: (B, A, M, M)
    pooled: Tensor | None  #: (B, K, M, M) in [0, 1]


class Losses(NamedTuple):
    """Scalars of one batch."""

    total: Tensor  #: what is minimised
    main: Tensor  #: of the output that is evaluated; for Zero-BEV the zero-shot map
    aux: Tensor | None = None  #: of the auxiliary maps


def dice_loss(probabilities: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Soft Dice loss, averaged over classes (paper, supplement, "Losses").

    Sums run over all images and cells of a class, so that images in which a class is rare or absent
    weigh little. A class that the whole batch lacks costs 1 whatever is predicted, without gradient.
    With several processes the sums run over the images of all of them: the loss, and the gradient once
    DistributedDataParallel has averaged it, are those of one process with the whole batch.

    probabilities: (B, K, M, M) in [0, 1]
    target: (B, K, M, M) in {0, 1}
    mask: (B, 1, M, M) in {0, 1}; cells where it is 0 do not count
    Returns a scalar float32 in [0, 1], also under autocast. Raises `InputError` where the shapes disagree.
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
        return 1 - (2 * both / (either + EPSILON)).mean()


def zero_bev_loss(
    predicted: Predicted, batch: Mapping[str, Tensor], alpha: float, aux: tuple[str, ...] = AUX
) -> Losses:
    """Dice loss of the main maps, and of the auxiliary maps with weight `alpha` where the model has them.

    Where the model shows its maps before the U-Net, their loss is added to the total, with the weight of the main maps:
    it reaches the geometry without a detour.

    predicted: logits (B, K, M, M) and, or None, (B, A, M, M), before the FOV mask
    batch: `target` (B, K, M, M), `aux` (B, 2, M, M) in the order of `AUX` if the model predicts it, `fov` (B, 1, M, M)
    alpha: weight of the auxiliary loss, in [0, 1]; without auxiliary maps the main loss stands alone
    aux: names of the A maps that the model predicts, its `config.aux`
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
    """Sums over all processes; the gradient is scaled so that its mean over processes is the true one."""
    if not distributed.is_initialized():
        return sums
    everywhere = sums.detach().clone()
    distributed.all_reduce(everywhere)
    scaled = distributed.get_world_size() * sums
    return scaled + (everywhere - scaled.detach())
