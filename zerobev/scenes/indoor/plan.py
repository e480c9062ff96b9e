"""Floor plans: rooms that tile a rectangle, doors that connect all rooms, windows in outer walls."""

from dataclasses import dataclass, field, replace

import numpy as np

#: Thickness of a room's half of an inner wall, and of an outer wall, metres.
INNER_M, OUTER_M = 0.06, 0.24
#: Height of the top of doors and windows of flats, metres; a wall is a beam above it and parts below it.
HEAD_M = 1.98
#: Depth of the floor in front of a door without another door's leaf, metres.
_LANDING_M = 0.95
#: Kinds of rooms, by area, the largest first.
KINDS = ("living room", "dining room", "kitchen", "bedroom", "office", "hall", "bathroom", "laundry room", "closet")
#: Kinds of halls: rooms of 40 m2 or more in varied homes.
HALLS = ("loft", "open office", "ward", "canteen", "gallery")
_SOCIAL = ("living room", "dining room", "kitchen", "hall")
_FIRST = ("living room", "kitchen", "bathroom", "bedroom")
#: Probabilities of the kinds of further rooms, for frequencies of chairs, beds, toilets, ... as in HM3DSem's rooms.
_LATER = {
    "bedroom": 0.22, "bathroom": 0.15, "hall": 0.2, "dining room": 0.08, "office": 0.11, "closet": 0.14,
    "laundry room": 0.1,
}  # fmt: skip
#: Probabilities of 4, 5, ..., 10 rooms.
_COUNTS = (0.05, 0.08, 0.12, 0.17, 0.2, 0.2, 0.18)

Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1, metres


@dataclass(frozen=True)
class Opening:
    """A hole in a wall, between two coordinates along the wall (x or y), from `sill` up to `head`."""

    side: int  #: 0 south (low y), 1 east (high x), 2 north, 3 west
    start: float
    end: float
    sill: float  #: metres; 0 for doors
    window: bool
    leaf: int = 0  #: an open door leaf in this room, hinged at the start (-1) or the end (1) of the opening; 0: none
    head: float = HEAD_M  #: metres; the height of the room for a passage without a wall above it


@dataclass
class Room:
    """One room: `outer` rectangles tile the home, `inner` is the floor between the walls."""

    kind: str
    outer: Rectangle
    inner: Rectangle
    outside: tuple[bool, bool, bool, bool]  #: sides that are outer walls
    height: float
    openings: list[Opening] = field(default_factory=list)

    @property
    def area(self) -> float:
        """Floor area, m2."""
        x0, y0, x1, y1 = self.inner
        return (x1 - x0) * (y1 - y0)


def draw_plan(rng: np.random.Generator) -> list[Room]:
    """A flat of 4 to 10 rooms, all connected by doors."""
    while True:
        rectangles, footprint = split(rng, int(rng.choice(np.arange(4, 11), p=_COUNTS)))
        rooms = flat_rooms(rng, rectangles, footprint, (2.4, 2.65))
        if connect(rng, rooms):
            break
    for room in rooms:
        room.openings += windows(rng, room)
    return rooms


def connect(rng: np.random.Generator, rooms: list[Room]) -> bool:
    """Add doors to the rooms, so that all are connected; False if that is not possible."""
    doors = _doors(rng, rooms)
    for first, second, side, start, end in doors or ():
        leaf = int(rng.choice([-1, 1])) if end - start < 1.0 and rng.random() < 0.6 else 0
        inside = rooms[first].area > rooms[second].area
        rooms[first].openings.append(Opening(side, start, end, 0.0, False, leaf * inside))
        rooms[second].openings.append(Opening((side + 2) % 4, start, end, 0.0, False, leaf * (not inside)))
    for room in rooms:
        room.openings = without_clashes(room)
    return doors is not None


def side_frame(room: Room, side: int) -> tuple[tuple[float, float, float], float, float]:
    """The local frame of a wall, x along it and y into the room: origin in the world, yaw, and the wall's length."""
    x0, y0, x1, y1 = room.inner
    origin = ((x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0))[side]
    return origin, side * np.pi / 2, (x1 - x0) if side in (0, 2) else (y1 - y0)


def along(room: Room, opening: Opening) -> tuple[float, float]:
    """Start and end of an opening in its wall's local frame."""
    axis = 0 if opening.side in (0, 2) else 1
    low, high = room.inner[axis], room.inner[axis + 2]
    if opening.side in (2, 3):
        return high - opening.end, high - opening.start
    return opening.start - low, opening.end - low


