# SPDX-License-Identifier: Apache-2.0
"""Motion on curves: within all limits, stopped along itself at any moment, over soon if killed."""

import copy
import dataclasses
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from supervisor_rig import HOME, LIMITS, RULES, Rig, along

from remaster_ros.motion.actions import Drive, Failed, Halted, Renew, Settled, Stop
from remaster_ros.motion.joint_units import TURNING
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import NO_STAMPS, Cubic, MotionGate, MotionRefusedError
from remaster_ros.motion.pieces import HORIZON_S, JOINED_S, STOP_AHEAD_S, stop_of
from remaster_ros.motion.spline import MOST_POINTS, SAGITTA_RAD, Spline
from remaster_ros.motion.states import Arm
from remaster_ros.motion.trajectory import RAMP_S, Curve, Trajectory, Waypoint

IN_PIECES = dataclasses.replace(RULES, horizon_s=HORIZON_S)
VIA = np.array([[0.5, 0.9], [-0.3, 1.2], [-0.6, 0.1], [0.2, -0.9], [0.7, -0.2], [0.0, 0.6]])
TARGET = np.array([-0.4, -0.3])
SHARES = np.linspace(0.0, 1.0, len(VIA) + 2)
SEVEN = MotionLimits(
    tuple(f'joint_{i}' for i in range(1, 8)),
    np.full(7, -2.9),
    np.full(7, 2.9),
    np.array([0.6, 0.6, 0.6, 0.6, 0.75, 0.75, 0.75]),
    np.full(7, 5.0),
)


def spline(start=HOME):
    return Spline.through(np.vstack([start, VIA, TARGET]), SHARES)


def drawn(seed, count=12):
    """Return a curve of seven joints, and print the seed that it is of."""
    print(f'seed {seed}')
    rng = np.random.default_rng(seed)
    q = np.clip(np.cumsum(rng.normal(0.0, 0.35, (count, 7)), axis=0), -2.5, 2.5)
    steps = rng.uniform(0.6, 1.4, count - 1)
    shares = np.append(0.0, np.cumsum(steps))
    return Spline.through(q, shares / shares[-1]), q


@pytest.mark.parametrize('seed', range(8))
def test_a_spline_goes_through_its_points_and_is_c2(seed):
    curve, q = drawn(seed)
    inner = curve.knots[2:-2]
    np.testing.assert_allclose(curve.at(inner), q[1:-1], atol=1e-12)
    np.testing.assert_allclose(curve.at(np.array([0.0, 1.0])), q[[0, -1]], atol=1e-12)
    for order, bound in ((0, 1e-7), (1, 1e-5), (2, 1e-3)):
        before, after = (curve.at(curve.knots[1:-1] + side, order) for side in (-1e-9, 1e-9))
        np.testing.assert_allclose(before, after, atol=bound)
    for low, high in ((0.0, curve.straight_until), (curve.straight_from, 1.0)):
        assert np.all(curve.at(np.linspace(low, high - 1e-12, 5), 2) == 0.0)


@pytest.mark.parametrize('seed', range(8))
def test_the_chords_of_the_samples_are_near_the_spline(seed):
    curve, _ = drawn(seed)
    shares, places = curve.samples
    between = np.linspace(0.0, 1.0, 9)[1:-1]
    for low, high, start, end in zip(shares, shares[1:], places, places[1:]):
        chord = start + between[:, None] * (end - start)
        assert np.max(np.abs(curve.at(low + between * (high - low)) - chord)) < 1.05 * SAGITTA_RAD


@pytest.mark.parametrize('seed', range(8))
def test_the_nearest_place_is_found(seed):
    curve, _ = drawn(seed)
    rng = np.random.default_rng([seed, 1])
    shares = rng.uniform(0.0, 1.0, 200)
    at = curve.at(shares)
    np.testing.assert_allclose(curve.at(curve.nearest(at, TURNING)), at, atol=1e-9)
    off = at + rng.normal(0.0, 0.01, at.shape)
    found = np.linalg.norm(curve.at(curve.nearest(off, TURNING)) - off, axis=1)
    fine = curve.at(np.linspace(0.0, 1.0, 20_001))
    least = np.array([np.min(np.linalg.norm(fine - q, axis=1)) for q in off])
    np.testing.assert_allclose(found, least, atol=1e-5)
    assert np.all(curve.nearest(at, TURNING, 0.25, 0.5) >= 0.25)
    assert np.all(curve.nearest(at, TURNING, 0.25, 0.5) <= 0.5)


