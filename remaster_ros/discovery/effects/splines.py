"""Free forms: cubic B-splines of a driver with a roughness penalty (P-splines).

Eilers & Marx 1996, Statistical Science 11. The penalty is a Gaussian prior up to one factor, the
smoothness, which the evidence decides; see `discovery.evidence`.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from remaster_ros.types import FloatArray

DEGREE = 3
# Keeps the straight line, which the roughness leaves free, of a finite size.
RIDGE = 1e-3


def knot_vector(low: float, high: float, spacing: float) -> FloatArray:
    """Return uniform knots over [low, high], about ``spacing`` apart, with those beyond."""
    count = max(2, int(np.ceil((high - low) / spacing)))
    step = (high - low) / count
    knots: FloatArray = low + step * np.arange(-DEGREE, count + DEGREE + 1.0)
    return knots


def basis(values: FloatArray, knots: FloatArray) -> FloatArray:
    """Return the splines' values, (n, m), at values (n,); outside the knots those of the edge."""
    low, high = knots[DEGREE], knots[-DEGREE - 1]
    inside = np.clip(values, low, high)
    return np.asarray(BSpline.design_matrix(inside, knots, DEGREE).toarray())


def centers(knots: FloatArray) -> FloatArray:
    """Return where each spline has its peak, (m,)."""
    return 0.5 * (knots[:-4] + knots[4:])


def roughness(count: int) -> FloatArray:
    """Return the penalty on m coefficients, (m, m): second differences, their mean, a small ridge.

    What is constant in a free form is another parameter's already, a zero-offset's or a
    registration's: the penalty on the mean leaves it there.
    """
    differences = np.diff(np.eye(count), n=2, axis=0)
    mean = np.full((count, count), 1.0 / count)
    return differences.T @ differences + mean + RIDGE * np.eye(count)
