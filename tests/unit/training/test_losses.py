"""The Dice loss against sums by hand, finite differences, and several processes against one."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor, distributed, multiprocessing

from zerobev.common.errors import InputError
from zerobev.models.base import MapLogits
from zerobev.training.losses import dice_loss, zero_bev_loss

UNIT = st.floats(0, 1, width=32)
BINARY = st.integers(0, 1).map(float)


def test_dice_by_hand():
    """Two classes, two images of 1 x 3 cells; the last cell is outside the FOV in both."""
    probabilities = torch.tensor([[[[0.5, 1.0, 1.0]], [[0.0, 0.2, 0.0]]], [[[0.0, 0.5, 1.0]], [[0.8, 0.0, 1.0]]]])
    target = torch.tensor([[[[1.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]]], [[[0.0, 1.0, 1.0]], [[1.0, 0.0, 0.0]]]])
    mask = torch.tensor([1.0, 1.0, 0.0]).expand(2, 1, 1, 3)
    first = 2 * (0.5 + 1 + 0.5) / (3 + 2)  # overlap of class 0; three true cells, two predicted
    second = 2 * 0.8 / (1 + 1)
    assert dice_loss(probabilities, target, mask).item() == pytest.approx(1 - (first + second) / 2, abs=1e-6)


def test_dice_limits():
    """0 for the truth, 1 for its complement; an absent class has loss 1."""
    truth = torch.tensor([[1.0, 0.0], [1.0, 1.0]]).expand(1, 1, 2, 2)
    mask = torch.ones(1, 1, 2, 2)
    assert dice_loss(truth, truth, mask).item() == pytest.approx(0, abs=1e-6)
    assert dice_loss(1 - truth, truth, mask).item() == 1
    with_absent = torch.cat((truth, torch.zeros_like(truth)), dim=1)
    assert dice_loss(with_absent, with_absent, mask).item() == pytest.approx(0.5, abs=1e-6)


def test_dice_sums_over_the_batch_not_over_images():
    """An image without any true cell adds no loss."""
    target = torch.zeros(2, 1, 2, 2)
    target[0] = 1
    assert dice_loss(target, target, torch.ones(2, 1, 2, 2)).item() == pytest.approx(0, abs=1e-6)


def test_gradient_against_finite_differences():
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(2, 3, 4, 4, generator=generator)
    target = (torch.rand(2, 3, 4, 4, generator=generator) < 0.4).float()
    mask = (torch.rand(2, 1, 4, 4, generator=generator) < 0.7).float()
    direction = torch.randn(2, 3, 4, 4, generator=generator)

    def loss(shift: float) -> float:
        return dice_loss((logits + shift * direction).sigmoid(), target, mask).item()

    logits.requires_grad_()
    (gradient,) = torch.autograd.grad(dice_loss(logits.sigmoid(), target, mask), logits)
    logits.requires_grad_(False)
    expected = (loss(0.01) - loss(-0.01)) / 0.02
    assert (gradient * direction).sum().item() == pytest.approx(expected, rel=1e-3)
    assert gradient[mask.expand_as(gradient) == 0].abs().max() == 0
    assert (gradient * (1 - 2 * target)).min() >= 0, "more probability inside the class, less outside"


@given(arrays(np.float32, (2, 2, 3, 3), elements=UNIT), arrays(np.float32, (2, 2, 3, 3), elements=BINARY), st.data())
def test_cells_outside_the_fov_have_no_effect(probabilities, target, data):
    mask = data.draw(arrays(np.float32, (2, 1, 3, 3), elements=BINARY))
    other = data.draw(arrays(np.float32, (2, 2, 3, 3), elements=UNIT))
    first, truth, fov = (torch.from_numpy(array) for array in (probabilities, target, mask))
    second = torch.where(fov > 0, first, torch.from_numpy(other))
    third = torch.where(fov > 0, truth, 1 - truth)
    assert 0 <= dice_loss(first, truth, fov) <= 1
    assert dice_loss(first, truth, fov) == dice_loss(second, third, fov)


def test_streams_are_weighted_by_alpha():
    generator = torch.Generator().manual_seed(1)
    zero, aux = torch.randn(2, 1, 4, 4, generator=generator), torch.randn(2, 2, 4, 4, generator=generator)
    batch = {"target": (zero > 0.3).float(), "aux": (aux > -0.3).float(), "fov": torch.ones(2, 1, 4, 4)}
    zero_dice = dice_loss(zero.sigmoid(), batch["target"], batch["fov"])
    aux_dice = dice_loss(aux.sigmoid(), batch["aux"], batch["fov"])
    losses = zero_bev_loss(MapLogits(zero, aux), batch, alpha=0.25)
    torch.testing.assert_close(losses.total, 0.75 * zero_dice + 0.25 * aux_dice)
    assert (losses.main, losses.aux) == (zero_dice, aux_dice)
    alone = zero_bev_loss(MapLogits(zero, None), batch, alpha=0.25)
    assert alone.total == alone.main == zero_dice
    assert alone.aux is None
    # maps before the U-Net are added to the total, with the weight of the main maps, but not to the score
    pooled = torch.rand(2, 1, 4, 4, generator=generator)
    shown = zero_bev_loss(MapLogits(zero, aux, pooled), batch, alpha=0.25)
    expected = losses.total + 0.75 * dice_loss(pooled, batch["target"], batch["fov"])
    torch.testing.assert_close(shown.total, expected)
    assert shown.main == zero_dice


def test_a_model_with_one_auxiliary_map_is_compared_with_that_map():
    aux = torch.randn(2, 1, 4, 4, generator=torch.Generator().manual_seed(1))
    truth = torch.cat([aux < 0, aux > 0], dim=1).float()
    batch = {"target": truth[:, :1], "aux": truth, "fov": torch.ones(2, 1, 4, 4)}
    maps = MapLogits(aux, 99 * aux)
    assert zero_bev_loss(maps, batch, 0.5, aux=("navigable",)).aux < 0.1
    assert zero_bev_loss(maps, batch, 0.5, aux=("obstacles",)).aux > 0.9
    with pytest.raises(InputError, match=r"expected the target's shape \(2, 2, 4, 4\), found \(2, 1, 4, 4\)"):
        zero_bev_loss(maps, batch, 0.5)


def test_float32_under_autocast():
    """Sums of 10,000 cells do not fit bfloat16's eight bits."""
    logits = torch.linspace(-4, 4, 10_000).reshape(1, 1, 100, 100)
    batch = {"target": (logits > 1).float(), "fov": torch.ones(1, 1, 100, 100)}
    plain = zero_bev_loss(MapLogits(logits, None), batch, 0.5).total
    with torch.autocast("cpu", torch.bfloat16):
        under = zero_bev_loss(MapLogits(logits, None), batch, 0.5).total
    assert under.dtype == torch.float32
    assert under == plain


