# SPDX-License-Identifier: Apache-2.0
"""Times of motion are those of the bridge's trajectories; orders by them are nearly the best."""

from itertools import pairwise, permutations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from remaster_ros.motion.trajectory import plan_trajectory
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.planning.visit_order import fastest_order
from remaster_ros.session.cells.workcell import read_cell

CELL = read_cell('demo')
MODEL = CELL.planning_scene(CELL.chain()).model


def joints(n, seed):
    chain = MODEL.chain
    return np.random.default_rng(seed).uniform(0.8 * chain.lower, 0.8 * chain.upper, (n, 7))


def test_straight_lines_take_as_long_as_their_trajectories():
    travel = TravelTime.of(MODEL, acceleration=3.0)
    q = joints(12, 1)
    q[1] = q[0] + 1e-4
    q[2] = q[0]
    times = travel.straight(q[0], q)
    exact = [plan_trajectory(travel.limits, np.array([q[0], end])).duration_s for end in q]
    np.testing.assert_allclose(times, exact, rtol=1e-12)


def test_a_limit_of_the_fastest_point_makes_lines_slower_and_is_kept():
    free, slow = TravelTime.of(MODEL), TravelTime.of(MODEL, tool_speed=0.25)
    q = joints(12, 2)
    times = slow.straight(q[0], q[1:])
    assert np.all(times >= free.straight(q[0], q[1:]))
    for end, time in zip(q[1:], times):
        trajectory, speed = slow.trajectory(np.array([q[0], end]))
        # Choices look at fewer points of a line than the bridge.
        np.testing.assert_allclose(time, trajectory.duration_s, rtol=0.1)
        assert speed <= 0.25
    assert max(free.trajectory(np.array([q[0], end]))[1] for end in q[1:]) > 0.25


def test_times_between_are_symmetric_and_a_polyline_rests_at_its_corners():
    travel = TravelTime.of(MODEL)
    q = joints(5, 3)
    between = travel.between(q)
    np.testing.assert_allclose(between, between.T)
    lines = sum(travel.along(np.array(line)) for line in pairwise(q))
    assert travel.along(q) > lines + 1.0


def length(times, order):
    return sum(times[a, b] for a, b in pairwise([0, *order]))


@given(st.integers(1, 7), st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_every_place_is_visited_once_and_no_small_tour_is_much_better(n, seed):
    points = np.random.default_rng(seed).random((n, 3))
    times = np.linalg.norm(points[:, None] - points, axis=-1)
    order = fastest_order(times)
    assert sorted(order) == list(range(1, n))
    best = min(length(times, other) for other in permutations(range(1, n)))
    assert length(times, order) <= 1.25 * best + 1e-12


def test_it_beats_the_nearest_first():
    gains = []
    for seed in range(20):
        points = np.random.default_rng(seed).random((60, 3))
        times = np.linalg.norm(points[:, None] - points, axis=-1)
        nearest, remaining_points = [0], set(range(1, 60))
        while remaining_points:
            nearest.append(min(remaining_points, key=lambda other: times[nearest[-1], other]))
            remaining_points.remove(nearest[-1])
        order = fastest_order(times)
        gains.append(length(times, order) / length(times, nearest[1:]))
    assert max(gains) <= 1.0
    assert np.mean(gains) < 0.93
