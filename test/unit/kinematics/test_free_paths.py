# SPDX-License-Identifier: Apache-2.0
"""Free paths around what is in the way, and ways out of margins and contacts."""

import numpy as np
import pytest
from collision_scene import capsules
from worlds.arms import planar_arm

from remaster_ros.kinematics.bodies import Body, cylinder, obstacle, sphere
from remaster_ros.kinematics.body_pairs import RESERVE_M
from remaster_ros.kinematics.collision import CollisionModel, arm_bodies
from remaster_ros.kinematics.free_paths import free_path, way_out
from remaster_ros.kinematics.transforms import transform


@pytest.fixture(scope='module')
def lwr(lwr):
    wall = obstacle('wall', [0.0, 0.6, 0.5], [0.05, 0.5, 1.0])
    table = obstacle('table', [0.6, 0.0, 0.2], [0.3, 0.3, 0.4])
    return capsules(lwr, 0.075, wall, table)


def test_a_free_way_is_straight(lwr):
    start, end = np.zeros(7), np.deg2rad([20.0, -30, 0, 40, 0, 10, 0])
    path = free_path(lwr, start, end, np.random.default_rng(0))
    np.testing.assert_array_equal(path, [start, end])


def test_paths_go_around_a_wall_and_are_the_same_again(lwr):
    """The wall stands between the two: the straight way, a turn of joint 1, goes through it."""
    start = np.deg2rad([60.0, -70, 0, 40, 0, 20, 0]) * [1, 1, 1, 1, 1, 1, 1]
    end = start.copy()
    end[0] = np.deg2rad(120.0)
    assert lwr.trouble(start) == lwr.trouble(end) == ''
    both = [start - [np.pi, 0, 0, 0, 0, 0, 0], end - [np.pi, 0, 0, 0, 0, 0, 0]]
    blocked = [pair for pair in ([start, end], both) if lwr.path_trouble(np.array(pair))]
    assert blocked
    for pair in blocked:
        assert 'wall' in lwr.path_trouble(np.array(pair))
        path = free_path(lwr, *pair, np.random.default_rng(3))
        assert len(path) > 2
        np.testing.assert_array_equal(path[[0, -1]], pair)
        assert lwr.path_trouble(path, RESERVE_M) == ''
        np.testing.assert_array_equal(path, free_path(lwr, *pair, np.random.default_rng(3)))


@pytest.mark.parametrize('seed', range(3))
def test_whatever_is_returned_is_free(lwr, seed):
    print('seed', seed)
    rng = np.random.default_rng(seed)
    q = rng.uniform(lwr.chain.lower, lwr.chain.upper, (60, 7))
    q = q[lwr.free_mask(q, RESERVE_M)]
    around = 0
    for start, end in zip(q[:-1:2], q[1::2]):
        path = free_path(lwr, start, end, rng)
        if path is not None:
            assert lwr.path_trouble(path) == ''
            around += len(path) > 2
    assert around > 0


def test_hints_are_tried_first(lwr):
    """What was found by searching is found in three checks with the hint."""
    rng = np.random.default_rng(4)
    q = rng.uniform(lwr.chain.lower, lwr.chain.upper, (120, 7))
    q = q[lwr.free_mask(q, RESERVE_M)]
    for start, end in zip(q[:-1:2], q[1::2]):
        path = free_path(lwr, start, end, rng)
        if path is None or len(path) != 3:
            continue
        if free_path(lwr, start, end, rng, most_checks=3) is None:
            break
    else:
        pytest.fail('no pair of this kind; draw others')
    hinted = free_path(lwr, start, end, rng, hints=[path[1]], most_checks=3)
    np.testing.assert_allclose(hinted, path)


def test_there_is_none_through_a_closed_wall():
    """A planar arm between two posts cannot swing past either of them."""
    chain = planar_arm(1, limit=3.0)
    posts = [obstacle(f'post {s}', [s * 0.25, 0, 0.3], [0.02, 0.4, 0.02]) for s in (-1, 1)]
    model = CollisionModel(chain, [*arm_bodies(chain, [], 0.02), *posts], floor_z=None)
    assert free_path(model, [0.0], [2.5], np.random.default_rng(0)) is None
    # An end that is not free has no path at all.
    assert free_path(model, [0.0], [np.pi / 2], np.random.default_rng(0)) is None
    assert free_path(model, [-0.5], [0.5], np.random.default_rng(0)) is not None