@pytest.mark.parametrize(
    ('points', 'shares', 'why'),
    [
        (np.zeros((2, 2)), [0.0, 1.0], 'three configurations'),
        (np.zeros((3, 2)), [0.0, 1.0], 'three configurations'),
        (np.zeros((3, 2)), [0.0, 0.5, 0.9], 'ascend from 0 to 1'),
        (np.zeros((4, 2)), [0.0, 0.6, 0.6, 1.0], 'ascend from 0 to 1'),
        (np.zeros((4, 2)), [0.0, np.nan, 0.6, 1.0], 'ascend from 0 to 1'),
        (np.full((3, 2), np.inf), [0.0, 0.5, 1.0], 'not finite'),
        (1e9 * np.eye(4)[:, :2], [0.0, 0.3, 0.6, 1.0], 'samples; 4000 at most'),
        (np.zeros((999, 2)), np.linspace(0.0, 1.0, 999), f'{MOST_POINTS} at most'),
    ],
)
def test_no_other_curve_is_made(points, shares, why):
    with pytest.raises(ValueError, match=why):
        Spline.through(points, np.array(shares))


def cubics(waypoints):
    """Return the start times and cubics of a controller's reference between waypoints."""
    return [(a.time_s, Cubic.between(a, b)) for a, b in pairwise(waypoints)]


def rates(waypoints):
    """Return the largest speed and acceleration of each joint between waypoints."""
    drawn = [cubic for _, cubic in cubics(waypoints)]
    return (
        np.max([cubic.largest_speed() for cubic in drawn], axis=0),
        np.max([cubic.largest_acceleration() for cubic in drawn], axis=0),
    )


@pytest.mark.parametrize('seed', range(8))
def test_a_curve_and_each_of_its_stops_keep_the_limits_and_stay_on_it(seed):
    curve, _ = drawn(seed)
    motion = Curve.within(SEVEN, curve)
    full_path = [Waypoint(0.0, curve.start, np.zeros(7)), *motion.waypoints()]
    trajectory = Trajectory((motion,))
    ways = [full_path]
    for sent_s in np.linspace(JOINED_S, motion.duration_s - 0.01, 53):
        piece = stop_of(trajectory, sent_s, sent_s + STOP_AHEAD_S)
        assert piece.end_s <= sent_s + STOP_AHEAD_S + RAMP_S + 1e-9
        assert np.all(piece.waypoints[-1].velocity == 0.0)
        ways.append(piece.waypoints)
    for way in ways:
        speed, acceleration = rates(way)
        assert np.all(speed <= SEVEN.velocity)
        assert np.all(acceleration <= SEVEN.acceleration)
        for _, cubic in cubics(way):
            at = cubic.at(np.linspace(0.0, cubic.duration_s, 7))
            off = at - curve.at(curve.nearest(at, TURNING))
            assert np.max(np.abs(off)) < 1e-6
    # It is as fast as they allow: by one of them, everywhere on the way, or by its ends.
    fastest = max(
        np.max(rates(full_path)[0] / SEVEN.velocity),
        np.max([rates(way)[1] for way in ways] / SEVEN.acceleration),
        motion.rate * 0.9 / curve.straight_until,
        motion.rate * RAMP_S / (1.0 - curve.straight_from),
    )
    assert 0.9 < fastest <= 1.0 + 1e-9


@pytest.mark.parametrize('acceleration', [0.3, 2.0, 50.0])
@pytest.mark.parametrize('seed', [0, 3])
def test_the_fastest_motion_passes_the_gate_whatever_limits_it(seed, acceleration):
    curve, _ = drawn(seed)
    limits = dataclasses.replace(
        SEVEN,
        lower=np.full(7, -9.0),
        upper=np.full(7, 9.0),
        acceleration=np.full(7, acceleration),
    )
    gate = MotionGate(limits)
    trajectory = gate.admit(along(curve), curve.start, HORIZON_S).trajectory
    for sent_s in np.arange(JOINED_S, trajectory.duration_s, 0.4):
        piece = gate.renew(sent_s, HORIZON_S).piece
        assert piece.is_last or piece.end_s < trajectory.duration_s


