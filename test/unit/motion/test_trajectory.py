# SPDX-License-Identifier: Apache-2.0
"""Lines and trajectories: within speeds and accelerations, exactly on the line, to rest."""

import dataclasses

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from supervisor_rig import LIMITS

from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.trajectory import (
    HEADROOM,
    NO_CRUISE,
    RAMP_S,
    REST_S,
    STOPPABLE,
    Line,
    Trajectory,
    plan_trajectory,
)


def curve_of(start, points):
    """Cubics through the waypoints, SciPy's as judge."""
    times = [0.0, *(point.time_s for point in points)]
    q = [start, *(point.q for point in points)]
    v = [np.zeros_like(start), *(point.velocity for point in points)]
    return CubicHermiteSpline(times, q, v)


# Lines


@pytest.mark.parametrize(('share', 'count'), [(1.0, 2), (NO_CRUISE, 2), (1.0 - 2.0**-19, 3)])
def test_two_waypoints_are_never_at_the_same_time(share, count):
    points = Line(np.zeros(2), np.ones(2), share / RAMP_S).waypoints()
    assert len(points) == count
    assert np.all(np.diff([point.time_s for point in points]) > 0.0)


def test_no_joint_exceeds_its_velocity_and_the_slowest_uses_it():
    rng = np.random.default_rng(3)
    short = 0
    for _ in range(200):
        start, end = rng.uniform(-1, 1, (2, 2))
        if rng.random() < 0.3:
            end = start + rng.uniform(-0.02, 0.02, 2)
        line = Line.within(LIMITS, start, end)
        points = line.waypoints()
        assert points[-1].time_s == pytest.approx(line.duration_s)
        t = np.linspace(0, line.duration_s, 2001)
        curve = curve_of(start, points)
        q, v, a = curve(t), curve(t, 1), curve(t, 2)
        share = np.max(np.abs(v) / LIMITS.velocity)
        assert share <= HEADROOM + 1e-9
        # A way longer than the two ramps is cruised at the limit; a shorter one has two ramps.
        is_short = np.all(np.abs(end - start) < HEADROOM * LIMITS.velocity * RAMP_S)
        short += is_short
        assert len(points) == (2 if is_short else 3)
        assert is_short or share > HEADROOM - 1e-9
        assert not is_short or line.duration_s == pytest.approx(2 * RAMP_S)
        np.testing.assert_allclose(q[-1], end, atol=1e-12)
        np.testing.assert_allclose(v[-1], 0, atol=1e-12)
        assert np.max(np.abs(a)) <= np.max(np.abs(v)) / RAMP_S * (1 + 1e-6)
        # Between the two ends and on the straight line between them.
        along = (q - start) @ (end - start) / np.sum((end - start) ** 2)
        assert along.min() >= -1e-9
        assert along.max() <= 1 + 1e-9
        np.testing.assert_allclose(q, start + along[:, None] * (end - start), atol=1e-9)
        # `share` gives the same as the judge, and `time_s` is its inverse.
        t, q, v = t[::29], q[::29], v[::29]
        mine = np.array([line.share(time) for time in t])
        np.testing.assert_allclose(start + mine[:, :1] * line.way, q, atol=1e-9)
        np.testing.assert_allclose(mine[:, 1:] * line.way, v, atol=1e-9)
        back = [line.time_s(value) for value in mine[:, 0]]
        np.testing.assert_allclose(back, t, atol=2e-6)
    assert 20 < short < 150


@pytest.mark.parametrize('acceleration', [0.2, 0.5, 4.0])
def test_what_the_joints_may_accelerate_bounds_the_speed(acceleration):
    """The ramp is of a given length: a careful acceleration makes the cruise slower."""
    limits = dataclasses.replace(LIMITS, acceleration=np.array([acceleration, 9.0]))
    line = Line.within(limits, np.zeros(2), np.array([1.0, 1.0]))
    curve = curve_of(line.start, line.waypoints())
    t = np.linspace(0, line.duration_s, 4001)
    largest = np.max(np.abs(curve(t, 2)), axis=0)
    assert largest[0] == pytest.approx(HEADROOM * min(STOPPABLE * acceleration, 1.0))
    assert np.max(np.abs(curve(t, 1))[:, 0]) <= 0.5


def test_the_fastest_point_bounds_the_speed():
    limits = dataclasses.replace(LIMITS, tool_speed=0.1)
    line = Line.within(limits, np.zeros(2), np.array([0.5, 0.5]), peak_m=2.0)
    assert line.rate == pytest.approx(HEADROOM * 0.05)
    # Where it would be slower anyhow, nothing changes.
    slow = Line.within(limits, np.zeros(2), np.array([0.5, 0.5]), peak_m=1e-3)
    free = Line.within(LIMITS, np.zeros(2), np.array([0.5, 0.5])).rate
    assert slow.rate == Line.within(limits, np.zeros(2), np.array([0.5, 0.5])).rate == free


def test_a_short_way_has_two_ramps_and_no_more():
    line = Line.within(LIMITS, np.zeros(2), np.array([1e-6, 0.0]))
    assert line.rate == 1.0 / RAMP_S
    assert line.cruise_s == 0.0
    assert line.duration_s == 2 * RAMP_S


def test_before_and_after_a_line_the_arm_stands_at_its_ends():
    line = Line(np.array([0.0]), np.array([2.0]), 0.5)
    for time_s, expected in ((-1.0, 0.0), (0.0, 0.0), (line.duration_s, 1.0), (9.0, 1.0)):
        assert line.share(time_s) == (expected, 0.0)
    assert line.time_s(-1.0) == line.time_s(0.0) == 0.0
    assert line.time_s(2.0) == line.time_s(1.0) == line.duration_s


