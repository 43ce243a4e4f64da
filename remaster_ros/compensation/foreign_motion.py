# SPDX-License-Identifier: Apache-2.0
"""Trajectories of other planners, corrected on their way to the controller, and the way back.

A planner that knows nothing of a correction plans for the nominal arm. It must be told where that
would have to be to have its tool where the arm has it (`TrueAngles`); what it then wants is
corrected and handed to the motion gate (`passed_on`). Both ways fit: what is planned from the
angles it was told begins where the arm is.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from remaster_ros.compensation.compensator import Compensator
from remaster_ros.compensation.in_use import CorrectionInUse
from remaster_ros.compensation.trajectories import (
    DrawnPath,
    Now,
    corrected_points,
    corrected_trajectory,
    largest_speeds,
)
from remaster_ros.errors import InputError
from remaster_ros.motion.following import FRESH_S, STANDING_S
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import (
    Admitted,
    ForeignGate,
    MotionRefusedError,
    StartMovedError,
)
from remaster_ros.motion.settling import SettleRules
from remaster_ros.motion.trajectory import Waypoint
from remaster_ros.types import BoolArray, FloatArray

SPEED_TOLERANCE = 0.01
"""A planner's speeds may exceed the limits by this share: its splines are sampled."""
REST_RAD_S = 1e-7
"""An end speed that is rounding, rad/s: joint_trajectory_controller takes no larger one (the
resolution of a float)."""
NEAR_RAD = 2e-4
"""So near to angles whose correction is known it is taken as it is there, rad: it changes by some
hundredths of the way. So near to the end of a trajectory the arm has arrived: it stands still."""
KNOWN_RAD = 1e-7
"""It is known where a further step changes less, rad: an encoder of 23 bits reads 7e-7."""
PLACES = 33
"""A stretch of a path is looked at in so many places."""
LONGEST_S = 3600.0
"""No trajectory of a planner takes longer, s: an hour. Switching waits for its end, and a slip of
the unit is a thousand times as long."""
EVERY_S = 0.02
"""While the arm moves the correction of reported angles is found anew so often, s."""
ADDED_RAD_S = 0.5
"""So fast it changes at the most, rad/s: from one bound of its budget to the other in 0.14 s. It
changes by some hundredths of the way, and joints go at a few radians a second."""
MOST_REACH_S = 0.2
"""What was found longer ago is changed no further at once, s: reports that failed to come."""


@dataclass(frozen=True)
class Trajectory:
    """A planner's trajectory: n points of k joints in the arm's order."""

    times_s: FloatArray  # From its start, (n,)
    # rad and rad/s, (n, k); velocities are None where the controller draws lines
    positions: FloatArray
    velocities: FloatArray | None


@dataclass(frozen=True)
class Passed:
    """What is sent in place of a planner's trajectory."""

    admitted: Admitted  # What the gate has let pass
    end_s: float  # When it ends, from its start
    # Where the arm was when this was worked out, rad and rad/s, (k,) each, and whether it stood
    start: FloatArray
    velocity: FloatArray
    stood: bool
    notes: tuple[str, ...] = ()  # What a person is to know of it, a line each
    # What is commanded at its end, and what was wanted there, rad, (k,); None where it is held
    end: tuple[FloatArray, FloatArray] | None = None

    def places(self, since_s: float, until_s: float) -> FloatArray:
        """Return where the controller leads the arm between two times from its start, (n, k)."""
        waypoints = self.admitted.waypoints
        times = np.array([0.0, *(point.time_s for point in waypoints)])
        q = np.array([self.start, *(point.q for point in waypoints)])
        v = np.array([self.velocity, *(point.velocity for point in waypoints)])
        first = 1 if times[1] <= 0.0 else 0
        drawn = DrawnPath(
            times[first:], q[first:], None if self.admitted.is_straight else v[first:]
        )
        between = np.linspace(since_s, until_s, PLACES)
        return drawn.at(np.clip(between, times[first], times[-1]))


class Present:
    """Where an arm is by its last reports, how fast, and whether it stands."""

    def __init__(self) -> None:
        self._reports: deque[tuple[float, FloatArray]] = deque()
        self._wall_s = -np.inf
        self._still_rad = SettleRules().still_tolerance

    def take(self, stamp_s: float, q: FloatArray, wall_s: float) -> None:
        """Take a report: its stamp, positions, rad, (k,), and when it came.

        One of the same time is the one before again; an earlier one begins anew: a clock was set
        back.
        """
        reports = self._reports
        if reports and stamp_s == reports[-1][0]:
            return
        if reports and stamp_s < reports[-1][0]:
            reports.clear()
        reports.append((stamp_s, q))
        while len(reports) > 2 and reports[1][0] <= stamp_s - STANDING_S:
            reports.popleft()
        self._wall_s = wall_s

    def snapshot(self) -> Present:
        """Return it as it is now, for another thread."""
        taken = Present()
        taken._reports, taken._wall_s = self._reports.copy(), self._wall_s
        return taken

    def is_fresh(self, wall_s: float) -> bool:
        """Whether the last report still shows where the arm is."""
        return wall_s - self._wall_s <= FRESH_S

    @property
    def q(self) -> FloatArray:
        """Where it is, rad, (k,)."""
        return self._reports[-1][1]

    @property
    def is_known(self) -> bool:
        """Whether there are two reports, which it takes to know how fast it is."""
        return len(self._reports) > 1

    @property
    def velocity(self) -> FloatArray:
        """How fast, rad/s, (k,): none at all where it stands."""
        if self.stands:
            return np.zeros_like(self.q)
        (before_s, before), (stamp_s, q) = self._reports[-2], self._reports[-1]
        return (q - before) / (stamp_s - before_s)

    @property
    def stands(self) -> bool:
        """Whether it has not moved for `following.STANDING_S`."""
        reports = self._reports
        if not reports or reports[-1][0] - reports[0][0] < STANDING_S:
            return False
        return bool(np.ptp([q for _, q in reports], axis=0).max() <= self._still_rad)


