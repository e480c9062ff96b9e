"""Image files of every mode in the reader's table: the same pixels as photograph, mask and label map."""

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from zerobev.common.errors import InputError
from zerobev.inference.masks import Masks
from zerobev.inference.reader import MAX_MEGAPIXELS, read_image, read_labels, read_mask

SHAPE = (24, 40)
MASK = np.zeros(SHAPE, bool)
MASK[3:11, 5:30] = MASK[11:20, 20:25] = True  # asymmetric
LABELS = (np.arange(SHAPE[0] * SHAPE[1]).reshape(SHAPE) // 40 % 12).astype(np.uint8)
GREY = np.tile(np.linspace(0, 255, SHAPE[1]).round().astype(np.uint8), (SHAPE[0], 1))


def encoded(image: Image.Image, kind: str = "PNG", **options) -> bytes:
    stream = io.BytesIO()
    image.save(stream, kind, **options)
    return stream.getvalue()


def refused(read: Callable, source, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(source)


def grey(mask: np.ndarray, dtype: str = "u1") -> Image.Image:
    return Image.fromarray(mask.astype(dtype) * np.iinfo(dtype).max)


def colours(mask: np.ndarray, inside, outside) -> Image.Image:
    return Image.fromarray(np.where(mask[..., None], inside, outside).astype(np.uint8))


def palette(indices: np.ndarray, table: list[int], **info) -> Image.Image:
    image = Image.fromarray(indices.astype(np.uint8), "P")
    image.putpalette(table)
    return image


# --- orientation ---------------------------------------------------------------------------------------------------

STORED = {  # EXIF orientation -> stored pixels of an upright image
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: np.swapaxes(a, 0, 1),
    6: lambda a: np.rot90(a, 1),
    7: lambda a: np.swapaxes(a[::-1, ::-1], 0, 1),
    8: lambda a: np.rot90(a, -1),
}


@pytest.mark.parametrize("orientation", STORED)
@pytest.mark.parametrize("kind", ["PNG", "TIFF", "WEBP"])
def test_photograph_mask_and_labels_are_turned_equally(orientation, kind):
    def file(array: np.ndarray, **options) -> bytes:
        exif = Image.Exif()
        exif[0x0112] = orientation
        return encoded(Image.fromarray(np.ascontiguousarray(STORED[orientation](array))), kind, exif=exif, **options)

    rgb = np.stack([GREY, GREY.T[: SHAPE[0], :1] + 0 * GREY, MASK * np.uint8(200)], axis=-1)
    np.testing.assert_array_equal(read_image(file(rgb, **({"lossless": True} if kind == "WEBP" else {}))), rgb)
    if kind != "WEBP":  # has no image of one channel
        np.testing.assert_array_equal(read_mask(file(MASK.astype(np.uint8) * 255)), MASK)
        np.testing.assert_array_equal(read_labels(file(LABELS)), LABELS)
        np.testing.assert_array_equal(read_labels(file(LABELS.astype(np.uint16) * 300)), LABELS.astype(int) * 300)


# --- sources -------------------------------------------------------------------------------------------------------


def test_every_source_gives_the_same_mask(tmp_path: Path):
    path = tmp_path / "chair.png"
    path.write_bytes(encoded(grey(MASK)))
    for source in (path, str(path), path.read_bytes(), bytearray(path.read_bytes()), io.BytesIO(path.read_bytes())):
        np.testing.assert_array_equal(read_mask(source), MASK)
    with path.open("rb") as file:
        np.testing.assert_array_equal(read_mask(file), MASK)
    np.testing.assert_array_equal(read_mask(Image.open(path)), MASK)
    (images,) = Masks.read(path, path.read_bytes(), names=["a", "b"]).layers(SHAPE)
    assert images.labels == ("a", "b")
    assert Masks.read(path).names == ["chair"]
    Image.new("1", (4, 4)).save(tmp_path / "small.png")
    with pytest.raises(InputError, match=r"small\.png: expected masks of one size"):
        Masks.read(path, tmp_path / "small.png")


@pytest.mark.parametrize("read", [read_image, read_mask, read_labels])
def test_only_single_images_are_read(read, tmp_path):
    frames = [grey(MASK), grey(~MASK)]
    whole = encoded(grey(MASK))
    for kind in ("GIF", "TIFF", "PNG", "WEBP"):
        refused(read, encoded(frames[0], kind, save_all=True, append_images=frames[1:]), "found 2 frames or pages")
    refused(read, tmp_path / "none.png", r"none\.png: expected an image, found no such file")
    refused(read, tmp_path, "expected an image, found a damaged one: .*directory")
    refused(read, b"", "found another kind of file")
    refused(read, whole[: len(whole) // 2], "found a damaged one")
    refused(read, encoded(Image.new("RGB", (4, 4)), "EPS"), "found another kind of file")
    huge = encoded(Image.new("1", (20000, MAX_MEGAPIXELS * 50 + 1)))
    refused(read, huge, f"expected at most {MAX_MEGAPIXELS} megapixels: scale photograph and masks down equally, found")
    refused(read, encoded(Image.new("1", (20000, 20000))), "megapixels")


def test_the_preview_in_a_camera_s_file_is_ignored():
    rgb = colours(MASK, (200, 10, 10), (10, 10, 200))
    mpo = encoded(rgb, "MPO", save_all=True, append_images=[Image.new("RGB", (8, 8))])
    assert read_image(mpo).shape == (*SHAPE, 3)


# --- photographs ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "image",
    [
        Image.fromarray(GREY),
        Image.fromarray(GREY.astype(np.uint16) * 257),
        Image.fromarray(GREY).convert("LA"),
        Image.fromarray(GREY).convert("RGB"),
        Image.fromarray(GREY).convert("RGBA"),
        Image.fromarray(GREY).convert("P"),
    ],
    ids=lambda image: image.mode,
)
def test_a_grey_photograph_is_the_same_in_every_mode(image):
    np.testing.assert_array_equal(read_image(encoded(image)), np.repeat(GREY[..., None], 3, axis=-1))


def test_colours_are_those_of_the_photograph():
    rgb = np.stack([GREY, GREY[:, ::-1], LABELS * 20], axis=-1)
    np.testing.assert_array_equal(read_image(encoded(Image.fromarray(rgb))), rgb)
    cmyk = read_image(encoded(Image.fromarray(rgb).convert("CMYK"), "TIFF"))
    assert np.abs(cmyk.astype(int) - rgb).max() <= 2
    index = palette(LABELS, [v for k in range(256) for v in (k * 3 % 256, k, 9)])
    expected = np.stack([LABELS * 3, LABELS, 0 * LABELS + 9], axis=-1)
    np.testing.assert_array_equal(read_image(encoded(index)), expected)
    np.testing.assert_array_equal(read_image(encoded(grey(MASK).convert("1")))[..., 1], MASK * 255)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (Image.fromarray(GREY.astype(np.float32) / 255), "expected a photograph of 8 bits per channel, found mode F"),
        (Image.fromarray(GREY.astype(np.int32)), "found mode I"),
        (Image.new("LAB", (8, 8)), "found mode LAB"),
    ],
)
def test_photographs_of_unknown_scale_are_refused(image, message):
    refused(read_image, encoded(image, "TIFF"), message)


def test_a_photograph_with_transparent_parts_is_refused():
    image = Image.fromarray(np.dstack([GREY, GREY, GREY, MASK * 255]).astype(np.uint8))
    refused(read_image, encoded(image), f"found transparency in {np.mean(~MASK):.0%} of the pixels: put it on a backgr")


# --- masks ---------------------------------------------------------------------------------------------------------

CUT_OUT = [(90, 90, 90), (0, 0, 0), (255, 255, 255), (200, 30, 60)]


@pytest.mark.parametrize(
    "image",
    [
        grey(MASK),
        grey(MASK, "u2"),
        grey(MASK).convert("1"),
        Image.fromarray(MASK.astype(np.uint8)),
        Image.fromarray(MASK.astype(np.uint8) * 7),
        colours(MASK, (255, 255, 255), (0, 0, 0)),
        colours(MASK, (128, 0, 0), (0, 0, 0)),
        colours(MASK, (255, 255, 255), (0, 0, 0)).convert("RGBA"),
        palette(MASK, [0, 0, 0, 224, 224, 192]),
        palette(MASK * 3, [0, 0, 0, 1, 1, 1, 2, 2, 2, 128, 0, 0]),
        palette(~MASK, [255, 255, 255, 0, 0, 0]),
        grey(MASK).convert("LA"),
        *(
            Image.fromarray(np.dstack([np.where(MASK[..., None], inside, outside), MASK * 255]).astype(np.uint8))
            for inside in CUT_OUT
            for outside in CUT_OUT
        ),
    ],
)
def test_a_mask_is_the_same_in_every_mode(image):
    np.testing.assert_array_equal(read_mask(encoded(image)), MASK)


def test_masks_in_other_files():
    np.testing.assert_array_equal(read_mask(encoded(Image.fromarray(MASK.astype(np.float32)), "TIFF")), MASK)
    np.testing.assert_array_equal(read_mask(encoded(Image.fromarray(MASK.astype(np.int32)), "TIFF")), MASK)
    large = np.hypot(*(np.mgrid[:200, :300] - np.array([90, 130])[:, None, None])) < 60
    for mode in ("L", "RGB"):
        np.testing.assert_array_equal(read_mask(encoded(grey(large).convert(mode), "JPEG", quality=80)), large)
    smooth = read_mask(encoded(grey(large).resize((600, 400), Image.Resampling.BICUBIC)))
    assert np.mean(smooth != np.kron(large, np.ones((2, 2), bool))) < 0.002
    clear = Image.fromarray(MASK.astype(np.uint8) * 9, "L")
    np.testing.assert_array_equal(read_mask(encoded(clear, transparency=0)), MASK)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (Image.fromarray(LABELS), "found 12 grey levels from 0 to 11; is it a label map"),
        (Image.fromarray(np.where(MASK, 255, np.where(LABELS > 9, 128, 0)).astype(np.uint8)), "found 3 grey levels"),
        (Image.fromarray(GREY), "grey levels from 0 to 255"),
        (palette(LABELS % 3, [0, 0, 0, 128, 0, 0, 0, 128, 0]), "expected black and one other colour, found 3 colours"),
        (colours(MASK, (200, 0, 0), (0, 0, 200)), "expected black and one other colour, found 2 colours"),
        (Image.new("RGBA", (8, 8), (255, 255, 255, 0)), "found the same transparency everywhere"),
        (
            Image.fromarray(np.dstack([MASK * 255] * 3 + [(LABELS > 4) * 255]).astype(np.uint8)),
            "found black and white in the visible part, and transparency",
        ),
    ],
)
def test_ambiguous_masks_are_refused(image, message):
    refused(read_mask, encoded(image), f"^mask: .*{message}")


