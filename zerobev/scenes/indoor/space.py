"""A room's free space, and the placement of furniture on the floor, on walls and on tops."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from zerobev.scenes.indoor.furniture.piece import Piece, Top
from zerobev.scenes.indoor.light import Lamp
from zerobev.scenes.indoor.plan import (
    HALLS,
    Opening,
    Rectangle,
    Room,
    along,
    floor_before,
    leaf_floor,
    overlap,
    side_frame,
)
from zerobev.scenes.indoor.solids import Solid
from zerobev.scenes.indoor.style import FLATS, Style

Design = Callable[[np.random.Generator], Piece]

#: Half the minimum width of a passage, metres; agents have a radius of 0.1 to 0.18 m.
PASSAGE_M = 0.23
#: Minimum fraction of the floor outside of the furniture's bounding rectangles.
FREE_FRACTION = 0.45
_CELL_M = 0.05
_DOOR_M = 0.75  # depth of the free floor in front of a door
_FLAT_M = 0.06  # thinner pieces on walls do not block the way
_TRIES = 40
#: Names of pieces that may be anywhere in a room.
_MOVABLE = frozenset((
    "chair", "office chair", "bar chair", "armchair", "sofa", "stool", "ottoman", "bench", "bed", "table",
    "coffee table", "side table", "console table", "desk", "plant", "basket", "trash can", "box", "toy", "ball",
    "shoes", "cabinet", "chest of drawers", "bookshelf", "suitcase", "drying rack", "ironing board",
))  # fmt: skip


@dataclass(frozen=True)
class Placed:
    """A piece in the world; `side` is its wall, or -1."""

    piece: Piece
    x: float
    y: float
    yaw: float
    side: int = -1
    along: float = 0.0  #: position of its middle along that wall, metres

    def to_world(self, x: float, y: float) -> tuple[float, float]:
        """World coordinates of a point of the piece's frame."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return float(self.x + c * x - s * y), float(self.y + s * x + c * y)


