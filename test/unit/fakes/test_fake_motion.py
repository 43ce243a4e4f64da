"""The fake arm's closed-form servo, judged by SciPy's integrator."""

import numpy as np
from scipy.integrate import solve_ivp

from remaster_ros.fakes.motion import DAMPING, NATURAL_FREQUENCY, Motion, quintic


def test_the_response_solves_the_servo_equation():
    w, z = NATURAL_FREQUENCY, DAMPING
    start, end, duration, begin = 0.2, -1.1, 1.7, 0.5
    reference = quintic(np.array([start]), np.zeros(1), np.array([end]), duration)[:, 0]

    def r(t):
        if t < begin:
            return start
        if t > begin + duration:
            return end
        return (t - begin) ** np.arange(6) @ reference

    motion = Motion(0.0, np.array([start]))
    motion.command(begin, np.array([end]), duration)
    times = np.linspace(0, 5, 301)
    judge = solve_ivp(
        lambda t, y: [y[1], w * w * (r(t) - y[0]) - 2 * z * w * y[1]],
        (0, 5),
        [start, 0.0],
        t_eval=times,
        rtol=1e-10,
        atol=1e-12,
        max_step=0.01,
    )
    ours = np.array([np.concatenate(motion.at(t)) for t in times])
    np.testing.assert_allclose(ours, judge.y.T, atol=1e-8)


def test_it_lags_overshoots_and_settles():
    motion = Motion(0.0, np.zeros(1))
    motion.command(1.0, np.ones(1), 2.0)
    x = np.array([motion.at(t)[0][0] for t in np.arange(0, 8, 0.01)])
    assert x[200] < 0.5 - 0.02  # half way in time, and still behind
    assert 1e-5 < x.max() - 1.0 < 5e-3
    assert abs(x[-1] - 1.0) < 1e-12


def test_a_new_command_on_the_way_is_continuous():
    motion = Motion(0.0, np.zeros(2))
    motion.command(1.0, np.array([1.0, -2.0]), 2.0)
    before = motion.at(2.0)
    motion.command(2.0, np.array([0.5, 0.5]), 1.0)
    np.testing.assert_allclose(motion.at(2.0), before, atol=1e-12)
    np.testing.assert_allclose(motion.at(2.0 + 1e-7)[0], before[0] + 1e-7 * before[1], atol=1e-9)
    np.testing.assert_allclose(motion.at(9.0)[0], [0.5, 0.5], atol=1e-9)


def test_memory_is_bounded():
    motion = Motion(0.0, np.zeros(1))
    for i in range(1000):
        motion.command(float(i), np.array([i % 2]), 0.5)
    assert len(motion._responses) <= 8
