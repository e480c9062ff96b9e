"""Chairs, armchairs and sofas; stools, ottomans and benches, which are not of class chair."""

import math

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.furniture.piece import Piece, Top, legs, one
from zerobev.scenes.indoor.solids import Solid


def slat_chair(rng: np.random.Generator) -> Piece:
    """Four legs, two posts, horizontal slats."""
    wood, w, d, h = (
        surfaces.lacquer_or_wood(rng),
        rng.uniform(0.4, 0.47),
        rng.uniform(0.42, 0.5),
        rng.uniform(0.43, 0.47),
    )
    top, solid = rng.uniform(0.82, 1.02), Solid()
    legs(solid, w / 2, (0.0, d), h - 0.03, 0.04, wood)
    solid.box((-w / 2, w / 2), (0, d), (h - 0.03, h), wood if rng.random() < 0.5 else surfaces.fabric(rng))
    for x in (-w / 2, w / 2 - 0.04):
        solid.box((x, x + 0.04), (0, 0.035), (h, top), wood, hide="u")
    for z in np.linspace(h + 0.14, top - 0.07, int(rng.integers(2, 5))):
        solid.box((-w / 2 + 0.04, w / 2 - 0.04), (0.008, 0.026), (z, z + 0.055), wood, hide="lr")
    return one("chair", solid)


def spindle_chair(rng: np.random.Generator) -> Piece:
    """Splayed round legs and upright spindles under a top rail."""
    wood, w, h, top = surfaces.wood(rng), rng.uniform(0.42, 0.48), rng.uniform(0.43, 0.46), rng.uniform(0.85, 1.0)
    solid = Solid().box((-w / 2, w / 2), (0.02, w), (h - 0.035, h), wood)
    for x in (-1, 1):
        for y in (0.05, w - 0.05):
            solid.rod((x * (w / 2 - 0.01), y + (y - w / 2) * 0.15, 0), (x * (w / 2 - 0.06), y, h - 0.035), 0.017, wood)
    for x in np.linspace(-w / 2 + 0.04, w / 2 - 0.04, 5):
        solid.rod((x, 0.045, h), (x * 1.05, 0.012, top - 0.05), 0.01, wood, sides=4)
    solid.box((-w / 2 - 0.01, w / 2 + 0.01), (0.0, 0.025), (top - 0.05, top), wood)
    return one("chair", solid)


def padded_chair(rng: np.random.Generator) -> Piece:
    """A dining chair upholstered to the top."""
    cloth, wood, w, h = surfaces.fabric(rng), surfaces.wood(rng), rng.uniform(0.44, 0.52), rng.uniform(0.45, 0.49)
    solid = Solid()
    legs(solid, w / 2, (0.02, w), h - 0.1, 0.045, wood)
    solid.box((-w / 2, w / 2), (0.06, w), (h - 0.1, h), cloth)
    solid.box((-w / 2, w / 2), (0.06, 0.14), (h - 0.1, rng.uniform(0.88, 1.05)), cloth, lean=(0, -0.05))
    return one("chair", solid)


def shell_chair(rng: np.random.Generator) -> Piece:
    """A moulded seat on thin metal or wooden legs."""
    skin, metal = surfaces.paint(rng), surfaces.metal(rng) if rng.random() < 0.5 else surfaces.wood(rng)
    w, h = rng.uniform(0.44, 0.5), rng.uniform(0.43, 0.46)
    solid = Solid()
    for x in (-1, 1):
        for y in (0.1, w - 0.06):
            solid.rod((x * w * 0.46, y + (y - w / 2) * 0.25, 0), (x * w * 0.25, y, h - 0.03), 0.012, metal, sides=4)
    solid.box((-w / 2 * 0.9, w / 2 * 0.9), (0.08, w), (h - 0.03, h), skin, taper=1.08)
    solid.box(
        (-w / 2 * 0.9, w / 2 * 0.9), (0.08, 0.11), (h, rng.uniform(0.76, 0.85)), skin, lean=(0, -0.08), taper=0.85
    )
    for x in (-1, 1):
        left, right = sorted((x * w * 0.45, x * w * 0.49))
        solid.box((left, right), (0.11, w * 0.7), (h, h + 0.16), skin, taper=0.7)
    return one("chair", solid)


