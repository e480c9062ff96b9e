"""Furniture by kind of room, with frequencies as in HM3DSem."""

from collections.abc import Callable

import numpy as np

from zerobev.scenes.indoor import arrange, fixtures
from zerobev.scenes.indoor.furniture import bathroom as baths
from zerobev.scenes.indoor.furniture import beds, clutter, household, seating, storage, tables
from zerobev.scenes.indoor.light import Lamp
from zerobev.scenes.indoor.plan import HALLS, Room
from zerobev.scenes.indoor.shell import Item
from zerobev.scenes.indoor.space import Space
from zerobev.scenes.indoor.style import FLATS, Style


def furnish(rng: np.random.Generator, room: Room, style: Style = FLATS) -> tuple[list[Item], list[Lamp]]:
    """A room's instances apart from its shell, in the world frame, and its lamps."""
    space = Space(rng, room, style)
    if room.kind in HALLS:
        fixtures.structure(space)
    if style.shut:
        fixtures.shut_doors(space, style.shut)
    if rng.random() < 0.4 and room.kind != "closet":
        arrange.breast(space)
    _ROOMS[room.kind](space)
    if rng.random() < 0.5 and room.kind != "closet":
        arrange.first(space, (clutter.radiator,), front=0.1)
    if room.kind not in HALLS:
        arrange.ceiling_light(space)
    arrange.curtains(space)
    if style.extra:
        arrange.mess(space, round(style.extra * room.area))
    return space.items, space.lamps


def _bedroom(space: Space) -> None:
    rng = space.rng
    narrow = space.room.area < 8.5 or rng.random() < 0.25
    bed = arrange.bed(space, beds.SINGLE if narrow else beds.DOUBLE) or arrange.bed(space, (beds.single_bed,))
    if bed and rng.random() < (0.4 if narrow else 0.08):
        arrange.bed(space, (beds.single_bed,))
    space.against_wall(storage.wardrobe(rng), corner=rng.random() < 0.7, front=0.5)
    low = None
    if rng.random() < 0.75:
        low = space.against_wall((storage.drawers if rng.random() < 0.6 else storage.sideboard)(rng), front=0.4)
    if rng.random() < 0.22:
        arrange.television(space, low)
    desk = arrange.workplace(space, screen=0.4) if rng.random() < 0.36 else None
    arrange.seats(space, 0.9 if desk else 0.25, 1.5 if desk else 0.6, seating.DINING + seating.ARMCHAIRS[1:])
    arrange.greenery(space, 0.11, 0.32, low)
    space.on_top(low, clutter.ON_SHELVES, int(rng.integers(2, 5)))
    if rng.random() < 0.35:
        shelf = space.against_wall(storage.bookshelf(rng), corner=True)
        space.on_top(shelf, clutter.ON_SHELVES, 4)
    if rng.random() < 0.3:
        arrange.first(space, (seating.bench, seating.ottoman, clutter.floor_lamp))
    arrange.on_walls(space, 1, 4)
    arrange.on_floor(space, (clutter.basket, clutter.box, clutter.toy, clutter.shoes), 1, 4)


def _bathroom(space: Space) -> None:
    rng = space.rng
    if rng.random() < 0.9:
        arrange.first(space, baths.TOILETS, front=0.35) or arrange.first(space, baths.TOILETS, front=0.1)
    sink = arrange.first(space, baths.SINKS, front=0.4) or arrange.first(space, (baths.pedestal_sink,), front=0.2)
    arrange.greenery(space, 0.06, 0.15, sink)
    space.on_top(sink, clutter.IN_BATHROOMS, 4)
    if sink:
        space.on_wall(clutter.mirror(rng), 1.15, sink.side, sink.along)
    arrange.first(space, baths.WASHING if rng.random() < 0.6 else (baths.shower,), corner=True)
    if rng.random() < 0.3:
        machine = space.against_wall(storage.washing_machine(rng))
        space.on_top(machine, clutter.IN_BATHROOMS, 3)
    if rng.random() < 0.4:
        shelf = space.against_wall(storage.bookshelf(rng), corner=True)
        space.on_top(shelf, clutter.IN_BATHROOMS, 5)
    for _ in range(int(rng.integers(1, 3))):
        space.on_wall(baths.towel_rail(rng), rng.uniform(0.7, 1.0))
    shelf = space.on_wall(storage.wall_shelf(rng), 1.3)
    space.on_top(shelf, clutter.IN_BATHROOMS, 5, z=1.3)
    if rng.random() < 0.7:
        arrange.mat(space, "bath mat", rng.uniform(0.6, 0.9), rng.uniform(0.4, 0.6))
    arrange.on_floor(space, (clutter.basket,), 1, 3)
    arrange.on_walls(space, 0, 2)