def test_the_share_of_the_way_by_hand():
    """Half the way a second: 1/16 and 1/8 in the ramp up, and the same in the ramp down."""
    line = Line(np.array([0.0]), np.array([2.0]), 0.5)
    assert line.duration_s == 2.5
    assert line.cruise_s == 1.5
    assert line.share(0.25) == (0.03125, 0.25)
    assert line.share(0.5) == (0.125, 0.5)
    assert line.share(1.0) == (0.375, 0.5)
    assert line.share(2.0) == (0.875, 0.5)
    assert line.share(2.25) == (0.96875, 0.25)
    for share, time_s in ((0.03125, 0.25), (0.125, 0.5), (0.375, 1.0), (0.875, 2.0)):
        assert line.time_s(share) == time_s
    assert line.time_s(0.96875) == 2.25


def test_no_way_is_no_motion():
    line = Line.within(LIMITS, np.ones(2), np.ones(2))
    assert line.duration_s == pytest.approx(2 * RAMP_S)
    curve, t = curve_of(np.ones(2), line.waypoints()), np.linspace(0, line.duration_s, 11)
    np.testing.assert_array_equal(curve(t), 1.0)
    np.testing.assert_array_equal(curve(t, 1), 0.0)
    # Nothing is left of it, wherever the arm is.
    assert line.project(np.array([1.0, 1.5])) == (1.0, 0.5)


def test_where_a_configuration_lies_beside_a_line():
    line = Line(np.zeros(2), np.array([2.0, 0.0]), 0.5)
    assert line.project(np.array([0.5, 0.25])) == (0.25, 0.25)
    assert line.project(np.array([-0.5, 0.25])) == (0.0, 0.5)
    assert line.project(np.array([2.125, -0.25])) == (1.0, 0.25)


# Trajectories


def test_a_polyline_is_left_to_rest_at_each_corner():
    points = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, -1.0], [0.0, 0.5]])
    trajectory = plan_trajectory(LIMITS, points)
    np.testing.assert_array_equal(trajectory.points, points)
    np.testing.assert_array_equal(trajectory.start, points[0])
    np.testing.assert_array_equal(trajectory.end, points[-1])
    durations = [line.duration_s for line in trajectory.lines]
    expected = [0.0, durations[0] + REST_S, durations[0] + durations[1] + 2 * REST_S]
    np.testing.assert_allclose(trajectory.starts_s, expected)
    assert trajectory.duration_s == pytest.approx(sum(durations) + 2 * REST_S)
    waypoints = trajectory.waypoints()
    times = [point.time_s for point in waypoints]
    assert np.all(np.diff([0.0, *times]) > 0.0)
    assert times[-1] == pytest.approx(trajectory.duration_s)
    curve = curve_of(points[0], waypoints)
    for corner, begun_s, duration_s in zip(points[1:-1], trajectory.starts_s, durations):
        rest_times = np.linspace(begun_s + duration_s, begun_s + duration_s + REST_S, 11)
        np.testing.assert_allclose(curve(rest_times), np.broadcast_to(corner, (11, 2)), atol=1e-12)
        np.testing.assert_allclose(curve(rest_times, 1), 0.0, atol=1e-12)
    # `at` gives the same as the judge, rests included; before and after it stands at its ends.
    for time_s in np.linspace(0.0, trajectory.duration_s, 501):
        q, velocity = trajectory.at(time_s)
        np.testing.assert_allclose(q, curve(time_s), atol=1e-9)
        np.testing.assert_allclose(velocity, curve(time_s, 1), atol=1e-9)
    for time_s, place in ((-1.0, points[0]), (trajectory.duration_s + 9.0, points[-1])):
        q, velocity = trajectory.at(time_s)
        np.testing.assert_allclose(q, place, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(velocity, 0.0)


def test_which_line_is_under_way():
    points = np.array([[0.0], [0.5], [0.0]])
    limits = MotionLimits(
        ('a',), np.array([-1.0]), np.array([1.0]), np.array([0.5]), np.array([5.0])
    )
    trajectory = plan_trajectory(limits, points)
    second = trajectory.starts_s[1]
    assert trajectory.line_at(-0.5) == (0, -0.5)
    assert trajectory.line_at(0.0) == (0, 0.0)
    assert trajectory.line_at(second - 0.125) == (0, second - 0.125)
    assert trajectory.line_at(second) == (1, 0.0)
    assert trajectory.line_at(second + 100.0) == (1, pytest.approx(100.0))


def test_each_line_keeps_the_speed_of_its_own_fastest_point():
    limits = dataclasses.replace(LIMITS, tool_speed=0.1)
    points = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.0]])
    trajectory = plan_trajectory(limits, points, (2.0, 0.5))
    assert trajectory.lines[0].rate == pytest.approx(HEADROOM * 0.05)
    assert trajectory.lines[1].rate == pytest.approx(HEADROOM * 0.2)
    free = plan_trajectory(limits, points)
    assert [line.rate for line in free.lines] == pytest.approx([HEADROOM * 1.0] * 2)
    with pytest.raises(ValueError, match='shorter'):
        plan_trajectory(limits, points, (2.0,))


def test_a_trajectory_of_one_line_begins_at_once():
    line = Line(np.zeros(1), np.ones(1), 0.5)
    trajectory = Trajectory((line,))
    assert trajectory.starts_s == (0.0,)
    assert [p.time_s for p in trajectory.waypoints()] == [p.time_s for p in line.waypoints()]
