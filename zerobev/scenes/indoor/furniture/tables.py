"""Tables and desks."""

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.furniture.piece import Piece, Top, legs, one
from zerobev.scenes.indoor.solids import Solid


def _slab_table(rng: np.random.Generator, name: str, w: float, d: float, h: float) -> Piece:
    """Four legs under a board, or two trestles, or a block in the middle."""
    wood = surfaces.lacquer_or_wood(rng)
    top = wood if rng.random() < 0.7 else surfaces.stone(rng)
    solid, edge, style = Solid(), rng.uniform(0.025, 0.045), rng.integers(3)
    solid.box((-w / 2, w / 2), (0, d), (h - edge, h), top)
    if style == 0 or h < 0.5:
        legs(solid, w / 2 - 0.03, (0.03, d - 0.03), h - edge, rng.uniform(0.04, 0.08), wood)
    elif style == 1:
        for x in (-w / 2 + 0.12, w / 2 - 0.19):
            solid.box((x, x + 0.07), (0.2, d - 0.2), (0, 0.06), wood, hide="u")
            solid.box((x, x + 0.07), (d / 2 - 0.08, d / 2 + 0.08), (0.06, h - edge), wood, hide="tu")
        solid.box((-w / 2 + 0.19, w / 2 - 0.19), (d / 2 - 0.02, d / 2 + 0.02), (0.3, 0.38), wood, hide="lr")
    else:
        legs(solid, w / 2 - 0.02, (0.02, d - 0.02), h - edge, 0.045, surfaces.metal(rng))
        solid.box((-w / 2 + 0.06, w / 2 - 0.06), (0.05, d - 0.05), (h - edge - 0.08, h - edge), wood, hide="t")
    return one(name, solid, Top((-w / 2 + 0.04, w / 2 - 0.04), (0.04, d - 0.04), h))


def dining_table(rng: np.random.Generator, seats: int = 4) -> Piece:
    """A table for `seats` people, two of them at the ends if more than four."""
    side = (seats - 2 * (seats > 4)) // 2
    return _slab_table(
        rng, "table", max(0.75, 0.62 * side + rng.uniform(0.0, 0.2)), rng.uniform(0.78, 0.95), rng.uniform(0.72, 0.77)
    )


def round_table(rng: np.random.Generator, radius: float = 0.55) -> Piece:
    """A round board on a column."""
    wood, h = surfaces.lacquer_or_wood(rng), rng.uniform(0.72, 0.76)
    solid = Solid().lathe([(radius * 0.5, 0), (radius * 0.45, 0.04)], (0, radius), wood)
    solid.lathe([(0.07, 0.04), (0.05, h - 0.035)], (0, radius), wood)
    solid.lathe([(radius, h - 0.035), (radius, h)], (0, radius), wood, sides=12)
    return one("table", solid, Top((-radius * 0.6, radius * 0.6), (radius * 0.4, radius * 1.6), h))


def coffee_table(rng: np.random.Generator) -> Piece:
    """A low table for a sofa."""
    if rng.random() < 0.3:
        r, h, skin = rng.uniform(0.3, 0.45), rng.uniform(0.32, 0.45), surfaces.lacquer_or_wood(rng)
        solid = (
            Solid()
            .lathe([(r * 0.6, 0), (r * 0.6, h - 0.03)], (0, r), skin)
            .lathe([(r, h - 0.03), (r, h)], (0, r), skin, sides=12)
        )
        return one("coffee table", solid, Top((-r * 0.6, r * 0.6), (r * 0.4, r * 1.6), h))
    return _slab_table(rng, "coffee table", rng.uniform(0.8, 1.3), rng.uniform(0.5, 0.65), rng.uniform(0.34, 0.46))


def side_table(rng: np.random.Generator) -> Piece:
    """A small table beside a seat."""
    side = rng.uniform(0.36, 0.5)
    return _slab_table(rng, "side table", side, side, rng.uniform(0.46, 0.6))


def console(rng: np.random.Generator) -> Piece:
    """A narrow table along a wall."""
    return _slab_table(rng, "console table", rng.uniform(0.8, 1.3), rng.uniform(0.28, 0.36), rng.uniform(0.76, 0.86))


def desk(rng: np.random.Generator) -> Piece:
    """A board on a drawer unit and two legs."""
    w, d, h, wood = (
        rng.uniform(1.1, 1.7),
        rng.uniform(0.58, 0.75),
        rng.uniform(0.72, 0.76),
        surfaces.lacquer_or_wood(rng),
    )
    solid = Solid().box((-w / 2, w / 2), (0, d), (h - 0.03, h), wood)
    unit = sorted(rng.choice([-1, 1]) * np.array([w / 2 - 0.42, w / 2 - 0.02]))
    other = -np.sign(unit[0]) * (w / 2 - 0.04)
    solid.box((unit[0], unit[1]), (0.04, d - 0.04), (0.03, h - 0.03), wood, hide="t")
    for z in np.linspace(0.05, h - 0.25, 3):
        solid.box(
            (unit[0] + 0.015, unit[1] - 0.015), (d - 0.04, d - 0.025), (float(z), float(z) + 0.19), wood, hide="b"
        )
    for y in (0.05, d - 0.1):
        solid.box((other - 0.025, other + 0.025), (y, y + 0.05), (0, h - 0.03), wood, hide="tu")
    return one("desk", solid, Top((-w / 2 + 0.05, w / 2 - 0.05), (0.05, d - 0.08), h))
