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

from zerobev.config import TextureConfig
from zerobev.errors import InputError
from zerobev.progress import progress
from zerobev.storage import replacing
from zerobev.streams.sources import SourceImages

KERNELS = ("ellipse", "square", "cross")
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

    The kernel's anchor is its texel `size // 2`. A row of the kernel is a run, and the union over a run
    takes the logarithm of its length: some fifty times faster than a library's general kernels at 30 px.
    """
    rows, columns = mask.shape
    size = len(runs)
    before, after = (size - 1) // 2, size // 2
    line = np.pad(mask, ((before, after), (before, after)), mode="wrap" if wrap else "constant")
    dilated = np.zeros_like(mask)
    length = 1
    for run in np.unique(runs):
        while length < run:  # line[:, x] is the union of `length` texels from x on
            step = min(length, run - length)
            line = line[:, :-step] | line[:, step:]
            length += step
        left = (size - run + 1) // 2  # a kernel reaches one way, its texels look the other way
        for top in size - 1 - np.flatnonzero(runs == run):
            dilated |= line[top : top + rows, left : left + columns]
    return dilated


def opening(mask: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """Morphological opening on the torus: the union of all kernels that fit into `mask` (rows, cols) bool."""
    eroded = ~dilate(~mask[::-1, ::-1], runs, wrap=True)[::-1, ::-1]
    return dilate(eroded, runs, wrap=True)


def synth_texture(
    shape: tuple[int, int], config: TextureConfig, sources: SourceImages, rng: np.random.Generator
) -> np.ndarray:
    """One seamless *Synth* texture: (rows, cols) bool with `config.share` white (paper, supplement, "Synth.").

    Opened structures of random sources are added until `config.opened_share` is white, then everything is
    dilated, again and again, until `config.share` is; the last dilation is limited, so the share is exact.
    """
    if not 0 < config.opened_share <= config.share < 1:
        raise InputError(
            f"texture shares: expected 0 < opened <= final < 1, found {config.opened_share} and {config.share}"
        )
    texels = shape[0] * shape[1]
    texture = opened_structures(shape, config, sources, rng)
    return _dilated_until(texture, round(config.share * texels), config.kernel_px, rng, wrap=True)


def opened_structures(
    shape: tuple[int, int], config: TextureConfig, sources: SourceImages, rng: np.random.Generator
) -> np.ndarray:
    """The first half of `synth_texture`: (rows, cols) bool, white from `opened_share` to 10 % (relative) above.

    Each source adds no more than four of the largest kernels, so that structures of many sources are spread
    over the texture; connected structures that are too large, of an almost white mask above all, are left out.
    """
    texture = np.zeros(shape, bool)
    wanted = config.opened_share * texture.size
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
    return kernel_runs(KERNELS[rng.integers(len(KERNELS))], rng.integers(kernel_px[0], kernel_px[1] + 1))


def _dilated_until(
    mask: np.ndarray, white: int, kernel_px: tuple[int, int], rng: np.random.Generator, wrap: bool
) -> np.ndarray:
    """Dilate `mask` (not empty) by random kernels until exactly `white` texels are set (or more were already).

    The dilation that would overshoot uses the largest size of its kernel that does not; what is then
    missing is part of a ring one texel wide: the part in the rows below a random one.
    """
    while np.count_nonzero(mask) < white:
        shape = KERNELS[rng.integers(len(KERNELS))]
        size = rng.integers(kernel_px[0], kernel_px[1] + 1)
        dilated = dilate(mask, kernel_runs(shape, size), wrap)
        if np.count_nonzero(dilated) <= white:
            mask = dilated
            continue
        fits, exceeds = 1, size
        below, above = mask, dilated
        while exceeds - fits > 1:
            middle = (fits + exceeds) // 2
            dilated = dilate(mask, kernel_runs(shape, middle), wrap)
            if np.count_nonzero(dilated) <= white:
                fits, below = middle, dilated
            else:
                exceeds, above = middle, dilated
        ring = np.flatnonzero(above & ~below)
        start = np.searchsorted(ring, rng.integers(mask.size))
        mask = below.copy()
        mask.flat[np.roll(ring, -start)[: white - np.count_nonzero(below)]] = True
    return mask


def modsem_texture(instance_image: np.ndarray, config: TextureConfig, rng: np.random.Generator) -> np.ndarray:
    """The *Mod. Sem.* texture of a chart: (rows, cols) bool (paper, supplement, "Mod. Sem.").

    `instance_image` (rows, cols) uint16 holds instance ids. All texels of an instance are white, then eroded
    by random kernels until `config.share` of the chart is left (all, if there was less). Beyond the chart is
    black: a chart that is covered edge to edge erodes from its edges.
    """
    ground = np.pad(instance_image == 0, 1, constant_values=True)
    black = ground.size - round(config.share * instance_image.size)
    return ~_dilated_until(ground, black, config.kernel_px, rng, wrap=False)[1:-1, 1:-1]


def random_rectangles(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """The FPV image of *Depth proj.*: (rows, cols) bool, 10 to 20 white rectangles on black (paper, supplement)."""
    image = np.zeros(shape, bool)
    for _ in range(rng.integers(10, 21)):
        height, width = (rng.integers(1, max(2, side // 3 + 1)) for side in shape)
        row, column = (rng.integers(side - length + 1) for side, length in zip(shape, (height, width)))
        image[row : row + height, column : column + width] = True
    return image


@dataclass(frozen=True)
class TextureDraw:
    """Which texture each of C charts of a home wears: one draw is one modality definition (paper, property P3)."""

    tile: np.ndarray  #: (C,) int64, index into the bank
    offset: np.ndarray  #: (C, 2) int32, rows and columns added to a texel's coordinates
    transpose: np.ndarray  #: (C,) bool: swap the tile's axes, before the flips
    flip: np.ndarray  #: (C, 2) bool: reverse the tile's rows, columns
    scale: float  #: >= 1: structures are that many times smaller


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
        config["kernel_px"] = tuple(config["kernel_px"])
        return cls(tiles, TextureConfig(**config))

    def draw(self, rng: np.random.Generator, charts: int, scale: float = 1.0) -> TextureDraw:
        """Draw a texture for each of `charts` charts, independent of all that is on them."""
        if scale < 1:
            raise InputError(f"texel scale: expected at least 1, found {scale}")
        count, side, _ = self.tiles.shape
        return TextureDraw(
            tile=rng.integers(count, size=charts),
            offset=rng.integers(side, size=(charts, 2), dtype=np.int32),
            transpose=rng.random(charts) < 0.5,
            flip=rng.random((charts, 2)) < 0.5,
            scale=scale,
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

        chart = texels[..., 0].astype(np.intp)
        index = first[chart]
        for axis in (0, 1):
            place = (texels[..., 1 + axis] * draw.scale).astype(np.int32) + draw.offset[:, axis][chart]
            place -= place // side * side  # numpy's % is slower
            index += place * stride[:, axis][chart]
        return self.tiles.reshape(-1)[index] & (chart >= 0)