def office_chair(rng: np.random.Generator) -> Piece:
    """Five-star base on castors, gas column, seat and tall back; often with armrests."""
    black = surfaces.two_tone("plain", (0.1, 0.1, 0.11), 0.8)
    cloth = surfaces.fabric(rng) if rng.random() < 0.6 else black
    h, w, top, mid = rng.uniform(0.44, 0.52), rng.uniform(0.46, 0.54), rng.uniform(0.9, 1.2), 0.32
    solid = Solid()
    for k in range(5):
        x, y = 0.29 * math.cos(k * 2 * math.pi / 5 + 0.3), 0.29 * math.sin(k * 2 * math.pi / 5 + 0.3)
        solid.rod((0, mid, 0.11), (x, mid + y, 0.07), 0.022, black, sides=4)
        solid.lathe([(0.03, 0.0), (0.03, 0.06)], (x, mid + y), black, sides=6)
    solid.lathe([(0.03, 0.09), (0.03, h - 0.07)], (0, mid), surfaces.metal(rng), sides=6)
    solid.box((-w / 2, w / 2), (mid - w / 2, mid + w / 2), (h - 0.07, h), cloth)
    solid.box((-w / 2 + 0.02, w / 2 - 0.02), (mid - w / 2, mid - w / 2 + 0.07), (h + 0.06, top), cloth, lean=(0, -0.06))
    solid.box((-0.03, 0.03), (mid - w / 2 - 0.02, mid - w / 2 + 0.01), (h - 0.06, h + 0.3), black)
    if rng.random() < 0.65:
        for x in (-w / 2 - 0.04, w / 2):
            solid.box((x, x + 0.04), (mid - 0.03, mid + 0.02), (h - 0.05, h + 0.18), black)
            solid.box((x, x + 0.04), (mid - 0.13, mid + 0.14), (h + 0.18, h + 0.21), black)
    return one("office chair", solid)


def bar_chair(rng: np.random.Generator) -> Piece:
    """A high seat with a low back."""
    frame, seat = surfaces.metal(rng), surfaces.fabric(rng) if rng.random() < 0.5 else surfaces.wood(rng)
    w, h = rng.uniform(0.36, 0.42), rng.uniform(0.62, 0.78)
    solid = Solid()
    if rng.random() < 0.5:
        solid.lathe([(0.2, 0), (0.2, 0.02)], (0, w / 2), frame).lathe(
            [(0.025, 0.02), (0.025, h - 0.05)], (0, w / 2), frame
        )
    else:
        legs(solid, w / 2, (0.0, w), h - 0.05, 0.03, frame)
        solid.box((-w / 2 + 0.03, w / 2 - 0.03), (w - 0.025, w - 0.005), (0.25, 0.28), frame, hide="lr")
    solid.box((-w / 2, w / 2), (0, w), (h - 0.05, h), seat)
    solid.box((-w / 2, w / 2), (0.03, 0.06), (h, h + rng.uniform(0.15, 0.35)), seat, lean=(0, -0.03))
    return one("bar chair", solid)


def armchair(rng: np.random.Generator) -> Piece:
    """A one-seat sofa: straight, or a wing chair with a tall back."""
    w, wing = rng.uniform(0.72, 0.95), rng.random() < 0.35
    return one("armchair", _couch(rng, w, rng.uniform(0.75, 0.9), 1, rng.uniform(0.95, 1.1) if wing else None))


def tub_chair(rng: np.random.Generator) -> Piece:
    """A low round armchair: a ring of back segments around a round cushion."""
    cloth, r, h = surfaces.fabric(rng), rng.uniform(0.34, 0.4), rng.uniform(0.38, 0.43)
    solid = Solid().lathe([(r * 0.9, 0.06), (r, 0.14), (r, h - 0.05), (r * 0.85, h)], (0, r), cloth, sides=10)
    for angle in np.linspace(math.pi * 0.95, math.pi * 2.05, 8):
        part = Solid().box((-r * 0.23, r * 0.23), (-0.045, 0.045), (0.1, h + 0.3), cloth)
        solid.join(part, (r * 0.95 * math.cos(angle), r + r * 0.95 * math.sin(angle), 0), angle + math.pi / 2)
    return one("armchair", solid)


