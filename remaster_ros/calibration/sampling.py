# SPDX-License-Identifier: Apache-2.0
"""Draws from the exact posterior of a fit, by Metropolis-Hastings with one adapted proposal.

Independent proposals of a Student t (`proposal`) that begins at the linearised posterior. Where
this is the exact one on draws, as with any number of good observations, it is sampled; else the
exact one is, with proposals moved to its mean and covariance. Where those do not reach it, the
Gaussian about the mode stands, and the result states that nothing has sampled it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from remaster_ros.calibration import convergence
from remaster_ros.calibration.convergence import ESS_LIMIT, R_HAT_LIMIT
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.metropolis import Chains, LogDensity, independence_sampler
from remaster_ros.calibration.proposal import AdaptedProposal, Weighted
from remaster_ros.types import FloatArray

Progress = Callable[[str, float], None]

WARM_UP = 100
# Monte Carlo error of every mean over its standard deviation, where nothing else is asked for:
# 1 / 0.02² = 2500 effective draws, of the bulk and of the tails.
PRECISION = 0.02
# Chains of fewer draws tell little of their own convergence.
FEWEST_DRAWS = 200
# Draws of the Gaussian about the mode, per chain.
GAUSSIAN_DRAWS = 800
# All the chains together do not hold more numbers than this: 32 MB, a dozen times in all that is
# derived from them.
LARGEST_CHAINS = 4_000_000
# The exact density is evaluated so many times in all, counted in rows of the session, which take
# some 0.2 µs each, so that any session ends: at 2,000 rows 50,000 times. An evaluation costs as
# much as so many rows whatever their number. Where there are very many rows it takes longer.
EVALUATED_ROWS = 100_000_000
ROWS_OF_AN_EVALUATION = 100
FEWEST_EVALUATIONS = 4000
# Of them, for the rounds that adapt the proposal; a round has so many draws, or so many for each
# dimension where that is more.
ADAPTING = 0.25
ROUNDS = 8
ROUND_DRAWS, ROUND_DRAWS_PER_DIMENSION = 1000, 40
# Draws worth this share of themselves are taken by more than half as proposals: good enough.
GOOD_WEIGHTS = 0.5
# With more parameters the Gaussian about the mode is taken: a Student t in so many dimensions
# hardly ever hits the bulk.
MANY_PARAMETERS = 60
# Chains are given up that promise to take so many times the draws they may have.
HOPELESS = 1.5
# The linearised density may differ by this from the exact one on draws of it: of so many rows of
# observations in all, fewest and most draws.
DENSITY_ERROR_LIMIT = 0.05
CHECKED_ROWS, FEWEST_CHECKED, MOST_CHECKED = 5_000_000, 20, 200
LINEARISED = (
    'independence Metropolis-Hastings on the linearised density, which is the exact one to within '
    f'{DENSITY_ERROR_LIMIT:g} on draws'
)
EXACT = 'independence Metropolis-Hastings on the exact density, adapted Student t proposal'


class Sampling(NamedTuple):
    """What `sample_posterior` returns."""

    run: Chains  # Points as `Posterior` defines them
    name: str  # Which sampler it was, for the report


def silent(stage: str, share: float) -> None:
    """Report nothing."""


def unchanged(points: FloatArray) -> FloatArray:
    """Return points as they are."""
    return points


def sample_posterior(
    mode: Mode,
    *,
    chains: int,
    rng: np.random.Generator,
    draws: int | None = None,
    precision: float = PRECISION,
    quantities: Callable[[FloatArray], FloatArray] = unchanged,
    report: Progress = silent,
) -> Sampling:
    """Sample the exact posterior about its mode.

    ``mode``: of the posterior; ``chains``: number of chains, from dispersed starts; ``draws``:
    draws of each chain; None to sample in batches until R-hat is at most 1.01 and the effective
    draws of every quantity reach the precision; ``precision``: Monte Carlo error of each mean over
    its standard deviation; ``quantities``: what the length is judged by: points (..., d) to
    quantities (..., p); ``report``: called with the stage and the share of it that is done.
    """
    posterior = mode.linearisation.posterior
    if len(posterior.free) > MANY_PARAMETERS:
        return Sampling(gaussian_draws(mode, chains, rng), 'Gaussian about the mode')
    evaluations = max(
        FEWEST_EVALUATIONS, EVALUATED_ROWS // (len(posterior.rows) + ROWS_OF_AN_EVALUATION)
    )
    target, name, proposal = posterior.log_density, EXACT, AdaptedProposal.about(mode)
    if _is_linear(proposal, rng.spawn(1)[0]):
        target, name = proposal.linearised, LINEARISED
        evaluations = EVALUATED_ROWS // ROWS_OF_AN_EVALUATION
    proposal, drawn = _adapted(proposal, target, ADAPTING * evaluations, rng, report)
    start = proposal.dispersed(chains, rng)

    def more(start: FloatArray, count: int, warm_up: int) -> Chains:
        return independence_sampler(
            target,
            proposal,
            draws=count,
            warm_up=warm_up,
            rng=rng,
            start=start,
            progress=lambda share: report('sampling', share),
        )

    if draws is not None:
        return Sampling(more(start, draws, WARM_UP), name)
    most = min(int((1.0 - ADAPTING) * evaluations), LARGEST_CHAINS // posterior.size) // chains
    most = max(FEWEST_DRAWS, most - WARM_UP)
    worth = drawn.effective / len(drawn.points)
    run = _long_enough(more, start, most, precision**-2, worth, quantities)
    if run is not None:
        return Sampling(run, name)
    gaussian = gaussian_draws(mode, chains, rng)
    return Sampling(
        gaussian._replace(pareto_k=drawn.pareto_k, effective=drawn.effective),
        'Gaussian about the mode (no chain reached the precision with the evaluations allowed)',
    )


def gaussian_draws(mode: Mode, chains: int, rng: np.random.Generator) -> Chains:
    """Draw from the Gaussian about the mode, which the posterior of many linear effects is.

    Parameters as by the linearised posterior at the mode's noise, the noise by its own curvature.
    """
    count = chains * GAUSSIAN_DRAWS
    parts = []
    for mean, covariance in (
        (mode.z[mode.linearisation.posterior.free], mode.covariance),
        (mode.eta, mode.eta_covariance),
    ):
        unit = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
        scaled = covariance / np.outer(unit, unit)
        values, vectors = np.linalg.eigh(scaled)
        root = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        parts.append(mean + rng.standard_normal((count, len(mean))) @ root.T)
    points = np.concatenate(parts, axis=1).reshape(chains, GAUSSIAN_DRAWS, -1)
    return Chains(points, float('nan'), points, method='laplace', effective=float(count))


def _is_linear(proposal: AdaptedProposal, rng: np.random.Generator) -> bool:
    """Return whether the linearised density is the exact one on draws of it."""
    posterior = proposal.mode.linearisation.posterior
    count = int(np.clip(CHECKED_ROWS // len(posterior.rows), FEWEST_CHECKED, MOST_CHECKED))
    points, log_proposal = proposal.sample(4 * count, rng)
    # Of the proposals those that the density would take: its tails are wider.
    log_weight = proposal.linearised(points) - log_proposal
    kept = np.log(rng.random(len(points))) < log_weight - np.max(log_weight)
    points = points[kept][:count]
    apart = posterior.log_density(points) - proposal.linearised(points)
    return len(points) > 1 and float(np.ptp(apart)) < 2.0 * DENSITY_ERROR_LIMIT


def _adapted(
    proposal: AdaptedProposal,
    log_density: LogDensity,
    evaluations: float,
    rng: np.random.Generator,
    report: Progress,
) -> tuple[AdaptedProposal, Weighted]:
    """Return the best of several proposals, each adapted to draws of the one before it."""
    count = max(ROUND_DRAWS, ROUND_DRAWS_PER_DIMENSION * proposal.dimension)
    rounds = int(np.clip(evaluations // count, 1, ROUNDS))
    best: tuple[AdaptedProposal, Weighted] | None = None
    for done in range(rounds):
        report('adapting the sampler', done / rounds)
        points, log_proposal = proposal.sample(count, rng)
        drawn = Weighted.of(points, log_density(points) - log_proposal)
        if best is None or drawn.effective > best[1].effective:
            best = (proposal, drawn)
        if best[1].effective >= GOOD_WEIGHTS * count:
            break
        proposal = proposal.adapted(drawn)
    assert best is not None
    return best


def _long_enough(
    more: Callable[[FloatArray, int, int], Chains],
    start: FloatArray,
    most: int,
    wanted: float,
    worth: float,
    quantities: Callable[[FloatArray], FloatArray],
) -> Chains | None:
    """Sample in batches until the chains have what is wanted; None where they will not.

    ``more`` continues from a state: (start, draws, warm-up) to chains; ``worth`` is what share of
    independent draws one is expected to be worth.
    """
    first = int(np.clip(1.1 * wanted / (worth * len(start)), FEWEST_DRAWS, most))
    run = more(start, first, WARM_UP)
    while True:
        count = run.draws.shape[1]
        values = quantities(run.draws)
        r_hat, bulk, tail = (
            figure(values)
            for figure in (convergence.r_hat, convergence.ess_bulk, convergence.ess_tail)
        )
        # What never moves has no effective draws.
        least = max(1.0, float(np.min(np.nan_to_num(np.minimum(bulk, tail)))))
        mixed = np.max(r_hat) <= R_HAT_LIMIT
        if mixed and (least >= wanted or (count >= most and least >= ESS_LIMIT)):
            return run._replace(figures=(r_hat, bulk, tail))
        if count >= most or count * min(wanted, ESS_LIMIT) / least > HOPELESS * most:
            return None
        # A tenth more than the rate so far promises, but no more than three times as many.
        expected = 1.1 * count * wanted / least
        batch = int(np.clip(expected - count, count // 4, 3 * count))
        part = more(run.draws[:, -1], min(batch, most - count), 0)
        added = part.draws.shape[1]
        run = Chains(
            np.concatenate((run.draws, part.draws), axis=1),
            (run.acceptance_rate * count + part.acceptance_rate * added) / (count + added),
            np.concatenate((run.trace, part.trace[:, -added:]), axis=1),
        )
