"""Procedural albedo: grey patterns, and palettes of materials.

A pattern is a square tile of 1 cm texels, in [0, 1]; a material blends its two colours by it. Tiles are the same in
all homes; colours and offsets differ.
"""

import colorsys
from collections.abc import Callable
from functools import cache

import numpy as np
from scipy import ndimage

from zerobev.scenes.indoor.atlas import CHART_PX
from zerobev.scenes.indoor.solids import Material

#: Side of a pattern, texels; it repeats.
TILE_PX = 480

Color = tuple[float, float, float]


def _noise(rng: np.random.Generator, sigma: float | tuple[float, float]) -> np.ndarray:
    """Smooth periodic noise, rescaled to mean 0.5 and clipped to [0, 1]."""
    spectrum = np.fft.rfft2(rng.standard_normal((TILE_PX, TILE_PX), np.float32))
    field = np.fft.irfft2(ndimage.fourier_gaussian(spectrum, sigma, n=TILE_PX))
    return np.clip(0.5 + 0.2 * field / field.std(), 0, 1)


def _plain(rng: np.random.Generator) -> np.ndarray:
    return 0.8 * _noise(rng, 24.0) + 0.2 * rng.random((TILE_PX, TILE_PX))


def _grain(rng: np.random.Generator) -> np.ndarray:
    """Fibres along a row."""
    return 0.6 * _noise(rng, (1.0, 40.0)) + 0.4 * _noise(rng, (4.0, 120.0))


