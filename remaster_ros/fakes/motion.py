"""How the fake arm moves: a second-order servo behind a trajectory, solved in closed form.

The reported joint positions x follow a reference r by x'' + 2 ζ ω x' + ω² x = ω² r. Each
segment's reference is a quintic that ends at rest, held afterwards, so x lags while moving,
overshoots a little and settles. The solution is a polynomial plus a decaying oscillation: exact at
any time, without integration, and therefore the same in every process that knows the segments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from remaster_ros.core.types import FloatArray

NATURAL_FREQUENCY = 14.0
"""ω of the servo, rad/s."""
DAMPING = 0.7
"""ζ of the servo; below 1 the arm overshoots."""


def quintic(start: FloatArray, velocity: FloatArray, end: FloatArray, duration: float) -> FloatArray:
    """Coefficients, lowest power first, (6, k), of the quintic that ends at rest at `end`.

    It starts at `start` (rad) with `velocity` (rad/s) and zero acceleration, and takes
    `duration` s.
    """
    T = duration
    gap = end - start - velocity * T
    # Solve r(T) = end, r'(T) = r''(T) = 0 for the three highest coefficients.
    c3 = (10 * gap + 4 * velocity * T) / T**3
    c4 = (-15 * gap - 7 * velocity * T) / T**4
    c5 = (6 * gap + 3 * velocity * T) / T**5
    return np.array([start, velocity, np.zeros_like(start), c3, c4, c5])


def _steady_response(reference: FloatArray) -> FloatArray:
    """Polynomial particular solution of the servo equation for a polynomial reference."""
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


def _derivative(coefficients: FloatArray) -> FloatArray:
    return coefficients[1:] * np.arange(1, len(coefficients))[:, None]


@dataclass(frozen=True)
class _Response:
    """x(s) = polynomial(s) + e^(-ζωs) (a cos ω_d s + b sin ω_d s) for s = t - start >= 0."""

    start_s: float
    polynomial: FloatArray
    a: FloatArray
    b: FloatArray

    @classmethod
    def of(cls, start_s: float, reference: FloatArray, x: FloatArray, v: FloatArray) -> _Response:
        steady = _steady_response(reference)
        w, z = NATURAL_FREQUENCY, DAMPING
        wd = w * np.sqrt(1 - z * z)
        a = x - steady[0]
        slope = steady[1] if len(steady) > 1 else np.zeros_like(x)
        b = (v - slope + z * w * a) / wd
        return cls(start_s, steady, a, b)

    def at(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Position and velocity at time t."""
        s = t - self.start_s
        w, z = NATURAL_FREQUENCY, DAMPING
        wd = w * np.sqrt(1 - z * z)
        decay, c, sn = np.exp(-z * w * s), np.cos(wd * s), np.sin(wd * s)
        powers = s ** np.arange(len(self.polynomial))
        slope = _derivative(self.polynomial)
        x = powers @ self.polynomial + decay * (self.a * c + self.b * sn)
        v = powers[: len(slope)] @ slope + decay * (
            (self.b * wd - z * w * self.a) * c - (self.a * wd + z * w * self.b) * sn
        )
        return x, v


class Motion:
    """The arm's reported joint positions over time, as commanded segments make them.

    Parameters
    ----------
    start_s
        World time of the beginning, s.
    q
        Joint positions at rest then, rad, (k,).
    """

    def __init__(self, start_s: float, q: FloatArray) -> None:
        q = np.asarray(q, float)
        self._responses = [_Response.of(start_s, q[None], q, np.zeros_like(q))]

    def command(self, start_s: float, end: FloatArray, duration: float) -> None:
        """From `start_s` on go to `end` (rad, (k,)) in `duration` s; replaces what is under way.

        Two pieces of response are kept for a segment: while the reference moves, and after.
        """
        # A later command replaces what of the former has not happened yet.
        self._responses = [r for r in self._responses if r.start_s <= start_s] or [
            self._responses[0]
        ]
        x, v = self.at(start_s)
        end = np.asarray(end, float)
        moving = _Response.of(start_s, quintic(x, v, end, duration), x, v)
        arrived = moving.at(start_s + duration)
        self._responses += [moving, _Response.of(start_s + duration, end[None], *arrived)]
        # Nobody asks for times long gone; bounded memory over hours of collection.
        del self._responses[:-8]

    def at(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Joint positions (rad) and velocities (rad/s) at world time t, each (k,)."""
        for response in reversed(self._responses):
            if response.start_s <= t:
                return response.at(t)
        return self._responses[0].at(self._responses[0].start_s)
