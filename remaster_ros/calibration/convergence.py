"""Have the chains mixed, and how many independent draws are they worth?

Rank-normalised split R-hat and effective sample sizes of Vehtari, Gelman, Simpson, Carpenter and
Bürkner (2021), "Rank-normalization, folding, and localization", Bayesian Analysis 16(2),
doi:10.1214/20-BA1221, as arviz-stats computes them. ``draws`` has the shape (chains, draws, ...)
everywhere; every further index is a quantity of its own. The figures of a quantity
that never moves are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from remaster_ros.calibration.metropolis import Chains, Method
from remaster_ros.errors import InsufficientDataError
from remaster_ros.types import FloatArray

MINIMUM_DRAWS = 8
R_HAT_LIMIT = 1.01
# Effective draws enough for two digits of a 95 % interval.
ESS_LIMIT = 400.0


def r_hat(draws: FloatArray) -> FloatArray:
    """Return the rank-normalised split R-hat: the larger of the one of the bulk and of the tails.

    ``draws``: chains of draws, (chains, draws, ...).
    Returns (...); near 1 when the chains agree, 1.01 is the usual limit.
    Raises InsufficientDataError: with fewer than 8 draws in a chain.
    """
    return _figures('rhat', draws)


def ess_bulk(draws: FloatArray) -> FloatArray:
    """Return the effective sample size of the centre of the distribution, (...); see `r_hat`."""
    return _figures('ess', draws, method='bulk')


def ess_tail(draws: FloatArray) -> FloatArray:
    """Return the effective sample size of the tails, (...): the smaller of the 5 % and 95 %."""
    return _figures('ess', draws, method='tail', prob=0.05)


def _figures(statistic: str, draws: FloatArray, **options: Any) -> FloatArray:
    """Return a statistic of arviz-stats for every quantity, (...)."""
    # It brings SciPy, which takes half a second: imported only where something was sampled.
    from arviz_stats.base import array_stats

    length = draws.shape[1]
    if length < MINIMUM_DRAWS:
        raise InsufficientDataError(
            f'chains of {length} draws are too short to judge convergence; '
            f'draw at least {MINIMUM_DRAWS}'
        )
    with np.errstate(invalid='ignore', divide='ignore'):
        figures = getattr(array_stats, statistic)(draws, chain_axis=0, draw_axis=1, **options)
    return np.where(np.ptp(draws, axis=(0, 1)) > 0.0, figures, np.nan)


@dataclass(frozen=True, eq=False)
class SamplerInfo:
    """How the draws were made and whether they are reliable."""

    name: str  # Which sampler it was, for the report
    # Number of chains, and of draws kept of each
    chains: int
    draws: int
    acceptance_rate: float  # Share of proposals taken
    # Per parameter of `FitResult.parameter_names`, (p,)
    r_hat: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray
    # Largest Monte Carlo error of a mean over its parameter's standard deviation, reached and
    # asked for; None where a number of draws was asked for instead
    precision: float
    precision_wanted: float | None
    seconds: float  # By the clock passed in; NaN without one
    # Every R-hat at most 1.01 and every effective sample size at least what the precision takes,
    # 400 where none was asked for. A Gaussian about the mode counts where the parameters are too
    # many to be sampled; not where chains were given up.
    converged: bool
    message: str  # The verdict with its figures, for the report
    # 'metropolis' or 'laplace', as `Chains` has it. The latter has no R-hat.
    method: Method = 'metropolis'
    # Where chains were given up: the shape of the tail of the proposals' importance weights. Else
    # NaN.
    pareto_k: float = float('nan')

    @property
    def wandering(self) -> bool:
        """Whether these are chains that do not agree, or are worth too few draws to tell."""
        if self.method != 'metropolis':
            return False
        few = np.min((self.ess_bulk, self.ess_tail)) < ESS_LIMIT
        return bool(few or np.max(self.r_hat) > R_HAT_LIMIT)

    @classmethod
    def of(
        cls,
        run: Chains,
        names: Sequence[str],
        *,
        name: str,
        wanted: float | None,
        seconds: float,
        weakest: str = '',
    ) -> SamplerInfo:
        """Judge the draws of p named parameters; the rest as the attributes.

        ``weakest`` names the parameters that the observations determine worst together.
        """
        draws = run.draws
        needed = ESS_LIMIT if wanted is None else wanted**-2
        if run.method == 'metropolis':
            figures = run.figures or (r_hat(draws), ess_bulk(draws), ess_tail(draws))
            worst, least = float(np.max(figures[0])), float(np.min(figures[1:]))
            sound = worst <= R_HAT_LIMIT
            agreement = f'R-hat up to {worst:.3f} ({names[int(np.argmax(figures[0]))]})'
        else:
            least = run.effective
            figures = (np.full(len(names), np.nan), *np.full((2, len(names)), least))
            sound = bool(np.isnan(run.pareto_k))
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
            message += f' within {draws.shape[1]} draws a chain'
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
            draws.shape[0],
            draws.shape[1],
            run.acceptance_rate,
            *figures,
            precision,
            wanted,
            seconds,
            converged,
            message,
            run.method,
            run.pareto_k,
        )
