"""For any image file or array, the reader returns a result or raises an `InputError` of one line.

Every mode of Pillow in every format that supports it, with orientation, transparency and frames, truncated and with
bytes replaced; and modalities of every kind, type and shape.
"""

import io
import warnings
from collections import Counter
from collections.abc import Callable
from random import Random

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import zerobev
from zerobev.common.errors import InputError
from zerobev.inference import read_image, read_labels, read_mask
from zerobev.inference.flow import read_flo

MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr", "HSV", "LAB", "I", "I;16", "F")
KINDS = ("PNG", "JPEG", "TIFF", "WEBP", "GIF", "BMP", "PPM", "MPO", "AVIF", "JPEG2000")
SHAPE = (7, 9)


def fuzz(examples: int, make: Callable[[Random], object], parse: Callable[[object], object]) -> Counter[str]:
    """Numbers of inputs that were accepted, and refused in one line."""
    seen: Counter[str] = Counter()

    @settings(max_examples=examples)
    @given(st.integers(0, 2**32 - 1))
    def run(seed: int) -> None:
        rng = Random(seed)
        value = make(rng)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Pillow's warnings about damaged metadata
                parse(value)
            seen["taken"] += 1
        except InputError as error:
            assert str(error) and "\n" not in str(error)
            seen["refused"] += 1

    run()
    return seen


def any_image(rng: Random) -> Image.Image:
    """A small image of any mode, with few or many values."""
    values = np.array([rng.randrange(256) for _ in range(63)]).reshape(SHAPE)
    values = rng.choice((values, values % 3, (values > 99) * 255, values * 0, values // 64 * 64)).astype(np.uint8)
    mode = rng.choice(MODES)
    if mode in ("I", "I;16", "F"):
        return Image.fromarray(values.astype({"I": np.int32, "I;16": np.uint16, "F": np.float32}[mode]))
    if mode == "LAB":
        return Image.merge("LAB", [Image.fromarray(values)] * 3)
    image = Image.fromarray(values)
    if mode in ("LA", "RGBA", "PA"):
        image = image.convert("LA" if mode == "LA" else "RGBA")
        image.putalpha(Image.fromarray(rng.choice((values, values * 0 + 255, np.flip(values, 0)))))
    return image.convert(mode)


def any_file(rng: Random) -> bytes:
    """A file of such an image, possibly damaged."""
    image, stream, exif = any_image(rng), io.BytesIO(), Image.Exif()
    exif[0x0112] = rng.choice((1, 1, 3, 5, 6, 8, 9, 0))
    kind = rng.choice(KINDS)
    options = (
        {"exif": exif} if kind != "AVIF" and rng.random() < 0.5 else {}
    )  # Pillow's AVIF writer crashes on some EXIF data
    if rng.random() < 0.1:
        options |= {"save_all": True, "append_images": [any_image(rng)]}
    if rng.random() < 0.1:
        options |= {"transparency": 0}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image.save(stream, kind, **options)
    except Exception:  # this format has no such mode or option
        stream = io.BytesIO()
        Image.new(rng.choice(("L", "RGB")), (9, 7)).save(stream, "PNG")
    content = bytearray(stream.getvalue())
    damage = rng.randrange(6)
    if damage == 0:
        return bytes(content[: rng.randrange(len(content))])
    if damage < 3:
        for _ in range(rng.randint(1, 4)):
            content[rng.randrange(len(content))] = rng.choice((0, 255, rng.randrange(256)))
    return bytes(content)


@pytest.mark.parametrize(("read", "dtype"), [(read_image, np.uint8), (read_mask, bool), (read_labels, np.int64)])
def test_image_files(read, dtype):
    def parse(content: bytes) -> None:
        array = read(content)
        assert array.dtype == dtype and array.ndim == (3 if read is read_image else 2) and array.size

    seen = fuzz(600, any_file, parse)
    assert min(seen["taken"], seen["refused"]) > 60


def test_flo_files(tmp_path):
    path = tmp_path / "a.flo"
    whole = b"PIEH" + np.array([3, 2], "<i4").tobytes() + np.arange(12, dtype="<f4").tobytes()

    def make(rng: Random) -> bytes:
        content = bytearray(whole[: rng.choice((len(whole), len(whole), rng.randrange(len(whole))))])
        for _ in range(rng.randrange(2) if content else 0):
            content[rng.randrange(len(content))] = rng.randrange(256)
        return bytes(content)

    def parse(content: bytes) -> None:
        path.write_bytes(content)
        assert read_flo(path).shape[2] == 2

    seen = fuzz(400, make, parse)
    assert min(seen["taken"], seen["refused"]) > 50


def any_array(rng: Random) -> object:
    """An array, tensor or list of few values, of a shape that may fit."""
    shape = rng.choice((SHAPE, SHAPE, (2, *SHAPE), (*SHAPE, 2), (*SHAPE, 3), (*SHAPE, 5), (9, 7), (4, 5), (0, 7, 9)))
    levels = rng.choice(([0, 1], [0, 255], [0, 1, 2, 255], [2, 250, 255], [0, 128, 255], [0.2, 0.9], [-1, 3], [np.nan]))
    values = np.array([rng.choice(levels) for _ in range(int(np.prod(shape)))]).reshape(shape)
    dtype = rng.choice((bool, np.uint8, np.int64, np.uint16, np.float32, np.float16))
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        values = values.astype(dtype)
    wrap = rng.choice((np.asarray, np.asarray, torch.from_numpy, np.ndarray.tolist))
    return values if values.dtype == np.uint16 else wrap(values)


def test_modalities():
    rgb = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    projector = zerobev.load("a.2")
    kinds = (zerobev.Masks, zerobev.Labels, zerobev.Probabilities, zerobev.Flow.of, None, None)

    def make(rng: Random) -> tuple:
        return any_array(rng), rng.choice(kinds), rng.choice((None, None, None, ["a", "b", "c"], {0: "a", 1: "b"}))

    def parse(arguments: tuple) -> None:
        array, kind, names = arguments
        result = projector.project(rgb, array if kind is None else kind(array), names=names)
        assert isinstance(result, zerobev.BevArrows) == (kind == zerobev.Flow.of)
        if isinstance(result, zerobev.BevMap):
            assert np.isfinite(result.values).all() and len(result.values) == len(result.labels)

    seen = fuzz(800, make, parse)
    assert min(seen["taken"], seen["refused"]) > 80
