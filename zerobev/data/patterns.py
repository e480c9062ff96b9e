"""Grey source images of the *Synth* textures: the DTD folder, or procedural patterns and photographs.

The paper uses the Describable Textures Dataset. Without it, the families of patterns below and the photographs in the
scikit-image package give similar variety.
"""

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np
import skimage
from PIL import Image
from scipy.spatial import cKDTree

from zerobev.common.errors import InputError

Array = np.ndarray
Rng = np.random.Generator

#: Images in the scikit-image wheel, read without a download.
PHOTOGRAPHS = (
    "brick.png",
    "chelsea.png",
    "coffee.png",
    "coins.png",
    "grass.png",
    "gravel.png",
    "hubble_deep_field.jpg",
    "ihc.png",
    "moon.png",
    "page.png",
    "retina.jpg",
    "rocket.jpg",
)


# --- coordinates and fields: all (size, size) float64; u and v are in periods of the pattern


def plane(rng: Rng, size: int) -> tuple[Array, Array]:
    """Coordinates u, v of the plane, rotated and shifted at random; 4 to 9 periods per side."""
    y, x = np.mgrid[:size, :size] * (rng.uniform(4, 9) / size)
    angle, (shift_u, shift_v) = rng.uniform(0, 2 * np.pi), rng.uniform(0, 64, 2)
    return x * np.cos(angle) - y * np.sin(angle) + shift_u, x * np.sin(angle) + y * np.cos(angle) + shift_v


def polar(rng: Rng, size: int) -> tuple[Array, Array]:
    """Radius in periods (4 to 9 per side) and angle in turns, about a random centre."""
    y, x = np.mgrid[:size, :size] / size - rng.uniform(0.3, 0.7, (2, 1, 1))
    return rng.uniform(4, 9) * np.hypot(x, y), np.arctan2(y, x) / (2 * np.pi)


def noise(rng: Rng, size: int, low: float, high: float, slope: float = 0, stretch: float = 1) -> Array:
    """Gaussian noise of `low` to `high` cycles per side, zero mean, unit variance.

    Amplitudes fall with frequency to the power `slope`; `stretch` > 1 elongates structures along one axis.
    """
    fy, fx = np.meshgrid(np.fft.fftfreq(size, 1 / size), np.fft.rfftfreq(size, 1 / size), indexing="ij")
    angle = rng.uniform(0, np.pi)
    frequency = np.hypot(fx * np.cos(angle) + fy * np.sin(angle), stretch * (fy * np.cos(angle) - fx * np.sin(angle)))
    band = (frequency >= low) & (frequency <= high)
    amplitude = np.where(band, np.maximum(frequency, 1) ** -slope, 0)
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * amplitude, (size, size))
    return (field - field.mean()) / field.std()


def shade(rng: Rng) -> Callable[[Array, Array], Array]:
    """A random grey in [0, 1] per unit square of the plane (period 64)."""
    table = rng.random((64, 64))
    return lambda u, v: table[np.floor(u).astype(int) % 64, np.floor(v).astype(int) % 64]


def cells(rng: Rng, size: int) -> tuple[Array, ...]:
    """Voronoi cells of a jittered grid: distances to the nearest and the second seed, the offset (2) from the
    nearest, rotated by a random angle per cell, and a grey per cell."""
    u, v = plane(rng, size)
    points = np.stack([u, v], axis=-1)
    low, high = np.floor(points.min((0, 1))) - 1, points.max((0, 1)) + 1
    seeds = np.mgrid[low[0] : high[0], low[1] : high[1]].reshape(2, -1).T
    seeds += rng.random(seeds.shape)
    distance, seed = cKDTree(seeds).query(points, k=2)
    nearest = seed[..., 0]
    x, y = np.moveaxis(points - seeds[nearest], -1, 0)
    turn, tone = rng.random((2, len(seeds)))[:, nearest]
    cosine, sine = np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)
    return distance[..., 0], distance[..., 1], cosine * x - sine * y, sine * x + cosine * y, tone


# --- shapes


def wave(x: Array) -> Array:
    """A cosine of period 1 in [0, 1]."""
    return 0.5 + 0.5 * np.cos(2 * np.pi * x)