def leaf_span(room: Room, opening: Opening) -> tuple[float, float]:
    """Start and end of an open door leaf along its wall, in the wall's local frame."""
    start, end = along(room, opening)
    at_start = (opening.leaf < 0) != (opening.side in (2, 3))
    return (start + 0.005, start + 0.045) if at_start else (end - 0.045, end - 0.005)


def floor_before(room: Room, side: int, start: float, end: float, depth: float) -> Rectangle:
    """The floor from `start` to `end` along a wall and to `depth` metres in front of it, in the world."""
    (x, y, _), yaw, _ = side_frame(room, side)
    c, s = np.cos(yaw), np.sin(yaw)
    corners = np.array([[x + c * t - s * far, y + s * t + c * far] for t in (start, end) for far in (0.0, depth)])
    return (*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist())


def leaf_floor(room: Room, opening: Opening) -> Rectangle:
    """The floor below an open door leaf and its handles."""
    start, end = leaf_span(room, opening)
    return floor_before(room, opening.side, start - 0.06, end + 0.06, opening.end - opening.start + 0.05)


def overlap(a: Rectangle, b: Rectangle) -> bool:
    """Whether two rectangles have an area in common."""
    return a[0] < b[2] and a[2] > b[0] and a[1] < b[3] and a[3] > b[1]


def without_clashes(room: Room, landing_m: float = _LANDING_M) -> list[Opening]:
    """A room's openings, without leaves closer than `landing_m` in front of another door, or in a shallow room."""
    doors = [o for o in room.openings if not o.window]
    kept = []
    for opening in room.openings:
        if opening.leaf:
            others = [floor_before(room, o.side, *along(room, o), landing_m) for o in doors if o is not opening]
            x0, y0, x1, y1 = room.inner
            depth = (y1 - y0) if opening.side in (0, 2) else (x1 - x0)
            if depth < 2.0 or any(overlap(leaf_floor(room, opening), other) for other in others):
                opening = replace(opening, leaf=0)
        kept.append(opening)
    return kept


