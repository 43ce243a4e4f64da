# SPDX-License-Identifier: Apache-2.0
"""Trajectories: straight lines and curves in joint space, each from rest to rest.

A controller joins positions and velocities by cubics, as joint_trajectory_controller does; it then
follows the ramps of a line at constant acceleration, and never leaves the line. A curve is a cubic
spline, of which it follows each piece; its ramps are on its straight ends.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from remaster_ros.motion.joint_units import TURNING, JointUnits
from remaster_ros.motion.limits import LONGEST_S, MotionLimits
from remaster_ros.motion.spline import Spline
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
LEAD_S = 0.9
"""The straight piece at the beginning of a curve takes so long at its cruising speed, s: until
a piece of it can be replaced (`pieces.JOINED_S`) the arm is stopped on a line."""
BRAKE_STEP_S = 0.02
"""A stop on a curve has a waypoint after each such time, s: the cubics between are within some
1e-7 rad of the curve where joints accelerate at some rad/s²."""
NO_CRUISE = 1.0 - 2.0**-20
"""Ramps that take this share of the way have none between them: two waypoints need two times."""


ALWAYS = (0.0, LONGEST_S)
"""From the start of any motion to its end, s."""


@dataclass(frozen=True)
class Waypoint:
    """A point of a trajectory: time from its start (s), positions, velocities (per s)."""

    time_s: float
    q: FloatArray
    velocity: FloatArray


@dataclass(frozen=True)
class RampedPath:
    """A path from rest to rest, whose speed has a ramp up, a cruise and a ramp down."""

    # Joint positions at rest, rad or m, (k,)
    start: FloatArray
    end: FloatArray
    rate: float  # Share of the path per second while cruising, 1/s; at most 1/`RAMP_S`

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

    def share(self, time_s: float) -> tuple[float, float]:
        """Return the share of the path covered at a time, s since its start, and its rate, 1/s.

        Before the start 0, after the end 1, at rate 0.
        """
        # The speed goes up from the start, and down by as much from where it is to be lost.
        up, gone_up = _ramp(time_s)
        down, gone_down = _ramp(time_s - RAMP_S - self.cruise_s)
        return min((gone_up - gone_down) * self.rate, 1.0), (up - down) * self.rate

    def time_s(self, share: float) -> float:
        """Return when a share of the path is covered, s since its start: the inverse of `share`.

        ``share``: clipped to 0 … 1.
        """
        share = min(max(share, 0.0), 1.0)
        ramp = 0.5 * RAMP_S * self.rate
        if share <= ramp:
            return float(np.sqrt(2 * RAMP_S * share / self.rate))
        if share >= 1.0 - ramp:
            return self.duration_s - float(np.sqrt(2 * RAMP_S * (1.0 - share) / self.rate))
        return 0.5 * RAMP_S + share / self.rate


@dataclass(frozen=True)
class Line(RampedPath):
    """A straight line in joint space; all joints arrive together."""

    @classmethod
    def within(
        cls, limits: MotionLimits, start: FloatArray, end: FloatArray, peak_m: float = 0.0
    ) -> Line:
        """Return the fastest line within `HEADROOM` times the allowed speeds and accelerations.

        Of the acceleration limits only the share `STOPPABLE` is allowed. ``start, end``: rad
        or m, (k,); ``peak_m``: speed of the fastest point of arm and tool if the whole way
        takes a second, m/s; 0 for no such limit. The rate is never below 0.1 / `LONGEST_S`,
        even if that is above a limit: a line at that rate takes too long for the gate, which
        refuses it.
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
        """Motion from start to end, rad or m, (k,)."""
        return self.end - self.start

    @property
    def corners(self) -> FloatArray:
        """Places between which the path is straight, rad or m: its ends, (2, k)."""
        return np.array([self.start, self.end])

    def at(self, time_s: float) -> tuple[FloatArray, FloatArray]:
        """Return joint positions, rad or m, and velocities, per s, at a time, s, (k,) each."""
        share, rate = self.share(time_s)
        return self.start + share * self.way, rate * self.way

    def waypoints(self) -> tuple[Waypoint, ...]:
        """Return the waypoints at the ends of ramp up, cruise (if there is one) and ramp down.

        Times are from the line's start, which is no waypoint.
        """
        velocity, ramp = self.rate * self.way, 0.5 * RAMP_S * self.rate * self.way
        points = [Waypoint(RAMP_S, self.start + ramp, velocity)]
        if self.rate * RAMP_S < NO_CRUISE:
            points.append(Waypoint(RAMP_S + self.cruise_s, self.end - ramp, velocity))
        points.append(Waypoint(self.duration_s, self.end, np.zeros_like(self.end)))
        return tuple(points)

    def brake(self, time_s: float) -> tuple[Waypoint, ...]:
        """Return the waypoint of a stop in `RAMP_S` on the line from a time on, s since its start.

        As even as the line's own ramps; the waypoint's time is since the stop's beginning.
        """
        q, velocity = self.at(time_s)
        return (Waypoint(RAMP_S, q + 0.5 * RAMP_S * velocity, np.zeros_like(q)),)

    def project(
        self, q: FloatArray, units: JointUnits = TURNING, window_s: tuple[float, float] = ALWAYS
    ) -> tuple[float, float]:
        """Return the share of the way (0 to 1) nearest to `q` (k,), and how far `q` is off, rad.

        Nearest by the sum of squares; the distance is of the farthest joint. A line without a way
        has the share 1. ``window_s``: as of `Curve.project`; a line has one nearest place.
        """
        way, gone = self.way / units.per_radian, (q - self.start) / units.per_radian
        length = float(way @ way)
        share = float(np.clip(way @ gone / length, 0.0, 1.0)) if length else 1.0
        return share, float(np.max(np.abs(gone - share * way)))

    def place(self, share: float) -> FloatArray:
        """Return the configuration at a share of the way, rad or m, (k,)."""
        return self.start + share * self.way


