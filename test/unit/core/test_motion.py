"""Motion limits: nothing outside, nothing too fast."""

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from remaster_ros.core.motion import RAMP_S, MotionLimits

LIMITS = MotionLimits(
    ('a', 'b'), np.array([-1.0, -2.0]), np.array([1.0, 2.0]), np.array([0.5, 1.0])
)


def test_inside_is_inside_and_the_edge_too():
    assert LIMITS.outside(np.array([1.0, -2.0])) == ''


def test_outside_names_the_joint_and_its_limits():
    text = LIMITS.outside(np.array([0.0, 2.01]))
    assert 'b at 115.16 deg' in text
    assert '[-114.59, 114.59]' in text


def test_not_a_number_is_outside():
    assert LIMITS.outside(np.array([np.nan, 0.0])).startswith('a ')


def sample(start, points, t):
    """Positions and velocities at times t of cubics through the waypoints, SciPy's as judge."""
    times = [0.0, *(point.time_s for point in points)]
    q = [start, *(point.q for point in points)]
    v = [np.zeros_like(start), *(point.velocity for point in points)]
    curve = CubicHermiteSpline(times, q, v)
    return curve(t), curve(t, 1), curve(t, 2)


def test_no_joint_exceeds_its_velocity_and_the_slowest_uses_it():
    rng = np.random.default_rng(3)
    for _ in range(100):
        start, end = rng.uniform(-1, 1, (2, 2))
        points = LIMITS.trajectory(start, end)
        t = np.linspace(0, points[-1].time_s, 2001)
        q, v, a = sample(start, points, t)
        share = np.max(np.abs(v) / LIMITS.velocity)
        assert share <= 1 + 1e-9
        # A way longer than the two ramps is cruised at the limit.
        assert share > 1 - 1e-9 or np.all(np.abs(end - start) < LIMITS.velocity * RAMP_S + 1e-9)
        np.testing.assert_allclose(q[-1], end, atol=1e-12)
        np.testing.assert_allclose(v[-1], 0, atol=1e-12)
        assert np.max(np.abs(a)) <= np.max(np.abs(v)) / RAMP_S * (1 + 1e-6)
        # Between the two ends and on the straight line between them.
        along = (q - start) @ (end - start) / np.sum((end - start) ** 2)
        assert along.min() >= -1e-9
        assert along.max() <= 1 + 1e-9
        np.testing.assert_allclose(q, start + along[:, None] * (end - start), atol=1e-9)


def test_no_way_is_no_motion():
    points = LIMITS.trajectory(np.ones(2), np.ones(2))
    q, v, _ = sample(np.ones(2), points, np.linspace(0, points[-1].time_s, 11))
    np.testing.assert_array_equal(q, 1.0)
    np.testing.assert_array_equal(v, 0.0)
