"""What stands in each kind of room, and how often; the numbers follow HM3DSem's rooms."""

from collections.abc import Callable

import numpy as np

from zerobev.scenes.indoor import arrange
from zerobev.scenes.indoor.furniture import bathroom as baths
from zerobev.scenes.indoor.furniture import beds, clutter, plants, seating, storage, tables
from zerobev.scenes.indoor.light import Lamp
from zerobev.scenes.indoor.plan import Room
from zerobev.scenes.indoor.shell import Item
from zerobev.scenes.indoor.space import Space


def furnish(rng: np.random.Generator, room: Room) -> tuple[list[Item], list[Lamp]]:
    """Instances that stand, lie and hang in a room, in the world frame, and its lamps."""
    space = Space(rng, room)
    _ROOMS[room.kind](space)
    if rng.random() < 0.5:
        arrange.first(space, (clutter.radiator,), front=0.1)
    arrange.ceiling_light(space)
    arrange.curtains(space)
    return space.items, space.lamps


def _bedroom(space: Space) -> None:
    rng = space.rng
    narrow = space.room.area < 8.5 or rng.random() < 0.25
    bed = arrange.bed(space, beds.SINGLE if narrow else beds.DOUBLE) or arrange.bed(space, (beds.single_bed,))
    if bed and rng.random() < (0.4 if narrow else 0.08):
        arrange.bed(space, (beds.single_bed,))
    arrange.standing_plants(space, 0.18)
    space.against_wall(storage.wardrobe(rng), corner=rng.random() < 0.7, front=0.5)
    low = None
    if rng.random() < 0.75:
        low = space.against_wall((storage.drawers if rng.random() < 0.6 else storage.sideboard)(rng), front=0.4)
    if rng.random() < 0.35:
        arrange.workplace(space, screen=0.35)
    if rng.random() < 0.6:
        arrange.first(space, seating.ARMCHAIRS if rng.random() < 0.4 else seating.DINING, front=0.1)
    if rng.random() < 0.2:
        arrange.television(space, low)
    space.on_top(low, clutter.ON_SHELVES, int(rng.integers(2, 5)))
    arrange.small_plants(space, low, 0.15)
    if rng.random() < 0.35:
        shelf = space.against_wall(storage.bookshelf(rng), corner=True)
        space.on_top(shelf, clutter.ON_SHELVES, 4)
    if rng.random() < 0.3:
        arrange.first(space, (seating.bench, seating.ottoman, clutter.floor_lamp))
    arrange.on_walls(space, 1, 4)
    arrange.on_floor(space, (clutter.basket, clutter.box, clutter.toy, clutter.shoes), 1, 4)


def _bathroom(space: Space) -> None:
    rng = space.rng
    if rng.random() < 0.92:
        arrange.first(space, baths.TOILETS, front=0.35) or arrange.first(space, baths.TOILETS, front=0.1)
    sink = arrange.first(space, baths.SINKS, front=0.4) or arrange.first(space, (baths.pedestal_sink,), front=0.2)
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
    shelf = space.on_wall(storage.wall_shelf(rng), rng.uniform(1.2, 1.4))
    if shelf:
        space.on_top(shelf, clutter.IN_BATHROOMS, 5, z=1.3)
    if rng.random() < 0.7:
        arrange.mat(space, "bath mat", rng.uniform(0.6, 0.9), rng.uniform(0.4, 0.6))
    arrange.standing_plants(space, 0.2, plants.STANDING[:1] + plants.STANDING[2:3])
    arrange.on_floor(space, (clutter.basket,), 1, 3)
    arrange.on_walls(space, 0, 2)


def _living_room(space: Space) -> None:
    rng = space.rng
    sofa = arrange.lounge(space)
    stand = arrange.television(space, None) if rng.random() < 0.5 else None
    if rng.random() < 0.4 and sofa:
        arrange.first(space, seating.SOFAS[:2], front=0.3)
    arrange.standing_plants(space, 0.85)
    if rng.random() < 0.85:
        arrange.dining(space, (4, 4, 6))
    for _ in range(int(rng.integers(1, 5))):
        arrange.first(space, seating.ARMCHAIRS, corner=rng.random() < 0.5, front=0.1)
    low = None
    for design in (storage.bookshelf, storage.bookshelf, storage.sideboard, tables.console):
        if rng.random() < 0.5:
            low = space.against_wall(design(rng), front=0.3)
            space.on_top(low, clutter.ON_SHELVES, int(rng.integers(2, 6)))
    space.on_top(stand, clutter.ON_SHELVES, 2)
    if rng.random() < 0.6:
        arrange.standing_lamp(space)
    if rng.random() < 0.4:
        arrange.first(space, (seating.ottoman, seating.stool, seating.bench))
    arrange.small_plants(space, stand or low, 0.5)
    arrange.hanging_plant(space, 0.15)
    arrange.on_walls(space, 2, 6)
    arrange.on_floor(space, clutter.ON_FLOORS, 0, 3)


