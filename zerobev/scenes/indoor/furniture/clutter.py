"""Small things: on tops, on walls, on the floor, under the ceiling."""

import math

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.furniture.piece import Piece, one
from zerobev.scenes.indoor.solids import Material, Solid

WARM = (1.0, 0.93, 0.78)


def vase(rng: np.random.Generator) -> Piece:
    """A vase of one colour."""
    r, h = rng.uniform(0.04, 0.1), rng.uniform(0.15, 0.38)
    skin = surfaces.vivid(rng) if rng.random() < 0.6 else surfaces.ceramic(rng)
    return one("vase", Solid().lathe([(r * 0.6, 0), (r, h * 0.4), (r * 0.5, h * 0.8), (r * 0.65, h)], (0, r), skin))


def bowl(rng: np.random.Generator) -> Piece:
    """A bowl, sometimes with fruit."""
    r = rng.uniform(0.09, 0.16)
    solid = Solid().lathe([(r * 0.5, 0), (r, r * 0.55)], (0, r), surfaces.vivid(rng), sides=10)
    items = [("bowl", solid)]
    if rng.random() < 0.5:
        fruit = Solid()
        for k in range(3):
            x, y = 0.45 * r * math.cos(2.1 * k), r + 0.45 * r * math.sin(2.1 * k)
            fruit.lathe(
                [(0.02, r * 0.56), (0.036, r * 0.56 + 0.03), (0.02, r * 0.56 + 0.065)],
                (x, y),
                surfaces.vivid(rng),
                sides=6,
            )
        items.append(("fruit", fruit))
    return Piece(items)


def bottle(rng: np.random.Generator) -> Piece:
    """A bottle of wine, soap or shampoo."""
    r, h = rng.uniform(0.025, 0.042), rng.uniform(0.15, 0.32)
    return one(
        "bottle",
        Solid().lathe([(r, 0), (r, h * 0.65), (r * 0.4, h * 0.78), (r * 0.4, h)], (0, r), surfaces.vivid(rng), sides=6),
    )


def cup(rng: np.random.Generator) -> Piece:
    """A cup without its handle."""
    return one("cup", Solid().lathe([(0.032, 0), (0.042, 0.09)], (0, 0.042), surfaces.vivid(rng), sides=8))


def plate(rng: np.random.Generator) -> Piece:
    """A plate."""
    return one("plate", Solid().lathe([(0.07, 0), (0.125, 0.02)], (0, 0.125), surfaces.ceramic(rng), sides=10))


def book_pile(rng: np.random.Generator) -> Piece:
    """Lying books, one instance per book."""
    items, z = [], 0.0
    for _ in range(int(rng.integers(1, 4))):
        w, d, h = rng.uniform(0.18, 0.28), rng.uniform(0.13, 0.2), rng.uniform(0.015, 0.04)
        items.append(
            ("book", Solid().box((-w / 2, w / 2), (0.1 - d / 2, 0.1 + d / 2), (z, z + h), surfaces.vivid(rng)))
        )
        z += h
    return Piece(items)


def box(rng: np.random.Generator) -> Piece:
    """A box of cardboard or of a colour."""
    w, d, h = rng.uniform(0.15, 0.35), rng.uniform(0.12, 0.28), rng.uniform(0.08, 0.25)
    skin = surfaces.two_tone("plain", (0.72, 0.56, 0.38), 0.9) if rng.random() < 0.4 else surfaces.vivid(rng)
    return one("box", Solid().box((-w / 2, w / 2), (0, d), (0, h), skin))


def photo_frame(rng: np.random.Generator) -> Piece:
    """A small standing picture."""
    w, h = rng.uniform(0.1, 0.2), rng.uniform(0.13, 0.24)
    solid = Solid().box((-w / 2, w / 2), (0.03, 0.05), (0, h), surfaces.wood(rng), lean=(0, -0.03))
    solid.box(
        (-w / 2 + 0.015, w / 2 - 0.015),
        (0.051, 0.054),
        (0.015, h - 0.015),
        surfaces.picture(rng),
        hide="brltu",
        lean=(0, -0.026),
    )
    return one("picture", solid)


