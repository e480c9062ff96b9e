"""Checks that a home is in metres with z up, as HM3DSem is, before anything costly is done with it."""

from pathlib import Path

import numpy as np

from zerobev.common.errors import InputError
from zerobev.config import LABELS
from zerobev.scenes.scene import Scene

#: A home is at most this large: metres from one end to the other, and from the lowest point to the highest.
_ACROSS_M, _TALL_M = 120.0, 40.0
_SMALLEST_M = 1.0
_STOREY_M = 3.0
#: Furniture of these classes is about this tall; the median of three pieces is less than 2.5 times that.
_FURNITURE = ("chair", "sofa", "bed", "toilet")
_FURNITURE_M, _FURNITURE_TIMES, _FURNITURE_COUNT = 0.8, 2.5, 3
_UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37, "feet": 3.281}
_STRAY_TIMES = 10.0  # a vertex this many times as far from the middle as half of all is a stray one
_SAME_TIMES = 10.0  # photograph and annotation differ by less than this


def check_extents(scene: Scene, annotation: Path, photograph: Path) -> None:
    """Raise `InputError`, with the file's name and the likely cause, unless `scene` can be a home in metres, z up.

    The axis is that along which the floors face. The unit shows in the height of the furniture, if there are three
    pieces or more, and in the extent: at most 120 m across and 40 m tall, at least 1 m. The photograph's extent has to
    be within ten times the annotation's.
    """
    corner = scene.vertices[scene.faces].astype(np.float64)
    extent = np.ptp(corner, axis=(0, 1))
    if not extent.any():
        return  # of a home without a surface, other checks say more
    _check_axis(scene, annotation, corner)
    heights = _furniture_heights(scene, corner)
    if len(heights) >= _FURNITURE_COUNT and np.median(heights) > _FURNITURE_TIMES * _FURNITURE_M:
        raise InputError(
            f"{annotation}: expected a home in metres, with {', '.join(_FURNITURE)} about {_FURNITURE_M} m tall, "
            f"found {np.median(heights):.4g}: it is likely in {_unit(_FURNITURE_M, np.median(heights))}"
        )
    if max(extent[:2]) > _ACROSS_M or extent[2] > _TALL_M:
        stray = _stray(corner)
        cause = f"it is likely in {_unit(_STOREY_M, extent[2])}" if stray is None else f"a stray vertex is at {stray}"
        expected = f"a home in metres, at most {_ACROSS_M:.0f} m across and {_TALL_M:.0f} m tall"
        raise InputError(f"{annotation}: expected {expected}, found {_product(extent)}: {cause}")
    if max(extent) < _SMALLEST_M:
        expected = f"a home in metres, at least {_SMALLEST_M:.0f} m in extent"
        raise InputError(f"{annotation}: expected {expected}, found {_product(extent)}: its unit is likely another")
    photographed = np.ptp(scene.photograph.bounds, axis=0)
    if not 1 / _SAME_TIMES < max(photographed) / max(extent) < _SAME_TIMES:
        expected = f"a photograph of the annotation's unit and extent, {_product(extent)}"
        raise InputError(f"{photograph}: expected {expected}, found {_product(photographed)}")


def _check_axis(scene: Scene, path: Path, corner: np.ndarray) -> None:
    floor = scene.instance_label[scene.face_instance] == LABELS.index("floor")
    edge = corner[floor, 1:] - corner[floor, :1]
    facing = np.abs(np.cross(edge[:, 0], edge[:, 1])).sum(axis=0)  # m2 of floor that face along x, y and z
    axis = int(facing.argmax())
    if facing[axis] > 0 and axis != 2:
        raise InputError(
            f"{path}: expected a home with z up, found floors that face along {'xyz'[axis]}: "
            f"it is likely {'xyz'[axis]} up"
        )


def _furniture_heights(scene: Scene, corner: np.ndarray) -> np.ndarray:
    """Vertical extents of the instances of the classes in `_FURNITURE`."""
    lowest, highest = (np.full(len(scene.instance_label), end) for end in (np.inf, -np.inf))
    np.minimum.at(lowest, scene.face_instance, corner[..., 2].min(axis=1))
    np.maximum.at(highest, scene.face_instance, corner[..., 2].max(axis=1))
    is_furniture = np.isin(scene.instance_label, [LABELS.index(label) for label in _FURNITURE])
    return (highest - lowest)[is_furniture & (highest > lowest)]


def _stray(corner: np.ndarray) -> str | None:
    """The vertex farthest out, if it is far beyond most others."""
    points = corner.reshape(-1, 3)
    distance = np.abs(points - np.median(points, axis=0)).max(axis=1)
    stray = distance.max() > _STRAY_TIMES * np.median(distance)
    return f"({', '.join(f'{value:.4g}' for value in points[distance.argmax()])})" if stray else None


def _unit(expected_m: float, found: float) -> str:
    """The unit in which `found` is nearest to `expected_m` metres."""
    return min(_UNITS, key=lambda name: abs(float(np.log(max(found, 1e-9) / _UNITS[name] / expected_m))))


def _product(extent: np.ndarray) -> str:
    return " x ".join(f"{value:.4g}" for value in extent)
