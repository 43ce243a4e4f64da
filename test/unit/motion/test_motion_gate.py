# SPDX-License-Identifier: Apache-2.0
"""The gate: every single violation is refused alone, judged by SciPy's cubics sampled densely."""

import dataclasses

import numpy as np
import pytest
from gate_rig import judge
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline
from supervisor_rig import LIMITS

from remaster_ros.motion import motion_gate
from remaster_ros.motion.motion_gate import (
    ON_PATH_RAD,
    START_RAD,
    Cubic,
    MotionGate,
    MotionRefusedError,
    StartMovedError,
)
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.trajectory import HEADROOM, Trajectory, Waypoint

ZERO = np.zeros(2)


def path(*points):
    return FreePath(np.array(points, float))


@pytest.fixture
def judged(monkeypatch):
    """Return what the gate makes of given waypoints, planned by whomever."""

    def of(*waypoints, along=((0.0, 0.0), (1.0, 0.0)), start=ZERO, limits=LIMITS, speeds=None):
        return judge(monkeypatch, waypoints, along, start, limits, speeds)

    return of


GOOD = ((2.0, [0.5, 0.0], [0.25, 0.0]), (4.0, [0.8, 0.0], [0.0, 0.0]))


def test_what_keeps_every_limit_passes(judged):
    assert judged(*GOOD) == ''


def test_a_position_in_between_two_waypoints_outside_its_limits(judged):
    """Both waypoints are inside; the cubic goes beyond the limit between them."""
    waypoints = ((4.0, [0.98, 0.0], [0.3, 0.0]), (5.0, [0.99, 0.0], [-0.3, 0.0]),
                 (9.0, [0.8, 0.0], [0.0, 0.0]))  # fmt: skip
    curve = CubicHermiteSpline([4.0, 5.0], [0.98, 0.99], [0.3, -0.3])
    top = np.max(curve(np.linspace(4.0, 5.0, 10001)))
    assert top > 1.0
    assert judged(*waypoints) == (
        f'a would go to {np.rad2deg(top):.2f} deg; its limits less the margin are '
        '[-57.30, 57.30] deg'
    )
    down = [(t, np.negative(q), np.negative(v)) for t, q, v in waypoints]
    assert judged(*down, along=((0.0, 0.0), (-1.0, 0.0))).startswith('a would go to -60')
    # With wider limits the same passes: nothing else is wrong with it.
    wide = dataclasses.replace(LIMITS, upper=np.array([1.1, 2.0]))
    assert judged(*waypoints, along=((0.0, 0.0), (1.1, 0.0)), limits=wide) == ''


def test_the_margin_belongs_to_the_limits(judged):
    limits = dataclasses.replace(LIMITS, margin=0.25)
    assert judged(*GOOD, limits=limits) == (
        'a would go to 45.84 deg; its limits less the margin are [-42.97, 42.97] deg'
    )
    assert judged((4.0, [0.74, 0.0], [0.0, 0.0]), limits=limits) == ''


def test_an_arm_that_stands_outside_may_go_inwards_and_no_further_out(judged):
    start = [1.2, 0.0]
    along = ((1.2, 0.0), (0.5, 0.0))
    assert judged((4.0, [0.5, 0.0], [0.0, 0.0]), along=along, start=start) == ''
    # It begins with a swing further out.
    out = ((4.0, [1.2, 0.0], [-0.2, 0.0]), (8.0, [0.5, 0.0], [0.0, 0.0]))
    assert judged(*out, along=along, start=start).startswith('a would go to 7')


def test_beyond_one_limit_from_a_start_at_the_other(judged):
    beyond = judged(
        (9.0, [1.5, 0.0], [0.0, 0.0]), along=((-1.0, 0.0), (1.5, 0.0)), start=[-1.0, 0.0]
    )
    assert beyond.startswith('a would go to 85.94 deg')


