"""The style of a home: surfaces, light and furniture that all its rooms share."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from zerobev.scenes.indoor import surfaces
from zerobev.scenes.indoor.light import Lamp
from zerobev.scenes.indoor.solids import Material
from zerobev.scenes.indoor.surfaces import Color

#: The material of a floor or wall in a room of the given kind.
Surface = Callable[[np.random.Generator, str], Material]

_WHITE = surfaces.two_tone("plain", (0.95, 0.95, 0.94), 0.96)
_WET = ("bathroom", "kitchen", "laundry room")
#: Colour casts of lamps and panes, linear RGB: warm, cold, green, red.
_CASTS = ((1.15, 0.8, 0.45), (0.7, 0.95, 1.35), (0.85, 1.1, 0.7), (1.2, 0.8, 0.85))


@dataclass(frozen=True)
class Style:
    """The defaults are the style of all flats."""

    floor: Surface = surfaces.floor
    wall: Surface = surfaces.wall
    ceiling: Material = _WHITE
    panel: Material | None = None  #: of the skirting, or of the lower part of walls; None: a skirting per room
    panel_m: float = 0.08  #: its height
    saturation: float = 1.0  #: factor on the saturation of all colours
    gamma: float = 1.0  #: exponent of all colours; less than 1 is lighter
    contrast: float = 1.0  #: factor on the contrast of all patterns; 0: no patterns

    kept: float = 1.0  #: probability that a piece is not left out
    extra: float = 0.0  #: further small things on the floor, per m2
    stretch: float = 0.0  #: largest change of a piece's width and depth, as logarithm
    loose: float = 0.0  #: probability that a movable piece is not at its wall
    askew: float = 0.0  #: probability that a piece away from walls is not parallel to them
    shut: float = 0.0  #: mean number of shut doors per room, to places outside the home

    day: float = 1.0  #: factor on daylight
    lamp: float = 1.0  #: factor on the light of lamps
    cast: Color = (1.0, 1.0, 1.0)  #: factor on the colour of all light
    uneven: float = 0.0  #: spread of brightness and colour among lamps
    pane: Material | None = None  #: of window panes
    key: float | None = None  #: median brightness of large surfaces, linear; None: no automatic exposure
    exposure: float = 1.5  #: see `paint`
    shoulder: float = 0.9
    directions: int = 8  #: of reflected light, see `bake`
    baked: bool = True  #: False: the textures have no light, photographs are taken with a lamp at the camera

    def of(self, name: str, material: Material) -> Material:
        """The material of a part of an instance called `name`."""
        if material.glow:
            return self.pane if self.pane and name == "window" else material
        if self.saturation == self.gamma == self.contrast == 1.0:
            return material
        first, second = np.array(material.color), np.array(material.second)
        second = first + self.contrast * (second - first)
        return replace(material, color=self._graded(first), second=self._graded(second))

    def _graded(self, color: np.ndarray) -> Color:
        grey = color.mean()
        red, green, blue = (np.clip(grey + self.saturation * (color - grey), 0.0, 1.0) ** self.gamma).tolist()
        return red, green, blue

    def shines(self, rng: np.random.Generator, lamp: Lamp) -> Lamp:
        """The lamp with this home's brightness and colour."""
        power = lamp.power * np.array(self.cast) * (self.day if lamp.facing.any() else self.lamp)
        if self.uneven:
            power = power * np.exp(rng.uniform(-self.uneven, self.uneven)) * rng.uniform(1 - self.uneven / 2, 1, 3)
        return replace(lamp, power=power)


#: The style of all flats.
FLATS = Style()


def draw_style(rng: np.random.Generator) -> Style:
    """A style with surfaces, furniture and light drawn independently."""
    style = Style(floor=_floors(rng), wall=_walls(rng), ceiling=_ceiling(rng))
    if rng.random() < 0.25:
        panel = surfaces.wood(rng) if rng.random() < 0.5 else surfaces.paint(rng)
        style = replace(style, panel=panel, panel_m=float(rng.choice([0.25, rng.uniform(0.8, 1.4)])))
    grade = rng.choice(["none", "white", "plain", "strong", "dark", "grey"], p=(0.3, 0.16, 0.16, 0.16, 0.12, 0.1))
    if grade == "white":
        style = replace(style, saturation=0.25, gamma=0.4, contrast=float(rng.uniform(0, 0.4)))
    elif grade == "plain":
        style = replace(style, saturation=float(rng.uniform(0.8, 2.2)), contrast=0.0)
    elif grade == "strong":
        style = replace(style, saturation=1.3, contrast=float(rng.uniform(1.3, 2.5)))
    elif grade == "dark":
        style = replace(style, gamma=float(rng.uniform(1.3, 2.0)))
    elif grade == "grey":
        style = replace(style, saturation=float(rng.uniform(0, 0.4)))
    return _lit(rng, _filled(rng, style))


