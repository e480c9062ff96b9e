"""The map of one storey of homes with ceilings, attics, lamps and other storeys, against the same home without them."""

from dataclasses import replace

import numpy as np
import pytest

from zerobev.config import LABELS, CameraConfig
from zerobev.geometry.cameras import Pose
from zerobev.rendering.gbuffer import GBuffer, RayCaster
from zerobev.scenes.indoor import generate_home
from zerobev.scenes.scene import Scene

from support.scenes import Thing, box, build, furnished, room

CAMERA = CameraConfig(fpv_px=32, bev_px=50)
POSES = (Pose(2.0, 0.5, 0, 1.0), Pose(4.4, 2.4, 0, -2.9))
OPEN = [thing for thing in furnished() if thing.name != "ceiling"]
FLAT = np.array([[(0, 0, 0), (5, 0, 0), (5, 4, 0), (0, 4, 0)]], float)  # faces up
SLOPE = np.array([(0, 0, 2.05), (0, 0, 2.05), (0, 0, 4), (0, 0, 4)])
SHEETS = {"flat": np.add(FLAT, (0, 0, 2.45)), "sloped": np.add(FLAT, SLOPE)}


def seen(*things: Thing, double_sided: bool = False, pose: Pose = POSES[0]) -> GBuffer:
    return RayCaster(build([*OPEN, *things], double_sided=double_sided)).bev(pose, CAMERA)


def same(first: GBuffer, second: GBuffer) -> bool:
    return bool((first.instance == second.instance).all() and np.allclose(first.distance, second.distance, atol=1e-5))


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("double_sided", [False, True])
@pytest.mark.parametrize("looks", ["up", "down"])
@pytest.mark.parametrize("sheet", SHEETS)
@pytest.mark.parametrize("name", ["ceiling", "ceilling", "roof", "upper floor", "panel", "wall", ""])
def test_a_ceiling_is_above_the_map(name, sheet, looks, double_sided, pose):
    quads = SHEETS[sheet] if looks == "up" else SHEETS[sheet][:, ::-1]
    with_it = seen(Thing(name, quads), double_sided=double_sided, pose=pose)
    assert same(with_it, seen(double_sided=double_sided, pose=pose))


@pytest.mark.parametrize("double_sided", [False, True])
@pytest.mark.parametrize("slab_m", [0.0, 0.05, 0.45])
@pytest.mark.parametrize("apart_m", [2.5, 2.6, 2.75, 2.85, 3.2])
def test_each_of_two_storeys_has_its_own_map(apart_m, slab_m, double_sided):
    floor = Thing("floor", np.add(FLAT, (0, 0, apart_m)))
    if slab_m:
        floor = box("floor", (0, 0, apart_m - slab_m), (5, 4, apart_m))
    above = [Thing(thing.name, np.add(thing.quads, (0, 0, apart_m))) for thing in OPEN if thing.name != "floor"]
    both = RayCaster(build([*OPEN, floor, *above], double_sided=double_sided))
    alone = RayCaster(build(OPEN, double_sided=double_sided))
    names = [thing.name for thing in [*OPEN, floor, *above]]
    for pose in POSES:
        lower, upper = both.bev(pose, CAMERA), both.bev(replace(pose, floor_z=apart_m), CAMERA)
        expected = alone.bev(pose, CAMERA)
        assert same(lower, expected)
        on_floor = expected.instance > 0  # the lower storey is visible beyond the upper one's edges
        assert [names[i - 1] for i in upper.instance[on_floor]] == [names[i - 1] for i in expected.instance[on_floor]]
        assert upper.distance[on_floor] == pytest.approx(expected.distance[on_floor], abs=1e-5)


def cell(view: GBuffer, pose: Pose, x: float, y: float) -> tuple[int, float]:
    """Instance and height of the cell at a point of the world."""
    right, forward, _ = pose.world_R_map.T @ (x - pose.x, y - pose.y, 0)
    place = CAMERA.bev_px - 1 - int(forward / CAMERA.cell_m), int(right / CAMERA.cell_m + CAMERA.bev_px / 2)
    return int(view.instance[place]), float(view.distance[place])


