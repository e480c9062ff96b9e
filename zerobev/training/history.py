"""Training history: losses and validation scores."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Entry:
    """One entry of the history; losses are means since the previous entry."""

    step: int  #: steps done
    loss: float
    main: float  #: loss of the evaluated output (the zero-shot stream)
    aux: float | None
    learning_rate: float  #: of the last step
    seconds: float  #: of training so far, without time lost to interruptions
    validation: float | None  #: score after this step; None: not validated


@dataclass(frozen=True)
class History:
    """History of a finished training."""

    entries: tuple[Entry, ...]
    best_step: int  #: step of the best validation score, and of the final weights
    best_score: float
    seconds: float

    def curves(self) -> dict[str, list[float | None]]:
        """`columns` of the validations and about a hundred other entries, for a record."""
        stride = max(len(self.entries) // 100, 1)
        return columns([e for i, e in enumerate(self.entries) if i % stride == 0 or e.validation is not None])


def columns(entries: Sequence[Entry]) -> dict[str, list[float | None]]:
    """Losses and scores of `entries` by name."""
    return {name: [getattr(e, name) for e in entries] for name in ("step", "loss", "main", "aux", "validation")}
