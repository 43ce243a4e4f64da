# SPDX-License-Identifier: Apache-2.0
"""Trajectories whose tool path is that of the nominal robot, with points added as needed.

Between points a trajectory controller draws a straight line if they have positions alone, a cubic
if they have velocities too. The correction is neither: so points are added where the drawn path
would leave the wanted one by more than a tolerance. At both ends the correction is that of a
single target; between them as much is corrected as the limits of acceleration allow
(`smooth_changes`). If the corrected trajectory still passes a limit, all of it is slowed down; the
path stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from remaster_ros.compensation.compensator import Compensator, Correction
from remaster_ros.compensation.smooth_changes import Ends, Limits, SmoothChanges, smooth_changes
from remaster_ros.errors import InputError
from remaster_ros.types import BoolArray, FloatArray, IntArray

# Points for each wave of the correction; longest step, rad, of a correction without waves.
POINTS_OF_WAVE = 8
LONGEST_STEP_RAD = 0.5
# Places between two points at which the path is compared, by whether it is a cubic. A cubic
# deviates from a wave most in the middle; elsewhere it deviates by 4e-5 of the wave, with eight
# points a wave. A line may deviate by 1 % elsewhere.
COMPARED = {True: np.array([0.5]), False: np.array([0.25, 0.5, 0.75])}
# Shortest interval of points, s: controllers run at up to a kilohertz.
SHORTEST_S = 1e-3
# Shortest difference of times, s: messages have whole nanoseconds.
LEAST_S = 0.9e-9
# Distance of the knots of the correction, s: points nearer to each other are interpolated, as it
# is as smooth as an arm's accelerations are.
KNOTS_S = 0.02
# Largest factor by which a correction may slow down a trajectory before less is corrected.
SLOWER = 1.05
# Share of the acceleration limit for points that are sent one by one while the arm moves: its
# position is then known only to some milliradians.
SHARE_OF_STREAM = 0.9


@dataclass(frozen=True, eq=False)
class ArmNow:
    """Current position and velocity of an arm of k joints, reported and as the nominal robot."""

    q: FloatArray  # Reported, rad, (k,)
    nominal_q: FloatArray  # Angles of the nominal robot with the same tool, rad, (k,)
    velocity: FloatArray  # rad/s, (k,)


@dataclass(frozen=True, eq=False)
class CorrectedTrajectory:
    """Trajectory to send, n points of k joints, and the errors that it leaves."""

    times_s: FloatArray  # Times from the start, (n,)
    # rad and rad/s, (n, k); velocities are None if none were given
    positions: FloatArray
    velocities: FloatArray | None
    change: FloatArray  # Change of the positions by the correction, rad, (n, k)
    stretched: float  # Factor by which it takes longer than wanted
    # Largest distance of the tool from the wanted path at the compared places, m
    deviation_m: float
    # Increase of each joint's largest speed and acceleration before slowing down, as a share of
    # the wanted one, (k,); 0 if the joint was to stand, and for accelerations of straight lines
    added_speed: FloatArray
    added_acceleration: FloatArray
    # As in `Correction`, (n,)
    residual_m: FloatArray
    incomplete: BoolArray
    outside_range: BoolArray


def corrected_trajectory(
    compensator: Compensator,
    times_s: ArrayLike,
    positions: ArrayLike,
    velocities: ArrayLike | None = None,
    *,
    tolerance_m: float = 2e-5,
    velocity_limits: ArrayLike | None = None,
    acceleration_limits: ArrayLike | None = None,
    temperature_c: float | None = None,
    begins: FloatArray | None = None,
) -> CorrectedTrajectory:
    """Trajectory to send to the controller for a wanted trajectory of the nominal robot.

    Points are added. If a limit requires it, less is corrected between the ends, and the whole
    trajectory is slowed down by one factor. ``compensator``: the correction; ``times_s``:
    ascending, (n,), n >= 2; ``positions, velocities``: wanted, rad and rad/s, (n, k);
    ``tolerance_m``: largest deviation of the tool between points; ``velocity_limits,
    acceleration_limits``: rad/s and rad/s², (k,); None for those of the URDF, and for no limit;
    ``temperature_c``: of the arm; ``begins``: command at the start, rad, (k,); None for the best
    command there.

    Raises InputError for numbers that are not finite, times that do not ascend, other shapes,
    or a path whose correction cannot be followed with a point per millisecond.
    """
    t, q, v = _checked(compensator, times_s, positions, velocities)
    wanted = DrawnPath(t, q, v)
    if velocity_limits is None:
        velocity_limits = compensator.model.chain.velocity_limits
    speed_limits = np.broadcast_to(np.asarray(velocity_limits, dtype=float), q.shape[1:])
    acceleration_limits = (
        None if acceleration_limits is None else np.asarray(acceleration_limits, dtype=float)
    )
    before = wanted.largest()
    limits = _allowed(before, speed_limits, acceleration_limits)
    ends = compensator.command(q[[0, -1]], temperature_c)
    first = ends[0] if begins is None else begins
    unit = compensator.model.chain.per_radian
    fixed = Ends(
        (first - q[0]) / unit, (ends[1] - q[-1]) / unit, wanted.rests(0), wanted.rests(-1)
    )
    times, apart_s = _sampling_times(compensator, wanted), KNOTS_S
    changes: SmoothChanges | None = None
    while True:
        knots = _knot_indices(times, apart_s)
        sent, done, changes = _corrected(
            compensator, wanted, times, knots, limits, fixed, temperature_c, changes
        )
        off = _deviation_between(compensator, wanted, sent, knots, temperature_c)
        far = off.max(axis=1) > tolerance_m
        if not far.any():
            break
        if np.diff(times)[far].min() < 2.0 * SHORTEST_S:
            raise InputError(
                f'behind {times[:-1][far][0]:.3f} s the tool leaves the wanted path between '
                f'points by {1e3 * off.max():.3f} mm (not {1e3 * tolerance_m:g}), even with a '
                'point per millisecond; go slower there, or give velocities'
            )
        times = np.sort(np.concatenate((times, 0.5 * (times[:-1] + times[1:])[far])))
        apart_s *= 0.5
    speed, acceleration = sent.largest()
    stretched = max(1.0, float(np.max(speed / speed_limits)))
    if acceleration_limits is not None and sent.v is not None:
        ratio = np.max(acceleration / acceleration_limits)
        stretched = max(stretched, float(np.sqrt(ratio)))
    return CorrectedTrajectory(
        times[0] + (times - times[0]) * stretched,
        sent.q,
        None if sent.v is None else sent.v / stretched,
        sent.q - wanted.at(times),
        stretched,
        float(off.max()),
        _added(before[0], speed),
        _added(before[1], acceleration),
        done.residual_m,
        done.incomplete,
        done.outside_range,
    )


def largest_speeds(
    times_s: FloatArray, positions: FloatArray, velocities: FloatArray | None
) -> FloatArray:
    """Largest speed of each joint on the path that a controller draws, rad/s or m/s, (k,).

    Cubics with velocities, lines if they are None; at least two points at ascending times.
    """
    return DrawnPath(times_s, positions, velocities).largest()[0]


class DrawnPath:
    """Path that a controller draws through points: lines, or cubics if there are velocities."""

    def __init__(self, t: FloatArray, q: FloatArray, v: FloatArray | None) -> None:
        self.t, self.q, self.v = t, q, v
        self._cubic = None if v is None else scipy.interpolate.CubicHermiteSpline(t, q, v)

    def at(self, times: FloatArray) -> FloatArray:
        """Positions, rad or m, at times (m,), s, (m, k).

        Beyond the ends: lines hold the position of the end, cubics go on.
        """
        if self._cubic is not None:
            return np.asarray(self._cubic(times))
        return np.stack([np.interp(times, self.t, q) for q in self.q.T], axis=1)

    def speed(self, times: FloatArray) -> FloatArray:
        """Velocities of a cubic at times (m,), s, rad/s, (m, k); AssertionError for lines."""
        assert self._cubic is not None
        return np.asarray(self._cubic(times, 1))

    def rests(self, end: int) -> bool:
        """Whether a cubic has no velocity at its first (0) or last (-1) point; False for lines."""
        return self.v is not None and not np.any(self.v[end])

    def accelerations(self) -> FloatArray:
        """Accelerations at both ends of each interval, rad/s², (n - 1, 2, k); 0 for lines."""
        h = np.diff(self.t)[:, None]
        if self.v is None:
            return np.zeros((len(h), 2, self.q.shape[1]))
        slope, first, last = np.diff(self.q, axis=0) / h, self.v[:-1], self.v[1:]
        start = (6.0 * slope - 4.0 * first - 2.0 * last) / h
        return np.stack((start, (2.0 * first + 4.0 * last - 6.0 * slope) / h), axis=1)

    def largest(self) -> tuple[FloatArray, FloatArray]:
        """Largest speed and acceleration of each joint, without sign, (k,) each.

        For lines the accelerations are NaN.
        """
        h = np.diff(self.t)[:, None]
        if self.v is None:
            slope = np.diff(self.q, axis=0) / h
            return np.abs(slope).max(axis=0), np.full(self.q.shape[1], np.nan)
        first = self.v[:-1]
        # The acceleration of a cubic is linear, and its speed has a vertex where that is zero.
        start, end = self.accelerations().swapaxes(0, 1)
        change = start - end
        share = np.divide(start, change, out=np.zeros_like(start), where=change != 0.0)
        inside = np.clip(share, 0.0, 1.0)
        vertex = first + h * (start * inside - 0.5 * change * inside**2)
        speeds = np.abs(np.concatenate((self.v, vertex)))
        accelerations = np.abs(np.concatenate((start, end)))
        return speeds.max(axis=0), accelerations.max(axis=0)


def _checked(
    compensator: Compensator,
    times_s: ArrayLike,
    positions: ArrayLike,
    velocities: ArrayLike | None,
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Times, positions and velocities as arrays.

    Raises InputError for other shapes, numbers that are not finite, or fewer than two points at
    ascending times.
    """
    t, q = np.asarray(times_s, dtype=float), np.asarray(positions, dtype=float)
    v = None if velocities is None else np.asarray(velocities, dtype=float)
    shape = (len(t) if t.ndim == 1 else 0, compensator.model.joints)
    for what, values in (('positions', q), ('velocities', v)):
        if values is not None and values.shape != shape:
            raise InputError(
                f'trajectory: {what} have the shape {values.shape}, not {shape}; give each point '
                'all joints, and all points velocities or none'
            )
    if not all(np.all(np.isfinite(array)) for array in (t, q, v) if array is not None):
        raise InputError('trajectory: a number is not finite; correct it')
    if len(t) < 2 or np.any(np.diff(t) < LEAST_S):
        raise InputError('trajectory: needs two points or more, at times that ascend')
    return t, q, v


