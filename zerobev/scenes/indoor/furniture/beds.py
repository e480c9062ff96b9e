"""Beds with their pillows."""

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.furniture.piece import Piece, legs
from zerobev.scenes.indoor.solids import Solid


def _bedding(rng: np.random.Generator, solid: Solid, w: float, d: float, z: float) -> list:
    """Add mattress and blanket to `solid`; returns the pillows as instances."""
    sheet = surfaces.linen(rng)
    blanket = surfaces.fabric(rng) if rng.random() < 0.7 else surfaces.linen(rng)
    top, fold = z + rng.uniform(0.16, 0.24), d * rng.uniform(0.25, 0.5)
    solid.box((-w / 2, w / 2), (0.05, d), (z, top), sheet, hide="u")
    solid.box((-w / 2 - 0.02, w / 2 + 0.02), (fold, d + 0.02), (top - 0.12, top + 0.035), blanket)
    count = 1 if w < 1.2 else 2
    pillows = []
    for row in range(int(rng.integers(1, 3)) if count == 2 else 1):
        cloth = surfaces.linen(rng) if row == 0 else surfaces.fabric(rng)
        for k in range(count):
            x = 0.0 if count == 1 else (k - 0.5) * w * 0.5
            y = 0.08 + 0.3 * row
            size = (0.27, 0.34) if row == 0 else (0.2, 0.2)
            pillow = Solid().box((x - size[0], x + size[0]), (y, y + size[1]), (top, top + 0.11), cloth, taper=0.85)
            pillows.append(("pillow", pillow))
    return pillows


def _frame(solid: Solid, w: float, d: float, z: float, material) -> None:
    solid.box((-w / 2 - 0.03, w / 2 + 0.03), (0.04, d + 0.03), (z - 0.14, z), material)
    legs(solid, w / 2, (0.06, d), z - 0.14, 0.06, material)


def double_bed(rng: np.random.Generator) -> Piece:
    """A wide bed with a headboard of wood."""
    w, d, z = rng.choice([1.4, 1.6, 1.8]), rng.uniform(1.95, 2.1), rng.uniform(0.26, 0.36)
    wood, solid = surfaces.wood(rng), Solid()
    _frame(solid, w, d, z, wood)
    solid.box((-w / 2 - 0.05, w / 2 + 0.05), (0, 0.045), (0.0, rng.uniform(0.85, 1.2)), wood)
    return Piece([("bed", solid), *_bedding(rng, solid, w, d, z)])


def box_spring(rng: np.random.Generator) -> Piece:
    """An upholstered box with a padded headboard."""
    w, d, cloth = rng.choice([1.4, 1.6, 1.8, 2.0]), rng.uniform(1.98, 2.1), surfaces.fabric(rng)
    solid = Solid().box((-w / 2, w / 2), (0.08, d), (0.05, 0.34), cloth)
    top = rng.uniform(0.95, 1.35)
    for k in range(4):
        x = -w / 2 - 0.04 + k * (w + 0.08) / 4
        solid.box((x + 0.004, x + (w + 0.08) / 4 - 0.004), (0, 0.08), (0.1, top), cloth)
    return Piece([("bed", solid), *_bedding(rng, solid, w, d, 0.34)])


def single_bed(rng: np.random.Generator) -> Piece:
    """A narrow bed with a low board at each end."""
    w, d, z, wood = (
        rng.choice([0.8, 0.9, 1.0]),
        rng.uniform(1.9, 2.02),
        rng.uniform(0.25, 0.34),
        surfaces.lacquer_or_wood(rng),
    )
    solid = Solid()
    _frame(solid, w, d, z, wood)
    solid.box((-w / 2 - 0.03, w / 2 + 0.03), (0, 0.04), (0.0, rng.uniform(0.65, 0.95)), wood)
    solid.box((-w / 2 - 0.03, w / 2 + 0.03), (d + 0.03, d + 0.07), (0.0, rng.uniform(0.4, 0.6)), wood)
    return Piece([("bed", solid), *_bedding(rng, solid, w, d, z)])


def bunk_bed(rng: np.random.Generator) -> Piece:
    """Two beds above each other, with a ladder."""
    w, d, wood = 0.9, 2.0, surfaces.lacquer_or_wood(rng)
    solid, pillows = Solid(), []
    for x in (-w / 2 - 0.06, w / 2):
        for y in (0.0, d + 0.03):
            solid.box((x, x + 0.06), (y, y + 0.06), (0, 1.65), wood, hide="u")
    for z in (0.32, 1.22):
        solid.box((-w / 2, w / 2), (0.04, d + 0.05), (z - 0.1, z), wood)
        pillows += _bedding(rng, solid, w - 0.06, d, z)
    for x in (-w / 2 - 0.03, w / 2 + 0.01):
        solid.box((x, x + 0.02), (0.06, d * 0.7), (1.5, 1.6), wood)
    for z in np.arange(0.25, 1.5, 0.28):
        solid.box((w / 2 + 0.01, w / 2 + 0.04), (d - 0.42, d), (float(z), float(z) + 0.04), wood)
    return Piece([("bed", solid), *pillows])


def four_poster(rng: np.random.Generator) -> Piece:
    """A double bed under a frame."""
    w, d, z = rng.choice([1.4, 1.6, 1.8]), 2.0, 0.34
    wood, h, solid = surfaces.wood(rng) if rng.random() < 0.6 else surfaces.metal(rng), rng.uniform(1.7, 2.0), Solid()
    _frame(solid, w, d, z, wood)
    for x in (-w / 2 - 0.08, w / 2 + 0.03):
        for y in (0.0, d + 0.03):
            solid.box((x, x + 0.05), (y, y + 0.05), (0, h), wood, hide="u")
        solid.box((x, x + 0.05), (0.05, d + 0.03), (h - 0.05, h), wood, hide="bf")
    for y in (0.0, d + 0.03):
        solid.box((-w / 2 - 0.03, w / 2 + 0.03), (y, y + 0.05), (h - 0.05, h), wood, hide="lr")
    return Piece([("bed", solid), *_bedding(rng, solid, w, d, z)])


SINGLE = (single_bed, bunk_bed)
DOUBLE = (double_bed, box_spring, four_poster)
BEDS = (*DOUBLE, *SINGLE)