def fold(x: Array) -> Array:
    """A triangle wave of period 1 in [0, 1], 0 at the integers."""
    return 2 * np.abs(x - np.round(x))


def parity(x: Array) -> Array:
    """0 on even unit intervals, 1 on odd ones."""
    return np.floor(x) % 2


def hexagon(u: Array, v: Array) -> Array:
    """0 at the centres of hexagonal cells of width 1, 1 on their edges."""
    distance, root = np.full_like(u, np.inf), np.sqrt(3)
    for shift in (0, 0.5):
        x, y = np.abs((u + shift) % 1 - 0.5), np.abs((v + shift * root) % root - root / 2)
        distance = np.minimum(distance, np.maximum(x, x / 2 + y * root / 2))
    return 2 * distance


def crossing(u: Array, v: Array, directions: int) -> Array:
    """Plane waves in evenly spaced directions: 3 make a hexagonal lattice, 5 a quasicrystal."""
    angles = np.pi * np.arange(directions) / directions
    return sum(np.cos(2 * np.pi * (u * np.cos(a) + v * np.sin(a))) for a in angles)


def brick(u: Array, v: Array, s: Callable[[Array, Array], Array]) -> Array:
    """Shaded bricks in mortar, every other row shifted by half a brick."""
    u = u + 0.5 * parity(2 * v)
    return np.where(np.minimum(fold(u) * 2, fold(2 * v)) > 0.25, 0.4 + 0.6 * s(u, 2 * v), 0)


def truchet(u: Array, v: Array, s: Callable[[Array, Array], Array]) -> Array:
    """Quarter circles in randomly mirrored squares, which join to a maze."""
    x, y = np.where(s(u, v) > 0.5, u % 1, 1 - u % 1), v % 1
    return -np.minimum(np.abs(np.hypot(x, y) - 0.5), np.abs(np.hypot(1 - x, 1 - y) - 0.5))


def triangle(u: Array, v: Array, s: Callable[[Array, Array], Array]) -> Array:
    """Equilateral triangles, with a grey per triangle."""
    u, v = u - v / np.sqrt(3), v * 2 / np.sqrt(3)
    return s(2 * np.floor(u) + (u % 1 + v % 1 > 1), v)


def ripples(rng: Rng, size: int) -> Array:
    """Superposed circular waves from four centres."""
    return sum((np.cos(2 * np.pi * polar(rng, size)[0] * 1.5) for _ in range(4)), np.zeros((size, size)))


def turbulence(rng: Rng, size: int) -> Array:
    """Octaves of rectified noise: sharp dark veins."""
    return sum(np.abs(noise(rng, size, 2**k, 2 ** (k + 1))) / 2**k for k in range(1, 5))


def discs(rng: Rng, size: int) -> Array:
    """Overlapping discs of many sizes and greys."""
    y, x = np.mgrid[:size, :size] / size
    image = np.zeros((size, size))
    for cy, cx, radius, grey in rng.random((80, 4)):
        image[np.hypot(y - cy, x - cx) < 0.02 + 0.1 * radius**2] = grey
    return image


def scratches(rng: Rng, size: int) -> Array:
    """Straight strokes at random angles over the whole image."""
    image = np.zeros((size, size))
    y, x = np.mgrid[:size, :size] / size
    for angle, along, width in rng.random((25, 3)) * [np.pi, 1, 0.02]:
        image += np.abs((x - 0.5) * np.cos(angle) + (y - 0.5) * np.sin(angle) + along - 0.5) < 0.004 + width
    return image


# --- the kinds of patterns, by their arguments