def candle(rng: np.random.Generator) -> Piece:
    """One to three candles on a plate."""
    solid = Solid().lathe([(0.07, 0), (0.07, 0.01)], (0, 0.07), surfaces.metal(rng))
    for k in range(int(rng.integers(1, 4))):
        at = (0.035 * math.cos(2.1 * k), 0.07 + 0.035 * math.sin(2.1 * k))
        solid.lathe([(0.02, 0.01), (0.02, rng.uniform(0.06, 0.18))], at, surfaces.linen(rng), sides=6)
    return one("candle", solid)


def laptop(rng: np.random.Generator) -> Piece:
    """An open laptop."""
    metal, w = surfaces.metal(rng), rng.uniform(0.3, 0.38)
    solid = Solid().box((-w / 2, w / 2), (0.06, 0.28), (0, 0.016), metal)
    solid.box((-w / 2, w / 2), (0.05, 0.06), (0.016, 0.22), metal, lean=(0, -0.05))
    solid.box(
        (-w / 2 + 0.01, w / 2 - 0.01),
        (0.061, 0.063),
        (0.03, 0.21),
        surfaces.screen(rng),
        lean=(0, -0.046),
        hide="brltu",
    )
    return one("laptop", solid)


def keyboard(rng: np.random.Generator) -> Piece:
    """A keyboard with a mouse."""
    skin = surfaces.paint(rng)
    mouse = Solid().box((0.26, 0.32), (0.03, 0.13), (0, 0.03), skin, taper=0.8)
    return Piece([("keyboard", Solid().box((-0.22, 0.22), (0, 0.14), (0, 0.02), skin)), ("mouse", mouse)])


def kettle(rng: np.random.Generator) -> Piece:
    """A kettle with its handle."""
    metal = surfaces.metal(rng)
    solid = Solid().lathe([(0.09, 0), (0.09, 0.03), (0.065, 0.2), (0.03, 0.23)], (0, 0.09), metal)
    return one(
        "kettle",
        solid.rod((-0.08, 0.09, 0.05), (-0.12, 0.09, 0.19), 0.012, metal, sides=4).rod(
            (-0.12, 0.09, 0.185), (-0.05, 0.09, 0.2), 0.012, metal, sides=4
        ),
    )


def microwave(rng: np.random.Generator) -> Piece:
    """A box with a dark door."""
    skin = surfaces.metal(rng)
    solid = Solid().box((-0.24, 0.24), (0, 0.34), (0, 0.28), skin, hide="b")
    return one(
        "microwave",
        solid.box(
            (-0.22, 0.1), (0.34, 0.35), (0.03, 0.25), surfaces.two_tone("plain", (0.05, 0.05, 0.06), 1.5), hide="b"
        ),
    )


def toaster(rng: np.random.Generator) -> Piece:
    """A toaster with two slots."""
    return one("toaster", Solid().box((-0.14, 0.14), (0, 0.17), (0, 0.19), surfaces.metal(rng), taper=0.9))


def table_lamp(rng: np.random.Generator) -> Piece:
    """A foot, a stem and a glowing shade."""
    h, r = rng.uniform(0.35, 0.6), rng.uniform(0.1, 0.17)
    foot = surfaces.vivid(rng) if rng.random() < 0.5 else surfaces.metal(rng)
    solid = Solid().lathe([(r * 0.6, 0), (r * 0.5, 0.03), (0.02, 0.05), (0.015, h * 0.6)], (0, r), foot)
    return one("table lamp", solid.lathe([(r, h * 0.55), (r * 0.65, h)], (0, r), surfaces.glowing(WARM), sides=10))


