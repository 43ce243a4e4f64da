# SPDX-License-Identifier: Apache-2.0
"""Limits of p-values for a test that is repeated while data come in.

A test at 1 % that is repeated a dozen times fires in far more than 1 % of the sessions without a
fault. Here each look may spend a part of the error rate: after the share t of all data 2 - 2 Φ(z /
√t) of it, z being the upper quantile at half of the error rate (Lan and DeMets 1983,
doi:10.1093/biomet/70.3.659, in the form of O'Brien and Fleming 1979). Early looks spend next to
nothing, so that the last one is nearly as powerful as a single test.

The limits follow from the joint distribution of the looks (Armitage, McPherson and Rowe 1969,
doi:10.2307/2343787). Between looks at shares s < t of the data a mean correlates by √(s / t), and
the sum of many squares, such as an F statistic with many degrees of freedom, by s / t. The smaller
one is used: by Slepian's inequality the error rate then holds for both.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy

from remaster_ros.types import FloatArray

LOWEST = -8.0
"""Lower end of the statistic's grid, in standard deviations; its probability is negligible."""
POINTS = 401
"""Points of the grid for the density of the tests that no look has stopped."""
NEGLIGIBLE = 1e-14
"""Share of the error rate below which a look is not computed on the grid."""


def spent(share: FloatArray, error_rate: float) -> FloatArray:
    """Part of the error rate that may be spent after shares (n,) of all data, (n,).

    2 - 2 Φ(z / √share), z being the upper quantile at half of the error rate; shares are above 0
    and at most 1, where all of it is spent.
    """
    z = scipy.special.ndtri(0.5 * error_rate)
    found: FloatArray = 2.0 * scipy.special.ndtr(z / np.sqrt(share))
    return found


@lru_cache(maxsize=64)
def p_value_limits(shares: tuple[float, ...], error_rate: float) -> tuple[float, ...]:
    """P-value limit of each look, below which the test fires.

    Parameters
    ----------
    shares
        Shares of all data at each look, ascending, above 0 to 1.
    error_rate
        Error rate of all looks together.
    """
    t = np.array(shares)
    steps = np.diff(spent(t, error_rate), prepend=0.0)
    # The statistic times t is a sum of independent steps, of variance t² - s².
    spread = np.sqrt(np.diff(t**2, prepend=0.0))
    grid, density = np.zeros(1), np.ones(1)
    limits = []
    for place, step, width in zip(t, steps, spread, strict=True):
        limit = -scipy.special.ndtri(step)
        if step > NEGLIGIBLE:
            limit = scipy.optimize.brentq(
                _above, 0.0, -LOWEST, (grid, density, place, width, step)
            )
        limits.append(float(scipy.special.ndtr(-limit)))
        edges = np.linspace(LOWEST * place, place * min(limit, -LOWEST), POINTS)
        # Trapezoids: half weights at both ends.
        weight = np.full(POINTS, edges[1] - edges[0])
        weight[[0, -1]] *= 0.5
        deviation = (edges[:, None] - grid) / width
        density = weight * (np.exp(-0.5 * deviation**2) @ density) / (np.sqrt(2.0 * np.pi) * width)
        grid = edges
    return tuple(limits)


def _above(
    limit: float, grid: FloatArray, density: FloatArray, place: float, width: float, step: float
) -> float:
    """Probability that the first alarm comes at this look, less ``step``, the error rate for it.

    ``limit``: of the test statistic, above which it alarms; ``grid, density``: values of the
    statistic times the share of data at the look before, and their probabilities without
    earlier alarms; ``place``: share of all data at this look; ``width``: standard deviation of
    the change of (statistic times share) since the look before.
    """
    return float(density @ scipy.special.ndtr((grid - limit * place) / width)) - step
