# SPDX-License-Identifier: Apache-2.0
"""Convergence of chains, and their number of independent draws.

Rank-normalised split R-hat and effective sample sizes of Vehtari, Gelman, Simpson, Carpenter and
Bürkner (2021), "Rank-normalization, folding, and localization", Bayesian Analysis 16(2),
doi:10.1214/20-BA1221. ``draws`` always has the shape (chains, draws, ...); each further index is a
separate quantity. The diagnostics of a constant quantity are NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from msgspec import Struct

from remaster_ros.calibration.metropolis import Chains, Method
from remaster_ros.errors import InsufficientDataError
from remaster_ros.types import FloatArray

MINIMUM_DRAWS = 8
R_HAT_LIMIT = 1.01
# Effective draws enough for two digits of a 95 % interval.
ESS_LIMIT = 400.0
# The quantiles by which the tails are judged.
TAILS = (0.05, 0.95)


def r_hat(draws: FloatArray) -> FloatArray:
    """Rank-normalised split R-hat, (...): the larger one of bulk and tails.

    ``draws``: (chains, draws, ...). Near 1 if the chains agree; 1.01 is the usual limit. Raises
    InsufficientDataError with fewer than 8 draws in a chain.
    """

    def of(flat: FloatArray) -> FloatArray:
        halves = _halves(flat)
        folded = np.abs(halves - np.median(halves, axis=(0, 1)))
        return np.maximum(*(_split_r_hat(_normal_scores(x)) for x in (halves, folded)))

    return _figures(of, draws)


def ess_bulk(draws: FloatArray) -> FloatArray:
    """Effective number of independent draws for the centre of the distribution, (...).

    ``draws``: (chains, draws, ...); normal scores of all chains' ranks, NaN for a constant
    quantity. Raises InsufficientDataError with fewer than 8 draws in a chain.
    """
    return _figures(lambda flat: _effective(_normal_scores(_halves(flat))), draws)


def ess_tail(draws: FloatArray) -> FloatArray:
    """Effective number of draws in the tails, (...): the smaller of the 5 % and 95 % quantiles.

    ``draws``: (chains, draws, ...); NaN for a constant quantity. Raises InsufficientDataError with
    fewer than 8 draws in a chain.
    """

    def of(flat: FloatArray) -> FloatArray:
        quantiles = np.quantile(flat, TAILS, axis=(0, 1))
        return np.minimum(*(_effective(_halves((flat <= at).astype(float))) for at in quantiles))

    return _figures(of, draws)


def _figures(of: Callable[[FloatArray], FloatArray], draws: FloatArray) -> FloatArray:
    """Apply a diagnostic to each quantity of draws (chains, draws, ...), (...).

    ``of``: the diagnostic, from draws (chains, draws, quantities) to (quantities,). NaN for a
    constant quantity. Raises InsufficientDataError with fewer than 8 draws in a chain.
    """
    length = draws.shape[1]
    if length < MINIMUM_DRAWS:
        raise InsufficientDataError(
            f'chains of {length} draws are too short to judge convergence; '
            f'draw at least {MINIMUM_DRAWS}'
        )
    flat = draws.reshape(*draws.shape[:2], -1)
    figures = np.full(flat.shape[2], np.nan)
    moves = np.ptp(flat, axis=(0, 1)) > 0.0
    if moves.any():
        # Chains that stay each in a place of its own have an R-hat of infinity.
        with np.errstate(invalid='ignore', divide='ignore'):
            figures[moves] = of(flat[..., moves])
    return figures.reshape(draws.shape[2:])


def _halves(draws: FloatArray) -> FloatArray:
    """First and last halves of chains (c, n, p) as separate chains, (2 c, n // 2, p).

    The middle draw of an odd number is in neither half.
    """
    half = draws.shape[1] // 2
    return np.concatenate((draws[:, :half], draws[:, -half:]))


def _normal_scores(draws: FloatArray) -> FloatArray:
    """Normal quantiles of each parameter's ranks over all chains (eq. 14), shape as ``draws``.

    ``draws``: (chains, draws, parameters); equal draws share their mean rank.
    """
    columns = draws.reshape(-1, draws.shape[2]).T
    rank = np.empty_like(columns)
    for of_one, column in zip(rank, columns, strict=True):
        _, which, count = np.unique(column, return_inverse=True, return_counts=True)
        of_one[:] = (np.cumsum(count) - 0.5 * (count - 1))[which]
    scores: FloatArray = scipy.special.ndtri((rank - 0.375) / (rank.shape[1] + 0.25))
    return scores.T.reshape(draws.shape)


def _split_r_hat(draws: FloatArray) -> FloatArray:
    """R-hat (eq. 1 to 4 of Vehtari et al. 2021) of chains (c, n, p), (p,); NaN if constant.

    `_halves` has split the chains before.
    """
    n = draws.shape[1]
    within = np.var(draws, axis=1, ddof=1).mean(axis=0)
    between = np.var(draws.mean(axis=1), axis=0, ddof=1)
    ratio: FloatArray = np.sqrt(between / within + (n - 1.0) / n)
    return ratio


def _effective(draws: FloatArray) -> FloatArray:
    """Effective sample size (eq. 10 to 13) of chains (c, n, p), (p,).

    Autocorrelations are added in pairs of lags while these are positive, none larger than the pair
    before (Geyer 1992, doi:10.1214/ss/1177011137).
    """
    c, n, p = draws.shape
    centred = draws - draws.mean(axis=1, keepdims=True)
    # Padded, so that the end of a chain is not correlated with its beginning.
    size = scipy.fft.next_fast_len(2 * n, real=True)
    spectrum = np.abs(scipy.fft.rfft(centred, size, axis=1)) ** 2
    covariance = scipy.fft.irfft(spectrum.mean(axis=0), size, axis=0)[:n] / n
    within = covariance[0] * n / (n - 1.0)
    total = covariance[0] + np.var(draws.mean(axis=1), axis=0, ddof=1)
    moves = total > 0.0
    correlation = 1.0 - (within - covariance) / np.where(moves, total, 1.0)
    correlation[0] = 1.0
    last = (n - 3) // 2
    even, odd = correlation[: 2 * last + 1 : 2], correlation[1 : 2 * last + 2 : 2]
    pairs = even + odd
    # The first pair that is not positive; of it the even one counts once.
    end = np.where(np.all(pairs > 0.0, axis=0), last, np.argmax(pairs <= 0.0, axis=0))
    before = np.arange(last + 1)[:, None] < end
    time = -1.0 + 2.0 * np.sum(np.minimum.accumulate(pairs) * before, axis=0)
    time += np.maximum(even[end, np.arange(p)], 0.0)
    time = np.maximum(time, 1.0 / np.log10(c * n))
    return np.where(moves, c * n / time, float(c * n))


class Diagnostics(NamedTuple):
    """R-hat, and effective draws of bulk and tails, of p parameters; no R-hat without chains.

    Arrays (p,); R-hat is NaN for draws of the Gaussian about the mode, which are no chains.
    """

    r_hat: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray

    @classmethod
    def of(cls, run: Chains) -> Diagnostics:
        """R-hat and effective numbers of draws of a sampler's parameters, (p,) each.

        Those of ``run.figures`` if it has them, else computed. For draws of the Gaussian about
        the mode R-hat is NaN and both effective numbers are ``run.effective``.
        """
        if run.method == 'metropolis':
            draws = run.draws
            return cls(*(run.figures or (r_hat(draws), ess_bulk(draws), ess_tail(draws))))
        p = run.draws.shape[2]
        return cls(np.full(p, np.nan), *np.full((2, p), run.effective))


class SamplerInfo(Struct, frozen=True):
    """Method of sampling, and how far its draws are to be trusted, as fit.json has it."""

    name: str  # Name of the sampler, for the report
    # Number of chains, and of draws kept in each
    chains: int
    draws: int
    # Largest R-hat, and least effective sample size, over all parameters; None: not known
    r_hat_max: float | None
    ess_min: float | None
    seconds: float | None  # Time by the clock passed in; None without one
    # What has a default is missing in files of others. Share of accepted proposals
    acceptance_rate: float | None = None
    # Whether each R-hat is at most 1.01 and each effective sample size at least that of the
    # requested precision (400 without one). True for a Gaussian about the mode if there are too
    # many parameters to sample; false if chains were given up
    converged: bool = False
    message: str = ''  # Verdict with its figures, for the appendix of the report
    # Largest Monte Carlo error of a mean over its parameter's standard deviation, reached and
    # requested; None if a number of draws was requested instead
    precision: float | None = None
    precision_wanted: float | None = None
    method: Method = 'metropolis'  # 'laplace' has no R-hat
    # If chains were given up: tail shape of the proposals' importance weights; None otherwise
    pareto_k: float | None = None

    @property
    def wandering(self) -> bool:
        """Whether Metropolis chains have R-hat above 1.01 or fewer than 400 effective draws.

        False for the Gaussian about the mode ('laplace'), which has no chains.
        """
        if self.method != 'metropolis':
            return False
        few = self.ess_min is not None and self.ess_min < ESS_LIMIT
        return few or (self.r_hat_max is not None and self.r_hat_max > R_HAT_LIMIT)

    @classmethod
    def of(
        cls,
        run: Chains,
        diagnostics: Diagnostics,
        names: Sequence[str],
        *,
        name: str,
        wanted: float | None,
        seconds: float | None,
        weakest: str = '',
    ) -> SamplerInfo:
        """Convergence of the draws of p named parameters, with a sentence for the report.

        Converged: the least effective number of draws is at least 1 / ``wanted``², or 400 if
        ``wanted`` is None, and every R-hat at most 1.01, or, for a Gaussian about the mode, no
        chains were given up. ``names``: of the parameters, p; ``name``: of the sampler;
        ``seconds``: computing time, None if unknown; ``weakest``: parameters that the
        observations determine worst together, which the sentence names for a Gaussian about the
        mode.
        """
        needed = ESS_LIMIT if wanted is None else wanted**-2
        least = float(np.min(diagnostics[1:]))
        chains, draws = run.draws.shape[:2]
        if run.method == 'metropolis':
            worst = float(np.max(diagnostics.r_hat))
            sound = worst <= R_HAT_LIMIT
            agreement = f'R-hat up to {worst:.3f} ({names[int(np.argmax(diagnostics.r_hat))]})'
        else:
            worst, sound = np.nan, bool(np.isnan(run.pareto_k))
            agreement = (
                f'a Gaussian about the mode of {len(names)} parameters, which nothing has checked'
            )
            if not sound:
                agreement += (
                    f' (no chain came to its end; Pareto k of the proposals {run.pareto_k:.2f})'
                )
        converged = sound and least >= needed
        precision = float(1.0 / np.sqrt(least))
        message = 'converged' if converged else 'NOT converged'
        if not converged and wanted is not None and run.method == 'metropolis':
            message += f' within {draws} draws a chain'
        message += (
            f': {agreement}, at least {least:.0f} effective draws, every mean within '
            f'{100 * precision:.1f} % of its standard deviation'
        )
        if wanted is not None:
            message += f' ({100 * wanted:g} % wanted)'
        if run.method != 'metropolis' and weakest:
            message += f'; the observations hardly determine {weakest}'
        return cls(
            name,
            chains,
            draws,
            _known(worst),
            _known(least),
            seconds,
            run.acceptance_rate,
            converged,
            message,
            precision,
            wanted,
            run.method,
            _known(run.pareto_k),
        )


def _known(figure: float) -> float | None:
    """The number itself; None for NaN."""
    return None if np.isnan(figure) else figure