def test_a_speed_in_between(judged):
    """Slow at both waypoints, and too fast in the middle of the cubic."""
    fast = ((1.5, [0.8, 0.0], [0.0, 0.0]),)
    assert judged(*fast) == 'a would have a speed of 0.800 rad/s; 0.500 are allowed'
    assert judged((2.41, [0.8, 0.0], [0.0, 0.0])) == ''
    assert judged((2.39, [0.8, 0.0], [0.0, 0.0])).startswith('a would have a speed of 0.502')
    # Half a thousandth above its limit is noise of the present state.
    assert judged((1.2 / (0.5 * 1.0005), [0.8, 0.0], [0.0, 0.0])) == ''
    # Of two joints the one is named that exceeds its own limit most: 160 and 120 %.
    both = judged((1.5, [0.8, 1.2], [0.0, 0.0]), along=((0.0, 0.0), (0.8, 1.2)))
    assert both == 'a would have a speed of 0.800 rad/s; 0.500 are allowed'
    # And at a waypoint.
    at = ((2.0, [0.5, 0.0], [0.6, 0.0]), (4.0, [0.8, 0.0], [0.0, 0.0]))
    assert 'a would have a speed of 0.600 rad/s' in judged(*at)
    # The other joint, backwards.
    other = ((1.0, [0.0, -1.0], [0.0, 0.0]),)
    along = ((0.0, 0.0), (0.0, -1.0))
    assert judged(*other, along=along).startswith('b would have a speed of 1.500 rad/s')


def test_an_acceleration(judged):
    """A short way in a short time: slow enough, and a jerk."""
    jerk = ((0.1, [0.02, 0.0], [0.0, 0.0]),)
    assert judged(*jerk) == 'a would have a acceleration of 12.000 rad/s2; 5.000 are allowed'
    assert judged((0.2, [0.02, 0.0], [0.0, 0.0])) == ''
    # At the end of a piece as well as at its start.
    end = ((0.2, [0.04, 0.0], [0.45, 0.0]), (4.0, [0.8, 0.0], [0.0, 0.0]))
    assert judged(*end) == ''
    end = ((0.2, [0.02, 0.0], [0.45, 0.0]), (4.0, [0.8, 0.0], [0.0, 0.0]))
    assert judged(*end) == 'a would have a acceleration of 6.000 rad/s2; 5.000 are allowed'


class Fastest:
    """Speeds of a point two metres from joint a, and what it was asked for."""

    def __init__(self):
        self.asked = []

    def fastest(self, q, velocity):
        self.asked.append((q, velocity))
        return 2.0 * np.abs(velocity[:, 0])


def test_the_speed_of_the_fastest_point(judged):
    limits = dataclasses.replace(LIMITS, tool_speed=0.4)
    # 0.3 rad/s in the middle of the cubic, where no waypoint is.
    assert judged((4.0, [0.8, 0.0], [0.0, 0.0]), limits=limits, speeds=Fastest()) == (
        'the fastest point of arm and tool would move at 0.600 m/s; 0.4 m/s are allowed'
    )
    assert judged((6.01, [0.8, 0.0], [0.0, 0.0]), limits=limits, speeds=Fastest()) == ''
    # Without such a limit nobody is asked.
    speeds = Fastest()
    assert judged((4.0, [0.8, 0.0], [0.0, 0.0]), speeds=speeds) == ''
    assert not speeds.asked
    assert judged((4.0, [0.8, 0.0], [0.0, 0.0]), limits=limits, speeds=None) == ''


@pytest.mark.parametrize('start', [0.0, -0.4])
def test_the_speed_of_the_fastest_point_is_looked_at_densely(judged, start):
    limits, speeds, end = dataclasses.replace(LIMITS, tool_speed=9.0), Fastest(), start + 0.8
    waypoint, along = (4.0, [end, 0.0], [0.0, 0.0]), ((start, 0.0), (end, 0.0))
    assert judged(waypoint, along=along, start=[start, 0.0], limits=limits, speeds=speeds) == ''
    ((q, velocity),) = speeds.asked
    curve = CubicHermiteSpline([0.0, 4.0], [[start, 0.0], [end, 0.0]], np.zeros((2, 2)))
    times = np.linspace(0.0, 4.0, len(q))
    np.testing.assert_allclose(q, curve(times), atol=1e-12)
    np.testing.assert_allclose(velocity, curve(times, 1), atol=1e-12)
    assert len(q) == 5 + 16


