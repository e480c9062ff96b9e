"""Closed solids of planar quads, and their materials.

A home is a set of planar convex quads (a triangle repeats its last corner), so that each quad has one rectangle of the
UV atlas. Corners are counter-clockwise seen from outside; the first edge is horizontal in the texture.
"""

import math
from dataclasses import dataclass

import numpy as np

#: Corners of a box's faces; 0-3 is the lower rectangle counter-clockwise from (-x, -y), 4-7 the upper one.
_BOX = np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7], [3, 2, 1, 0]])
#: One letter per face of a box, in the same order: back, right, front, left, top, underside.
_SIDES = "brfltu"
#: Longest side of a quad, metres: it must fit a chart of the atlas. A longer box is several boxes.
LONGEST_M = 10.2
#: Undersides lower than this are below all cameras; they have no area in the atlas.
_EYE_M = 0.85

Span = tuple[float, float]


@dataclass(frozen=True)
class Material:
    """A pattern that blends two sRGB colours."""

    pattern: str  #: a key of `surfaces.PATTERNS`
    color: tuple[float, float, float]  #: sRGB in [0, 1] for a pattern of 0
    second: tuple[float, float, float]  #: sRGB in [0, 1] for a pattern of 1
    glow: bool = False  #: shown at full brightness, independent of light


