# SPDX-License-Identifier: Apache-2.0
"""Correction of other planners' trajectories on their way to the controller, and the inverse.

A planner that knows nothing of a correction plans for the nominal arm. It must be given the angles
at which the nominal arm would have its tool where the arm has it (`TrueAngles`); the trajectory
that it then wants is corrected and handed to the motion gate (`corrected_for_controller`). The two
directions are consistent: a plan from the given angles begins where the arm is.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from remaster_ros.compensation.compensator import Compensator
from remaster_ros.compensation.in_use import CorrectionInUse
from remaster_ros.compensation.trajectories import (
    ArmNow,
    DrawnPath,
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
"""Share by which a planner's speeds may exceed the limits, since its splines are sampled."""
REST_RAD_S = 1e-7
"""Largest end speed that counts as rest, rad/s: joint_trajectory_controller accepts no larger one
(the resolution of a float)."""
NEAR_RAD = 2e-4
"""Distance from angles with a known correction within which that correction is reused, rad: it
changes by some hundredths of the distance. Within this distance of the end of a trajectory the arm
has arrived."""
KNOWN_RAD = 1e-7
"""A correction is known if a further step changes it by less, rad: an encoder of 23 bits resolves
7e-7."""
PLACES = 33
"""Number of samples on a stretch of a path."""
LONGEST_S = 3600.0
"""Longest trajectory of a planner, s: an hour. Switching waits for its end, and a mistake of the
unit makes it a thousand times as long."""
EVERY_S = 0.02
"""Interval at which the correction of reported angles is computed while the arm moves, s."""
ADDED_RAD_S = 0.5
"""Largest rate of change of the correction, rad/s: from one bound of its budget to the other in
0.14 s. It changes by some hundredths of the way, and joints go at a few radians a second."""
MOST_REACH_S = 0.2
"""Longest time, s, over which the correction may change in one step, if reports failed to come."""


@dataclass(frozen=True)
class Trajectory:
    """Trajectory of a planner: n points of k joints in the arm's order."""

    times_s: FloatArray  # Times from its start, (n,)
    # rad and rad/s, (n, k); velocities are None if the controller draws lines
    positions: FloatArray
    velocities: FloatArray | None


@dataclass(frozen=True)
class SentTrajectory:
    """Trajectory that is sent to the controller in place of a planner's."""

    admitted: Admitted  # Waypoints that the gate has admitted
    end_s: float  # Time of its end from its start, s
    # Position and velocity of the arm at the computation, rad and rad/s, (k,) each, and whether it
    # stood
    start: FloatArray
    velocity: FloatArray
    stood: bool
    notes: tuple[str, ...] = ()  # Remarks for a person, a line each
    # Command at its end, and wanted angles there, rad, (k,); None if the arm is held
    end: tuple[FloatArray, FloatArray] | None = None

    def samples(self, since_s: float, until_s: float) -> FloatArray:
        """Positions on the path at 33 evenly spaced times between two times, rad, (33, k).

        The times, s, count from the path's start; before and after the path its ends hold.
        """
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


