"""Groups of furniture: a bed and its nightstands, a table and its chairs, a sofa and its table."""

from collections.abc import Sequence

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.furniture import clutter, household, plants, screens, seating, storage, tables
from zerobev.scenes.indoor.furniture.piece import Piece
from zerobev.scenes.indoor.light import Lamp
from zerobev.scenes.indoor.plan import along
from zerobev.scenes.indoor.solids import LONGEST_M, Solid
from zerobev.scenes.indoor.space import Design, Placed, Space

_EVERY_WAY = np.zeros(3)


def first(space: Space, designs: Sequence[Design], **where) -> Placed | None:
    """Place one of the designs against a wall; up to two more are tried if it does not fit."""
    for index in space.rng.permutation(len(designs))[:3]:
        placed = space.against_wall(designs[index](space.rng), **where)
        if placed:
            return placed
    return None


def shine(space: Space, placed: Placed, z: float, power: float) -> None:
    """Add the light of a lamp at height `z`."""
    x, y = placed.to_world(0.0, float(placed.piece.bounds[:, 1].mean()))
    color = np.array([1.0, space.rng.uniform(0.82, 0.97), space.rng.uniform(0.6, 0.92)])
    space.lamps.append(Lamp(np.array([x, y, z]), power * color, _EVERY_WAY))


def bed(space: Space, designs: Sequence[Design]) -> Placed | None:
    """A bed, a nightstand with a lamp on each free side, often a rug."""
    rng = space.rng
    placed = first(space, designs, middle=rng.random() < 0.7, front=0.45) or first(space, designs, front=0.1)
    if placed is None:
        return None
    (x0, _, _), (x1, y1, _) = placed.piece.bounds
    for side in (-1, 1):
        table = storage.nightstand(rng)
        half = table.bounds[1, 0]
        t = placed.along + (x1 + half + 0.04 if side > 0 else x0 - half - 0.04)
        stand = space.at_wall(table, placed.side, t) if rng.random() < 0.85 else None
        if stand:
            for lamp in space.on_top(stand, (clutter.table_lamp,), 1):
                if rng.random() < 0.5:
                    shine(space, lamp, float(stand.piece.tops[0].z + lamp.piece.bounds[1, 2] + 0.08), 0.25)
            space.on_top(Placed(Piece([], [_front_half(stand)]), stand.x, stand.y, stand.yaw), clutter.ON_DESKS[1:], 1)
    if rng.random() < 0.55:
        x, y = placed.to_world(0.0, float(y1) * 0.45)
        space.lay(clutter.rug(rng, float(x1 - x0) + rng.uniform(0.7, 1.2), rng.uniform(1.3, 1.7)), x, y, placed.yaw)
    return placed


def _front_half(placed: Placed):
    top = placed.piece.tops[0]
    return type(top)(top.x, ((top.y[0] + top.y[1]) / 2 + 0.08, top.y[1]), top.z, 0.2)


