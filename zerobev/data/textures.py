"""Binary textures for the surfaces of a scene: *Synth*, *Mod. Sem.*, and the rectangles of *Depth proj.*

Paper, supplement, "Details on the data generation process". *Synth* tiles are seamless, so one bank of tiles serves
all charts of all scenes: a new draw of tile, offset, orientation and scale per chart is a new texture, and rendering
it is a look-up.
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
#: *Mod. Sem.* textures per scene. A byte could hold eight, but they differ little.
MODSEM_DRAWS = 4
#: Maximum number of sources tried per texture.
MAX_SOURCES = 2000


def kernel_runs(shape: str, size: int) -> np.ndarray:
    """(size,) int: number of texels per row of a kernel (`KERNELS`), centred in the row."""
    if shape == "square":
        return np.full(size, size)
    if shape == "cross":
        return np.where(np.arange(size) == size // 2, size, 1)
    height = np.arange(size) - (size - 1) / 2
    inset = np.round(size / 2 - np.sqrt((size / 2) ** 2 - height**2)).astype(int)
    return size - 2 * inset


def dilate(mask: np.ndarray, runs: np.ndarray, wrap: bool) -> np.ndarray:
    """Binary dilation of `mask` (rows, cols) bool by a kernel given as `kernel_runs`; `wrap`: on the torus.

    The kernel's anchor is its texel `size // 2`. Same result as dilation by the kernel as a footprint in SciPy or
    scikit-image, which takes more than 100 times as long. The mask is one long integer with a bit per texel; a row of
    the kernel is a run, and the union over a run takes the logarithm of its length.
    """
    rows, columns = mask.shape
    size = len(runs)
    margins = (size - 1) // 2, size // 2
    padded = np.pad(mask, (margins, margins), mode="wrap" if wrap else "constant")
    packed = np.packbits(padded, bitorder="little")
    bits = int.from_bytes(packed.tobytes(), "little")
    dilated, length = 0, 1
    for run in np.unique(runs).tolist():
        while length < run:  # bit i is the union of the `length` texels from i on
            step = min(length, run - length)
            bits |= bits >> step
            length += step
        for top in (size - 1 - np.flatnonzero(runs == run)).tolist():  # a texel is reached from the opposite side
            dilated |= bits >> (top * padded.shape[1] + (size - run + 1) // 2)
    texels = np.unpackbits(np.frombuffer(dilated.to_bytes(len(packed), "little"), np.uint8), bitorder="little")
    return texels[: rows * padded.shape[1]].reshape(rows, -1)[:, :columns].view(bool)


def opening(mask: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """Morphological opening on the torus: the union of all kernels that fit into `mask` (rows, cols) bool."""
    eroded = ~dilate(~mask[::-1, ::-1], runs, wrap=True)[::-1, ::-1]
    return dilate(eroded, runs, wrap=True)


def synth_texture(
    shape: tuple[int, int], config: TextureConfig, sources: SourceImages, rng: np.random.Generator
) -> np.ndarray:
    """One seamless *Synth* texture: (rows, cols) bool with `config.white_fraction` white (paper, supplement, "Synth.").

    Opened structures of random sources are added until `config.opened_fraction` is white. The texture is then dilated
    repeatedly until `config.white_fraction` is white; the last dilation is partial, so the fraction is exact.
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

    A source adds at most the area of four of the largest kernels, so that many sources contribute. Larger connected
    structures, mainly from almost white masks, are left out.
    """
    texture = np.zeros(shape, bool)
    target = config.opened_fraction * texture.size
    for _ in range(MAX_SOURCES):
        missing = target - np.count_nonzero(texture)
        if missing <= 0:
            return texture
        structures = _opened_source(shape, config, sources, rng)
        if not structures.any():
            continue
        labels, _ = ndimage.label(structures)
        area = np.bincount(labels.ravel())
        area[0] = 0
        limit = min(missing + 0.1 * target, 4 * config.kernel_px[1] ** 2)
        fits = rng.permutation(np.flatnonzero((area > 0) & (area <= limit)))
        chosen = np.isin(labels, fits[np.cumsum(area[fits]) <= limit])
        corner = rng.integers(shape)
        rows, columns = ((np.argwhere(chosen) + corner) % shape).T
        texture[rows, columns] = True
    raise InputError(f"texture sources: expected images with structure, found none that fits among {MAX_SOURCES}")


def _opened_source(
    shape: tuple[int, int], config: TextureConfig, sources: SourceImages, rng: np.random.Generator
) -> np.ndarray:
    """A random source, resized to sides of 4 to 16 kernels, thresholded and opened: (h, w) bool, at most `shape`.

    A mask that is mostly white is inverted, because its white part follows the outline of the image.
    """
    sides = config.kernel_px[1] * 2 ** rng.uniform(2, 4, size=2)
    height, width = np.minimum(sides.astype(int), shape)
    image = np.asarray(Image.fromarray(sources.draw(rng)).resize((width, height), Image.Resampling.BILINEAR))
    mask = image > rng.uniform(image.min(), image.max())
    if np.count_nonzero(mask) > mask.size / 2:
        mask = ~mask
    mask[[0, -1]] = mask[:, [0, -1]] = False  # `opening` wraps around: no kernel may fit across the border
    return opening(mask, kernel_runs(*_random_kernel(config.kernel_px, rng)))


def _random_kernel(kernel_px: tuple[int, int], rng: np.random.Generator) -> tuple[str, int]:
    return KERNELS[rng.integers(len(KERNELS))], int(rng.integers(kernel_px[0], kernel_px[1] + 1))


def _dilated_until(
    mask: np.ndarray, white: int, kernel_px: tuple[int, int], rng: np.random.Generator, wrap: bool
) -> np.ndarray:
    """Dilate `mask` (not empty) by random kernels until exactly `white` texels are set (or more were already).

    The last dilation uses the largest size of its kernel that does not exceed `white`. The remaining texels are taken
    from the ring that the next size adds, from a random texel on, row by row.
    """
    while np.count_nonzero(mask) < white:
        shape, size = _random_kernel(kernel_px, rng)
        dilated = dilate(mask, kernel_runs(shape, size), wrap)
        if np.count_nonzero(dilated) <= white:
            mask = dilated
            continue
        sizes, results = [1, size], [mask, dilated]
        while sizes[1] - sizes[0] > 1:
            few, many = map(np.count_nonzero, results)
            guess = int(np.interp(white, (few, many), sizes))  # the white area grows almost linearly with the size
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
    eroded by random kernels until `config.modsem_fraction` of them is left. The paper leaves two points open:
    - The fraction is relative to the texels of instances, not to the chart, so that it does not depend on the unused
      area of the atlas.
    - Instances erode separately: a line one texel wide is black between two that touch, and so is all beyond the
      chart. Without it a densely packed chart is uniformly white, without a trace of its objects.
    Kernels are in texels: if the density of an atlas varies, as in scans, coarse parts lose wider margins in metres.
    Draws differ in the margins only; some are equal.
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
    """The textures of the C charts of a scene: one draw is one modality definition (paper, property P3)."""

    tile: np.ndarray  #: (C,) int64, index into the bank
    offset: np.ndarray  #: (C, 2) int32, rows and columns added to a texel's coordinates
    transpose: np.ndarray  #: (C,) bool: swap the tile's axes, before the flips
    flip: np.ndarray  #: (C, 2) bool: reverse the tile's rows, columns
    scale: float  #: structures are this many times smaller; larger if below 1


@dataclass(frozen=True)
class TextureBank:
    """Seamless *Synth* tiles of one configuration; a `TextureDraw` maps them onto charts."""

    tiles: np.ndarray  #: (N, S, S) bool
    config: TextureConfig

    @classmethod
    def build(cls, config: TextureConfig, sources: SourceImages, rng: np.random.Generator) -> "TextureBank":
        """Generate `config.tiles` tiles of side `config.tile_px`."""
        shape = (config.tile_px, config.tile_px)
        streams = progress(rng.spawn(config.tiles), "textures", "tile", config.tiles)
        return cls(np.stack([synth_texture(shape, config, sources, stream) for stream in streams]), config)

    def save(self, path: Path) -> None:
        """Write the bank as one `.npz` file, with a bit per texel."""
        with replacing(path) as temporary:
            np.savez_compressed(
                temporary, bits=np.packbits(self.tiles), shape=self.tiles.shape, config=json.dumps(asdict(self.config))
            )

    @classmethod
    def load(cls, path: Path) -> "TextureBank":
        """Read a file of `save`; a missing file or one of another kind is an `InputError`."""
        try:
            with np.load(path) as file:
                shape = tuple(file["shape"])
                tiles = np.unpackbits(file["bits"], count=int(np.prod(shape))).reshape(shape).view(bool)
                config = json.loads(str(file["config"]))
            pairs = {name: tuple(value) for name, value in config.items() if isinstance(value, list)}
            return cls(tiles, TextureConfig(**config | pairs))
        except Exception as error:  # NumPy, zipfile and zlib raise many kinds of error for a damaged file
            raise InputError(f"{path}: expected a texture bank, found {error}") from error

    def draw(self, rng: np.random.Generator, charts: int) -> TextureDraw:
        """Draw a texture per chart, independent of the chart's content, and one scale for all.

        The scale is log-uniform between `config.scales`: the paper gives kernels in texels without a texel's size.
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
        """The texture at `texels` (..., 3) int16 [chart, row, column], as (...) bool; False for chart -1, no surface.

        The value of texel (row, column) is `tile[(floor(row * scale) + dr) % S, (floor(column * scale) + dc) % S]`,
        with the chart's tile transposed and flipped. FPV and BEV texels looked up with one draw are the aligned pair
        (I_zero, M_zero) of the paper.
        """
        side = self.tiles.shape[1]
        # transposing or flipping a tile only changes its strides
        stride = np.where(draw.transpose[:, None], [1, side], [side, 1])
        first = draw.tile * side**2 + ((side - 1) * stride * draw.flip).sum(axis=1)
        stride = np.where(draw.flip, -stride, stride)

        chart, *coordinates = np.ascontiguousarray(np.moveaxis(texels, -1, 0))
        chart = chart.astype(np.intp)
        index = first[chart]
        for axis, position in enumerate(coordinates):
            if draw.scale != 1:
                position = position * draw.scale
            position = position.astype(np.int32)
            position += draw.offset[:, axis][chart]
            position -= position // side * side  # numpy's % is slower
            index += position * stride[:, axis][chart]
        return self.tiles.reshape(-1)[index] & (chart >= 0)
