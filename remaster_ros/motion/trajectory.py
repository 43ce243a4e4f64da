# SPDX-License-Identifier: Apache-2.0
"""Trajectories: straight lines in joint space, each from rest to rest.

A controller joins positions and velocities by cubics, as joint_trajectory_controller does; it then
follows the ramps of a line at constant acceleration, and never leaves the line.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from remaster_ros.motion.joint_units import TURNING, JointUnits
from remaster_ros.motion.limits import LONGEST_S, MotionLimits
from remaster_ros.types import FloatArray

RAMP_S = 0.5
"""How long a line takes to reach its speed, and to lose it, s."""
REST_S = 0.5
"""How long the arm rests between two lines, s: longer than it may lag, so that it is never on two
lines at once."""
HEADROOM = 0.97
"""Share of the allowed speeds that is planned with: an arm that stands is reported to move a
little, and the first cubic begins there."""
STOPPABLE = 0.42
"""Share of the allowed accelerations that a line is planned with: a stop of an arm that lags may
have to brake harder than the line does."""
NO_CRUISE = 1.0 - 2.0**-20
"""Ramps that take this share of the way have none between them: two waypoints need two times."""


@dataclass(frozen=True)
class Waypoint:
    """A point of a trajectory: time from its start (s), positions, velocities (per s)."""

    time_s: float
    q: FloatArray
    velocity: FloatArray


@dataclass(frozen=True)
class Line:
    """A straight line in joint space: ramp up, cruise, ramp down; all joints arrive together."""

    # Joint positions at rest, rad or m, (k,)
    start: FloatArray
    end: FloatArray
    rate: float  # Share of the way per second while cruising, 1/s; at most 1/`RAMP_S`

    @classmethod
    def within(
        cls, limits: MotionLimits, start: FloatArray, end: FloatArray, peak_m: float = 0.0
    ) -> Line:
        """Return the fastest line within the speeds and accelerations, less `HEADROOM`.

        ``start, end``: rad or m, (k,); ``peak_m``: speed of the fastest point of arm and tool if
        the whole way takes a second, m/s; 0 for no such limit. Accelerations count `STOPPABLE`
        times.
        """
        way = np.maximum(np.abs(end - start), 1e-12)
        # The ramp is of a given length: what the joints may accelerate bounds the speed as well.
        speeds = np.minimum(limits.velocity, STOPPABLE * limits.acceleration * RAMP_S)
        rate = float(np.min(speeds / way))
        if peak_m > 0.0:
            rate = min(rate, limits.tool_speed / peak_m)
        # A short way is over before the cruising speed is reached. At a limit of next to nothing
        # the time is that of a move that the gate refuses.
        return cls(start, end, min(max(HEADROOM * rate, 0.1 / LONGEST_S), 1.0 / RAMP_S))

    @property
    def way(self) -> FloatArray:
        """From start to end, rad or m, (k,)."""
        return self.end - self.start

    @property
    def cruise_s(self) -> float:
        """Time between the two ramps, s."""
        return 1.0 / self.rate - RAMP_S

    @property
    def duration_s(self) -> float:
        """Time from start to end, s."""
        return self.cruise_s + 2 * RAMP_S

    @property
    def kinks_s(self) -> tuple[float, float]:
        """When the ramp up ends and when the ramp down begins, s."""
        return RAMP_S, RAMP_S + self.cruise_s

    def waypoints(self) -> tuple[Waypoint, ...]:
        """Return the ends of ramp up, cruise and ramp down; no cruise if there is none."""
        velocity, ramp = self.rate * self.way, 0.5 * RAMP_S * self.rate * self.way
        points = [Waypoint(RAMP_S, self.start + ramp, velocity)]
        if self.rate * RAMP_S < NO_CRUISE:
            points.append(Waypoint(RAMP_S + self.cruise_s, self.end - ramp, velocity))
        points.append(Waypoint(self.duration_s, self.end, np.zeros_like(self.end)))
        return tuple(points)

    def share(self, time_s: float) -> tuple[float, float]:
        """Return the share of the line covered at a time, s since its start, and its rate, 1/s.

        Before the start 0, after the end 1, at rate 0.
        """
        # The speed goes up from the start, and down by as much from where it is to be lost.
        up, gone_up = _ramp(time_s)
        down, gone_down = _ramp(time_s - RAMP_S - self.cruise_s)
        return min((gone_up - gone_down) * self.rate, 1.0), (up - down) * self.rate

    def time_s(self, share: float) -> float:
        """Return when a share of the way is gone, s: the inverse of `share`, clipped to 0 … 1."""
        share = min(max(share, 0.0), 1.0)
        ramp = 0.5 * RAMP_S * self.rate
        if share <= ramp:
            return float(np.sqrt(2 * RAMP_S * share / self.rate))
        if share >= 1.0 - ramp:
            return self.duration_s - float(np.sqrt(2 * RAMP_S * (1.0 - share) / self.rate))
        return 0.5 * RAMP_S + share / self.rate

    def project(self, q: FloatArray, units: JointUnits = TURNING) -> tuple[float, float]:
        """Return the share of the way (0 to 1) nearest to `q` (k,), and how far `q` is off, rad.

        Nearest by the sum of squares; the distance is of the farthest joint. A line without a way
        has the share 1.
        """
        way, gone = self.way / units.per_radian, (q - self.start) / units.per_radian
        length = float(way @ way)
        share = float(np.clip(way @ gone / length, 0.0, 1.0)) if length else 1.0
        return share, float(np.max(np.abs(gone - share * way)))


def _ramp(time_s: float) -> tuple[float, float]:
    """Return a speed that goes from 0 to 1 in `RAMP_S`, and its integral, s.

    ``time_s``: from the ramp's start, s; 0 before, and 1 after `RAMP_S`.
    """
    speed = min(max(time_s / RAMP_S, 0.0), 1.0)
    return speed, 0.5 * RAMP_S * speed**2 + max(time_s - RAMP_S, 0.0)


@dataclass(frozen=True)
class Trajectory:
    """Lines one after the other, with a rest between them."""

    lines: tuple[Line, ...]
    rest_s: float = REST_S  # Between two lines

    @cached_property
    def starts_s(self) -> tuple[float, ...]:
        """When each line begins, s from the trajectory's start, which is 0; rests included."""
        times = [0.0]
        for line in self.lines[:-1]:
            times.append(times[-1] + line.duration_s + self.rest_s)
        return tuple(times)

    @property
    def start(self) -> FloatArray:
        """Joint positions at the start, rad or m, (k,)."""
        return self.lines[0].start

    @property
    def end(self) -> FloatArray:
        """Joint positions at the end, rad or m, (k,)."""
        return self.lines[-1].end

    @property
    def points(self) -> FloatArray:
        """The polyline, rad or m, (n + 1, k) for n lines."""
        return np.array([self.lines[0].start, *(line.end for line in self.lines)])

    @property
    def duration_s(self) -> float:
        """Time from start to end, s."""
        return self.starts_s[-1] + self.lines[-1].duration_s

    def waypoints(self) -> tuple[Waypoint, ...]:
        """Return the waypoints for the controller: those of the lines, and the end of each rest.

        Times are from the trajectory's start; where it starts is no waypoint.
        """
        points: list[Waypoint] = []
        for start_s, line in zip(self.starts_s, self.lines):
            if start_s:
                # The end of the rest.
                points.append(Waypoint(start_s, line.start, np.zeros_like(line.start)))
            points += [Waypoint(start_s + p.time_s, p.q, p.velocity) for p in line.waypoints()]
        return tuple(points)

    def line_at(self, time_s: float) -> tuple[int, float]:
        """Return the index, from 0, of the line under way at a time, and the time since its start.

        In s. A rest after a line belongs to the line; before the start it is the first line, with
        a negative time.
        """
        index = max(bisect_right(self.starts_s, time_s) - 1, 0)
        return index, time_s - self.starts_s[index]

    def at(self, time_s: float) -> tuple[FloatArray, FloatArray]:
        """Return joint positions, rad or m, and velocities, per s, at a time, s, (k,) each.

        Before the start and after the end the arm stands.
        """
        index, since_s = self.line_at(time_s)
        line = self.lines[index]
        share, rate = line.share(since_s)
        return line.start + share * line.way, rate * line.way


def plan_trajectory(
    limits: MotionLimits, points: FloatArray, peaks_m: tuple[float, ...] = ()
) -> Trajectory:
    """Return the trajectory along a polyline.

    Parameters
    ----------
    limits
        Its speeds and accelerations.
    points
        rad, (n + 1, k).
    peaks_m
        For each line the speed of the fastest point where the whole way takes a second, m/s, (n,);
        none if no such limit is kept.
    """
    peaks = peaks_m or (0.0,) * (len(points) - 1)
    return Trajectory(
        tuple(
            Line.within(limits, start, end, peak)
            for (start, end), peak in zip(pairwise(points), peaks, strict=True)
        )
    )
