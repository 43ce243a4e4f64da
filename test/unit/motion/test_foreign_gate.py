# SPDX-License-Identifier: Apache-2.0
"""The gate for trajectories of other planners, against what a controller draws of them."""

import numpy as np
import pytest

from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import ForeignGate, MotionRefusedError, StartMovedError
from remaster_ros.motion.trajectory import Waypoint

K = 3
LIMITS = MotionLimits(
    ('a', 'b', 'c'), np.full(K, -1.0), np.full(K, 1.0), np.full(K, 1.5), np.full(K, 6.0)
)
GATE = ForeignGate(LIMITS)
NEAR = 0.02
NAMES = ('go to', 'would have a speed of', 'acceleration of', 'step of its speed of')


def shares(times, q, v, is_straight):
    """Return the largest share of each limit that a controller comes to: dense, by itself."""
    worst = dict.fromkeys(NAMES, 0.0)
    rates = [v[0]]
    for i in range(len(times) - 1):
        T = times[i + 1] - times[i]
        s = np.linspace(0.0, 1.0, 400)[:, None]
        if is_straight:
            place, speed = q[i] + s * (q[i + 1] - q[i]), (q[i + 1] - q[i]) / T * np.ones_like(s)
            bend = np.zeros_like(speed)
            rates.append(speed[0])
        else:
            a, b = q[i], v[i] * T
            c = 3 * (q[i + 1] - q[i]) - (2 * v[i] + v[i + 1]) * T
            d = -2 * (q[i + 1] - q[i]) + (v[i] + v[i + 1]) * T
            place = a + b * s + c * s**2 + d * s**3
            speed, bend = (b + 2 * c * s + 3 * d * s**2) / T, (2 * c + 6 * d * s) / T**2
        for name, values, limit in zip(NAMES, (place, speed, bend), (1.0, 1.5, 6.0)):
            worst[name] = max(worst[name], np.abs(values).max() / limit)
    if is_straight:
        # Of what the limit of acceleration allows in a tenth of a second, at each corner.
        steps = np.diff([*rates, np.zeros(K)], axis=0)
        worst['step of its speed of'] = np.abs(steps).max() / 0.6
    return worst


@pytest.mark.parametrize('is_straight', [False, True])
@pytest.mark.parametrize('moves', [False, True])
def test_it_passes_what_keeps_the_limits_and_nothing_else(is_straight, moves):
    rng = np.random.default_rng(3)
    passed, refused = 0, dict.fromkeys(NAMES, 0)
    for _ in range(700):
        n = int(rng.integers(2, 6))
        times = np.cumsum(rng.uniform(0.3, 1.0, n))
        size = rng.uniform(0.02, 1.0)
        q = np.cumsum(size * rng.normal(0.0, 0.4, (n, K)), axis=0)
        v = size * rng.normal(0.0, 0.4, (n, K))
        v[-1] = 0.0
        start, speed = np.zeros(K), size * rng.normal(0.0, 0.3, K) if moves else np.zeros(K)
        worst = shares(
            np.r_[0.0, times], np.vstack((start, q)), np.vstack((speed, v)), is_straight
        )
        if any(abs(share - 1.0) < NEAR for share in worst.values()):
            continue
        waypoints = [Waypoint(*row) for row in zip(times, q, v)]
        said = ''
        try:
            done = GATE.admit(waypoints, start, speed, is_straight=is_straight)
        except MotionRefusedError as error:
            said = str(error)
        if not said:
            assert max(worst.values()) < 1.0, worst
            assert done.waypoints == tuple(waypoints)
            assert done.is_straight == is_straight
            passed += 1
            continue
        (name,) = [reason for reason in refused if reason in said]
        assert worst[name] > 1.0, (worst, said)
        refused[name] += 1
    assert passed > 50
    assert refused['go to'] > 20
    assert refused['would have a speed of'] > 20
    assert (refused['acceleration of'] > 20) != is_straight
    assert (refused['step of its speed of'] > 20) == is_straight


def test_an_arm_that_stands_outside_may_go_inwards_alone():
    q = np.array([1.02, 0.0, 0.0])
    inwards = [Waypoint(2.0, np.array([0.9, 0.0, 0.0]), np.zeros(K))]
    assert GATE.admit(inwards, q, np.zeros(K)).waypoints
    outwards = [Waypoint(2.0, np.array([1.04, 0.0, 0.0]), np.zeros(K))]
    with pytest.raises(MotionRefusedError, match='a would go to'):
        GATE.admit(outwards, q, np.zeros(K))


@pytest.mark.parametrize(
    ('off', 'speed', 'passes'),
    [
        (1.9e-3, 0.0, True),
        (2.1e-3, 0.0, False),
        (0.0, 0.019, True),
        (0.0, 0.021, False),
        (0.0, np.nan, False),
    ],
)
def test_it_begins_at_once_where_the_arm_is_and_stands(off, speed, passes):
    waypoints = [
        Waypoint(0.0, np.array([off, 0.0, 0.0]), np.zeros(K)),
        Waypoint(1.0, np.full(K, 0.1), np.zeros(K)),
    ]
    velocity = np.array([0.0, speed, 0.0])
    if passes:
        assert GATE.admit(waypoints, np.zeros(K), velocity).waypoints
    else:
        with pytest.raises(StartMovedError, match='it begins'):
            GATE.admit(waypoints, np.zeros(K), velocity)


@pytest.mark.parametrize(
    ('times', 'q', 'v', 'words'),
    [
        ((1.0, 1.0), (0.1, 0.2), (0.0, 0.0), 'do not increase'),
        ((1.0, 0.5), (0.1, 0.2), (0.0, 0.0), 'do not increase'),
        ((1.0, np.nan), (0.1, 0.2), (0.0, 0.0), 'do not increase'),
        ((1.0, 2.0), (0.1, np.nan), (0.0, 0.0), 'do not increase'),
        ((1.0, 2.0), (0.1, 0.2), (np.inf, 0.0), 'do not increase'),
        ((1.0, 2.0), (0.1, 0.2), (0.0, 1e-6), 'not end at rest'),
    ],
)
def test_what_is_no_trajectory_is_refused(times, q, v, words):
    waypoints = [Waypoint(t, np.full(K, a), np.full(K, b)) for t, a, b in zip(times, q, v)]
    with np.errstate(all='ignore'), pytest.raises(MotionRefusedError, match=words):
        GATE.admit(waypoints, np.zeros(K), np.zeros(K))


def test_a_hold_is_passed_on():
    assert GATE.admit((), np.zeros(K), np.ones(K)).waypoints == ()