class ArmReports:
    """Position and velocity of an arm by its last reports, and whether it stands."""

    def __init__(self) -> None:
        self._reports: deque[tuple[float, FloatArray]] = deque()
        self._wall_s = -np.inf
        self._still_rad = SettleRules().still_tolerance

    def take(self, stamp_s: float, q: FloatArray, wall_s: float) -> None:
        """Add a report: its stamp, s, positions, rad, (k,), and the wall time of its arrival, s.

        A report with the stamp of the one before is ignored. An earlier stamp clears all
        reports before, since a clock was set back.
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

    def snapshot(self) -> ArmReports:
        """Copy of the reports for another thread; later reports do not change it."""
        taken = ArmReports()
        taken._reports, taken._wall_s = self._reports.copy(), self._wall_s
        return taken

    def is_fresh(self, wall_s: float) -> bool:
        """Whether the last report came at most 0.25 s (`FRESH_S`) before a wall time, s."""
        return wall_s - self._wall_s <= FRESH_S

    @property
    def q(self) -> FloatArray:
        """Last reported position, rad or m, (k,); IndexError before the first report."""
        return self._reports[-1][1]

    @property
    def is_known(self) -> bool:
        """Whether there are two reports, from which a velocity can be computed."""
        return len(self._reports) > 1

    @property
    def velocity(self) -> FloatArray:
        """Velocity by the last two reports, rad/s or m/s, (k,): exactly 0 if the arm stands.

        There must be two reports (`is_known`), else IndexError.
        """
        if self.stands:
            return np.zeros_like(self.q)
        (before_s, before), (stamp_s, q) = self._reports[-2], self._reports[-1]
        return (q - before) / (stamp_s - before_s)

    @property
    def stands(self) -> bool:
        """Whether the reports of the last `following.STANDING_S` differ by no more than noise.

        False if the reports do not reach back so long.
        """
        reports = self._reports
        if not reports or reports[-1][0] - reports[0][0] < STANDING_S:
            return False
        return bool(np.ptp([q for _, q in reports], axis=0).max() <= self._still_rad)


class TrueAngles:
    """Joint angles at which the nominal arm's tool is where the real arm has it, report by report.

    They are continuous from report to report: near singularities, where several solutions
    exist, the branch is kept while the arm moves. When the arm comes to rest at the end of a
    trajectory, they are the angles that the planner wanted there. ``compensator``: the
    correction.
    """

    def __init__(self, compensator: Compensator) -> None:
        self._compensator = compensator
        # Correction of reported angles, rad; the angles and the time, s, of its computation.
        self.added: FloatArray = np.zeros(compensator.model.joints)
        self._at: FloatArray | None = None
        self._warm: float | None = None
        self._found_s = -np.inf
        self._is_known = False
        # Command and wanted angles at the end of the last trajectory, (k,)
        self._end: tuple[FloatArray, FloatArray] | None = None

    def lead(self, passed: SentTrajectory) -> None:
        """Note the trajectory that is sent: at its end the planner expects its wanted angles.

        The end of the trajectory before is forgotten. The correction is computed again even if
        the arm stands.
        """
        self._end, self._is_known = passed.end, False

    def at(self, q: FloatArray, temperature_c: float | None, now_s: float) -> FloatArray:
        """Nominal arm's angles for reported angles q, rad, (k,); ``now_s``: present time, s.

        The correction is computed at most every `EVERY_S` while the arm moves, and after it
        stands until it no longer changes; its rate of change is `ADDED_RAD_S` at most. Between
        computations the last one is used, so that the angles are off by what it has changed
        since. ``temperature_c``: of the arm, None for the mean of the measurements.
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


def corrected_for_controller(
    wanted: Trajectory,
    arm: ArmReports,
    gate: ForeignGate,
    correction: CorrectionInUse,
    tolerance_m: float,
    temperature_c: float | None = None,
    believed_q: FloatArray | None = None,
) -> SentTrajectory:
    """Trajectory to send to the controller for a planner's trajectory.

    If the arm stands, points are added and time is stretched as
    `trajectories.corrected_trajectory` does. If it moves, only the points are corrected; the
    controller decides how it gets to the first of them. ``wanted``: the trajectory, which
    begins at once; without points: hold the arm; ``arm``: its reports; ``gate``: checks the
    trajectory that is sent; ``correction``: may be one that corrects nothing; ``tolerance_m``:
    largest distance of the tool from the wanted path between points, m; ``temperature_c``: of
    the arm; ``believed_q``: position of the arm that the planner was given, rad, (k,); None
    for that of `Compensator.true`.

    Raises InputError, in one line, if the trajectory is refused.
    """
    if not len(wanted.times_s):
        return _passed(gate.admit((), arm.q, arm.velocity), 0.0, arm, [])
    _refuse_bad_numbers(wanted)
    if believed_q is None:
        believed_q = correction.compensator.true(arm.q, temperature_c)
    t, q, v, notes = _corrected(
        wanted, arm, gate, correction, tolerance_m, temperature_c, believed_q
    )
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
    arm: ArmReports,
    notes: list[str],
    end: tuple[FloatArray, FloatArray] | None = None,
) -> SentTrajectory:
    """Return the trajectory to send, with the arm's position, velocity and rest at present.

    ``admitted``: waypoints that the gate admitted; ``end_s``: time of the last one from the
    start, s; ``notes``: remarks for a person; ``end``: command at the end and wanted angles
    there, rad, (k,) each; None if the arm is held.
    """
    return SentTrajectory(admitted, end_s, arm.q, arm.velocity, arm.stands, tuple(notes), end)


