"""What a training tells of itself: losses and scores, step by step."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Entry:
    """A line of the history; losses are means since the entry before."""

    step: int  #: steps done
    loss: float
    main: float  #: loss of the evaluated output (the zero-shot stream)
    aux: float | None
    learning_rate: float  #: of the last step
    seconds: float  #: of training so far, without those lost to an interruption
    validation: float | None  #: score of the model after this step, where it was validated


@dataclass(frozen=True)
class History:
    """What a finished run tells of itself."""

    entries: tuple[Entry, ...]
    best_step: int  #: whose weights were kept
    best_score: float
    seconds: float

    def curves(self) -> dict[str, list[float | None]]:
        """`columns`, thinned to about a hundred entries beside those at validations: for a record."""
        stride = max(len(self.entries) // 100, 1)
        return columns([e for i, e in enumerate(self.entries) if i % stride == 0 or e.validation is not None])


def columns(entries: Sequence[Entry]) -> dict[str, list[float | None]]:
    """Losses and scores of `entries` by name."""
    return {name: [getattr(e, name) for e in entries] for name in ("step", "loss", "main", "aux", "validation")}
