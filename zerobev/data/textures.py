"""Binary textures for the surface of a home: *Synth*, *Mod. Sem.*, and the rectangles of *Depth proj.*

Paper, supplement, "Details on the data generation process". A finished *Synth* tile is seamless, so one
bank of tiles serves every chart of every home: a fresh draw of tile, offset, orientation and scale for
each chart is a fresh texture, and rendering it is a look-up.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from zerobev.common.errors import InputError
from zerobev.common.progress import progress
from zerobev.common.storage import replacing
from zerobev.config import TextureConfig
from zerobev.data.patterns import SourceImages

KERNELS = ("ellipse", "square", "cross")
#: *Mod. Sem.* textures that are made of each scene; a byte has room for eight, but they differ little.
MODSEM_DRAWS = 4
#: Sources tried for one texture before they are taken to hold no structure at all.
MAX_SOURCES = 2000


def kernel_runs(shape: str, size: int) -> np.ndarray:
    """(size,) int: how many texels of each row belong to the kernel (`KERNELS`); each run is centred."""
    if shape == "square":
        return np.full(size, size)
    if shape == "cross":
        return np.where(np.arange(size) == size // 2, size, 1)
    height = np.arange(size) - (size - 1) / 2
    inset = np.round(size / 2 - np.sqrt((size / 2) ** 2 - height**2)).astype(int)
    return size - 2 * inset


def dilate(mask: np.ndarray, runs: np.ndarray, wrap: bool) -> np.ndarray:
    """Binary dilation of `mask` (rows, cols) bool by a kernel given as `kernel_runs`; `wrap`: on the torus.

    The kernel's anchor is its texel `size // 2`. Rows are packed into words of 64 texels; a row of the kernel
    is a run, and the union over a run takes the logarithm of its length.
    """
    rows, columns = mask.shape
    size = len(runs)
    before, after = (size - 1) // 2, size // 2
    padded = np.pad(mask, ((before, after), (before, after)), mode="wrap" if wrap else "constant")
    words = -(-padded.shape[1] // 64)
    line = np.zeros((len(padded), 8 * words), np.uint8)
    packed = np.packbits(padded, axis=1, bitorder="little")
    line[:, : packed.shape[1]] = packed
    line = line.reshape(-1).view("<u8")
    dilated = np.zeros(rows * words, "<u8")
    length = 1
    for run in np.unique(runs).tolist():
        while length < run:  # bit x of a row is the union of `length` texels from x on
            step = min(length, run - length)
            line = line | _ahead(line, step)
            length += step
        line_from_left = _ahead(line, (size - run + 1) // 2)  # a kernel reaches one way, its texels look the other way
        for top in (size - 1 - np.flatnonzero(runs == run)).tolist():
            dilated |= line_from_left[top * words : (top + rows) * words]
    texels = dilated.view(np.uint8).reshape(rows, -1)
    return np.unpackbits(texels, axis=1, count=columns, bitorder="little").view(bool)


def _ahead(bits: np.ndarray, by: int) -> np.ndarray:
    """`bits` (n,) uint64 as one string, first bit lowest, without its first `by` bits; zeros follow at its end."""
    words, rest = divmod(by, 64)
    moved = np.zeros_like(bits)
    np.right_shift(bits[words:], rest, out=moved[: len(bits) - words])
    if rest:
        moved[: len(bits) - words - 1] |= bits[words + 1 :] << (64 - rest)
    return moved


def opening(mask: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """Morphological opening on the torus: the union of all kernels that fit into `mask` (rows, cols) bool."""
    eroded = ~dilate(~mask[::-1, ::-1], runs, wrap=True)[::-1, ::-1]
    return dilate(eroded, runs, wrap=True)


def synth_texture(
    shape: tuple[int, int], config: TextureConfig, sources: SourceImages, rng: np.random.Generator
) -> np.ndarray:
    """One seamless *Synth* texture: (rows, cols) bool with `config.white_fraction` white (paper, supplement, "Synth.").

    Opened structures of random sources are added until `config.opened_fraction` is white, then everything is
    dilated, again and again, until `config.white_fraction` is; the last dilation is limited, so the share is exact.
    """
    if not 0 < config.opened_fraction <= config.white_fraction < 1:
        raise InputError(
            "texture fractions: expected 0 < opened <= white < 1, "
            f"found {config.opened_fraction} and {config.white_fraction}"
        )
    texels = shape[0] * shape[1]
    texture = opened_structures(shape, config, sources, rng)
    return _dilated_until(texture, round(config.white_fraction * texels), config.kernel_px, rng, wrap=True)


def opened_structures(
    shape: tuple[int, int], config: TextureConfig, sources: SourceImages, rng: np.random.Generator
) -> np.ndarray:
    """The first half of `synth_texture`: (rows, cols) bool, white from `opened_fraction` to 10 % (relative) above.

    Each source adds no more than four of the largest kernels, so that structures of many sources are spread
    over the texture; connected structures that are too large, of an almost white mask above all, are left out.
    """
    texture = np.zeros(shape, bool)
    wanted = config.opened_fraction * texture.size
    for _ in range(MAX_SOURCES):
        missing = wanted - np.count_nonzero(texture)
        if missing <= 0:
            return texture
        structures = _opened_source(shape, config, sources, rng)
        if not structures.any():
            continue
        labels, _ = ndimage.label(structures)
        area = np.bincount(labels.ravel())
        area[0] = 0
        limit = min(missing + 0.1 * wanted, 4 * config.kernel_px[1] ** 2)
        fits = rng.permutation(np.flatnonzero((area > 0) & (area <= limit)))
        kept = np.isin(labels, fits[np.cumsum(area[fits]) <= limit])
        corner = rng.integers(shape)
        rows, columns = ((np.argwhere(kept) + corner) % shape).T
        texture[rows, columns] = True
    raise InputError(f"texture sources: expected images with structure, found none that fits among {MAX_SOURCES}")


def _opened_source(
    shape: tuple[int, int], config: TextureConfig, sources: SourceImages, rng: np.random.Generator
) -> np.ndarray:
    """A random source, resized to sides of 4 to 16 kernels, thresholded and opened: (h, w) bool, at most `shape`.

    Of a mask that is mostly white the black part is taken: the white one shows the outline of the image.
    """
    sides = config.kernel_px[1] * 2 ** rng.uniform(2, 4, size=2)
    height, width = np.minimum(sides.astype(int), shape)
    image = np.asarray(Image.fromarray(sources.draw(rng)).resize((width, height), Image.Resampling.BILINEAR))
    mask = image > rng.uniform(image.min(), image.max())
    if np.count_nonzero(mask) > mask.size / 2:
        mask = ~mask
    mask[[0, -1]] = mask[:, [0, -1]] = False  # `opening` wraps around: no kernel may fit across the frame
    return opening(mask, _random_kernel(config.kernel_px, rng))


def _random_kernel(kernel_px: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    return kernel_runs(KERNELS[rng.integers(len(KERNELS))], int(rng.integers(kernel_px[0], kernel_px[1] + 1)))


def _dilated_until(
    mask: np.ndarray, white: int, kernel_px: tuple[int, int], rng: np.random.Generator, wrap: bool
) -> np.ndarray:
    """Dilate `mask` (not empty) by random kernels until exactly `white` texels are set (or more were already).

    The dilation that would overshoot uses the largest size of its kernel that does not; what is then
    missing is part of a ring one texel wide: the part in the rows below a random one.
    """
    while np.count_nonzero(mask) < white:
        shape = KERNELS[rng.integers(len(KERNELS))]
        size = int(rng.integers(kernel_px[0], kernel_px[1] + 1))
        dilated = dilate(mask, kernel_runs(shape, size), wrap)
        if np.count_nonzero(dilated) <= white:
            mask = dilated
            continue
        sizes, results = [1, size], [mask, dilated]
        while sizes[1] - sizes[0] > 1:
            few, many = map(np.count_nonzero, results)
            guess = int(np.interp(white, (few, many), sizes))  # the white grows almost evenly with the size
            middle = min(max(guess, sizes[0] + 1), sizes[1] - 1)
            dilated = dilate(mask, kernel_runs(shape, middle), wrap)
            exceeds = int(np.count_nonzero(dilated) > white)
            sizes[exceeds], results[exceeds] = middle, dilated
        below, above = results
        ring = np.flatnonzero(above & ~below)
        start = np.searchsorted(ring, rng.integers(mask.size))
        mask = below.copy()
        mask.flat[np.roll(ring, -start)[: white - np.count_nonzero(below)]] = True
    return mask


def modsem_textures(
    instance_image: np.ndarray, config: TextureConfig, rng: np.random.Generator, draws: int = MODSEM_DRAWS
) -> np.ndarray:
    """Independent *Mod. Sem.* textures of a chart: (draws, rows, cols) bool (paper, supplement, "Mod. Sem.").

    `instance_image` (rows, cols) uint16 holds instance ids, 0 for none. All texels of instances are white, then
    eroded by random kernels until `config.modsem_fraction` of them is left. Two readings of the paper are taken:
    - The share is of the texels that an instance covers, not of the chart: as much of the surfaces is white as
      with a *Synth* texture of this share, however much of the atlas is unused.
    - Instances erode one by one: a line one texel wide is black where two of them touch, and so is all beyond the
      chart. Without it, a densely packed chart is one white sheet, which shows nothing of the objects on it.
    Kernels are in texels: where an atlas has uneven density (as scans have), coarse parts lose wider margins in metres.
    Draws differ by the margins alone, and are alike where the share leaves little choice.
    """
    covered = instance_image > 0
    white = covered.copy()
    for here, there in (np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:]):
        white[here] &= (instance_image[here] == instance_image[there]) | ~covered[there]
    ground = ~np.pad(white, 1)
    black = ground.size - round(config.modsem_fraction * np.count_nonzero(covered))
    eroded = [_dilated_until(ground, black, config.kernel_px, rng, wrap=False) for _ in range(draws)]
    return ~np.array(eroded)[:, 1:-1, 1:-1]


def random_rectangles(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """The FPV image of *Depth proj.*: (rows, cols) bool, 10 to 20 white rectangles on black (paper, supplement)."""
    count = rng.integers(10, 21)
    largest = np.maximum(np.array(shape) // 3, 1)
    sides = rng.integers(1, largest + 1, size=(count, 2))
    corners = rng.integers(np.array(shape) - sides + 1)
    image = np.zeros(shape, bool)
    for (top, left), (bottom, right) in zip(corners.tolist(), (corners + sides).tolist()):
        image[top:bottom, left:right] = True
    return image


@dataclass(frozen=True)
class TextureDraw:
    """Which texture each of C charts of a home wears: one draw is one modality definition (paper, property P3)."""

    tile: np.ndarray  #: (C,) int64, index into the bank
    offset: np.ndarray  #: (C, 2) int32, rows and columns added to a texel's coordinates
    transpose: np.ndarray  #: (C,) bool: swap the tile's axes, before the flips
    flip: np.ndarray  #: (C, 2) bool: reverse the tile's rows, columns
    scale: float  #: structures are that many times smaller; below 1 they are larger


@dataclass(frozen=True)
class TextureBank:
    """Seamless *Synth* tiles of one configuration, worn by charts through `TextureDraw`s."""

    tiles: np.ndarray  #: (N, S, S) bool
    config: TextureConfig

    @classmethod
    def build(cls, config: TextureConfig, sources: SourceImages, rng: np.random.Generator) -> "TextureBank":
        """Make `config.tiles` tiles of side `config.tile_px`."""
        shape = (config.tile_px, config.tile_px)
        streams = progress(rng.spawn(config.tiles), "textures", "tile", config.tiles)
        return cls(np.stack([synth_texture(shape, config, sources, stream) for stream in streams]), config)

    def save(self, path: Path) -> None:
        """Write the bank as one `.npz` file, eight texels a byte."""
        with replacing(path) as temporary:
            np.savez_compressed(
                temporary, bits=np.packbits(self.tiles), shape=self.tiles.shape, config=json.dumps(asdict(self.config))
            )

    @classmethod
    def load(cls, path: Path) -> "TextureBank":
        """Read what `save` wrote; a file that is missing or is something else is an `InputError`."""
        try:
            with np.load(path) as file:
                shape = tuple(file["shape"])
                tiles = np.unpackbits(file["bits"], count=int(np.prod(shape))).reshape(shape).view(bool)
                config = json.loads(str(file["config"]))
        except Exception as error:
            raise InputError(f"{path}: expected a texture bank, found {error}") from error
        pairs = {name: tuple(value) for name, value in config.items() if isinstance(value, list)}
        return cls(tiles, TextureConfig(**config | pairs))

    def draw(self, rng: np.random.Generator, charts: int) -> TextureDraw:
        """Draw a texture for each of `charts` charts, independent of all that is on them, and one scale for all.

        The scale is log-uniform between `config.scales`: the paper gives kernels in texels, and not what a texel
        measures.
        """
        low, high = self.config.scales
        if not 0 < low <= high:
            raise InputError(f"texture scales: expected 0 < low <= high, found {low} and {high}")
        count, side, _ = self.tiles.shape
        return TextureDraw(
            tile=rng.integers(count, size=charts),
            offset=rng.integers(side, size=(charts, 2), dtype=np.int32),
            transpose=rng.random(charts) < 0.5,
            flip=rng.random((charts, 2)) < 0.5,
            scale=low * (high / low) ** rng.random(),
        )

    def look_up(self, texels: np.ndarray, draw: TextureDraw) -> np.ndarray:
        """The texture at `texels` (..., 3) int16 [chart, row, column], as (...) bool; chart -1 is no surface: False.

        Texel (row, column) of a chart reads `tile[(floor(row * scale) + dr) % S, (floor(column * scale) + dc) % S]`
        of its tile, transposed and flipped. FPV and BEV texels looked up with one draw are the aligned pair
        (I_zero, M_zero) of the paper.
        """
        side = self.tiles.shape[1]
        # a transposed or flipped tile is the same memory with other strides
        stride = np.where(draw.transpose[:, None], [1, side], [side, 1])
        first = draw.tile * side**2 + ((side - 1) * stride * draw.flip).sum(axis=1)
        stride = np.where(draw.flip, -stride, stride)

        chart, *places = np.ascontiguousarray(np.moveaxis(texels, -1, 0))
        chart = chart.astype(np.intp)
        index = first[chart]
        for axis, place in enumerate(places):
            if draw.scale != 1:
                place = place * draw.scale
            place = place.astype(np.int32)
            place += draw.offset[:, axis][chart]
            place -= place // side * side  # numpy's % is slower
            index += place * stride[:, axis][chart]
        return self.tiles.reshape(-1)[index] & (chart >= 0)