class Solid:
    """A set of closed solids in a local frame: x right, y to the front, z up, the origin on the floor."""

    def __init__(self) -> None:
        self._quads: list[np.ndarray] = []  # each (n, 4, 3)
        self._hidden: list[np.ndarray] = []  # each (n,) bool
        self._materials: list[Material] = []

    def _add(self, quads: np.ndarray, material: Material, hidden: np.ndarray | None = None) -> None:
        self._quads.append(quads)
        self._hidden.append(np.zeros(len(quads), bool) if hidden is None else hidden)
        self._materials.append(material)

    def quad(self, corners: np.ndarray, material: Material) -> "Solid":
        """Add one open (4, 3) quad, visible from its front only."""
        self._add(corners[None], material)
        return self

    def box(
        self,
        x: Span,
        y: Span,
        z: Span,
        material: Material,
        *,
        hide: str = "",
        lean: tuple[float, float] = (0.0, 0.0),
        taper: float = 1.0,
    ) -> "Solid":
        """Add a box; its upper rectangle is scaled by `taper` and moved by `lean` (metres in x and y).

        `hide` names invisible faces: (b)ack -y, (r)ight +x, (f)ront +y, (l)eft -x, (t)op, (u)nderside.
        """
        (x0, x1), (y0, y1), (z0, z1) = x, y, z
        if x1 - x0 > LONGEST_M:
            middle = (x0 + x1) / 2
            self.box((x0, middle), y, z, material, hide=hide + "r")
            return self.box((middle, x1), y, z, material, hide=hide + "l")
        if y1 - y0 > LONGEST_M:
            middle = (y0 + y1) / 2
            self.box(x, (y0, middle), z, material, hide=hide + "f")
            return self.box(x, (middle, y1), z, material, hide=hide + "b")
        mx, my = (x0 + x1) / 2 + lean[0], (y0 + y1) / 2 + lean[1]
        hx, hy = (x1 - x0) / 2 * taper, (y1 - y0) / 2 * taper
        lower = [(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)]
        upper = [(mx - hx, my - hy, z1), (mx + hx, my - hy, z1), (mx + hx, my + hy, z1), (mx - hx, my + hy, z1)]
        self._add(np.array(lower + upper)[_BOX], material, np.array([side in hide for side in _SIDES]))
        return self

    def lathe(
        self, profile: list[tuple[float, float]], center: tuple[float, float], material: Material, sides: int = 8
    ) -> "Solid":
        """Add a surface of revolution about the vertical through `center`; `profile` is (radius, z), from below."""
        angle = np.arange(sides) * (2 * math.pi / sides) + math.pi / sides
        circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], axis=1)
        rings = [np.array([*center, z]) + radius * circle for radius, z in profile]
        self._rings(rings, [radius for radius, _ in profile], material)
        return self

    def rod(self, start, end, radius: float, material: Material, sides: int = 6) -> "Solid":
        """Add a round bar from `start` to `end` (x, y, z)."""
        start, end = np.asarray(start, float), np.asarray(end, float)
        axis = (end - start) / np.linalg.norm(end - start)
        helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.9 else np.array([0, 1.0, 0])
        right = np.cross(axis, helper)
        right /= np.linalg.norm(right)
        angle = np.arange(sides)[:, None] * (2 * math.pi / sides)
        circle = radius * (np.cos(angle) * right + np.sin(angle) * np.cross(axis, right))
        self._rings([start + circle, end + circle], [radius, radius], material)
        return self

    def _rings(self, rings: list[np.ndarray], radii: list[float], material: Material) -> None:
        """Add the surface between consecutive rings, with a lid if the first or last radius is not zero."""
        sides = len(rings[0])
        after = np.roll(np.arange(sides), -1)
        for low, high, r_low, r_high in zip(rings[:-1], rings[1:], radii[:-1], radii[1:]):
            if r_low > 0:
                self._add(np.stack([low, low[after], high[after], high], axis=1), material)
            elif r_high > 0:  # a tip below: start on the upper edge, because the first edge needs a length
                self._add(np.stack([high[after], high, low, low], axis=1), material)
        fan = np.array([[0, i, i + 1, i + 2] for i in range(1, sides - 2, 2)])
        if radii[-1] > 0:
            self._add(rings[-1][fan], material)
        if radii[0] > 0:
            self._add(rings[0][fan][:, ::-1], material)

    def leaf(self, base, tip, width: float, material: Material) -> "Solid":
        """Add a thin folded leaf (a flat tetrahedron) from `base` to `tip`, `width` metres wide."""
        base, tip = np.asarray(base, float), np.asarray(tip, float)
        along = tip - base
        x, y, z = along.tolist()
        side = np.array([y, -x, 0.0] if math.hypot(x, y) > 1e-6 else [1.0, 0.0, 0.0])  # horizontal, across the leaf
        side *= width / 2 / np.linalg.norm(side)
        lift = np.array([side[1] * z, -side[0] * z, side[0] * y - side[1] * x])  # side x along
        middle = base + 0.45 * along + lift * (0.25 * width / np.linalg.norm(lift))
        left, right = middle - side, middle + side
        faces = np.array([[tip, base, left], [base, tip, right], [left, right, tip], [right, left, base]])
        self._add(faces[:, [0, 1, 2, 2]], material)
        return self

    def join(self, other: "Solid", at: tuple[float, float, float] = (0, 0, 0), yaw: float = 0.0) -> "Solid":
        """Add `other`, rotated by `yaw` (radians) about z and moved to `at`."""
        turn = np.array([[math.cos(yaw), math.sin(yaw), 0], [-math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
        self._quads.extend(quads @ turn + np.asarray(at, float) for quads in other._quads)
        self._hidden.extend(other._hidden)
        self._materials.extend(other._materials)
        return self

    def uncovered(self) -> "Solid":
        """A copy without hidden quads."""
        solid = Solid()
        solid._quads, solid._materials = self._quads, self._materials
        solid._hidden = [np.zeros_like(hidden) for hidden in self._hidden]
        return solid

    def stretched(self, factor: np.ndarray) -> "Solid":
        """A copy with each axis scaled by `factor` (3,) about the origin."""
        solid = Solid()
        solid._quads = [quads * factor for quads in self._quads]
        solid._hidden, solid._materials = self._hidden, self._materials
        return solid

    @property
    def filled(self) -> bool:
        """Whether it has a quad."""
        return bool(self._quads)

    @property
    def quads(self) -> np.ndarray:
        """(Q, 4, 3) float64, metres."""
        return np.concatenate(self._quads)

    @property
    def hidden(self) -> np.ndarray:
        """(Q,) bool: whether a quad is invisible from everywhere."""
        return np.concatenate(self._hidden)

    @property
    def materials(self) -> list[Material]:
        """Q materials."""
        return [m for quads, m in zip(self._quads, self._materials) for _ in range(len(quads))]

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) lower and upper corner, metres."""
        corners = self.quads.reshape(-1, 3)
        return np.stack([corners.min(axis=0), corners.max(axis=0)])


def unseen(quads: np.ndarray) -> np.ndarray:
    """(Q,) bool: undersides among quads ((Q, 4, 3), metres) that are below all cameras."""
    normal = np.cross(quads[:, 1] - quads[:, 0], quads[:, 2] - quads[:, 0])
    return (normal[:, 2] < -0.99 * np.linalg.norm(normal, axis=1)) & (quads[:, :, 2].max(axis=1) < _EYE_M)


def tops_above(quads: np.ndarray, height_m: float) -> np.ndarray:
    """(Q,) bool: quads ((Q, 4, 3), metres) that face up, above a height."""
    normal = np.cross(quads[:, 1] - quads[:, 0], quads[:, 2] - quads[:, 0])
    return (normal[:, 2] > 0.99 * np.linalg.norm(normal, axis=1)) & (quads[:, :, 2].min(axis=1) > height_m)
