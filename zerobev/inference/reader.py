"""Image files -> arrays: one reader for photographs, masks and label maps.

A source is a path, the bytes of a file, an open binary file, or a PIL image. Photographs, masks and label maps are
turned upright by the EXIF orientation of their file. A file without one is upright.

| image | photograph | mask | label map |
|---|---|---|---|
| 1-bit (`1`) | black and white | white | 0 and 1 |
| 8-bit grey (`L`) | grey | white, see below | the stored value |
| 16-bit grey (`I;16`) | grey, 65535 is white | white, see below | the stored value |
| palette (`P`) | its colours | as RGB | the index, whatever its colour |
| RGB, CMYK, YCbCr, HSV | its colours | white; or all that is not black, if one other colour is left | refused |
| `LA`, `RGBA`, `PA`, transparent colour | only if opaque | the opaque part; as without, if all is opaque | refused |
| 32-bit integers (`I`) | refused | white, see below | the stored value |
| floating point (`F`) | refused | 1, if the rest is 0 | refused |
| another mode (`LAB`) | refused | refused | refused |
| JPEG, JPEG 2000 | as its mode | as its mode | refused: compression changes labels |
| several frames, pages | refused | refused | refused |

White, in a grey mask: 0 and one other value are black and white. With more values, those from half of the type's
maximum are white, if nearly all are close to black or to white, as after JPEG compression and on smooth edges. Other
grey levels are refused: they are a label map, or a mask that needs a threshold of your choice.

Files: PNG, JPEG, TIFF, WebP, BMP, GIF, PPM, JPEG 2000, AVIF, up to `MAX_MEGAPIXELS`. Colour profiles are not applied.
"""

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from zerobev.common.errors import InputError

#: Larger images are refused: a photograph takes 16 bytes per pixel in memory.
MAX_MEGAPIXELS = 120

Source = str | Path | bytes | bytearray | memoryview | BinaryIO | Image.Image

_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF", "PPM", "JPEG2000", "AVIF")
_GREY_16 = ("I;16", "I;16B", "I;16L", "I;16N")
_GREY = ("1", "L", "I", "F", *_GREY_16)
_COLOURS = ("P", "RGB", "RGBX", "CMYK", "YCbCr", "HSV")
_WITH_ALPHA = ("LA", "La", "PA", "RGBA", "RGBa")
#: Pillow spreads grey values of 2 and 4 bits over 0 to 255.
_SPREAD = {"L;2": 85, "L;4": 17}
_MAX_CHROMA = 32  # difference of the channels of a grey pixel, after JPEG
_MAX_GREYS = 0.1  # fraction of the pixels of a mask that may be neither black nor white
_MAX_LEVEL = 0.01  # likewise, of any one grey level


def is_source(value: object) -> bool:
    """Whether a value is an image file or a PIL image."""
    return isinstance(value, str | Path | bytes | bytearray | memoryview | Image.Image) or hasattr(value, "read")


def read_image(source: Source) -> np.ndarray:
    """A photograph, (H, W, 3) uint8, upright. Raises `InputError` as in the table."""
    opened = _open(source, "photograph")
    image = opened.image
    if image.mode in _GREY_16:
        grey = np.round(np.asarray(image) / 257).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1)
    if image.mode not in ("1", "L", *_COLOURS, *_WITH_ALPHA):
        raise InputError(f"{opened.name}: expected a photograph of 8 bits per channel, found mode {image.mode}")
    if (alpha := _alpha(image)) is not None:
        found = f"transparency in {np.mean(alpha < 255):.0%} of the pixels"
        raise InputError(f"{opened.name}: expected an opaque photograph, found {found}: put it on a background")
    return np.asarray(image.convert("RGB"))


def read_mask(source: Source) -> np.ndarray:
    """A mask, (H, W) bool, upright. Raises `InputError` as in the table."""
    opened = _open(source, "mask")
    alpha = _alpha(opened.image)
    if alpha is None:
        return _white(opened)
    if alpha.min() == alpha.max():
        raise InputError(f"{opened.name}: expected a mask, found the same transparency everywhere: remove it")
    visible = black_and_white(alpha, f"{opened.name}, transparency")
    try:
        white = _white(opened)[visible]
    except InputError:  # a cut-out in the colours of the object
        return visible
    if white.any() and not white.all():
        found = "black and white in the visible part, and transparency"
        raise InputError(f"{opened.name}: expected one mask, found {found}: remove one of them")
    return visible


def read_labels(source: Source) -> np.ndarray:
    """A label map, (H, W) int64, upright. Raises `InputError` as in the table."""
    opened = _open(source, "label map")
    mode = opened.image.mode
    if opened.is_lossy:
        raise InputError(f"{opened.name}: expected labels as they were stored, found lossy compression: use PNG")
    if mode not in ("1", "L", "P", "I", *_GREY_16):
        raise InputError(f"{opened.name}: expected a label map of one channel of integers, found mode {mode}")
    if opened.is_rescaled:
        raise InputError(f"{opened.name}: expected a largest value of 255 in its header, found another: use PNG")
    return np.asarray(opened.image).astype(np.int64) // opened.spread