def test_the_controller_follows_the_curve_between_the_waypoints():
    motion = Curve.within(LIMITS, spline())
    points = [Waypoint(0.0, HOME, np.zeros(2)), *motion.waypoints()]
    for begins_s, cubic in cubics(points):
        for time_s in np.linspace(0.0, cubic.duration_s, 7):
            q, velocity = motion.at(begins_s + time_s)
            np.testing.assert_allclose(cubic.at(time_s), q, atol=1e-9)
            np.testing.assert_allclose(cubic.velocity(time_s), velocity, atol=1e-8)


def test_the_gate_admits_a_curve_in_pieces_alone():
    gate, free = MotionGate(LIMITS), along(spline())
    for how in ({'horizon_s': 0.0}, {'horizon_s': HORIZON_S, 'keeps_stamps': False}):
        with pytest.raises(MotionRefusedError) as refused:
            gate.admit(free, HOME, **how)
        assert str(refused.value) == NO_STAMPS
    admitted = gate.admit(free, HOME, HORIZON_S)
    assert admitted.trajectory.is_curve
    assert admitted.piece.end_s <= HORIZON_S + 1e-9


def test_a_curve_that_leaves_the_limits_or_the_checked_path_is_refused():
    inside = dataclasses.replace(LIMITS, upper=np.array([1.0, 1.1]))
    with pytest.raises(MotionRefusedError, match='b would go to'):
        MotionGate(inside).admit(along(spline()), HOME, HORIZON_S)
    gate = MotionGate(LIMITS)
    gate.admit(along(spline()), HOME, HORIZON_S)
    trajectory, limits, _ = gate._under_way
    other = Spline.through(np.vstack([HOME, VIA[:-1] + 0.01, TARGET]), np.linspace(0, 1, 7))
    gate._under_way = trajectory, limits, along(other)
    with pytest.raises(MotionRefusedError, match='off the path found free'):
        gate.renew(2.0, HORIZON_S)


def test_limits_lowered_since_refuse_the_next_piece():
    gate = MotionGate(LIMITS)
    gate.admit(along(spline()), HOME, HORIZON_S)
    trajectory, limits, free = gate._under_way
    gate._under_way = trajectory, dataclasses.replace(limits, velocity=limits.velocity / 2), free
    with pytest.raises(MotionRefusedError, match='speed'):
        gate.renew(2.0, HORIZON_S)


def off_curve(trail):
    """Return the largest distance of a trail from the curve, in any joint, rad."""
    q, curve = trail[:, 1:3], spline()
    return float(np.max(np.abs(q - curve.at(curve.nearest(q, TURNING)))))


def sent():
    """Return a rig whose arm is sent along the curve."""
    rig = Rig(IN_PIECES)
    rig.plan(TARGET, waypoints={0: np.vstack([HOME, VIA])}, shares={0: SHARES[:-1]})
    return rig


BESIDE_RAD = 0.01
"""The servo of the rig lags by 0.1 s and cuts corners by so much."""


DURATION_S = Curve.within(LIMITS, spline()).duration_s
MOMENTS = np.append(np.linspace(0.1, DURATION_S - 0.05, 25), DURATION_S + np.array([0.1, 0.3]))


@cache
def _rigs():
    """Return the arm at each of the moments of one way along the curve."""
    rig = sent()
    begun, found = rig.t, {}
    for moment in MOMENTS:
        rig.run(60.0, lambda until=begun + moment: rig.t >= until - 1e-9)
        found[moment] = copy.deepcopy(rig)
    return found


def under_way(moment):
    """Return the test's own arm at one of the moments."""
    return copy.deepcopy(_rigs()[moment])


def test_an_arm_goes_along_a_curve_settles_and_is_measured():
    rig = sent()
    trail = moved(rig, DURATION_S + 3.0)
    assert not rig.said(Halted, Stop, Failed)
    assert len(rig.said(Drive)) == 1
    assert len(rig.said(Renew)) > 0.8 * (DURATION_S - 2.0) / 0.42
    np.testing.assert_allclose(rig.last(Settled).q, TARGET, atol=1e-4)
    assert off_curve(trail) < BESIDE_RAD
    assert rig.last(Settled).motion_s == pytest.approx(DURATION_S, abs=1.5)


def moved(rig, seconds):
    """Return times, places and speeds of the arm from now on."""
    trail = []
    end = rig.t + seconds
    while rig.t < end:
        rig.step()
        trail.append((rig.t, *rig.arm.at(rig.t)[0], *rig.arm.at(rig.t)[1]))
    return np.array(trail)


