# SPDX-License-Identifier: Apache-2.0
"""Trajectories as a planner sends them, and what a controller draws of them."""

from __future__ import annotations

import numpy as np

from remaster_ros.compensation.foreign_motion import Trajectory


def drawn(times, q, v, at):
    """Evaluate as ros2_control's trajectory.cpp does: a cubic, or a line without velocities."""
    i = np.clip(np.searchsorted(times, at, 'right') - 1, 0, len(times) - 2)
    T, s = (times[i + 1] - times[i])[:, None], (at - times[i])[:, None]
    if v is None:
        return q[i] + (q[i + 1] - q[i]) / T * s
    c2 = (3 * (q[i + 1] - q[i]) - (2 * v[i] + v[i + 1]) * T) / T**2
    c3 = (-2 * (q[i + 1] - q[i]) + (v[i] + v[i + 1]) * T) / T**3
    return q[i] + v[i] * s + c2 * s**2 + c3 * s**3


def line(a, b, acceleration, chain, every_s=0.1, share=0.95):
    """Return a planner's trajectory along a line, of least jerk, up to a share of its limits."""
    far = np.abs(b - a)
    # Of least jerk: largest speed 15/8, largest acceleration 10/sqrt(3).
    fast = np.max(1.875 * far / chain.velocity_limits)
    seconds = max(fast, np.sqrt(np.max(5.7735 * far) / acceleration)) / share
    n = int(np.ceil(seconds / every_s)) + 1
    t = np.linspace(0.0, seconds, n)
    s = t / seconds
    u = 10 * s**3 - 15 * s**4 + 6 * s**5
    du = (30 * s**2 - 60 * s**3 + 30 * s**4) / seconds
    return Trajectory(t, a + u[:, None] * (b - a), du[:, None] * (b - a))