def floor_lamp(rng: np.random.Generator) -> Piece:
    """A floor lamp, higher than a seated person."""
    h, r, metal = rng.uniform(1.4, 1.75), rng.uniform(0.15, 0.22), surfaces.metal(rng)
    solid = (
        Solid().lathe([(r * 0.8, 0), (r * 0.8, 0.02)], (0, r), metal).rod((0, r, 0.02), (0, r, h - 0.2), 0.014, metal)
    )
    return one("floor lamp", solid.lathe([(r, h - 0.25), (r * 0.7, h)], (0, r), surfaces.glowing(WARM), sides=10))


def ceiling_lamp(rng: np.random.Generator) -> Piece:
    """A pendant, a bowl or a panel; z = 0 is the ceiling."""
    shade, solid, style = surfaces.glowing(WARM), Solid(), rng.integers(3)
    if style == 0:
        drop, r = rng.uniform(0.35, 0.6), rng.uniform(0.13, 0.25)
        solid.rod((0, 0, -drop + 0.15), (0, 0, -0.002), 0.006, surfaces.metal(rng), sides=4)
        solid.lathe([(r, -drop), (r * 0.4, -drop + 0.2)], (0, 0), shade, sides=10)
    elif style == 1:
        r = rng.uniform(0.15, 0.25)
        solid.lathe([(r * 0.5, -0.12), (r, -0.05), (r, -0.005)], (0, 0), shade, sides=10)
    else:
        solid.box((-0.3, 0.3), (-0.1, 0.1), (-0.06, -0.005), shade, hide="t")
    return one("ceiling lamp", solid)


def painting(rng: np.random.Generator) -> Piece:
    """A framed picture for a wall; z = 0 is its lower edge."""
    w, h, frame = rng.uniform(0.3, 1.1), rng.uniform(0.3, 0.8), surfaces.lacquer_or_wood(rng)
    solid = Solid().box((-w / 2, w / 2), (0, 0.025), (0, h), frame, hide="b")
    return one(
        "picture",
        solid.box((-w / 2 + 0.03, w / 2 - 0.03), (0.025, 0.028), (0.03, h - 0.03), surfaces.picture(rng), hide="brltu"),
    )


def mirror(rng: np.random.Generator) -> Piece:
    """A framed mirror without reflections."""
    w, h = rng.uniform(0.45, 0.9), rng.uniform(0.6, 0.95)
    solid = Solid().box((-w / 2, w / 2), (0, 0.02), (0, h), surfaces.metal(rng), hide="b")
    glass = surfaces.two_tone("plain", (0.72, 0.77, 0.8), 1.1)
    return one("mirror", solid.box((-w / 2 + 0.02, w / 2 - 0.02), (0.02, 0.024), (0.02, h - 0.02), glass, hide="brltu"))


def clock(rng: np.random.Generator) -> Piece:
    """A round clock for a wall."""
    r = rng.uniform(0.12, 0.2)
    solid = Solid().rod((0, 0.0, r), (0, 0.03, r), r, surfaces.metal(rng), sides=12)
    return one("clock", solid.rod((0, 0.03, r), (0, 0.034, r), r * 0.88, surfaces.ceramic(rng), sides=12))


def curtain(rng: np.random.Generator, cloth: Material, w: float, z: tuple[float, float]) -> Solid:
    """A gathered curtain of `w` metres between two heights, hanging from a rod."""
    solid, folds = Solid(), max(2, round(w / 0.09))
    for k in range(folds):
        x = -w / 2 + k * w / folds
        solid.box((x, x + w / folds), (0.05 + 0.03 * (k % 2), 0.09 + 0.03 * (k % 2)), z, cloth)
    return solid


def radiator(rng: np.random.Generator) -> Piece:
    """A radiator with ribs."""
    w, white = rng.uniform(0.6, 1.2), surfaces.ceramic(rng)
    solid = Solid().box((-w / 2, w / 2), (0.03, 0.07), (0.12, 0.68), white)
    for x in np.arange(-w / 2 + 0.02, w / 2 - 0.05, 0.12):
        solid.box((float(x), float(x) + 0.06), (0.07, 0.095), (0.14, 0.66), white, hide="b")
    return one("radiator", solid)