def _planks(rng: np.random.Generator, width: int, length: int) -> np.ndarray:
    """Staggered boards with a random shade per board and dark joints."""
    row, column = np.mgrid[:TILE_PX, :TILE_PX]
    board = row // width
    shift = rng.integers(0, length, TILE_PX // width + 1)
    end = (column + shift[board]) // length
    shade = rng.random((board.max() + 1, end.max() + 1))[board, end]
    joint = (row % width == 0) | ((column + shift[board]) % length == 0)
    return np.where(joint, 1.0, 0.55 * shade + 0.3 * _grain(rng))


def _tiles(rng: np.random.Generator, height: int, width: int, bond: bool = False) -> np.ndarray:
    """Tiles with joints of one texel; with `bond` every other row is shifted by half a tile."""
    row, column = np.mgrid[:TILE_PX, :TILE_PX]
    line = row // height
    column = column + (line % 2) * (width // 2) * bond
    shade = rng.random((line.max() + 1, column.max() // width + 1))[line, column // width]
    joint = (row % height == 0) | (column % width == 0)
    return np.where(joint, 1.0, 0.2 * shade + 0.1 * _noise(rng, 3.0))


def _checker(rng: np.random.Generator, side: int) -> np.ndarray:
    row, column = np.mgrid[:TILE_PX, :TILE_PX]
    return np.clip(((row // side + column // side) % 2) * 0.9 + 0.1 * rng.random(row.shape), 0, 1)


def _stripes(rng: np.random.Generator, period: int, fraction: float) -> np.ndarray:
    """Vertical stripes."""
    column = np.arange(TILE_PX) % period
    return np.clip((column < fraction * period) * 0.9 + 0.1 * rng.random((TILE_PX, TILE_PX)), 0, 1)


def _floral(rng: np.random.Generator) -> np.ndarray:
    """Blobs that repeat every 32 cm."""
    cell = ndimage.gaussian_filter(rng.standard_normal((32, 32)), 2.0, mode="wrap")
    return np.tile((cell > 0.6 * cell.std()).astype(float), (TILE_PX // 32, TILE_PX // 32))


def _woven(rng: np.random.Generator) -> np.ndarray:
    row, column = np.mgrid[:TILE_PX, :TILE_PX]
    return 0.35 * ((row + column) % 2) + 0.65 * rng.random(row.shape)


def _marble(rng: np.random.Generator) -> np.ndarray:
    return np.abs(np.sin(6 * np.pi * _noise(rng, 20.0) + 3 * _noise(rng, 4.0))) ** 3


def _ornament(rng: np.random.Generator) -> np.ndarray:
    """Concentric diamonds, for rugs."""
    row, column = np.mgrid[:TILE_PX, :TILE_PX]
    ring = (np.abs(row % 120 - 60) + np.abs(column % 120 - 60)) // 8
    return np.clip(rng.random(80)[ring] * 0.9 + 0.1 * rng.random(row.shape), 0, 1)


def _painting(rng: np.random.Generator) -> np.ndarray:
    """Uniform areas with sharp borders."""
    return np.floor(_noise(rng, 9.0) * 6) / 5 * 0.9 + 0.1 * _noise(rng, 1.0)


#: Every pattern by name; each is drawn once per process, from a fixed seed.
PATTERNS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "plain": _plain,
    "grain": _grain,
    "planks": lambda rng: _planks(rng, 12, 120),
    "wide planks": lambda rng: _planks(rng, 20, 160),
    "parquet": lambda rng: _planks(rng, 8, 40),
    "small tiles": lambda rng: _tiles(rng, 10, 10),
    "tiles": lambda rng: _tiles(rng, 30, 30),
    "large tiles": lambda rng: _tiles(rng, 60, 60),
    "metro tiles": lambda rng: _tiles(rng, 10, 20, bond=True),
    "brick": lambda rng: _tiles(rng, 8, 24, bond=True),
    "checker": lambda rng: _checker(rng, 30),
    "squares": lambda rng: _checker(rng, 8),
    "stripes": lambda rng: _stripes(rng, 16, 0.5),
    "pinstripes": lambda rng: _stripes(rng, 8, 0.2),
    "folds": lambda rng: np.clip(0.5 + 0.5 * np.sin(np.arange(TILE_PX) * np.pi / 6) + 0 * _plain(rng), 0, 1),
    "floral": _floral,
    "woven": _woven,
    "carpet": lambda rng: 0.6 * rng.random((TILE_PX, TILE_PX)) + 0.4 * _noise(rng, 12.0),
    "marble": _marble,
    "ornament": _ornament,
    "painting": _painting,
    "foliage": lambda rng: _noise(rng, 2.0),
}


@cache
def tile(pattern: str) -> np.ndarray:
    """(rows, columns) uint8: a pattern (255 is 1), repeated so that any window of a chart's size is a slice."""
    rng = np.random.default_rng(sorted(PATTERNS).index(pattern))
    grey = np.round(255 * np.clip(PATTERNS[pattern](rng), 0, 1)).astype(np.uint8)
    side = TILE_PX + CHART_PX
    return np.tile(grey, (4, 4))[:side, :side]


def _hsv(hue: float, saturation: float, value: float) -> Color:
    return colorsys.hsv_to_rgb(hue % 1.0, min(max(saturation, 0), 1), min(max(value, 0), 1))


def _shade(color: Color, factor: float) -> Color:
    red, green, blue = (min(1.0, factor * c) for c in color)
    return red, green, blue


def two_tone(pattern: str, color: Color, factor: float = 0.8) -> Material:
    """A pattern between a colour and a darker (or lighter) one."""
    return Material(pattern, color, _shade(color, factor))


def wood(rng: np.random.Generator, pattern: str = "grain") -> Material:
    """Wood from white to nearly black."""
    value = rng.choice([0.28, 0.42, 0.58, 0.74, 0.86])
    return two_tone(pattern, _hsv(rng.uniform(0.05, 0.11), rng.uniform(0.3, 0.65) * (1.15 - value * 0.5), value), 0.68)


def paint(rng: np.random.Generator) -> Material:
    """Lacquer: white, grey, black, or any muted colour."""
    if rng.random() < 0.55:
        return two_tone("plain", _hsv(0.1, rng.uniform(0, 0.06), rng.choice([0.15, 0.35, 0.6, 0.85, 0.92])), 0.92)
    return two_tone("plain", _hsv(rng.random(), rng.uniform(0.2, 0.7), rng.uniform(0.3, 0.85)), 0.9)


def lacquer_or_wood(rng: np.random.Generator) -> Material:
    """The material of a cabinet."""
    return wood(rng) if rng.random() < 0.6 else paint(rng)


def fabric(rng: np.random.Generator) -> Material:
    """Upholstery, blankets and cushions."""
    pattern = rng.choice(["woven", "woven", "woven", "carpet", "plain", "stripes", "squares", "floral"])
    return two_tone(str(pattern), _hsv(rng.random(), rng.uniform(0.05, 0.6), rng.uniform(0.2, 0.9)), 0.78)


def linen(rng: np.random.Generator) -> Material:
    """Light bed linen."""
    pattern = rng.choice(["plain", "woven", "pinstripes", "floral"])
    return two_tone(str(pattern), _hsv(rng.random(), rng.uniform(0, 0.15), rng.uniform(0.8, 0.97)), 0.88)


def metal(rng: np.random.Generator) -> Material:
    """Steel, brass or black iron."""
    color = [(0.72, 0.73, 0.75), (0.7, 0.58, 0.35), (0.12, 0.12, 0.13), (0.9, 0.9, 0.9)][rng.integers(4)]
    return two_tone("plain", color, 0.85)


def ceramic(rng: np.random.Generator) -> Material:
    """Sanitary white."""
    return two_tone("plain", _hsv(0.1, rng.uniform(0, 0.06), rng.uniform(0.9, 0.98)), 0.96)


def stone(rng: np.random.Generator) -> Material:
    """Worktops."""
    return two_tone("marble", _hsv(rng.random(), rng.uniform(0, 0.12), rng.choice([0.2, 0.5, 0.75, 0.9])), 0.75)


def vivid(rng: np.random.Generator) -> Material:
    """Books, toys, boxes, bottles."""
    return two_tone("plain", _hsv(rng.random(), rng.uniform(0.15, 0.8), rng.uniform(0.3, 0.95)), 0.85)


def foliage(rng: np.random.Generator) -> Material:
    """Leaves."""
    return two_tone("foliage", _hsv(rng.uniform(0.2, 0.4), rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.65)), 0.55)


def picture(rng: np.random.Generator) -> Material:
    """A painting or a print."""
    return Material("painting", _hsv(rng.random(), rng.random(), rng.random()), _hsv(rng.random(), 0.5, rng.random()))


def screen(rng: np.random.Generator) -> Material:
    """A display: mostly off and black, sometimes on."""
    if rng.random() < 0.7:
        return two_tone("plain", (0.04, 0.04, 0.05), 1.5)
    return Material("painting", _hsv(rng.random(), 0.6, 0.9), _hsv(rng.random(), 0.5, 0.4), glow=True)


def glowing(color: Color) -> Material:
    """A lamp shade or the sky."""
    return Material("plain", color, _shade(color, 0.93), glow=True)


def floor(rng: np.random.Generator, room: str) -> Material:
    """The material of a room's floor."""
    if room in ("bathroom", "kitchen") or rng.random() < 0.15:
        pattern = rng.choice(["tiles", "large tiles", "small tiles", "checker"])
        base = _hsv(rng.uniform(0, 0.15), rng.uniform(0, 0.25), rng.uniform(0.35, 0.92))
        return two_tone(str(pattern), base, rng.choice([0.45, 0.7, 1.3]))
    if room == "bedroom" and rng.random() < 0.4:
        return two_tone("carpet", _hsv(rng.random(), rng.uniform(0, 0.25), rng.uniform(0.45, 0.8)), 0.8)
    return wood(rng, str(rng.choice(["planks", "wide planks", "parquet"])))


def wall(rng: np.random.Generator, room: str) -> Material:
    """The material of a room's walls."""
    if room == "bathroom" or (room == "kitchen" and rng.random() < 0.3):
        pattern = rng.choice(["tiles", "metro tiles", "small tiles", "plain"])
        return two_tone(str(pattern), _hsv(rng.random(), rng.uniform(0, 0.25), rng.uniform(0.75, 0.97)), 0.8)
    color = _hsv(rng.random(), rng.choice([0.03, 0.1, 0.25, 0.4]) * rng.random(), rng.uniform(0.65, 0.96))
    if rng.random() < 0.75:
        return two_tone("plain", color, 0.93)
    pattern = rng.choice(["stripes", "pinstripes", "floral", "brick", "ornament"])
    return two_tone(str(pattern), color, 0.87)