def split(
    rng: np.random.Generator,
    count: int,
    room_m2: tuple[float, float] = (10.5, 14.0),
    corridor_m: tuple[float, float] = (1.5, 1.9),
) -> tuple[list[Rectangle], Rectangle]:
    """Cut a rectangle into `count` ones of at least 1.9 m; larger homes often have a corridor, the first one."""
    area = count * rng.uniform(*room_m2)
    width = np.sqrt(area * rng.uniform(1.0, 1.8))
    footprint = (0.0, 0.0, float(width), float(area / width))
    pieces, done = [footprint], []
    if count >= 6 and rng.random() < 0.6:
        low = footprint[3] * rng.uniform(0.4, 0.52)
        high = low + rng.uniform(*corridor_m)
        pieces = [(0.0, 0.0, footprint[2], low), (0.0, high, footprint[2], footprint[3])]
        done = [(0.0, low, footprint[2], high)]
    while len(pieces) + len(done) < count:
        sizes = [(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in pieces]
        x0, y0, x1, y1 = pieces.pop(int(np.argmax(sizes)))
        cut = rng.uniform(0.3, 0.7)
        if x1 - x0 > (y1 - y0) * rng.uniform(0.85, 1.15):
            middle = x0 + (x1 - x0) * cut
            pieces += [(x0, y0, middle, y1), (middle, y0, x1, y1)]
        else:
            middle = y0 + (y1 - y0) * cut
            pieces += [(x0, y0, x1, middle), (x0, middle, x1, y1)]
    if min(min(x1 - x0, y1 - y0) for x0, y0, x1, y1 in pieces) < 1.9 or (footprint[2] > 9.8 and done):
        return split(rng, count, room_m2, corridor_m)
    return done + pieces, footprint


def flat_rooms(
    rng: np.random.Generator, rectangles: list[Rectangle], footprint: Rectangle, height_m: tuple[float, float]
) -> list[Room]:
    """Assign a kind to each rectangle of a flat, by area, and inset it by its walls; a corridor is a hall."""
    corridor = rectangles[0][3] - rectangles[0][1] < 1.9 and len(rectangles) >= 6
    kinds = list(_FIRST) + ["hall"] * corridor
    kinds += list(rng.choice(list(_LATER), len(rectangles) - len(kinds), p=list(_LATER.values())))
    if corridor:
        kinds.remove("hall")
    rest = rectangles[corridor:]
    rest = sorted(rest, key=lambda r: -(r[2] - r[0]) * (r[3] - r[1]) * rng.uniform(0.85, 1.15))
    named = [("hall", rectangles[0])] * corridor + list(zip(sorted(kinds, key=KINDS.index), rest))
    height = float(rng.uniform(*height_m))
    return [walled(str(kind), outer, footprint, height) for kind, outer in named]


def walled(kind: str, outer: Rectangle, footprint: Rectangle, height: float) -> Room:
    """A room inside its walls; sides on the footprint's border are outer walls."""
    west, south, east, north = (abs(a - b) < 1e-9 for a, b in zip(outer, footprint))
    outside = south, east, north, west
    inset = [OUTER_M if o else INNER_M for o in outside]
    inner = (outer[0] + inset[3], outer[1] + inset[0], outer[2] - inset[1], outer[3] - inset[2])
    return Room(kind, outer, inner, outside, height)


def shared_wall(a: Room, b: Room) -> tuple[int, float, float] | None:
    """The side of `a` that touches `b`, and the start and end of their common wall; None if too short."""
    for side, (mine, its, axis) in enumerate(((1, 3, 0), (2, 0, 1), (3, 1, 0), (0, 2, 1))):
        if abs(a.outer[mine] - b.outer[its]) < 1e-9:
            start = max(a.inner[axis], b.inner[axis])
            end = min(a.inner[axis + 2], b.inner[axis + 2])
            if end - start > 1.15:
                return side, start, end
    return None


def _doors(rng: np.random.Generator, rooms: list[Room]) -> list[tuple[int, int, int, float, float]] | None:
    """A spanning tree of doors, with bathrooms and bedrooms as leaves, and further doors between social rooms."""
    dislike = {"bathroom": 4.0, "closet": 4.0, "laundry room": 3.0, "bedroom": 1.5, "office": 1.0, "hall": -1.0}
    pairs = []
    for i, a in enumerate(rooms):
        for j, b in enumerate(rooms[:i]):
            shared = shared_wall(a, b)
            if shared:
                weight = dislike.get(a.kind, 0) + dislike.get(b.kind, 0) + rng.uniform(0, 0.8)
                pairs.append((weight, i, j, shared))
    group = list(range(len(rooms)))
    doors = []
    for _, i, j, (side, start, end) in sorted(pairs):
        social = rooms[i].kind in _SOCIAL and rooms[j].kind in _SOCIAL
        if group[i] == group[j] and not (social and rng.random() < 0.35):
            continue
        group = [group[i] if g == group[j] else g for g in group]
        wide = social and "hall" not in (rooms[i].kind, rooms[j].kind) and rng.random() < 0.5
        width = min(rng.uniform(1.2, 2.2) if wide else rng.uniform(0.8, 0.95), end - start - 0.24)
        at = start + 0.12 + (end - start - 0.24 - width) * float(rng.choice([0.0, 1.0, rng.random()]))
        doors.append((i, j, side, at, at + width))
    return doors if len(set(group)) == 1 else None


def windows(rng: np.random.Generator, room: Room) -> list[Opening]:
    """At most one window (two in long walls) per outer wall; a kitchen has only one, because it needs walls."""
    found: list[Opening] = []
    for side in range(4):
        axis = 0 if side in (0, 2) else 1
        start, end = room.inner[axis], room.inner[axis + 2]
        if found and room.kind == "kitchen":
            break
        if not room.outside[side] or end - start < 1.2 or rng.random() < (0.8 if room.kind == "closet" else 0.2):
            continue
        parts = 2 if end - start > 4.2 and room.kind != "kitchen" and rng.random() < 0.6 else 1
        sill = 1.2 if room.kind == "bathroom" else float(rng.choice([0.08, 0.5, 0.85, 0.95], p=[0.12, 0.13, 0.35, 0.4]))
        for part in range(parts):
            middle = start + (end - start) * (part + 0.5) / parts
            half = min(rng.uniform(0.35, 1.0) if room.kind != "bathroom" else 0.3, (end - start) / parts / 2 - 0.25)
            middle += rng.uniform(-0.2, 0.2) * ((end - start) / parts / 2 - 0.25 - half)
            found.append(Opening(side, middle - half, middle + half, sill, True))
    return found
