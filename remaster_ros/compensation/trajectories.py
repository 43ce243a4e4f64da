# SPDX-License-Identifier: Apache-2.0
"""A trajectory whose tool path is that of the nominal robot, on points of its own.

Between points a trajectory controller draws a straight line where they have positions alone, a
cubic where they have velocities too. The correction is not what it draws: so points are added
where its path would leave the wanted one by more than a tolerance. At both ends the correction is
that of a single target; between them as much is corrected as the limits of acceleration allow
(`smooth_changes`). Where the corrected trajectory still passes a limit all of it is slowed down;
the path stays.
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

# Waves of the correction are seen with eight points each, and turns of the arm by half a radian
# where it has none.
POINTS_OF_WAVE = 8
LONGEST_STEP_RAD = 0.5
# Where between two points the path is compared. A cubic leaves a wave most in the middle: what it
# leaves elsewhere where that is none is, with eight points a wave, 4e-5 of the wave. A line may
# leave 1 % there.
COMPARED = {True: np.array([0.5]), False: np.array([0.25, 0.5, 0.75])}
# Controllers run at up to a kilohertz: no more points than that.
SHORTEST_S = 1e-3
# Times of messages are whole nanoseconds.
LEAST_S = 0.9e-9
# The correction of points nearer to each other than this is drawn through some of them, s: it is
# as smooth as an arm's accelerations are.
KNOTS_S = 0.02
# A correction may make a trajectory so much slower before less is corrected.
SLOWER = 1.05
# Of the limit of acceleration, what corrected points take that are sent one by one while the arm
# moves: where it then is is known to some milliradians.
SHARE_OF_STREAM = 0.9


@dataclass(frozen=True, eq=False)
class Now:
    """Where an arm of k joints is."""

    q: FloatArray  # Reported, rad, (k,)
    told: FloatArray  # Where the nominal robot would be, rad, (k,)
    velocity: FloatArray  # rad/s, (k,)


@dataclass(frozen=True, eq=False)
class CorrectedTrajectory:
    """What to send: n points of k joints."""

    times_s: FloatArray  # From the start, (n,)
    # rad and rad/s, (n, k); velocities are None where none were given
    positions: FloatArray
    velocities: FloatArray | None
    change: FloatArray  # Of the positions, by the correction, rad, (n, k)
    stretched: float  # How many times longer it takes than it was to
    # Largest distance of the tool from the wanted path between points, where it was compared
    deviation_m: float
    # Of each joint's largest, before all was slowed down, as a share of the wanted one, (k,); 0
    # where the joint was to stand, and NaN for accelerations of straight lines
    added_speed: FloatArray
    added_acceleration: FloatArray
    # As of a `Correction`, (n,)
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
    """Return the trajectory to send for a wanted one of the nominal robot.

    ``compensator``: the correction; ``times_s``: ascending, (n,), n >= 2; ``positions,
    velocities``: wanted, rad and rad/s, (n, k); ``tolerance_m``: of the tool between points;
    ``velocity_limits, acceleration_limits``: rad/s and rad/s², (k,); those of the URDF, and none,
    where None; ``temperature_c``: of the arm; ``begins``: what is commanded at the start, rad,
    (k,); the best command there where None.
    Raises InputError: numbers that are not finite, times that do not ascend, other shapes, or a
    path whose correction no point per millisecond follows.
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
    times, apart_s = _spread(compensator, wanted), KNOTS_S
    changes: SmoothChanges | None = None
    while True:
        knots = _thinned(times, apart_s)
        sent, done, changes = _corrected(
            compensator, wanted, times, knots, limits, fixed, temperature_c, changes
        )
        off = _between(compensator, wanted, sent, knots, temperature_c)
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
    """Return the largest speed of each joint of what a controller draws, rad/s, (k,)."""
    return DrawnPath(times_s, positions, velocities).largest()[0]


