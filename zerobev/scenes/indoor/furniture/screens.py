"""Televisions and monitors."""

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.furniture.piece import Piece, one
from zerobev.scenes.indoor.solids import Material, Solid

_BLACK = Material("plain", (0.07, 0.07, 0.08), (0.1, 0.1, 0.1))


def _panel(rng: np.random.Generator, solid: Solid, w: float, y: float, z: float, depth: float = 0.05) -> float:
    """A frame and its screen, `w` metres wide with the lower edge at `z`; the height of its upper edge."""
    h = w * 0.5625
    body = _BLACK if rng.random() < 0.8 else surfaces.metal(rng)
    solid.box((-w / 2, w / 2), (y, y + depth), (z, z + h), body)
    edge = rng.uniform(0.008, 0.025)
    screen = surfaces.screen(rng)
    solid.box(
        (-w / 2 + edge, w / 2 - edge), (y + depth, y + depth + 0.004), (z + edge, z + h - edge), screen, hide="brltu"
    )
    return z + h


def wall_tv(rng: np.random.Generator) -> Piece:
    """A flat television on the wall; z = 0 is its lower edge."""
    solid = Solid()
    _panel(rng, solid, rng.uniform(0.8, 1.5), 0.03, 0.0)
    solid.box((-0.2, 0.2), (0.0, 0.03), (0.1, 0.35), _BLACK, hide="b")
    return one("tv", solid)


def footed_tv(rng: np.random.Generator) -> Piece:
    """A television on two feet, for a cabinet."""
    w, solid = rng.uniform(0.7, 1.3), Solid()
    _panel(rng, solid, w, 0.09, 0.06)
    for x in (-w * 0.32, w * 0.32):
        solid.box((x - 0.015, x + 0.015), (0.0, 0.24), (0.0, 0.015), _BLACK)
        solid.box((x - 0.015, x + 0.015), (0.1, 0.13), (0.015, 0.06), _BLACK, hide="tu")
    return one("tv", solid)


def pedestal_tv(rng: np.random.Generator) -> Piece:
    """A television on one column, for a cabinet."""
    w, solid = rng.uniform(0.6, 1.1), Solid()
    _panel(rng, solid, w, 0.1, 0.1)
    solid.box((-w * 0.2, w * 0.2), (0.0, 0.24), (0.0, 0.015), _BLACK)
    solid.box((-0.04, 0.04), (0.08, 0.1), (0.015, 0.3), _BLACK)
    return one("tv", solid)


def tube_tv(rng: np.random.Generator) -> Piece:
    """A deep old set of glass and grey plastic."""
    w, grey = rng.uniform(0.5, 0.7), surfaces.two_tone("plain", (0.3, 0.3, 0.32), 0.8)
    solid = Solid().box((-w * 0.35, w * 0.35), (0.0, 0.22), (0.03, w * 0.65), grey)
    solid.box((-w / 2, w / 2), (0.22, 0.42), (0.0, w * 0.78), grey)
    solid.box((-w * 0.42, w * 0.42), (0.42, 0.43), (w * 0.12, w * 0.72), surfaces.screen(rng), hide="b")
    return one("tv", solid)


def tripod_tv(rng: np.random.Generator) -> Piece:
    """A screen on an easel that stands on the floor."""
    w, wood, solid = rng.uniform(0.9, 1.3), surfaces.wood(rng), Solid()
    top = _panel(rng, solid, w, 0.28, 0.75)
    for x, y in ((-0.4, 0.5), (0.4, 0.5), (0.0, 0.02)):
        solid.rod((x, y, 0), (x * 0.1, 0.24, top - 0.1), 0.018, wood, sides=4)
    return one("tv", solid)


def monitor(rng: np.random.Generator) -> Piece:
    """A computer's screen for a desk."""
    w, solid = rng.uniform(0.48, 0.75), Solid()
    _panel(rng, solid, w, 0.1, 0.12, 0.03)
    solid.box((-0.12, 0.12), (0.02, 0.22), (0.0, 0.015), _BLACK)
    solid.box((-0.03, 0.03), (0.06, 0.1), (0.015, 0.3), _BLACK)
    return one("monitor", solid)


ON_CABINET = (footed_tv, pedestal_tv, tube_tv)
SCREENS = (wall_tv, *ON_CABINET, tripod_tv, monitor)
