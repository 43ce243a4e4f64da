"""Draws from the exact posterior of a fit, by the cheapest sampler that works on it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from remaster_ros.core.laplace import LaplaceProposal, Mode
from remaster_ros.core.metropolis import (
    Chains,
    Proposal,
    StudentT,
    independence_sampler,
    random_walk_sampler,
)
from remaster_ros.core.types import FloatArray

Progress = Callable[[str, float], None]

WARM_UP = 100
# Below this share of proposals taken the proposal is adapted to a random walk's draws; should
# that not help, a random walk is what remains.
POOR_ACCEPTANCE = 0.15
# In tens of dimensions a Student t of few degrees of freedom hardly ever hits the bulk.
ADAPTED_FREEDOM = 15.0
PILOT_CHAINS = 32
PILOT_STEPS = 1000
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
    adapted to a pilot run; at last a random walk.

    Returns
    -------
    chains
        Points as `Posterior` defines them.
    name
        What was done, in words.
    """
    log_density = mode.linearisation.posterior.log_density
    laplace = LaplaceProposal(mode)

    def independent(proposal: Proposal, start: FloatArray) -> Chains:
        return independence_sampler(
            log_density,
            proposal,
            chains=chains,
            draws=draws,
            warm_up=WARM_UP,
            rng=rng,
            start=start,
            progress=lambda share: report('sampling', share),
        )

    run = independent(laplace, laplace.dispersed(chains, rng))
    if run.acceptance_rate >= POOR_ACCEPTANCE:
        return run, 'independence Metropolis-Hastings, Laplace proposal'

    factor: FloatArray = np.asarray(np.linalg.cholesky(_point_covariance(mode)))
    pilot = random_walk_sampler(
        log_density,
        _gaussian_step(factor, PILOT_CHAINS),
        start=laplace.dispersed(PILOT_CHAINS, rng),
        steps=PILOT_STEPS,
        burn_in=PILOT_STEPS // 2,
        rng=rng,
        thin=10,
        progress=lambda share: report('adapting the sampler', share),
    ).draws
    pooled = pilot.reshape(-1, pilot.shape[-1])
    factor = np.asarray(np.linalg.cholesky(np.cov(pooled.T)))
    adapted = StudentT(pooled.mean(axis=0), factor, ADAPTED_FREEDOM)
    start = pilot[rng.choice(PILOT_CHAINS, chains, replace=chains > PILOT_CHAINS), -1]
    run = independent(adapted, start)
    if run.acceptance_rate >= POOR_ACCEPTANCE:
        return run, (
            'independence Metropolis-Hastings, Student t proposal adapted to a random walk '
            '(too few of the Laplace proposals were taken)'
        )
    walk = random_walk_sampler(
        log_density,
        _gaussian_step(factor, chains),
        start=start,
        steps=(draws + WARM_UP) * WALK_STEPS_PER_DRAW,
        burn_in=WARM_UP * WALK_STEPS_PER_DRAW,
        rng=rng,
        thin=WALK_STEPS_PER_DRAW,
        trace_every=WALK_STEPS_PER_DRAW,
        progress=lambda share: report('sampling by random walk', share),
    )
    return walk, 'random-walk Metropolis (too few independent proposals were taken)'


def _gaussian_step(factor: FloatArray, chains: int) -> Callable[[np.random.Generator], FloatArray]:
    """Return moves of 2.38 / sqrt(d) widths, best for Gaussians (Gelman, Roberts, Gilks 1996)."""
    d = len(factor)
    scaled = 2.38 / np.sqrt(d) * factor
    return lambda rng: rng.standard_normal((chains, d)) @ scaled.T


def _point_covariance(mode: Mode) -> FloatArray:
    """Return the covariance of parameters and noise coordinates at the mode, (d, d)."""
    f, e = len(mode.linearisation.posterior.free), len(mode.eta)
    covariance = np.zeros((f + e, f + e))
    covariance[:f, :f] = mode.covariance
    covariance[f:, f:] = mode.eta_covariance
    return covariance
