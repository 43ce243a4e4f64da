"""Importance sampling: right where its check passes, and a check that fails where it should."""

from __future__ import annotations

import numpy as np
import pytest

from remaster_ros.calibration.convergence import PARETO_LIMIT
from remaster_ros.calibration.importance import Weighted, adaptive_importance
from remaster_ros.calibration.proposal import StudentT
from remaster_ros.types import FloatArray

MEAN = np.array([1.0, -2.0, 0.5])
FACTOR = np.array([[1.0, 0.0, 0.0], [0.9, 0.3, 0.0], [0.0, 0.2, 2.0]])


def gaussian(points: FloatArray) -> FloatArray:
    whitened = np.linalg.solve(FACTOR, (points - MEAN).T)
    return -0.5 * np.sum(whitened**2, axis=0)


def drawn(proposal: StudentT, wanted: float = 2000.0, evaluations: int = 100_000) -> Weighted:
    return adaptive_importance(
        gaussian,
        proposal,
        wanted=wanted,
        evaluations=evaluations,
        rng=np.random.default_rng(1),
        progress=lambda share: None,
    )


@pytest.mark.parametrize('off', [0.0, 8.0])
def test_weighted_draws_have_the_moments_of_the_target(off: float) -> None:
    """Also from a proposal eight standard deviations away and three times too narrow."""
    found = drawn(StudentT(MEAN + off, 0.3 * np.eye(3), 15.0))
    assert found.reliable
    assert found.effective >= 2000.0
    points = found.resampled(4000, np.random.default_rng(2))
    # 2,000 effective draws: five standard errors.
    error = np.abs(points.mean(axis=0) - MEAN) / np.linalg.norm(FACTOR, axis=1)
    assert np.max(error) < 5.0 / np.sqrt(2000.0)
    np.testing.assert_allclose(np.cov(points.T), FACTOR @ FACTOR.T, atol=0.5)


def test_the_check_fails_where_the_proposal_misses_the_tails() -> None:
    """A tenth as wide as the target: every weight that counts lies in the tail."""
    proposal = StudentT(MEAN, 0.1 * FACTOR, 1000.0)
    points, log_proposal = proposal.sample(4000, np.random.default_rng(3))
    found = Weighted.of(points, gaussian(points) - log_proposal, proposal)
    assert found.pareto_k > PARETO_LIMIT
    assert not found.reliable


class LongTailed:
    """Draws are their own log weights: harmless at first, with a long tail from then on."""

    dimension, first_draws, cost = 1, 1000, 1.0

    def __init__(self, *, better: bool = False) -> None:
        self.better, self.asked = better, 0

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        self.asked += 1
        harmless = self.better or self.asked == 1
        weight = 0.3 * rng.standard_normal(count) if harmless else np.log(rng.pareto(0.8, count))
        return weight[:, None], np.zeros(count)

    def log_density(self, points: FloatArray) -> FloatArray:
        return np.zeros(len(points))

    def adapted(self, points: FloatArray, weight: FloatArray) -> LongTailed:
        return LongTailed(better=True)


def test_a_tail_that_only_more_draws_show_is_adapted_to() -> None:
    found = adaptive_importance(
        lambda points: points[:, 0],
        LongTailed(),
        wanted=3000.0,
        evaluations=100_000,
        rng=np.random.default_rng(4),
        progress=lambda share: None,
    )
    assert found.proposal.better
    assert found.reliable
    assert found.effective >= 3000.0


class OfManyParameters(LongTailed):
    """More than moments of some thousand draws can be had of: nothing is adapted."""

    dimension, first_draws = 400, 4000

    def __init__(self, spread: float) -> None:
        self.spread = spread

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        return self.spread * rng.standard_normal((count, 1)), np.zeros(count)


@pytest.mark.parametrize(('spread', 'more'), [(5.0, False), (1.6, True)])
def test_hopeless_draws_are_not_multiplied_where_nothing_can_be_adapted(spread, more) -> None:
    found = adaptive_importance(
        lambda points: points[:, 0],
        OfManyParameters(spread),
        wanted=1e5,
        evaluations=100_000,
        rng=np.random.default_rng(4),
        progress=lambda share: None,
    )
    print('effective', found.effective, 'Pareto k', found.pareto_k)
    assert (len(found.points) == 1000) != more
    assert (len(found.points) >= 4000) == more


def test_evaluations_are_limited_and_counted() -> None:
    count = 0

    def counted(points: FloatArray) -> FloatArray:
        nonlocal count
        count += len(points)
        return gaussian(points)

    adaptive_importance(
        counted,
        StudentT(MEAN, FACTOR, 15.0),
        wanted=1e9,
        evaluations=5000,
        rng=np.random.default_rng(4),
        progress=lambda share: None,
    )
    assert 5000 <= count < 5100


def test_draws_where_there_is_no_density_count_for_nothing() -> None:
    proposal = StudentT(MEAN, FACTOR, 15.0)
    points, log_proposal = proposal.sample(2000, np.random.default_rng(5))
    inside = points[:, 0] > 1.0
    log_weight = np.where(inside, gaussian(points) - log_proposal, -np.inf)
    found = Weighted.of(points, log_weight, proposal)
    assert found.weight[~inside].sum() < 1e-12
    assert np.all(found.resampled(500, np.random.default_rng(6))[:, 0] > 1.0)
