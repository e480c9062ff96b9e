"""The shell of a room: floor, ceiling, walls with their openings, door frames, windows."""

from itertools import pairwise

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.light import Lamp
from zerobev.scenes.indoor.plan import HEAD_M, INNER_M, OUTER_M, Opening, Room, along, leaf_span, side_frame
from zerobev.scenes.indoor.solids import LONGEST_M, Material, Solid
from zerobev.scenes.indoor.style import FLATS, Style

_SLAB_M = 0.05
_SKIRTING_M = (0.014, 0.08)  # depth, height
_SKY = (0.86, 0.92, 1.0)

Item = tuple[str, Solid]
#: Height and material of the skirting or panel of walls, and its invisible faces.
Panel = tuple[float, Material, str]


def build_shell(rng: np.random.Generator, room: Room, style: Style = FLATS) -> tuple[list[Item], list[Lamp]]:
    """Instances of a room's shell, in the world frame, and the daylight of its windows."""
    floor, wall = style.floor(rng, room.kind), style.wall(rng, room.kind)
    trim = surfaces.two_tone("plain", (0.93, 0.92, 0.9), 0.95) if rng.random() < 0.7 else surfaces.wood(rng)
    day = rng.uniform(1.2, 3.5) * np.array([0.95, 1.0, 1.08])
    x0, y0, x1, y1 = room.outer
    items = [("floor", Solid().box((x0, x1), (y0, y1), (-_SLAB_M, 0.0), floor, hide="brflu"))]
    items.append(("ceiling", _ceiling(room, style.ceiling)))
    # door frames hide the ends of a skirting; passages have no frames
    panel = (_SKIRTING_M[1], trim, "blr") if style is FLATS else (style.panel_m, style.panel or trim, "b")
    lamps = []
    for side in range(4):
        origin, yaw, length = side_frame(room, side)
        openings = sorted((*along(room, o), o) for o in room.openings if o.side == side)
        for part in _walls(room, side, length, openings, wall, panel):
            items.append(("wall", Solid().join(part, origin, yaw)))
        for start, end, opening in openings:
            if opening.window:
                items.append(("window", Solid().join(_window(rng, start, end, opening, trim), origin, yaw)))
                lamps.extend(_daylight(start, end, opening, origin, yaw, day))
            elif opening.head < room.height:
                items.append(("door frame", Solid().join(door_frame(start, end, opening.head, trim), origin, yaw)))
                if opening.leaf:
                    items.append(("door", Solid().join(_door_leaf(rng, room, opening, trim), origin, yaw)))
    return items, lamps


def _ceiling(room: Room, material: Material) -> Solid:
    x0, y0, x1, y1 = room.outer
    solid = Solid()
    z = room.height
    xs, ys = (np.linspace(a, b, int((b - a) / LONGEST_M) + 2).tolist() for a, b in ((x0, x1), (y0, y1)))
    for x0, x1 in pairwise(xs):
        for y0, y1 in pairwise(ys):
            solid.quad(np.array([[x0, y1, z], [x1, y1, z], [x1, y0, z], [x0, y0, z]]), material)
    return solid


def _walls(room: Room, side: int, length: float, openings: list, wall: Material, panel: Panel) -> list[Solid]:
    """The wall of one side, split as in HM3DSem: from the end of each opening to the end of the next, with skirting.

    The part with an opening includes the lintel above it, and the parapet below it if it is a window.
    """
    depth = OUTER_M if room.outside[side] else INNER_M
    before = OUTER_M if room.outside[side - 1] else INNER_M  # walls 1 and 3 are between 0 and 2
    after = OUTER_M if room.outside[(side + 1) % 4] else INNER_M
    first, last = (-before, length + after) if side in (0, 2) else (0.0, length)
    parts, at, before = [], first, 0.0
    for start, end, opening in [*openings, (last, last, None)]:
        head = HEAD_M if opening is None else opening.head
        hide = "bt" + "l" * (at == first) + "r" * (start == last)
        part = Solid().box((at, start), (-depth, 0.0), (0.0, head), wall, hide=hide)
        if head < room.height:
            part.box((at, end), (-depth, 0.0), (head, room.height), wall, hide="br" + "l" * (head >= before))
        _skirting(part, max(at, 0.0), min(start, length), panel)
        if opening is not None and opening.window:
            part.box((start, end), (-depth, 0.0), (0.0, opening.sill), wall, hide="blr")
            low = min(panel[0], max(opening.sill, _SKIRTING_M[1]))
            _skirting(part, start, end, (low, *panel[1:]))
        parts.append(part)
        at, before = end, head
    return parts


