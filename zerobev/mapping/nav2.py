"""Occupancy grids as files of nav2's `map_server`: a YAML file, and an image beside it."""

import json
from pathlib import Path

import numpy as np

from zerobev.common.storage import replacing

#: Grey values of a cell; `map_server` reads a value v as the occupancy (255 - v) / 255.
OCCUPIED, UNKNOWN, FREE = 0, 205, 254
# unknown cells have an occupancy of 0.19608: nav2's default for free cells, 0.25, would make them free
_OCCUPIED_FROM, _FREE_BELOW = 0.65, 0.196


def write_nav2(path: Path, image: np.ndarray, lower_left_m: tuple[float, float], cell_m: float) -> None:
    """Write `path`, which ends in `.yaml`, and its image, a binary PGM of the same name.

    image: (R, C) uint8 of the three grey values, row 0 at the largest y
    lower_left_m: x and y of the lower left corner of the lower left cell, metres
    The YAML file is replaced last, and only if both files are complete.
    """
    picture = path.with_suffix(".pgm")
    settings = {
        "image": picture.name,
        "mode": "trinary",
        "resolution": float(cell_m),
        "origin": [*(round(float(value), 9) for value in lower_left_m), 0.0],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_FROM,
        "free_thresh": _FREE_BELOW,
    }
    with replacing(path) as described, replacing(picture) as drawn:
        drawn.write_bytes(b"P5\n%d %d\n255\n" % image.shape[::-1] + image.astype(np.uint8).tobytes())
        # values in JSON are valid YAML
        described.write_text("".join(f"{name}: {json.dumps(value)}\n" for name, value in settings.items()))
