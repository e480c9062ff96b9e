"""The result of a design: instances in a local frame, and tops for smaller pieces."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from zerobev.scenes.indoor.solids import Material, Solid


@dataclass(frozen=True)
class Top:
    """A free level rectangle of a piece, metres."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: float
    room: float = 0.6  #: free height above it, metres


@dataclass
class Piece:
    """Instances (name, solid); x to the right, y to the front from the back at y = 0, z up from the floor."""

    items: list[tuple[str, Solid]]
    tops: list[Top] = field(default_factory=list)

    @cached_property
    def bounds(self) -> np.ndarray:
        """(2, 3) lower and upper corner, metres."""
        bounds = np.stack([solid.bounds for _, solid in self.items])
        return np.stack([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])

    def moved(self, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> "Piece":
        """The piece at another pose, without its tops."""
        return Piece([(name, Solid().join(solid, (x, y, z), yaw)) for name, solid in self.items])

    def uncovered(self) -> "Piece":
        """The piece with its back visible."""
        return Piece([(name, solid.uncovered()) for name, solid in self.items], self.tops)

    def stretched(self, factor: np.ndarray) -> "Piece":
        """The piece with each axis scaled by `factor` (3,) about its origin."""
        x, y, z = factor.tolist()
        tops = [
            Top((x * top.x[0], x * top.x[1]), (y * top.y[0], y * top.y[1]), z * top.z, z * top.room)
            for top in self.tops
        ]
        return Piece([(name, solid.stretched(factor)) for name, solid in self.items], tops)


def one(name: str, solid: Solid, *tops: Top) -> Piece:
    """A piece of one instance."""
    return Piece([(name, solid)], list(tops))


def legs(solid: Solid, x: float, y: tuple[float, float], height: float, side: float, material: Material) -> None:
    """Four upright legs under a rectangle from -x to x and over y."""
    for left in (-x, x - side):
        for back in (y[0], y[1] - side):
            solid.box((left, left + side), (back, back + side), (0, height), material, hide="tu")