#: functions of (u, v, shade of unit squares)
PLANE = {
    "stripes": lambda u, v, s: wave(u),
    "awning": lambda u, v, s: s(2 * u, 0 * v),
    "sawtooth": lambda u, v, s: u % 1,
    "pinstripes": lambda u, v, s: fold(u) ** 12,
    "waves": lambda u, v, s: wave(u + 0.25 * np.sin(np.pi * v)),
    "zigzag": lambda u, v, s: parity(1.5 * u + fold(v)) * 0.8 + 0.2 * fold(v),
    "herringbone": lambda u, v, s: s(u, 3 * (v + np.where(parity(u) > 0, u % 1, 1 - u % 1))),
    "checks": lambda u, v, s: (parity(u) + parity(v)) % 2 + 0.4 * s(u, v),
    "gingham": lambda u, v, s: parity(2 * u) + parity(2 * v),
    "eggs": lambda u, v, s: wave(u) * wave(v),
    "grid": lambda u, v, s: np.maximum(fold(u), fold(v)) ** 8,
    "pyramids": lambda u, v, s: np.maximum(fold(u), fold(v)),
    "dots": lambda u, v, s: np.hypot(fold(u), fold(v)) < 0.2 + 0.7 * s(u + 0.5, v + 0.5),
    "patchwork": lambda u, v, s: s(u, v),
    "plaid": lambda u, v, s: s(3 * u, 0 * v) + s(0 * u, 3 * v),
    "weave": lambda u, v, s: np.where((parity(u) + parity(v)) % 2 > 0, fold(u), fold(v)) ** 0.5,
    "bricks": brick,
    "hexagons": lambda u, v, s: np.minimum(hexagon(u, v), 0.9) * (hexagon(u, v) < 0.95),
    "lattice": lambda u, v, s: crossing(u, v, 3),
    "quasicrystal": lambda u, v, s: crossing(u, v, 5),
    "triangles": triangle,
    "scales": lambda u, v, s: np.hypot((u + 0.5 * parity(2 * v)) % 1 - 0.5, v % 0.5),
    "maze": truchet,
    "carpet": lambda u, v, s: (16 * u).astype(int) & (16 * v).astype(int) & 63,
}
#: functions of (radius, turns, number of arms)
POLAR = {
    "rings": lambda r, a, k: wave(r),
    "spiral": lambda r, a, k: parity(2 * (r + (k % 3 + 1) * a)) + 0.3 * r,
    "sunburst": lambda r, a, k: wave(2 * k * a),
    "vortex": lambda r, a, k: wave(k * a + 1.5 * np.log(r + 0.1)),
    "flower": lambda r, a, k: (r * (1 + 0.3 * np.cos(2 * np.pi * k * a))) % 1,
    "dartboard": lambda r, a, k: (parity(r) + parity(2 * k * a)) % 2 + 0.05 * r,
    "web": lambda r, a, k: np.maximum(fold(r * (1 + 0.2 * fold(2 * k * a))), fold(2 * k * a)) ** 10,
}
#: functions of (distances to the nearest and the second seed, rotated offset from the nearest (2), grey of the cell)
CELLS = {
    "bumps": lambda f, g, x, y, s: -f,
    "mosaic": lambda f, g, x, y, s: s,
    "cracks": lambda f, g, x, y, s: np.minimum(g - f, 0.15),
    "stones": lambda f, g, x, y, s: (0.4 + s) * np.minimum(g - f, 0.4),
    "agate": lambda f, g, x, y, s: wave(3 * f),
    "spots": lambda f, g, x, y, s: f < 0.1 + 0.35 * s,
    "facets": lambda f, g, x, y, s: s + 1.5 * x,
    "leaves": lambda f, g, x, y, s: (0.5 + s) * (np.abs(x) < 0.5 * (0.25 - y**2)) * (np.abs(x) > 0.015),
    "petals": lambda f, g, x, y, s: (f < 0.32 + 0.15 * np.cos(5 * np.arctan2(y, x))) * (0.4 + f),
    "confetti": lambda f, g, x, y, s: (0.4 + s) * (np.maximum(np.abs(x), np.abs(y)) < 0.28),
    "sticks": lambda f, g, x, y, s: (np.abs(x) < 0.07) * (0.5 + s),
    "crosses": lambda f, g, x, y, s: (np.minimum(np.abs(x), np.abs(y)) < 0.1) * (f < 0.45),
    "hoops": lambda f, g, x, y, s: -np.abs(f - 0.3) * (0.3 + s),
    "crescents": lambda f, g, x, y, s: (f < 0.4) * (np.hypot(x - 0.2, y) > 0.36) * (0.6 + s),
}
#: functions of (rng, size)
FIELDS = {
    "clouds": lambda rng, n: noise(rng, n, 1, 128, slope=2),
    "smoke": lambda rng, n: noise(rng, n, 1, 128, slope=1.3),
    "grain": lambda rng, n: noise(rng, n, 16, 32),
    "labyrinth": lambda rng, n: np.tanh(2 * noise(rng, n, 8, 10)),
    "blobs": lambda rng, n: noise(rng, n, 2, 6),
    "brushed": lambda rng, n: noise(rng, n, 2, 64, slope=0.5, stretch=12),
    "bark": lambda rng, n: np.tanh(3 * noise(rng, n, 6, 24, stretch=4)),
    "ridges": lambda rng, n: -np.abs(noise(rng, n, 1, 16, slope=1)),
    "terraces": lambda rng, n: (1.5 * noise(rng, n, 1, 5)) % 1,
    "camouflage": lambda rng, n: np.clip(np.floor(1.5 * noise(rng, n, 1, 32, slope=1.5)), -2, 2),
    "marble": lambda rng, n: wave(plane(rng, n)[0] / 2 + 0.4 * noise(rng, n, 1, 32, slope=1.5)) ** 2,
    "wood": lambda rng, n: (polar(rng, n)[0] + 0.3 * noise(rng, n, 1, 5)) % 1,
    "zebra": lambda rng, n: np.tanh(5 * np.sin(2 * np.pi * plane(rng, n)[0] + 2 * noise(rng, n, 1, 5))),
    "turbulence": turbulence,
    "ripples": ripples,
    "discs": discs,
    "scratches": scratches,
}
KINDS = (*PLANE, *POLAR, *CELLS, *FIELDS)