def test_the_fastest_point_may_exceed_its_limit_by_noise_and_no_more(judged):
    class Constant:
        def fastest(self, q, velocity):
            return np.full(len(q), self.speed)

    limits, speeds = dataclasses.replace(LIMITS, tool_speed=0.4), Constant()
    speeds.speed = 0.4 * (1.0 + motion_gate.TOLERANCE)
    assert judged(*GOOD, limits=limits, speeds=speeds) == ''
    speeds.speed *= 1.0 + 1e-9
    assert '0.4 m/s are allowed' in judged(*GOOD, limits=limits, speeds=speeds)
    speeds.speed = np.nan
    assert 'nan m/s' in judged(*GOOD, limits=limits, speeds=speeds)


@pytest.mark.parametrize('off', [2 * ON_PATH_RAD, 0.1])
def test_a_waypoint_off_the_path_that_was_checked(judged, off):
    waypoints = (GOOD[0], (4.0, [0.8, off], [0.0, 0.0]))
    assert judged(*waypoints) == f'a waypoint lies {off:.6f} rad off the path found free'
    assert judged(GOOD[0], (4.0, [0.8, ON_PATH_RAD / 2], [0.0, 0.0])) == ''
    just = ((2.0, [0.5, ON_PATH_RAD], [0.25, 0.0]), (4.0, [0.8, ON_PATH_RAD], [0.0, 0.0]))
    assert judged(*just) == ''
    # Beyond the end of the path is off it.
    assert 'off the path' in judged(*GOOD, along=((0.0, 0.0), (0.8 - off, 0.0)))


def test_a_corner_that_is_cut_between_two_waypoints(judged):
    """Each waypoint is on the path; the straight way between them is not."""
    along = ((0.0, 0.0), (0.4, 0.0), (0.4, 0.4))
    cut = ((4.0, [0.4, 0.4], [0.0, 0.0]),)
    assert judged(*cut, along=along) == (
        'the move leaves the path found free by 0.200000 rad between two waypoints'
    )
    # Only the first piece may be off by what the arm stands off the start.
    late = ((4.0, [0.399, 0.0], [0.0, 0.0]), (8.0, [0.4, 0.001], [0.0, 0.0]))
    assert judged(*late, along=((0.0, 0.0), (0.4, 0.0), (0.4, 0.002))) == (
        'the move leaves the path found free by 0.000500 rad between two waypoints'
    )
    corner = ((4.0, [0.4, 0.0], [0.0, 0.0]), (8.0, [0.4, 0.4], [0.0, 0.0]))
    assert judged(*corner, along=along) == ''


@pytest.mark.parametrize('times', [(2.0, 2.0), (2.0, 1.0), (0.0, 2.0), (-1.0, 2.0), (2.0, np.nan)])
def test_times_that_do_not_increase(judged, times):
    waypoints = [(time_s, q, v) for time_s, (_, q, v) in zip(times, GOOD)]
    assert judged(*waypoints) == 'the times of the move do not increase'


def test_what_is_not_finite(judged):
    for bad in (np.nan, np.inf):
        assert judged(GOOD[0], (4.0, [0.8, bad], [0.0, 0.0]))
        assert judged((2.0, [0.5, 0.0], [bad, 0.0]), GOOD[1])


def test_a_move_that_does_not_end_at_rest(judged):
    moving = ((2.0, [0.5, 0.0], [0.25, 0.0]), (4.0, [0.8, 0.0], [0.1, 0.0]))
    assert judged(*moving) == 'the move does not end at rest'


# What it plans itself


def test_the_start_is_where_the_arm_stands():
    gate = MotionGate(LIMITS)
    free = path([0.0, 0.0], [0.5, 0.5])
    admitted = gate.admit(free, np.array([0.0, 0.999 * START_RAD]))
    assert isinstance(admitted.trajectory, Trajectory)
    with pytest.raises(StartMovedError, match=r'the arm stands 0\.0020 rad from the start'):
        gate.admit(free, np.array([0.0, 1.001 * START_RAD]))
    with pytest.raises(StartMovedError, match='nan'):
        gate.admit(free, np.array([0.0, np.nan]))
    assert gate.refused == 2
    gate.admit(free, np.array([0.0, START_RAD]))
    with pytest.raises(StartMovedError, match=r'the arm stands 0\.1000 rad from the start'):
        gate.admit(path([0.2, 0.1], [0.5, 0.5]), np.array([0.3, 0.1]))


