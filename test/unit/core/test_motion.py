"""Motion limits: nothing outside, nothing too fast."""

import numpy as np

from remaster_ros.core.motion import QUINTIC_PEAK, MotionLimits

LIMITS = MotionLimits(('a', 'b'), np.array([-1.0, -2.0]), np.array([1.0, 2.0]), np.array([0.5, 1.0]))


def test_inside_is_inside_and_the_edge_too():
    assert LIMITS.outside(np.array([1.0, -2.0])) == ''


def test_outside_names_the_joint_and_its_limits():
    text = LIMITS.outside(np.array([0.0, 2.01]))
    assert 'b at 115.16 deg' in text
    assert '[-114.59, 114.59]' in text


def test_not_a_number_is_outside():
    assert LIMITS.outside(np.array([np.nan, 0.0])).startswith('a ')


def test_no_joint_exceeds_its_velocity():
    """The duration against a quintic sampled finely, for random moves."""
    rng = np.random.default_rng(3)
    s = np.linspace(0, 1, 20001)
    slope = np.max(np.gradient(10 * s**3 - 15 * s**4 + 6 * s**5, s))
    np.testing.assert_allclose(slope, QUINTIC_PEAK, rtol=1e-4)
    for _ in range(100):
        start, end = rng.uniform(-1, 1, (2, 2))
        duration = LIMITS.duration(start, end)
        assert np.all(np.abs(end - start) * slope / duration <= LIMITS.velocity * 1.001)
