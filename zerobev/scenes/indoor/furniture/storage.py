"""Cabinets, shelves with their contents, kitchens and their machines."""

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.furniture.piece import Piece, Top, legs, one
from zerobev.scenes.indoor.solids import Material, Solid


def _fronts(
    solid: Solid, x: tuple[float, float], y: float, z: tuple[float, float], grid: tuple[int, int],
    front: Material, knob: Material | None,
) -> None:  # fmt: skip
    """Doors or drawers in (columns, rows) on the front, at `y`, of a carcass."""
    columns, rows = grid
    dx, dz = (x[1] - x[0]) / columns, (z[1] - z[0]) / rows
    for i in range(columns):
        for j in range(rows):
            left, low = x[0] + i * dx, z[0] + j * dz
            solid.box(
                (left + 0.006, left + dx - 0.006), (y, y + 0.016), (low + 0.006, low + dz - 0.006), front, hide="b"
            )
            if knob:
                cx, cz = left + dx / 2, low + dz * (0.5 if dz < 0.4 else 0.55)
                handle = (0.05, 0.008) if dz < 0.4 else (0.008, 0.06)
                solid.box(
                    (cx - handle[0], cx + handle[0]),
                    (y + 0.016, y + 0.035),
                    (cz - handle[1], cz + handle[1]),
                    knob,
                    hide="b",
                )


def _chest(rng: np.random.Generator, name: str, w: float, d: float, h: float, grid: tuple[int, int]) -> Piece:
    """A carcass with fronts, on a plinth or on legs."""
    body = surfaces.lacquer_or_wood(rng)
    front = body if rng.random() < 0.65 else surfaces.lacquer_or_wood(rng)
    foot, solid = rng.choice([0.0, 0.06, 0.14]) if h < 1.3 else 0.0, Solid()
    if foot:
        legs(solid, w / 2, (0.0, d - 0.02), foot, 0.04, body)
    solid.box((-w / 2, w / 2), (0, d - 0.02), (foot, h), body, hide="b")
    _fronts(solid, (-w / 2, w / 2), d - 0.02, (foot + 0.02, h - 0.02), grid, front, surfaces.metal(rng))
    tops = [Top((-w / 2 + 0.03, w / 2 - 0.03), (0.02, d - 0.05), h)] if h < 1.6 else []
    return one(name, solid, *tops)


def nightstand(rng: np.random.Generator) -> Piece:
    """A nightstand."""
    return _chest(rng, "nightstand", rng.uniform(0.38, 0.52), rng.uniform(0.35, 0.42), rng.uniform(0.45, 0.6), (1, 2))


def drawers(rng: np.random.Generator) -> Piece:
    """A chest of drawers."""
    rows = int(rng.integers(3, 6))
    return _chest(
        rng,
        "chest of drawers",
        rng.uniform(0.7, 1.3),
        rng.uniform(0.42, 0.5),
        0.2 * rows + 0.15,
        (int(rng.integers(1, 3)), rows),
    )


def sideboard(rng: np.random.Generator) -> Piece:
    """A wide, low cabinet."""
    return _chest(
        rng,
        "cabinet",
        rng.uniform(1.2, 1.9),
        rng.uniform(0.38, 0.46),
        rng.uniform(0.68, 0.9),
        (int(rng.integers(2, 5)), 1),
    )


def tv_stand(rng: np.random.Generator) -> Piece:
    """A cabinet for a television."""
    return _chest(rng, "tv stand", rng.uniform(1.2, 1.8), rng.uniform(0.38, 0.45), rng.uniform(0.42, 0.6), (3, 1))


def wardrobe(rng: np.random.Generator) -> Piece:
    """A wardrobe with two to four doors."""
    doors = int(rng.integers(2, 5))
    return _chest(rng, "wardrobe", 0.5 * doors, rng.uniform(0.55, 0.62), rng.uniform(1.95, 2.25), (doors, 1))


def shoe_cabinet(rng: np.random.Generator) -> Piece:
    """A shallow cabinet for a hall."""
    return _chest(rng, "shoe cabinet", rng.uniform(0.6, 0.9), 0.26, rng.uniform(0.8, 1.2), (1, 3))