class DrawnPath:
    """What a controller draws through points."""

    def __init__(self, t: FloatArray, q: FloatArray, v: FloatArray | None) -> None:
        self.t, self.q, self.v = t, q, v
        self._cubic = None if v is None else scipy.interpolate.CubicHermiteSpline(t, q, v)

    def at(self, times: FloatArray) -> FloatArray:
        """Return positions, (n, k)."""
        if self._cubic is not None:
            return np.asarray(self._cubic(times))
        return np.stack([np.interp(times, self.t, q) for q in self.q.T], axis=1)

    def speed(self, times: FloatArray) -> FloatArray:
        """Return velocities of a cubic, (n, k)."""
        assert self._cubic is not None
        return np.asarray(self._cubic(times, 1))

    def rests(self, end: int) -> bool:
        """Return whether it rests at its first (0) or last (-1) point, as a cubic can."""
        return self.v is not None and not np.any(self.v[end])

    def accelerations(self) -> FloatArray:
        """Return those at the start and the end of each interval, (n - 1, 2, k); 0 of lines."""
        h = np.diff(self.t)[:, None]
        if self.v is None:
            return np.zeros((len(h), 2, self.q.shape[1]))
        slope, first, last = np.diff(self.q, axis=0) / h, self.v[:-1], self.v[1:]
        start = (6.0 * slope - 4.0 * first - 2.0 * last) / h
        return np.stack((start, (2.0 * first + 4.0 * last - 6.0 * slope) / h), axis=1)

    def largest(self) -> tuple[FloatArray, FloatArray]:
        """Return the largest speed and acceleration of each joint, (k,) each."""
        h = np.diff(self.t)[:, None]
        if self.v is None:
            slope = np.diff(self.q, axis=0) / h
            return np.abs(slope).max(axis=0), np.full(self.q.shape[1], np.nan)
        first = self.v[:-1]
        # Of a cubic the acceleration is linear, and the speed has a vertex where it is none.
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
    t, q = np.asarray(times_s, dtype=float), np.asarray(positions, dtype=float)
    v = None if velocities is None else np.asarray(velocities, dtype=float)
    shape = (len(t) if t.ndim == 1 else 0, compensator.model.joints)
    for what, values in (('positions', q), ('velocities', v)):
        if values is not None and values.shape != shape:
            raise InputError(
                f'trajectory: {what} have the shape {values.shape}, not {shape}; give each point '
                'all joints, and all points velocities or none'
            )
    if not all(np.all(np.isfinite(one)) for one in (t, q, v) if one is not None):
        raise InputError('trajectory: a number is not finite; correct it')
    if len(t) < 2 or np.any(np.diff(t) < LEAST_S):
        raise InputError('trajectory: needs two points or more, at times that ascend')
    return t, q, v


