"""Project masks, labels or boxes of an image to a map.

Reads an image and its masks, labels or boxes, or runs a detector on it; writes the image beside its map as PNG, and
values, maps and metric grid as NPZ of the same name.
"""

import argparse
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from zerobev.common.errors import InputError
from zerobev.common.storage import replacing
from zerobev.inference import BevMap, Boxes, HubDetector, load
from zerobev.inference.bev_map import color_of
from zerobev.inference.images import BinaryImages, binary_images
from zerobev.inference.projector import GEOMETRIC
from zerobev.inference.shipped_weights import ROWS

_OPACITY = 0.5


def read_image(path: Path) -> np.ndarray:
    """(H, W, 3) uint8, turned upright as the camera noted; a file that is no image is an `InputError`."""
    return np.asarray(ImageOps.exif_transpose(_open(path)).convert("RGB"))


def read_mask(path: Path) -> np.ndarray:
    """(H, W) bool: pixels of an image file that are not black."""
    return np.any(np.asarray(_open(path).convert("RGB")), axis=-1)


def read_labels(path: Path) -> np.ndarray:
    """(H, W) integers: grey values, or palette indices, of an image file."""
    image = _open(path)
    if image.mode not in ("P", "L", "I", "I;16"):
        raise InputError(f"{path}: expected a label map of one channel, found an image of mode {image.mode}")
    return np.asarray(image).astype(np.int64)


def figure_of(rgb: np.ndarray, images: BinaryImages, bev: BevMap) -> plt.Figure:
    """The photograph under its masks, and the map."""
    shown = rgb / 255
    for k, mask in enumerate(images.images):
        shown = np.where(mask[..., None], (1 - _OPACITY) * shown + _OPACITY * np.array(color_of(k)), shown)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4))
    left.imshow(shown)
    left.set_axis_off()
    bev.show(right)
    figure.tight_layout()
    return figure


def _open(path: Path) -> Image.Image:
    try:
        image = Image.open(path)
        image.load()
    except UnidentifiedImageError:
        raise InputError(f"{path}: expected an image, found another kind of file") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path}: expected an image, found: {error}") from None
    return image


def _modality(options: argparse.Namespace, rgb: np.ndarray) -> tuple[Any, list[str] | None]:
    """What the options name, and names for it."""
    if options.labels:
        return read_labels(options.labels), None
    if options.boxes:
        return Boxes.read_csv(options.boxes), None
    if options.detector:
        return HubDetector.from_pretrained(options.detector).detect(rgb), None
    masks = [read_mask(path) for path in options.masks]
    for path, mask in zip(options.masks, masks):
        if mask.shape != rgb.shape[:2]:
            raise InputError(f"{path}: expected the photograph's size {rgb.shape[:2]}, found {mask.shape}")
    return np.stack(masks), [path.stem for path in options.masks]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev project`."""
    parser.add_argument("image", type=Path, metavar="IMAGE", help="photograph, taken level, 0.88 m above the floor")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--masks", type=Path, nargs="+", metavar="FILE", help="images, black outside the mask")
    what.add_argument("--labels", type=Path, metavar="FILE", help="image of labels: grey values or palette indices")
    what.add_argument("--boxes", type=Path, metavar="FILE", help="CSV: xmin,ymin,xmax,ymax,label and perhaps score")
    what.add_argument("--detector", metavar="NAME", help="object detector of transformers: hub name or folder")
    parser.add_argument("--hfov", type=float, default=79.0, help="horizontal field of view, degrees; default 79")
    parser.add_argument("--row", default=ROWS[-1], help=f"one of {', '.join((GEOMETRIC, *ROWS))}, or a checkpoint")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png", help="an NPZ is written beside it")


def run(options: argparse.Namespace) -> None:
    """Project, write the map, and print where the things on it are."""
    if options.out.suffix.lower() != ".png":
        raise InputError(f"--out: expected a name that ends in .png, found {options.out}")
    plt.switch_backend("agg")  # no window is opened
    rgb = read_image(options.image)
    modality, names = _modality(options, rgb)
    shape = rgb.shape[:2]
    bev = load(options.row).project(rgb, modality, options.hfov, names)
    assert isinstance(bev, BevMap)  # no option names flow
    images = modality.images(shape) if isinstance(modality, Boxes) else binary_images(modality, shape, names)
    with replacing(options.out) as temporary:
        figure_of(rgb, images, bev).savefig(temporary, dpi=120)
    bev.save(options.out.with_suffix(".npz"))
    print(bev.footprints().round(2).to_string(index=False))
