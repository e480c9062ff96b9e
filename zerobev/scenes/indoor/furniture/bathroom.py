"""Toilets, basins, tubs, showers."""

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.furniture.piece import Piece, Top, one
from zerobev.scenes.indoor.solids import Material, Solid


def _bowl(solid: Solid, back: float, depth: float, low: float, white: Material, lid: Material) -> None:
    """A pan from `low` to 40 cm with its seat and lid, reaching `depth` metres forward of `back`."""
    w = 0.36
    middle = back + depth - w / 2
    solid.box((-w / 2, w / 2), (back, middle), (low, 0.38), white, taper=1.0)
    solid.lathe([(w * 0.36, low), (w / 2, 0.3), (w / 2, 0.38)], (0, middle), white, sides=12)
    solid.box((-w / 2, w / 2), (back + 0.04, middle), (0.38, 0.42), lid, hide="u")
    solid.lathe([(w / 2 + 0.005, 0.38), (w / 2 + 0.005, 0.42)], (0, middle), lid, sides=12)


def close_coupled_toilet(rng: np.random.Generator) -> Piece:
    """A toilet with the cistern on the pan."""
    white, solid, depth = surfaces.ceramic(rng), Solid(), rng.uniform(0.44, 0.5)
    _bowl(solid, 0.17, depth, 0.0, white, surfaces.ceramic(rng) if rng.random() < 0.8 else surfaces.wood(rng))
    solid.box((-0.2, 0.2), (0, 0.17), (0.38, rng.uniform(0.72, 0.8)), white)
    return one("toilet", solid, Top((-0.18, 0.18), (0.02, 0.16), 0.81, 0.3))


def wall_hung_toilet(rng: np.random.Generator) -> Piece:
    """A pan on the wall, with a flush plate above it."""
    white, solid = surfaces.ceramic(rng), Solid()
    _bowl(solid, 0.0, rng.uniform(0.5, 0.56), rng.uniform(0.1, 0.16), white, surfaces.ceramic(rng))
    solid.box((-0.12, 0.12), (0, 0.012), (0.95, 1.1), surfaces.metal(rng), hide="b")
    return one("toilet", solid)


def built_in_toilet(rng: np.random.Generator) -> Piece:
    """A pan in front of a boxed cistern with a shelf on top."""
    white, solid, box = surfaces.ceramic(rng), Solid(), surfaces.paint(rng)
    solid.box((-0.45, 0.45), (0, 0.2), (0, 1.1), box, hide="bu")
    _bowl(solid, 0.2, 0.5, 0.06, white, white)
    return one("toilet", solid, Top((-0.4, 0.4), (0.02, 0.18), 1.1))


def high_cistern_toilet(rng: np.random.Generator) -> Piece:
    """An old toilet with a high cistern and a pipe."""
    white, solid, metal = surfaces.ceramic(rng), Solid(), surfaces.metal(rng)
    _bowl(solid, 0.05, rng.uniform(0.5, 0.56), 0.0, white, surfaces.wood(rng))
    solid.box((-0.22, 0.22), (0, 0.17), (1.55, 1.85), white if rng.random() < 0.5 else surfaces.wood(rng), hide="b")
    solid.rod((0, 0.06, 0.35), (0, 0.06, 1.55), 0.02, metal)
    return one("toilet", solid)


def pedestal_sink(rng: np.random.Generator) -> Piece:
    """A basin on a column."""
    white, w = surfaces.ceramic(rng), rng.uniform(0.48, 0.6)
    solid = Solid().box((-0.09, 0.09), (0.06, 0.24), (0, 0.68), white, taper=1.2)
    solid.box((-w / 2 * 0.8, w / 2 * 0.8), (0, 0.36), (0.68, 0.84), white, taper=1.25)
    _tap(rng, solid, 0.08, 0.84)
    return one("sink", solid)