def _sampling_times(compensator: Compensator, wanted: DrawnPath) -> FloatArray:
    """Times, s, ascending, at which the correction is computed, with those of the path's points.

    Between two of them no joint moves further than 0.5 rad, or an eighth of the period of the
    joint term with the highest order if that is less; but no times closer than 1 ms are added.
    """
    orders = [term.function.order for term in compensator.model.joint_terms]
    step = min(LONGEST_STEP_RAD, 2.0 * np.pi / (POINTS_OF_WAVE * max([1, *orders])))
    h = np.diff(wanted.t)
    # Of a cubic the way may be longer than its ends are apart.
    way = np.abs(np.diff(wanted.q, axis=0)).max(axis=1)
    if wanted.v is not None:
        ends = np.maximum(np.abs(wanted.v[:-1]), np.abs(wanted.v[1:])).max(axis=1)
        way = np.maximum(1.5 * way, h * ends)
    # A number of points has to be of this size at most, however far the arm goes.
    counts = np.maximum(1, np.minimum(np.ceil(way / step), np.floor(h / SHORTEST_S)))
    parts = [
        np.linspace(start, end, int(count), endpoint=False)
        for start, end, count in zip(wanted.t[:-1], wanted.t[1:], counts, strict=True)
    ]
    return np.concatenate([*parts, wanted.t[-1:]])