class TrueAngles:
    """Angles of the nominal arm with its tool where the arm has it, report by report.

    They go on from report to report: near singularities, where several do, no other ones are told
    while the arm moves on. Where the arm comes to rest at the end of a trajectory they are what
    the planner wanted there.

    ``compensator``: the correction.
    """

    def __init__(self, compensator: Compensator) -> None:
        self._compensator = compensator
        # What is to be added to reported angles, rad, where that was found, and when (s).
        self.added: FloatArray = np.zeros(compensator.model.joints)
        self._at: FloatArray | None = None
        self._warm: float | None = None
        self._found_s = -np.inf
        self._is_known = False
        # Where the last trajectory leads: what is commanded there, and what was wanted, (k,)
        self._end: tuple[FloatArray, FloatArray] | None = None

    def lead(self, passed: Passed) -> None:
        """Take what is sent to the controller: there the planner expects what it has wanted."""
        self._end, self._is_known = passed.end, False

    def at(self, q: FloatArray, temperature_c: float | None, now_s: float) -> FloatArray:
        """Return them for reported angles, rad, (k,).

        What is added is found anew at most every `EVERY_S` while the arm moves and until it is
        known where it stands, and goes there at `ADDED_RAD_S` at the most. Between, it is off by
        the way in that time times the slope of the correction.
        """
        if self._at is None:
            self.added, self._is_known = self._compensator.true(q, temperature_c) - q, True
        else:
            is_near = np.abs(q - self._at).max() <= NEAR_RAD and temperature_c == self._warm
            since_s = now_s - self._found_s
            if (is_near and self._is_known) or 0.0 <= since_s < EVERY_S:
                return q + self.added
            model = self._compensator.model
            unit = model.chain.per_radian
            reach = ADDED_RAD_S * min(max(since_s, EVERY_S), MOST_REACH_S)
            if self._end is not None and np.abs(q - self._end[0]).max() <= NEAR_RAD:
                aim = self._end[1] - self._end[0]
                step = np.clip(aim - self.added, -reach * unit, reach * unit)
            else:
                here = (self.added / unit)[None]
                # No further than any correction goes.
                most = np.maximum(self._compensator.most_rad, np.abs(here))
                found = self._compensator.nominal_within(
                    q[None],
                    model.warming(1, temperature_c),
                    (np.maximum(here - reach, -most), np.minimum(here + reach, most)),
                    here,
                )
                step = found[0] - self.added
            self.added = self.added + step
            self._is_known = bool(np.abs(step).max() <= KNOWN_RAD)
        self._at, self._warm, self._found_s = q, temperature_c, now_s
        return q + self.added


def passed_on(
    wanted: Trajectory,
    arm: Present,
    gate: ForeignGate,
    correction: CorrectionInUse,
    tolerance_m: float,
    temperature_c: float | None = None,
    told: FloatArray | None = None,
) -> Passed:
    """Return what to send to the controller for a planner's trajectory.

    From where the arm stands on, points are added and time is stretched as
    `trajectories.corrected_trajectory` does. While it moves the points alone are corrected: how
    the controller comes to the first of them is its own.

    ``wanted``: the trajectory, which begins at once; of no points: the arm is to be held; ``arm``:
    where it is now; ``gate``: checks what is sent; ``correction``: may be one that corrects
    nothing; ``tolerance_m``: how far the tool may leave the wanted path between points, m;
    ``temperature_c``: of the arm; ``told``: where the planner was told that the arm is, rad, (k,);
    as `Compensator.true` has it where None.
    Raises InputError: the trajectory is refused; one line.
    """
    if not len(wanted.times_s):
        return _passed(gate.admit((), arm.q, arm.velocity), 0.0, arm, [])
    _refuse_bad_numbers(wanted)
    if told is None:
        told = correction.compensator.true(arm.q, temperature_c)
    t, q, v, notes = _corrected(wanted, arm, gate, correction, tolerance_m, temperature_c, told)
    velocities = np.zeros_like(q) if v is None else v.copy()
    if np.abs(velocities[-1]).max() <= REST_RAD_S:
        velocities[-1] = 0.0
    rows = zip(t, q, velocities, strict=True)
    waypoints = [Waypoint(float(at), place, speed) for at, place, speed in rows]
    try:
        admitted = gate.admit(waypoints, arm.q, arm.velocity, is_straight=v is None)
    except MotionRefusedError as error:
        hint = ''
        if isinstance(error, StartMovedError):
            hint = (
                ": the planner must read this node's joint_states, which have the correction in "
                'them, and begin where the arm stands'
            )
        raise InputError(f'{error}{hint}') from None
    end = q[-1], wanted.positions[-1]
    return _passed(admitted, float(t[-1]), arm, notes, end)


