"""A trajectory whose tool path is that of the nominal robot, on points of its own.

Between points a trajectory controller draws a straight line where they have positions alone, a
cubic where they have velocities too. The correction is not what it draws: so points are added
where its path would leave the wanted one by more than a tolerance. Where the corrected trajectory
passes a limit all of it is slowed down; the path stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from remaster_ros.compensation.compensator import Compensator, Correction
from remaster_ros.errors import InputError
from remaster_ros.types import BoolArray, FloatArray

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
# Along a path the correction is differentiated over so much motion: errors of its second order are
# below 1e-9, those of rounding below 1e-11.
STEP_RAD = 1e-4


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
    faded: BoolArray
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
) -> CorrectedTrajectory:
    """Return the trajectory to send for a wanted one of the nominal robot.

    ``compensator``: the correction; ``times_s``: ascending, (n,), n >= 2; ``positions,
    velocities``: wanted, rad and rad/s, (n, k); ``tolerance_m``: of the tool between points;
    ``velocity_limits, acceleration_limits``: rad/s and rad/s², (k,); those of the URDF, and none,
    where None; ``temperature_c``: of the arm.
    Raises InputError: numbers that are not finite, times that do not ascend, other shapes, or a
    path whose correction no point per millisecond follows.
    """
    t, q, v = _checked(compensator, times_s, positions, velocities)
    wanted = _Path(t, q, v)
    if velocity_limits is None:
        velocity_limits = compensator.model.chain.velocity_limits
    times = _spread(compensator, wanted)
    while True:
        sent, done = _sent(compensator, wanted, times, temperature_c)
        compared = COMPARED[v is not None]
        middle = times[:-1, None] + np.diff(times)[:, None] * compared
        exact = compensator.command(wanted.at(middle.ravel()), temperature_c)
        off = _distance(compensator, sent.at(middle.ravel()), exact).reshape(middle.shape)
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
    speed, acceleration = sent.largest()
    before = wanted.largest()
    stretched = max(1.0, float(np.max(speed / np.asarray(velocity_limits, dtype=float))))
    if acceleration_limits is not None and sent.v is not None:
        ratio = np.max(acceleration / np.asarray(acceleration_limits, dtype=float))
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
        done.faded,
        done.outside_range,
    )


def largest_speeds(
    times_s: FloatArray, positions: FloatArray, velocities: FloatArray | None
) -> FloatArray:
    """Return the largest speed of each joint of what a controller draws, rad/s, (k,)."""
    return _Path(times_s, positions, velocities).largest()[0]


class _Path:
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

    def largest(self) -> tuple[FloatArray, FloatArray]:
        """Return the largest speed and acceleration of each joint, (k,) each."""
        h = np.diff(self.t)[:, None]
        slope = np.diff(self.q, axis=0) / h
        if self.v is None:
            return np.abs(slope).max(axis=0), np.full(self.q.shape[1], np.nan)
        first, last = self.v[:-1], self.v[1:]
        # Of a cubic the acceleration is linear, and the speed has a vertex where it is none.
        start = (6.0 * slope - 4.0 * first - 2.0 * last) / h
        end = (2.0 * first + 4.0 * last - 6.0 * slope) / h
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
    if len(t) < 2 or np.any(np.diff(t) <= 0.0):
        raise InputError('trajectory: needs two points or more, at times that ascend')
    return t, q, v


def _spread(compensator: Compensator, wanted: _Path) -> FloatArray:
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


def _sent(
    compensator: Compensator, wanted: _Path, times: FloatArray, temperature_c: float | None
) -> tuple[_Path, Correction]:
    """Return the corrected path through points at these times, and what was done to them."""
    v = None if wanted.v is None else wanted.speed(times)
    done, speeds = corrected_points(compensator, wanted.at(times), v, temperature_c)
    return _Path(times, done.command, speeds), done


def corrected_points(
    compensator: Compensator,
    q: FloatArray,
    v: FloatArray | None,
    temperature_c: float | None = None,
) -> tuple[Correction, FloatArray | None]:
    """Return what to command for points, and their velocities.

    ``compensator, temperature_c``: as of `corrected_trajectory`; ``q, v``: wanted, rad and rad/s,
    (n, k); None where there are no velocities.
    """
    done = compensator.correct(q, temperature_c)
    if v is None:
        return done, None
    # The correction is a function of the joints: its change along the way there.
    size = np.abs(v).max(axis=1, keepdims=True)
    step = STEP_RAD * np.divide(v, size, out=np.zeros_like(v), where=size > 0.0)
    both = compensator.command(np.concatenate((q + step, q - step)), temperature_c)
    ahead, behind = both[: len(q)], both[len(q) :]
    return done, (ahead - behind) * size / (2.0 * STEP_RAD)


def _distance(compensator: Compensator, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return how far the tool is apart at joints (n, k), m, (n,)."""
    tools = [compensator.model.chain.forward(q)[:, :3, 3] for q in (a, b)]
    return np.asarray(np.linalg.norm(tools[0] - tools[1], axis=1))


def _added(before: FloatArray, after: FloatArray) -> FloatArray:
    return np.divide(after, before, out=np.ones_like(after), where=before > 0.0) - 1.0