def basket(rng: np.random.Generator) -> Piece:
    """Woven, or a bin."""
    r, h = rng.uniform(0.13, 0.22), rng.uniform(0.25, 0.5)
    skin = surfaces.two_tone("squares", (0.75, 0.6, 0.4), 0.7) if rng.random() < 0.5 else surfaces.paint(rng)
    name = "basket" if rng.random() < 0.5 else "trash can"
    return one(name, Solid().lathe([(r * 0.8, 0), (r, h), (r * 0.9, h)], (0, r), skin, sides=10))


def toy(rng: np.random.Generator) -> Piece:
    """A ball or blocks."""
    if rng.random() < 0.5:
        r = rng.uniform(0.06, 0.13)
        profile = [(r * math.cos(a), r + r * math.sin(a)) for a in np.linspace(-1.4, 1.4, 5)]
        return one("ball", Solid().lathe(profile, (0, r), surfaces.vivid(rng)))
    solid = Solid()
    for k in range(3):
        solid.box((-0.15 + 0.1 * k, -0.07 + 0.1 * k), (0, 0.08), (0, 0.08 * (1 + k % 2)), surfaces.vivid(rng))
    return one("toy", solid)


def shoes(rng: np.random.Generator) -> Piece:
    """A pair of shoes."""
    skin, solid = surfaces.vivid(rng), Solid()
    for x in (-0.11, 0.02):
        solid.box((x, x + 0.09), (0, 0.27), (0, 0.05), skin).box(
            (x + 0.005, x + 0.085), (0.0, 0.11), (0.05, 0.11), skin, hide="u"
        )
    return one("shoes", solid)


def coat_rack(rng: np.random.Generator) -> Piece:
    """A board with hooks and coats, for a wall; z = 0 is the coats' hem."""
    w, board = rng.uniform(0.6, 1.0), Solid()
    board.box((-w / 2, w / 2), (0, 0.025), (0.85, 0.97), surfaces.wood(rng), hide="b")
    items = [("coat hanger", board)]
    for x in rng.permutation(np.linspace(-w / 2 + 0.15, w / 2 - 0.15, 3))[: rng.integers(1, 4)]:
        coat = Solid().box(
            (float(x) - 0.14, float(x) + 0.14),
            (0.03, 0.16),
            (rng.uniform(0, 0.3), 0.88),
            surfaces.fabric(rng),
            taper=0.75,
        )
        items.append(("clothes", coat))
    return Piece(items)


def rug(rng: np.random.Generator, w: float, d: float) -> Piece:
    """A flat rectangle or disc, of class floor."""
    pattern = str(rng.choice(["ornament", "stripes", "carpet", "squares", "floral"]))
    cloth = surfaces.two_tone(pattern, surfaces.fabric(rng).color, rng.choice([0.45, 0.65, 0.85]))
    name = "rug" if rng.random() < 0.7 else "carpet"
    if rng.random() < 0.2:
        r = min(w, d) / 2
        return one(name, Solid().lathe([(r, 0.0), (r, 0.012)], (0, d / 2), cloth, sides=12))
    return one(name, Solid().box((-w / 2, w / 2), (0, d), (0.0, 0.012), cloth))


ON_TABLES = (vase, bowl, cup, plate, book_pile, candle, bottle)
ON_SHELVES = (vase, box, photo_frame, book_pile, bowl, candle)
ON_DESKS = (laptop, cup, book_pile, photo_frame, box)
ON_WORKTOPS = (kettle, microwave, toaster, bottle, bowl, cup, plate, box)
IN_BATHROOMS = (bottle, bottle, cup, box, candle)
ON_FLOORS = (basket, box, toy)
