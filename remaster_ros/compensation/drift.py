# SPDX-License-Identifier: Apache-2.0
"""Drifts in a series of checks: since when, how fast, and when they matter.

Results x₁ … x_T at times t are a constant and noise, until from a check s on they are a line of
unknown slope: μ + β max(0, t − t_s). Mean and noise are integrated out under their invariant
priors as for a step (`checking`), the slope under normal priors of several widths, in standard
deviations of a result a day, and s under a prior: the mean of the odds is an e-process again, of
expected value at most 1 as long as nothing changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from remaster_ros.types import FloatArray

RATES = (0.01, 0.03, 0.1, 0.3, 1.0)
"""Widths of the priors of a slope, in standard deviations of a result a day; equally likely."""
FROM_THE_FIRST = 0.5
"""Prior that a drift has been there since the first check; the rest is for a later onset."""
BATCHES = 6
"""Number of batches from which the wander about a drift is estimated; two numbers are fitted."""
LONGEST_DAYS = 30.0
"""Longest time to the next check of a drift, days."""


@dataclass(frozen=True)
class Drift:
    """Drift in a series of T results, constant up to one of them and then a line."""

    evidence: float  # Value of the e-process over all drifts
    at: int  # Index of the first check of the likeliest line
    # Change from there to the newest check, and half of its 95 % interval, infinite if there are
    # too few results
    size: float
    half: float
    days: float  # Duration of the change, days
    weights: FloatArray  # The size is the sum of weights times results, (T,)

    def days_left(self, smallest: float) -> float:
        """Days until the drift reaches the size ``smallest``, m, if it goes on; at least 0.

        Its slope is taken as large as the 95 % interval allows.
        """
        slope = (abs(self.size) + self.half) / self.days
        return max(0.0, (smallest - abs(self.size)) / slope)


def drift(x: FloatArray, days: FloatArray) -> Drift:
    """Likeliest drift in a series (T,) at ascending times ``days`` (T,), and the evidence for any.

    Without three results, or at a single time: evidence 1, size 0. The half interval is
    infinite for three results or fewer.
    """
    T = len(x)
    none = Drift(1.0, 0, 0.0, np.inf, 0.0, np.zeros(T))
    if T < 3 or days[-1] <= days[0]:
        return none
    onsets = np.arange(T - 1)
    lines = np.maximum(0.0, days[None, :] - days[onsets, None])
    lines = lines - lines.mean(axis=1, keepdims=True)
    squares_of_line = np.sum(lines**2, axis=1)
    # Of checks at one and the same time a line has none.
    is_any = squares_of_line > 1e-12 * squares_of_line.max()
    squares_of_line = np.where(is_any, squares_of_line, 1.0)
    deviations = x - x.mean()
    squares = float(deviations @ deviations)
    slope = np.where(is_any, lines @ deviations / squares_of_line, 0.0)
    share = np.zeros(T - 1) if squares <= 0.0 else slope**2 * squares_of_line / squares
    share = np.minimum(share, 1.0)
    odds = np.zeros(T - 1)
    for rate in RATES:
        # Variance of the slope over that with its prior.
        kept = 1.0 / (1.0 + rate**2 * squares_of_line)
        residual_share = np.maximum(1.0 - share * (1.0 - kept), 1e-300)
        odds += np.sqrt(kept) * residual_share ** (-0.5 * (T - 1.0)) / len(RATES)
    odds = np.where(is_any, odds, 1.0)
    prior = np.full(T - 1, FROM_THE_FIRST)
    later = onsets[1:].astype(float)
    prior[1:] = (1.0 - FROM_THE_FIRST) / (later * (later + 1.0))
    # What is left of the prior is for an onset that is still to come.
    evidence = float(prior @ odds + (1.0 - FROM_THE_FIRST) / (T - 1.0))
    at = int(np.argmax(np.where(is_any, prior * odds, 0.0)))
    span = float(days[-1] - days[at])
    weights = lines[at] / squares_of_line[at] * span
    size = float(weights @ x)
    half = np.inf
    if T > 3:
        residuals = deviations - slope[at] * lines[at]
        variance = float(residuals @ residuals) / (T - 2.0)
        std = float(np.sqrt(variance * float(weights @ weights)))
        half = max(float(stdtrit(T - 2.0, 0.975)) * std, _interval_of_batches(residuals, weights))
    return Drift(evidence, at, size, half, span, weights)


def _interval_of_batches(residuals: FloatArray, weights: FloatArray) -> float:
    """Half of the 95 % interval of a drift's size, m, with autocorrelated residuals (T,).

    Batch means: residuals are averaged in batches of consecutive results, so that slow changes
    widen the interval. ``weights``: (T,), factors with which the results are summed to the
    size. 0 for fewer than six results.
    """
    T = len(residuals)
    size = T // BATCHES
    count = T // size if size else 0
    if count < BATCHES:
        return 0.0
    means = residuals[T - count * size :].reshape(count, size).mean(axis=1)
    variance = float(means @ means) / (count - 2.0) * size
    return float(stdtrit(count - 2.0, 0.975)) * float(np.sqrt(variance * (weights @ weights)))
