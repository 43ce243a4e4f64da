"""Free forms: cubic B-splines of a driver with a roughness penalty (P-splines) and zero mean.

Eilers & Marx 1996, Statistical Science 11. The penalty is a Gaussian prior up to one factor, the
smoothness, which the evidence decides; see `discovery.evidence`.

What is constant in a free form is another parameter's already, a zero-offset's or a
registration's. The heights w of the splines are therefore bound to Σ c_i w_i = 0 with c_i the mean
of spline i over the rows to fit, and the height of the most visited spline p follows from the
others (Wood 2017, Generalized Additive Models, sec. 5.4.1)::

    f(x) = Σ_{i≠p} w_i (B_i(x) − c_i / c_p B_p(x))
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from remaster_ros.types import BoolArray, FloatArray

DEGREE = 3
# Keeps the straight line, which the roughness leaves free, of a finite size.
RIDGE = 1e-3
# The same of the heights of a joint's error curve: white up to some 15 waves a turn. With `RIDGE`
# a UR10 has 134 less of log evidence, and a curve of a few waves is taken for gear waves.
CURVE_RIDGE = 1.0
TURN = 2.0 * np.pi
# An angle that takes all values of the turn up to a gap of so many knots has a closed curve.
CLOSED_GAP = 3.0


@dataclass(frozen=True, eq=False)
class Curve:
    """Cubic spline of a quantity (driver), bound to zero mean over the values it was made for.

    Its free heights are those of all splines but one, which follows from the zero mean.
    """

    knots: FloatArray  # Uniform, in the unit of the driver, (m + 4,), or (m + 7,) where closed
    # Where the turn begins that angles are brought to, rad; NaN where the driver is no angle of a
    # joint that turns over
    start: float
    closed: bool  # The curve runs into itself after a turn
    visited: FloatArray  # The values that it was made for, each once, sorted, in that turn, (v,)
    weights: FloatArray  # Mean of each spline over these values, as often as they occurred, (m,)

    @classmethod
    def of(
        cls, values: FloatArray, share: float, finest: float = 0.0, turns_over: bool = False
    ) -> Curve:
        """Return the curve for a driver's values in the rows to fit.

        Parameters
        ----------
        values
            (n,), in the unit of the driver.
        share
            Distance of the knots as a share of the range of the values.
        finest
            Least distance of the knots, in the unit of the driver.
        turns_over
            Whether the driver is an angle, rad, of a joint that turns more than once: values are
            brought into one turn, and the curve is closed if they fill it up to a small gap.
        """
        start = np.nan
        if turns_over:
            start = start_of_turn(values)
            values = in_turn(values, start)
        low, high = float(values.min()), float(values.max())
        spacing = max(finest, share * (high - low))
        closed = turns_over and high - low > TURN - CLOSED_GAP * spacing
        if closed:
            knots = knot_vector(start, start + TURN, spacing)
        else:
            knots = knot_vector(low, max(high, low + 3.0 * spacing), spacing)
        found = cls(knots, start, closed, np.unique(values), np.zeros(0))
        weights = found.splines(values).mean(axis=0)
        return cls(knots, start, closed, found.visited, weights)

    def among(self, values: FloatArray) -> Curve:
        """Return a copy of the curve whose visited values, as used by `seen`, are these, (n,)."""
        return replace(self, visited=np.unique(self.in_turn(values)))

    @property
    def step(self) -> float:
        """Distance of the knots, in the unit of the driver."""
        return float(self.knots[1] - self.knots[0])

    @cached_property
    def _pivot(self) -> int:
        """Index of the spline with the largest mean, whose height follows from the zero mean."""
        return int(np.argmax(self.weights))

    def splines(self, values: FloatArray) -> FloatArray:
        """Return the values of all m splines at values (n,) of the driver, (n, m)."""
        found = basis(self.in_turn(values), self.knots)
        if not self.closed:
            return found
        # The last splines are the first ones of the next turn.
        folded = found[:, :-DEGREE].copy()
        folded[:, :DEGREE] += found[:, -DEGREE:]
        return folded

    def columns(self, values: FloatArray) -> FloatArray:
        """Return the curve's value by one unit of each free height, (n, m − 1).

        ``values``: of the driver, (n,). m: number of splines.
        """
        found = self.splines(values)
        ratio = self._others(self.weights) / self.weights[self._pivot]
        return self._others(found) - found[:, [self._pivot]] * ratio

    @property
    def places(self) -> FloatArray:
        """Values of the driver at the peaks of the free splines, (m − 1,)."""
        peaks = centers(self.knots)
        return self._others(peaks[:-DEGREE] if self.closed else peaks)

    @property
    def heights(self) -> FloatArray:
        """Matrix from the free heights to the heights of all m splines, (m, m − 1)."""
        heights: FloatArray = np.delete(np.eye(len(self.weights)), self._pivot, axis=1)
        heights[self._pivot] = -self._others(self.weights) / self.weights[self._pivot]
        return heights

    @property
    def penalty(self) -> FloatArray:
        """Roughness penalty on the free heights, (m − 1, m − 1)."""
        heights = self.heights
        found: FloatArray = heights.T @ roughness(len(heights), self.closed, CURVE_RIDGE) @ heights
        return found

    def grid(self, per_knot: int = 8) -> FloatArray:
        """Return evenly spaced values of the driver from the first to the last knot, (g,).

        ``per_knot``: number of steps between two knots.
        """
        low, high = self.knots[DEGREE], self.knots[-DEGREE - 1]
        return np.linspace(low, high, 1 + round((high - low) / self.step) * per_knot)

    def in_turn(self, values: FloatArray) -> FloatArray:
        """Return values (n,) with whole turns added, so that they are in the turn of the curve.

        Unchanged if the driver is no angle that turns over.
        """
        return values if np.isnan(self.start) else in_turn(values, self.start)

    def seen(self, values: FloatArray, reach: float = 1.0) -> BoolArray:
        """Mask of the values, (n,), within `reach` knot distances of a visited value, (n,)."""
        at, visited = self.in_turn(values), self.visited
        if not np.isnan(self.start):
            visited = np.concatenate((visited[-1:] - TURN, visited, visited[:1] + TURN))
        after = np.searchsorted(visited, at)
        below = visited[np.maximum(after - 1, 0)]
        above = visited[np.minimum(after, len(visited) - 1)]
        found: BoolArray = np.minimum(np.abs(at - below), np.abs(above - at)) <= reach * self.step
        return found

    def _others(self, values: FloatArray) -> FloatArray:
        """Return values, (…, m), without that of the pivot spline, (…, m − 1)."""
        return np.delete(values, self._pivot, axis=-1)


def start_of_turn(values: FloatArray) -> float:
    """Return the start of the turn of 2π into which angles are brought, rad.

    It lies in the middle of the widest gap between the angles modulo 2π. Of all such starts, 2π
    apart, it is the one with which most angles stay unchanged. ``values``: rad, (n,).
    """
    at = np.sort(np.mod(values, TURN))
    gaps = np.append(at[1:], at[0] + TURN) - at
    widest = int(np.argmax(gaps))
    start = float(at[widest] + 0.5 * gaps[widest])
    moved = in_turn(values, start) - values
    return start - round(float(np.median(np.round(moved / TURN)))) * TURN


def in_turn(values: FloatArray, start: float) -> FloatArray:
    """Return angles (n,), rad, with whole turns added: from ``start`` to a turn above it."""
    found: FloatArray = start + np.mod(values - start, TURN)
    return found


def knot_vector(low: float, high: float, spacing: float) -> FloatArray:
    """Uniform knots over [low, high], at most ``spacing`` apart, with DEGREE more beyond each end.

    There are at least two intervals.
    """
    count = max(2, int(np.ceil((high - low) / spacing)))
    step = (high - low) / count
    knots: FloatArray = low + step * np.arange(-DEGREE, count + DEGREE + 1.0)
    return knots


def basis(values: FloatArray, knots: FloatArray) -> FloatArray:
    """Return the values of all m cubic B-splines at values (n,), (n, m).

    Beyond the first and last inner knot those at the nearest of these.
    """
    low, high = knots[DEGREE], knots[-DEGREE - 1]
    inside = np.clip(values, low, high)
    return np.asarray(scipy.interpolate.BSpline.design_matrix(inside, knots, DEGREE).toarray())


def centers(knots: FloatArray) -> FloatArray:
    """Return the position of each cubic spline's peak, (m,): mean of its first and last knot."""
    return 0.5 * (knots[:-4] + knots[4:])


def roughness(count: int, closed: bool = False, ridge: float = RIDGE) -> FloatArray:
    """Return the penalty matrix on `count` coefficients: second differences, and a ridge.

    ``closed``: the last coefficient is a neighbour of the first; ``ridge``: added to the
    diagonal. (count, count).
    """
    if closed:
        unit = np.eye(count)
        differences = np.roll(unit, 1, axis=0) - 2.0 * unit + np.roll(unit, -1, axis=0)
    else:
        differences = np.diff(np.eye(count), n=2, axis=0)
    return differences.T @ differences + ridge * np.eye(count)