# --- label maps ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "image",
    [
        Image.fromarray(LABELS),
        Image.fromarray(LABELS.astype(np.uint16)),
        palette(LABELS, [k for _ in range(12) for k in (7, 7, 7)]),  # of one colour
    ],
    ids=lambda image: image.mode,
)
@pytest.mark.parametrize("kind", ["PNG", "TIFF"])
def test_labels_are_the_stored_values(image, kind):
    np.testing.assert_array_equal(read_labels(encoded(image, kind)), LABELS)


def test_labels_of_few_bits_are_the_stored_values():
    np.testing.assert_array_equal(read_labels(encoded(palette(LABELS % 4, [0, 0, 0] * 4), bits=2)), LABELS % 4)
    np.testing.assert_array_equal(read_labels(encoded(grey(MASK).convert("1"))), MASK)
    for bits, count in ((2, 4), (4, 12)):  # grey PNG of few bits: Pillow scales it on reading, and cannot write it
        np.testing.assert_array_equal(read_labels(png_of(LABELS % count, bits)), LABELS % count)


def png_of(labels: np.ndarray, bits: int) -> bytes:
    """A grey PNG file of 2 or 4 bits per pixel."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = labels.shape
    spread = ((labels[..., None] >> np.arange(bits)[::-1]) & 1).reshape(height, -1)
    rows = np.pad(np.packbits(spread.astype(np.uint8), axis=1), ((0, 0), (1, 0)))
    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows.tobytes())), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize(
    ("file", "message"),
    [
        (encoded(Image.fromarray(LABELS), "JPEG"), "found lossy compression: use PNG"),
        (encoded(Image.fromarray(LABELS), "TIFF", compression="jpeg"), "found lossy compression"),
        (encoded(Image.fromarray(LABELS).convert("RGB")), "of one channel of integers, found mode RGB"),
        (encoded(Image.fromarray(LABELS).convert("LA")), "found mode LA"),
        (encoded(Image.fromarray(LABELS.astype(np.float32)), "TIFF"), "found mode F"),
        (b"P5 2 2 7\n\x00\x01\x02\x07", "expected a largest value of 255 in its header"),
    ],
)
def test_label_maps_with_changed_values_are_refused(file, message):
    refused(read_labels, file, f"^label map: .*{message}")