@dataclass(frozen=True, eq=False)
class Curve(RampedPath):
    """A spline gone at a constant rate of its share, except on the ramps at both ends."""

    spline: Spline

    @classmethod
    def within(cls, limits: MotionLimits, spline: Spline, peak_m: float = 0.0) -> Curve:
        """Return the fastest motion along a spline within `HEADROOM` times the limits.

        At every place within the speeds, and within the accelerations also of a stop in
        `RAMP_S` from there. The straight piece at the beginning is begun and stopped as a line
        is, and takes at least `LEAD_S`; that at the end holds the ramp. ``peak_m``: as of
        `Line.within`. The rate is never below 0.1 / `LONGEST_S`, even if that is above a
        limit: a motion at that rate takes too long for the gate, which refuses it.
        """
        rate = min(
            float(np.min(allowed_rates(limits, spline))),
            spline.straight_until / LEAD_S,
            (1.0 - spline.straight_from) / RAMP_S,
        )
        if peak_m > 0.0:
            rate = min(rate, HEADROOM * limits.tool_speed / peak_m)
        return cls(spline.start, spline.end, max(rate, 0.1 / LONGEST_S), spline)

    @property
    def lead(self) -> Line:
        """The straight piece at the beginning, as a line at the same speed.

        Curve and line are the same motion until the line's ramp down begins.
        """
        until = self.spline.straight_until
        return Line(self.start, self.place(until), self.rate / until)

    @property
    def corners(self) -> FloatArray:
        """Places between which the path is nearly straight (`SAGITTA_RAD`), rad or m, (p, k)."""
        return self.spline.samples[1]

    def at(self, time_s: float) -> tuple[FloatArray, FloatArray]:
        """Return joint positions, rad or m, and velocities, per s, at a time, s, (k,) each."""
        share, rate = self.share(time_s)
        return self.place(share), rate * self.spline.at(np.array([share]), 1)[0]

    def place(self, share: float) -> FloatArray:
        """Return the configuration at a share of the curve, rad or m, (k,)."""
        return self.spline.at(np.array([share]))[0]

    def waypoints(self) -> tuple[Waypoint, ...]:
        """Return waypoints at the end of the ramp up, knots, the begin of the ramp down, the end.

        Between two of them the curve is one cubic of time. Times are from the curve's start.
        """
        begins_s, ends_s = self.kinks_s
        low, high = self.share(begins_s)[0], self.share(ends_s)[0]
        inner = self.spline.knots[(self.spline.knots > low) & (self.spline.knots < high)]
        times = [begins_s, *map(self.time_s, inner), ends_s]
        moving = [Waypoint(time_s, *self.at(time_s)) for time_s in times]
        return (*moving, Waypoint(self.duration_s, self.end, np.zeros_like(self.end)))

    def brake(self, time_s: float) -> tuple[Waypoint, ...]:
        """Return the waypoints of a stop in `RAMP_S` along the curve from a time on.

        The rate of the share falls evenly; the waypoints' times are since the stop's beginning.
        """
        share, rate = self.share(time_s)
        since = np.linspace(0.0, RAMP_S, round(RAMP_S / BRAKE_STEP_S) + 1)[1:]
        shares = share + rate * since * (1.0 - since / (2.0 * RAMP_S))
        rates = rate * (1.0 - since / RAMP_S)
        rates[-1] = 0.0
        velocities = rates[:, None] * self.spline.at(shares, 1)
        return tuple(map(Waypoint, since.tolist(), self.spline.at(shares), velocities))

    def project(
        self, q: FloatArray, units: JointUnits = TURNING, window_s: tuple[float, float] = ALWAYS
    ) -> tuple[float, float]:
        """Return the share nearest to `q` (k,), and how far `q` is off, rad.

        ``window_s``: times since the start between which the place is looked for, s: a curve may
        cross itself, or come near itself. Distances as of `Line.project`.
        """
        low, high = (self.share(time_s)[0] for time_s in window_s)
        share = float(self.spline.nearest(q[None], units, low, high)[0])
        return share, units.largest(q - self.place(share))