HERE = (2.4, 2.6)  # free floor in view of `POSES[0]`
NEW, BELOW = len(OPEN) + 1, [thing.name for thing in OPEN].index("floor") + 1
AROUND = (2.2, 2.4), (2.6, 2.8)


@pytest.mark.parametrize("double_sided", [False, True])
@pytest.mark.parametrize(
    ("low", "high", "instance", "height"),
    [
        (1.5, 1.8, NEW, 1.8),  # a lamp, a beam or a shelf at head height
        (1.9, 2.3, NEW, 2.3),  # it reaches below 2 m
        (0.0, 2.3, NEW, 2.3),  # a wardrobe
        (0.0, 2.0, NEW, 2.0),
        (2.0, 2.4, BELOW, 0.0),
        (2.2, 2.4, BELOW, 0.0),  # a lamp under the ceiling
        (2.7, 2.8, BELOW, 0.0),
    ],
)
def test_two_metres_decide(low, high, instance, height, double_sided):
    (x0, y0), (x1, y1) = AROUND
    closed = box("thing", (x0, y0, low), (x1, y1, high))
    found = seen(closed, double_sided=double_sided)
    assert cell(found, POSES[0], *HERE) == (instance, pytest.approx(height, abs=1e-5))
    open_below = Thing("thing", np.delete(closed.quads, 1, axis=0))
    if low == 0:  # as in a scan, without invisible faces
        assert same(seen(open_below, double_sided=double_sided), found)


def test_a_wall_is_wall_and_a_door_in_it_is_open():
    """A lintel above 2 m is not on the map, as in inverse projection; the wall beside it is cut."""
    parts = [((2.0, 2.5, 0), (2.3, 2.7, 2.5)), ((2.3, 2.5, 2.1), (2.9, 2.7, 2.5)), ((2.9, 2.5, 0), (3.2, 2.7, 2.5))]
    wall = Thing("wall", np.concatenate([box("wall", *part).quads for part in parts]))
    for double_sided in (False, True):
        found = seen(wall, double_sided=double_sided)
        assert cell(found, POSES[0], 2.15, 2.6) == (NEW, pytest.approx(2.5))
        assert cell(found, POSES[0], 2.6, 2.6) == (BELOW, pytest.approx(0, abs=1e-5))


def test_sidedness_is_of_each_face():
    """From outside, the back of the near wall is visible if it is double-sided; all else is unchanged."""
    scene = build([*room((2, 2, 2.5)), box("chest", (0.5, 0.5, 0), (1.5, 1.5, 1))])
    pose, camera = Pose(-1, 1, 0, 0), CameraConfig(fpv_px=48, bev_px=50)
    for owner, instances, depths in ((5, (5, 5), (1, 1)), (6, (7, 6), (1.5, 3))):
        one = replace(scene, double_sided=scene.face_instance == owner)
        view = RayCaster(one).fpv(pose, camera)
        assert (view.instance[26, 24], view.instance[20, 24]) == instances
        assert view.distance[[26, 20], 24] == pytest.approx(depths, abs=1e-4)


def map_of(scene: Scene, pose: Pose) -> GBuffer:
    return RayCaster(scene).bev(pose, CAMERA)


def test_generated_homes_differ_only_in_their_lamps():
    """Recorded data have their lamps on the map; under another name the home has none above 2 m."""
    home = generate_home("Home0000003", np.random.default_rng(3))
    other = replace(home, name="other")
    assert home.generated and not other.generated
    floor = home.vertices[home.faces[home.instance_label[home.face_instance] == LABELS.index("floor")]]
    low, high = floor.min(axis=(0, 1)), floor.max(axis=(0, 1))
    names = {instance.id: instance.name for instance in home.instances}
    hanging = 0
    for share in (0.2, 0.5, 0.8):
        pose = Pose(*(low + share * (high - low))[:2], 0.0, 2.0)
        first, second = map_of(home, pose), map_of(other, pose)
        differ = first.instance != second.instance
        hanging += differ.sum()
        assert differ.mean() < 0.1 and (first.distance[differ] > 2).all() and (second.distance[differ] < 2).all()
        assert not {names[i] for i in first.instance[differ]} & {"wall", "floor", "ceiling", "wardrobe"}
    assert hanging > 0