def test_a_refused_move_leaves_the_former_to_be_stopped():
    gate = MotionGate(LIMITS)
    gate.admit(path([0.0, 0.0], [0.5, 0.5]), ZERO)
    with pytest.raises(MotionRefusedError):
        gate.admit(path([0.0, 0.0], [5.0, 0.5]), ZERO)
    (stop,) = gate.stop(0.8, 0.8).waypoints
    assert np.all(stop.q < 0.5)


def test_a_target_outside_is_refused_in_words():
    gate = MotionGate(LIMITS)
    with pytest.raises(MotionRefusedError, match=r'b would go to 1[234]\d\.\d\d deg'):
        gate.admit(path([0.0, 0.0], [0.5, 2.5]), ZERO)
    with pytest.raises(MotionRefusedError):
        gate.admit(path([0.0, 0.0], [0.5, np.nan]), ZERO)


def test_limits_may_be_replaced_between_two_moves():
    gate = MotionGate(LIMITS)
    free = path([0.0, 0.0], [0.8, 0.0])
    fast = gate.admit(free, ZERO)
    gate.limits = dataclasses.replace(LIMITS, velocity=LIMITS.velocity / 2)
    slow = gate.admit(free, ZERO)
    assert slow.waypoints[-1].time_s > 1.5 * fast.waypoints[-1].time_s


def test_a_way_out_is_gone_slowly():
    gate = MotionGate(dataclasses.replace(LIMITS, tool_speed=0.25), Fastest())
    out = FreePath(np.array([[0.0, 0.0], [0.5, 0.0]]), (1.0,), way_out=True)
    admitted = gate.admit(out, ZERO)
    speeds = [np.max(np.abs(p.velocity)) for p in admitted.waypoints]
    # 0.05 m/s at a metre and half a radian; twice as far out the gate sees to it.
    assert max(speeds) == pytest.approx(HEADROOM * 0.025)
    quick = FreePath(out.points, (0.5,), way_out=True)
    with pytest.raises(MotionRefusedError, match=r'0\.05 m/s are allowed'):
        gate.admit(quick, ZERO)
    # A tenth of the joint speeds where no point limits it, and never more than anywhere else.
    free = MotionGate(LIMITS).admit(FreePath(out.points, way_out=True), ZERO)
    assert max(np.max(np.abs(p.velocity)) for p in free.waypoints) == pytest.approx(
        HEADROOM * 0.05
    )
    careful = MotionGate(dataclasses.replace(LIMITS, tool_speed=0.01), Fastest())
    slow = careful.admit(out, ZERO)
    assert max(np.max(np.abs(p.velocity)) for p in slow.waypoints) == pytest.approx(
        HEADROOM * 0.005
    )


def test_a_way_out_keeps_limits_margin_and_accelerations():
    limits = dataclasses.replace(LIMITS, margin=0.25, acceleration=np.array([0.1, 0.1]))
    out = FreePath(np.array([[0.0, 0.0], [0.8, 0.0]]), way_out=True)
    with pytest.raises(MotionRefusedError, match=r'a would go to 45\.\d\d deg'):
        MotionGate(limits).admit(out, ZERO)
    slow = FreePath(np.array([[0.0, 0.0], [0.5, 0.0]]), way_out=True)
    admitted = MotionGate(limits).admit(slow, ZERO)
    assert max(np.max(np.abs(p.velocity)) for p in admitted.waypoints) <= 0.05 * 0.5


corner = st.tuples(st.floats(-1.1, 1.1), st.floats(-2.2, 2.2)).map(np.array)


@settings(max_examples=150)
@given(
    corners=st.lists(corner, min_size=2, max_size=4),
    off=st.tuples(st.floats(-0.002, 0.002), st.floats(-0.002, 0.002)),
    acceleration=st.floats(0.5, 10.0),
)
def test_what_is_admitted_is_allowed_by_another_judge(corners, off, acceleration):
    """SciPy's cubics at 2001 times: positions, speeds, accelerations; refused only if outside."""
    limits = dataclasses.replace(LIMITS, acceleration=np.full(2, acceleration))
    q = corners[0] + np.array(off)
    gate = MotionGate(limits)
    low, high = np.minimum(limits.lower, q), np.maximum(limits.upper, q)
    inside = all(np.all((c >= low) & (c <= high)) for c in corners)
    try:
        admitted = gate.admit(FreePath(np.array(corners)), q)
    except MotionRefusedError as error:
        refusal = str(error)
    else:
        refusal = ''
    if refusal:
        assert not inside or 'stands' in refusal or 'acceleration' in refusal
        return
    points = admitted.waypoints
    curve = CubicHermiteSpline(
        [0.0, *(p.time_s for p in points)],
        [q, *(p.q for p in points)],
        [ZERO, *(p.velocity for p in points)],
    )
    t = np.linspace(0.0, points[-1].time_s, 2001)
    assert np.all((curve(t) >= low - 1e-8) & (curve(t) <= high + 1e-8))
    assert np.all(np.abs(curve(t, 1)) <= limits.velocity * 1.001)
    assert np.all(np.abs(curve(t, 2)) <= limits.acceleration * 1.001 + 1e-9)
    np.testing.assert_allclose(curve(t[-1]), corners[-1], atol=1e-9)