def _floors(rng: np.random.Generator) -> Surface:
    """As in flats, or one material in all rooms, or in all except those with water."""
    if rng.random() < 0.25:
        return surfaces.floor
    grey = (float(rng.uniform(0.3, 0.8)),) * 3
    dry = (
        surfaces.two_tone("wide planks", (0.25, 0.17, 0.12), 0.7),
        surfaces.two_tone("planks", (0.88, 0.8, 0.68), 0.85),
        surfaces.two_tone("carpet", surfaces.fabric(rng).color, 0.8),
        surfaces.two_tone("large tiles", surfaces.stone(rng).color, float(rng.choice([0.6, 0.9, 1.2]))),
        surfaces.two_tone("plain", grey, 0.9),
        surfaces.two_tone("marble", (0.85, 0.84, 0.82), 0.7),
        surfaces.paint(rng),
        surfaces.wood(rng, "parquet"),
    )[rng.integers(8)]
    wet = surfaces.floor(rng, "bathroom") if rng.random() < 0.6 else dry
    return lambda rng, room: wet if room in _WET else dry


def _walls(rng: np.random.Generator) -> Surface:
    """As in flats; white; one colour; a strong colour per room; a pattern per room."""
    style = rng.choice(["mixed", "white", "one", "strong", "pattern"], p=(0.25, 0.3, 0.2, 0.15, 0.1))
    if style == "mixed":
        return surfaces.wall
    if style == "white":
        return lambda rng, room: _WHITE
    if style == "one":
        one = surfaces.wall(rng, "hall")
        return lambda rng, room: one
    if style == "strong":
        return lambda rng, room: surfaces.two_tone("plain", surfaces.vivid(rng).color, 0.95)
    patterns = ("stripes", "floral", "brick", "ornament", "squares", "marble", "painting", "grain")
    return lambda rng, room: surfaces.two_tone(str(rng.choice(patterns)), surfaces.wall(rng, "hall").color, 0.7)


def _ceiling(rng: np.random.Generator) -> Material:
    style = rng.random()
    if style < 0.6:
        return _WHITE
    if style < 0.75:
        return surfaces.two_tone("large tiles", (0.9, 0.9, 0.88), 0.75)
    return surfaces.wood(rng, "planks") if style < 0.85 else surfaces.paint(rng)


def _filled(rng: np.random.Generator, style: Style) -> Style:
    """From nearly empty to crowded."""
    style = replace(
        style,
        stretch=0.2,
        loose=float(rng.choice([0.05, 0.15, 0.4])),
        askew=float(rng.choice([0.1, 0.3, 0.8])),
        shut=float(rng.uniform(0.0, 0.6)),
    )
    amount = rng.random()
    if amount < 0.12:
        return replace(style, kept=float(rng.uniform(0.04, 0.2)))
    if amount < 0.25:
        return replace(style, kept=float(rng.uniform(0.3, 0.7)))
    return replace(style, extra=float(rng.uniform(0.1, 0.6))) if amount > 0.75 else style


def _lit(rng: np.random.Generator, style: Style) -> Style:
    """Even, bright with clipped windows, dark, with a colour cast, with uneven lamps, or without baked light."""
    kinds = ["even", "bright", "dark", "cast", "uneven", "none"]
    kind = rng.choice(kinds, p=(0.2, 0.24, 0.16, 0.16, 0.14, 0.1))
    outside = (
        None,
        surfaces.glowing((1.0, 1.0, 1.0)),
        Material("foliage", (0.75, 0.85, 0.95), (0.25, 0.4, 0.2), glow=True),
        Material("painting", (0.7, 0.75, 0.8), (0.5, 0.45, 0.4), glow=True),
    )
    if kind == "none":
        return replace(style, baked=False, pane=outside[rng.integers(4)], exposure=1.0, shoulder=0.0)
    style = replace(style, pane=outside[rng.integers(4)], key=float(rng.uniform(0.15, 0.4)), exposure=1.0, shoulder=0.6)
    style = replace(style, directions=32)
    if kind == "bright":
        key, day = float(rng.uniform(0.35, 0.7)), float(rng.uniform(1, 4))
        return replace(style, day=day, key=key, shoulder=float(rng.uniform(0, 0.3)), pane=outside[1])
    if kind == "dark":
        night = surfaces.glowing((0.03, 0.04, 0.07) if rng.random() < 0.5 else (0.45, 0.5, 0.6))
        return replace(style, day=0.1, key=float(rng.uniform(0.02, 0.08)), pane=night)
    if kind == "cast":
        return replace(style, cast=_CASTS[rng.integers(len(_CASTS))])
    if kind == "uneven":
        return replace(style, uneven=float(rng.uniform(0.5, 1.2)))
    return style
