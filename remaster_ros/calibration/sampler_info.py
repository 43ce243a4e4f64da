"""Whether draws can be believed: convergence, effective draws, the verdict in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration import convergence
from remaster_ros.calibration.sampling import R_HAT_LIMIT
from remaster_ros.types import FloatArray

# Effective draws enough for two digits of a 95 % interval.
ESS_LIMIT = 400.0


@dataclass(frozen=True, eq=False)
class SamplerInfo:
    """How the draws were made and whether they can be believed.

    Attributes
    ----------
    name
        Which sampler, in words.
    chains, draws
        Number of chains, and of draws kept of each.
    acceptance_rate
        Share of proposals taken.
    r_hat, ess_bulk, ess_tail
        Per parameter of `FitResult.parameter_names`, (p,).
    precision, precision_wanted
        Largest Monte Carlo error of a mean over its parameter's standard deviation, reached and
        asked for; None where a number of draws was asked for instead.
    log_density_error, checked
        Largest difference of the density that was sampled from the exact one, on so many of the
        draws; NaN and 0 where the exact one was sampled.
    seconds
        By the clock passed in; NaN without one.
    converged
        Every R-hat at most 1.01 and every effective sample size at least what the precision
        takes, 400 where none was asked for.
    message
        The verdict in words.
    """

    name: str
    chains: int
    draws: int
    acceptance_rate: float
    r_hat: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray
    precision: float
    precision_wanted: float | None
    log_density_error: float
    checked: int
    seconds: float
    converged: bool
    message: str

    @classmethod
    def of(
        cls,
        draws: FloatArray,
        names: Sequence[str],
        *,
        name: str,
        acceptance_rate: float,
        wanted: float | None,
        log_density_error: float,
        checked: int,
        seconds: float,
    ) -> SamplerInfo:
        """Judge draws (chains, draws, p) of p named parameters; the rest as the attributes."""
        r_hat = convergence.r_hat(draws)
        bulk, tail = convergence.ess_bulk(draws), convergence.ess_tail(draws)
        worst, least = float(np.max(r_hat)), float(np.min(np.minimum(bulk, tail)))
        enough = ESS_LIMIT if wanted is None else wanted**-2
        converged = worst <= R_HAT_LIMIT and least >= enough
        precision = 1.0 / np.sqrt(least)
        figures = (
            f'R-hat up to {worst:.3f} ({names[int(np.argmax(r_hat))]}), '
            f'at least {least:.0f} effective draws, every mean within {100 * precision:.1f} % of '
            'its standard deviation'
        )
        if wanted is not None:
            figures += f' ({100 * wanted:g} % wanted)'
        verdict = 'converged' if converged else 'NOT converged'
        if not converged and wanted is not None:
            verdict += f' within {draws.shape[1]} draws a chain'
        return cls(
            name=name,
            chains=draws.shape[0],
            draws=draws.shape[1],
            acceptance_rate=acceptance_rate,
            r_hat=r_hat,
            ess_bulk=bulk,
            ess_tail=tail,
            precision=float(precision),
            precision_wanted=wanted,
            log_density_error=log_density_error,
            checked=checked,
            seconds=seconds,
            converged=converged,
            message=f'{verdict}: {figures}',
        )