# Cubics


numbers = st.floats(-3.0, 3.0, allow_subnormal=False)


@settings(max_examples=300)
@given(
    q=st.tuples(numbers, numbers),
    v=st.tuples(numbers, numbers),
    start=st.floats(0.0, 10.0),
    duration=st.floats(0.01, 10.0),
)
def test_extremes_of_cubics_against_dense_samples(q, v, start, duration):
    before = Waypoint(start, np.array(q[:1]), np.array(v[:1]))
    after = Waypoint(start + duration, np.array(q[1:]), np.array(v[1:]))
    piece = Cubic.between(before, after)
    assert piece.duration_s == pytest.approx(duration)
    curve = CubicHermiteSpline([0.0, piece.duration_s], q, v)
    t = np.linspace(0.0, piece.duration_s, 2001)
    np.testing.assert_allclose(piece.at(t)[:, 0], curve(t), atol=1e-8)
    np.testing.assert_allclose(piece.velocity(t)[:, 0], curve(t, 1), atol=1e-6)
    np.testing.assert_allclose(piece.at(float(t[7])), [curve(t[7])], atol=1e-8)
    # The sampled extreme lies within half a step of the true one.
    step = t[1]
    (low,), (high,) = piece.range()
    bend = float(piece.largest_acceleration()[0])
    for mine, sampled in ((-low, np.max(-curve(t))), (high, np.max(curve(t)))):
        assert sampled - 1e-8 <= mine <= sampled + bend * step**2 + 1e-8
    fastest = float(piece.largest_speed()[0])
    sampled = np.max(np.abs(curve(t, 1)))
    third = 6 * abs(float(piece.coefficients[3, 0]))
    assert sampled - 1e-6 <= fastest <= sampled + third * step**2 + 1e-6
    hardest = np.max(np.abs(curve(np.array([0.0, piece.duration_s]), 2)))
    assert bend == pytest.approx(hardest, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    ('v', 'low', 'high'),
    [
        # A parabola, which has no cubic term; a straight line; a turn at either side.
        ((1.0, -1.0), 0.0, 0.25),
        ((0.0, 0.0), 0.0, 0.0),
        ((-1.0, 1.0), -0.25, 0.0),
    ],
)
def test_cubics_that_are_less_than_cubic(v, low, high):
    piece = Cubic.between(
        Waypoint(3.0, np.zeros(1), np.array(v[:1])), Waypoint(4.0, np.zeros(1), np.array(v[1:]))
    )
    least, most = piece.range()
    assert (least[0], most[0]) == (low, high)
    assert piece.largest_speed()[0] == abs(v[0])
    assert piece.largest_acceleration()[0] == 2 * abs(v[0])


@pytest.mark.parametrize('speed', [3e-6, 1e-300, 0.0])
def test_a_move_that_takes_days_is_refused_before_it_is_a_message(speed):
    """A limit of speed of next to nothing: its time fits no message."""
    limits = dataclasses.replace(LIMITS, velocity=np.full(2, speed))
    gate = MotionGate(limits)
    why = 'longer than 24 h' if speed > 1e-9 else 'longer than 24 h|would have a speed of'
    with np.errstate(divide='ignore'):
        with pytest.raises(MotionRefusedError, match=why):
            gate.admit(path(ZERO, [0.3, 0.3]), ZERO)
        with pytest.raises(MotionRefusedError, match='longer than 24 h'):
            gate.admit_probe(path(ZERO, [1e-6, 1e-6]), ZERO, np.ones(2, bool))
    assert gate.refused == 2
