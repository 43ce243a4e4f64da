# SPDX-License-Identifier: Apache-2.0
"""Motion of the fake arm: a second-order servo that follows a trajectory, in closed form.

The reported joint positions x follow a reference r by x'' + 2 ζ ω x' + ω² x = ω² r. Each piece of
the reference is a polynomial, so x lags while moving, overshoots a little and settles. The
solution is a polynomial plus a decaying oscillation: exact at any time, without integration, and
therefore the same in every process that has read the trajectories.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.types import FloatArray

NATURAL_FREQUENCY = 14.0
"""ω of the servo, rad/s."""
DAMPING = 0.7
"""ζ of the servo; below 1 the arm overshoots."""
_DECAY = DAMPING * NATURAL_FREQUENCY
_DAMPED = NATURAL_FREQUENCY * np.sqrt(1 - DAMPING * DAMPING)
"""ζω and ω_d = ω √(1 - ζ²), rad/s."""


@dataclass(frozen=True)
class ServoPoint:
    """Point of a trajectory: time from its start (s), position (rad) and velocity (rad/s).

    Without a velocity the controller interpolates linearly towards the point, as the real one
    does.
    """

    time_s: float
    q: FloatArray
    velocity: FloatArray | None = None


def spline(
    start: FloatArray,
    start_velocity: FloatArray,
    end: FloatArray,
    end_velocity: FloatArray | None,
    duration: float,
) -> FloatArray:
    """Polynomial coefficients between two waypoints, lowest power first, (2 or 4, k).

    Of the positions over time in s from the first waypoint. Cubic (Hermite) if
    ``end_velocity`` is given, else linear, whatever the velocity at the start. `duration`: s,
    above 0.
    """
    T, gap = duration, end - start
    if end_velocity is None:
        return np.array([start, gap / T])
    c2 = (3 * gap / T - 2 * start_velocity - end_velocity) / T
    c3 = (start_velocity + end_velocity - 2 * gap / T) / T**2
    return np.array([start, start_velocity, c2, c3])


def from_now(
    now_s: float, begins_s: float | None, points: Sequence[ServoPoint]
) -> tuple[list[ServoPoint], tuple[FloatArray, FloatArray] | None]:
    """Remaining points of a trajectory, and its reference (position, velocity) now, or None.

    As in joint_trajectory_controller, points whose time has passed are dropped, and the
    reference is between the last passed and the first remaining point. None, which means to
    begin at the arm's own position, if no point has passed, or all have (then no point
    remains). ``begins_s``: stamp of the trajectory, s, None for now; ``points``: at times from
    the stamp; the remaining ones are at times from ``now_s``.
    """
    since_s = 0.0 if begins_s is None else now_s - begins_s
    remaining = [
        ServoPoint(point.time_s - since_s, point.q, point.velocity)
        for point in points
        if point.time_s > since_s
    ]
    behind = [point for point in points if point.time_s <= since_s]
    if not behind or not remaining:
        return remaining, None
    last, ahead = behind[-1], points[len(behind)]
    zeros = np.zeros_like(last.q)
    start = zeros if last.velocity is None else last.velocity
    piece = spline(last.q, start, ahead.q, ahead.velocity, ahead.time_s - last.time_s)
    powers = (since_s - last.time_s) ** np.arange(len(piece))
    slope = piece[1:] * np.arange(1, len(piece))[:, None]
    return remaining, (powers @ piece, powers[: len(slope)] @ slope)


def _steady_response(reference: FloatArray) -> FloatArray:
    """Polynomial particular solution of the servo equation for a polynomial reference.

    Coefficients over time in s, lowest power first, (powers, k), as those of ``reference``.
    """
    w, z = NATURAL_FREQUENCY, DAMPING
    out = np.zeros_like(reference)
    for power in range(len(reference) - 1, -1, -1):
        value = np.array(reference[power])
        if power + 1 < len(reference):
            value = value - (2 * z / w) * (power + 1) * out[power + 1]
        if power + 2 < len(reference):
            value = value - (power + 2) * (power + 1) / w**2 * out[power + 2]
        out[power] = value
    return out


@dataclass(frozen=True)
class _Response:
    """Position of the servo from ``start_s`` on: polynomial and decaying oscillation.

    x(s) = polynomial(s) + e^(-ζωs) (a cos ω_d s + b sin ω_d s) for s = t - start_s >= 0.
    """

    start_s: float
    polynomial: FloatArray
    a: FloatArray
    b: FloatArray

    @classmethod
    def of(cls, start_s: float, reference: FloatArray, x: FloatArray, v: FloatArray) -> _Response:
        """Response to a polynomial reference (powers, k) from positions x and velocities v, (k,).

        All at ``start_s``, from which the polynomial's time counts.
        """
        steady = _steady_response(reference)
        a = x - steady[0]
        slope = steady[1] if len(steady) > 1 else np.zeros_like(x)
        b = (v - slope + _DECAY * a) / _DAMPED
        return cls(start_s, steady, a, b)

    def at(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Position and velocity, (k,) each, at world time t, s, from ``start_s`` on."""
        s = t - self.start_s
        decay = np.exp(-_DECAY * s)
        cosine, sine = decay * np.cos(_DAMPED * s), decay * np.sin(_DAMPED * s)
        powers = s ** np.arange(len(self.polynomial))
        slope = self.polynomial[1:] * np.arange(1, len(self.polynomial))[:, None]
        x = powers @ self.polynomial + self.a * cosine + self.b * sine
        v = powers[: len(slope)] @ slope
        v = v + (self.b * _DAMPED - _DECAY * self.a) * cosine
        v = v - (self.a * _DAMPED + _DECAY * self.b) * sine
        return x, v


