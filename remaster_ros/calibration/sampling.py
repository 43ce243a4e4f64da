"""Draws from the exact posterior of a fit, by the cheapest sampler that works on it.

`sample_posterior` is the one interface of the samplers: `metropolis` has the two kernels,
`proposal` and `conditional_proposal` the densities that are proposed from, `surrogate` the density
that costs the same for any number of observations, `importance` what remains where chains are not
worth their length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from remaster_ros.calibration import convergence
from remaster_ros.calibration.conditional_proposal import ConditionalProposal
from remaster_ros.calibration.convergence import ESS_LIMIT, R_HAT_LIMIT
from remaster_ros.calibration.importance import Adaptable, Weighted, adaptive_importance
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.metropolis import (
    Chains,
    LogDensity,
    Proposal,
    gaussian_step,
    independence_sampler,
    random_walk_sampler,
    step_scale,
)
from remaster_ros.calibration.proposal import LaplaceProposal
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
# Nor do all the chains together hold more numbers than this: 32 MB, a dozen times in all that is
# derived from them.
LARGEST_CHAINS = 4_000_000
# The exact density is evaluated so many times in all, counted in rows of the session, which take
# some 0.2 µs each, so that any session ends: at 2,000 rows 50,000 times. An evaluation costs as
# much as so many rows whatever their number. Where there are very many rows it takes longer.
EVALUATED_ROWS = 100_000_000
ROWS_OF_AN_EVALUATION = 100
FEWEST_EVALUATIONS = 4000
# Chains are given up that promise to take so many times the draws they may have.
HOPELESS = 1.5
# Share of them for chains of independent proposals that are not adapted, and of what is then left
# for importance sampling; the rest is for the random walk.
CHAINS_SHARE, IMPORTANCE_SHARE = 0.25, 0.5
# Below this share of proposals taken the proposal is adapted; should that not help, a random walk
# is what remains.
POOR_ACCEPTANCE = 0.15
# Where independent draws by the proposal with the mode's noise are worth less than this share of
# themselves, it is factorised for every draw. So many draws are tried. Not where there are more
# parameters than this: it would take a hundred times as long as a few more draws.
POOR_WEIGHTS = 0.8
MANY_PARAMETERS = 60
TRIAL_DRAWS = 1000
# Where they are worth less than this share of themselves, chains of them are not tried: log
# weights of variance v leave a share of exp(-v), and a chain takes 2 Φ(-√(v / 2)) of its
# proposals, which is then a poor acceptance.
HOPELESS_WEIGHTS = 0.016
# So many times the draws on trial the exact density has to be evaluated in all, or there are none.
TRIALS = 10
WALKS = 32
WALK_STEPS_PER_DRAW = 20
# The first draws of each walk, by which it is judged: a draw costs as much as twenty of a chain.
# Walks begin at weighted draws, so that they need hardly any warm-up.
FIRST_WALKED, WALK_WARM_UP = 100, 25
# The second-order density may differ by this from the exact one on the draws it gave, of which so
# many are checked (fewer where there are so many observations that it would take seconds).
DENSITY_ERROR_LIMIT = 0.05
# So few before anything is sampled by it.
CHECKED_DRAWS, FIRST_CHECKED = 200, 20
CHECKED_ROWS = 5_000_000
# Weighted draws that are worth fewer than this are not shown instead of the Gaussian's.
FEWEST_EFFECTIVE = 100.0


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
    they differ. Where too few proposals are taken, or chains of a stated length are worth too few
    independent draws, importance sampling by proposals that are adapted; then a random walk. The
    evaluations of the exact density are limited (`EVALUATED_ROWS`); where they do not suffice the
    result is the best approximation, and its Pareto k states how good it is.

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
        effective draws of every quantity reach the precision, or the chains are as long as they
        may be (`ALLOWANCE`, `LARGEST_CHAINS`).
    precision
        Monte Carlo error of each mean over its standard deviation.
    quantities
        What the length is judged by: points (..., d) to quantities (..., p).
    report
        Called with the stage and the share of it that is done.
    """
    posterior = mode.linearisation.posterior
    evaluations = max(
        FEWEST_EVALUATIONS, EVALUATED_ROWS // (len(posterior.rows) + ROWS_OF_AN_EVALUATION)
    )
    task = _Task(draws, precision, quantities, rng, report, evaluations)
    surrogate = Surrogate.of(mode)
    laplace = LaplaceProposal(mode)
    name = 'independence Metropolis-Hastings, Laplace proposal'
    few = len(posterior.free) < MANY_PARAMETERS
    trial = Weighted.of(*_proposed(laplace, surrogate.log_density, rng.spawn(1)[0]), laplace)
    if few and trial.effective < POOR_WEIGHTS * TRIAL_DRAWS:
        laplace = LaplaceProposal(mode, factorised=True)
        name += ' factorised for every draw'
    starts = laplace.dispersed(chains, rng)
    likely = trial.resampled(FIRST_CHECKED, rng.spawn(1)[0])
    if surrogate.log_density_error(likely) > DENSITY_ERROR_LIMIT:
        return _exact(task, posterior.log_density, laplace, starts)
    run, enough = task.independent(surrogate.log_density, laplace, starts)
    checked = max(20, min(CHECKED_DRAWS, CHECKED_ROWS // len(posterior.rows)))
    points = run.draws.reshape(-1, posterior.size)
    points = points[rng.choice(len(points), min(checked, len(points)), replace=False)]
    error = surrogate.log_density_error(points)
    if error > DENSITY_ERROR_LIMIT or not enough:
        return _exact(task, posterior.log_density, laplace, starts)
    return Sampling(run._replace(log_density_error=error, checked=len(points)), name)


def gaussian_draws(mode: Mode, *, chains: int, rng: np.random.Generator) -> Sampling:
    """Draw from the Gaussian about the mode, which the posterior of many linear effects is.

    Parameters as by the linearised posterior at the mode's noise, the noise by its own curvature.
    """
    count = chains * FIRST_DRAWS
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
    points = np.concatenate(parts, axis=1).reshape(chains, FIRST_DRAWS, -1)
    return Sampling(
        Chains(points, float('nan'), points, method='laplace', effective=float(count)),
        'Gaussian about the mode',
    )


def _proposed(
    proposal: LaplaceProposal, log_density: LogDensity, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return draws on trial, (n, d), and their log weights, (n,)."""
    points, log_proposal = proposal.sample(TRIAL_DRAWS, rng)
    return points, log_density(points) - log_proposal


def _exact(
    task: _Task,
    log_density: LogDensity,
    laplace: LaplaceProposal,
    starts: FloatArray,
) -> Sampling:
    """Sample by the exact density, with the evaluations that there are.

    Chains of independent proposals are begun only where draws on trial show that enough of them
    would be taken.
    """
    chains, rng = len(starts), task.rng
    weighted = _by_conditional(task, log_density, laplace.mode)
    how = 'effects drawn given the other parameters and the noise'
    if weighted is None:
        worth = 1.0
        if task.evaluations >= TRIALS * TRIAL_DRAWS:
            trial = Weighted.of(*_proposed(laplace, log_density, rng.spawn(1)[0]), laplace)
            worth = trial.effective / TRIAL_DRAWS
        if worth >= HOPELESS_WEIGHTS:
            most = int(CHAINS_SHARE * task.evaluations) // chains
            run, enough = task.independent(log_density, laplace, starts, most)
            if enough:
                return Sampling(
                    run,
                    'independence Metropolis-Hastings on the exact density, Laplace proposal '
                    '(the density is not near enough to its second order)',
                )
        weighted = task.weighted(log_density, laplace)
        how = 'chains of independent proposals are worth too few draws'
    if weighted.reliable and weighted.effective >= task.enough:
        return Sampling(
            task.by_weights(weighted, chains),
            f'importance sampling, proposal adapted to the weighted draws ({how})',
        )

    # All walks go on side by side: a batch of many costs hardly more than a few.
    walks = WALKS if task.draws is None else chains
    most = task.evaluations // (walks * WALK_STEPS_PER_DRAW) if task.draws is None else task.draws
    if most >= FIRST_DRAWS or task.draws is not None:
        start = weighted.resampled(walks, rng)
        factor = weighted.factor()
        run, enough = task.walk(
            log_density, step_scale(log_density, factor, start, rng) * factor, start, most
        )
        if enough:
            return Sampling(
                run, 'random-walk Metropolis (too few independent proposals were taken)'
            )
    if weighted.effective >= FEWEST_EFFECTIVE:
        return Sampling(
            task.by_weights(weighted, chains),
            'importance sampling (no sampler reached the precision with the evaluations allowed)',
        )
    points = laplace.sample(chains * FIRST_DRAWS, rng)[0].reshape(chains, FIRST_DRAWS, -1)
    return Sampling(
        Chains(
            points,
            float('nan'),
            points,
            method='laplace',
            pareto_k=weighted.pareto_k,
            effective=weighted.effective,
        ),
        'Gaussian about the mode (no sampler reached the precision with the evaluations allowed)',
    )


def _by_conditional(task: _Task, log_density: LogDensity, mode: Mode) -> Weighted | None:
    """Return weighted draws with the effects given the rest; None where that cannot be done."""
    try:
        conditional = ConditionalProposal.of(mode)
        return None if conditional is None else task.weighted(log_density, conditional)
    except np.linalg.LinAlgError:
        # Far out rounding may leave nothing that determines an effect.
        return None


@dataclass(frozen=True)
class _Task:
    """How long to sample, and what is the same for every sampler; see `sample_posterior`.

    ``evaluations`` of the exact density are allowed in all.
    """

    draws: int | None
    precision: float
    quantities: Callable[[FloatArray], FloatArray]
    rng: np.random.Generator
    report: Progress
    evaluations: int

    @property
    def wanted(self) -> float:
        """Effective draws that the precision takes."""
        return self.precision**-2

    @property
    def enough(self) -> float:
        """Effective draws without which another sampler is tried."""
        return min(self.wanted, ESS_LIMIT)

    def weighted(self, log_density: LogDensity, proposal: Adaptable) -> Weighted:
        """Return draws of a proposal that is adapted, with their weights."""
        return adaptive_importance(
            log_density,
            proposal,
            wanted=self.wanted,
            evaluations=int(IMPORTANCE_SHARE * self.evaluations),
            rng=self.rng,
            progress=lambda share: self.report('adapting the sampler', share),
        )

    def by_weights(self, weighted: Weighted, chains: int) -> Chains:
        """Return weighted draws as draws of equal weight, in as many parts as there are chains."""
        draws = self.draws
        if draws is None:
            draws = max(FIRST_DRAWS, int(np.ceil(weighted.effective / chains)))
        points = weighted.resampled(chains * draws, self.rng).reshape(chains, draws, -1)
        return Chains(
            points,
            float('nan'),
            points,
            method='importance',
            pareto_k=weighted.pareto_k,
            effective=weighted.effective,
        )

    def independent(
        self, target: LogDensity, proposal: Proposal, start: FloatArray, most: int = ALLOWANCE
    ) -> tuple[Chains, bool]:
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

        return self._long_enough(more, start, most, poor=POOR_ACCEPTANCE)

    def walk(
        self, target: LogDensity, factor: FloatArray, start: FloatArray, most: int
    ) -> tuple[Chains, bool]:
        """Sample by a random walk with steps of this factor, (d, d)."""

        def more(start: FloatArray, draws: int, warm_up: int) -> Chains:
            return random_walk_sampler(
                target,
                gaussian_step(factor, len(start)),
                start=start,
                steps=(draws + warm_up) * WALK_STEPS_PER_DRAW,
                burn_in=warm_up * WALK_STEPS_PER_DRAW,
                rng=self.rng,
                thin=WALK_STEPS_PER_DRAW,
                trace_every=WALK_STEPS_PER_DRAW,
                progress=lambda share: self.report('sampling by random walk', share),
            )

        return self._long_enough(more, start, most, first=FIRST_WALKED, warm_up=WALK_WARM_UP)

    def _long_enough(
        self,
        more: Callable[[FloatArray, int, int], Chains],
        start: FloatArray,
        most: int,
        *,
        poor: float = 0.0,
        first: int = FIRST_DRAWS,
        warm_up: int = WARM_UP,
    ) -> tuple[Chains, bool]:
        """Sample in batches until the length is reached, and return whether that is enough.

        ``more`` continues from a state: (start, draws, warm-up) to chains, which begins with
        ``first`` draws. Chains with a poor acceptance are given up, as are those that ``most``
        draws each will not make long enough.
        """
        most = max(first, min(most, ALLOWANCE, LARGEST_CHAINS // start.size))
        run = more(start, self.draws or first, warm_up)
        if self.draws is not None:
            return run, run.acceptance_rate >= poor
        while run.acceptance_rate >= poor:
            count = run.draws.shape[1]
            values = self.quantities(run.draws)
            bulk, tail = convergence.ess_bulk(values), convergence.ess_tail(values)
            # What never moves has no effective draws.
            least = max(1.0, float(np.min(np.nan_to_num(np.minimum(bulk, tail)))))
            if least >= self.wanted or count >= most:
                r_hat = convergence.r_hat(values)
                mixed = np.max(r_hat) <= R_HAT_LIMIT
                if mixed or count >= most:
                    run = run._replace(figures=(r_hat, bulk, tail))
                    return run, bool(mixed and least >= self.enough)
            if count * self.enough / least > HOPELESS * most:
                break
            # A tenth more than the rate so far promises, but no more than three times as many.
            expected = 1.1 * count * self.wanted / least
            batch = int(np.clip(expected - count, count // 4, 3 * count))
            part = more(run.draws[:, -1], min(batch, most - count), 0)
            added = part.draws.shape[1]
            run = Chains(
                np.concatenate((run.draws, part.draws), axis=1),
                (run.acceptance_rate * count + part.acceptance_rate * added) / (count + added),
                np.concatenate((run.trace, part.trace[:, -added:]), axis=1),
            )
        return run, False
