"""Importance sampling with its own check: Pareto-smoothed weights, the proposal adapted in rounds.

Independent draws of a proposal, weighted by density over proposal, have the moments of the density
whatever the proposal, if the weights have a variance. Their largest ones are smoothed by a Pareto
distribution; its shape k tells whether they can be relied on, below 0.7 (Vehtari, Simpson, Gelman,
Yao and Gabry 2024, "Pareto smoothed importance sampling", JMLR 25(72); as arviz-stats has it).
Where the proposal is poor its mean and covariance are moved to those of the weighted draws
(population Monte Carlo; Cappé, Guillin, Marin and Robert 2004, doi:10.1198/106186004X12803).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from remaster_ros.calibration.convergence import PARETO_LIMIT
from remaster_ros.calibration.metropolis import LogDensity, Proposal
from remaster_ros.calibration.proposal import ADAPTED_FREEDOM, StudentT
from remaster_ros.types import FloatArray

# Below this one the proposal is not adapted further.
GOOD_SHAPE = 0.5
ROUNDS = 8
FEWEST_DRAWS, MOST_DRAWS = 1000, 4000
# Share of the evaluations that all of the rounds may take.
ADAPTING = 0.5
# Effective draws that moments take for each dimension. Where that is more than this share of the
# draws nothing is adapted.
DRAWS_PER_DIMENSION = 5.0
LARGEST_NEED = 0.25
# Where nothing can be adapted and draws are worth less than this share, more of them are no use.
HOPELESS = 0.01
# Of the weights, tried one after the other.
POWERS = 0.7 ** np.arange(1.0, 25.0)


class Adaptable(Proposal, Protocol):
    """A proposal that can be moved to where the density is."""

    @property
    def dimension(self) -> int:
        """Of what is adapted."""
        ...

    @property
    def first_draws(self) -> int:
        """So many draws tell whether it has to be adapted."""
        ...

    @property
    def cost(self) -> float:
        """Of a draw, in evaluations of a density."""
        ...

    def adapted(self, points: FloatArray, weight: FloatArray) -> Adaptable:
        """Return a proposal with the moments of weighted points (n, d)."""
        ...


class Weighted(NamedTuple):
    """Draws of a proposal with their weights.

    Attributes
    ----------
    points
        (n, d).
    log_weight
        Log density over proposal, (n,).
    weight
        Smoothed, with sum 1, (n,).
    pareto_k
        Shape of their upper tail.
    proposal
        What they were drawn from.
    """

    points: FloatArray
    log_weight: FloatArray
    weight: FloatArray
    pareto_k: float
    proposal: Adaptable

    @classmethod
    def of(cls, points: FloatArray, log_weight: FloatArray, proposal: Adaptable) -> Weighted:
        """Smooth the weights."""
        from arviz_stats.base import array_stats

        finite = np.isfinite(log_weight)
        # Draws where there is no density count for nothing.
        least = np.min(log_weight[finite], initial=0.0) - 100.0
        log_weight = np.where(finite, log_weight, least)
        # arviz-stats smooths the weights 1 / likelihood of a left-out observation: the sign turns.
        smoothed, pareto_k = array_stats.psislw(-log_weight)
        weight = np.exp(smoothed - np.max(smoothed))
        return cls(points, log_weight, weight / weight.sum(), float(pareto_k), proposal)

    @property
    def effective(self) -> float:
        """What number of independent draws they are worth."""
        return _effective(self.weight)

    @property
    def reliable(self) -> bool:
        """Whether the weights' tail passes its check."""
        return self.pareto_k < PARETO_LIMIT

    def with_draws(self, points: FloatArray, log_weight: FloatArray) -> Weighted:
        """Return these and further draws of the same proposal, smoothed together."""
        return Weighted.of(
            np.concatenate((self.points, points)),
            np.concatenate((self.log_weight, log_weight)),
            self.proposal,
        )

    def adapted(self) -> Adaptable:
        """Return a proposal nearer to the density: with the moments of the weighted draws."""
        return self.proposal.adapted(self.points, self._with_moments(self.proposal.dimension))

    def factor(self) -> FloatArray:
        """Return a Cholesky factor of the weighted draws' covariance, (d, d)."""
        weight = self._with_moments(self.points.shape[1])
        return StudentT.of(self.points, weight, ADAPTED_FREEDOM).factor

    def _with_moments(self, dimension: int) -> FloatArray:
        """Return the weights, (n,).

        Where the draws are worth too few to have moments the weights are raised to a power below
        1, which leads part of the way.
        """
        weight = self.weight
        for power in POWERS:
            if _effective(weight) >= DRAWS_PER_DIMENSION * dimension:
                break
            weight = np.exp(power * (self.log_weight - np.max(self.log_weight)))
            weight /= weight.sum()
        return weight

    def resampled(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return draws of equal weight in random order, (count, d) (systematic resampling)."""
        places = (np.arange(count) + rng.random()) / count
        chosen = np.searchsorted(np.cumsum(self.weight), places)
        points: FloatArray = self.points[rng.permutation(np.minimum(chosen, len(self.weight) - 1))]
        return points


def adaptive_importance(
    log_density: LogDensity,
    proposal: Adaptable,
    *,
    wanted: float,
    evaluations: int,
    rng: np.random.Generator,
    progress: Callable[[float], None],
) -> Weighted:
    """Draw from the best of several proposals until the weighted draws are worth what is wanted.

    Parameters
    ----------
    log_density
        Points (n, d) to log density (n,), up to a constant.
    proposal
        To begin with.
    wanted
        Effective draws.
    evaluations
        Of the density, at most; a draw of the proposal is counted as its `cost` of them.
    rng
        Source of all randomness.
    progress
        Called with the share of the evaluations done.
    """
    spent = 0
    evaluations = max(FEWEST_DRAWS, int(evaluations / proposal.cost))

    def drawn(source: Adaptable, count: int) -> tuple[FloatArray, FloatArray]:
        nonlocal spent
        points, log_proposal = source.sample(count, rng)
        log_weight = log_density(points) - log_proposal
        spent += count
        progress(min(1.0, spent / evaluations))
        return points, log_weight

    def enough(weighted: Weighted) -> Weighted:
        while weighted.reliable and weighted.effective < wanted and spent < evaluations:
            # A tenth more than the rate so far promises.
            missing = len(weighted.points) * (1.1 * wanted / weighted.effective - 1.0)
            further = int(np.clip(missing, count // 4, evaluations - spent + 1))
            weighted = weighted.with_draws(*drawn(weighted.proposal, further))
        return weighted

    count = int(np.clip(ADAPTING * evaluations / ROUNDS, FEWEST_DRAWS, MOST_DRAWS))
    adaptable = DRAWS_PER_DIMENSION * proposal.dimension <= LARGEST_NEED * count
    first = min(count, proposal.first_draws)
    best = last = Weighted.of(
        *drawn(proposal, first if adaptable else min(first, FEWEST_DRAWS)), proposal
    )
    if len(best.points) < first and best.effective >= HOPELESS * len(best.points):
        best = last = best.with_draws(*drawn(proposal, first - len(best.points)))
    for _ in range(ROUNDS - 1):
        if best.pareto_k < GOOD_SHAPE:
            best = last = enough(best)
            if best.reliable:
                break
            # More draws have shown a longer tail: they tell better how to adapt.
        if not adaptable or spent >= ADAPTING * evaluations:
            break
        proposal = last.adapted()
        last = Weighted.of(*drawn(proposal, count), proposal)
        best = min(best, last, key=lambda weighted: weighted.pareto_k)
    return enough(best)


def _effective(weight: FloatArray) -> float:
    """Return what number of independent draws weights with sum 1 are worth (Kish 1965)."""
    return float(1.0 / np.sum(weight**2))
