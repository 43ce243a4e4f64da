"""Have the chains mixed, and how many independent draws are they worth? Arrays in, numbers out.

Rank-normalised split R-hat and effective sample sizes as defined by Vehtari, Gelman, Simpson,
Carpenter and Bürkner (2021), "Rank-normalization, folding, and localization", Bayesian Analysis
16(2), doi:10.1214/20-BA1221; the autocorrelation is cut by the initial monotone sequence of
Geyer (1992). ``draws`` has the shape (chains, draws, ...) everywhere; every further index is a
quantity of its own. A quantity that never moves has nothing to judge: its figures are NaN.
"""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from remaster_ros.errors import InsufficientDataError
from remaster_ros.types import FloatArray, IntArray

MINIMUM_DRAWS = 8


def r_hat(draws: FloatArray) -> FloatArray:
    """Return the rank-normalised split R-hat: the larger of the one of the bulk and of the tails.

    Parameters
    ----------
    draws
        Chains of draws, (chains, draws, ...).

    Returns
    -------
    ndarray
        (...); near 1 when the chains agree, 1.01 is the usual limit.

    Raises
    ------
    InsufficientDataError
        With fewer than 8 draws in a chain.
    """
    halves = _split(draws)
    folded = np.abs(halves - np.median(halves, axis=(0, 1)))
    return np.maximum(
        _split_r_hat(_rank_normalised(halves)), _split_r_hat(_rank_normalised(folded))
    )


def ess_bulk(draws: FloatArray) -> FloatArray:
    """Return the effective sample size of the centre of the distribution, (...); see `r_hat`."""
    return _effective_sample_size(_rank_normalised(_split(draws)))


def ess_tail(draws: FloatArray) -> FloatArray:
    """Return the effective sample size of the tails, (...): the smaller of the 5 % and 95 %."""
    halves = _split(draws)
    quantiles = np.quantile(np.asarray(draws, dtype=float), (0.05, 0.95), axis=(0, 1))
    sizes = [_effective_sample_size((halves <= limit).astype(float)) for limit in quantiles]
    return np.minimum(*sizes)


def _split(draws: FloatArray) -> FloatArray:
    """Cut every chain into its first and its last half, (2 chains, draws // 2, ...)."""
    draws = np.asarray(draws, dtype=float)
    length = draws.shape[1]
    if length < MINIMUM_DRAWS:
        raise InsufficientDataError(
            f'chains of {length} draws are too short to judge convergence; '
            f'draw at least {MINIMUM_DRAWS}'
        )
    half = length // 2
    return np.concatenate((draws[:, :half], draws[:, -half:]))


def _rank_normalised(draws: FloatArray) -> FloatArray:
    """Replace values by the normal scores of their ranks over all chains."""
    pooled = draws.reshape(draws.shape[0] * draws.shape[1], -1)
    count = len(pooled)
    # Ranks are multiples of one half: a table holds the normal quantile of each. Blom's offsets
    # (1958), as in eq. 14 of Vehtari et al.
    quantile = NormalDist().inv_cdf
    scores = np.array(
        [quantile((half / 2.0 - 0.375) / (count + 0.25)) for half in range(2, 2 * count + 1)]
    )
    columns = [scores[_double_ranks(column) - 2] for column in pooled.T]
    return np.stack(columns, axis=1).reshape(draws.shape)


def _double_ranks(values: FloatArray) -> IntArray:
    """Return twice the ranks of values (n,), equal ones sharing the mean of theirs."""
    order = np.argsort(values, kind='stable')
    ordered = values[order]
    start = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))
    size = np.diff(np.append(start, len(values)))
    ranks = np.empty(len(values), dtype=np.int64)
    ranks[order] = np.repeat(2 * start + size + 1, size)
    return ranks


def _split_r_hat(draws: FloatArray) -> FloatArray:
    """Root of pooled over within-chain variance (eq. 1 to 4 of Vehtari et al.)."""
    length = draws.shape[1]
    within = draws.var(axis=1, ddof=1).mean(axis=0)
    between = draws.mean(axis=1).var(axis=0, ddof=1)
    with np.errstate(invalid='ignore', divide='ignore'):
        return np.sqrt((length - 1) / length + between / within)


def _effective_sample_size(draws: FloatArray) -> FloatArray:
    """Return the number of draws over the integrated autocorrelation time (eq. 10 to 13)."""
    chains, length = draws.shape[:2]
    covariance = _autocovariance(draws).mean(axis=0)
    within = covariance[0] * length / (length - 1.0)
    pooled = covariance[0] + draws.mean(axis=1).var(axis=0, ddof=1)
    with np.errstate(invalid='ignore', divide='ignore'):
        correlation = 1.0 - (within - covariance) / pooled
    correlation[0] = 1.0
    # Sums of neighbours are positive and fall with the lag in any reversible chain: from where
    # they do not, there is only noise. The last lags are averages of a handful of products.
    count = (length - 2) // 2
    pairs = correlation[0 : 2 * count : 2] + correlation[1 : 2 * count : 2]
    kept = np.cumprod(pairs > 0.0, axis=0).astype(bool)
    pairs = np.minimum.accumulate(np.where(kept, pairs, 0.0), axis=0)
    # The first even lag after the cut still counts where it is positive: it lowers the variance
    # of the estimate for chains that alternate.
    cut = kept.sum(axis=0)
    following = np.take_along_axis(correlation, 2 * cut[None], axis=0)[0]
    time = -1.0 + 2.0 * pairs.sum(axis=0) + np.maximum(following, 0.0)
    total = chains * length
    # Alternating chains may beat independent draws, but not without bound.
    size = total / np.maximum(time, 1.0 / np.log10(total))
    return np.where(np.isfinite(pooled) & (pooled > 0.0), size, np.nan)


def _autocovariance(draws: FloatArray) -> FloatArray:
    """Return the autocovariance of every chain at every lag, (chains, draws, ...)."""
    length = draws.shape[1]
    size = 2 ** int(np.ceil(np.log2(2 * length)))
    spectrum = np.fft.rfft(draws - draws.mean(axis=1, keepdims=True), size, axis=1)
    return np.fft.irfft(np.abs(spectrum) ** 2, size, axis=1)[:, :length] / length
