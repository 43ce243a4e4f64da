# SPDX-License-Identifier: Apache-2.0
"""The fake arm's closed-form servo, judged by SciPy's integrator and splines."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from remaster_ros.simulation.arm_motion import DAMPING, NATURAL_FREQUENCY, Motion, ServoPoint


def go(motion, start, end, duration):
    """Send it to `end` at rest."""
    end = np.asarray(end, float)
    motion.follow(start, [ServoPoint(duration, end, np.zeros_like(end))])


@pytest.mark.parametrize('with_velocities', [True, False])
def test_the_response_solves_the_servo_equation(with_velocities):
    w, z, begin, start = NATURAL_FREQUENCY, DAMPING, 0.5, 0.2
    times, q, v = [0.5, 1.1, 1.7], [0.0, -0.8, -1.1], [-0.9, -1.2, 0.0]
    if with_velocities:
        curve = CubicHermiteSpline([0, *times], [start, *q], [0, *v])
        points = [ServoPoint(t, np.array([a]), np.array([b])) for t, a, b in zip(times, q, v)]
    else:
        points = [ServoPoint(t, np.array([a])) for t, a in zip(times, q)]

        def curve(s):
            return np.interp(s, [0, *times], [start, *q])

    def r(t):
        return float(curve(np.clip(t - begin, 0, times[-1])))

    motion = Motion(0.0, np.array([start]))
    motion.follow(begin, points)
    sampled = np.linspace(0, 5, 301)
    judge = solve_ivp(
        lambda t, y: [y[1], w * w * (r(t) - y[0]) - 2 * z * w * y[1]],
        (0, 5),
        [start, 0.0],
        t_eval=sampled,
        rtol=1e-10,
        atol=1e-12,
        max_step=0.005,
    )
    ours = np.array([np.concatenate(motion.at(t)) for t in sampled])
    np.testing.assert_allclose(ours, judge.y.T, atol=1e-6)


def test_it_lags_overshoots_and_settles():
    motion = Motion(0.0, np.zeros(1))
    go(motion, 1.0, [1.0], 2.0)
    x = np.array([motion.at(t)[0][0] for t in np.arange(0, 8, 0.01)])
    assert x[200] < 0.5 - 0.02  # half way in time, and still behind
    assert 1e-5 < x.max() - 1.0 < 5e-3
    assert abs(x[-1] - 1.0) < 1e-12


def test_a_new_command_on_the_way_is_continuous():
    motion = Motion(0.0, np.zeros(2))
    go(motion, 1.0, [1.0, -2.0], 2.0)
    before = motion.at(2.0)
    go(motion, 2.0, [0.5, 0.5], 1.0)
    np.testing.assert_allclose(motion.at(2.0), before, atol=1e-12)
    np.testing.assert_allclose(motion.at(2.0 + 1e-7)[0], before[0] + 1e-7 * before[1], atol=1e-9)
    np.testing.assert_allclose(motion.at(9.0)[0], [0.5, 0.5], atol=1e-9)


def test_memory_is_bounded():
    motion = Motion(0.0, np.zeros(1))
    for i in range(1000):
        go(motion, float(i), [i % 2], 0.5)
    # The past, and the way to the last point and its rest.
    assert len(motion._responses) <= 16 + 2


def test_a_trajectory_of_many_points_is_followed_from_its_first():
    """A stop along a curve has more points than are kept of the past."""
    motion, times = Motion(0.0, np.zeros(1)), np.arange(1, 61) / 30.0
    points = [ServoPoint(t, np.array([t]), np.ones(1)) for t in times[:-1]]
    motion.follow(0.0, [*points, ServoPoint(times[-1], np.array([times[-1]]), np.zeros(1))])
    assert motion.at(0.5)[0][0] == pytest.approx(0.5 - 2 * DAMPING / NATURAL_FREQUENCY, abs=0.01)
