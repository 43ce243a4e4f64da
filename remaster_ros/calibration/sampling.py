"""Draws from the exact posterior of a fit, by the cheapest sampler that works on it.

`sample_posterior` is the one interface of the samplers: `metropolis` has the two kernels,
`proposal` the densities that are proposed from, `surrogate` the density that costs the same for
any number of observations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from remaster_ros.calibration import convergence
from remaster_ros.calibration.convergence import R_HAT_LIMIT
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.metropolis import (
    Chains,
    LogDensity,
    Proposal,
    independence_sampler,
    random_walk_sampler,
)
from remaster_ros.calibration.proposal import LaplaceProposal, StudentT
from remaster_ros.calibration.surrogate import Surrogate
from remaster_ros.types import FloatArray

Progress = Callable[[str, float], None]

WARM_UP = 100
# Monte Carlo error of every mean over its standard deviation, where nothing else is asked for:
# 1 / 0.02² = 2500 effective draws, of the bulk and of the tails.
PRECISION = 0.02
FIRST_DRAWS = 800
# A chain is not made longer than this; the result then states that it has not converged.
ALLOWANCE = 100_000
# Below this share of proposals taken the proposal is adapted to a random walk's draws; should
# that not help, a random walk is what remains.
POOR_ACCEPTANCE = 0.15
# Where independent draws by the proposal with the mode's noise are worth less than this share of
# themselves, it is factorised for every draw. So many draws are tried.
POOR_WEIGHTS = 0.8
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
        Which sampler it was, for the report.
    """

    run: Chains
    name: str


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

    Independent proposals from the linearised posterior, accepted by the second-order density
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
    task = _Task(draws, precision, quantities, rng, report)
    surrogate = Surrogate.of(mode)
    laplace = LaplaceProposal(mode)
    name = 'independence Metropolis-Hastings, Laplace proposal'
    if _weight_share(laplace, surrogate.log_density, rng.spawn(1)[0]) < POOR_WEIGHTS:
        laplace = LaplaceProposal(mode, factorised=True)
        name += ' factorised for every draw'
    starts = laplace.dispersed(chains, rng)
    run = task.independent(surrogate.log_density, laplace, starts)
    checked = max(20, min(CHECKED_DRAWS, CHECKED_ROWS // len(posterior.rows)))
    points = run.draws.reshape(-1, posterior.size)
    points = points[rng.choice(len(points), min(checked, len(points)), replace=False)]
    error = surrogate.log_density_error(points)
    if error > DENSITY_ERROR_LIMIT or run.acceptance_rate < POOR_ACCEPTANCE:
        return _exact(task, posterior.log_density, laplace, starts)
    return Sampling(run._replace(log_density_error=error, checked=len(points)), name)


def _weight_share(
    proposal: LaplaceProposal, log_density: LogDensity, rng: np.random.Generator
) -> float:
    """Return what share of independent draws their importance weights are worth (Kish 1965)."""
    points, log_proposal = proposal.sample(TRIAL_DRAWS, rng)
    log_weight = log_density(points) - log_proposal
    weight = np.exp(log_weight - log_weight.max())
    return float(np.mean(weight) ** 2 / np.mean(weight**2))


def _exact(
    task: _Task, log_density: LogDensity, laplace: LaplaceProposal, starts: FloatArray
) -> Sampling:
    """Sample by the exact density, whatever it costs."""
    run = task.independent(log_density, laplace, starts)
    if run.acceptance_rate >= POOR_ACCEPTANCE:
        return Sampling(
            run,
            'independence Metropolis-Hastings on the exact density, Laplace proposal '
            '(the density is not near enough to its second order)',
        )

    rng, chains = task.rng, len(starts)
    factor = _factor(laplace.sample(TRIAL_DRAWS, rng)[0])
    pilot = random_walk_sampler(
        log_density,
        _gaussian_step(factor, PILOT_CHAINS),
        start=laplace.dispersed(PILOT_CHAINS, rng),
        steps=PILOT_STEPS,
        burn_in=PILOT_STEPS // 2,
        rng=rng,
        thin=10,
        progress=lambda share: task.report('adapting the sampler', share),
    ).draws
    pooled = pilot.reshape(-1, pilot.shape[-1])
    factor = _factor(pooled)
    adapted = StudentT(pooled.mean(axis=0), factor, ADAPTED_FREEDOM)
    start = pilot[rng.choice(PILOT_CHAINS, chains, replace=chains > PILOT_CHAINS), -1]
    run = task.independent(log_density, adapted, start)
    if run.acceptance_rate >= POOR_ACCEPTANCE:
        return Sampling(
            run,
            'independence Metropolis-Hastings, Student t proposal adapted to a random walk '
            '(too few of the Laplace proposals were taken)',
        )

    # All of the pilot's chains go on: a batch of them costs hardly more than a few.
    start = pilot[:, -1] if task.draws is None else start
    run = task.walk(log_density, _step_scale(log_density, factor, start, rng) * factor, start)
    return Sampling(run, 'random-walk Metropolis (too few independent proposals were taken)')


@dataclass(frozen=True)
class _Task:
    """How long to sample, and what is the same for every sampler; see `sample_posterior`."""

    draws: int | None
    precision: float
    quantities: Callable[[FloatArray], FloatArray]
    rng: np.random.Generator
    report: Progress

    def independent(self, target: LogDensity, proposal: Proposal, start: FloatArray) -> Chains:
        """Sample by independent proposals; stop early where too few are taken."""

        def more(start: FloatArray, draws: int, warm_up: int) -> Chains:
            return independence_sampler(
                target,
                proposal,
                draws=draws,
                warm_up=warm_up,
                rng=self.rng,
                start=start,
                progress=lambda share: self.report('sampling', share),
            )

        return self._long_enough(more, start, POOR_ACCEPTANCE)

    def walk(self, target: LogDensity, factor: FloatArray, start: FloatArray) -> Chains:
        """Sample by a random walk with steps of this factor, (d, d)."""

        def more(start: FloatArray, draws: int, warm_up: int) -> Chains:
            return random_walk_sampler(
                target,
                _gaussian_step(factor, len(start)),
                start=start,
                steps=(draws + warm_up) * WALK_STEPS_PER_DRAW,
                burn_in=warm_up * WALK_STEPS_PER_DRAW,
                rng=self.rng,
                thin=WALK_STEPS_PER_DRAW,
                trace_every=WALK_STEPS_PER_DRAW,
                progress=lambda share: self.report('sampling by random walk', share),
            )

        return self._long_enough(more, start, 0.0)

    def _long_enough(
        self, more: Callable[[FloatArray, int, int], Chains], start: FloatArray, poor: float
    ) -> Chains:
        """Sample in batches until the length is reached; give up early where acceptance is poor.

        ``more`` continues from a state: (start, draws, warm-up) to chains.
        """
        run = more(start, self.draws or FIRST_DRAWS, WARM_UP)
        while self.draws is None and run.acceptance_rate >= poor:
            count = run.draws.shape[1]
            values = self.quantities(run.draws)
            ess = np.minimum(convergence.ess_bulk(values), convergence.ess_tail(values))
            # What never moves has no effective draws.
            least, wanted = float(np.min(np.nan_to_num(ess))), self.precision**-2
            mixed = np.max(convergence.r_hat(values)) <= R_HAT_LIMIT
            if (mixed and least >= wanted) or count >= ALLOWANCE:
                break
            # A tenth more than the rate so far promises, but no more than three times as many.
            expected = 1.1 * count * wanted / max(least, 1.0)
            batch = int(np.clip(expected - count, count // 4, 3 * count))
            part = more(run.draws[:, -1], min(batch, ALLOWANCE - count), 0)
            added = part.draws.shape[1]
            run = Chains(
                np.concatenate((run.draws, part.draws), axis=1),
                (run.acceptance_rate * count + part.acceptance_rate * added) / (count + added),
                np.concatenate((run.trace, part.trace[:, -added:]), axis=1),
            )
        return run


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


def _gaussian_step(factor: FloatArray, chains: int) -> Callable[[np.random.Generator], FloatArray]:
    """Return moves of 2.38 / sqrt(d) widths, best for Gaussians (Gelman, Roberts, Gilks 1996)."""
    d = len(factor)
    scaled = 2.38 / np.sqrt(d) * factor
    return lambda rng: rng.standard_normal((chains, d)) @ scaled.T


def _factor(points: FloatArray) -> FloatArray:
    """Return the Cholesky factor of the covariance of points (n, d), (d, d)."""
    return np.asarray(np.linalg.cholesky(np.cov(points.T)))