def _around(rng: np.random.Generator, table: Piece, design: Design, seats: int, tuck: float) -> Piece:
    """A table with `seats` chairs: along both long sides, and at the ends if there are more than four."""
    (x0, y0, _), (x1, y1, _) = table.bounds
    ends = 2 if seats > 4 else 0
    side = (seats - ends + 1) // 2
    places = []
    for k in range(seats - ends):
        x = x0 + (x1 - x0) * (k // 2 + 0.5) / side
        places.append((x, y1 - tuck, np.pi) if k % 2 else (x, y0 + tuck, 0.0))
    places += [(x0 + tuck, (y0 + y1) / 2, -np.pi / 2), (x1 - tuck, (y0 + y1) / 2, np.pi / 2)][:ends]
    items = list(table.items)
    seed = int(rng.integers(2**32))
    for x, y, yaw in places:
        chair = design(np.random.default_rng(seed))  # the chairs of a set are identical
        depth = float(chair.bounds[1, 1]) + rng.uniform(0.0, 0.12)
        yaw += rng.uniform(-0.08, 0.08)
        items += chair.moved(x + np.sin(yaw) * depth, y - np.cos(yaw) * depth, 0.0, yaw).items
    return Piece(items, table.tops)


def dining(space: Space, sizes: Sequence[int]) -> Placed | None:
    """A table with its chairs away from the walls, with things on it, sometimes on a rug."""
    rng = space.rng
    wanted = int(rng.choice(sizes))
    for seats in (wanted, max(wanted - 2, 2), 2):
        disc = seats <= 4 and rng.random() < 0.3
        table = tables.round_table(rng) if disc else tables.dining_table(rng, seats)
        design = seating.DINING[rng.integers(len(seating.DINING))]
        placed = space.in_the_open(_around(rng, table, design, seats, 0.02 if disc else 0.14))
        if placed:
            space.on_top(placed, clutter.ON_TABLES, int(rng.integers(2, 7)))
            if rng.random() < 0.3:
                (x0, y0, _), (x1, y1, _) = placed.piece.bounds
                rug = clutter.rug(rng, float(x1 - x0), float(y1 - y0)).moved(0.0, float(y0))
                space.lay(rug, placed.x, placed.y, placed.yaw)
            return placed
    return None


def island(space: Space) -> Placed | None:
    """A kitchen island with two to four bar chairs at its back."""
    rng = space.rng
    block = storage.kitchen_island(rng)
    items, seed = list(block.items), int(rng.integers(2**32))
    width = float(block.bounds[1, 0])
    for x in np.linspace(-width, width, 2 * round(width / 0.28) + 1)[1::2]:
        chair = seating.bar_chair(np.random.default_rng(seed))
        items += chair.moved(float(x), 0.15 - float(chair.bounds[1, 1])).items
    placed = space.in_the_open(Piece(items, block.tops))
    space.on_top(placed, clutter.ON_TABLES, 4)
    return placed


def lounge(space: Space) -> Placed | None:
    """A sofa at a wall, often with a coffee table in front, a rug below both and side tables."""
    rng = space.rng
    sofa = first(space, seating.SOFAS, middle=True, front=0.8) or first(space, seating.SOFAS[:2], front=0.3)
    if sofa is None:
        return None
    depth = float(sofa.piece.bounds[1, 1])
    if rng.random() < 0.8:
        table = tables.coffee_table(rng)
        x, y = sofa.to_world(rng.uniform(-0.15, 0.15), depth + rng.uniform(0.3, 0.45))
        low = space.put(Placed(table, x, y, sofa.yaw))
        space.on_top(low, clutter.ON_TABLES, int(rng.integers(2, 6)))
    if rng.random() < 0.75:
        x, y = sofa.to_world(0.0, depth * 0.6)
        space.lay(clutter.rug(rng, rng.uniform(1.8, 2.6), rng.uniform(1.3, 1.8)), x, y, sofa.yaw)
    for side in (-1, 1):
        if rng.random() < 0.5:
            table = tables.side_table(rng)
            t = sofa.along + side * (float(sofa.piece.bounds[1, 0]) + 0.3)
            stand = space.at_wall(table, sofa.side, t)
            if stand is None:
                continue
            for lamp in space.on_top(stand, (clutter.table_lamp, clutter.vase), 1):
                if lamp.piece.items[0][0] == "table lamp":
                    shine(space, lamp, float(stand.piece.tops[0].z + lamp.piece.bounds[1, 2] + 0.08), 0.3)
    return sofa


def television(space: Space, low: Placed | None) -> Placed | None:
    """A TV on the given cabinet, on a TV stand, on the wall, or on an easel."""
    rng = space.rng
    style = rng.random()
    if low is None and style < 0.75:
        low = space.against_wall(storage.tv_stand(rng), middle=True, front=0.4)
    if low is not None and style < 0.5:
        done = space.on_top(low, screens.ON_CABINET, 1) or space.on_top(low, (screens.pedestal_tv,), 3)
        if done:
            return None
    piece = screens.wall_tv(rng)
    if low is not None and space.on_wall(piece, max(0.95, float(low.piece.bounds[1, 2]) + 0.15), low.side, low.along):
        return low
    if rng.random() < 0.6:
        return space.on_wall(piece, rng.uniform(0.95, 1.15)) and low
    space.against_wall(screens.tripod_tv(rng), corner=True)
    return low


def workplace(space: Space, screen: float, free: bool = False) -> Placed | None:
    """A desk with its chair, sometimes a monitor, and things on it; at a wall unless `free`."""
    rng = space.rng
    table = tables.desk(rng)
    chair = (seating.office_chair if rng.random() < 0.75 else seating.shell_chair)(rng)
    depth, reach = float(table.bounds[1, 1]), float(chair.bounds[1, 1])
    x = rng.uniform(-0.1, 0.1)
    group = Piece(table.items + chair.moved(x, depth + reach + rng.uniform(0.0, 0.1), 0.0, np.pi).items, table.tops)
    if free:
        placed = space.in_the_open(group)
    else:
        placed = space.against_wall(group, front=0.0) or space.against_wall(group, front=0.0)
    if placed is None:
        return None
    top = placed.piece.tops[0]
    if rng.random() < screen:
        back = Placed(Piece([], [type(top)(top.x, (top.y[0], top.y[0] + 0.26), top.z)]), placed.x, placed.y, placed.yaw)
        space.on_top(back, (screens.monitor,), 1)
        front = Placed(
            Piece([], [type(top)(top.x, (top.y[1] - 0.18, top.y[1]), top.z)]), placed.x, placed.y, placed.yaw
        )
        space.on_top(front, (clutter.keyboard,), 1)
        return placed
    space.on_top(placed, clutter.ON_DESKS, int(rng.integers(2, 6)))
    return placed


def kitchen_row(space: Space) -> Placed | None:
    """The longest row of kitchen units that fits a wall."""
    for length, front in ((3.6, 0.6), (3.0, 0.6), (2.5, 0.6), (2.5, 0.3), (2.0, 0.3), (1.8, 0.1)):
        piece = storage.kitchen_row(space.rng, length + space.rng.uniform(-0.2, 0.1))
        placed = space.against_wall(piece, front=front, corner=True) or space.against_wall(piece, front=front)
        if placed:
            return placed
    return None


def standing_lamp(space: Space) -> None:
    """A floor lamp in a corner, on or off."""
    placed = space.against_wall(clutter.floor_lamp(space.rng), corner=True, front=0.0)
    if placed and space.rng.random() < 0.6:
        shine(space, placed, float(placed.piece.bounds[1, 2]) + 0.08, 0.5)


def company(rng: np.random.Generator, fraction: float, mean: float) -> int:
    """Random number of things in a room: one or more in a `fraction` of rooms, else none, with mean `mean`."""
    return int(rng.random() < fraction) * (1 + int(rng.poisson(mean / fraction - 1)))


def greenery(space: Space, fraction: float, mean: float, *low: Placed | None) -> None:
    """Plants (number by `company`): on the floor, on the tops of `low`, below the ceiling."""
    rng = space.rng

    def standing() -> object:
        return first(space, plants.STANDING, corner=True, front=0.0) or first(space, plants.STANDING, front=0.0)

    def small() -> object:
        return low and space.on_top(low[rng.integers(len(low))], plants.SMALL, 1)

    def hanging() -> object:
        x0, y0, x1, y1 = space.room.inner
        x, y = rng.choice([x0 + 0.4, x1 - 0.4]), rng.choice([y0 + 0.3, y1 - 0.6])
        return space.put(Placed(plants.hanging_plant(rng), float(x), float(y), 0.0), z=space.room.height)

    for _ in range(company(rng, fraction, mean)):
        ways = (standing, small, hanging, small)
        start = rng.choice(3, p=(0.5, 0.35, 0.15))
        any(way() for way in ways[start:] + ways[:start])


def seats(space: Space, fraction: float, mean: float, designs: Sequence[Design]) -> None:
    """Single chairs along the walls (number by `company`)."""
    for _ in range(company(space.rng, fraction, mean)):
        first(space, designs, corner=space.rng.random() < 0.5, front=0.1)


def breast(space: Space) -> None:
    """A chimney breast or boxed pipes: a protruding piece of wall, annotated as an instance."""
    rng = space.rng
    w, d, skin = rng.uniform(0.3, 1.1), rng.uniform(0.12, 0.35), space.style.wall(rng, space.room.kind)
    solid = Solid().box((-w / 2, w / 2), (0, d), (0, space.room.height - 0.002), skin, hide="btu")
    space.against_wall(Piece([("wall", solid)]), gap=0.006, front=0.2)


def on_walls(space: Space, low: int, high: int) -> None:
    """Pictures, a clock, a shelf with things on it."""
    rng = space.rng
    for _ in range(int(rng.integers(low, high))):
        style = rng.random()
        if style < 0.7:
            space.on_wall(clutter.painting(rng), rng.uniform(1.15, 1.4))
        elif style < 0.8:
            space.on_wall(clutter.clock(rng), rng.uniform(1.5, 1.7))
        else:
            z = rng.uniform(1.2, 1.5)
            shelf = space.on_wall(storage.wall_shelf(rng), z)
            space.on_top(shelf, clutter.ON_SHELVES, 4, z=z)


def on_floor(space: Space, designs: Sequence[Design], low: int, high: int) -> None:
    """Small things along the walls."""
    for _ in range(int(space.rng.integers(low, high))):
        first(space, designs, front=0.0)


def mat(space: Space, name: str, w: float, d: float) -> None:
    """A mat near the middle of the room."""
    rng = space.rng
    x0, y0, x1, y1 = space.room.inner
    yaw = 0.0 if x1 - x0 > y1 - y0 else np.pi / 2
    piece = Piece([(name, solid) for _, solid in clutter.rug(rng, w, d).moved(0.0, -d / 2).items])
    x = rng.uniform(0.4, 0.6) * (x1 - x0) + x0
    space.lay(piece, x, rng.uniform(0.4, 0.6) * (y1 - y0) + y0, yaw)


def ceiling_light(space: Space) -> None:
    """A lamp in the middle of the ceiling (two in long rooms); it is off in some rooms with a window."""
    rng = space.rng
    x0, y0, x1, y1 = space.room.inner
    long = max(x1 - x0, y1 - y0)
    parts = [0.5] if long < 5.0 else [0.27, 0.73]
    if long > LONGEST_M:
        parts = ((np.arange(round(long / 4)) + 0.5) / round(long / 4)).tolist()
    seed = int(rng.integers(2**32))
    glass = sum((o.end - o.start) * (o.head - o.sill) for o in space.room.openings if o.window)
    dark = glass > 0.12 * space.room.area and rng.random() < 0.4
    power = rng.uniform(1.2, 3.2) / len(parts) ** 0.5
    for part in parts:
        x, y = (x0 + part * (x1 - x0), (y0 + y1) / 2) if x1 - x0 > y1 - y0 else ((x0 + x1) / 2, y0 + part * (y1 - y0))
        piece = clutter.ceiling_lamp(np.random.default_rng(seed))
        space.items += piece.moved(x, y, space.room.height).items
        if not dark:
            centred = Placed(Piece(piece.items), x, y, 0.0)
            shine(space, centred, space.room.height + float(piece.bounds[0, 2]) - 0.06, power)


def curtains(space: Space) -> None:
    """A curtain on each side of most windows, down to the sill or the floor."""
    rng = space.rng
    if rng.random() < 0.3 or space.room.kind in ("bathroom", "kitchen"):
        return
    cloth = surfaces.two_tone("folds", surfaces.fabric(rng).color, 0.75)
    for opening in space.room.openings:
        if opening.window and opening.head + 0.16 < space.room.height:
            start, end = along(space.room, opening)
            head = opening.head
            low = 0.03 if opening.sill < 0.3 else opening.sill - 0.05
            for t in (start - 0.12, end + 0.12):
                hanging = clutter.curtain(rng, cloth, 0.34, (low, head + 0.12))
                space.drape("curtain", hanging, opening.side, t, low)
            rod = Solid().rod(
                (0, 0.08, head + 0.13), (end - start + 0.6, 0.08, head + 0.13), 0.012, surfaces.metal(rng)
            )
            space.drape("curtain rod", rod, opening.side, start - 0.3, head)


def mess(space: Space, count: int) -> None:
    """Small things anywhere on the floor."""
    designs = (*clutter.ON_FLOORS, clutter.box, clutter.shoes, clutter.book_pile, seating.stool, *household.IN_CLOSETS)
    for _ in range(count):
        space.in_the_open(designs[int(space.rng.integers(len(designs)))](space.rng), everywhere=True)
