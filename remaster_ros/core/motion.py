"""What limits motion: joint limits, the share of the joint velocity limits, and how to stop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.core.chain import SerialChain
from remaster_ros.core.types import FloatArray

RAMP_S = 0.5
"""How long a move takes to reach its speed, and to lose it, s."""
BRAKE_S = 0.25
"""How long a stop takes to lose the speed, s; the arm's own servo comes on top."""
STANDSTILL_S = 1.0
"""Within this time of a stop no joint moves faster than `STANDSTILL_RAD_S`, s."""
STANDSTILL_RAD_S = 1e-3
NO_CRUISE = 1.0 - 2.0**-20
"""Ramps that take this share of the way have none between them: two waypoints need two times."""

_UNKNOWN_VELOCITY = 1.0
"""Where a robot model has no velocity limit, rad/s: slow for any arm."""


@dataclass(frozen=True)
class Waypoint:
    """A point of a trajectory: time from its start (s), positions (rad), velocities (rad/s)."""

    time_s: float
    q: FloatArray
    velocity: FloatArray


@dataclass(frozen=True)
class Move:
    """A straight move in joint space: ramp up, cruise, ramp down; all joints arrive together.

    A controller that joins positions and velocities by cubics, as joint_trajectory_controller
    does, follows the ramps at constant acceleration.

    Attributes
    ----------
    start, end
        Joint positions at rest, rad, (k,).
    speed
        Share of the way per second while cruising, 1/s.
    """

    start: FloatArray
    end: FloatArray
    speed: float

    @property
    def cruise_s(self) -> float:
        """Time between the two ramps, s."""
        return 1.0 / self.speed - RAMP_S

    @property
    def duration_s(self) -> float:
        """Time from start to end, s."""
        return self.cruise_s + 2 * RAMP_S

    def waypoints(self) -> tuple[Waypoint, ...]:
        """Return the end of each phase."""
        way = self.end - self.start
        velocity, ramp = self.speed * way, 0.5 * RAMP_S * self.speed * way
        points = [Waypoint(RAMP_S, self.start + ramp, velocity)]
        if self.speed * RAMP_S < NO_CRUISE:
            points.append(Waypoint(RAMP_S + self.cruise_s, self.end - ramp, velocity))
        points.append(Waypoint(self.duration_s, self.end, np.zeros_like(way)))
        return tuple(points)

    def at(self, time_s: float) -> tuple[FloatArray, FloatArray]:
        """Return where the arm should be (rad) and how fast (rad/s), (k,) each."""
        # The speed goes up from the start, and down by as much from where it is to be lost.
        up, gone_up = _ramp(time_s)
        down, gone_down = _ramp(time_s - RAMP_S - self.cruise_s)
        velocity = self.speed * (self.end - self.start)
        return self.start + (gone_up - gone_down) * velocity, (up - down) * velocity


def _ramp(time_s: float) -> tuple[float, float]:
    """Return a speed that goes from 0 to 1 in `RAMP_S`, and its integral, s."""
    speed = min(max(time_s / RAMP_S, 0.0), 1.0)
    return speed, 0.5 * RAMP_S * speed**2 + max(time_s - RAMP_S, 0.0)


@dataclass(frozen=True)
class MotionLimits:
    """Limits of commanded joint positions and velocities.

    Attributes
    ----------
    names
        Joint names, base to tip.
    lower, upper
        Position limits in reported angles, rad, (k,).
    velocity
        Largest allowed joint velocities (the share of the limits), rad/s, (k,).
    """

    names: Sequence[str]
    lower: FloatArray
    upper: FloatArray
    velocity: FloatArray

    @classmethod
    def of(
        cls, chain: SerialChain, speed_share: float, offsets: FloatArray | None = None
    ) -> MotionLimits:
        """Take the limits of a chain.

        A joint's stops are at true angles, which are the reported ones plus the offset: in
        reported angles the limits are shifted by minus the offset. The robot's own controller
        watches the limits in reported angles, so the shifted ones never reach beyond them.

        Parameters
        ----------
        chain
            The arm.
        speed_share
            Share (0 to 1) of its velocity limits that is used.
        offsets
            Joint zero-offsets in use, rad, (k,); None for none.
        """
        shift = np.zeros(len(chain)) if offsets is None else offsets
        known = np.isfinite(chain.velocity_limits)
        velocity = np.where(known, chain.velocity_limits, _UNKNOWN_VELOCITY)
        return cls(
            chain.joint_names,
            np.maximum(chain.lower, chain.lower - shift),
            np.minimum(chain.upper, chain.upper - shift),
            speed_share * velocity,
        )

    def outside(self, q: FloatArray) -> str:
        """Return which joint of `q` (rad, (k,)) lies outside, in words; '' if none does."""
        for name, value, low, high in zip(self.names, q, self.lower, self.upper):
            if not low <= value <= high:
                return (
                    f'{name} at {np.rad2deg(value):.2f} deg is outside its limits '
                    f'[{np.rad2deg(low):.2f}, {np.rad2deg(high):.2f}] deg'
                )
        return ''

    def move(self, start: FloatArray, end: FloatArray) -> Move:
        """Return the fastest move between two places, (k,) each, within the velocities."""
        way = np.abs(end - start)
        speed = float(np.min(self.velocity / np.maximum(way, 1e-12)))
        # A short way is over before the cruising speed is reached.
        return Move(start, end, min(speed, 1.0 / RAMP_S))

    def stop(self, q: FloatArray, velocity: FloatArray) -> Waypoint:
        """Return where an arm at `q` (rad) that moves at `velocity` (rad/s), (k,), is to stand.

        Each joint brakes evenly in `BRAKE_S`, but never beyond a limit.
        """
        way = 0.5 * BRAKE_S * np.clip(velocity, -self.velocity, self.velocity)
        # A joint that is already outside is left where it is, not sent back at a stop.
        end = np.clip(q + way, np.minimum(self.lower, q), np.maximum(self.upper, q))
        return Waypoint(BRAKE_S, end, np.zeros_like(end))