def _spread(compensator: Compensator, wanted: DrawnPath) -> FloatArray:
    """Return times between which the correction cannot hide a wave."""
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
    """Return the largest speeds and accelerations of a corrected path, (k,) each.

    Those at which it is slowed down by `SLOWER`, beside what the wanted path has to be slowed down
    itself. Without limits of acceleration, twice the largest of the wanted path, or of joints that
    go over a radian at its speed.
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


def _thinned(times: FloatArray, apart_s: float) -> IntArray:
    """Return the indices of times of which each is so far behind the one before, both ends too."""
    chosen = [0]
    last = len(times) - 1
    while chosen[-1] < last:
        following = int(np.searchsorted(times, times[chosen[-1]] + apart_s))
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
    """Return the corrected path through points at these times, and what was done to them."""
    q = wanted.at(times)
    v = None if wanted.v is None else wanted.speed(times)
    path = DrawnPath(times, q, v)
    unit = compensator.model.chain.per_radian
    problem = compensator.problem(q[knots], temperature_c)
    speeds = np.zeros_like(q) if v is None else v
    changes = smooth_changes(
        problem.errors,
        times[knots],
        problem.own,
        (_largest_between(path.accelerations(), knots) / unit, speeds[knots] / unit),
        Limits(limits[1] / unit, limits[0] / unit, problem.budget),
        ends,
        before,
    )
    change, added = changes.at(times)
    command = q + unit * change
    every = problem if len(knots) == len(times) else compensator.problem(q, temperature_c)
    done = compensator.correction(command, every.left(change))
    return DrawnPath(times, command, None if v is None else v + unit * added), done, changes


def _largest_between(accelerations: FloatArray, knots: IntArray) -> FloatArray:
    """Return the largest acceleration between knots, of either sign, at both ends, (m, 2, k).

    ``accelerations``: at both ends of each interval, (n, 2, k), as they are where no interval lies
    between two knots but one.
    """
    ends = accelerations.reshape(-1, accelerations.shape[2])
    first = 2 * knots[:-1]
    high, low = (np.asarray(one.reduceat(ends, first)) for one in (np.maximum, np.minimum))
    largest = np.where(high > -low, high, low)
    found = np.stack((largest, largest), axis=1)
    single = np.diff(knots) == 1
    found[single] = accelerations[knots[:-1][single]]
    return found


def _between(
    compensator: Compensator,
    wanted: DrawnPath,
    sent: DrawnPath,
    knots: IntArray,
    temperature_c: float | None,
) -> FloatArray:
    """Return how far the tool is off in each interval beside what it is at knots, m, (n - 1, m).

    What is not corrected at two knots is expected to go from the one to the other in a line.
    """
    times, share = sent.t, COMPARED[sent.v is not None]
    inside = times[:-1, None] + np.diff(times)[:, None] * np.concatenate((share, [1.0]))
    at = np.concatenate((times[knots], inside.ravel()))
    model = compensator.model
    nominal = model.chain.forward(wanted.at(at))[:, :3, 3]
    off = compensator.tool(sent.at(at), temperature_c)[:, :3, 3] - nominal
    off, between = np.split(off, [len(knots)])
    expected = [np.interp(inside.ravel(), times[knots], one) for one in off.T]
    beside = np.linalg.norm(between - np.stack(expected, axis=1), axis=1)
    return np.asarray(beside.reshape(inside.shape))


def corrected_points(
    compensator: Compensator,
    times_s: FloatArray,
    q: FloatArray,
    v: FloatArray | None,
    now: Now,
    acceleration_limits: FloatArray,
    temperature_c: float | None = None,
) -> tuple[Correction, FloatArray | None]:
    """Return what to command for the points of an arm that moves, and their velocities.

    ``compensator, temperature_c, acceleration_limits``: as of `corrected_trajectory`;
    ``times_s``: from now on, above 0, (n,); ``q, v``: wanted, rad and rad/s, (n, k), None where
    there are no velocities; ``now``: where the arm is.
    """
    unit = compensator.model.chain.per_radian
    times, q = np.concatenate(([0.0], times_s)), np.concatenate((now.told[None], q))
    speeds = None if v is None else np.concatenate((now.velocity[None], v))
    problem = compensator.problem(q, temperature_c)
    limits = Limits(
        SHARE_OF_STREAM * acceleration_limits / unit, np.full(len(unit), np.inf), problem.budget
    )
    found = smooth_changes(
        problem.errors,
        times,
        problem.own,
        (DrawnPath(times, q, speeds).accelerations() / unit, np.zeros_like(q)),
        limits,
        # The controller goes on from the speed of the arm, whatever part the correction has in it.
        Ends((now.q - now.told) / unit, None, True, v is not None and not np.any(v[-1])),
    )
    command = (q + unit * found.change)[1:]
    done = compensator.correction(command, problem.left(found.change)[1:])
    return done, None if v is None else v + unit * found.speed[1:]


def _added(before: FloatArray, after: FloatArray) -> FloatArray:
    return np.divide(after, before, out=np.ones_like(after), where=before > 0.0) - 1.0