class Space:
    """The contents of a room; refuses pieces that would block a door, a window or the way."""

    def __init__(self, rng: np.random.Generator, room: Room, style: Style = FLATS) -> None:
        self.rng, self.room, self.style = rng, room, style
        self.items: list = []
        self.lamps: list[Lamp] = []
        self.used_m2 = 0.0
        self._rectangles: list[Rectangle] = []
        self._on_wall: list[tuple[int, float, float, float, float]] = []  # side, start, end, low, high
        self._on_tops: list[tuple[Top, Rectangle]] = []
        x0, y0, x1, y1 = room.inner
        shape = (int((x1 - x0) / _CELL_M), int((y1 - y0) / _CELL_M))
        self._walkable = np.zeros(shape, bool)
        margin = int(PASSAGE_M / _CELL_M)
        self._walkable[margin:-margin, margin:-margin] = True
        self._door_cells = []
        for opening in room.openings:
            start, end = along(room, opening)
            self._on_wall.append((opening.side, start - 0.1, end + 0.1, opening.sill, opening.head + 0.1))
            if not opening.window:
                self._rectangles.append(floor_before(room, opening.side, start, end, _DOOR_M))
                if opening.leaf:
                    self._leaf(opening)
                self._door_cells.append(self._cell(*self._at(opening.side, (start + end) / 2, PASSAGE_M + 0.1)))

    def _leaf(self, opening: Opening) -> None:
        """Reserve the floor of an open door leaf."""
        rectangle = leaf_floor(self.room, opening)
        self._rectangles.append(rectangle)
        low = self._cell(rectangle[0] - PASSAGE_M, rectangle[1] - PASSAGE_M)
        high = self._cell(rectangle[2] + PASSAGE_M, rectangle[3] + PASSAGE_M)
        self._walkable[low[0] : high[0] + 1, low[1] : high[1] + 1] = False

    # -- geometry ------------------------------------------------------------------------------------------------

    def _at(self, side: int, t: float, depth: float) -> tuple[float, float]:
        """World point `t` metres along a wall and `depth` metres in front of it."""
        (x, y, _), yaw, _ = side_frame(self.room, side)
        c, s = np.cos(yaw), np.sin(yaw)
        return float(x + c * t - s * depth), float(y + s * t + c * depth)

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        x0, y0, _, _ = self.room.inner
        i, j = int((x - x0) / _CELL_M), int((y - y0) / _CELL_M)
        return min(max(i, 0), self._walkable.shape[0] - 1), min(max(j, 0), self._walkable.shape[1] - 1)

    def _footprint(self, placed: Placed) -> Rectangle:
        (x0, y0, _), (x1, y1, _) = placed.piece.bounds
        corners = np.array([placed.to_world(x, y) for x in (x0, x1) for y in (y0, y1)])
        return (*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist())

    def _fits(self, rectangle: Rectangle) -> bool:
        """Whether a rectangle is inside the room, on no other piece and not in front of a door."""
        x0, y0, x1, y1 = rectangle
        a0, b0, a1, b1 = self.room.inner
        if x0 < a0 + 0.005 or y0 < b0 + 0.005 or x1 > a1 - 0.005 or y1 > b1 - 0.005:
            return False
        return not any(overlap(rectangle, other) for other in self._rectangles)

    def _leaves_a_way(self, rectangle: Rectangle) -> np.ndarray | None:
        """The walkable cells without `rectangle`; None if a door or much of the floor becomes unreachable."""
        x0, y0, x1, y1 = rectangle
        area = (x1 - x0) * (y1 - y0)
        if self.used_m2 + area > (1 - FREE_FRACTION) * self.room.area:
            return None
        (i0, j0), (i1, j1) = self._cell(x0 - PASSAGE_M, y0 - PASSAGE_M), self._cell(x1 + PASSAGE_M, y1 + PASSAGE_M)
        left = self._walkable.copy()
        left[i0 : i1 + 1, j0 : j1 + 1] = False
        label, _ = ndimage.label(left)
        parts = [label[cell] for cell in self._door_cells]
        if min(parts) == 0 or min(parts) != max(parts) or (label == parts[0]).sum() < 0.85 * left.sum():
            return None
        return left

    # -- style ---------------------------------------------------------------------------------------------------

    def _is_left_out(self) -> bool:
        return self.style.kept < 1 and self.rng.random() > self.style.kept

    def _stretched(self, piece: Piece) -> Piece:
        """The piece in a size of this home; a piece up to the ceiling keeps its size."""
        top, room = piece.bounds[1, 2], self.room.height - 0.04
        if not self.style.stretch or top > room:
            return piece
        factor = np.exp(self.rng.uniform(-self.style.stretch, self.style.stretch, 3))
        factor[2] = min(np.sqrt(factor[2]), room / top)
        return piece.stretched(factor)

    # -- floor ---------------------------------------------------------------------------------------------------

    def put(self, placed: Placed, front: float = 0.0, z: float = 0.0) -> Placed | None:
        """Place a piece at its pose and height `z`, if it fits and `front` metres in front of it are free."""
        rectangle = self._footprint(placed)
        if not self._fits(rectangle):
            return None
        if front:
            x, y = placed.to_world(0.0, placed.piece.bounds[1, 1] + front)
            if not self._fits((min(x, rectangle[0]), min(y, rectangle[1]), max(x, rectangle[2]), max(y, rectangle[3]))):
                return None
        walkable = self._leaves_a_way(rectangle)
        if walkable is None:
            return None
        self._walkable = walkable
        self._rectangles.append(rectangle)
        self.used_m2 += (rectangle[2] - rectangle[0]) * (rectangle[3] - rectangle[1])
        self.items += placed.piece.moved(placed.x, placed.y, z, placed.yaw).items
        return placed

    def against_wall(
        self, piece: Piece, *, gap: float = 0.016, front: float = 0.3, sides: Sequence[int] = (0, 1, 2, 3),
        corner: bool = False, middle: bool = False, margin: float = 0.03,
    ) -> Placed | None:  # fmt: skip
        """Place a piece with its back to a random wall, without covering a window; a movable one perhaps elsewhere."""
        if self._is_left_out():
            return None
        piece = self._stretched(piece)
        if self.style.loose and piece.items[0][0] in _MOVABLE and self.rng.random() < self.style.loose:
            return self._anywhere(piece.uncovered(), everywhere=True)
        (x0, _, _), (x1, _, _) = piece.bounds
        for _ in range(_TRIES):
            side = sides[int(self.rng.integers(len(sides)))]
            length = side_frame(self.room, side)[2]
            low, high = margin - x0, length - margin - x1
            if high < low:
                continue
            t = self.rng.uniform(low, high)
            if corner:
                t = float((low, high)[self.rng.integers(2)])
            elif middle:
                t = (low + high) / 2 + 0.2 * (t - (low + high) / 2)
            placed = self.at_wall(piece, side, t, gap=gap, front=front)
            if placed:
                return placed
        return None

    def at_wall(self, piece: Piece, side: int, t: float, *, gap: float = 0.016, front: float = 0.0) -> Placed | None:
        """Place a piece at position `t` of a wall (-1: none), if it fits."""
        (x0, _, _), (x1, _, height) = piece.bounds
        if side < 0 or not self._wall_is_free(side, t + x0, t + x1, 0.0, height):
            return None
        x, y = self._at(side, t, gap)
        placed = self.put(Placed(piece, x, y, side_frame(self.room, side)[1], side, t), front)
        if placed:
            self._on_wall.append((side, t + x0, t + x1, 0.0, float(height)))
        return placed

    def keep_free(self, placed: Placed) -> None:
        """Reserve the floor in front of a piece at a wall."""
        (x0, _, _), (x1, _, _) = placed.piece.bounds
        start, end = placed.along + float(x0), placed.along + float(x1)
        self._rectangles.append(floor_before(self.room, placed.side, start, end, _DOOR_M))

    def in_the_open(self, piece: Piece, everywhere: bool = False) -> Placed | None:
        """Place a piece anywhere, preferably near the middle of the room unless `everywhere`."""
        return None if self._is_left_out() else self._anywhere(self._stretched(piece), everywhere)

    def _anywhere(self, piece: Piece, everywhere: bool) -> Placed | None:
        x0, y0, x1, y1 = self.room.inner
        lower, upper = piece.bounds
        for attempt in range(_TRIES):
            yaw = float(self.rng.integers(4)) * np.pi / 2
            if self.style.askew and self.rng.random() < self.style.askew:
                yaw += float(self.rng.uniform(-np.pi / 4, np.pi / 4))
            spread = 0.95 if everywhere or self.room.kind in HALLS else 0.1 + 0.8 * attempt / _TRIES
            x = (x0 + x1) / 2 + self.rng.uniform(-0.5, 0.5) * spread * (x1 - x0)
            y = (y0 + y1) / 2 + self.rng.uniform(-0.5, 0.5) * spread * (y1 - y0)
            shift = Placed(piece, 0.0, 0.0, yaw).to_world(*((lower + upper)[:2] / 2))
            placed = self.put(Placed(piece, x - shift[0], y - shift[1], yaw))
            if placed:
                return placed
        return None

    def lay(self, piece: Piece, x: float, y: float, yaw: float) -> None:
        """Lay a flat piece on the floor below others, if it is inside the room."""
        rectangle = self._footprint(Placed(piece, x, y, yaw))
        a0, b0, a1, b1 = self.room.inner
        if rectangle[0] > a0 and rectangle[1] > b0 and rectangle[2] < a1 and rectangle[3] < b1:
            self.items += piece.moved(x, y, 0.0, yaw).items

    # -- above the floor -----------------------------------------------------------------------------------------

    def _wall_is_free(self, side: int, start: float, end: float, low: float, high: float) -> bool:
        return not any(
            s == side and start < e and end > b and low < top and high > bottom
            for s, b, e, bottom, top in self._on_wall
        )

    def on_wall(self, piece: Piece, z: float, side: int | None = None, t: float | None = None) -> Placed | None:
        """Hang a piece on a wall (-1: none) with its z = 0 at height `z`, clear of openings and furniture."""
        if side == -1 or self._is_left_out():
            return None
        (x0, _, bottom), (x1, depth, top) = piece.bounds
        for _ in range(_TRIES if t is None else 1):
            wall = int(self.rng.integers(4)) if side is None else side
            length = side_frame(self.room, wall)[2]
            if length < x1 - x0 + 0.2:
                continue
            at = self.rng.uniform(0.1 - x0, length - 0.1 - x1) if t is None else t
            if at + x0 < 0.02 or at + x1 > length - 0.02:
                continue
            if self._wall_is_free(wall, at + x0 - 0.05, at + x1 + 0.05, z + bottom - 0.03, z + top + 0.05):
                x, y = self._at(wall, at, 0.001)
                yaw = side_frame(self.room, wall)[1]
                placed = Placed(piece, x, y, yaw, wall, at)
                walkable = self._leaves_a_way(self._footprint(placed)) if depth > _FLAT_M else self._walkable
                if walkable is None:
                    continue
                self._walkable = walkable
                self.items += piece.moved(x, y, z, yaw).items
                self._on_wall.append((wall, at + x0, at + x1, z + bottom, z + top))
                return placed
        return None

    def drape(self, name: str, solid: Solid, side: int, t: float, low: float) -> None:
        """Hang a thin solid at a window, unless furniture is there."""
        (x0, _, _), (x1, _, _) = solid.bounds
        length = side_frame(self.room, side)[2]
        furniture = [w for w in self._on_wall if w[3] == 0.0]
        blocked = any(s == side and t + x0 < e and t + x1 > b and low < top for s, b, e, _, top in furniture)
        if not blocked and t + x0 > 0 and t + x1 < length:
            x, y = self._at(side, t, 0.0)
            self.items += Piece([(name, solid)]).moved(x, y, 0.0, side_frame(self.room, side)[1]).items

    def on_top(self, placed: Placed | None, designs: Sequence[Design], count: int, z: float = 0.0) -> list[Placed]:
        """Place up to `count` small pieces on the tops of a placed one (raised by `z`), without overlap."""
        done: list[Placed] = []
        if placed is None or not placed.piece.tops:
            return done
        for _ in range(count):
            if self._is_left_out():
                continue
            piece = self._stretched(designs[int(self.rng.integers(len(designs)))](self.rng))
            top = placed.piece.tops[self.rng.integers(len(placed.piece.tops))]
            (x0, y0, _), (x1, y1, height) = piece.bounds
            if x1 - x0 > top.x[1] - top.x[0] or y1 - y0 > top.y[1] - top.y[0] or height > top.room:
                continue
            for _ in range(6):
                x = self.rng.uniform(top.x[0] - x0, top.x[1] - x1)
                y = self.rng.uniform(top.y[0] - y0, top.y[1] - y1)
                box = (x + x0, y + y0, x + x1, y + y1)
                if not any(other is top and overlap(box, there) for other, there in self._on_tops):
                    self._on_tops.append((top, box))
                    wx, wy = placed.to_world(x, y)
                    self.items += piece.moved(wx, wy, top.z + z + 0.001, placed.yaw).items
                    done.append(Placed(piece, wx, wy, placed.yaw))
                    break
        return done