def lounge_chair(rng: np.random.Generator) -> Piece:
    """A wooden frame with loose cushions and open arms."""
    wood, cloth, w = surfaces.wood(rng), surfaces.fabric(rng), rng.uniform(0.64, 0.74)
    solid = Solid()
    for x in (-w / 2, w / 2 - 0.045):
        for y in (0.12, 0.68):
            solid.box((x, x + 0.045), (y, y + 0.045), (0, 0.56), wood, hide="u")
        solid.box((x - 0.01, x + 0.055), (0.08, 0.76), (0.56, 0.59), wood)
    solid.box((-w / 2 + 0.045, w / 2 - 0.045), (0.12, 0.74), (0.24, 0.3), wood)
    solid.box((-w / 2 + 0.05, w / 2 - 0.05), (0.2, 0.78), (0.3, 0.44), cloth)
    solid.box((-w / 2 + 0.05, w / 2 - 0.05), (0.14, 0.28), (0.32, rng.uniform(0.8, 0.95)), cloth, lean=(0, -0.12))
    return one("armchair", solid)


def _couch(rng: np.random.Generator, w: float, d: float, seats: int, back: float | None = None) -> Solid:
    """Base, arms, back and one cushion per seat, with or without feet."""
    cloth, wood = surfaces.fabric(rng), surfaces.wood(rng)
    cushion = cloth if rng.random() < 0.7 else surfaces.fabric(rng)
    arm, feet, h = rng.uniform(0.1, 0.24), rng.choice([0.0, 0.05, 0.14]), rng.uniform(0.4, 0.46)
    back = back or rng.uniform(0.7, 0.92)
    solid = Solid()
    if feet:
        legs(solid, w / 2 - 0.03, (0.03, d - 0.03), feet, 0.05, wood)
    solid.box((-w / 2 + arm, w / 2 - arm), (0, d - 0.02), (feet, h - 0.13), cloth, hide="lr")
    for x in (-w / 2, w / 2 - arm):
        solid.box((x, x + arm), (0, d), (feet, rng.uniform(0.54, 0.56) if arm < 0.2 else 0.6), cloth)
    solid.box((-w / 2 + arm, w / 2 - arm), (0, 0.17), (h - 0.13, back), cloth, hide="u")
    each = (w - 2 * arm) / seats
    for k in range(seats):
        x = -w / 2 + arm + k * each
        solid.box((x + 0.006, x + each - 0.006), (0.17, d + 0.01), (h - 0.13, h), cushion, hide="u")
        solid.box((x + 0.01, x + each - 0.01), (0.17, 0.31), (h, back + 0.03), cushion, hide="u", lean=(0, -0.06))
    return solid


def _with_cushions(rng: np.random.Generator, solid: Solid, w: float, h: float = 0.44) -> Piece:
    """A sofa with some loose cushions, which are separate instances."""
    items = [("couch", solid)]
    for x in rng.permutation(np.linspace(-w / 2 + 0.42, w / 2 - 0.42, 4))[: rng.integers(0, 4)]:
        cushion = Solid().box((-0.19, 0.19), (0.3, 0.4), (h, h + 0.34), surfaces.fabric(rng), lean=(0, -0.06))
        items.append(("pillow", Solid().join(cushion, (float(x), 0.03, 0.0))))
    return Piece(items)


def two_seater(rng: np.random.Generator) -> Piece:
    """A small couch."""
    w = rng.uniform(1.4, 1.7)
    return _with_cushions(rng, _couch(rng, w, rng.uniform(0.8, 0.92), 2), w)


def three_seater(rng: np.random.Generator) -> Piece:
    """A couch of three or four seats."""
    w = rng.uniform(1.9, 2.4)
    return _with_cushions(rng, _couch(rng, w, rng.uniform(0.82, 0.98), int(rng.integers(2, 5))), w)


