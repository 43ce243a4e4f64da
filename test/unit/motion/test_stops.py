# SPDX-License-Identifier: Apache-2.0
"""Stops: never back, never faster, never off the line or beyond its end, not too hard."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import MotionGate
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.stopping import (
    END_OF_STOP_S,
    LONGEST_S,
    STOP_S,
    TRIED,
    _Stretch,
    stop_on_line,
)
from remaster_ros.motion.trajectory import HEADROOM, RAMP_S, Line

LIMITS = MotionLimits(
    ('a', 'b', 'c'),
    np.array([-3.0, -3.0, -3.0]),
    np.array([3.0, 3.0, 3.0]),
    np.array([0.5, 1.0, 2.0]),
    np.array([5.0, 5.0, 5.0]),
)


BACK = 0.28
"""In the last moments of a line a stop may go back so fast, as a share of the cruising speed."""
LAST_S = 0.85
"""These moments, s."""


def judge(line, stop, time_s, high_s, limits=LIMITS):
    """Check the cubic from where a line is at a time to the stop's waypoint; SciPy judges."""
    share, rate = line.share(time_s)
    q, v = line.start + share * line.way, rate * line.way
    assert stop.time_s >= END_OF_STOP_S
    np.testing.assert_array_equal(stop.velocity, 0.0)
    curve = CubicHermiteSpline([0.0, stop.time_s], [q, stop.q], [v, np.zeros_like(v)])
    t = np.linspace(0.0, stop.time_s, 101)
    length = float(np.sqrt(line.way @ line.way))
    way = line.way / max(length, 1e-300)
    along, speed = (curve(t) - line.start) @ way, curve(t, 1) @ way
    cruise = line.rate * length
    # Not back, not faster than the line is cruised, on the line and within it.
    back = BACK if line.duration_s - high_s < LAST_S else 0.0
    assert speed.min() >= -max(back, 1e-3) * cruise - 1e-7
    assert speed.max() <= cruise * (1 + 1e-9) + 1e-9
    np.testing.assert_allclose(curve(t), line.start + along[:, None] * way, atol=1e-9)
    assert along.min() >= -1e-9
    assert along.max() <= length + 1e-6
    assert np.max(np.abs(curve(t, 2)) / limits.acceleration) <= HEADROOM + 0.01


angles = st.integers(-3_000_000, 3_000_000).map(lambda n: n * 1e-6)
configurations = st.tuples(angles, angles, angles).map(np.array)


@settings(max_examples=100)
@given(
    start=configurations,
    end=configurations,
    moment=st.floats(0.0, 1.0),
    width=st.floats(0.0, 0.5),
    inside=st.lists(st.floats(0.0, 1.0), max_size=4),
)
def test_a_stop_from_anywhere_in_the_window(start, end, moment, width, inside):
    """The arm, and the reference of an open-loop controller, may be at any time of the window."""
    line = Line.within(LIMITS, start, end)
    high_s = moment * line.duration_s
    low_s = max(high_s - width, 0.0)
    stop = stop_on_line(line, low_s, high_s, LIMITS)
    for share in (0.0, 1.0, *inside):
        judge(line, stop, low_s + share * (high_s - low_s), high_s)
    # It ends soon: nobody waits for a stop that takes as long as the move.
    assert stop.time_s <= max(STOP_S, 3.3 * width) * 4 + 2 * RAMP_S


@settings(max_examples=100)
@given(
    end=configurations,
    acceleration=st.floats(0.3, 10.0),
    moment=st.floats(0.0, 1.0),
    width=st.floats(0.0, 0.5),
)
def test_a_careful_acceleration_makes_a_stop_longer(end, acceleration, moment, width):
    limits = dataclasses.replace(LIMITS, acceleration=np.full(3, acceleration))
    line = Line.within(limits, np.zeros(3), end)
    high_s = moment * line.duration_s
    low_s = max(high_s - width, 0.0)
    stop = stop_on_line(line, low_s, high_s, limits)
    for time_s in (low_s, high_s):
        judge(line, stop, time_s, high_s, limits)


