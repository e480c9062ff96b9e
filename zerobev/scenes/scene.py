"""A scene: what the sensors need to know about a home, in memory."""

import re
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from zerobev.config import NO_LABEL


@dataclass(frozen=True)
class Instance:
    """One annotated object: a row of `.semantic.txt`, plus the class its name maps to."""

    id: int  #: >= 1; id 0 is the implicit "unknown"
    color: tuple[int, int, int]  #: sRGB bytes, unique in the scene
    name: str
    region: int  #: room number
    label: int  #: index into `zerobev.config.LABELS`, or NO_LABEL


@dataclass(frozen=True)
class Scene:
    """Geometry, UV atlas and annotation of one home; world frame in metres, z up.

    The atlas is a tuple of charts (one texture image each). Every point of the surface has one texel
    `(chart, row, column)`; row 0 is the top of the image. Any modality that lives on the surface is a
    set of images of the charts' sizes, and is rendered by looking texels up.

    The meshes of photographs and of annotations may differ (they do in HM3D's format); both are in
    the same frame.
    """

    name: str
    vertices: np.ndarray  #: (V, 3) float32, metres
    faces: np.ndarray  #: (F, 3) int32
    face_uv: np.ndarray  #: (F, 3, 2) float32, u right and v down, of each corner of a face; clamped to [0, 1] per point
    face_chart: np.ndarray  #: (F,) int16, index into `chart_instance`
    chart_instance: tuple[np.ndarray, ...]  #: one (rows, columns) uint16 image a chart: instance id of each texel
    instances: tuple[Instance, ...]  #: sorted by id
    photograph: trimesh.Scene  #: the textured mesh that photographs are taken of
    unlit: bool  #: light is part of the photograph's textures already
    double_sided: bool | np.ndarray  #: whether the back of a face is visible too: of all faces, or (F,) bool

    @property
    def generated(self) -> bool:
        """Whether this is one of the homes of `zerobev.scenes.homes`, which alone have such names."""
        return re.fullmatch(r"([0-9]{5}-)?Home[0-9]{7}", self.name) is not None

    @cached_property
    def instance_label(self) -> np.ndarray:
        """(largest id + 1,) int8: label of each instance id; NO_LABEL for id 0 and for unused ids."""
        table = np.full(max((i.id for i in self.instances), default=0) + 1, NO_LABEL, np.int8)
        for instance in self.instances:
            table[instance.id] = instance.label
        return table

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