def _living_room(space: Space) -> None:
    rng = space.rng
    sofa = arrange.lounge(space)
    stand = arrange.television(space, None) if rng.random() < 0.6 else None
    if rng.random() < 0.4 and sofa:
        arrange.first(space, seating.SOFAS[:2], front=0.3)
    table = arrange.dining(space, (4, 6, 6)) if rng.random() < 0.62 else None
    arrange.seats(space, 0.65, 3.4, seating.ARMCHAIRS + seating.DINING[3:])
    low = [stand, table]
    for design in (storage.bookshelf, storage.bookshelf, storage.sideboard, tables.console):
        if rng.random() < 0.55:
            low.append(space.against_wall(design(rng), front=0.3))
    arrange.greenery(space, 0.42, 2.2, *low)
    for piece in low:
        space.on_top(piece, clutter.ON_SHELVES, int(rng.integers(2, 6)))
    if rng.random() < 0.6:
        arrange.standing_lamp(space)
    if rng.random() < 0.4:
        arrange.first(space, (seating.ottoman, seating.stool, seating.bench))
    arrange.on_walls(space, 2, 7)
    arrange.on_floor(space, clutter.ON_FLOORS, 0, 3)


def _kitchen(space: Space) -> None:
    rng = space.rng
    row = arrange.kitchen_row(space)
    style = rng.random()
    table = arrange.dining(space, (6, 6, 8)) if style < 0.66 else None
    island = arrange.island(space) if 0.4 < style < 0.8 else None
    if style < 0.8:
        arrange.seats(space, 0.3 if table or island else 1.0, 1.6, seating.DINING)
    arrange.greenery(space, 0.28, 0.85, row, table, island)
    space.on_top(row, clutter.ON_WORKTOPS, int(rng.integers(7, 14)))
    if rng.random() < 0.4:
        shelf = space.against_wall(storage.bookshelf(rng), corner=True)
        space.on_top(shelf, clutter.ON_WORKTOPS, 4)
    arrange.on_walls(space, 1, 4)
    arrange.on_floor(space, (clutter.basket, clutter.box), 1, 2)


def _dining_room(space: Space) -> None:
    rng = space.rng
    low = [arrange.dining(space, (6, 8, 8, 8))]
    for design in (storage.sideboard, tables.console, storage.drawers):
        if rng.random() < 0.6:
            low.append(space.against_wall(design(rng), front=0.3))
    arrange.seats(space, 0.2, 0.4, seating.DINING + seating.ARMCHAIRS)
    arrange.greenery(space, 0.25, 0.4, *low)
    for piece in low:
        space.on_top(piece, clutter.ON_SHELVES + clutter.ON_TABLES, int(rng.integers(2, 5)))
    arrange.on_walls(space, 2, 6)


def _office(space: Space) -> None:
    rng = space.rng
    desk = arrange.workplace(space, screen=0.7)
    if rng.random() < 0.45:
        arrange.workplace(space, screen=0.4)
    low = [space.against_wall(storage.bookshelf(rng), front=0.3) for _ in range(int(rng.integers(1, 3)))]
    if rng.random() < 0.4:
        low.append(space.against_wall(storage.drawers(rng), front=0.3))
    arrange.seats(space, 0.5, 1.3, seating.ARMCHAIRS + seating.DINING)
    if rng.random() < 0.15:
        arrange.first(space, seating.SOFAS[:1])
    arrange.greenery(space, 0.15, 0.35, desk, *low)
    for piece in low:
        space.on_top(piece, clutter.ON_SHELVES, 4)
    arrange.on_walls(space, 2, 5)
    arrange.on_floor(space, (clutter.basket, clutter.box), 1, 3)


def _hall(space: Space) -> None:
    rng = space.rng
    low = []
    for design in (tables.console, storage.shoe_cabinet, storage.sideboard):
        if rng.random() < 0.5:
            low.append(space.against_wall(design(rng), front=0.3))
    arrange.greenery(space, 0.13, 0.4, *low)
    for piece in low:
        space.on_top(piece, clutter.ON_SHELVES, int(rng.integers(2, 5)))
    arrange.seats(space, 0.24, 0.65, seating.DINING + seating.ARMCHAIRS[1:])
    if rng.random() < 0.3:
        arrange.first(space, (seating.bench, seating.stool), front=0.2)
    space.on_wall(clutter.coat_rack(rng), 0.9)
    if rng.random() < 0.6:
        space.on_wall(clutter.mirror(rng), 1.0)
    if rng.random() < 0.7:
        arrange.mat(space, "rug", rng.uniform(1.0, 2.2), rng.uniform(0.6, 0.9))
    arrange.on_walls(space, 3, 8)
    arrange.on_floor(space, (clutter.shoes, clutter.shoes, clutter.basket, clutter.box, household.suitcase), 1, 5)