def allowed_rates(limits: MotionLimits, spline: Spline) -> FloatArray:
    """Return the largest rate of the share at each sample of a spline, 1/s, (p,).

    Within `HEADROOM` times the joints' limits of speed, and of acceleration also during a stop
    in `RAMP_S` from there. On the straight piece at the beginning, a ramp of `RAMP_S` from rest
    to the rate also takes at most `HEADROOM` times `STOPPABLE` of the acceleration limits, as
    of a `Line`. The limit of the speed of points (``tool_speed``) is not considered.
    """
    shares, _ = spline.samples
    first, second = (np.abs(spline.at(shares, order)) for order in (1, 2))
    # r² |q''| + r |q'| / RAMP_S = a, solved for the rate r in a form that needs no q''.
    a, b = HEADROOM * limits.acceleration, first / RAMP_S
    rates = 2.0 * a / (b + np.sqrt(b**2 + 4.0 * second * a) + 1e-300)
    speed = np.max(first / limits.velocity, axis=1)
    lead = np.max(first / (STOPPABLE * limits.acceleration * RAMP_S), axis=1)
    slowest = np.where(shares <= spline.straight_until, np.maximum(speed, lead), speed)
    return np.minimum(np.min(rates, axis=1), HEADROOM / np.maximum(slowest, 1e-12))


def _ramp(time_s: float) -> tuple[float, float]:
    """Return a speed that rises linearly from 0 to 1 in `RAMP_S`, and its integral, s.

    ``time_s``: from the ramp's start, s; 0 before, and 1 after `RAMP_S`.
    """
    speed = min(max(time_s / RAMP_S, 0.0), 1.0)
    return speed, 0.5 * RAMP_S * speed**2 + max(time_s - RAMP_S, 0.0)


@dataclass(frozen=True)
class Trajectory:
    """Lines one after the other, with a rest between them; or a single curve."""

    lines: tuple[Line | Curve, ...]
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
        """The polyline, rad or m, (n + 1, k) for n lines; of a curve its samples."""
        return np.concatenate([self.start[None], *(line.corners[1:] for line in self.lines)])

    @property
    def is_curve(self) -> bool:
        """Whether it is a curve."""
        return isinstance(self.lines[0], Curve)

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
        return self.lines[index].at(since_s)


def plan_trajectory(
    limits: MotionLimits, points: FloatArray, peaks_m: tuple[float, ...] = ()
) -> Trajectory:
    """Return the fastest trajectory along a polyline, which rests at each corner.

    Parameters
    ----------
    limits
        Its speeds and accelerations.
    points
        Corners, rad or m, (n + 1, k).
    peaks_m
        For each line the speed of the fastest point where the whole way takes a second, m/s, (n,);
        () if no such limit is kept.
    """
    peaks = peaks_m or (0.0,) * (len(points) - 1)
    return Trajectory(
        tuple(
            Line.within(limits, start, end, peak)
            for (start, end), peak in zip(pairwise(points), peaks, strict=True)
        )
    )
