"""Potted plants, flowers, hanging plants."""

import math

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.furniture.piece import Piece, one
from zerobev.scenes.indoor.solids import Material, Solid


def _pot(rng: np.random.Generator, solid: Solid, r: float, h: float, z: float = 0.0) -> None:
    skin = [surfaces.ceramic, surfaces.vivid, surfaces.paint, surfaces.wood][rng.integers(4)](rng)
    soil = surfaces.two_tone("foliage", (0.22, 0.15, 0.1), 0.6)
    solid.lathe([(r * rng.uniform(0.6, 0.95), z), (r, z + h)], (0, r), skin)
    solid.lathe([(r * 0.88, z + h), (r * 0.86, z + h + 0.008)], (0, r), soil)


def _crown(
    rng: np.random.Generator, solid: Solid, center: tuple[float, float, float], count: int, length: float,
    leaf: Material, rise: tuple[float, float], width: float,
) -> None:  # fmt: skip
    """Leaves around a point, at angles of `rise` (radians) above the horizontal."""
    for k in range(count):
        turn = 2.4 * k + rng.uniform(-0.3, 0.3)
        up = rng.uniform(*rise)
        reach = length * rng.uniform(0.7, 1.0)
        direction = np.array([math.cos(turn) * math.cos(up), math.sin(turn) * math.cos(up), math.sin(up)])
        base = np.array(center) + 0.12 * reach * direction
        solid.leaf(base, base + reach * direction, width * rng.uniform(0.8, 1.2), leaf)


def _potted(
    rng: np.random.Generator, r: float, h: float, count: tuple[int, int], length: tuple[float, float],
    rise: tuple[float, float], slender: float,
) -> Piece:  # fmt: skip
    """A pot and one crown of leaves with a ratio of length to width of `slender`."""
    solid, size = Solid(), rng.uniform(*length)
    _pot(rng, solid, r, h)
    _crown(rng, solid, (0, r, h - 0.02), int(rng.integers(*count)), size, surfaces.foliage(rng), rise, size / slender)
    return one("potted plant", solid)


def bushy_plant(rng: np.random.Generator) -> Piece:
    """Many broad leaves from one pot."""
    return _potted(rng, rng.uniform(0.11, 0.2), rng.uniform(0.18, 0.4), (16, 28), (0.3, 0.55), (0.35, 1.4), 2.9)


def tall_plant(rng: np.random.Generator) -> Piece:
    """A trunk with a crown, about as tall as a person."""
    solid, r, h, top = Solid(), rng.uniform(0.14, 0.2), rng.uniform(0.25, 0.4), rng.uniform(0.9, 1.5)
    _pot(rng, solid, r, h)
    solid.rod((0, r, h), (rng.uniform(-0.06, 0.06), r, top), 0.018, surfaces.wood(rng), sides=6)
    leaf = surfaces.foliage(rng)
    for z in np.linspace(h + 0.45 * (top - h), top, 4):
        _crown(rng, solid, (0, r, float(z)), 7, rng.uniform(0.25, 0.42), leaf, (-0.1, 1.0), rng.uniform(0.07, 0.16))
    return one("plant", solid)


def snake_plant(rng: np.random.Generator) -> Piece:
    """Stiff upright blades."""
    return _potted(rng, rng.uniform(0.1, 0.16), rng.uniform(0.15, 0.3), (9, 16), (0.45, 0.8), (1.15, 1.5), 7.5)


def small_tree(rng: np.random.Generator) -> Piece:
    """A clipped ball of foliage on a stem, like a laurel."""
    solid, r, h, top = Solid(), rng.uniform(0.14, 0.2), rng.uniform(0.25, 0.35), rng.uniform(1.0, 1.4)
    _pot(rng, solid, r, h)
    solid.rod((0, r, h), (0, r, top), 0.02, surfaces.wood(rng), sides=6)
    ball, leaf = rng.uniform(0.18, 0.28), surfaces.foliage(rng)
    profile = [(ball * math.cos(a), top + ball * math.sin(a)) for a in np.linspace(-1.5, 1.5, 6)]
    solid.lathe(profile, (0, r), leaf)
    _crown(rng, solid, (0, r, top), 14, ball * 1.2, leaf, (-1.0, 1.3), 0.12)
    return one("potted plant", solid)


def table_plant(rng: np.random.Generator) -> Piece:
    """A small plant for a table or a sill."""
    return _potted(rng, rng.uniform(0.05, 0.08), rng.uniform(0.08, 0.13), (8, 14), (0.12, 0.22), (0.4, 1.4), 2.8)


def bouquet(rng: np.random.Generator) -> Piece:
    """Cut flowers in a vase."""
    solid, r, h = Solid(), rng.uniform(0.04, 0.06), rng.uniform(0.15, 0.25)
    solid.lathe([(r * 0.7, 0), (r, h * 0.5), (r * 0.6, h)], (0, r), surfaces.vivid(rng))
    _crown(rng, solid, (0, r, h - 0.02), 8, 0.2, surfaces.foliage(rng), (0.7, 1.4), 0.04)
    _crown(rng, solid, (0, r, h + 0.12), 9, 0.12, surfaces.vivid(rng), (0.3, 1.4), 0.09)
    return one("flowers", solid)


def hanging_plant(rng: np.random.Generator) -> Piece:
    """A pot on cords from the ceiling, with trailing leaves; z = 0 is the ceiling."""
    solid, r, drop = Solid(), rng.uniform(0.09, 0.14), rng.uniform(0.5, 0.9)
    for angle in (0.5, 2.6, 4.7):
        x, y = r * math.cos(angle), r + r * math.sin(angle)
        solid.rod((x, y, -drop), (0, r, -0.005), 0.004, surfaces.wood(rng), sides=4)
    _pot(rng, solid, r, 0.16, -drop - 0.16)
    leaf = surfaces.foliage(rng)
    _crown(rng, solid, (0, r, -drop), 14, 0.25, leaf, (-0.5, 1.0), 0.08)
    _crown(rng, solid, (0, r, -drop - 0.05), 12, 0.45, leaf, (-1.2, -0.7), 0.07)
    return one("plant", solid)


STANDING = (bushy_plant, tall_plant, snake_plant, small_tree)
SMALL = (table_plant, bouquet)
PLANTS = (*STANDING, *SMALL, hanging_plant)