def _closet(space: Space) -> None:
    rng = space.rng
    designs = (household.clothes_rail, household.linen_shelf, storage.wardrobe, storage.drawers)
    for _ in range(int(rng.integers(2, 5))):
        low = arrange.first(space, designs, corner=rng.random() < 0.6, front=0.3)
        space.on_top(low, (clutter.box, clutter.shoes, clutter.basket), int(rng.integers(2, 6)))
    arrange.on_floor(space, (clutter.box, clutter.shoes, *household.IN_CLOSETS), 1, 5)
    arrange.on_walls(space, 0, 2)


def _laundry_room(space: Space) -> None:
    rng = space.rng
    for _ in range(int(rng.integers(1, 3))):
        machine = space.against_wall(storage.washing_machine(rng), corner=rng.random() < 0.6)
        space.on_top(machine, (*clutter.IN_BATHROOMS, household.iron), 3)
    if rng.random() < 0.5:
        space.on_top(arrange.first(space, baths.SINKS, front=0.3), clutter.IN_BATHROOMS, 3)
    for design in (household.linen_shelf, storage.bookshelf, storage.sideboard):
        if rng.random() < 0.55:
            low = space.against_wall(design(rng), corner=True, front=0.3)
            space.on_top(low, clutter.IN_BATHROOMS + clutter.ON_SHELVES, int(rng.integers(3, 8)))
    if rng.random() < 0.5:
        space.on_wall(household.boiler(rng), rng.uniform(1.1, 1.4))
    arrange.on_floor(space, (clutter.basket, clutter.box, *household.TOOLS), 2, 5)
    for _ in range(int(rng.integers(0, 2))):
        shelf = space.on_wall(storage.wall_shelf(rng), 1.4)
        space.on_top(shelf, clutter.IN_BATHROOMS, 4, z=1.4)
    arrange.on_walls(space, 0, 3)


def _loft(space: Space) -> None:
    """All of a home in one room."""
    for zone in (_living_room, _kitchen, _bedroom, _dining_room, _office, _living_room)[
        : 2 + int(space.room.area / 20)
    ]:
        zone(space)


def _open_office(space: Space) -> None:
    rng = space.rng
    for _ in range(int(space.room.area / rng.uniform(6.0, 15.0))):
        arrange.workplace(space, screen=0.7, free=rng.random() < 0.8)
    for _ in range(int(space.room.area / 25)):
        low = arrange.first(space, (storage.bookshelf, storage.drawers, storage.sideboard), front=0.3)
        space.on_top(low, clutter.ON_SHELVES, 4)
    if rng.random() < 0.6:
        arrange.dining(space, (6, 8))
    if rng.random() < 0.4:
        arrange.lounge(space)
    arrange.greenery(space, 0.7, 3.0)
    arrange.on_walls(space, 2, 9)
    arrange.on_floor(space, (clutter.basket, clutter.box), 2, 6)


def _ward(space: Space) -> None:
    rng = space.rng
    for _ in range(int(space.room.area / rng.uniform(8.0, 16.0))):
        arrange.bed(space, (beds.single_bed,))
    arrange.seats(space, 0.8, 4.0, seating.DINING + seating.ARMCHAIRS)
    for design in (storage.wardrobe, storage.wardrobe, storage.drawers, household.linen_shelf):
        if rng.random() < 0.6:
            space.against_wall(design(rng), front=0.4)
    if rng.random() < 0.5:
        arrange.television(space, None)
    arrange.greenery(space, 0.4, 1.0)
    arrange.on_walls(space, 1, 6)


def _canteen(space: Space) -> None:
    rng = space.rng
    for _ in range(int(space.room.area / rng.uniform(8.0, 18.0))):
        arrange.dining(space, (2, 4, 4, 6, 8))
    if rng.random() < 0.5:
        space.on_top(arrange.kitchen_row(space), clutter.ON_WORKTOPS, 8)
    if rng.random() < 0.4:
        arrange.television(space, None)
    arrange.greenery(space, 0.6, 2.5)
    arrange.on_walls(space, 2, 8)


def _gallery(space: Space) -> None:
    """Little furniture, many pictures."""
    rng = space.rng
    for _ in range(int(rng.integers(1, 6))):
        space.in_the_open((seating.bench, seating.ottoman, tables.console, seating.corner_sofa)[rng.integers(4)](rng))
    arrange.seats(space, 0.5, 2.0, seating.ARMCHAIRS)
    arrange.greenery(space, 0.6, 2.5)
    arrange.on_walls(space, 8, 20)


_ROOMS: dict[str, Callable[[Space], None]] = {
    "bedroom": _bedroom,
    "bathroom": _bathroom,
    "living room": _living_room,
    "kitchen": _kitchen,
    "dining room": _dining_room,
    "office": _office,
    "hall": _hall,
    "closet": _closet,
    "laundry room": _laundry_room,
    "loft": _loft,
    "open office": _open_office,
    "ward": _ward,
    "canteen": _canteen,
    "gallery": _gallery,
}
