"""A walk through two rooms with a door between them: on the free floor, through both, at equal steps."""

from dataclasses import replace

import numpy as np
import pytest

from zerobev.common.errors import InputError
from zerobev.config import LABELS, AgentConfig
from zerobev.rendering.poses import NavigableFloor, navigable_floor
from zerobev.rendering.walks import REACH_M, STEP_M, walk
from zerobev.scenes.scene import Scene

from support.scenes import Thing, box, build, furnished

VIEWS = 60


def two_rooms(side: float = 5) -> Scene:
    """Square rooms beside each other; the wall between them ends 1.4 m before the largest y."""
    floors = [[(x, 0, 0), (x + side, 0, 0), (x + side, side, 0), (x, side, 0)] for x in (0, side)]
    things = [
        *(Thing("floor", np.array([quad], float)) for quad in floors),
        box("wall", (side - 0.1, 0, 0), (side + 0.1, side - 1.4, 2.5)),
    ]
    scene = build(things)
    return replace(scene, instances=tuple(replace(one, region=one.id) for one in scene.instances))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return two_rooms()


@pytest.fixture(scope="module")
def floor(scene) -> NavigableFloor:
    return navigable_floor(scene, AgentConfig(), np.random.default_rng(0))


@pytest.fixture(scope="module")
def positions(scene, floor) -> np.ndarray:
    return np.array([(pose.x, pose.y) for pose in walk(scene, floor, VIEWS)])


def test_it_starts_in_the_middle_of_a_room_and_takes_the_door(positions):
    assert np.linalg.norm(positions[0] - 2.5) < 0.05
    assert np.linalg.norm(positions - (7.5, 2.5), axis=1).min() < STEP_M
    crossings = np.flatnonzero(np.diff(positions[:, 0] > 5))
    assert len(crossings) and (positions[crossings, 1] > 3.6).all()


def test_ways_are_short():
    """From the middle of one small room around the wall's end, at the distance of the robot's radius, to the other."""
    small = two_rooms(3)
    floor = navigable_floor(small, AgentConfig(), np.random.default_rng(0))
    way = np.array([(pose.x, pose.y) for pose in walk(small, floor, 20)])
    there = STEP_M * np.linalg.norm(way - (4.5, 1.5), axis=1).argmin()
    corner = np.array([0.1 + AgentConfig().radius_m, 0.1 + AgentConfig().radius_m])
    shortest = 2 * (np.linalg.norm((1.5, 0.1) - corner * (1, -1)) + corner[0])
    assert shortest - STEP_M < there < 1.1 * shortest + STEP_M  # a grid has eight directions


def test_it_stays_on_the_free_floor_and_reaches_all_of_it(positions, floor):
    away = np.linalg.norm(positions[:, None] - floor.cells[None, :, :2], axis=2)
    assert away.min(axis=1).max() < floor.grid_m
    assert away.min(axis=0).max() <= REACH_M + STEP_M


def test_steps_are_equal_and_each_pose_faces_the_next(scene, floor, positions):
    poses = walk(scene, floor, VIEWS)
    assert len(poses) == VIEWS and [pose.floor_z for pose in poses] == pytest.approx([0] * VIEWS, abs=1e-6)
    steps = np.diff(positions, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    assert lengths.max() <= STEP_M + 1e-9 and np.median(lengths) > 0.95 * STEP_M  # shorter around corners
    yaw = np.array([pose.yaw for pose in poses[:-1]])
    moving = lengths > 1e-6
    np.testing.assert_allclose(steps[moving].T, (lengths * [np.cos(yaw), np.sin(yaw)])[:, moving], atol=1e-9)
    assert poses == walk(scene, floor, VIEWS) and poses[:10] == walk(scene, floor, 10)


def test_a_long_walk_goes_back_on_its_way(scene, floor, positions):
    long = np.array([(pose.x, pose.y) for pose in walk(scene, floor, 5 * VIEWS)])
    away = np.linalg.norm(long[:, None] - floor.cells[None, :, :2], axis=2)
    assert away.min(axis=1).max() < floor.grid_m
    assert np.linalg.norm(long[VIEWS:] - positions[0], axis=1).min() < STEP_M


def test_a_floor_without_a_way_is_refused():
    small = build(furnished())
    floor = navigable_floor(small, AgentConfig(), np.random.default_rng(0))
    with pytest.raises(InputError, match=r"floor: expected a way of more than 3\.5 m, found none"):
        walk(small, floor, 3)
    assert {one.label for one in small.instances} >= {LABELS.index("floor")}