def books(rng: np.random.Generator, width: float, depth: float, room: float) -> Piece:
    """A row of upright books about `width` metres long; an instance is a handful of books."""
    items, x = [], -width / 2
    while x < width / 2 - 0.08:
        bundle, high = Solid(), min(rng.uniform(0.17, 0.27), room - 0.03)
        for _ in range(int(rng.integers(2, 5))):
            thick = rng.uniform(0.02, 0.05)
            if x + thick > width / 2:
                break
            top = high * rng.uniform(0.85, 1.0)
            bundle.box(
                (x, x + thick - 0.001), (0.02, depth * rng.uniform(0.7, 0.95)), (0, top), surfaces.vivid(rng), hide="b"
            )
            x += thick
        items.append(("book" if rng.random() < 0.5 else "books", bundle))
        x += rng.choice([0.0, 0.0, 0.12])
    return Piece([item for item in items if item[1].filled])


def bookshelf(rng: np.random.Generator) -> Piece:
    """Boards between two sides, with books and a few boxes."""
    w, d, h, wood = rng.uniform(0.6, 1.1), rng.uniform(0.26, 0.34), rng.uniform(1.2, 2.1), surfaces.lacquer_or_wood(rng)
    shelf, items, tops = Solid(), [], []
    shelf.box((-w / 2, w / 2), (0, 0.01), (0, h), wood, hide="b")
    for x in (-w / 2, w / 2 - 0.02):
        shelf.box((x, x + 0.02), (0.01, d), (0, h), wood, hide="b")
    levels = np.linspace(0.06, h - 0.02, round(h / 0.36) + 1)
    for low, high in zip(levels, np.append(levels[1:], levels[-1] + 0.4)):
        shelf.box((-w / 2 + 0.02, w / 2 - 0.02), (0.01, d), (float(low) - 0.02, float(low)), wood, hide="blr")
        room = float(high - low) - 0.03
        if high <= levels[-1] and rng.random() < 0.6:
            width = (w - 0.06) * rng.uniform(0.5, 1.0)
            x = (w - 0.06 - width) / 2 * rng.choice([-1, 1])
            items += books(rng, width, d, room).moved(x, 0.0, float(low)).items
        elif high <= levels[-1] or h < 1.5:
            tops.append(Top((-w / 2 + 0.04, w / 2 - 0.04), (0.03, d - 0.02), float(low), room))
    return Piece([("bookshelf", shelf), *items], tops)


def wall_shelf(rng: np.random.Generator) -> Piece:
    """One board on the wall; z = 0 is its underside."""
    w, d = rng.uniform(0.6, 1.2), rng.uniform(0.18, 0.25)
    solid = Solid().box((-w / 2, w / 2), (0, d), (0, 0.03), surfaces.lacquer_or_wood(rng), hide="b")
    return one("shelf", solid, Top((-w / 2, w / 2), (0.02, d), 0.03, 0.35))