@pytest.mark.parametrize('way', [1e-7, 1e-6, 1e-3, 0.1, 1.0, 5.0])
@pytest.mark.parametrize('moment', [0.0, 1e-9, 0.05, 0.5, 0.95, 1.0 - 1e-9, 1.0])
def test_stops_at_the_very_start_and_end_of_any_way(way, moment):
    line = Line.within(LIMITS, np.zeros(3), np.array([way, -way / 2, 0.0]))
    time_s = moment * line.duration_s
    stop = stop_on_line(line, time_s, time_s, LIMITS)
    judge(line, stop, time_s, time_s)


def test_a_stop_in_the_cruise_is_short_and_even():
    """Its time is the shortest, and the speed falls evenly: half of rate times time remains."""
    line = Line.within(LIMITS, np.zeros(3), np.array([2.0, 0.0, 0.0]))
    middle = line.duration_s / 2
    stop = stop_on_line(line, middle, middle, LIMITS)
    share, rate = line.share(middle)
    assert stop.time_s == STOP_S
    np.testing.assert_allclose(stop.q, line.start + (share + 0.5 * rate * STOP_S) * line.way)
    curve = CubicHermiteSpline(
        [0, stop.time_s], [share * line.way, stop.q], [rate * line.way, np.zeros(3)]
    )
    t = np.linspace(0, stop.time_s, 21)
    np.testing.assert_allclose(curve(t, 1), np.outer(1 - t / STOP_S, rate * line.way), atol=1e-12)


def test_a_wide_window_makes_a_stop_longer():
    line = Line.within(LIMITS, np.zeros(3), np.array([2.0, 0.0, 0.0]))
    stop = stop_on_line(line, 1.5, 1.7, LIMITS)
    assert 3 * 0.2 <= stop.time_s <= 3.3 * 0.2


def test_in_the_last_ramp_the_end_is_kept():
    line = Line.within(LIMITS, np.zeros(3), np.array([2.0, 1.0, 0.0]))
    time_s = line.duration_s - RAMP_S / 2
    stop = stop_on_line(line, time_s, time_s, LIMITS)
    np.testing.assert_allclose(stop.q, line.end)
    assert END_OF_STOP_S <= stop.time_s <= RAMP_S


def test_a_stop_at_the_end_stays_there():
    line = Line.within(LIMITS, np.zeros(3), np.array([2.0, 1.0, 0.0]))
    stop = stop_on_line(line, line.duration_s, line.duration_s, LIMITS)
    np.testing.assert_allclose(stop.q, line.end)
    assert stop.time_s == STOP_S


@pytest.mark.parametrize(('low', 'high'), [(1.2, 0.0), (0.3, 0.0), (0.02, 0.0), (0.9, 0.05)])
def test_a_stretch_up_to_the_end_has_the_time_that_the_slowest_needs(low, high):
    """Not faster than the line from its first place, no longer than that takes."""
    line = Line.within(LIMITS, np.zeros(3), np.array([2.0, 1.0, 0.0]))
    low_s, high_s = line.duration_s - low, line.duration_s - high
    stop = stop_on_line(line, low_s, high_s, LIMITS)
    share, _ = line.share(low_s)
    needed = max(low, 1.5 * (1.0 - share) / line.rate, END_OF_STOP_S)
    assert stop.time_s == pytest.approx(needed, rel=1e-12)
    for time_s in np.linspace(low_s, high_s, 7):
        share, rate = line.share(time_s)
        curve = CubicHermiteSpline([0.0, stop.time_s], [share, stop.q[0] / 2.0], [rate, 0.0])
        t = np.linspace(0.0, stop.time_s, 101)
        assert curve(t, 1).max() <= line.rate * (1 + 1e-9)
        assert curve(t).max() <= 1.0 + 1e-8


def test_how_hard_a_stop_brakes_against_a_spline():
    rng = np.random.default_rng(6)
    for _ in range(100):
        bound = rng.uniform(1.0, 9.0, 3)
        limits = dataclasses.replace(LIMITS, acceleration=bound)
        line = Line.within(limits, np.zeros(3), rng.uniform(-2.0, 2.0, 3))
        low_s, high_s = np.sort(rng.uniform(0.0, line.duration_s, 2))
        stretch = _Stretch(line, low_s, high_s, limits)
        time, end = rng.uniform(0.1, 2.0), rng.uniform(0.0, 1.2)
        curves = CubicHermiteSpline(
            [0.0, time],
            [stretch._x, np.full_like(stretch._x, end)],
            [stretch._v, np.zeros_like(stretch._v)],
        )
        largest = np.max(np.abs(curves(np.array([0.0, time]), 2)))
        expected = largest * np.max(np.abs(line.way) / bound)
        assert stretch._acceleration(time, end) == pytest.approx(expected)