def black_and_white(values: np.ndarray, name: str) -> np.ndarray:
    """Grey values of a mask -> (..., ) bool, by the rule under the table of this module.

    values: bool, integers or floating point; the type's maximum is 255, or 65535 if there are larger values
    Raises `InputError` for other grey levels, negative values and NaN.
    """
    if values.dtype.kind == "b":
        return values
    levels, counts = np.unique(values, return_counts=True)
    found = f"{len(levels)} grey levels from {levels[0]:g} to {levels[-1]:g}"
    if np.isfinite(levels).all() and levels[0] >= 0:
        if levels[0] == 0 and len(levels) <= 2:
            return values > 0
        if len(levels) == 1 and levels[0] in ((1,) if values.dtype.kind == "f" else (1, 255, 65535)):
            return values > 0
        white = 255 if levels[-1] <= 255 else 65535
        greys = counts[(levels > white / 8) & (levels < white * 7 / 8)] / values.size
        clear = greys.sum() <= _MAX_GREYS and greys.max(initial=0) <= _MAX_LEVEL
        if values.dtype.kind != "f" and white * 7 / 8 <= levels[-1] <= white and clear:
            return values > white // 2
    raise InputError(f"{name}: expected a mask of 0 and 1, or of black and white, found {found}; is it a label map?")


@dataclass(frozen=True)
class _Opened:
    image: Image.Image  #: loaded and upright
    name: str  #: for messages
    is_lossy: bool
    is_rescaled: bool  #: Pillow has rescaled the values of the file, irreversibly
    spread: int  #: factor of Pillow on the grey values of the file


def _open(source: Source, kind: str) -> _Opened:
    name = str(source) if isinstance(source, str | Path) else kind
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the limit is checked below
            image = source if isinstance(source, Image.Image) else Image.open(_file(source), formats=_FORMATS)
        _check_size(image, name)
        codec, rawmode = _stored_as(image)
        frames = getattr(image, "n_frames", 1)
        image.load()
        upright = ImageOps.exif_transpose(image)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{name}: expected an image, found no such file") from None
    except UnidentifiedImageError:
        formats = "PNG, JPEG, TIFF, WebP, BMP, GIF, PPM, JPEG 2000 or AVIF"
        raise InputError(f"{name}: expected an image in {formats}, found another kind of file") from None
    except Image.DecompressionBombError:
        raise InputError(f"{name}: {_TOO_LARGE}, found more") from None
    except Exception as error:  # each decoder fails in its own way on a damaged file
        found = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{name}: expected an image, found a damaged one: {found}") from None
    if frames > 1 and image.format != "MPO":  # the second image of a camera's MPO is a preview or a depth map
        raise InputError(f"{name}: expected one image, found {frames} frames or pages: save one of them")
    compression = str(image.info.get("compression", ""))
    is_lossy = image.format in ("JPEG", "MPO", "JPEG2000") or compression in ("jpeg", "tiff_jpeg", "webp")
    is_rescaled = image.format == "PPM" and codec in ("ppm", "ppm_plain")
    return _Opened(upright, name, is_lossy, is_rescaled, _SPREAD.get(rawmode, 1))


def _stored_as(image: Image.Image) -> tuple[str, str]:
    """Pillow's names of the codec and of the pixel format of a file, before it is loaded; empty without a file."""
    tiles = getattr(image, "tile", None)
    if not tiles:
        return "", ""
    codec, arguments = tiles[0][0], tiles[0][3]
    return codec, str(arguments[0] if isinstance(arguments, tuple) else arguments)


def _file(source: str | Path | bytes | bytearray | memoryview | BinaryIO) -> Path | BinaryIO:
    if isinstance(source, bytes | bytearray | memoryview):
        return io.BytesIO(source)
    return Path(source) if isinstance(source, str | Path) else source


_TOO_LARGE = f"expected at most {MAX_MEGAPIXELS} megapixels: scale photograph and masks down equally"


def _check_size(image: Image.Image, name: str) -> None:
    width, height = image.size
    if width * height > MAX_MEGAPIXELS * 1_000_000:
        raise InputError(f"{name}: {_TOO_LARGE}, found {width * height / 1e6:.0f}")
    if not width * height:
        raise InputError(f"{name}: expected an image, found {width} x {height} pixels")


def _alpha(image: Image.Image) -> np.ndarray | None:
    """(H, W) uint8, 255 is opaque; None if the image is opaque."""
    if image.mode not in ("1", "L", "P", "RGB", *_WITH_ALPHA) or not image.has_transparency_data:
        return None
    if image.mode == "La":
        image = image.convert("LA")
    alpha = np.asarray(image.convert("RGBA").getchannel("A"))
    return None if (alpha == 255).all() else alpha


def _white(opened: _Opened) -> np.ndarray:
    """(H, W) bool: the mask from its grey values or colours."""
    image = opened.image
    if image.mode in _GREY:
        return black_and_white(np.asarray(image), opened.name)
    if image.mode not in (*_COLOURS, *_WITH_ALPHA):
        raise InputError(f"{opened.name}: expected a mask in grey or in colours, found mode {image.mode}")
    rgb = np.asarray(image.convert("RGB"))
    code = rgb.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    colours = np.unique(code)
    if colours[0] == 0 and len(colours) <= 2:
        return code > 0
    if np.ptp(rgb, axis=-1).max() > _MAX_CHROMA:
        raise InputError(f"{opened.name}: expected black and one other colour, found {len(colours)} colours")
    return black_and_white(rgb.max(axis=-1), opened.name)