def _allowed(
    wanted: tuple[FloatArray, FloatArray],
    speed_limits: FloatArray,
    acceleration_limits: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Largest speeds and accelerations of a corrected path before time is stretched, (k,) each.

    ``wanted``: largest of the wanted path, (k,) each. They are the limits, raised so far that
    the path then has to be slowed down by `SLOWER` more than the wanted path itself. Without
    limits of acceleration, or for a path of lines: the path's own, plus the largest of all
    joints or, if more, the square of the largest speed.
    """
    speed, acceleration = wanted
    slower = max(1.0, float(np.max(speed / speed_limits)))
    if acceleration_limits is None or np.isnan(acceleration).any():
        largest = max(float(np.nan_to_num(acceleration).max()), float(speed.max()) ** 2)
        # A path that rests has no acceleration to compare with.
        allowed = np.nan_to_num(acceleration) + max(largest, np.finfo(float).eps)
    else:
        slower = max(slower, float(np.sqrt(np.max(acceleration / acceleration_limits))))
        allowed = acceleration_limits * (SLOWER * slower) ** 2
    return speed_limits * SLOWER * slower, allowed


def _knot_indices(times: FloatArray, interval_s: float) -> IntArray:
    """Indices of ascending times that are at least ``interval_s`` apart, with both ends.

    The last interval may be shorter. Times that are further apart are all chosen.
    """
    chosen = [0]
    last = len(times) - 1
    while chosen[-1] < last:
        following = int(np.searchsorted(times, times[chosen[-1]] + interval_s))
        chosen.append(min(max(following, chosen[-1] + 1), last))
    return np.array(chosen)


def _corrected(
    compensator: Compensator,
    wanted: DrawnPath,
    times: FloatArray,
    knots: IntArray,
    limits: tuple[FloatArray, FloatArray],
    ends: Ends,
    temperature_c: float | None,
    before: SmoothChanges | None,
) -> tuple[DrawnPath, Correction, SmoothChanges]:
    """Corrected path through points at given times, their correction, and changes at knots.

    ``wanted``: the path; ``knots``: indices of the times at which changes are sought;
    ``limits``: largest speeds and accelerations, (k,) each; ``ends``: known changes;
    ``before``: changes for fewer times, to begin with, or None.
    """
    q = wanted.at(times)
    v = None if wanted.v is None else wanted.speed(times)
    path = DrawnPath(times, q, v)
    unit = compensator.model.chain.per_radian
    problem = compensator.problem(q[knots], temperature_c)
    speeds = np.zeros_like(q) if v is None else v
    changes = smooth_changes(
        problem.errors,
        times[knots],
        problem.angle_change,
        (_largest_between(path.accelerations(), knots) / unit, speeds[knots] / unit),
        Limits(limits[1] / unit, limits[0] / unit, problem.budget),
        ends,
        before,
    )
    change, added = changes.at(times)
    command = q + unit * change
    every = problem if len(knots) == len(times) else compensator.problem(q, temperature_c)
    done = compensator.correction(command, every.remaining_error(change))
    return DrawnPath(times, command, None if v is None else v + unit * added), done, changes


def _largest_between(accelerations: FloatArray, knots: IntArray) -> FloatArray:
    """Acceleration of the largest size, with its sign, between consecutive knots, (m, 2, k).

    The same at both ends of each of the m intervals between knots. ``accelerations``: at both
    ends of each interval between times, (n, 2, k), returned unchanged if two knots have a
    single one between them.
    """
    ends = accelerations.reshape(-1, accelerations.shape[2])
    first = 2 * knots[:-1]
    high, low = (np.asarray(ufunc.reduceat(ends, first)) for ufunc in (np.maximum, np.minimum))
    largest = np.where(high > -low, high, low)
    found = np.stack((largest, largest), axis=1)
    single = np.diff(knots) == 1
    found[single] = accelerations[knots[:-1][single]]
    return found


def _deviation_between(
    compensator: Compensator,
    wanted: DrawnPath,
    sent: DrawnPath,
    knots: IntArray,
    temperature_c: float | None,
) -> FloatArray:
    """Deviation of the tool from the wanted path within each interval, m, (n - 1, times).

    At some times of the interval; the last is the end of the interval. From the deviation its
    linear interpolation between the knots is subtracted: an error that the correction leaves
    there is not counted. ``sent``: path that is sent, with n points; ``knots``: indices of
    those at which changes were computed.
    """
    times, share = sent.t, COMPARED[sent.v is not None]
    inside = times[:-1, None] + np.diff(times)[:, None] * np.concatenate((share, [1.0]))
    at = np.concatenate((times[knots], inside.ravel()))
    model = compensator.model
    nominal = model.chain.forward(wanted.at(at))[:, :3, 3]
    off = compensator.tool(sent.at(at), temperature_c)[:, :3, 3] - nominal
    off, between = np.split(off, [len(knots)])
    expected = [np.interp(inside.ravel(), times[knots], coordinate) for coordinate in off.T]
    deviation = np.linalg.norm(between - np.stack(expected, axis=1), axis=1)
    return np.asarray(deviation.reshape(inside.shape))


def corrected_points(
    compensator: Compensator,
    times_s: FloatArray,
    q: FloatArray,
    v: FloatArray | None,
    now: ArmNow,
    acceleration_limits: FloatArray,
    temperature_c: float | None = None,
) -> tuple[Correction, FloatArray | None]:
    """Commands for the points of a moving arm, and their velocities, rad/s, (n, k).

    ``compensator, temperature_c``: as in `corrected_trajectory`; ``times_s``: from now on,
    above 0, (n,); ``q, v``: wanted, rad and rad/s, (n, k); without velocities v and the
    returned ones are None; ``now``: current state of the arm; ``acceleration_limits``: rad/s²,
    (k,).
    """
    unit = compensator.model.chain.per_radian
    times, q = np.concatenate(([0.0], times_s)), np.concatenate((now.nominal_q[None], q))
    speeds = None if v is None else np.concatenate((now.velocity[None], v))
    problem = compensator.problem(q, temperature_c)
    limits = Limits(
        SHARE_OF_STREAM * acceleration_limits / unit, np.full(len(unit), np.inf), problem.budget
    )
    found = smooth_changes(
        problem.errors,
        times,
        problem.angle_change,
        (DrawnPath(times, q, speeds).accelerations() / unit, np.zeros_like(q)),
        limits,
        # The controller goes on from the speed of the arm, whatever part the correction has in it.
        Ends((now.q - now.nominal_q) / unit, None, True, v is not None and not np.any(v[-1])),
    )
    command = (q + unit * found.change)[1:]
    done = compensator.correction(command, problem.remaining_error(found.change)[1:])
    return done, None if v is None else v + unit * found.speed[1:]


def _added(before: FloatArray, after: FloatArray) -> FloatArray:
    """Relative increase of values (k,), 0 if the value before is 0 or NaN."""
    return np.divide(after, before, out=np.ones_like(after), where=before > 0.0) - 1.0
