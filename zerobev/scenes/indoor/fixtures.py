"""Fixed parts of varied homes inside the shell: columns, beams and lamps of halls, shut doors."""

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.arrange import shine
from zerobev.scenes.indoor.furniture import clutter
from zerobev.scenes.indoor.furniture.piece import Piece
from zerobev.scenes.indoor.plan import side_frame
from zerobev.scenes.indoor.shell import door_frame
from zerobev.scenes.indoor.solids import Solid
from zerobev.scenes.indoor.space import Placed, Space


def structure(space: Space) -> None:
    """Often columns and beams on a grid of a hall, and a lamp in each bay."""
    rng, room = space.rng, space.room
    x0, y0, x1, y1 = room.inner
    pitch = rng.uniform(2.6, 5.5)
    xs, ys = (np.linspace(a, b, max(2, round((b - a) / pitch)) + 1) for a, b in ((x0, x1), (y0, y1)))
    skin = space.style.wall(rng, room.kind) if rng.random() < 0.6 else surfaces.lacquer_or_wood(rng)
    side, is_round = rng.uniform(0.22, 0.5), rng.random() < 0.35
    column = Solid()
    foot, top = 0.004, room.height - 0.002  # a foot above the floor, so that a map's cut finds the column in a beam
    if is_round:
        column.lathe([(side / 2, foot), (side / 2, top)], (0.0, 0.0), skin, sides=12)
    else:
        column.box((-side / 2, side / 2), (-side / 2, side / 2), (foot, top), skin, hide="u")
    if rng.random() < 0.6:
        for x in xs[1:-1]:
            for y in ys[1:-1]:
                space.put(Placed(Piece([("column", column)]), float(x), float(y), 0.0))
    if rng.random() < 0.5:
        low, wide = room.height - rng.uniform(0.15, 0.4), rng.uniform(0.1, 0.3)
        for x in xs[1:-1]:
            span = (float(x) - wide / 2, float(x) + wide / 2)
            space.items.append(("beam", Solid().box(span, (y0, y1), (low, room.height), skin, hide="tbf")))
    seed, power = int(rng.integers(2**32)), rng.uniform(1.0, 3.5)
    for x in (xs[1:] + xs[:-1]) / 2:
        for y in (ys[1:] + ys[:-1]) / 2:
            lamp = clutter.ceiling_lamp(np.random.default_rng(seed))
            space.items += lamp.moved(float(x), float(y), room.height).items
            low = room.height + float(lamp.bounds[0, 2]) - 0.06
            shine(space, Placed(Piece(lamp.items), float(x), float(y), 0.0), low, power)


def shut_doors(space: Space, mean: float) -> None:
    """Doors to places outside the home (number Poisson-distributed), with the floor in front of them free."""
    rng = space.rng
    for _ in range(int(rng.poisson(mean))):
        width, head = rng.uniform(0.75, 1.0), rng.uniform(1.96, 2.15)
        skin, metal = surfaces.lacquer_or_wood(rng), surfaces.metal(rng)
        leaf = Solid().box((-width / 2, width / 2), (0.0, 0.018), (0.0, head), skin, hide="b")
        grip = width / 2 - 0.07
        leaf.rod((grip, 0.018, 1.0), (grip, 0.07, 1.0), 0.012, metal)
        leaf.rod((grip + 0.01, 0.06, 1.0), (grip - 0.12, 0.06, 1.0), 0.011, metal)
        frame = door_frame(-width / 2, width / 2, head, skin)
        door = Piece([("door", leaf), ("door frame", frame)])
        for _ in range(8):
            side = int(rng.integers(4))
            length = side_frame(space.room, side)[2]
            if length > width + 0.4:
                t = rng.uniform(width / 2 + 0.1, length - width / 2 - 0.1)
                placed = space.at_wall(door, side, t, gap=0.015, front=0.7)
                if placed:
                    space.keep_free(placed)
                    break
