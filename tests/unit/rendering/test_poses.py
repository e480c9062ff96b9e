"""Navigable floor of hand-made rooms with known free area."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chisquare, kstest

from zerobev.common.errors import InputError
from zerobev.config import AgentConfig
from zerobev.rendering.poses import NavigableFloor, navigable_floor

from support.scenes import Thing, box, build, furnished, room, table

AGENT = AgentConfig()
SIZE = (4.0, 3.0, 2.5)


def floor_of(*things: Thing) -> NavigableFloor:
    return navigable_floor(build(things), AGENT, np.random.default_rng(0))


def is_free(floor: NavigableFloor, *point: float) -> bool:
    """Whether a cell centre lies within a cell of the point (x, y)."""
    return bool((np.abs(floor.cells[:, :2] - point) <= AGENT.grid_m).all(axis=1).any())


@pytest.mark.parametrize("size", [SIZE, (3.3, 3.3, 2.5)])  # in a square, cell centres are on the faces' diagonal
def test_area_of_an_empty_room(size):
    floor = floor_of(*room(size))
    width, depth, _ = size
    within = [(width - 2 * r) * (depth - 2 * r) for r in np.add(AGENT.radius_m, (AGENT.grid_m, -AGENT.grid_m))]
    assert within[0] <= floor.area_m2 <= within[1]
    clearance = np.minimum(floor.cells[:, :2], np.array(size[:2]) - floor.cells[:, :2]).min()
    assert clearance >= AGENT.radius_m - AGENT.grid_m / 2
    assert floor.cells[:, 2] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    "thing, blocks",
    [
        (box("chest", (1.5, 1.0, 0), (2.5, 2.0, 0.5)), True),
        (box("threshold", (1.5, 1.0, 0), (2.5, 2.0, 0.05)), False),
        (box("rug", (1.5, 1.0, 0), (2.5, 2.0, 0.02)), False),
        (table((1.5, 1.0, 0), (1.0, 1.0))[0], True),
        (box("lamp", (1.5, 1.0, 1.8), (2.5, 2.0, 2.1)), False),
        (box("lamp", (1.5, 1.0, 1.3), (2.5, 2.0, 1.6)), True),
    ],
    ids=lambda value: value.name if isinstance(value, Thing) else None,
)
def test_what_blocks(thing, blocks):
    empty, floor = floor_of(*room(SIZE)), floor_of(*room(SIZE), thing)
    assert is_free(floor, 2.0, 1.5) is not blocks
    # obstacles grow by the body's radius on all sides, with round corners
    side, r = 1.0, AGENT.radius_m
    taken = side**2 + 4 * side * r + np.pi * r**2 if blocks else 0
    assert empty.area_m2 - floor.area_m2 == pytest.approx(taken, abs=4 * (side + 2 * r) * AGENT.grid_m)
    if blocks:
        near = np.maximum(np.abs(floor.cells[:, :2] - (2.0, 1.5)) - 0.5, 0)
        assert np.linalg.norm(near, axis=1).min() >= r - AGENT.grid_m


def test_the_floor_inside_a_cupboard_is_not_navigable():
    cupboard = box("cupboard", (1.0, 1.0, 0), (2.0, 2.0, 2.2))
    hollow = Thing("cupboard", cupboard.quads[[0, 2, 3, 4, 5]])  # no bottom: the room's floor is inside
    assert not is_free(floor_of(*room(SIZE), hollow), 1.5, 1.5)


def test_rug_is_floor_at_its_own_height():
    floor = floor_of(*furnished())
    on_rug = (np.abs(floor.cells[:, :2] - (2.9, 1.5)) < (0.65, 0.45)).all(axis=1)
    assert on_rug.sum() > 300
    assert floor.cells[on_rug, 2] == pytest.approx(0.02, abs=1e-6)


def test_two_storeys_are_found():
    floor = floor_of(*room(SIZE), *room((3.0, 2.0, 2.5), corner=(0, 0, 2.6)))
    lower, upper = np.abs(floor.cells[:, 2]) < 0.01, np.abs(floor.cells[:, 2] - 2.6) < 0.01
    assert (lower | upper).all()
    for storey, (width, depth) in ((lower, (4, 3)), (upper, (3, 2))):
        free = (width - 2 * AGENT.radius_m) * (depth - 2 * AGENT.radius_m)
        assert storey.sum() * AGENT.grid_m**2 == pytest.approx(free, abs=2 * (width + depth) * AGENT.grid_m)


def test_the_edge_of_a_gallery_is_not_navigable():
    floor = floor_of(*room((6, 4, 5.2)), box("floor", (3, 0, 2.6), (6, 4, 2.7)))
    gallery = floor.cells[floor.cells[:, 2] > 1]
    assert gallery[:, 0].min() >= 3 + AGENT.radius_m - AGENT.grid_m / 2
    assert is_free(floor, 2.5, 2) and is_free(floor, 4.5, 2)
    below = floor.cells[np.abs(floor.cells[:, 2]) < 0.01]
    # the floor below is continuous
    under = NavigableFloor(below, AGENT.grid_m)
    assert all(is_free(under, x, 2) for x in (2.9, 3, 3.1, 4.5))


def test_an_unused_vertex_far_away_changes_nothing():
    scene = build(furnished())
    far = replace(scene, vertices=np.concatenate([scene.vertices, [[0, 0, 1e9]]]).astype(np.float32))
    first, second = (navigable_floor(one, AGENT, np.random.default_rng(3)).cells for one in (scene, far))
    assert np.array_equal(first, second)


@pytest.mark.parametrize("apart_m", [2.5, 2.75, 3.2])
def test_stairs_of_class_floor_do_not_join_storeys(apart_m):
    """Steps with a floor's name lead from one storey to the other; each storey has its free floor."""
    upper = box("floor", (0, 0, apart_m - 0.2), (4, 3, apart_m))
    count = int(np.ceil(apart_m / 0.18))
    rise = apart_m / count
    steps = [
        Thing("floor", box("floor", (4 + 0.2 * k, 0, 0), (4.2 + 0.2 * k, 3, apart_m - rise * k)).quads[:1])
        for k in range(count)
    ]
    floor = floor_of(*room((8, 3, 6)), upper, *steps)
    free = (4 - AGENT.radius_m) * (3 - 2 * AGENT.radius_m)
    for height in (0, apart_m):
        storey = (np.abs(floor.cells[:, 2] - height) < 0.01) & (floor.cells[:, 0] < 4)
        assert storey.sum() * AGENT.grid_m**2 == pytest.approx(free, abs=12 * AGENT.grid_m)


