# SPDX-License-Identifier: Apache-2.0
"""The gate: the last check before a command is published to the controller.

A move passes if everything that the controller will make of it is allowed: the controller joins
the present state and the waypoints by cubics, and each cubic is checked by itself, independently
of the planning. A stop is another timing of the rest of the line of the move that was admitted
last, so that it is never refused and never has a target of its own.

Only what is `Admitted` is published, and only this module makes those objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from remaster_ros.errors import RemasterError
from remaster_ros.motion.limits import LONGEST_S, MotionLimits
from remaster_ros.motion.path_check import FreePath, PointSpeeds
from remaster_ros.motion.pieces import AHEAD_S, Piece, in_steps, piece_of, step_of, stop_of
from remaster_ros.motion.stopping import STOP_S, stop_on_line
from remaster_ros.motion.trajectory import (
    HEADROOM,
    RAMP_S,
    Curve,
    Line,
    Trajectory,
    Waypoint,
    plan_trajectory,
)
from remaster_ros.types import BoolArray, FloatArray

# Of a joint that slides each of these angles is `SerialChain.per_radian` (0.25 m) times as much in
# m, for the reason in `joint_units`. What the limits state is in each joint's own unit.
START_RAD = 2e-3
"""A move begins so near to where the arm stands, rad: the way between is not checked. At the end
of an arm of a metre that is 2 mm; a slide, 0.5 mm off, has nothing further off than that."""
STEP_S = 0.1
"""Where a controller draws lines the speed steps from one to the next: by no more than what the
acceleration limit allows in so much time, s. A servo follows a step within its lag, for which
`SupervisorRules.lag_s` allows 0.35 s, and which is a tenth of a second on the simulated arm."""
SLOW_RAD_S = START_RAD / 0.1
"""An arm that is no faster has hardly moved when it begins, rad/s: a tenth of a second may be
between a report of it and the command (as much as a busy machine may add to its lag)."""
ON_PATH_RAD = 1e-6
"""A waypoint is so near to the path that was checked, rad."""
BETWEEN = 9
"""And so many places between two waypoints, both included."""
TOLERANCE = 1e-3
"""Share by which speeds and accelerations may exceed their limits: noise of the present state."""
SAMPLE_RAD = 0.05
"""The speed of the fastest point is looked at every so many radians of the fastest joint, and
every 12.5 mm of a slide. That speed changes with the directions of the links, so with angles."""
CUBIC_PEAK, CUBIC_BEND = 1.5, 6.0
"""A cubic from rest to rest over a way d in a time T has at most the speed 1.5 d/T and the
acceleration 6 d/T²."""
PROBE_S = 2 * RAMP_S
"""A probe takes so long at least, s."""
FULL_TURN = 2 * np.pi
"""Taken for the range of a joint without limits, rad. One that slides has limits in every URDF."""
WAY_OUT_SPEED = 0.1
"""Share of the joint speeds on a way out of a contact or a margin."""
WAY_OUT_TOOL_SPEED = 0.05
"""Largest speed of the fastest point on it, m/s."""


NO_STAMPS = (
    'a curve is gone in pieces (horizon_s), by stamps that the controller keeps '
    '(trajectory_stamps) and that are of the clock of this computer, as those of joint_states '
    'have to be (NTP); without them measure by stop and go'
)


class MotionRefusedError(RemasterError):
    """A move that is not sent, and why."""


class StartMovedError(MotionRefusedError):
    """The arm is not, or not at rest, where the motion begins that is to be sent."""


@dataclass(frozen=True)
class Admitted:
    """Waypoints that the gate has admitted: they may be published to the controller."""

    waypoints: tuple[Waypoint, ...]  # For the controller, which begins at once
    # The lines that the arm will be on; None for a stop, which stays on those of its move, and for
    # the trajectory of another planner
    trajectory: Trajectory | None = None
    # Whether the controller is given no velocities, and draws straight lines
    is_straight: bool = False
    # Which part of `trajectory` the waypoints are; None if they are no part of one
    piece: Piece | None = None


class MotionGate:
    """Checks moves against the limits, and computes their stops.

    Parameters
    ----------
    limits
        Positions, speeds, accelerations.
    speeds
        Speed of the fastest point of arm and tool; None if no such limit is kept.

    Attributes
    ----------
    limits
        May be replaced between two moves.
    refused
        Number of moves that were not admitted.
    """

    def __init__(self, limits: MotionLimits, speeds: PointSpeeds | None = None) -> None:
        self.limits, self._speeds = limits, speeds
        self._under_way: tuple[Trajectory, MotionLimits, FreePath] | None = None
        self.refused = 0

    def admit(
        self, path: FreePath, q: FloatArray, horizon_s: float = 0.0, *, keeps_stamps: bool = True
    ) -> Admitted:
        """Check all of a move along a path that was found free; return it, or its first piece.

        It is the move under way then, for `renew`, `step` and `stop`.

        Parameters
        ----------
        path
            The path.
        q
            Where the arm stands, rad or m, (k,).
        horizon_s
            Longest time from sending a piece of the move to the end of the piece, s, as of
            `pieces.piece_of`; 0 to send all of the move at once.
        keeps_stamps
            Whether the controller keeps the stamps of trajectories; if not, the pieces are steps,
            each from rest to rest.

        Raises
        ------
        MotionRefusedError
            With the limit, the value and the joint; also a curve without a horizon or stamps.
            StartMovedError, one of these, if the arm stands more than `START_RAD` from the path's
            start.
        """
        limits = _way_out_limits(self.limits) if path.way_out else self.limits
        off = path.points[0] - q
        try:
            if not limits.units.largest(off) <= START_RAD:
                text = limits.units.in_radians(off, 4)
                raise StartMovedError(f'the arm stands {text} from the start of the path')
            if path.curve is None:
                trajectory = plan_trajectory(limits, path.points, path.peaks_m)
            elif not (horizon_s and keeps_stamps):
                raise MotionRefusedError(NO_STAMPS)
            else:
                trajectory = Trajectory((Curve.within(limits, path.curve, *path.peaks_m),))
            stands = Waypoint(0.0, q, np.zeros_like(q))
            # All of the way first: an arm is not sent where it could not go on.
            if horizon_s and not keeps_stamps:
                trajectory = in_steps(trajectory, horizon_s)
            waypoints, piece = trajectory.waypoints(), None
            self._check(waypoints, stands, path, limits)
            if horizon_s and not keeps_stamps:
                piece = step_of(trajectory, 0)
                waypoints = piece.waypoints
            elif horizon_s:
                piece = piece_of(trajectory, 0.0, horizon_s)
                waypoints = piece.waypoints
                # With a stamp it may come sooner or later than it begins.
                for time_s in (-AHEAD_S, 0.0, AHEAD_S):
                    self._check(waypoints, replace(stands, time_s=time_s), path, limits)
        except MotionRefusedError:
            self.refused += 1
            raise
        self._under_way = trajectory, limits, path
        return Admitted(waypoints, trajectory, piece=piece)

    def renew(self, sent_s: float, horizon_s: float) -> Admitted:
        """Check and return the next piece of the move under way, which replaces the present one.

        ``sent_s``: time since the start of the move, s; ``horizon_s``: as in `admit`.

        Raises MotionRefusedError as `admit`, also if nothing is left of the move; LookupError
        if no move is under way.
        """
        if self._under_way is None:
            raise LookupError('no move is under way')
        trajectory, limits, path = self._under_way
        piece = piece_of(trajectory, sent_s, horizon_s)
        first, *remaining = piece.waypoints
        try:
            if not remaining:
                raise MotionRefusedError('nothing is left of the move')
            self._check(remaining, first, path, limits)
        except MotionRefusedError:
            self.refused += 1
            raise
        return Admitted(piece.waypoints, trajectory, piece=piece)

    def step(self, index: int, q: FloatArray) -> Admitted:
        """Check and return one line of the trajectory of the move under way, to be sent now.

        ``index``: of the line in `Trajectory.lines`, from 0; ``q``: where the arm stands, rad
        or m, (k,). Waypoint times count from the line's start.

        Raises MotionRefusedError as `admit`; StartMovedError, one of these, if the arm stands
        more than `START_RAD` from the line's start; LookupError if no move is under way.
        """
        if self._under_way is None:
            raise LookupError('no move is under way')
        trajectory, limits, path = self._under_way
        piece, start_s = step_of(trajectory, index), trajectory.starts_s[index]
        sent = tuple(replace(p, time_s=p.time_s - start_s) for p in piece.waypoints)
        off = trajectory.lines[index].start - q
        try:
            if not limits.units.largest(off) <= START_RAD:
                text = limits.units.in_radians(off, 4)
                raise StartMovedError(f'the arm stands {text} from the start of the step')
            self._check(sent, Waypoint(0.0, q, np.zeros_like(q)), path, limits)
        except MotionRefusedError:
            self.refused += 1
            raise
        return Admitted(sent, trajectory, piece=piece)

    def admit_probe(self, path: FreePath, q: FloatArray, doubtful: BoolArray) -> Admitted:
        """Return a minimal move, harmless even if the arm is not where it is reported.

        A controller begins it where the arm really is. It has a single waypoint, so far ahead
        in time that from anywhere within the limits of the doubtful joints no speed and no
        acceleration is above its limit. Neither `stop` nor `stop_on_curve` can stop it.

        ``path``: from `q` to a place next to it; ``q``: where the arm is reported, rad or m,
        (k,); ``doubtful``: which joints may be elsewhere, (k,).

        Raises MotionRefusedError as `admit`, also if it would take longer than `LONGEST_S`.
        """
        limits = self.limits
        farthest = np.maximum(q - limits.lower, limits.upper - q)
        farthest = np.where(np.isfinite(farthest), farthest, FULL_TURN)
        tolerance = START_RAD * limits.units.per_radian
        way = np.where(doubtful, np.maximum(farthest, tolerance), tolerance)
        times = [
            PROBE_S,
            *(CUBIC_PEAK * way / limits.velocity),
            *np.sqrt(CUBIC_BEND * way / limits.acceleration),
        ]
        if self._speeds is not None:
            point_m = float(np.sum(way * self._speeds.reach_m))
            times.append(CUBIC_PEAK * point_m / limits.tool_speed)
        time_s = max(times)
        if not time_s <= LONGEST_S:
            self.refused += 1
            raise MotionRefusedError(_too_long())
        start, end = path.points
        # A line that takes as long; what the controller is sent is its end alone.
        trajectory = Trajectory((Line(start, end, 1.0 / (time_s - RAMP_S)),))
        waypoints = (Waypoint(time_s, end, np.zeros_like(end)),)
        try:
            self._check(waypoints, Waypoint(0.0, q, np.zeros_like(q)), path, limits)
        except MotionRefusedError:
            self.refused += 1
            raise
        self._under_way = None
        return Admitted(waypoints, trajectory)

    def stop(self, low_s: float, high_s: float) -> Admitted:
        """Return a stop along the line that the arm is on: one waypoint, at rest.

        Another timing of what was admitted: it is not checked. On a curve that line is its
        straight beginning; `stop_on_curve` stops an arm behind that. No move is under way
        afterwards.

        Parameters
        ----------
        low_s, high_s
            Times since the start of the move between which the arm is on the trajectory, s.

        Raises
        ------
        LookupError
            No move is under way: none was admitted, the last one was stopped, or it was a probe.
        """
        if self._under_way is None:
            raise LookupError('no move is under way')
        trajectory, limits, _ = self._under_way
        index, since_s = trajectory.line_at(high_s)
        low_since_s = max(low_s - trajectory.starts_s[index], 0.0)
        line = trajectory.lines[index]
        if isinstance(line, Curve):
            line = line.lead
        # In the rest after a line both times lie past its end.
        end_s = line.duration_s
        stop = stop_on_line(line, min(low_since_s, end_s), min(since_s, end_s), limits)
        self._under_way = None
        return Admitted((stop,))

    def stop_on_curve(self, sent_s: float, cut_s: float) -> Admitted:
        """Return a stop along the curve that is under way, as its last piece.

        ``sent_s``: when the piece is sent; ``cut_s``: when it leaves the timing of the curve
        to brake; s since the move's start. Only the timing of what was admitted is changed: it
        needs no check, and is not refused. No move is under way afterwards. Raises LookupError
        if none was before.
        """
        if self._under_way is None:
            raise LookupError('no move is under way')
        trajectory, *_ = self._under_way
        piece = stop_of(trajectory, sent_s, cut_s)
        self._under_way = None
        return Admitted(piece.waypoints, trajectory, piece=piece)

    def _check(
        self,
        waypoints: Sequence[Waypoint],
        start: Waypoint,
        path: FreePath,
        limits: MotionLimits,
    ) -> None:
        """Raise MotionRefusedError unless the cubics from `start` to each waypoint are allowed.

        Each cubic is checked: positions within the limits less their margin (an arm that
        stands outside may stay there, or go inwards), speeds and accelerations (with
        `TOLERANCE`), `tool_speed`, and at most `ON_PATH_RAD` off the path (on the first one,
        before its end, `START_RAD` √k more, for what the arm stands off). Times must increase;
        the last waypoint must be at rest, and at most `LONGEST_S` ahead.
        """
        units, q = limits.units, start.q
        low = np.minimum(limits.lower + limits.margins, q)
        high = np.maximum(limits.upper - limits.margins, q)
        points = [start, *waypoints]
        if np.any(points[-1].velocity != 0.0):
            raise MotionRefusedError('the move does not end at rest')
        places: list[FloatArray] = []
        for before, after in pairwise(points):
            piece = Cubic.between(before, after)
            if not piece.duration_s > 0.0 or not np.all(np.isfinite(piece.coefficients)):
                raise MotionRefusedError('the times of the move do not increase')
            _check_range(*piece.range(), low, high, limits)
            _check_rate('speed', piece.largest_speed(), limits.velocity, 's', limits)
            largest = piece.largest_acceleration()
            _check_rate('acceleration', largest, limits.acceleration, 's2', limits)
            self._check_point_speed(piece, limits)
            places += [after.q, *piece.at(np.linspace(0.0, piece.duration_s, BETWEEN))]
        offs = path.offs(np.array(places), units).reshape(-1, BETWEEN + 1, len(q))
        for number, (at_end, *between) in enumerate(offs):
            if not units.largest(at_end) <= ON_PATH_RAD:
                text = units.in_radians(at_end, 6)
                raise MotionRefusedError(f'a waypoint lies {text} off the path found free')
            # What the arm stands off the start of the path is lost on the first piece.
            allowed = 0.0 if number else START_RAD * np.sqrt(len(q))
            off = max(between, key=units.largest)
            if not units.largest(off) <= allowed + ON_PATH_RAD:
                text = units.in_radians(off, 6)
                raise MotionRefusedError(
                    f'the move leaves the path found free by {text} between two waypoints'
                )
        if not points[-1].time_s <= LONGEST_S:
            raise MotionRefusedError(_too_long())

    def _check_point_speed(self, piece: Cubic, limits: MotionLimits) -> None:
        """Raise MotionRefusedError if a cubic moves a point faster than `limits.tool_speed`.

        Looked at some every `SAMPLE_RAD`, with `TOLERANCE`; no check without a limit or
        without the speeds of points.
        """
        if self._speeds is None or not np.isfinite(limits.tool_speed):
            return
        way = piece.at(piece.duration_s) - piece.at(0.0)
        count = 5 + int(limits.units.largest(way) / SAMPLE_RAD)
        times = np.linspace(0.0, piece.duration_s, count)
        fastest = float(np.max(self._speeds.fastest(piece.at(times), piece.velocity(times))))
        if not fastest <= limits.tool_speed * (1.0 + TOLERANCE):
            raise MotionRefusedError(
                f'the fastest point of arm and tool would move at {fastest:.3f} m/s; '
                f'{limits.tool_speed:g} m/s are allowed'
            )


class ForeignGate:
    """Checks trajectories of other planners against joint limits.

    What leads where is theirs: no path was found free here, and nothing is known of what
    stands in the way. What is looked at is what the controller makes of a trajectory, from
    where the arm is: positions, speeds, accelerations, and that it ends at rest.

    Parameters
    ----------
    limits
        Positions, speeds and accelerations, without a margin.
    """

    def __init__(self, limits: MotionLimits) -> None:
        self.limits = limits

    def admit(
        self,
        waypoints: Sequence[Waypoint],
        q: FloatArray,
        velocity: FloatArray,
        *,
        is_straight: bool = False,
    ) -> Admitted:
        """Check a trajectory, and return it; the controller begins it at once.

        Parameters
        ----------
        waypoints
            At times that ascend; none for a controller that is to hold the arm (not checked).
        q, velocity
            Where the arm is, rad or m, and how fast, per s, (k,); the velocity is 0 if it stands.
        is_straight
            Whether the controller is given no velocities, and draws straight lines.

        Raises
        ------
        MotionRefusedError
            With the limit, the value and the joint.
            StartMovedError, one of these, if the first waypoint is for time 0 and not where the
            arm stands.
        """
        if not waypoints:
            return Admitted(())
        limits = self.limits
        low, high = np.minimum(limits.lower, q), np.maximum(limits.upper, q)
        points = list(waypoints)
        if points[0].time_s > 0.0:
            points.insert(0, Waypoint(0.0, q, velocity))
        else:
            self._check_start(points[0], q, velocity)
        if not is_straight and np.any(points[-1].velocity != 0.0):
            raise MotionRefusedError('the trajectory does not end at rest')
        # All pieces in one: a planner's trajectory has a hundred.
        times = np.array([point.time_s for point in points])[:, None]
        places, speeds = (
            np.array([getattr(p, field) for p in points]) for field in ('q', 'velocity')
        )
        if is_straight:
            with np.errstate(divide='ignore', invalid='ignore'):
                # The lines that a controller draws without velocities.
                first = last = np.diff(places, axis=0) / np.diff(times, axis=0)
        else:
            first, last = speeds[:-1], speeds[1:]
        pieces = Cubic.hermite(np.diff(times, axis=0), places[:-1], first, places[1:], last)
        if not np.all(pieces.duration_s > 0.0) or not np.all(np.isfinite(pieces.coefficients)):
            raise MotionRefusedError('the times of the trajectory do not increase')
        least, most = pieces.range()
        _check_range(least.min(axis=0), most.max(axis=0), low, high, limits)
        largest = pieces.largest_speed().max(axis=0)
        _check_rate('speed', largest, limits.velocity, 's', limits)
        largest = pieces.largest_acceleration().max(axis=0)
        _check_rate('acceleration', largest, limits.acceleration, 's2', limits)
        if is_straight:
            # Where two lines meet, and at rest before the first and behind the last.
            zeros = np.zeros_like(q)
            begins = velocity if waypoints[0].time_s > 0.0 else zeros
            rates = np.vstack((begins, first, zeros))
            steps = np.abs(np.diff(rates, axis=0)).max(axis=0)
            _check_rate('step of its speed', steps, STEP_S * limits.acceleration, 's', limits)
        return Admitted(tuple(waypoints), None, is_straight)

    def brake(self, q: FloatArray, velocity: FloatArray) -> Admitted:
        """Return a stop at constant deceleration from the arm's present place and velocity.

        It takes `STOP_S`, or longer to stay within the acceleration limits. Without waypoints
        (the controller holds the arm at once) if the stop would lead beyond a position limit.
        ``q, velocity``: where the arm is, rad or m, and how fast, per s, (k,).
        """
        limits = self.limits
        hardest = float(np.max(np.abs(velocity) / limits.acceleration))
        time_s = max(STOP_S, hardest / HEADROOM)
        end = q + 0.5 * time_s * velocity
        if np.any((end < limits.lower) | (end > limits.upper)):
            return Admitted(())
        return Admitted((Waypoint(time_s, end, np.zeros_like(end)),))

    def _check_start(self, first: Waypoint, q: FloatArray, velocity: FloatArray) -> None:
        """Raise StartMovedError unless the trajectory begins where the arm is, and the arm stands.

        It may begin `START_RAD` away, and the arm may move at `SLOW_RAD_S`. ``q, velocity``:
        where the arm is, rad or m, and how fast, per s, (k,).
        """
        off, units = np.abs(first.q - q), self.limits.units
        if not units.largest(off) <= START_RAD:
            joint = units.farthest(off)
            text = units.in_degrees(joint, float(off[joint]))
            raise StartMovedError(f'it begins {text} from where {self.limits.names[joint]} is')
        if not units.largest(velocity) <= SLOW_RAD_S:
            raise StartMovedError('it begins at once while the arm moves')


def _too_long() -> str:
    """Reason of a refusal: the motion would take longer than `LONGEST_S`."""
    return f'it would take longer than {LONGEST_S / 3600.0:.0f} h with these limits of speed'


def _way_out_limits(limits: MotionLimits) -> MotionLimits:
    """Limits for a slow way out of a contact.

    `WAY_OUT_SPEED` times the joint speeds of ``limits``, and at most `WAY_OUT_TOOL_SPEED` for
    the fastest point; the other limits are the same.
    """
    return replace(
        limits,
        velocity=WAY_OUT_SPEED * limits.velocity,
        tool_speed=min(limits.tool_speed, WAY_OUT_TOOL_SPEED),
    )


def _check_range(
    least: FloatArray, most: FloatArray, low: FloatArray, high: FloatArray, limits: MotionLimits
) -> None:
    """Raise MotionRefusedError if a range, `least` to `most`, leaves `low` to `high`, (k,).

    By more than rounding, 1e-9. ``limits``: for names and units.
    """
    # To rounding: an arm that stands outside may stay there, and go inwards.
    bad = (least < low - 1e-9) | (most > high + 1e-9)
    if np.any(bad):
        joint = int(np.argmax(bad))
        value = least[joint] if least[joint] < low[joint] else most[joint]
        raise MotionRefusedError(
            f'{limits.names[joint]} would go to {limits.units.in_degrees(joint, value)}; its '
            f'limits less the margin are {limits.shown(joint, low[joint], high[joint])}'
        )


def _check_rate(
    what: str, largest: FloatArray, allowed: FloatArray, per: str, limits: MotionLimits
) -> None:
    """Raise MotionRefusedError if a joint's largest rate, (k,), is above the allowed rate.

    By more than `TOLERANCE`; NaN is above. ``what``: 'speed' or the like; ``per``: unit of time
    for the message, 's' or 's2'.
    """
    bad = ~(largest <= allowed * (1.0 + TOLERANCE))
    if np.any(bad):
        joint = int(np.argmax(largest / allowed))
        value, unit = limits.units.rate(joint, largest[joint], per)
        most, _ = limits.units.rate(joint, allowed[joint], per)
        raise MotionRefusedError(
            f'{limits.names[joint]} would have a {what} of {value} {unit}; {most} are allowed'
        )


@dataclass(frozen=True)
class Cubic:
    """Cubic that a controller interpolates between two waypoints, or n such cubics."""

    duration_s: float | FloatArray  # s; of n cubics (n, 1)
    # Of the powers of time since its start, lowest first, (4, k); of n cubics (4, n, k)
    coefficients: FloatArray

    @classmethod
    def between(cls, before: Waypoint, after: Waypoint) -> Cubic:
        """Return the cubic that has two waypoints' positions and velocities (Hermite).

        Its coefficients are not finite if both have the same time.
        """
        duration_s = after.time_s - before.time_s
        return cls.hermite(duration_s, before.q, before.velocity, after.q, after.velocity)

    @classmethod
    def hermite(
        cls,
        duration_s: float | FloatArray,
        q: FloatArray,
        velocity: FloatArray,
        end_q: FloatArray,
        end_velocity: FloatArray,
    ) -> Cubic:
        """Return the cubics with given positions and velocities at both ends (Hermite).

        For n cubics: ``duration_s``: s, (n, 1); ``q, velocity``: at the start, rad or m, per
        s, (n, k); ``end_q, end_velocity``: at the end, (n, k). For one cubic: a number, and
        (k,). With a duration of 0 the coefficients are not finite.
        """
        gap = end_q - q
        with np.errstate(divide='ignore', invalid='ignore'):
            second = (3 * gap / duration_s - 2 * velocity - end_velocity) / duration_s
            third = (velocity + end_velocity - 2 * gap / duration_s) / duration_s**2
        return cls(duration_s, np.array([q, velocity, second, third]))

    def at(self, time_s: float | FloatArray) -> FloatArray:
        """Return positions, rad or m, (k,) or (n, k) for times (n,).

        ``time_s``: since the start, s; beyond the end the cubic goes on.
        """
        powers = np.power.outer(time_s, np.arange(4))
        return powers @ self.coefficients

    def velocity(self, time_s: float | FloatArray) -> FloatArray:
        """Return velocities, rad/s or m/s, (k,) or (n, k).

        ``time_s``: since the start, s; one or (n,).
        """
        powers = np.power.outer(time_s, np.arange(3))
        return powers @ (self.coefficients[1:] * np.array([[1.0], [2.0], [3.0]]))

    def range(self) -> tuple[FloatArray, FloatArray]:
        """Return the smallest and the largest position of each joint, (k,) or (n, k) each.

        Over the whole cubic, between its ends too; rad or m.
        """
        _, velocity, second, third = self.coefficients
        # Where the velocity v + 2 c t + 3 d t^2 is zero, and at both ends.
        root = np.sqrt(np.maximum(second**2 - 3 * third * velocity, 0.0))
        with np.errstate(divide='ignore', invalid='ignore'):
            # The form that does not lose digits where the cubic is nearly a parabola.
            flat = -(second + np.where(second >= 0.0, root, -root))
            times = np.array([flat / (3 * third), velocity / flat])
        times = np.clip(np.nan_to_num(times), 0.0, self.duration_s)
        ends = np.zeros_like(times)
        ends[1] = self.duration_s
        times = np.concatenate([times, ends])
        values = sum(c * times**power for power, c in enumerate(self.coefficients))
        return np.min(values, axis=0), np.max(values, axis=0)

    def largest_speed(self) -> FloatArray:
        """Return the largest absolute velocity of each joint, its unit/s, (k,) or (n, k)."""
        _, velocity, second, third = self.coefficients
        with np.errstate(divide='ignore', invalid='ignore'):
            middle = np.nan_to_num(-second / (3 * third))
        times = np.array([np.zeros_like(middle), np.clip(middle, 0.0, self.duration_s)])
        times = np.concatenate([times, np.broadcast_to(self.duration_s, (1, *middle.shape))])
        return np.max(np.abs(velocity + 2 * second * times + 3 * third * times**2), axis=0)

    def largest_acceleration(self) -> FloatArray:
        """Return the largest absolute acceleration of each joint, its unit/s², (k,) or (n, k)."""
        _, _, second, third = self.coefficients
        ends = np.array([2 * second, 2 * second + 6 * third * self.duration_s])
        return np.max(np.abs(ends), axis=0)