def _passed(
    admitted: Admitted,
    end_s: float,
    arm: Present,
    notes: list[str],
    end: tuple[FloatArray, FloatArray] | None = None,
) -> Passed:
    return Passed(admitted, end_s, arm.q, arm.velocity, arm.stands, tuple(notes), end)


def _refuse_bad_numbers(wanted: Trajectory) -> None:
    t, q, v = wanted.times_s, wanted.positions, wanted.velocities
    if not all(np.all(np.isfinite(one)) for one in (t, q, v) if one is not None):
        raise InputError('a number of it is not finite')
    if t[0] < 0.0 or np.any(np.diff(t) <= 0.0):
        raise InputError('its times do not ascend from 0 on')
    if t[-1] > LONGEST_S:
        raise InputError(f'it takes {t[-1]:.0f} s; {LONGEST_S:.0f} are the most')


def _refuse_too_fast(
    t: FloatArray, q: FloatArray, v: FloatArray | None, limits: MotionLimits
) -> None:
    """Refuse what a planner wants itself beyond the limits; time is stretched for ours alone."""
    largest = largest_speeds(t, q, v)
    if np.any(largest > limits.velocity * (1.0 + SPEED_TOLERANCE)):
        joint = int(np.argmax(largest / limits.velocity))
        raise InputError(
            f'{limits.names[joint]} is to turn at {largest[joint]:.3f} rad/s; '
            f'{limits.velocity[joint]:.3f} are its limit'
        )


def _corrected(
    wanted: Trajectory,
    arm: Present,
    gate: ForeignGate,
    correction: CorrectionInUse,
    tolerance_m: float,
    temperature_c: float | None,
    told: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray | None, list[str]]:
    """Return times, positions, velocities and notes of what is to be sent."""
    compensator, t, q, v = (
        correction.compensator, wanted.times_s, wanted.positions, wanted.velocities,
    )  # fmt: skip
    notes: list[str] = []
    begins_at_once = t[0] <= 0.0
    if not (arm.stands or begins_at_once):
        now = Now(arm.q, told, arm.velocity)
        limits = gate.limits.acceleration
        done, v = corrected_points(compensator, t, q, v, now, limits, temperature_c)
        _refuse_too_large(correction, done.command - q)
        return t, done.command, v, _notes(done.residual_m, done.incomplete, done.outside_range)
    if not begins_at_once:
        t, q = np.concatenate(([0.0], t)), np.concatenate((told[None], q))
        v = None if v is None else np.concatenate((np.zeros((1, q.shape[1])), v))
    if len(t) == 1:
        raise InputError('it has a single point, for now: give it a time_from_start')
    _refuse_too_fast(t, q, v, gate.limits)
    found = corrected_trajectory(
        compensator,
        t,
        q,
        v,
        tolerance_m=tolerance_m,
        velocity_limits=gate.limits.velocity,
        acceleration_limits=gate.limits.acceleration,
        temperature_c=temperature_c,
        begins=q[0] + (arm.q - told),
    )
    _refuse_too_large(correction, found.change)
    if found.stretched > 1.0:
        notes.append(
            f'slowed down to {100.0 / found.stretched:.1f} %: it would pass a limit of speed or '
            'acceleration'
        )
    notes += _notes(found.residual_m, found.incomplete, found.outside_range)
    # A controller begins where the arm is by itself.
    sent = slice(0 if begins_at_once else 1, None)
    speeds = None if found.velocities is None else found.velocities[sent]
    return found.times_s[sent], found.positions[sent], speeds, notes


def _refuse_too_large(correction: CorrectionInUse, change: FloatArray) -> None:
    refused = correction.too_large(change)
    if refused:
        raise InputError(next(iter(refused.values())))


def _notes(residual_m: FloatArray, incomplete: BoolArray, outside: BoolArray) -> list[str]:
    notes = []
    if count := int(np.sum(incomplete)):
        notes.append(
            f'{count} of {len(incomplete)} points near a singularity: up to '
            f'{1e3 * residual_m.max():.3f} mm is not corrected'
        )
    if count := int(np.sum(outside)):
        notes.append(
            f'{count} of {len(outside)} points beyond the angles at which a curve was measured: '
            'its end value is taken'
        )
    return notes
