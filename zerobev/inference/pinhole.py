"""An image of any size and field of view -> the pinhole camera that a network was trained for.

Both cameras look straight ahead with their principal point in the middle, so that the one image is a scaled and
cropped or padded version of the other: an axis at a time, each pixel of the network's image covers an interval of the
photograph's. Areas are exact: no library resizes with a fractional box that reaches beyond the image.
"""

import math

import numpy as np

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig

#: A pixel of the network's image is white where a mask covers this share of it, see `PinholeView.mask`.
MASK_SHARE = 0.25
_LEAST_HFOV_DEG = 1e-6  # narrower ones cover no pixel either, and overflow


class PinholeView:
    """Resamples images of one size and field of view to `camera`.

    shape: (H, W) of the images, with square pixels
    hfov_deg: their horizontal field of view, in degrees, between the left and the right edge
    In pixels of `camera` that the images do not cover (`covered` is False) masks are empty, and photographs go on with
    the colours at their border: a bar of black is like nothing in training, and spoils the rest of the map.
    Raises `InputError` for an angle outside (0, 180), and where not a single pixel is covered.
    """

    def __init__(self, shape: tuple[int, int], hfov_deg: float, camera: CameraConfig) -> None:
        angle = float(hfov_deg) if isinstance(hfov_deg, float | int | np.floating | np.integer) else math.nan
        if not 0 < angle < 180:
            raise InputError(f"hfov_deg: expected an angle between 0 and 180 degrees, found {hfov_deg!r}")
        focal_px = 0.5 * shape[1] / math.tan(math.radians(max(angle, _LEAST_HFOV_DEG)) / 2)
        self._rows, self._columns = (_shares(length, focal_px, camera) for length in shape)
        rows, columns = (shares.sum(axis=1) for shares in (self._rows, self._columns))
        self.covered = (rows[:, None] >= 0.5) & (columns >= 0.5)  #: (S, S) bool, S = camera.fpv_px
        if not self.covered.any():
            expected = f"a field of view that covers a pixel of the network's {camera.hfov_deg:g} degrees"
            raise InputError(f"hfov_deg: expected {expected}, found {angle:g}")
        self._area = rows[:, None] * columns
        #: side, in pixels as small as the images', of all that `camera` sees
        self.resolution_px = math.ceil(round(camera.fpv_px * focal_px / camera.focal_px, 6))

    def photograph(self, rgb: np.ndarray) -> np.ndarray:
        """(H, W, 3) in [0, 1] -> (S, S, 3) float32: mean colour of what a pixel, or the nearest covered one, sees."""
        channels = np.moveaxis(rgb, -1, 0).astype(np.float32)
        means = self._rows @ channels @ self._columns.T / np.maximum(self._area, 1e-6)
        row, column = (np.flatnonzero(self.covered.any(axis=axis)) for axis in (1, 0))
        every = np.arange(len(self.covered))
        nearest = np.ix_(np.clip(every, row[0], row[-1]), np.clip(every, column[0], column[-1]))
        return np.moveaxis(means, 0, -1)[nearest].astype(np.float32)

    def mask(self, image: np.ndarray) -> np.ndarray:
        """(H, W) bool -> (S, S) bool: white where the mask covers a quarter of a pixel at least.

        Half would be true to area, and would lose the legs of chairs; any touch at all would keep everything, and
        let edges grow by half a pixel. At a quarter every line of half a pixel's width survives, wherever it lies,
        and edges grow by a quarter of a pixel. A mask that reaches a quarter nowhere keeps the pixels that it covers
        most, so that nothing in view gets lost. An image that is not scaled comes back as it is.
        """
        share = np.where(self.covered, self._rows @ image.astype(np.float32) @ self._columns.T, 0)
        most = float(share.max())
        if most == 0:
            return np.zeros(share.shape, bool)
        return share >= (MASK_SHARE if most >= MASK_SHARE else most * (1 - 1e-5))  # equal shares differ by rounding


def _shares(length_px: int, focal_px: float, camera: CameraConfig) -> np.ndarray:
    """(S, L) float32: the share of each of the network's pixels, along one axis, that each source pixel covers."""
    scale = focal_px / camera.focal_px
    edge = length_px / 2 + scale * (np.arange(camera.fpv_px + 1) - camera.fpv_px / 2)
    source = np.arange(length_px)
    overlap = np.minimum(edge[1:, None], source + 1) - np.maximum(edge[:-1, None], source)
    # float32 after rounding: what is whole stays whole in spite of the tangents
    return np.round(overlap.clip(min=0) / scale, 7).astype(np.float32)