def vanity(rng: np.random.Generator) -> Piece:
    """A cabinet with a basin in its top."""
    w, d, body, white = (
        rng.uniform(0.6, 1.2),
        rng.uniform(0.44, 0.52),
        surfaces.lacquer_or_wood(rng),
        surfaces.ceramic(rng),
    )
    cabinet = Solid().box((-w / 2, w / 2), (0, d), (rng.choice([0.0, 0.3]), 0.8), body, hide="b")
    for x in (-w / 4, w / 4):
        cabinet.box((x - w / 4 + 0.01, x + w / 4 - 0.01), (d, d + 0.015), (0.34, 0.77), body, hide="b")
    cabinet.box((-w / 2 - 0.01, w / 2 + 0.01), (0, d + 0.02), (0.8, 0.84), surfaces.stone(rng), hide="b")
    basin = Solid().lathe([(0.13, 0.84), (0.2, 0.94)], (0, d * 0.52), white, sides=12)
    _tap(rng, basin, 0.05, 0.84)
    return Piece(
        [("bathroom cabinet", cabinet), ("sink", basin)],
        [Top((-w / 2, -0.22), (0.02, d), 0.84), Top((0.22, w / 2), (0.02, d), 0.84)],
    )


def _tap(rng: np.random.Generator, solid: Solid, y: float, z: float) -> None:
    metal = surfaces.metal(rng)
    solid.rod((0, y, z), (0, y, z + 0.18), 0.014, metal).rod((0, y, z + 0.17), (0, y + 0.12, z + 0.16), 0.01, metal)


def bathtub(rng: np.random.Generator) -> Piece:
    """A hollow tub with rim, walls and floor, often panelled."""
    w, d, h, white = rng.uniform(1.5, 1.75), rng.uniform(0.7, 0.8), rng.uniform(0.5, 0.6), surfaces.ceramic(rng)
    solid = Solid().box((-w / 2, w / 2), (0, d), (0, 0.15), white, hide="bu")
    for y in ((0.0, 0.08), (d - 0.08, d)):
        solid.box((-w / 2, w / 2), y, (0.15, h), white, hide="u")
    for x in ((-w / 2, -w / 2 + 0.1), (w / 2 - 0.1, w / 2)):
        solid.box(x, (0.08, d - 0.08), (0.15, h), white, hide="ubf")
    metal = surfaces.metal(rng)
    solid.rod((w / 2 - 0.05, d / 2, h), (w / 2 - 0.05, d / 2, h + 0.14), 0.015, metal)
    solid.rod((w / 2 - 0.05, d / 2, h + 0.13), (w / 2 - 0.2, d / 2, h + 0.12), 0.012, metal)
    return one("bathtub", solid)


def shower(rng: np.random.Generator) -> Piece:
    """A tray, a tall rail with its head, and a curtain along one side."""
    w, metal = rng.uniform(0.8, 1.0), surfaces.metal(rng)
    tray = Solid().box((-w / 2, w / 2), (0, w), (0, 0.07), surfaces.ceramic(rng), hide="b")
    rail = Solid().rod((0, 0.05, 0.9), (0, 0.05, 1.95), 0.012, metal).rod((0, 0.05, 1.94), (0, 0.3, 1.92), 0.01, metal)
    rail.lathe([(0.08, 1.9), (0.03, 1.92)], (0, 0.32), metal)
    curtain = Solid()
    cloth = surfaces.two_tone("folds", surfaces.linen(rng).color, 0.85)
    for k in range(5):
        x = -w / 2 + 0.02 + k * 0.09
        curtain.box((x, x + 0.085), (w - 0.05 - 0.025 * (k % 2), w - 0.02 - 0.025 * (k % 2)), (0.12, 1.9), cloth)
    return Piece([("shower tray", tray), ("shower", rail), ("shower curtain", curtain)])


def towel_rail(rng: np.random.Generator) -> Piece:
    """Two rods with towels, for a wall; z = 0 is its lower end."""
    metal, w = surfaces.metal(rng), rng.uniform(0.45, 0.6)
    rail = Solid().rod((-w / 2, 0.06, 0.5), (w / 2, 0.06, 0.5), 0.01, metal)
    for x in (-w / 2, w / 2):
        rail.rod((x, 0.0, 0.5), (x, 0.06, 0.5), 0.01, metal, sides=4)
    towel = Solid().box((-w * 0.35, w * 0.3), (0.03, 0.09), (rng.uniform(0, 0.2), 0.52), surfaces.fabric(rng))
    return Piece([("towel rack", rail), ("towel", towel)])


TOILETS = (close_coupled_toilet, wall_hung_toilet, built_in_toilet, high_cistern_toilet)
SINKS = (pedestal_sink, vanity)
WASHING = (bathtub, shower)