def kitchen_row(rng: np.random.Generator, length: float) -> Piece:
    """Base cabinets with worktop, sink, cooker and a fridge at one end; wall cabinets and a hood above."""
    front, metal, stone = surfaces.lacquer_or_wood(rng), surfaces.metal(rng), surfaces.stone(rng)
    white = (
        surfaces.two_tone("plain", (0.9, 0.9, 0.91), 0.95)
        if rng.random() < 0.5
        else surfaces.two_tone("plain", (0.66, 0.67, 0.69), 0.9)
    )
    black = surfaces.two_tone("plain", (0.06, 0.06, 0.07), 1.4)
    x0, tall = -length / 2 + 0.62, rng.uniform(1.5, 1.95)
    fridge = Solid().box((-length / 2, x0 - 0.02), (0, 0.62), (0, tall), white, hide="b")
    _fronts(fridge, (-length / 2, x0 - 0.02), 0.62, (0.02, tall * 0.62), (1, 1), white, metal)
    _fronts(fridge, (-length / 2, x0 - 0.02), 0.62, (tall * 0.62, tall), (1, 1), white, metal)
    items, tops = [("refrigerator", fridge)], []
    modules = max(2, int((length - 0.62) / 0.55))
    each = (length - 0.62) / modules
    cooker, basin = (
        (0, modules - 1) if modules < 4 else (int(rng.integers(0, 2)), modules - 1 - int(rng.integers(0, 2)))
    )
    for k in range(modules):
        x = (x0 + k * each, x0 + (k + 1) * each)
        middle = (x[0] + x[1]) / 2
        unit = Solid().box(x, (0, 0.56), (0.1, 0.86), front, hide="blt" + "r" * (k < modules - 1))
        unit.box(x, (0.05, 0.5), (0.0, 0.1), black, hide="bt")
        if k == cooker:
            _fronts(unit, x, 0.56, (0.25, 0.84), (1, 1), black, metal)
            plate = Solid().box((middle - 0.25, middle + 0.25), (0.05, 0.53), (0.9, 0.91), black, hide="u")
            items += [("oven", unit), ("stove", plate)]
        else:
            _fronts(unit, x, 0.56, (0.1, 0.86), (1, int(rng.choice([1, 3]))), front, metal)
            items.append(
                (
                    ("dishwasher" if rng.random() < 0.5 else "washing machine")
                    if k == basin + 1
                    else "kitchen cabinet",
                    unit,
                )
            )
        if k == basin:
            sink = Solid().box((middle - 0.2, middle + 0.2), (0.1, 0.48), (0.895, 0.905), metal, hide="u")
            sink.rod((middle, 0.06, 0.9), (middle, 0.06, 1.15), 0.014, metal).rod(
                (middle, 0.06, 1.14), (middle, 0.25, 1.1), 0.011, metal
            )
            items.append(("sink", sink))
        elif k != cooker:
            tops.append(Top((x[0] + 0.04, x[1] - 0.04), (0.04, 0.5), 0.9, 0.45))
    items.append(("kitchen counter", Solid().box((x0, length / 2), (0, 0.6), (0.86, 0.9), stone, hide="b")))
    if rng.random() < 0.8:
        for k in range(modules):
            x = (x0 + k * each, x0 + (k + 1) * each)
            if k == cooker:
                hood = Solid().box((x[0] + 0.02, x[1] - 0.02), (0, 0.45), (1.55, 1.65), metal, hide="b")
                items.append(
                    ("range hood", hood.box((x[0] + 0.15, x[1] - 0.15), (0, 0.28), (1.65, 2.15), metal, hide="bu"))
                )
            elif rng.random() < 0.85:
                cabinet = Solid().box(x, (0, 0.33), (1.45, 2.1), front, hide="b")
                _fronts(cabinet, x, 0.33, (1.45, 2.1), (1, 1), front, metal)
                items.append(("kitchen cabinet", cabinet))
    return Piece(items, tops)


def kitchen_island(rng: np.random.Generator) -> Piece:
    """A free block with a worktop that overhangs at the back, for bar chairs."""
    w, front = rng.uniform(1.2, 1.9), surfaces.lacquer_or_wood(rng)
    solid = Solid().box((-w / 2 + 0.03, w / 2 - 0.03), (0.25, 0.85), (0, 0.87), front, hide="t")
    _fronts(solid, (-w / 2 + 0.03, w / 2 - 0.03), 0.85, (0.08, 0.86), (3, 1), front, surfaces.metal(rng))
    solid.box((-w / 2, w / 2), (0, 0.9), (0.87, 0.91), surfaces.stone(rng))
    return one("kitchen island", solid, Top((-w / 2 + 0.1, w / 2 - 0.1), (0.1, 0.8), 0.91))


def washing_machine(rng: np.random.Generator) -> Piece:
    """A white box with a round door."""
    white, black = surfaces.ceramic(rng), surfaces.two_tone("plain", (0.12, 0.12, 0.14), 1.3)
    solid = Solid().box((-0.3, 0.3), (0.02, 0.58), (0, 0.85), white, hide="b")
    solid.rod((0, 0.58, 0.42), (0, 0.61, 0.42), 0.17, black, sides=12)
    solid.box((-0.28, 0.28), (0.58, 0.585), (0.73, 0.83), surfaces.metal(rng), hide="b")
    return one("washing machine", solid, Top((-0.26, 0.26), (0.05, 0.54), 0.85))