def _refuse_bad_numbers(wanted: Trajectory) -> None:
    """Raise InputError for numbers that are not finite, or times that do not ascend from 0 on.

    Also if it takes over an hour (`LONGEST_S`). ``wanted``: at least one point.
    """
    t, q, v = wanted.times_s, wanted.positions, wanted.velocities
    if not all(np.all(np.isfinite(values)) for values in (t, q, v) if values is not None):
        raise InputError('a number of it is not finite')
    if t[0] < 0.0 or np.any(np.diff(t) <= 0.0):
        raise InputError('its times do not ascend from 0 on')
    if t[-1] > LONGEST_S:
        raise InputError(f'it takes {t[-1]:.0f} s; {LONGEST_S:.0f} are the most')


def _refuse_too_fast(
    t: FloatArray, q: FloatArray, v: FloatArray | None, limits: MotionLimits
) -> None:
    """Raise InputError if a planner's trajectory exceeds a joint's velocity limit by over 1 %.

    It is not slowed down: that is done only for speed that the correction adds. ``t``: s,
    (n,); ``q``: rad, (n, k); ``v``: rad/s, (n, k), cubics between points; None for straight
    lines.
    """
    largest = largest_speeds(t, q, v)
    if np.any(largest > limits.velocity * (1.0 + SPEED_TOLERANCE)):
        joint = int(np.argmax(largest / limits.velocity))
        raise InputError(
            f'{limits.names[joint]} is to turn at {largest[joint]:.3f} rad/s; '
            f'{limits.velocity[joint]:.3f} are its limit'
        )


def _corrected(
    wanted: Trajectory,
    arm: ArmReports,
    gate: ForeignGate,
    correction: CorrectionInUse,
    tolerance_m: float,
    temperature_c: float | None,
    believed_q: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray | None, list[str]]:
    """Times, positions, velocities and remarks of the trajectory to send.

    Arguments and errors as of `corrected_for_controller`.
    """
    compensator, t, q, v = (
        correction.compensator, wanted.times_s, wanted.positions, wanted.velocities,
    )  # fmt: skip
    notes: list[str] = []
    begins_at_once = t[0] <= 0.0
    if not (arm.stands or begins_at_once):
        now = ArmNow(arm.q, believed_q, arm.velocity)
        limits = gate.limits.acceleration
        done, v = corrected_points(compensator, t, q, v, now, limits, temperature_c)
        _refuse_too_large(correction, done.command - q)
        return t, done.command, v, _notes(done.residual_m, done.incomplete, done.outside_range)
    if not begins_at_once:
        t, q = np.concatenate(([0.0], t)), np.concatenate((believed_q[None], q))
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
        begins=q[0] + (arm.q - believed_q),
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
    """Raise InputError if a row of the changes, rad, (n, k), is larger than the correction allows.

    The message is that of the first such row (`CorrectionInUse.too_large`).
    """
    refused = correction.too_large(change)
    if refused:
        raise InputError(next(iter(refused.values())))


def _notes(residual_m: FloatArray, incomplete: BoolArray, outside: BoolArray) -> list[str]:
    """Remarks on points near a singularity or beyond a measured range; [] without any.

    ``residual_m, incomplete, outside``: as in `compensator.Correction`, (n,).
    """
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