def test_stops_are_nearly_as_short_as_they_can_be():
    """Beside a search over 21 ends at each time: one in 24 is 5 % longer, none by a quarter."""
    rng, ratios = np.random.default_rng(7), []
    for _ in range(200):
        bound = np.full(3, 10.0 ** rng.uniform(-0.5, 1.0))
        limits = dataclasses.replace(LIMITS, acceleration=bound)
        line = Line.within(limits, np.zeros(3), rng.uniform(-2.0, 2.0, 3))
        high_s = rng.uniform(0.0, 0.9) * line.duration_s
        low_s = max(high_s - rng.uniform(0.0, 0.5), 0.0)
        stretch = _Stretch(line, low_s, high_s, limits)
        x, v = stretch._x, stretch._v
        for time in np.geomspace(STOP_S, LONGEST_S, TRIED):
            ends = np.linspace(
                np.max(x + v * time / 3), min(np.min(x + line.rate * time * 2 / 3), 1.0), 21
            )
            if ends[0] <= ends[-1] and any(
                stretch._acceleration(time, end) <= HEADROOM for end in ends
            ):
                stop = stop_on_line(line, low_s, high_s, limits)
                ratios.append(stop.time_s / time)
                break
    print(len(ratios), max(ratios), np.mean(np.array(ratios) > 1.05))
    assert len(ratios) > 150
    assert max(ratios) < 1.26
    assert np.mean(np.array(ratios) > 1.05) < 0.1


# Through the gate: trajectories of several lines


def admitted(points, limits=LIMITS):
    gate = MotionGate(limits)
    return gate, gate.admit(FreePath(np.asarray(points, float)), np.asarray(points[0], float))


@settings(max_examples=100)
@given(
    corners=st.lists(configurations, min_size=2, max_size=4),
    moment=st.floats(0.0, 1.1),
    lag=st.floats(0.0, 0.45),
    inside=st.floats(0.0, 1.0),
)
def test_a_stop_of_several_lines_stays_on_the_line_under_way(corners, moment, lag, inside):
    """With rests between the lines, and from an arm that lags: it is on no line but this one."""
    gate, move = admitted(corners)
    trajectory = move.trajectory
    high_s = moment * trajectory.duration_s
    low_s = high_s - lag
    stop = gate.stop(low_s, high_s)
    assert stop.trajectory is None
    (waypoint,) = stop.waypoints
    index, since_s = trajectory.line_at(high_s)
    line = trajectory.lines[index]
    for time_s in (low_s, low_s + inside * lag, high_s):
        q, _ = trajectory.at(time_s)
        # An arm that lags still stands in the rest before, which is where this line begins.
        assert line.project(q)[1] <= 1e-9
        judge(line, waypoint, time_s - trajectory.starts_s[index], since_s)


def test_a_stop_in_a_rest_stays_at_the_corner():
    gate, move = admitted([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    line = move.trajectory.lines[0]
    (stop,) = gate.stop(line.duration_s + 0.2, line.duration_s + 0.3).waypoints
    np.testing.assert_allclose(stop.q, [1.0, 0.0, 0.0])
    assert stop.time_s == STOP_S


def test_only_what_is_under_way_can_be_stopped_and_once():
    gate = MotionGate(LIMITS)
    with pytest.raises(LookupError, match=r'^no move is under way$'):
        gate.stop(0.0, 0.0)
    gate, _ = admitted([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    gate.stop(1.0, 1.0)
    with pytest.raises(LookupError, match=r'^no move is under way$'):
        gate.stop(1.0, 1.0)


def test_a_stop_keeps_the_accelerations_that_its_move_was_admitted_with():
    gate, _ = admitted([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    gate.limits = dataclasses.replace(LIMITS, acceleration=np.full(3, 0.01))
    (stop,) = gate.stop(2.0, 2.0).waypoints
    assert stop.time_s == STOP_S