def _skirting(solid: Solid, start: float, end: float, panel: Panel) -> None:
    height, material, hide = panel
    if end - start > 0.1:
        solid.box((start, end), (0.0, _SKIRTING_M[0]), (0.0, height), material, hide=hide)


def door_frame(start: float, end: float, head: float, trim: Material) -> Solid:
    """A frame around the opening, on this room's side."""
    solid = Solid()
    solid.box((start - 0.07, start), (0.0, 0.02), (0.0, head), trim, hide="b")
    solid.box((end, end + 0.07), (0.0, 0.02), (0.0, head), trim, hide="b")
    return solid.box((start - 0.07, end + 0.07), (0.0, 0.02), (head, head + 0.07), trim, hide="b")


def _door_leaf(rng: np.random.Generator, room: Room, opening: Opening, trim: Material) -> Solid:
    """An open leaf, perpendicular to its wall, with panels and a handle."""
    x0, x1 = leaf_span(room, opening)
    width, skin = opening.end - opening.start, trim if rng.random() < 0.5 else surfaces.lacquer_or_wood(rng)
    solid = Solid().box((x0, x1), (0.025, width), (0.01, opening.head - 0.01), skin)
    for low, high in ((0.15, 0.9), (1.05, 1.8)):
        for x in ((x0 - 0.004, x0), (x1, x1 + 0.004)):
            solid.box(x, (0.15, width - 0.13), (low, high), skin, hide="r" if x[1] == x0 else "l")
    metal = surfaces.metal(rng)
    return solid.rod((x0 - 0.05, width - 0.06, 0.98), (x1 + 0.05, width - 0.06, 0.98), 0.012, metal)


def _window(rng: np.random.Generator, start: float, end: float, opening: Opening, trim: Material) -> Solid:
    """A bright recessed pane, its frame, and a sill."""
    back, sill, head = -OUTER_M + 0.02, opening.sill, opening.head
    red, green, blue = (float(np.clip(c * rng.uniform(0.85, 1.05), 0, 1)) for c in _SKY)
    sky = surfaces.glowing((red, green, blue))
    solid = Solid().box((start, end), (back, back + 0.02), (sill, head), sky, hide="brlt")
    bars = max(1 + (end - start > 0.9) * int(rng.integers(1, 3)), round((end - start) / 1.2))
    face = (back + 0.02, back + 0.06)
    for z in ((sill, sill + 0.05), (head - 0.05, head)):
        solid.box((start, end), face, z, trim, hide="brl")
    for bar in range(bars + 1):
        x = start + (end - start - 0.05) * bar / bars
        solid.box((x, x + 0.05), face, (sill + 0.05, head - 0.05), trim, hide="btu")
    if sill > 0.2:
        solid.box((start, end), (back + 0.06, 0.03), (sill, sill + 0.025), trim, hide="bu")
    return solid


def _daylight(start: float, end: float, opening: Opening, origin, yaw: float, day: np.ndarray) -> list[Lamp]:
    """A window as one or more small lamps in front of its pane, which shine only into the room."""
    sill, head = opening.sill, opening.head
    right, inward = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
    columns = max(2 if end - start > 1.1 else 1, round((end - start) / 2))
    lamps = []
    for column in range(columns):
        x, z = start + (end - start) * (column + 0.5) / columns, 0.4 * sill + 0.6 * head
        position = np.asarray(origin) + x * right - 0.1 * inward + np.array([0, 0, z])
        lamps.append(Lamp(position, day * (end - start) * (head - sill) / columns, inward))
    return lamps