# Ways out


def test_a_free_arm_needs_no_way_out(lwr):
    path = way_out(lwr, np.zeros(7), np.random.default_rng(0))
    np.testing.assert_array_equal(path, np.zeros((1, 7)))


@pytest.mark.parametrize('depth', [-0.005, 0.01])
def test_out_of_the_floor_the_way_goes_up(depth):
    """A level arm with its ball within the margin of the floor, or 10 mm in it."""
    chain = planar_arm(2, limit=3.0)
    ball = Body('ball', 2, sphere(0.02), transform(np.eye(3), np.array([0, 0, 0.3])))
    model = CollisionModel(chain, [ball], floor_z=0.3 - 0.02 + depth)
    q = np.array([np.pi / 2, 0.0])
    assert 'the floor' in model.trouble(q)
    path = way_out(model, q, np.random.default_rng(0))
    heights = chain.positions(path, [0, 0, 0])[:, 2]
    assert np.all(np.diff(heights) > 0)
    assert model.trouble(path[-1]) == ''
    assert model.escape_trouble(path) == ''
    assert heights[-1] - heights[0] < 0.06


@pytest.mark.parametrize('seed', range(3))
def test_on_a_way_out_nothing_gets_worse(lwr, seed):
    print('seed', seed)
    rng = np.random.default_rng(seed)
    q = rng.uniform(lwr.chain.lower, lwr.chain.upper, (2000, 7))
    found = lwr.shortfalls(q)
    worst = np.full(len(q), np.inf)
    for short in found:
        worst[short.index] = min(worst[short.index], short.distance)
    # Within the margin, or a little in contact: where an arm comes to stand.
    starts = np.flatnonzero((worst > -0.02) & np.isfinite(worst))[:12]
    ways = 0
    for i in starts:
        path = way_out(lwr, q[i], rng)
        if path is None:
            continue
        ways += 1
        pairs = np.arange(len(lwr._pairs.inner))
        distances = lwr.pair_distances(path, pairs)
        short = lwr.shortfalls(path[:1])
        bad = np.isin(pairs, [each.pair for each in short])
        assert np.all(np.diff(distances[:, bad], axis=0) > -1e-3)
        assert lwr.trouble(path[-1]) == ''
        further_trouble = [s for s in lwr.shortfalls(path) if not bad[s.pair]]
        assert further_trouble == []
    assert ways >= 0.7 * len(starts)


def test_a_way_that_comes_nearer_is_refused():
    chain = planar_arm(2, limit=3.0)
    ball = Body('ball', 2, sphere(0.02), transform(np.eye(3), np.array([0, 0, 0.3])))
    model = CollisionModel(chain, [ball], floor_z=0.285)
    q = np.array([np.pi / 2, 0.0])
    down = np.array([q, q + np.array([0.05, 0]), q - [0.3, 0]])
    assert 'comes nearer' in model.escape_trouble(down)
    stays = np.array([q, q - [0.005, 0], q - [0.006, 0]])
    assert 'at the end of the way out' in model.escape_trouble(stays)
    assert model.escape_trouble(np.array([q, q - [0.3, 0]])) == ''


def test_shut_in_there_is_no_way_out():
    """Between two plates that both are too near, away from one is towards the other."""
    chain = planar_arm(1, limit=3.0)
    rod = Body('rod', 1, cylinder(0.02, 0.4), transform(np.eye(3), np.array([0, 0, 0.3])))
    plates = [obstacle(f'plate {s}', [s * 0.03, 0, 0.7], [0.01, 1, 0.4]) for s in (-1, 1)]
    model = CollisionModel(chain, [rod, *plates], floor_z=None)
    assert model.trouble([0.0])
    assert way_out(model, np.array([0.0]), np.random.default_rng(0)) is None
