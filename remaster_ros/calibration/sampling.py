"""Draws from the exact posterior of a fit, by the cheapest sampler that works on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from remaster_ros.calibration import convergence
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.metropolis import (
    Chains,
    LogDensity,
    Proposal,
    StudentT,
    independence_sampler,
    random_walk_sampler,
)
from remaster_ros.calibration.proposal import FactorisedProposal, LaplaceProposal
from remaster_ros.calibration.surrogate import Surrogate
from remaster_ros.types import FloatArray

Progress = Callable[[str, float], None]

WARM_UP = 100
# Monte Carlo error of every mean over its standard deviation, where nothing else is asked for:
# 1 / 0.02² = 2500 effective draws, of the bulk and of the tails.
PRECISION = 0.02
R_HAT_LIMIT = 1.01
FIRST_DRAWS = 800
# Draws of one chain after which the sampler gives up and says so.
ALLOWANCE = 100_000
# Below this share of proposals taken the proposal is adapted to a random walk's draws; should
# that not help, a random walk is what remains.
POOR_ACCEPTANCE = 0.15
# Where independent draws by the interpolated proposal are worth less than this share of themselves
# it is factorised for every draw; so many draws tell.
POOR_WEIGHTS = 0.5
TRIAL_DRAWS = 1000
# In tens of dimensions a Student t of few degrees of freedom hardly ever hits the bulk.
ADAPTED_FREEDOM = 15.0
PILOT_CHAINS = 32
PILOT_STEPS = 1000
WALK_STEPS_PER_DRAW = 20
# Shares of a Gaussian's best step that are tried for the walk, for so many steps each.
STEP_SCALES = (1.0, 0.7, 0.5, 0.35, 0.25)
SCALE_STEPS = 200
# The second-order density may differ by this from the exact one on the draws it gave, of which so
# many are checked (fewer where there are so many observations that it would take seconds).
DENSITY_ERROR_LIMIT = 0.05
CHECKED_DRAWS = 200
CHECKED_ROWS = 5_000_000


class Sampling(NamedTuple):
    """What `sample_posterior` returns.

    Attributes
    ----------
    run
        Points as `Posterior` defines them.
    name
        What was done, in words.
    """

    run: Chains
    name: str


@dataclass(frozen=True)
class Length:
    """How long to sample.

    Attributes
    ----------
    draws
        Of each chain; None for as many as the precision takes.
    precision
        Wanted Monte Carlo error of every mean, in standard deviations of that quantity.
    """

    draws: int | None = None
    precision: float = PRECISION

    @property
    def effective(self) -> float:
        """Effective draws that the precision takes."""
        return self.precision**-2

    def reached(self, r_hat: FloatArray, ess: FloatArray) -> bool:
        """Tell whether chains with these figures are long enough."""
        return bool(np.max(r_hat) <= R_HAT_LIMIT and np.min(ess) >= self.effective)


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

    Independent proposals from the linearised posterior, judged by the second-order density
    (`surrogate`); that is compared with the exact one on draws it gave, and replaced by it where
    they differ. Where too few proposals are taken they come from a Student t adapted to a pilot
    run; at last a random walk.

    Parameters
    ----------
    mode
        Of the posterior.
    chains
        Number of chains, from dispersed starts; a random walk to a precision has more.
    rng
        Source of all randomness.
    draws
        Draws of each chain; None to sample in batches until R-hat is at most 1.01 and the
        effective draws of every quantity reach the precision, or each chain has `ALLOWANCE`.
    precision
        Monte Carlo error of each mean over its standard deviation.
    quantities
        What the length is judged by: points (..., d) to quantities (..., p).
    report
        Called with the stage and the share of it that is done.
    """
    posterior = mode.linearisation.posterior
    length = Length(draws, precision)
    surrogate = Surrogate.of(mode)
    laplace = LaplaceProposal.of(mode)
    factorised = _weight_share(laplace, surrogate.log_density, rng.spawn(1)[0]) < POOR_WEIGHTS
    if factorised:
        laplace = FactorisedProposal.of(mode)
    starts = laplace.dispersed(chains, rng)

    def independent(target: LogDensity, proposal: Proposal, start: FloatArray) -> Chains:
        def more(start: FloatArray, count: int, warm_up: int) -> Chains:
            return independence_sampler(
                target,
                proposal,
                chains=chains,
                draws=count,
                warm_up=warm_up,
                rng=rng,
                start=start,
                progress=lambda share: report('sampling', share),
            )

        return _long_enough(more, start, length, quantities, POOR_ACCEPTANCE)

    run = independent(surrogate.log_density, laplace, starts)
    name = 'independence Metropolis-Hastings, Laplace proposal'
    if factorised:
        name += ' factorised for every draw'
    checked = max(20, min(CHECKED_DRAWS, CHECKED_ROWS // len(posterior.rows)))
    points = run.draws.reshape(-1, posterior.size)
    points = points[rng.choice(len(points), min(checked, len(points)), replace=False)]
    error = surrogate.log_density_error(points)
    if error > DENSITY_ERROR_LIMIT or run.acceptance_rate < POOR_ACCEPTANCE:
        run, name = _exact(mode, laplace, starts, independent, length, quantities, rng, report)
        return Sampling(run, name)
    return Sampling(run._replace(log_density_error=error, checked=len(points)), name)


def _weight_share(
    proposal: LaplaceProposal, log_density: LogDensity, rng: np.random.Generator
) -> float:
    """Return what share of independent draws their importance weights are worth (Kish 1965)."""
    points, log_proposal = proposal.sample(TRIAL_DRAWS, rng)
    log_weight = log_density(points) - log_proposal
    weight = np.exp(log_weight - log_weight.max())
    return float(np.sum(weight) ** 2 / np.sum(weight**2) / len(weight))


def _exact(
    mode: Mode,
    laplace: LaplaceProposal,
    starts: FloatArray,
    independent: Callable[[LogDensity, Proposal, FloatArray], Chains],
    length: Length,
    quantities: Callable[[FloatArray], FloatArray],
    rng: np.random.Generator,
    report: Progress,
) -> tuple[Chains, str]:
    """Sample by the exact density, whatever it costs."""
    log_density = mode.linearisation.posterior.log_density
    run = independent(log_density, laplace, starts)
    if run.acceptance_rate >= POOR_ACCEPTANCE:
        return run, (
            'independence Metropolis-Hastings on the exact density, Laplace proposal '
            '(the density is not near enough to its second order)'
        )

    chains = len(starts)
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
    run = independent(log_density, adapted, start)
    if run.acceptance_rate >= POOR_ACCEPTANCE:
        return run, (
            'independence Metropolis-Hastings, Student t proposal adapted to a random walk '
            '(too few of the Laplace proposals were taken)'
        )

    # All of the pilot's chains go on: a batch of them costs hardly more than a few.
    start = pilot[:, -1] if length.draws is None else start
    scale = _step_scale(log_density, factor, start, rng)

    def walk(start: FloatArray, count: int, warm_up: int) -> Chains:
        return random_walk_sampler(
            log_density,
            _gaussian_step(scale * factor, len(start)),
            start=start,
            steps=(count + warm_up) * WALK_STEPS_PER_DRAW,
            burn_in=warm_up * WALK_STEPS_PER_DRAW,
            rng=rng,
            thin=WALK_STEPS_PER_DRAW,
            trace_every=WALK_STEPS_PER_DRAW,
            progress=lambda share: report('sampling by random walk', share),
        )

    run = _long_enough(walk, start, length, quantities, 0.0)
    return run, 'random-walk Metropolis (too few independent proposals were taken)'


def _step_scale(
    log_density: LogDensity, factor: FloatArray, start: FloatArray, rng: np.random.Generator
) -> float:
    """Return the share of a Gaussian's best step that moves a walk farthest (Pasarica 2010).

    The widths of a posterior with long tails are too long a step for its bulk.
    """

    def squared_jump(scale: float) -> float:
        run = random_walk_sampler(
            log_density,
            _gaussian_step(scale * factor, len(start)),
            start=start,
            steps=SCALE_STEPS,
            burn_in=0,
            rng=rng,
        )
        return scale**2 * run.acceptance_rate

    return max(STEP_SCALES, key=squared_jump)


def _long_enough(
    more: Callable[[FloatArray, int, int], Chains],
    start: FloatArray,
    length: Length,
    quantities: Callable[[FloatArray], FloatArray],
    poor: float,
) -> Chains:
    """Sample in batches until the length is reached; give up early where acceptance is poor.

    ``more`` continues from a state: (start, draws, warm-up) to chains.
    """
    run = more(start, length.draws or FIRST_DRAWS, WARM_UP)
    while length.draws is None and run.acceptance_rate >= poor:
        count = run.draws.shape[1]
        values = quantities(run.draws)
        # What never moved has no effective draws.
        ess = np.nan_to_num(np.minimum(convergence.ess_bulk(values), convergence.ess_tail(values)))
        if length.reached(convergence.r_hat(values), ess) or count >= ALLOWANCE:
            break
        # A tenth more than the rate so far promises, but no more than three times what there is.
        wanted = 1.1 * count * length.effective / max(float(np.min(ess)), 1.0)
        batch = int(np.clip(wanted - count, count // 4, 3 * count))
        part = more(run.draws[:, -1], min(batch, ALLOWANCE - count), 0)
        taken = run.acceptance_rate * count + part.acceptance_rate * part.draws.shape[1]
        run = Chains(
            np.concatenate((run.draws, part.draws), axis=1),
            taken / (count + part.draws.shape[1]),
            np.concatenate((run.trace, part.trace[:, -part.draws.shape[1] :]), axis=1),
        )
    return run


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
