"""Motion limits: nothing outside, nothing too fast, and a stop that stops."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from remaster_ros.core.motion import BRAKE_S, NO_CRUISE, RAMP_S, MotionLimits, Move

LIMITS = MotionLimits(
    ('a', 'b'), np.array([-1.0, -2.0]), np.array([1.0, 2.0]), np.array([0.5, 1.0])
)


class Arm(SimpleNamespace):
    """What `MotionLimits.of` asks a chain for."""

    def __len__(self):
        return len(self.joint_names)


CHAIN = Arm(
    joint_names=('a', 'b', 'c'),
    lower=np.array([-1.0, -2.0, -np.inf]),
    upper=np.array([1.0, 2.0, np.inf]),
    velocity_limits=np.array([2.0, 4.0, np.inf]),
)


def test_the_limits_of_a_chain_and_a_share_of_its_speed():
    limits = MotionLimits.of(CHAIN, 0.3)
    assert limits.names == ('a', 'b', 'c')
    np.testing.assert_array_equal(limits.lower, CHAIN.lower)
    np.testing.assert_array_equal(limits.upper, CHAIN.upper)
    # A joint without a limit in the model gets 1 rad/s, and of that the share.
    np.testing.assert_allclose(limits.velocity, [0.6, 1.2, 0.3])


def test_offsets_in_use_shift_the_limits_and_never_widen_them():
    """True angle = reported + offset; the controller watches the reported one."""
    offsets = np.array([0.1, -0.2, 0.3])
    limits = MotionLimits.of(CHAIN, 1.0, offsets)
    np.testing.assert_allclose(limits.upper[:2], [1.0 - 0.1, 2.0])
    np.testing.assert_allclose(limits.lower[:2], [-1.0, -2.0 + 0.2])
    assert limits.lower[2] == -np.inf
    assert limits.upper[2] == np.inf
    rng = np.random.default_rng(1)
    for q in rng.uniform(-2.5, 2.5, (500, 3)):
        true_inside = np.all((q + offsets >= CHAIN.lower) & (q + offsets <= CHAIN.upper))
        reported_inside = np.all((q >= CHAIN.lower) & (q <= CHAIN.upper))
        assert (limits.outside(q) == '') == (true_inside and reported_inside)


def test_inside_is_inside_and_the_edge_too():
    assert LIMITS.outside(np.array([1.0, -2.0])) == ''
    assert LIMITS.outside(np.array([-1.0, 2.0])) == ''


@pytest.mark.parametrize(
    ('q', 'text'),
    [
        ([0.0, 2.01], 'b at 115.16 deg is outside its limits [-114.59, 114.59] deg'),
        ([-1.01, 0.0], 'a at -57.87 deg is outside its limits [-57.30, 57.30] deg'),
        ([np.nan, 0.0], 'a at nan deg is outside its limits [-57.30, 57.30] deg'),
        ([np.inf, 0.0], 'a at inf deg is outside its limits [-57.30, 57.30] deg'),
    ],
)
def test_outside_names_the_joint_and_its_limits(q, text):
    assert LIMITS.outside(np.array(q)) == text


def sample(start, points, t):
    """Positions and velocities at times t of cubics through the waypoints, SciPy's as judge."""
    times = [0.0, *(point.time_s for point in points)]
    q = [start, *(point.q for point in points)]
    v = [np.zeros_like(start), *(point.velocity for point in points)]
    curve = CubicHermiteSpline(times, q, v)
    return curve(t), curve(t, 1), curve(t, 2)


@pytest.mark.parametrize(('share', 'count'), [(1.0, 2), (NO_CRUISE, 2), (1.0 - 2.0**-19, 3)])
def test_two_waypoints_are_never_at_the_same_time(share, count):
    points = Move(np.zeros(2), np.ones(2), share / RAMP_S).waypoints()
    assert len(points) == count
    assert np.all(np.diff([point.time_s for point in points]) > 0.0)