class Motion:
    """Reported joint positions of the arm over time, by the commanded trajectories.

    ``start_s``: world time of the beginning, s; ``q``: joint positions at rest at that time, rad,
    (k,).
    """

    def __init__(self, start_s: float, q: FloatArray) -> None:
        q = np.asarray(q, float)
        self._responses = [_Response.of(start_s, q[None], q, np.zeros_like(q))]

    def follow(
        self,
        start_s: float,
        waypoints: Sequence[ServoPoint],
        reference_now: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        """Follow a trajectory from ``start_s`` on, in place of the rest of the last one.

        ``waypoints``: at increasing times from ``start_s``, above 0; the last position is
        held. ``reference_now``: position and velocity of the trajectory at ``start_s``, (k,)
        each; None if it begins at the arm's own. Of the motion before ``start_s``, only the
        last 16 parts between waypoints are kept.
        """
        # A later trajectory replaces the future of the former one.
        past = [r for r in self._responses if r.start_s <= start_s] or self._responses[:1]
        # The past is read back for seconds at most; memory stays bounded over hours of collection.
        self._responses = past[-16:]
        x, v = self.at(start_s)
        reference, velocity = (x, v) if reference_now is None else reference_now
        begin_s = 0.0
        for waypoint in waypoints:
            # Differences of times from the start: in world time those of a message may vanish.
            duration_s = waypoint.time_s - begin_s
            piece = spline(reference, velocity, waypoint.q, waypoint.velocity, duration_s)
            response = _Response.of(start_s + begin_s, piece, x, v)
            self._responses.append(response)
            x, v = response.at(start_s + waypoint.time_s)
            reference, begin_s = waypoint.q, waypoint.time_s
            velocity = np.zeros_like(x) if waypoint.velocity is None else waypoint.velocity
        self._responses.append(_Response.of(start_s + begin_s, reference[None], x, v))

    def at(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Joint positions (rad) and velocities (rad/s) at world time t, s, (k,) each.

        For times before the oldest part of the motion that is kept: those at its beginning.
        """
        for response in reversed(self._responses):
            if response.start_s <= t:
                return response.at(t)
        return self._responses[0].at(self._responses[0].start_s)
