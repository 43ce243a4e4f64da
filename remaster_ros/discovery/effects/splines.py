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
    """Free curve of a driver (a spline) with zero mean over the values it was made for."""

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
        """Return the curve of a driver's values in the rows to fit.

        Parameters
        ----------
        values
            (n,).
        share
            Distance of the knots as a share of the range of the values.
        finest
            The least distance.
        turns_over
            Whether the driver is an angle, rad, that is the same after a turn.
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
        """Curve with these values of the driver as visited, (n,)."""
        return replace(self, visited=np.unique(self.in_turn(values)))

    @property
    def step(self) -> float:
        """Distance of the knots."""
        return float(self.knots[1] - self.knots[0])

    @cached_property
    def _pivot(self) -> int:
        return int(np.argmax(self.weights))

    def splines(self, values: FloatArray) -> FloatArray:
        """Return the splines' values, (n, m), at values (n,)."""
        found = basis(self.in_turn(values), self.knots)
        if not self.closed:
            return found
        # The last splines are the first ones of the next turn.
        folded = found[:, :-DEGREE].copy()
        folded[:, :DEGREE] += found[:, -DEGREE:]
        return folded

    def columns(self, values: FloatArray) -> FloatArray:
        """Return the curve at values (n,) by a unit of each free height, (n, m − 1)."""
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
        """Heights of all splines by a unit of each free height, (m, m − 1)."""
        heights: FloatArray = np.delete(np.eye(len(self.weights)), self._pivot, axis=1)
        heights[self._pivot] = -self._others(self.weights) / self.weights[self._pivot]
        return heights

    @property
    def penalty(self) -> FloatArray:
        """Penalty on the free heights, (m − 1, m − 1)."""
        heights = self.heights
        found: FloatArray = heights.T @ roughness(len(heights), self.closed, CURVE_RIDGE) @ heights
        return found

    def grid(self, per_knot: int = 8) -> FloatArray:
        """Return evenly spaced values of the driver over the whole curve, (g,)."""
        low, high = self.knots[DEGREE], self.knots[-DEGREE - 1]
        return np.linspace(low, high, 1 + round((high - low) / self.step) * per_knot)

    def in_turn(self, values: FloatArray) -> FloatArray:
        """Return values (n,) brought to the turn of the curve."""
        return values if np.isnan(self.start) else in_turn(values, self.start)

    def seen(self, values: FloatArray, reach: float = 1.0) -> BoolArray:
        """Return whether values, (n,), are within `reach` knot steps of a visited value, (n,)."""
        at, visited = self.in_turn(values), self.visited
        if not np.isnan(self.start):
            visited = np.concatenate((visited[-1:] - TURN, visited, visited[:1] + TURN))
        after = np.searchsorted(visited, at)
        below = visited[np.maximum(after - 1, 0)]
        above = visited[np.minimum(after, len(visited) - 1)]
        found: BoolArray = np.minimum(np.abs(at - below), np.abs(above - at)) <= reach * self.step
        return found

    def _others(self, values: FloatArray) -> FloatArray:
        return np.delete(values, self._pivot, axis=-1)


def start_of_turn(values: FloatArray) -> float:
    """Return the middle of the largest gap between angles, rad, less whole turns.

    So that most angles are in the turn from there.
    """
    at = np.sort(np.mod(values, TURN))
    gaps = np.append(at[1:], at[0] + TURN) - at
    widest = int(np.argmax(gaps))
    start = float(at[widest] + 0.5 * gaps[widest])
    moved = in_turn(values, start) - values
    return start - round(float(np.median(np.round(moved / TURN)))) * TURN


def in_turn(values: FloatArray, start: float) -> FloatArray:
    """Return angles (n,) brought to the turn that begins at ``start``, rad."""
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
    """Return the splines at values (n,), (n, m); beyond the knots the values at the edge."""
    low, high = knots[DEGREE], knots[-DEGREE - 1]
    inside = np.clip(values, low, high)
    return np.asarray(scipy.interpolate.BSpline.design_matrix(inside, knots, DEGREE).toarray())


def centers(knots: FloatArray) -> FloatArray:
    """Return the place of each spline's peak, (m,)."""
    return 0.5 * (knots[:-4] + knots[4:])


def roughness(count: int, closed: bool = False, ridge: float = RIDGE) -> FloatArray:
    """Return the penalty on m coefficients, (m, m): second differences and a small ridge."""
    if closed:
        unit = np.eye(count)
        differences = np.roll(unit, 1, axis=0) - 2.0 * unit + np.roll(unit, -1, axis=0)
    else:
        differences = np.diff(np.eye(count), n=2, axis=0)
    return differences.T @ differences + ridge * np.eye(count)
