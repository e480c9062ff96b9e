"""Checks that a scene is in metres with z up, as in HM3DSem, before costly steps."""

from pathlib import Path

import numpy as np

from zerobev.common.errors import InputError
from zerobev.config import LABELS
from zerobev.scenes.scene import Scene

_MAX_ACROSS_M, _MAX_TALL_M = 120.0, 40.0  # horizontal and vertical extent of a scene
_MIN_EXTENT_M = 1.0
_STOREY_M = 3.0
_FURNITURE = ("chair", "sofa", "bed", "toilet")
#: Typical height of these classes, maximum ratio of the median height to it, and minimum number of pieces.
_FURNITURE_M, _MAX_FURNITURE_RATIO, _MIN_FURNITURE = 0.8, 2.5, 3
_UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37, "feet": 3.281}
_MIN_STRAY_RATIO = 10.0  # of a stray vertex's distance from the centre to the median distance
_MAX_EXTENT_RATIO = 10.0  # between photograph and annotation


def check_extents(scene: Scene, annotation: Path, photograph: Path) -> None:
    """Raise `InputError`, with the file's name and the likely cause, unless `scene` can be in metres with z up.

    The axis is checked by the normals of the floors; the unit by the median height of the furniture, from three pieces
    on, and by the extent: at most 120 m across and 40 m tall, at least 1 m. The extents of the photograph and of the
    annotation may differ by a factor of ten.
    """
    corner = scene.vertices[scene.faces].astype(np.float64)
    extent = np.ptp(corner, axis=(0, 1))
    if not extent.any():
        return  # other checks report a scene without surfaces
    _check_axis(scene, annotation, corner)
    heights = _furniture_heights(scene)
    if len(heights) >= _MIN_FURNITURE and np.median(heights) > _MAX_FURNITURE_RATIO * _FURNITURE_M:
        raise InputError(
            f"{annotation}: expected a home in metres, with {', '.join(_FURNITURE)} about {_FURNITURE_M} m tall, "
            f"found {np.median(heights):.4g}: it is likely in {_unit(_FURNITURE_M, np.median(heights))}"
        )
    if max(extent[:2]) > _MAX_ACROSS_M or extent[2] > _MAX_TALL_M:
        stray = _stray(corner)
        cause = f"it is likely in {_unit(_STOREY_M, extent[2])}" if stray is None else f"a stray vertex is at {stray}"
        expected = f"a home in metres, at most {_MAX_ACROSS_M:.0f} m across and {_MAX_TALL_M:.0f} m tall"
        raise InputError(f"{annotation}: expected {expected}, found {_product(extent)}: {cause}")
    if max(extent) < _MIN_EXTENT_M:
        expected = f"a home in metres, at least {_MIN_EXTENT_M:.0f} m in extent"
        raise InputError(f"{annotation}: expected {expected}, found {_product(extent)}: its unit is likely another")
    photographed = np.ptp(scene.photograph.bounds, axis=0)
    if not 1 / _MAX_EXTENT_RATIO < max(photographed) / max(extent) < _MAX_EXTENT_RATIO:
        expected = f"a photograph of the annotation's unit and extent, {_product(extent)}"
        raise InputError(f"{photograph}: expected {expected}, found {_product(photographed)}")


def _check_axis(scene: Scene, path: Path, corner: np.ndarray) -> None:
    floor = scene.instance_label[scene.face_instance] == LABELS.index("floor")
    edge = corner[floor, 1:] - corner[floor, :1]
    facing = np.abs(np.cross(edge[:, 0], edge[:, 1])).sum(axis=0)  # floor area, m2, projected along x, y and z
    axis = int(facing.argmax())
    if facing[axis] > 0 and axis != 2:
        raise InputError(
            f"{path}: expected a home with z up, found floors that face along {'xyz'[axis]}: "
            f"it is likely {'xyz'[axis]} up"
        )


def _furniture_heights(scene: Scene) -> np.ndarray:
    """Vertical extents of the instances of the classes in `_FURNITURE`, metres."""
    is_furniture = np.isin(scene.instance_label, [LABELS.index(label) for label in _FURNITURE])
    lowest, highest = scene.instance_bounds[is_furniture, :, 2].T
    return (highest - lowest)[highest > lowest]


def _stray(corner: np.ndarray) -> str | None:
    """The vertex farthest from the centre, if it is far beyond most others."""
    points = corner.reshape(-1, 3)
    distance = np.abs(points - np.median(points, axis=0)).max(axis=1)
    stray = distance.max() > _MIN_STRAY_RATIO * np.median(distance)
    return f"({', '.join(f'{value:.4g}' for value in points[distance.argmax()])})" if stray else None


def _unit(expected_m: float, found: float) -> str:
    """The unit that brings `found` nearest to `expected_m` metres."""
    return min(_UNITS, key=lambda name: abs(float(np.log(max(found, 1e-9) / _UNITS[name] / expected_m))))


def _product(extent: np.ndarray) -> str:
    return " x ".join(f"{value:.4g}" for value in extent)