def corner_sofa(rng: np.random.Generator) -> Piece:
    """An L: a couch with a long seat at one end."""
    w, d, reach, side = rng.uniform(2.2, 2.8), 0.9, rng.uniform(1.45, 1.8), rng.choice([-1, 1])
    cloth, h = surfaces.fabric(rng), 0.43
    solid = Solid().box((-w / 2, w / 2), (0, d), (0.06, h), cloth)
    long_x = sorted((side * (w / 2 - 0.85), side * w / 2))
    solid.box(tuple(long_x), (d, reach), (0.06, h), cloth, hide="b")
    solid.box((-w / 2, w / 2), (0, 0.2), (h, rng.uniform(0.72, 0.85)), cloth, hide="u")
    end = sorted((-side * (w / 2 - 0.18), -side * w / 2))
    solid.box(tuple(end), (0.2, d), (h, 0.58), cloth, hide="ub")
    if rng.random() < 0.6:
        solid.box(tuple(sorted((side * (w / 2 - 0.2), side * w / 2))), (0.2, reach), (h, 0.74), cloth, hide="ub")
    return _with_cushions(rng, solid, w * 0.7)


def bench_sofa(rng: np.random.Generator) -> Piece:
    """A slim sofa without arms on thin legs."""
    w, cloth, metal = rng.uniform(1.6, 2.0), surfaces.fabric(rng), surfaces.metal(rng)
    solid = Solid()
    legs(solid, w / 2 - 0.08, (0.08, 0.74), 0.2, 0.03, metal)
    for k in (0, 1):
        x = -w / 2 + k * w / 2
        solid.box((x + 0.005, x + w / 2 - 0.005), (0.05, 0.8), (0.2, 0.42), cloth)
        solid.box((x + 0.005, x + w / 2 - 0.005), (0.05, 0.2), (0.42, 0.8), cloth, lean=(0, -0.05))
    return _with_cushions(rng, solid, w, 0.42)


def stool(rng: np.random.Generator) -> Piece:
    """A small seat without a back."""
    wood, r, h = surfaces.lacquer_or_wood(rng), rng.uniform(0.15, 0.2), rng.uniform(0.4, 0.5)
    solid = Solid().lathe([(r, h - 0.04), (r, h)], (0, r), wood, sides=10)
    for angle in (0.6, 2.2, 3.8, 5.4):
        c, s = math.cos(angle), math.sin(angle)
        solid.rod((r * c, r + r * s, 0), (0.7 * r * c, r + 0.7 * r * s, h - 0.04), 0.015, wood, sides=4)
    return one("stool", solid, Top((-r / 2, r / 2), (r / 2, 1.5 * r), h))


def ottoman(rng: np.random.Generator) -> Piece:
    """A padded block or drum."""
    cloth, w, h = surfaces.fabric(rng), rng.uniform(0.4, 0.65), rng.uniform(0.35, 0.44)
    if rng.random() < 0.5:
        return one(
            "ottoman", Solid().lathe([(w / 2, 0.0), (w / 2, h - 0.03), (w / 2 - 0.04, h)], (0, w / 2), cloth, 10)
        )
    return one("ottoman", Solid().box((-w / 2, w / 2), (0, w), (0.0, h), cloth))


def bench(rng: np.random.Generator) -> Piece:
    """A plank on two trestles, sometimes padded."""
    wood, w, d = surfaces.wood(rng), rng.uniform(0.8, 1.3), rng.uniform(0.3, 0.4)
    solid = Solid().box((-w / 2, w / 2), (0, d), (0.41, 0.46), wood if rng.random() < 0.6 else surfaces.fabric(rng))
    for x in (-w / 2 + 0.06, w / 2 - 0.12):
        solid.box((x, x + 0.06), (0.03, d - 0.03), (0, 0.41), wood, hide="tu")
    return one("bench", solid, Top((-w / 2 + 0.1, w / 2 - 0.1), (0.05, d - 0.05), 0.46))


DINING = (slat_chair, spindle_chair, padded_chair, shell_chair)
ARMCHAIRS = (armchair, tub_chair, lounge_chair)
SOFAS = (two_seater, three_seater, corner_sofa, bench_sofa)
CHAIRS = (*DINING, office_chair, bar_chair, *ARMCHAIRS)
