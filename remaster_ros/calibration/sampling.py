# SPDX-License-Identifier: Apache-2.0
"""Draws from the exact posterior of a fit, by Metropolis-Hastings with one adapted proposal.

Independent proposals of a Student t (`proposal`) that begins at the linearised posterior. If its
density equals the exact one on draws, as with any number of good observations, it is sampled;
otherwise the exact density is sampled, with proposals adapted to its mean and covariance. If these
do not reach it, the result is the Gaussian about the mode, and states that no sampler has
confirmed it.
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
# Default Monte Carlo error of every mean over its standard deviation: 1 / 0.02² = 2500 effective
# draws, of the bulk and of the tails.
PRECISION = 0.02
# Fewest draws of a chain that show its convergence.
FEWEST_DRAWS = 200
# Number of draws of the Gaussian about the mode, per chain.
GAUSSIAN_DRAWS = 800
# Largest number of values in all chains together: 32 MB, and a dozen times that in all quantities
# derived from them.
LARGEST_CHAINS = 4_000_000
# Largest number of evaluated rows, some 0.2 µs each, so that sampling ends for any session: at
# 2,000 rows 50,000 evaluations of the exact density. The fixed cost of an evaluation is counted in
# rows; the fewest evaluations are made with any number of rows, which takes longer with very many.
EVALUATED_ROWS = 100_000_000
ROWS_OF_AN_EVALUATION = 100
FEWEST_EVALUATIONS = 4000
# Share of the evaluations for the rounds that adapt the proposal, number of rounds, and draws of a
# round: a fixed number, or a number for each dimension if that is more.
ADAPTING = 0.25
ROUNDS = 8
ROUND_DRAWS, ROUND_DRAWS_PER_DIMENSION = 1000, 40
# Effective share of the draws from which a proposal is good enough: more than half are accepted.
GOOD_WEIGHTS = 0.5
# Number of parameters above which the result is the Gaussian about the mode: draws of a Student t
# in so many dimensions are hardly ever in the bulk.
MANY_PARAMETERS = 60
# Ratio of needed to allowed draws from which chains are given up.
HOPELESS = 1.5
# Largest difference of the linearised log density from the exact one, on draws; number of
# evaluated rows for this check, with the fewest and most draws.
DENSITY_ERROR_LIMIT = 0.05
CHECKED_ROWS, FEWEST_CHECKED, MOST_CHECKED = 5_000_000, 20, 200
LINEARISED = (
    'independence Metropolis-Hastings on the linearised density, which is the exact one to within '
    f'{DENSITY_ERROR_LIMIT:g} on draws'
)
EXACT = 'independence Metropolis-Hastings on the exact density, adapted Student t proposal'


class Sampling(NamedTuple):
    """Result of `sample_posterior`."""

    run: Chains  # Points as `Posterior` defines them
    name: str  # Name of the sampler, for the report


def silent(stage: str, share: float) -> None:
    """Do nothing: progress without a report."""


def unchanged(points: FloatArray) -> FloatArray:
    """Points as they are."""
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
    """Draws of the exact posterior about its mode.

    ``chains``: number of chains, from dispersed first states; ``draws``: draws of each chain, or
    None to sample in batches until R-hat is at most 1.01 and the effective draws of every quantity
    reach the precision; ``precision``: Monte Carlo error of each mean over its standard deviation;
    ``quantities``: of points (..., d) to the quantities (..., p) that decide the length;
    ``report``: called with the stage and the share of it that is done.
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
    """Draws of the Gaussian about the mode, which is the posterior of many linear effects.

    800 for each chain (`GAUSSIAN_DRAWS`): parameters by the linearised posterior at the mode's
    noise, the noise by its own curvature, both independent.
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
    """Whether the linearised density equals the exact one on draws of it, up to a constant.

    The differences of the logs span less than 0.1 (twice `DENSITY_ERROR_LIMIT`).
    """
    posterior = proposal.mode.linearisation.posterior
    count = int(np.clip(CHECKED_ROWS // len(posterior.rows), FEWEST_CHECKED, MOST_CHECKED))
    points, log_proposal = proposal.sample(4 * count, rng)
    # Proposals that the linearised density would accept: the proposal's tails are wider.
    log_weight = proposal.linearised(points) - log_proposal
    kept = np.log(rng.random(len(points))) < log_weight - np.max(log_weight)
    points = points[kept][:count]
    difference = posterior.log_density(points) - proposal.linearised(points)
    return len(points) > 1 and float(np.ptp(difference)) < 2.0 * DENSITY_ERROR_LIMIT


def _adapted(
    proposal: AdaptedProposal,
    log_density: LogDensity,
    evaluations: float,
    rng: np.random.Generator,
    report: Progress,
) -> tuple[AdaptedProposal, Weighted]:
    """Best of up to 8 proposals, each adapted to draws of the one before, with its draws.

    Best by the effective number of draws. Ends once half of the draws are effective
    (`GOOD_WEIGHTS`). ``evaluations``: number of evaluations of the density that are allowed;
    ``report``: called with the stage and the share of it that is done.
    """
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
    """Chains, sampled in batches until they have enough effective draws; None if they will not.

    Enough: ``wanted`` ones of every quantity, in bulk and tails, or 400 (`ESS_LIMIT`) at the
    largest length; R-hat at most 1.01. ``more``: samples chains, from (start, draws, warm-up);
    ``start``: first states; ``most``: largest number of draws of a chain; ``worth``: expected
    effective share of the draws; ``quantities``: of points (..., d) to the quantities (..., p)
    that decide.
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
        # A quantity that never moves has no effective draws.
        least = max(1.0, float(np.min(np.nan_to_num(np.minimum(bulk, tail)))))
        mixed = np.max(r_hat) <= R_HAT_LIMIT
        if mixed and (least >= wanted or (count >= most and least >= ESS_LIMIT)):
            return run._replace(figures=(r_hat, bulk, tail))
        if count >= most or count * min(wanted, ESS_LIMIT) / least > HOPELESS * most:
            return None
        # A tenth more than by the rate so far, but no more than three times as many.
        expected = 1.1 * count * wanted / least
        batch = int(np.clip(expected - count, count // 4, 3 * count))
        part = more(run.draws[:, -1], min(batch, most - count), 0)
        added = part.draws.shape[1]
        run = Chains(
            np.concatenate((run.draws, part.draws), axis=1),
            (run.acceptance_rate * count + part.acceptance_rate * added) / (count + added),
            np.concatenate((run.trace, part.trace[:, -added:]), axis=1),
        )
