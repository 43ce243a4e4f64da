# SPDX-License-Identifier: Apache-2.0
"""The samplers on targets that are known exactly; SciPy is the judge.

KS tests run on draws thinned to independence, with fixed seeds: a correct sampler fails one with
another seed in 1,000.
"""

import numpy as np
import pytest
from scipy import stats

from remaster_ros.calibration.convergence import ess_bulk
from remaster_ros.calibration.metropolis import (
    _states_of_chain,
    independence_sampler,
    random_walk_sampler,
)
from remaster_ros.calibration.proposal import StudentT

COVARIANCE = np.array([[2.0, 0.9], [0.9, 1.0]])


def bent(points: np.ndarray) -> np.ndarray:
    """Log density of (u, v): u gamma with shape 3, v normal about u."""
    u, v = points[..., 0], points[..., 1]
    with np.errstate(invalid='ignore', divide='ignore'):
        value = 2.0 * np.log(u) - u - 0.5 * (v - u) ** 2
    return np.where(u > 0.0, value, -np.inf)


def check_bent(draws: np.ndarray) -> None:
    u, v = draws[..., 0].ravel(), draws[..., 1].ravel()
    size = float(np.min(ess_bulk(draws)))
    assert size > 1000
    # Mean 3, variances 3 and 4; four standard errors.
    assert u.mean() == pytest.approx(3.0, abs=4.0 * np.sqrt(3.0 / size))
    assert v.mean() == pytest.approx(3.0, abs=4.0 * np.sqrt(4.0 / size))
    assert v.std() == pytest.approx(2.0, rel=4.0 / np.sqrt(size))
    thin = int(np.ceil(2.0 * u.size / size))
    assert stats.kstest(u[::thin], stats.gamma(3.0).cdf).pvalue > 1e-3
    assert stats.kstest((v - u)[::thin], stats.norm.cdf).pvalue > 1e-3


def test_student_t_is_scipys() -> None:
    rng = np.random.default_rng(1)
    ours = StudentT(np.array([1.0, -2.0]), np.linalg.cholesky(COVARIANCE), 4.0)
    judge = stats.multivariate_t([1.0, -2.0], COVARIANCE, df=4.0)
    points, density = ours.sample(2000, rng)
    np.testing.assert_allclose(density, judge.logpdf(points))
    squares = np.sum(np.linalg.solve(ours.factor, (points - ours.mean).T) ** 2, axis=0)
    assert stats.kstest(squares / 2.0, stats.f(2, 4.0).cdf).pvalue > 1e-3


@pytest.mark.parametrize('share', [0.02, 0.5, 0.98])
def test_walk_is_hastings_rule_step_by_step(share: float) -> None:
    """Against the rule as it is written; a share of the proposals has no density at all."""
    rng = np.random.default_rng(11)
    for length in (1, 2, 50, 500):
        for current in (-np.inf, 0.3):
            weight = np.where(rng.random(length) < share, -np.inf, rng.standard_normal(length))
            uniform = np.log(rng.random(length))
            here, log_density, path = -1, current, []
            for step in range(length):
                # A state without density is left for any that has one.
                nowhere = np.isneginf(weight[step])
                if not nowhere and uniform[step] < weight[step] - log_density:
                    here, log_density = step, weight[step]
                path.append(here)
            assert _states_of_chain(weight, uniform, current) == path


def independent(density, proposal, start, draws: int, seed: int, warm_up: int = 0):
    rng = np.random.default_rng(seed)
    return independence_sampler(
        density, proposal, draws=draws, warm_up=warm_up, rng=rng, start=start
    )


def test_independent_proposals_sample_a_skewed_target() -> None:
    proposal = StudentT(np.array([3.0, 3.0]), np.linalg.cholesky([[4.0, 4.0], [4.0, 6.0]]), 3.0)
    run = independent(bent, proposal, np.full((4, 2), 30.0), draws=3000, seed=2, warm_up=100)
    assert run.draws.shape == (4, 3000, 2)
    assert run.trace.shape == (4, 3100, 2)
    assert 0.3 < run.acceptance_rate < 0.9
    check_bent(run.draws)


def test_a_proposal_equal_to_the_target_is_always_taken() -> None:
    target = StudentT(np.zeros(3), np.eye(3), 5.0)
    run = independent(target.log_density, target, np.zeros((2, 3)), draws=500, seed=3)
    assert run.acceptance_rate == 1.0


def test_a_rejected_proposal_repeats_the_state() -> None:
    """Where the target is a needle hardly anything is taken, and nothing else is recorded."""
    proposal = StudentT(np.zeros(1), np.eye(1), 5.0)

    def needle(points: np.ndarray) -> np.ndarray:
        return -0.5 * (points[:, 0] / 0.01) ** 2

    run = independent(needle, proposal, np.zeros((2, 1)), draws=400, seed=4)
    moved = np.diff(run.draws[..., 0], axis=1) != 0.0
    assert 0.0 < run.acceptance_rate < 0.2
    assert moved.mean() == pytest.approx(run.acceptance_rate, abs=0.01)


def test_a_random_walk_samples_the_same_target() -> None:
    shares: list[float] = []
    run = random_walk_sampler(
        bent,
        lambda rng: 2.0 * rng.standard_normal((8, 2)),
        start=np.full((8, 2), 1.0),
        steps=6000,
        burn_in=500,
        rng=np.random.default_rng(5),
        trace_every=60,
        progress=shares.append,
    )
    assert run.draws.shape == (8, 5500, 2)
    assert run.trace.shape == (8, 101, 2)
    np.testing.assert_array_equal(run.trace[:, 0], np.full((8, 2), 1.0))
    check_bent(run.draws)
    np.testing.assert_allclose(shares, np.arange(1, 101) / 100)
