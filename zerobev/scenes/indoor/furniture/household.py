"""Contents of closets and laundry rooms: clothes, suitcases, machines and tools."""

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.furniture.piece import Piece, Top, legs, one
from zerobev.scenes.indoor.solids import Solid


def clothes_rail(rng: np.random.Generator) -> Piece:
    """A rail between two posts, full of clothes, with shoes or boxes below."""
    w, h, metal = rng.uniform(0.8, 1.5), rng.uniform(1.5, 1.75), surfaces.metal(rng)
    rail = Solid().rod((-w / 2, 0.25, h), (w / 2, 0.25, h), 0.014, metal)
    for x in (-w / 2, w / 2):
        rail.rod((x, 0.25, 0.02), (x, 0.25, h), 0.016, metal).box((x - 0.02, x + 0.02), (0.05, 0.45), (0, 0.03), metal)
    items, x = [("clothes rack", rail)], -w / 2 + 0.06
    while x < w / 2 - 0.1:
        thick, long = rng.uniform(0.03, 0.09), rng.uniform(0.6, 1.1)
        piece = Solid().box((x, x + thick), (0.06, 0.44), (h - long, h - 0.03), surfaces.fabric(rng), taper=0.8)
        items.append(("clothes", piece))
        x += thick + rng.choice([0.012, 0.03, 0.15])
    return Piece(items, [Top((-w / 2 + 0.04, w / 2 - 0.04), (0.06, 0.44), 0.0, 0.35)])


def linen_shelf(rng: np.random.Generator) -> Piece:
    """Open boards with piles of folded clothes and towels."""
    w, d, h, wood = rng.uniform(0.6, 1.0), rng.uniform(0.34, 0.42), rng.uniform(1.5, 2.0), surfaces.lacquer_or_wood(rng)
    shelf, items, tops = Solid().box((-w / 2, w / 2), (0, 0.012), (0, h), wood, hide="b"), [], []
    for x in (-w / 2, w / 2 - 0.02):
        shelf.box((x, x + 0.02), (0.012, d), (0, h), wood, hide="b")
    for low in np.linspace(0.08, h - 0.02, 5):
        shelf.box((-w / 2 + 0.02, w / 2 - 0.02), (0.012, d), (low - 0.02, low), wood, hide="blr")
        for x in np.linspace(-w / 2, w / 2, 2 * int(w / 0.3) + 1)[1::2] if low < h - 0.1 else ():
            if rng.random() < 0.3:
                tops.append(Top((x - 0.13, x + 0.13), (0.03, d - 0.02), float(low), 0.3))
                continue
            top, cloth = low + rng.uniform(0.08, 0.26), surfaces.fabric(rng)
            pile = Solid().box((x - 0.12, x + 0.12), (0.03, d - 0.03), (low, top), cloth, taper=0.94)
            items.append(("towel" if rng.random() < 0.3 else "clothes", pile))
    return Piece([("shelf", shelf), *items], tops)


def suitcase(rng: np.random.Generator) -> Piece:
    """Upright, with its handle drawn out."""
    w, d, h, skin = rng.uniform(0.35, 0.5), rng.uniform(0.2, 0.28), rng.uniform(0.5, 0.7), surfaces.vivid(rng)
    solid, metal = Solid().box((-w / 2, w / 2), (0, d), (0.04, h), skin), surfaces.metal(rng)
    legs(solid, w / 2 - 0.02, (0.02, d - 0.02), 0.04, 0.04, metal)
    for x in (-0.09, 0.09):
        solid.rod((x, 0.04, h), (x, 0.04, h + 0.3), 0.008, metal, sides=4)
    return one("suitcase", solid.box((-0.1, 0.1), (0.025, 0.055), (h + 0.3, h + 0.33), metal))


def ironing_board(rng: np.random.Generator) -> Piece:
    """Set up, on crossed legs."""
    metal, h, solid = surfaces.metal(rng), rng.uniform(0.8, 0.92), Solid()
    solid.box((-0.6, 0.6), (0.03, 0.38), (h - 0.03, h), surfaces.linen(rng), taper=0.97)
    for y in (0.1, 0.3):
        for x in (-0.45, 0.45):
            solid.rod((x, y, 0.0), (-x * 0.7, y, h - 0.03), 0.013, metal, sides=4)
    return one("ironing board", solid, Top((-0.5, 0.5), (0.06, 0.34), h))


def iron(rng: np.random.Generator) -> Piece:
    """Lying on its sole."""
    solid = Solid().box((-0.12, 0.12), (0, 0.12), (0, 0.04), surfaces.metal(rng))
    return one("iron", solid.box((-0.1, 0.08), (0.03, 0.09), (0.04, 0.13), surfaces.vivid(rng), taper=0.7))


def vacuum_cleaner(rng: np.random.Generator) -> Piece:
    """A drum with a pipe."""
    skin, metal = surfaces.vivid(rng), surfaces.metal(rng)
    solid = Solid().lathe([(0.14, 0.02), (0.15, 0.12), (0.12, 0.26)], (0, 0.16), skin, sides=10)
    solid.rod((0.16, 0.1, 0.05), (0.2, 0.04, 0.95), 0.018, metal)
    return one("vacuum cleaner", solid.box((0.06, 0.32), (0.06, 0.16), (0.0, 0.05), metal))


def boiler(rng: np.random.Generator) -> Piece:
    """A white box or drum for a wall; z = 0 is its underside."""
    white, h = surfaces.ceramic(rng), rng.uniform(0.6, 0.85)
    if rng.random() < 0.5:
        return one("boiler", Solid().box((-0.22, 0.22), (0, 0.32), (0, h), white, hide="b"))
    return one("boiler", Solid().lathe([(0.15, 0.0), (0.2, 0.05), (0.2, h)], (0, 0.21), white, sides=12))


def drying_rack(rng: np.random.Generator) -> Piece:
    """A folding rack with some wet clothes."""
    metal, rack = surfaces.metal(rng), Solid()
    for x in (-0.5, 0.5):
        for y in (0.05, 0.5):
            rack.rod((x, y, 0.0), (x, 0.55 - y, 0.9), 0.012, metal, sides=4)
    items = [("drying rack", rack)]
    for y in np.linspace(0.05, 0.5, 5):
        rack.rod((-0.5, y, 0.9), (0.5, y, 0.9), 0.007, metal, sides=4)
        if rng.random() < 0.6:
            x, w = rng.uniform(-0.42, 0.1), rng.uniform(0.2, 0.32)
            hung = Solid().box((x, x + w), (y - 0.012, y + 0.012), (rng.uniform(0.4, 0.7), 0.93), surfaces.fabric(rng))
            items.append(("clothes", hung))
    return Piece(items)


IN_CLOSETS = (suitcase, vacuum_cleaner)
TOOLS = (ironing_board, vacuum_cleaner, drying_rack)