def test_no_joint_exceeds_its_velocity_and_the_slowest_uses_it():
    rng = np.random.default_rng(3)
    short = 0
    for _ in range(200):
        start, end = rng.uniform(-1, 1, (2, 2))
        if rng.random() < 0.3:
            end = start + rng.uniform(-0.02, 0.02, 2)
        move = LIMITS.move(start, end)
        points = move.waypoints()
        assert points[-1].time_s == pytest.approx(move.duration_s)
        t = np.linspace(0, move.duration_s, 2001)
        q, v, a = sample(start, points, t)
        share = np.max(np.abs(v) / LIMITS.velocity)
        assert share <= 1 + 1e-9
        # A way longer than the two ramps is cruised at the limit; a shorter one has two ramps.
        is_short = np.all(np.abs(end - start) < LIMITS.velocity * RAMP_S)
        short += is_short
        assert len(points) == (2 if is_short else 3)
        assert is_short or share > 1 - 1e-9
        assert not is_short or move.duration_s == pytest.approx(2 * RAMP_S)
        np.testing.assert_allclose(q[-1], end, atol=1e-12)
        np.testing.assert_allclose(v[-1], 0, atol=1e-12)
        assert np.max(np.abs(a)) <= np.max(np.abs(v)) / RAMP_S * (1 + 1e-6)
        # Between the two ends and on the straight line between them.
        along = (q - start) @ (end - start) / np.sum((end - start) ** 2)
        assert along.min() >= -1e-9
        assert along.max() <= 1 + 1e-9
        np.testing.assert_allclose(q, start + along[:, None] * (end - start), atol=1e-9)
        # `at` says the same as the judge.
        mine = [move.at(time) for time in t]
        np.testing.assert_allclose([m[0] for m in mine], q, atol=1e-9)
        np.testing.assert_allclose([m[1] for m in mine], v, atol=1e-9)
    assert 20 < short < 150


def test_before_and_after_the_move_the_arm_stands_at_its_ends():
    move = Move(np.array([0.0]), np.array([2.0]), 0.5)
    for time_s, place in ((-1.0, 0.0), (0.0, 0.0), (move.duration_s, 2.0), (9.0, 2.0)):
        q, v = move.at(time_s)
        np.testing.assert_array_equal(q, [place])
        np.testing.assert_array_equal(v, [0.0])


def test_a_cruise_of_no_length_is_left_out():
    """Two waypoints at one time are a trajectory that a controller drops."""
    move = Move(np.zeros(1), np.ones(1), 1.0 / RAMP_S - 1e-9)
    assert len(move.waypoints()) == 2
    move = Move(np.zeros(1), np.ones(1), 1.0 / (RAMP_S + 2e-6))
    assert len(move.waypoints()) == 3


def test_no_way_is_no_motion():
    move = LIMITS.move(np.ones(2), np.ones(2))
    assert move.duration_s == pytest.approx(2 * RAMP_S)
    q, v, _ = sample(np.ones(2), move.waypoints(), np.linspace(0, move.duration_s, 11))
    np.testing.assert_array_equal(q, 1.0)
    np.testing.assert_array_equal(v, 0.0)


def test_a_stop_brakes_evenly_without_turning_back():
    velocity = np.array([0.4, -0.9])
    stop = LIMITS.stop(np.array([0.1, -0.3]), velocity)
    assert stop.time_s == BRAKE_S
    np.testing.assert_array_equal(stop.velocity, 0.0)
    curve = CubicHermiteSpline([0, BRAKE_S], [[0.1, -0.3], stop.q], [velocity, np.zeros(2)])
    t = np.linspace(0, BRAKE_S, 101)
    np.testing.assert_allclose(curve(t, 1), np.outer(1 - t / BRAKE_S, velocity), atol=1e-12)


def test_a_stop_never_reaches_beyond_a_limit_and_does_not_send_a_joint_back():
    stop = LIMITS.stop(np.array([0.99, -2.1]), np.array([0.5, -1.0]))
    np.testing.assert_array_equal(stop.q, [1.0, -2.1])
    stop = LIMITS.stop(np.array([-0.99, 2.1]), np.array([-0.5, 1.0]))
    np.testing.assert_array_equal(stop.q, [-1.0, 2.1])


def test_a_velocity_that_cannot_be_does_not_throw_the_arm():
    """A jump in the reports looks like speed; the stop allows for no more than the limit."""
    stop = LIMITS.stop(np.zeros(2), np.array([50.0, -50.0]))
    np.testing.assert_allclose(stop.q, 0.5 * BRAKE_S * np.array([0.5, -1.0]))
