"""What limits motion: joint limits and the share of the joint velocity limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.core.chain import SerialChain
from remaster_ros.core.types import FloatArray

RAMP_S = 0.5
"""How long a move takes to reach its speed, and to lose it, s."""


@dataclass(frozen=True)
class Waypoint:
    """A point of a trajectory: time from its start (s), positions (rad), velocities (rad/s)."""

    time_s: float
    q: FloatArray
    velocity: FloatArray


@dataclass(frozen=True)
class MotionLimits:
    """Limits of commanded joint positions and velocities.

    Attributes
    ----------
    names
        Joint names, base to tip.
    lower, upper
        Position limits, rad, (k,).
    velocity
        Largest allowed joint velocities (the share of the limits), rad/s, (k,).
    """

    names: Sequence[str]
    lower: FloatArray
    upper: FloatArray
    velocity: FloatArray

    @classmethod
    def of(cls, chain: SerialChain, speed_share: float) -> MotionLimits:
        """Take the limits of a chain, with a share (0 to 1) of its velocity limits."""
        # An unknown limit is infinite in the chain; 1 rad/s is slow for any arm.
        limits = np.where(np.isfinite(chain.velocity_limits), chain.velocity_limits, 1.0)
        return cls(chain.joint_names, chain.lower, chain.upper, speed_share * limits)

    def outside(self, q: FloatArray) -> str:
        """Return which joint of `q` (rad, (k,)) lies outside, in words; '' if none does."""
        for name, value, low, high in zip(self.names, q, self.lower, self.upper):
            if not low <= value <= high:
                return (
                    f'{name} at {np.rad2deg(value):.2f} deg is outside its limits '
                    f'[{np.rad2deg(low):.2f}, {np.rad2deg(high):.2f}] deg'
                )
        return ''

    def trajectory(self, start: FloatArray, end: FloatArray) -> tuple[Waypoint, ...]:
        """Return the fastest move within the velocities: ramp up, cruise, ramp down.

        All joints start and arrive together. A controller that joins positions and velocities by
        cubics, as joint_trajectory_controller does, follows the ramps at constant acceleration.

        Parameters
        ----------
        start, end
            Joint positions at rest, rad, (k,).
        """
        way = end - start
        # Share of the way per second; a short way is over before the cruising speed is reached.
        speed = float(np.min(self.velocity / np.maximum(np.abs(way), 1e-12)))
        speed = min(speed, 1.0 / RAMP_S)
        cruise_s = 1.0 / speed - RAMP_S
        velocity, ramp = speed * way, 0.5 * RAMP_S * speed * way
        points = [Waypoint(RAMP_S, start + ramp, velocity)]
        if cruise_s > 1e-6:
            points.append(Waypoint(RAMP_S + cruise_s, end - ramp, velocity))
        points.append(Waypoint(2 * RAMP_S + cruise_s, np.array(end, float), np.zeros_like(way)))
        return tuple(points)
