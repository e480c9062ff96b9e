"""Project masks, labels or boxes of an image to a map.

Reads a photograph and its masks, label map or table of boxes (rules for image files: `zerobev.inference.reader`), or
runs a detector; writes a picture of photograph and map as PNG, and values, maps and metric grid as NPZ of the same
name.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from zerobev.common.errors import InputError, first_line
from zerobev.common.storage import replacing
from zerobev.geometry.cameras import Camera
from zerobev.inference.bev_map import BevMap, colors_of
from zerobev.inference.boxes import Boxes
from zerobev.inference.detector import HubDetector
from zerobev.inference.labels import IGNORE, Labels
from zerobev.inference.masks import Masks
from zerobev.inference.modality import BinaryImages, Modality
from zerobev.inference.pretrained import shipped_names
from zerobev.inference.projector import load
from zerobev.inference.reader import read_image, read_labels
from zerobev.inference.shipped_weights import ROWS

_OPACITY = 0.5


def figure_of(rgb: np.ndarray, images: BinaryImages, bev: BevMap) -> plt.Figure:
    """The photograph with its masks on top, and the map."""
    shown = rgb / 255
    for mask, color in zip(images.images, colors_of(bev.labels)):
        shown = np.where(mask[..., None], (1 - _OPACITY) * shown + _OPACITY * np.array(color), shown)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4))
    left.imshow(shown)
    left.set_axis_off()
    bev.show(right)
    figure.tight_layout()
    return figure


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `zerobev project`."""
    parser.add_argument("image", type=Path, metavar="IMAGE", help="photograph")
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument("--masks", type=Path, nargs="+", metavar="FILE", help="images that are black outside the mask")
    kind.add_argument("--labels", type=Path, metavar="FILE", help="image of labels: grey values or palette indices")
    kind.add_argument("--boxes", type=Path, metavar="FILE", help="CSV: xmin,ymin,xmax,ymax,label and optionally score")
    kind.add_argument("--detector", metavar="NAME", help="object detector of transformers: hub name or folder")
    parser.add_argument("--ignore", metavar="LABEL", help=f"label of pixels without a class, often {IGNORE}; or none")
    lens = parser.add_mutually_exclusive_group()
    lens.add_argument("--hfov", type=float, help="horizontal field of view, degrees; default 79")
    lens.add_argument("--lens", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"), help="calibration, pixels")
    parser.add_argument("--height", type=float, default=0.88, help="of the camera above the floor, metres; default .88")
    parser.add_argument("--pitch", type=float, default=0.0, help="degrees upwards; default 0, a level camera")
    parser.add_argument("--roll", type=float, default=0.0, help="degrees clockwise; default 0, a level camera")
    parser.add_argument("--depth", type=Path, metavar="FILE.npy", help="planar depth of a sensor, metres; 0: no value")
    names = ", ".join(shipped_names())
    parser.add_argument("--row", default=ROWS[-1], help=f"one of {names}; or your checkpoint or folder")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png", help="an NPZ is written beside it")


def run(options: argparse.Namespace) -> None:
    """Project, write the map, print its footprints. Raises `InputError`."""
    if options.out.suffix.lower() != ".png":
        raise InputError(f"--out: expected a name that ends in .png, found {options.out}")
    if options.ignore is not None and not options.labels:
        raise InputError("--ignore: expected beside --labels, found without")
    plt.switch_backend("agg")  # without a window
    rgb = read_image(options.image)
    modality = _modality(options, rgb)
    (images,) = modality.layers(rgb.shape[:2])
    depth = None if options.depth is None else _read_depth(options.depth)
    bev = load(options.row).project(rgb, modality, _camera(options), depth)
    with replacing(options.out) as temporary:
        figure_of(rgb, images, bev).savefig(temporary, dpi=120)
    bev.save(options.out.with_suffix(".npz"))
    print(bev.footprints().round(2).to_string(index=False))


def _camera(options: argparse.Namespace) -> Camera:
    fx, fy, cx, cy = options.lens or (None,) * 4
    return Camera(options.hfov, options.height, options.pitch, options.roll, fx, fy, cx, cy)


def _read_depth(path: Path) -> np.ndarray:
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: expected an array in NumPy's format .npy, found: {first_line(error)}") from None


def _modality(options: argparse.Namespace, rgb: np.ndarray) -> Modality[BevMap]:
    """The modality chosen by the options."""
    if options.labels:
        return _labels(options.labels, options.ignore)
    if options.boxes:
        return Boxes.read_csv(options.boxes)
    if options.detector:
        return HubDetector.from_pretrained(options.detector).detect(rgb)
    masks = Masks.read(*options.masks)
    if (size := masks.values.shape[1:]) != rgb.shape[:2]:
        raise InputError(f"{options.masks[0]}: expected the photograph's size {rgb.shape[:2]}, found {size}")
    return masks


def _labels(path: Path, ignore: str | None) -> Labels:
    labels = read_labels(path)
    if ignore is None and labels.max() == IGNORE:
        choice = f"--ignore {IGNORE} if it means no label, --ignore none if it is a label"
        raise InputError(f"{path}: expected a choice for label {IGNORE}, found none: {choice}")
    try:
        return Labels(labels, ignore=None if ignore in (None, "none") else int(ignore))
    except ValueError:
        raise InputError(f"--ignore: expected a label or none, found {ignore!r}") from None
