"""The learning rate schedule (paper, "Implementation and training details")."""

from typing import Any

from torch.optim import Optimizer, lr_scheduler

from zerobev.config import TrainConfig


class Schedule:
    """Linear warm-up, exponential decay, and halving on a plateau of the validation score.

    These are three factors on the configured rate: (t + 1) / warmup for step t < `warmup`; `decay` every `decay_every`
    steps; 1/2 at the first validation after `patience` validations without progress (a score at least 0.01 % lower), as
    in torch's `ReduceLROnPlateau`.
    """

    def __init__(self, optimizer: Optimizer, config: TrainConfig) -> None:
        self._steps: list[lr_scheduler.LRScheduler] = [lr_scheduler.StepLR(optimizer, config.decay_every, config.decay)]
        if config.warmup > 1:
            self._steps.append(lr_scheduler.LinearLR(optimizer, 1 / config.warmup, total_iters=config.warmup - 1))
        self._plateau = lr_scheduler.ReduceLROnPlateau(optimizer, factor=0.5, patience=config.patience)

    def step(self) -> None:
        """Advance by one step; call after every step of the optimiser."""
        for scheduler in self._steps:
            scheduler.step()

    def validated(self, score: float) -> None:
        """Take the score of a validation; lower is better."""
        self._plateau.step(score)

    def state_dict(self) -> list[dict[str, Any]]:
        """State of the three factors; the rate itself is in the optimiser's state."""
        return [scheduler.state_dict() for scheduler in (*self._steps, self._plateau)]

    def load_state_dict(self, states: list[dict[str, Any]]) -> None:
        """The inverse of `state_dict`."""
        for scheduler, state in zip((*self._steps, self._plateau), states, strict=True):
            scheduler.load_state_dict(state)
