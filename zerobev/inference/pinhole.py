"""An image of any camera -> the level pinhole camera of a network.

Columns: a rotation about the pinhole changes an image by a homography, so a tilted camera is levelled exactly. Rows:
the image is stretched vertically about the horizon by the ratio of the camera heights. The floor is then at the rows
at which the network's camera sees it, and every point keeps its image column and its planar depth, thus its place on
the map; only heights above the floor are scaled.

For a level camera, the photograph is a scaled and cropped or padded version of the network's image: per axis, each
pixel of the network's image covers an interval of the photograph. Areas are exact, unlike in libraries, which do not
resize fractional boxes beyond the image.
"""

import math

import numpy as np

from zerobev.common.errors import InputError
from zerobev.config import CameraConfig
from zerobev.geometry.cameras import Camera

_MASK_FRACTION = 0.25  # white pixels have at least this fraction covered by the mask, see `PinholeView.mask`
_MAX_LEVEL_PX = 2048  # maximum side of a levelled image


class PinholeView:
    """Resamples images of one camera to `network`, a level camera.

    shape: (H, W) of the images
    camera: the images' camera
    In pixels of `network` outside the images (`covered` is False), masks are empty, and photographs are extended with
    the colours at their border: black bars, unseen in training, would impair the rest of the map.
    Raises `InputError` for a camera of another type, and if no pixel is covered.
    """

    def __init__(self, shape: tuple[int, int], camera: Camera, network: CameraConfig) -> None:
        if not isinstance(camera, Camera):
            raise InputError(f"camera: expected a zerobev.Camera, found {camera!r}")
        self._shape, self._camera, self._network = shape, camera, network
        fx, fy, cx, cy = camera.lens(shape)
        fy *= camera.height_m / network.height_m
        #: side of the view of `network`, in pixels of the images
        self.resolution_px = math.ceil(round(network.fpv_px * fx / network.focal_px, 6))
        self._level: tuple[np.ndarray, np.ndarray] | None = None
        if camera.is_level:
            self._rows, self._columns = _fractions(shape[0], fy, cy, network), _fractions(shape[1], fx, cx, network)
            rows, columns = (fractions.sum(axis=1) for fractions in (self._rows, self._columns))
            self.covered = (rows[:, None] >= 0.5) & (columns >= 0.5)  #: (S, S) bool, S = network.fpv_px
            self._area = rows[:, None] * columns
        else:
            sides = [min(math.ceil(network.fpv_px * f / network.focal_px), _MAX_LEVEL_PX) for f in (fy, fx)]
            self._rows, self._columns = (
                _fractions(n, network.focal_px * n / network.fpv_px, n / 2, network) for n in sides
            )
            u, v, _ = self._positions(*sides)
            inside = (u >= 0) & (u < shape[1]) & (v >= 0) & (v < shape[0])
            self._level = _nearest(u, shape[1]), _nearest(v, shape[0])
            self._inside = inside
            self._area = self._rows @ inside.astype(np.float32) @ self._columns.T
            self.covered = self._area >= 0.5
        if not self.covered.any():
            expected = f"a view that covers a pixel of the network's {network.hfov_deg:g} degrees, level"
            raise InputError(f"camera: expected {expected}, found {camera}")

    def photograph(self, rgb: np.ndarray) -> np.ndarray:
        """(H, W, 3) in [0, 1] -> (S, S, 3) float32: mean colour within each pixel, or the nearest covered pixel."""
        if self._level is not None:
            # the nearest pixel of the photograph, also outside of it
            channels = np.moveaxis(rgb[self._level[1], self._level[0]], -1, 0).astype(np.float32)
            return np.moveaxis(self._rows @ channels @ self._columns.T, 0, -1).astype(np.float32)
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
        if self._level is not None:
            image = image[self._level[1], self._level[0]] & self._inside
        fraction = np.where(self.covered, self._rows @ image.astype(np.float32) @ self._columns.T, 0)
        maximum = float(fraction.max())
        if maximum == 0:
            return np.zeros(fraction.shape, bool)
        # 1 - 1e-5: equal fractions differ by rounding
        return fraction >= (_MASK_FRACTION if maximum >= _MASK_FRACTION else maximum * (1 - 1e-5))

    def depth(self, depth: np.ndarray) -> np.ndarray:
        """Planar depth (H, W), metres, of the images' camera -> (S, S) float32 of `network`; 0: no value.

        Each pixel has the value at its centre: means over edges would be points in the air.
        """
        side = self._network.fpv_px
        u, v, forward = self._positions(side, side)
        inside = (u >= 0) & (u < self._shape[1]) & (v >= 0) & (v < self._shape[0])
        values = depth[_nearest(v, self._shape[0]), _nearest(u, self._shape[1])]
        return np.where(inside, values / np.where(inside, forward, 1), 0).astype(np.float32)

    def _positions(self, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Image positions u, v of the view of `network` in rows x columns pixels, and their depth at level depth 1."""
        network = self._network
        half = 0.5 * network.fpv_px / network.focal_px
        across, down = (half * ((2 * np.arange(n) + 1) / n - 1) for n in (columns, rows))
        x, y = np.meshgrid(across, down * self._camera.height_m / network.height_m)
        return self._camera.positions(np.stack([x, y, np.ones_like(x)]), self._shape)


def _nearest(position: np.ndarray, length: int) -> np.ndarray:
    """Index of the pixel at each position, or of the nearest one in the image."""
    return np.clip(np.floor(position), 0, length - 1).astype(np.intp)


def _fractions(length_px: int, focal_px: float, centre_px: float, network: CameraConfig) -> np.ndarray:
    """(S, L) float32: fraction of each of the network's pixels covered by each source pixel, along one axis."""
    scale = focal_px / network.focal_px
    edge = centre_px + scale * (np.arange(network.fpv_px + 1) - network.fpv_px / 2)
    source = np.arange(length_px)
    overlap = np.minimum(edge[1:, None], source + 1) - np.maximum(edge[:-1, None], source)
    # rounded, so that whole fractions are exact in spite of the tangents
    return np.round(overlap.clip(min=0) / scale, 7).astype(np.float32)