def _half(rank: int, logits: Tensor, batch: dict[str, Tensor], path: str) -> None:
    distributed.init_process_group("gloo", init_method=f"file://{path}/meet", rank=rank, world_size=2)
    mine = logits[rank::2].clone().requires_grad_()
    loss = dice_loss(mine.sigmoid(), batch["target"][rank::2], batch["fov"][rank::2])
    (gradient,) = torch.autograd.grad(loss, mine)
    torch.save((loss.detach(), gradient), f"{path}/{rank}.pt")
    distributed.destroy_process_group()


@pytest.mark.slow
def test_two_processes_give_the_loss_of_one(tmp_path):
    """Each process has half of the batch; the mean gradient over processes is that of the whole batch."""
    generator = torch.Generator().manual_seed(2)
    logits = torch.randn(4, 2, 3, 3, generator=generator)
    batch = {"target": (torch.rand(4, 2, 3, 3, generator=generator) < 0.3).float(), "fov": torch.ones(4, 1, 3, 3)}
    multiprocessing.spawn(_half, args=(logits, batch, str(tmp_path)), nprocs=2)
    logits.requires_grad_()
    loss = dice_loss(logits.sigmoid(), batch["target"], batch["fov"])
    (gradient,) = torch.autograd.grad(loss, logits)
    for rank in range(2):
        theirs, theirs_gradient = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        torch.testing.assert_close(theirs, loss.detach())
        torch.testing.assert_close(theirs_gradient / 2, gradient[rank::2])
