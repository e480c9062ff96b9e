"""The example of the playground: a view of a generated home that was not in training.

The files of `example/` are made as in the test of this module: an image of the networks' camera, 256 x 256 pixels, the
number of the object at each pixel, and the objects' names by number.
"""

import json
from pathlib import Path

import numpy as np

from zerobev.inference import read_image, read_labels

FOLDER = Path(__file__).with_name("example")


def example() -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Image (256, 256, 3) uint8, numbers of objects (256, 256) int64 from 0 up, and K names."""
    names = json.loads((FOLDER / "names.json").read_text())
    return read_image(FOLDER / "image.jpg"), read_labels(FOLDER / "instances.png"), names