def procedural(kind: str, rng: Rng, size: int) -> Array:
    """A pattern of `kind` (one of `KINDS`): (size, size) float32 from 0 to 1."""
    if kind in PLANE:
        image = PLANE[kind](*plane(rng, size), shade(rng))
    elif kind in POLAR:
        image = POLAR[kind](*polar(rng, size), rng.integers(3, 12))
    elif kind in CELLS:
        image = CELLS[kind](*cells(rng, size))
    else:
        image = FIELDS[kind](rng, size)
    image = image.astype(np.float32)
    low, high = image.min(), image.max()
    return (image - low) / (high - low)


def read_grey(path: Path) -> Array:
    """Read a PNG or JPEG file as (h, w) float32 in [0, 1]; a damaged file or one of another kind is an `InputError`."""
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as image:
            return np.asarray(image.convert("L"), np.float32) / 255
    except Exception as error:  # PIL raises many kinds of error for a damaged image
        raise InputError(f"{path}: expected an image, found {error}") from error


@cache
def photograph(name: str) -> Array:
    """One of `PHOTOGRAPHS` as (h, w) float32 in [0, 1]."""
    return read_grey(Path(skimage.__file__).parent / "data" / name)


class SourceImages:
    """Random grey images: from the DTD folder if one is given, else patterns and photographs.

    `dtd` is a folder with `images/<category>/*.jpg`; none found is an `InputError`. Files are read when drawn.
    """

    def __init__(self, dtd: Path | None = None, size: int = 96) -> None:
        """`size`: side of a pattern, pixels."""
        if dtd is None:
            self._kinds: list[Callable[[Rng], Array]] = [partial(procedural, kind, size=size) for kind in KINDS]
            self._kinds += [_fixed(partial(photograph, name)) for name in PHOTOGRAPHS]
            return
        files = sorted(Path(dtd).glob("images/*/*.jpg"))
        if not files:
            raise InputError(f"{dtd}: expected a folder with images/<category>/*.jpg, found none")
        self._kinds = [_fixed(partial(read_grey, file)) for file in files]

    def draw(self, rng: Rng) -> Array:
        """A random source: (h, w) float32 in [0, 1]."""
        return self._kinds[rng.integers(len(self._kinds))](rng)


def _fixed(read: Callable[[], Array]) -> Callable[[Rng], Array]:
    """A kind with a single image; it draws no random numbers."""
    return lambda _: read()
