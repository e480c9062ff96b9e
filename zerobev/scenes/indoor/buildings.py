"""Floor plans of varied homes: flats of many sizes, halls with side rooms, corridors with rooms on their sides."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from zerobev.scenes.indoor.plan import (
    HALLS,
    KINDS,
    Opening,
    Rectangle,
    Room,
    connect,
    flat_rooms,
    shared_wall,
    split,
    walled,
    windows,
    without_clashes,
)

#: Depth of the floor in front of a door without another door's leaf, metres; two leaves leave a way between them.
_LANDING_M = 1.4
_OPEN = ("living room", "dining room", "kitchen", "hall")
#: Kinds of the hall, and of the rooms on the sides of a hall or corridor with their probabilities, by use.
_USES = (
    (("open office", "canteen", "gallery"), {"office": 0.5, "closet": 0.12, "bathroom": 0.16, "kitchen": 0.22}),
    (("ward", "loft"), {"bedroom": 0.6, "bathroom": 0.28, "closet": 0.06, "laundry room": 0.06}),
    (("loft", "canteen", "gallery"), {"bedroom": 0.35, "bathroom": 0.2, "kitchen": 0.15, "living room": 0.3}),
)


def draw_building(rng: np.random.Generator) -> list[Room]:
    """The rooms of a varied home, all connected by doors or by passages without a wall above."""
    design = _DESIGNS[int(rng.choice(len(_DESIGNS), p=(0.45, 0.3, 0.25)))]
    while True:
        rooms = design(rng)
        if connect(rng, rooms):
            break
    head = min(float(rng.uniform(2.02, 2.25)), min(room.height for room in rooms) - 0.1)
    for room in rooms:
        room.openings = [replace(opening, head=head) for opening in room.openings]
    for index, room in enumerate(rooms):
        for other in rooms[:index]:
            if room.kind in _OPEN and other.kind in _OPEN and rng.random() < 0.35:
                _join(room, other)
    glass = rng.random() < 0.4
    for room in rooms:
        room.openings = without_clashes(room, _LANDING_M)
        front = _glass_front(rng, room) if glass else None
        top = float(rng.uniform(2.0, min(room.height - 0.1, 2.6)))
        others = _rows_of_windows(rng, room) if room.kind in HALLS else windows(rng, room)
        others = [replace(window, head=top) for window in others if not front or window.side != front.side]
        room.openings += [front, *others] if front else others
    return rooms


def _flat(rng: np.random.Generator) -> list[Room]:
    """As in flats, with smaller, larger, lower and higher rooms."""
    room_m2 = float(rng.uniform(8.0, 22.0))
    rectangles, footprint = split(rng, int(rng.integers(4, 11)), (room_m2, room_m2), (1.3, 1.9))
    return flat_rooms(rng, rectangles, footprint, (2.3, 3.2))


def _hall(rng: np.random.Generator) -> list[Room]:
    """A hall of 40 to 150 m2, with a row of rooms along one or two of its sides."""
    area = float(np.exp(rng.uniform(np.log(40), np.log(150))))
    width = float(np.sqrt(area * rng.uniform(1.0, 2.2)))
    low = float(rng.uniform(2.2, 4.0)) if rng.random() < 0.35 else 0.0
    high = low + area / width
    top = high + float(rng.uniform(2.2, 4.0))
    rows = _row(rng, width, high, top) + (_row(rng, width, 0.0, low) if low else [])
    names, rates = _USES[rng.integers(len(_USES))]
    tall = float(rng.uniform(2.6, 3.6))
    footprint = (0.0, 0.0, width, top)
    hall = walled(str(rng.choice(names)), (0.0, low, width, high), footprint, tall)
    return [hall, *_side_rooms(rng, rows, rates, footprint, min(tall, float(rng.uniform(2.3, 3.0))))]


def _corridor(rng: np.random.Generator) -> list[Room]:
    """A corridor of 6 to 20 m with rooms on one or both sides."""
    width, both = float(rng.uniform(6.0, 20.0)), rng.random() < 0.7
    low = float(rng.uniform(2.4, 5.0)) if both else 0.0
    high = low + float(rng.uniform(1.4, 2.4))
    top = high + float(rng.uniform(2.4, 5.0))
    rows = _row(rng, width, high, top) + (_row(rng, width, 0.0, low) if both else [])
    rates, height = _USES[rng.integers(len(_USES))][1], float(rng.uniform(2.3, 3.0))
    footprint = (0.0, 0.0, width, top)
    corridor = walled("hall", (0.0, low, width, high), footprint, height)
    return [corridor, *_side_rooms(rng, rows, rates, footprint, height)]


_DESIGNS: tuple[Callable[[np.random.Generator], list[Room]], ...] = (_flat, _hall, _corridor)


def _row(rng: np.random.Generator, width: float, low: float, high: float) -> list[Rectangle]:
    """Rectangles of at least 1.9 m side by side."""
    count = max(1, int(width / rng.uniform(2.5, 4.5)))
    step = width / count
    cuts = step * (np.arange(1, count) + rng.uniform(-0.12, 0.12, count - 1))
    return [(x0, low, x1, high) for x0, x1 in pairwise([0.0, *cuts.tolist(), width])]


def _side_rooms(
    rng: np.random.Generator, rectangles: list[Rectangle], rates: dict[str, float], footprint: Rectangle, height: float
) -> list[Room]:
    """Rooms of random kinds, by area."""
    kinds = sorted(rng.choice(list(rates), len(rectangles), p=list(rates.values())).tolist(), key=KINDS.index)
    rectangles = sorted(rectangles, key=lambda r: -(r[2] - r[0]) * (r[3] - r[1]) * rng.uniform(0.7, 1.3))
    return [walled(kind, outer, footprint, height) for kind, outer in zip(kinds, rectangles)]


def _join(room: Room, other: Room) -> None:
    """Replace the doors between two rooms by a passage as wide and high as their common wall, if there is one."""
    shared = shared_wall(room, other)
    if shared is None:
        return
    side, start, end = shared
    for one, its_side in ((room, side), (other, (side + 2) % 4)):
        kept = [o for o in one.openings if o.side != its_side or o.end < start or o.start > end]
        passage = Opening(its_side, start + 0.12, end - 0.12, 0.0, False, head=one.height)
        one.openings = [*kept, passage]


def _glass_front(rng: np.random.Generator, room: Room) -> Opening | None:
    """A window from the floor to the ceiling along one outer wall."""
    sides = [side for side in range(4) if room.outside[side]]
    if not sides or room.kind in ("bathroom", "closet", "kitchen"):
        return None
    side = int(rng.choice(sides))
    axis = side % 2
    start, end = room.inner[axis] + 0.2, room.inner[axis + 2] - 0.2
    return Opening(side, start, end, 0.06, True, head=room.height - 0.15)


def _rows_of_windows(rng: np.random.Generator, room: Room) -> list[Opening]:
    """Equal windows in most outer walls of a hall."""
    found = []
    sill, share = float(rng.choice([0.08, 0.6, 0.9])), float(rng.uniform(0.4, 0.8))
    for side in range(4):
        if room.outside[side] and rng.random() < 0.75:
            start, end = room.inner[side % 2], room.inner[side % 2 + 2]
            count = max(1, round((end - start) / float(rng.uniform(2.0, 3.5))))
            step = (end - start) / count
            for middle in start + step * (np.arange(count) + 0.5):
                half = step * share / 2
                found.append(Opening(side, float(middle - half), float(middle + half), sill, True))
    return found
