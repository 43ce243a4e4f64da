"""Draws from the exact posterior of a fit, by the cheapest sampler that works on it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .laplace import LaplaceProposal, Mode
from .metropolis import Chains, Proposal, StudentT, independence_sampler, random_walk_sampler
from .types import FloatArray

Progress = Callable[[str, float], None]

WARM_UP = 100
# Below this share of proposals taken the proposal is adapted; three times, then a random walk.
POOR_ACCEPTANCE = 0.3
ADAPTATIONS = 3
WALK_STEPS_PER_DRAW = 20


def silent(stage: str, share: float) -> None:
    """Report nothing."""


def sample_posterior(
    mode: Mode,
    *,
    chains: int,
    draws: int,
    rng: np.random.Generator,
    report: Progress = silent,
) -> tuple[Chains, str]:
    """Sample the exact posterior about its mode.

    Independent proposals from the linearised posterior; where too few are taken, from a Student t
    adapted to the draws so far; at last a random walk.

    Returns
    -------
    chains
        Points as `Posterior` defines them.
    name
        What was done, in words.
    """
    posterior = mode.linearisation.posterior
    laplace = LaplaceProposal(mode)
    start = laplace.dispersed(chains, rng)
    proposal: Proposal = laplace
    name = 'independence Metropolis-Hastings, Laplace proposal'
    for attempt in range(ADAPTATIONS + 1):
        run = independence_sampler(
            posterior.log_density,
            proposal,
            chains=chains,
            draws=draws,
            warm_up=WARM_UP,
            rng=rng,
            start=start,
            progress=lambda share: report('sampling', share),
        )
        if run.acceptance_rate >= POOR_ACCEPTANCE:
            return run, name
        pooled = run.draws.reshape(-1, posterior.size)
        covariance: FloatArray = np.cov(pooled.T) + 1e-4 * np.diag(
            np.diag(_point_covariance(mode))
        )
        factor = np.asarray(1.1 * np.linalg.cholesky(covariance))
        proposal = StudentT(pooled.mean(axis=0), factor, 5.0)
        name = (
            'independence Metropolis-Hastings, Student t proposal adapted '
            f'{attempt + 1} time{"s" if attempt else ""} (the Laplace one was taken too rarely)'
        )
    d = posterior.size
    walk = random_walk_sampler(
        posterior.log_density,
        # 2.38 / sqrt(d): the best step for Gaussian targets (Gelman, Roberts and Gilks 1996).
        lambda source: (2.38 / np.sqrt(d)) * source.standard_normal((chains, d)) @ factor.T,
        start=run.draws[:, -1],
        steps=(draws + WARM_UP) * WALK_STEPS_PER_DRAW,
        burn_in=WARM_UP * WALK_STEPS_PER_DRAW,
        rng=rng,
        thin=WALK_STEPS_PER_DRAW,
        trace_every=WALK_STEPS_PER_DRAW,
        progress=lambda share: report('sampling by random walk', share),
    )
    return walk, 'random-walk Metropolis (independent proposals were taken too rarely)'


def _point_covariance(mode: Mode) -> FloatArray:
    """Return the covariance of parameters and noise coordinates at the mode, (d, d)."""
    f, e = len(mode.linearisation.posterior.free), len(mode.eta)
    covariance = np.zeros((f + e, f + e))
    covariance[:f, :f] = mode.covariance
    covariance[f:, f:] = mode.eta_covariance
    return covariance
