"""A scene in memory: geometry, UV atlas and annotation."""

import re
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from zerobev.config import NO_LABEL


@dataclass(frozen=True)
class Instance:
    """One annotated object: a row of `.semantic.txt`, and the class of its name."""

    id: int  #: >= 1; id 0 is the implicit "unknown"
    color: tuple[int, int, int]  #: sRGB bytes, unique in the scene
    name: str
    region: int  #: room number
    label: int  #: index into `zerobev.config.LABELS`, or NO_LABEL


@dataclass(frozen=True)
class Scene:
    """Geometry, UV atlas and annotation of one scene; world frame in metres, z up.

    The atlas is a tuple of charts, one texture image each. Every point of the surface has one texel
    `(chart, row, column)`; row 0 is the top of the image. A modality on the surface is a set of images of the charts'
    sizes, and is rendered by looking up texels.

    The meshes of the photograph and of the annotation may differ, as in HM3DSem; both are in the world frame.
    """

    name: str
    vertices: np.ndarray  #: (V, 3) float32, metres
    faces: np.ndarray  #: (F, 3) int32
    face_uv: np.ndarray  #: (F, 3, 2) float32, u right and v down, per corner of a face; points are clamped to [0, 1]
    face_chart: np.ndarray  #: (F,) int16, index into `chart_instance`
    chart_instance: tuple[np.ndarray, ...]  #: one (rows, columns) uint16 image per chart: instance id of each texel
    instances: tuple[Instance, ...]  #: sorted by id
    photograph: trimesh.Scene  #: the textured mesh for photographs
    unlit: bool  #: light is baked into the photograph's textures
    double_sided: bool | np.ndarray  #: whether the backs of faces are visible: one value, or (F,) bool

    @property
    def generated(self) -> bool:
        """Whether this is a flat of `zerobev.scenes.homes`; only these have such names, not varied homes."""
        return re.fullmatch(r"([0-9]{5}-)?Home[0-9]{7}", self.name) is not None

    @cached_property
    def instance_label(self) -> np.ndarray:
        """(largest id + 1,) int8: label of each instance id; NO_LABEL for id 0 and for unused ids."""
        table = np.full(max((i.id for i in self.instances), default=0) + 1, NO_LABEL, np.int8)
        for instance in self.instances:
            table[instance.id] = instance.label
        return table

    @cached_property
    def instance_bounds(self) -> np.ndarray:
        """(largest id + 1, 2, 3) float64: lower and upper corner of each instance, metres; inf, -inf without faces."""
        corner = self.vertices[self.faces].astype(np.float64)
        lower, upper = (np.full((len(self.instance_label), 3), end) for end in (np.inf, -np.inf))
        np.minimum.at(lower, self.face_instance, corner.min(axis=1))
        np.maximum.at(upper, self.face_instance, corner.max(axis=1))
        return np.stack([lower, upper], axis=1)

    @cached_property
    def face_instance(self) -> np.ndarray:
        """(F,) uint16: instance id at the centre of each face."""
        uv = self.face_uv.mean(axis=1)
        ids = np.zeros(len(self.faces), np.uint16)
        for chart, image in enumerate(self.chart_instance):
            on = self.face_chart == chart
            row, column = texel_of_uv(uv[on], image.shape)
            ids[on] = image[row, column]
        return ids


def texel_of_uv(uv: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the texels at `uv` ((..., 2), u right, v down) in an image of `shape`, clamped."""
    rows, columns = shape
    column = np.clip(np.floor(uv[..., 0] * columns), 0, columns - 1).astype(np.int16)
    row = np.clip(np.floor(uv[..., 1] * rows), 0, rows - 1).astype(np.int16)
    return row, column
