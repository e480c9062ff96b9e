"""An image of any size and field of view -> the pinhole camera of a network.

Both cameras are level with the principal point in the middle, so one image is a scaled and cropped or padded version
of the other: per axis, each pixel of the network's image covers an interval of the photograph. Areas are exact, unlike
in libraries, which do not resize fractional boxes beyond the image.
"""

import math

import numpy as np

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig

_MASK_FRACTION = 0.25  # white pixels have at least this fraction covered by the mask, see `PinholeView.mask`
_MIN_HFOV_DEG = 1e-6  # smaller angles overflow, and cover no pixel in any case


class PinholeView:
    """Resamples images of one size and field of view to `camera`.

    shape: (H, W) of the images, with square pixels
    hfov_deg: their horizontal field of view, in degrees, between the left and the right edge
    In pixels of `camera` outside the images (`covered` is False), masks are empty, and photographs are extended with
    the colours at their border: black bars, unseen in training, would impair the rest of the map.
    Raises `InputError` for an angle outside (0, 180), and if no pixel is covered.
    """

    def __init__(self, shape: tuple[int, int], hfov_deg: float, camera: CameraConfig) -> None:
        angle = float(hfov_deg) if isinstance(hfov_deg, float | int | np.floating | np.integer) else math.nan
        if not 0 < angle < 180:
            raise InputError(f"hfov_deg: expected an angle between 0 and 180 degrees, found {hfov_deg!r}")
        focal_px = 0.5 * shape[1] / math.tan(math.radians(max(angle, _MIN_HFOV_DEG)) / 2)
        self._rows, self._columns = (_fractions(length, focal_px, camera) for length in shape)
        rows, columns = (fractions.sum(axis=1) for fractions in (self._rows, self._columns))
        self.covered = (rows[:, None] >= 0.5) & (columns >= 0.5)  #: (S, S) bool, S = camera.fpv_px
        if not self.covered.any():
            expected = f"a field of view that covers a pixel of the network's {camera.hfov_deg:g} degrees"
            raise InputError(f"hfov_deg: expected {expected}, found {angle:g}")
        self._area = rows[:, None] * columns
        #: side of the view of `camera`, in pixels of the size of the images' pixels
        self.resolution_px = math.ceil(round(camera.fpv_px * focal_px / camera.focal_px, 6))

    def photograph(self, rgb: np.ndarray) -> np.ndarray:
        """(H, W, 3) in [0, 1] -> (S, S, 3) float32: mean colour within each pixel, or the nearest covered pixel."""
        channels = np.moveaxis(rgb, -1, 0).astype(np.float32)
        means = self._rows @ channels @ self._columns.T / np.maximum(self._area, 1e-6)
        row, column = (np.flatnonzero(self.covered.any(axis=axis)) for axis in (1, 0))
        every = np.arange(len(self.covered))
        nearest = np.ix_(np.clip(every, row[0], row[-1]), np.clip(every, column[0], column[-1]))
        return np.moveaxis(means, 0, -1)[nearest].astype(np.float32)

    def mask(self, image: np.ndarray) -> np.ndarray:
        """(H, W) bool -> (S, S) bool: white if the mask covers at least a quarter of a pixel.

        A threshold of 1/2 would preserve areas, but lose thin objects such as the legs of chairs. With "any overlap",
        edges would grow by half a pixel. With 1/4, every line of half a pixel's width is kept, and edges grow by a
        quarter of a pixel. If the mask covers less than 1/4 of every pixel, the pixels with the maximum fraction are
        white. Masks at the network's size and field of view are unchanged.
        """
        fraction = np.where(self.covered, self._rows @ image.astype(np.float32) @ self._columns.T, 0)
        maximum = float(fraction.max())
        if maximum == 0:
            return np.zeros(fraction.shape, bool)
        # 1 - 1e-5: equal fractions differ by rounding
        return fraction >= (_MASK_FRACTION if maximum >= _MASK_FRACTION else maximum * (1 - 1e-5))


def _fractions(length_px: int, focal_px: float, camera: CameraConfig) -> np.ndarray:
    """(S, L) float32: fraction of each of the network's pixels covered by each source pixel, along one axis."""
    scale = focal_px / camera.focal_px
    edge = length_px / 2 + scale * (np.arange(camera.fpv_px + 1) - camera.fpv_px / 2)
    source = np.arange(length_px)
    overlap = np.minimum(edge[1:, None], source + 1) - np.maximum(edge[:-1, None], source)
    # rounded, so that whole fractions are exact in spite of the tangents
    return np.round(overlap.clip(min=0) / scale, 7).astype(np.float32)
