# SPDX-License-Identifier: Apache-2.0
"""Curves through configurations whose positions, velocities and accelerations are continuous.

A cubic spline is what a controller draws between positions and velocities, so that it follows one
exactly. It begins and ends with a straight piece: an arm that leaves rest, or comes to rest, is on
a line there, as in any other move.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.types import FloatArray

STRAIGHT_SHARE = 0.6
"""Share of the first and of the last interval between two configurations that is straight: of an
interval of 1.5 s the 0.9 s that a beginning takes (`trajectory.LEAD_S`), 0.6 s to bend."""
BEGINS_RAD = 0.02
"""An arm stands where a curve begins if no joint is further off, rad: ten times what counts as
arrived by default. The curve that is checked and gone begins where it stands."""
SAGITTA_RAD = 2e-4
"""The samples of a spline are so near that no chord between two is further from it, rad, or m of a
joint that slides: at the end of an arm of a metre 0.2 mm, which path checks add to the clearance
(`path_search.beside_chords_m`)."""
MOST_POINTS = 100
"""A curve through more places is refused: with one a second that is a minute and a half."""
MOST_SAMPLES = 4_000
"""A curve that needs more samples is refused: a minute of motion needs some 2,000, noise more.
With both the check of a curve takes some hundredths of a second."""
NEWTON_ROUNDS = 3
"""Steps from the nearest place on a chord to the nearest on the curve, to 1e-9 rad."""


@dataclass(frozen=True, eq=False)
class Spline:
    """Piecewise cubic curve in joint space over a share from 0 to 1, C2."""

    knots: FloatArray  # Shares at which a piece begins or ends, from 0 to 1, (m + 1,)
    # Of the powers of the share since the piece's knot, rad or m, (4, m, k)
    coefficients: FloatArray

    @classmethod
    def through(cls, points: FloatArray, shares: FloatArray) -> Spline:
        """Return the natural cubic spline through configurations.

        Between the first two and the last two, `STRAIGHT_SHARE` is a straight piece: its inner
        end is where the second derivative vanishes and the first one is continuous.

        Parameters
        ----------
        points
            rad or m, (n, k), n >= 3.
        shares
            Their shares of the curve, (n,), ascending from 0 to 1.

        Raises
        ------
        ValueError
            Other shapes, more than `MOST_POINTS` points, points that are not finite, shares that
            do not ascend, or more than `MOST_SAMPLES` samples.
        """
        q, s = np.asarray(points, dtype=float), np.asarray(shares, dtype=float)
        if q.ndim != 2 or len(q) < 3 or s.shape != (len(q),):
            raise ValueError(f'a curve needs three configurations, each with its share: {q.shape}')
        if len(q) > MOST_POINTS:
            raise ValueError(f'a curve through {len(q)} configurations; {MOST_POINTS} at most')
        if s[0] != 0.0 or s[-1] != 1.0 or not np.all(np.diff(s) > 0.0):
            raise ValueError('the shares of a curve must ascend from 0 to 1')
        if not np.all(np.isfinite(q)):
            raise ValueError('a configuration of a curve is not finite')
        first, last = STRAIGHT_SHARE * s[1], 1.0 - STRAIGHT_SHARE * (1.0 - s[-2])
        knots = np.concatenate(([0.0, first], s[1:-1], [last, 1.0]))
        places, second = _natural(q, knots)
        h = np.diff(knots)[:, None]
        left, right = second[:-1], second[1:]
        slope = np.diff(places, axis=0) / h - h * (2.0 * left + right) / 6.0
        spline = cls(knots, np.array([places[:-1], slope, left / 2.0, (right - left) / (6.0 * h)]))
        if spline._counts.sum() > MOST_SAMPLES:
            raise ValueError(f'a curve of {spline._counts.sum()} samples; {MOST_SAMPLES} at most')
        return spline

    @property
    def start(self) -> FloatArray:
        """Configuration at the share 0, rad or m, (k,)."""
        return self.coefficients[0, 0]

    @cached_property
    def end(self) -> FloatArray:
        """Configuration at the share 1, rad or m, (k,)."""
        return self.at(np.ones(1))[0]

    @property
    def straight_until(self) -> float:
        """Share at which the straight piece ends with which every curve begins; above 0."""
        return float(self.knots[1])

    @property
    def straight_from(self) -> float:
        """Share at which the straight piece at the end begins."""
        return float(self.knots[-2])

    def at(self, share: FloatArray, order: int = 0) -> FloatArray:
        """Return configurations (n, k) at shares (n,), or derivatives by the share.

        ``order``: 0, 1 or 2. Shares outside 0 to 1 continue the first or last piece.
        """
        piece = np.clip(np.searchsorted(self.knots, share, 'right') - 1, 0, len(self.knots) - 2)
        t = (share - self.knots[piece])[:, None]
        a, b, c, d = self.coefficients[:, piece]
        if order == 0:
            return np.asarray(a + t * (b + t * (c + t * d)))
        return np.asarray(b + t * (2.0 * c + 3.0 * t * d) if order == 1 else 2.0 * c + 6.0 * t * d)

    @cached_property
    def _counts(self) -> FloatArray:
        """Number of chords of each piece, (m,), by `SAGITTA_RAD`."""
        _, _, c, d = self.coefficients
        h = np.diff(self.knots)
        # A cubic bends most at one of its ends.
        bend = np.max(np.maximum(np.abs(2.0 * c), np.abs(2.0 * c + 6.0 * d * h[:, None])), axis=1)
        return np.maximum(np.ceil(h * np.sqrt(bend / (8.0 * SAGITTA_RAD))), 4.0)

    @cached_property
    def samples(self) -> tuple[FloatArray, FloatArray]:
        """Shares (p,) from 0 to 1, and configurations there, rad or m, (p, k)."""
        parts = [
            low + (high - low) * np.arange(count) / count
            for low, high, count in zip(self.knots, self.knots[1:], self._counts)
        ]
        shares = np.concatenate([*parts, [1.0]])
        return shares, self.at(shares)

    def nearest(
        self, q: FloatArray, units: JointUnits, low: float = 0.0, high: float = 1.0
    ) -> FloatArray:
        """Return the shares (n,) at which the curve is nearest to configurations (n, k).

        By the sum of squares, a slide as `units` count it. ``low, high``: only between these.
        """
        shares, places = self.samples
        inside = slice(*np.searchsorted(shares, (low, high)))
        shares = np.concatenate(([low], shares[inside], [high]))
        places = self.at(shares) / units.per_radian
        here = q / units.per_radian
        # The nearest place on each chord, and on the nearest of them.
        chords = np.diff(places, axis=0)
        squares = np.sum(chords**2, axis=1)
        along = here @ chords.T - np.sum(places[:-1] * chords, axis=1)
        part = np.clip(along / np.where(squares > 0.0, squares, np.inf), 0.0, 1.0)
        # |here - place|² less |here|², which is the same for all of them.
        off = np.sum(places[:-1] ** 2, axis=1) - 2.0 * here @ places[:-1].T
        off += part * (part * squares - 2.0 * along)
        nearest = np.argmin(off, axis=1)
        span = np.diff(shares)
        share = shares[nearest] + part[np.arange(len(q)), nearest] * span[nearest]
        least = shares[np.maximum(nearest - 1, 0)]
        most = shares[np.minimum(nearest + 2, len(shares) - 1)]
        for _ in range(NEWTON_ROUNDS):
            off = self.at(share) / units.per_radian - here
            tangent = self.at(share, 1) / units.per_radian
            length = np.sum(tangent**2, axis=1)
            step = np.sum(off * tangent, axis=1) / np.where(length > 0.0, length, np.inf)
            share = np.clip(share - step, least, most)
        return share


def _natural(q: FloatArray, knots: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the curve's positions and second derivatives at the knots, (m + 1, k) each.

    ``q``: positions at all knots but the second and the last but one, (m - 1, k). The second
    derivative is zero at the first two and the last two knots; where the curve is at the
    second and the last but one follows from its slope, which is continuous at every inner
    knot.
    """
    h, last = np.diff(knots), len(knots) - 1
    # One row for the slope at each inner knot; columns are the second derivatives at the knots 2
    # to m - 2, with the places at the knots 1 and m - 1 before and behind them.
    matrix = np.zeros((last - 1, last - 1))
    target = np.zeros((last - 1, q.shape[1]))
    free = {1, last - 1}
    known = {0: 0, last: len(q) - 1, **{knot: knot - 1 for knot in range(2, last - 1)}}
    for knot in range(1, last):
        row = knot - 1
        before, after = h[knot - 1], h[knot]
        for other, weight in (
            (knot - 1, before / 6.0),
            (knot, (before + after) / 3.0),
            (knot + 1, after / 6.0),
        ):
            if 2 <= other <= last - 2:
                matrix[row, other - 1] += weight
        for other, weight in (
            (knot - 1, 1.0 / before),
            (knot, -1.0 / before - 1.0 / after),
            (knot + 1, 1.0 / after),
        ):
            if other in free:
                matrix[row, other - 1] -= weight
            else:
                target[row] += weight * q[known[other]]
    solved = np.linalg.solve(matrix, target)
    places, second = np.zeros((last + 1, q.shape[1])), np.zeros((last + 1, q.shape[1]))
    for knot, index in known.items():
        places[knot] = q[index]
    places[1], places[last - 1] = solved[0], solved[-1]
    second[2 : last - 1] = solved[1:-1]
    return places, second