@pytest.mark.parametrize('moment', MOMENTS, ids='{:.2f}'.format)
def test_a_stop_at_any_moment_stays_on_the_curve(moment):
    rig = under_way(moment)
    speed = rig.speed()
    rig.pause()
    trail = moved(rig, 2.5)
    assert rig.supervisor.state in (Arm.STANDS, Arm.HALTED)
    assert not rig.said(Halted)
    assert rig.speed() < 1e-3
    assert off_curve(trail) < BESIDE_RAD
    # It gets no faster than it was allowed to, and stands after latency, stop and lag.
    assert np.all(np.abs(trail[:, 3:]) <= 1.1 * LIMITS.velocity)
    moves = np.max(np.abs(trail[:, 3:]), axis=1) > 0.02
    if speed > 0.05:
        assert trail[moves][-1, 0] - (rig.t - 2.5) < STOP_AHEAD_S + RAMP_S + 0.45
    accelerations = np.abs(np.diff(trail[:, 3:], axis=0)) / 0.02
    assert np.all(accelerations < 1.3 * LIMITS.acceleration)


@pytest.mark.parametrize('moment', MOMENTS[::3], ids='{:.2f}'.format)
def test_after_a_stop_it_goes_on_to_the_target(moment):
    rig = under_way(moment)
    rig.pause()
    rig.run(2.5)
    rig.state = 'running'
    rig.run(30.0, lambda: rig.said(Settled, Halted))
    assert not rig.said(Halted, Failed)
    np.testing.assert_allclose(rig.last(Settled).q, TARGET, atol=1e-4)


@pytest.mark.parametrize('moment', MOMENTS[::2], ids='{:.2f}'.format)
def test_an_arm_whose_bridge_is_killed_on_a_curve_stands_within_two_seconds(moment):
    rig = under_way(moment)
    rig.alive.remove('bridge')
    trail = moved(rig, 2.6)
    assert off_curve(trail) < BESIDE_RAD
    late = trail[trail[:, 0] > rig.t - 0.6]
    assert np.max(np.abs(late[:, 3:])) < 5e-3


@pytest.mark.parametrize('moment', MOMENTS[2:-4:3], ids='{:.2f}'.format)
def test_an_arm_stopped_on_a_curve_by_its_own_safety_is_halted(moment):
    rig = under_way(moment)
    commands = len(rig.commands)
    rig.freeze()
    rig.obey = lambda waypoints: ()
    assert 'emergency' in rig.halts(3.0)
    # No command leads on after what was seen; pieces of the curve may have come before.
    assert len(rig.commands) - commands <= 2


@pytest.mark.parametrize('moment', MOMENTS[2:-4:3], ids='{:.2f}'.format)
def test_an_arm_that_is_pushed_off_the_curve_is_halted(moment):
    rig = under_way(moment)
    rig.alter = lambda t, q: q + np.array([0.0, 0.05])
    assert 'does not follow its path' in rig.halts(3.0)


@pytest.mark.parametrize('moment', MOMENTS[2:-4:3], ids='{:.2f}'.format)
def test_silent_or_frozen_reports_on_a_curve_end_in_a_stop_or_a_halt(moment):
    for alter in (lambda t, q: None, lambda t, q, last=[]: last[0] if last else last.append(q)):
        rig = under_way(moment)
        rig.alter = alter
        trail = moved(rig, 6.0)
        assert rig.said(Halted)
        assert np.max(np.abs(trail[-50:, 3:])) < 5e-3
        assert off_curve(trail) < BESIDE_RAD


def test_limits_lowered_on_the_way_stop_the_arm_and_it_goes_on_slower():
    rig = under_way(MOMENTS[6])
    slow = dataclasses.replace(LIMITS, velocity=LIMITS.velocity / 4)
    rig.do(rig.supervisor.use_limits(slow, rig.wall))
    assert rig.said(Stop)
    rig.run(2.0)
    trail = moved(rig, 20.0)
    assert np.all(np.abs(trail[:, 3:]) <= 1.2 * slow.velocity)
    assert rig.said(Settled)


def test_a_curve_that_begins_elsewhere_is_not_gone():
    rig = Rig(IN_PIECES)
    way = np.vstack([HOME + 0.1, VIA])
    rig.plan(TARGET, waypoints={0: way}, shares={0: SHARES[:-1]})
    rig.settles()
    assert not rig.last(Drive).admitted.trajectory.is_curve
