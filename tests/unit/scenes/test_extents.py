"""Units and axes of scenes: one in metres is read, others are refused with the likely cause."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from zerobev.common.errors import InputError
from zerobev.scenes.extents import check_extents
from zerobev.scenes.scene import Scene

from support.scenes import box, build, furnished, room

FILES = Path("a.semantic.glb"), Path("a.glb")
HOME = build([*furnished(), box("toilet", (1, 3, 0), (1.4, 3.6, 0.75)), box("sofa", (2, 3, 0), (4, 3.8, 0.9))])
BARE = build(room((5, 4, 2.5)))


def turned(scene: Scene, matrix: np.ndarray) -> Scene:
    photograph = scene.photograph.copy()
    photograph.apply_transform(np.block([[matrix, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]))
    return replace(scene, vertices=(scene.vertices @ matrix.T).astype(np.float32), photograph=photograph)


@pytest.mark.parametrize("scene", [HOME, BARE, build(room((0.4, 0.4, 2.5))), build(room((90, 70, 12)))])
def test_homes_in_metres(scene):
    check_extents(scene, *FILES)
    check_extents(replace(scene, vertices=scene.vertices + np.float32(1000)), *FILES)  # at any position


@pytest.mark.parametrize(("unit", "per_metre"), [("millimetres", 1000), ("centimetres", 100), ("inches", 39.37)])
@pytest.mark.parametrize("scene", [HOME, BARE])
def test_the_unit_is_named(scene, unit, per_metre):
    with pytest.raises(InputError, match=rf"a\.semantic\.glb: expected a home in metres, .*found .*likely in {unit}"):
        check_extents(turned(scene, per_metre * np.eye(3)), *FILES)


def test_feet_show_in_the_furniture():
    with pytest.raises(InputError, match="likely in feet"):
        check_extents(turned(HOME, 3.281 * np.eye(3)), *FILES)


@pytest.mark.parametrize("scale", [1, 100])
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(("axis", "order"), [("y", (0, 2, 1)), ("x", (2, 0, 1))])
def test_the_axis_is_named(axis, order, sign, scale):
    with pytest.raises(InputError, match=f"expected a home with z up, found .* likely {axis} up"):
        check_extents(turned(HOME, sign * scale * np.eye(3)[list(order)]), *FILES)


def test_a_stray_vertex_is_named():
    vertices = HOME.vertices.copy()
    vertices[30] = (0, -2e5, 0)
    with pytest.raises(InputError, match=r"a stray vertex is at \(0, -2e\+05, 0\)"):
        check_extents(replace(HOME, vertices=vertices), *FILES)
    unused = replace(HOME, vertices=np.concatenate([HOME.vertices, [[1e9, 0, 0]]]).astype(np.float32))
    check_extents(unused, *FILES)


def test_other_sizes():
    with pytest.raises(InputError, match=r"at least 1 m in extent, found 0\.005 x 0\.004 x 0\.0025"):
        check_extents(turned(HOME, 1e-3 * np.eye(3)), *FILES)
    with pytest.raises(InputError, match=r"^a\.glb: expected a photograph of .* 5 x 4 x 2.5, found 500 x 400 x 250"):
        check_extents(replace(HOME, photograph=turned(HOME, 100 * np.eye(3)).photograph), *FILES)
