"""Textures: the paper's *Synth* process, the bank and its look-up, the two variants, and the source images."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy import ndimage
from scipy.spatial.distance import cdist
from scipy.stats import kstest
from skimage.feature import local_binary_pattern

from zerobev.common.errors import InputError
from zerobev.config import TextureConfig
from zerobev.data.patterns import KINDS, PHOTOGRAPHS, SourceImages, photograph, procedural
from zerobev.data.textures import (
    KERNELS,
    TextureBank,
    TextureDraw,
    dilate,
    kernel_runs,
    modsem_textures,
    opened_structures,
    opening,
    random_rectangles,
    synth_texture,
)

SMALL = TextureConfig(tile_px=256, tiles=4)
FRACTIONS = (0.10, 0.15, 0.20, 0.25, 0.30)  # the paper's sensitivity analysis
SOURCES = SourceImages(size=64)
seeds = st.integers(0, 2**32 - 1)


def footprint(runs: np.ndarray) -> np.ndarray:
    """The kernel as a (size, size) bool image."""
    column = np.arange(len(runs))
    start = (len(runs) - runs) // 2
    return (column >= start[:, None]) & (column < (start + runs)[:, None])


@pytest.fixture(scope="module")
def bank() -> TextureBank:
    return TextureBank.build(SMALL, SOURCES, np.random.default_rng(0))


# --- morphology


@given(st.sampled_from(KERNELS), st.integers(1, 9), st.booleans(), seeds)
@settings(max_examples=40, deadline=None)
def test_dilation_and_opening_agree_with_scipy(shape, size, wrap, seed):
    mask = np.random.default_rng(seed).random((23, 31)) < 0.03
    kernel = footprint(kernel_runs(shape, size))
    mode = {"mode": "wrap"} if wrap else {"mode": "constant", "cval": 0}
    expected = ndimage.grey_dilation(mask.astype(np.uint8), footprint=kernel, **mode) > 0
    assert np.array_equal(dilate(mask, kernel_runs(shape, size), wrap), expected)
    dense = ~(mask & (np.arange(31) > 12))  # with room for the largest kernel
    expected = ndimage.binary_opening(np.tile(dense, (3, 3)), kernel)[23:46, 31:62]
    assert np.array_equal(opening(dense, kernel_runs(shape, size)), expected)


@given(st.sampled_from(KERNELS), st.integers(1, 150), st.sampled_from([63, 64, 65, 200]), seeds)
@settings(max_examples=20, deadline=None)
def test_dilation_by_kernels_wider_than_a_machine_word(shape, size, columns, seed):
    mask = np.random.default_rng(seed).random((150, columns)) < 0.0005
    runs = kernel_runs(shape, size)
    spread = np.zeros((150 + size, columns + size), bool)
    for row, column in np.argwhere(mask):
        spread[row : row + size, column : column + size] |= footprint(runs)
    corner = size // 2
    assert np.array_equal(dilate(mask, runs, False), spread[corner : corner + 150, corner : corner + columns])


def test_kernels_have_their_shape():
    for size in range(10, 31):
        kernel = {shape: footprint(kernel_runs(shape, size)) for shape in KERNELS}
        assert kernel["square"].all() and kernel["cross"].sum() == 2 * size - 1
        assert abs(kernel["ellipse"].sum() / (np.pi / 4 * size**2) - 1) < 0.04
        assert np.array_equal(kernel["ellipse"], kernel["ellipse"][::-1, ::-1])


# --- Synth


@given(seeds)
@settings(max_examples=8, deadline=None)
def test_fraction_is_reached_and_structures_only_grow(seed):
    opened = opened_structures((256, 256), SMALL, SOURCES, np.random.default_rng(seed))
    assert SMALL.opened_fraction <= opened.mean() <= 1.1 * SMALL.opened_fraction
    for fraction in FRACTIONS:
        config = replace(SMALL, white_fraction=fraction)
        texture = synth_texture((256, 256), config, SOURCES, np.random.default_rng(seed))
        assert abs(texture.mean() - fraction) < 0.0001
        assert texture[opened].all()
    barely = synth_texture((256, 256), replace(SMALL, white_fraction=0.06), SOURCES, np.random.default_rng(seed))
    assert not barely[~dilate(opened, kernel_runs("square", 31), wrap=True)].any()  # one partial dilation


def test_structures_are_everywhere():
    textures = [synth_texture((256, 256), SMALL, SOURCES, np.random.default_rng(seed)) for seed in range(12)]
    quadrants = np.mean(textures, axis=0).reshape(2, 128, 2, 128).mean(axis=(1, 3))
    assert quadrants.min() > 0.13 and quadrants.max() < 0.27


def test_structures_are_blobs_not_salt_and_pepper():
    noise = np.random.default_rng(0).random((512, 512)) < 0.2
    lost, width = [], []
    for seed in range(4):
        texture = synth_texture((512, 512), SMALL, SOURCES, np.random.default_rng(seed))
        remaining = opening(texture, kernel_runs("square", 7))
        lost.append(1 - remaining.sum() / texture.sum())
        width.append(4 * texture.sum() / edges(texture).sum())
        background = ~texture
        assert opening(background, kernel_runs("square", 3)).sum() > 0.99 * background.sum()
    assert np.mean(lost) < 0.03
    assert 15 < np.mean(width) < 120  # side of squares with as many edges: of the order of kernels
    assert opening(noise, kernel_runs("square", 3)).sum() < 0.01 * noise.sum()


def edges(texture: np.ndarray) -> np.ndarray:
    """(rows,) number of changes of colour from each row to the next and from each texel to its right, on the torus."""
    return ((texture != np.roll(texture, -1, 0)) | (texture != np.roll(texture, -1, 1))).sum(axis=1)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_tile_has_no_seam(axis):
    changes = 0
    for seed in range(12):
        texture = synth_texture((256, 256), SMALL, SOURCES, np.random.default_rng(seed))
        changes = changes + (texture != np.roll(texture, 1, axis)).sum(axis=1 - axis)
    assert changes[0] < 4 * changes.mean()  # a seam would have about 30 times the mean
    other = (texture != np.roll(texture, 128, axis)).sum(axis=1 - axis)
    assert other.mean() > 3 * changes.mean() / 12


def test_sources_without_usable_structure():
    class Poor(SourceImages):
        """Mostly blank, or white except for a margin; rarely a small square."""

        def draw(self, rng):
            image = np.full((50, 50), float(rng.integers(2)), np.float32)
            image[:, :2] = 0
            if rng.random() < 0.3:
                image[10:18, 10:18] = 1 - image[10, 10]
            return image

    rng = np.random.default_rng(0)
    assert 0.05 <= opened_structures((256, 256), SMALL, Poor(), rng).mean() <= 1.1 * SMALL.opened_fraction

    class Blank(SourceImages):
        def draw(self, rng):
            return np.full((8, 8), 0.5, np.float32)

    with pytest.raises(InputError, match="texture sources"):
        synth_texture((64, 64), SMALL, Blank(), rng)


def test_fractions_must_be_ordered():
    with pytest.raises(InputError, match=r"found 0.05 and 0.01"):
        synth_texture((64, 64), replace(SMALL, white_fraction=0.01), SOURCES, np.random.default_rng(0))


# --- the bank


def test_same_seed_same_tiles_and_no_two_tiles_alike(bank):
    again = TextureBank.build(SMALL, SOURCES, np.random.default_rng(0))
    assert np.array_equal(bank.tiles, again.tiles) and bank.tiles.dtype == bool
    assert bank.tiles.shape == (4, 256, 256)
    other = TextureBank.build(replace(SMALL, tiles=1), SOURCES, np.random.default_rng(1))
    for i in range(3):
        for tile in (*bank.tiles[i + 1 :], other.tiles[0]):
            assert 0.05 < np.mean(bank.tiles[i] != tile) < 0.4


def test_save_and_load(bank, tmp_path):
    bank.save(tmp_path / "bank.npz")
    loaded = TextureBank.load(tmp_path / "bank.npz")
    assert np.array_equal(loaded.tiles, bank.tiles) and loaded.tiles.dtype == bool and loaded.config == SMALL
    assert (tmp_path / "bank.npz").stat().st_size < bank.tiles.size / 8 + 2000
    (tmp_path / "bad.npz").write_bytes(b"not a bank")
    for name in ("bad.npz", "missing.npz"):
        with pytest.raises(InputError, match=name):
            TextureBank.load(tmp_path / name)


def naive(bank: TextureBank, draw: TextureDraw, chart: int, row: int, column: int) -> bool:
    """The look-up by its definition."""
    if chart < 0:
        return False
    tile = bank.tiles[draw.tile[chart]]
    tile = tile.T if draw.transpose[chart] else tile
    tile = tile[::-1] if draw.flip[chart, 0] else tile
    tile = tile[:, ::-1] if draw.flip[chart, 1] else tile
    side = len(tile)
    dr, dc = draw.offset[chart]
    return tile[(int(row * draw.scale) + dr) % side, (int(column * draw.scale) + dc) % side]


@given(seeds, st.sampled_from([1.0, 1.5, 2.0, 3.7]))
@settings(max_examples=15, deadline=None)
def test_look_up_agrees_with_its_definition(bank, seed, scale):
    rng = np.random.default_rng(seed)
    draw = replace(bank.draw(rng, 5), scale=scale)
    texels = np.stack([rng.integers(-1, 5, (9, 31)), *rng.integers(0, 3000, (2, 9, 31))], axis=-1).astype(np.int16)
    values = bank.look_up(texels, draw)
    assert values.shape == (9, 31) and values.dtype == bool
    assert values.tolist() == [[naive(bank, draw, *map(int, texel)) for texel in row] for row in texels]
    assert not values[texels[..., 0] == -1].any()
    with pytest.raises(IndexError):  # a chart without a texture in the draw
        bank.look_up(np.full((2, 2, 3), 5, np.int16), draw)


def test_fpv_and_bev_see_one_texture(bank):
    rng = np.random.default_rng(0)
    draw = bank.draw(rng, 3)
    fpv = np.stack([rng.integers(0, 3, (64, 64)), *rng.integers(0, 2000, (2, 64, 64))], axis=-1).astype(np.int16)
    chosen = rng.integers(0, 64, (2, 40, 40))
    bev = fpv[tuple(chosen)]
    assert np.array_equal(bank.look_up(bev, draw), bank.look_up(fpv, draw)[tuple(chosen)])


def test_every_orientation_and_tile_is_drawn_and_charts_differ(bank):
    draw = bank.draw(np.random.default_rng(0), 400)
    assert set(draw.tile) == {0, 1, 2, 3}
    assert len({(t, *f) for t, f in zip(draw.transpose.tolist(), draw.flip.tolist())}) == 8
    assert 100 < draw.offset.mean() < 156 and draw.offset.min() >= 0 and draw.offset.max() < 256


def scaled(bank: TextureBank, low: float, high: float) -> TextureBank:
    return TextureBank(bank.tiles, replace(bank.config, scales=(low, high)))


def test_scales_are_log_uniform_and_drawn_for_each_texture(bank):
    rng = np.random.default_rng(1)
    scales = [scaled(bank, 1, 5).draw(rng, 1).scale for _ in range(500)]
    assert kstest(np.log(scales) / np.log(5), "uniform").pvalue > 0.05
    assert kstest((np.array(scales) - 1) / 4, "uniform").pvalue < 1e-6  # hence not uniform
    assert {scaled(bank, 2, 2).draw(rng, 1).scale for _ in range(9)} == {2}
    assert {bank.draw(rng, 1).scale for _ in range(9)} == {1}
    for low, high in (0, 2), (3, 2):
        with pytest.raises(InputError, match=f"scales: expected 0 < low <= high, found {low} and {high}"):
            scaled(bank, low, high).draw(rng, 1)


@pytest.mark.parametrize("scale", [0.5, 2, 3.5, 5])
def test_structures_shrink_by_the_scale(bank, scale):
    """Mean length of the white runs along rows, over many charts; the white fraction stays."""
    rows, columns = np.mgrid[:64, :1500]
    runs, shares = [], []
    for low in (1, scale):
        draw = scaled(bank, low, low).draw(np.random.default_rng(5), 30)
        white = np.stack(
            [bank.look_up(np.stack([0 * rows + c, rows, columns], -1).astype(np.int16), draw) for c in range(30)]
        )
        starts = white[..., 1:] & ~white[..., :-1]
        runs.append(white.sum() / starts.sum())
        shares.append(white.mean())
    assert runs[0] / runs[1] == pytest.approx(scale, rel=0.1)
    assert shares[0] == pytest.approx(shares[1], abs=0.03)


def test_textures_are_independent_of_any_fixed_image(bank):
    """Property P3: over draws, all texels are equally often white, independent of the image."""
    rng = np.random.default_rng(3)
    row, column = np.mgrid[:64, :64]
    texels = np.stack([(row // 32) * 2 + column // 32, row, column], axis=-1).astype(np.int16)
    draws = np.array([bank.look_up(texels, bank.draw(rng, 4)) for _ in range(500)])
    image = row / 64 + np.sin(column / 9)
    correlation = [np.corrcoef(image.ravel(), d.ravel())[0, 1] for d in draws if d.any()]
    assert abs(np.mean(correlation)) < 4 * np.std(correlation) / np.sqrt(len(correlation))
    assert np.std(correlation) > 0.05  # single draws correlate by chance, their mean does not
    assert abs(draws.mean() - SMALL.white_fraction) < 0.02 and draws.mean(axis=0).max() < 0.30


# --- Mod. Sem. and Depth proj.


def things(rng: np.random.Generator, gap: int) -> np.ndarray:
    """A chart of rectangles, at least `gap` texels apart, in three rows."""
    instances = np.zeros((240, 300), np.uint16)
    for i, (row, column) in enumerate(np.mgrid[0:240:80, 0:300:75].reshape(2, -1).T):
        width = rng.integers(55, 73) if gap else 75
        instances[row + gap : row + 80 - gap, column + gap : column + gap + width] = i + 1
    return instances


@given(seeds, st.sampled_from(FRACTIONS), st.sampled_from([0, 2]))
@settings(max_examples=10, deadline=None)
def test_modsem_erodes_the_objects_to_the_fraction(seed, fraction, gap):
    rng = np.random.default_rng(seed)
    instances = things(rng, gap)
    textures = modsem_textures(instances, replace(SMALL, modsem_fraction=fraction), rng, draws=3)
    assert textures.dtype == bool and textures.shape == (3, *instances.shape)
    for texture in textures:
        assert not texture[instances == 0].any()
        assert abs(texture[instances > 0].mean() - fraction) < 0.0002  # of the covered texels, not of the chart
        assert opening(texture, kernel_runs("square", 3)).sum() > 0.98 * texture.sum()
        labels, count = ndimage.label(texture, np.ones((3, 3)))  # no two objects touch
        whites = [np.unique(instances[labels == label]) for label in range(1, count + 1)]
        assert all(len(ids) == 1 for ids in whites)


def test_most_modsem_draws_differ():
    rng = np.random.default_rng(0)
    textures = modsem_textures(things(rng, 2), SMALL, rng, draws=8)
    assert len({texture.tobytes() for texture in textures}) >= 6


def test_modsem_of_charts_without_objects_and_full_of_them():
    rng = np.random.default_rng(0)
    for full in modsem_textures(np.ones((100, 200), np.uint16), SMALL, rng):
        assert abs(full.mean() - SMALL.modsem_fraction) < 0.001
        assert full[50, 100] and not full[0].any()  # the middle is left
    few = np.zeros((100, 100), np.uint16)
    few[40:50, 40:50] = 7
    assert np.array_equal(modsem_textures(few, replace(SMALL, modsem_fraction=1.0), rng, draws=1)[0], few > 0)
    assert not modsem_textures(np.zeros((50, 60), np.uint16), SMALL, rng).any()


def test_modsem_lies_between_two_erosions_of_each_object():
    rng = np.random.default_rng(4)
    instances = things(rng, 0)
    config = replace(SMALL, kernel_px=(12, 12), modsem_fraction=0.55)  # one erosion leaves 70 %, two leave 50 %
    objects = [np.pad(instances == i, 1) for i in range(1, 13)]
    once, twice = (
        np.any([ndimage.binary_erosion(one, np.ones((side, side))) for one in objects], axis=0)[1:-1, 1:-1]
        for side in (11, 26)
    )
    for texture in modsem_textures(instances, config, rng):
        assert once[texture].all() and texture[twice].all()
        assert twice.mean() < 0.5 < once.mean()


def test_random_rectangles():
    rng = np.random.default_rng(0)
    images = [random_rectangles((64, 96), rng) for _ in range(60)]
    shares = np.array([image.mean() for image in images])
    assert images[0].shape == (64, 96) and images[0].dtype == bool
    assert 0.1 < shares.mean() < 0.6 and shares.std() > 0.03
    mean = np.mean(images, axis=0)
    assert mean[:4].mean() > 0 and mean[-4:].mean() > 0 and mean[:, :4].mean() > 0 and mean[:, -4:].mean() > 0
    corners = [
        np.sum(ndimage.correlate(image.astype(int), [[-1, 1], [1, -1]], mode="constant") != 0) for image in images
    ]
    assert min(corners) >= 4 and max(corners) <= 20 * 20  # outlines of few axis-parallel rectangles
    single = random_rectangles((1, 1), rng)
    assert single.all()


# --- sources


def descriptor(image: np.ndarray) -> np.ndarray:
    """Visual features: greys, local patterns at three scales, and the spectrum over frequency."""
    parts = [np.histogram(image, 12, (0, 1))[0] / image.size]
    levels = (255 * image).astype(np.uint8)
    for radius in (1, 3, 6):
        patterns = local_binary_pattern(levels, 8, radius, "uniform")
        parts.append(np.histogram(patterns, 10, (0, 10))[0] / image.size)
    power = np.abs(np.fft.fft2(image - image.mean())) ** 2
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(len(image), 1 / len(image))] * 2))
    rings = np.histogram(frequency, [1, 2, 4, 6, 8, 10, 13, 16, 24, 48], weights=power)[0]
    parts.append(rings / power.sum())
    return np.sqrt(np.concatenate(parts))  # for the Hellinger distance


def test_there_are_many_visibly_different_kinds():
    assert len(KINDS) == len(set(KINDS)) >= 40
    examples = []
    for kind in KINDS:
        rng = np.random.default_rng(7)
        images = [procedural(kind, rng, 96) for _ in range(5)]
        for image in images:
            assert image.shape == (96, 96) and image.dtype == np.float32
            assert np.isfinite(image).all() and image.min() == 0 and image.max() == 1 and image.std() > 0.03
        assert not np.array_equal(images[0], images[1])
        examples.append([descriptor(image) for image in images])
    examples = np.array(examples)  # kind, example, feature
    means = examples.mean(axis=1)
    apart = cdist(means, means) + 9 * np.eye(len(KINDS))
    first, second = np.unravel_index(apart.argmin(), apart.shape)
    assert apart.min() > 0.14, f"{KINDS[first]} and {KINDS[second]} look alike"
    # and examples are mostly nearest to others of the same kind
    flat = examples.reshape(-1, examples.shape[-1])
    distance = cdist(flat, flat) + 9 * np.eye(len(flat))
    own = np.arange(len(flat)) // 5
    assert np.mean(own[distance.argmin(axis=1)] == own) > 0.75


def test_photographs_need_no_download():
    for name in PHOTOGRAPHS:
        image = photograph(name)
        assert image.ndim == 2 and image.dtype == np.float32 and 0 <= image.min() < image.max() <= 1


def test_sources_draw_every_kind_and_are_a_function_of_the_seed():
    images = [SOURCES.draw(np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert np.array_equal(images[0], images[1]) and not np.array_equal(images[0], images[2])
    rng = np.random.default_rng(0)
    sizes = [SOURCES.draw(rng).shape for _ in range(200)]
    assert 0 < sum(size != (64, 64) for size in sizes) < 80  # some are photographs


def test_dtd_folder(tmp_path):
    for category, grey in (("banded", 50), ("woven", 200)):
        folder = tmp_path / "images" / category
        folder.mkdir(parents=True)
        Image.new("RGB", (30, 20), (grey, grey, grey)).save(folder / f"{category}_0001.jpg")
    rng = np.random.default_rng(0)
    sources = SourceImages(tmp_path)
    drawn = [sources.draw(rng) for _ in range(20)]
    assert all(image.shape == (20, 30) and image.dtype == np.float32 for image in drawn)
    assert {round(float(image.mean() * 255)) for image in drawn} == {50, 200}

    (tmp_path / "images" / "woven" / "woven_0001.jpg").write_bytes(b"broken")
    with pytest.raises(InputError, match=r"woven_0001\.jpg: expected an image"):
        for _ in range(20):
            sources.draw(rng)
    for folder in (tmp_path / "nowhere", tmp_path / "images"):
        with pytest.raises(InputError, match=f"{folder.name}: expected a folder with images"):
            SourceImages(folder)