def test_poses_are_uniform():
    floor = floor_of(*furnished())
    rng = np.random.default_rng(1)
    poses = [floor.draw(rng) for _ in range(20_000)]
    points = np.array([(pose.x, pose.y) for pose in poses])
    cells = {tuple(cell): i for i, cell in enumerate(np.floor(floor.cells[:, :2] / floor.grid_m + 1e-6).astype(int))}
    hit = [cells[tuple(cell)] for cell in np.floor(points / floor.grid_m).astype(int)]  # each is in a free cell
    assert chisquare(np.bincount(hit, minlength=len(cells))).pvalue > 0.01
    for axis in (0, 1):
        assert kstest(points[:, axis] / floor.grid_m % 1, "uniform").pvalue > 0.01
    assert kstest([pose.yaw for pose in poses], "uniform", args=(-np.pi, 2 * np.pi)).pvalue > 0.01


def test_floor_is_a_function_of_scene_and_seed():
    scene = build(furnished())
    first, again = (navigable_floor(scene, AGENT, np.random.default_rng(3)).cells for _ in range(2))
    assert np.array_equal(first, again)
    draws = [NavigableFloor(first, AGENT.grid_m).draw(np.random.default_rng(4)) for _ in range(2)]
    assert all(a == b for a, b in pairwise(draws))


def test_scenes_without_navigable_floor():
    with pytest.raises(InputError, match=r"scene test: .*class floor, found none"):
        floor_of(box("bed", (0, 0, 0), (2, 2, 0.5)))
    with pytest.raises(InputError, match=r"scene test: .*free floor, found none"):
        floor_of(*room((0.5, 0.5, 2.5)))