def _kitchen(space: Space) -> None:
    rng = space.rng
    row = arrange.kitchen_row(space)
    space.on_top(row, clutter.ON_WORKTOPS, int(rng.integers(6, 12)))
    if rng.random() < 0.4 and space.room.area > 9:
        arrange.island(space)
    if rng.random() < 0.9:
        arrange.dining(space, (4, 4, 6)) or arrange.first(space, seating.DINING, front=0.1)
    if rng.random() < 0.4:
        shelf = space.against_wall(storage.bookshelf(rng), corner=True)
        space.on_top(shelf, clutter.ON_WORKTOPS, 4)
    arrange.standing_plants(space, 0.5)
    arrange.small_plants(space, row, 0.9)
    arrange.on_walls(space, 1, 4)
    arrange.on_floor(space, (clutter.basket, clutter.box), 1, 2)


def _dining_room(space: Space) -> None:
    rng = space.rng
    table = arrange.dining(space, (6, 8, 8))
    for design in (storage.sideboard, tables.console, storage.drawers):
        if rng.random() < 0.6:
            low = space.against_wall(design(rng), front=0.3)
            space.on_top(low, clutter.ON_SHELVES + clutter.ON_TABLES, int(rng.integers(2, 5)))
    if table and rng.random() < 0.35:
        arrange.first(space, seating.DINING + seating.ARMCHAIRS, corner=True)
    arrange.standing_plants(space, 0.4)
    arrange.hanging_plant(space, 0.1)
    arrange.on_walls(space, 2, 5)


def _office(space: Space) -> None:
    rng = space.rng
    arrange.workplace(space, screen=0.6)
    if rng.random() < 0.45:
        arrange.workplace(space, screen=0.3)
    arrange.standing_plants(space, 0.25)
    for _ in range(int(rng.integers(1, 3))):
        shelf = space.against_wall(storage.bookshelf(rng), front=0.3)
        space.on_top(shelf, clutter.ON_SHELVES, 4)
    if rng.random() < 0.4:
        low = space.against_wall(storage.drawers(rng), front=0.3)
        space.on_top(low, clutter.ON_SHELVES, 3)
    for _ in range(int(rng.integers(0, 3))):
        arrange.first(space, seating.ARMCHAIRS + seating.DINING, corner=rng.random() < 0.5)
    if rng.random() < 0.15:
        arrange.first(space, seating.SOFAS[:1])
    arrange.on_walls(space, 2, 5)
    arrange.on_floor(space, (clutter.basket, clutter.box), 1, 3)


def _hall(space: Space) -> None:
    rng = space.rng
    arrange.standing_plants(space, 0.6)
    for design in (tables.console, storage.shoe_cabinet):
        if rng.random() < 0.6:
            low = space.against_wall(design(rng), front=0.3)
            space.on_top(low, clutter.ON_SHELVES, 3)
    if rng.random() < 0.6:
        arrange.first(space, seating.DINING + seating.ARMCHAIRS[1:], front=0.2)
    if rng.random() < 0.3:
        arrange.first(space, (seating.bench, seating.stool), front=0.2)
    space.on_wall(clutter.coat_rack(rng), 0.9)
    if rng.random() < 0.6:
        space.on_wall(clutter.mirror(rng), 1.0)
    arrange.mat(space, "rug", rng.uniform(1.0, 2.2), rng.uniform(0.6, 0.9))
    arrange.on_walls(space, 2, 6)
    arrange.on_floor(space, (clutter.shoes, clutter.shoes, clutter.basket, clutter.box), 1, 4)


_ROOMS: dict[str, Callable[[Space], None]] = {
    "bedroom": _bedroom,
    "bathroom": _bathroom,
    "living room": _living_room,
    "kitchen": _kitchen,
    "dining room": _dining_room,
    "office": _office,
    "hall": _hall,
}
