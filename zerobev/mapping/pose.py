"""The pose of a camera on the floor of a home."""

import math
from dataclasses import dataclass, fields

import numpy as np

from zerobev.common.errors import InputError

_MAX_YAW = 4 * math.pi  # larger angles are probably degrees


@dataclass(frozen=True)
class Pose2D:
    """Position and heading of a camera in the world frame, as `geometry.cameras.Pose` without heights.

    Raises `InputError` for values that are not finite numbers, and for a yaw of more than two turns, which is probably
    in degrees.
    """

    x: float  #: metres
    y: float  #: metres
    yaw: float  #: angle of the forward direction from +x, counter-clockwise, radians

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.number):
                raise InputError(f"pose.{field.name}: expected a number, found {value!r}")
            if not math.isfinite(value):
                raise InputError(f"pose.{field.name}: expected a finite number, found {value!r}")
        if abs(self.yaw) > _MAX_YAW:
            raise InputError(f"pose.yaw: expected radians, at most two turns, found {self.yaw:g}: degrees?")
