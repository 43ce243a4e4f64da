"""The second-order density against the exact one, and the sampler that rests on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import scene
from scipy.stats import ks_2samp

from remaster_ros.calibration import sampling
from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.laplace import find_mode
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.calibration.proposal import LaplaceProposal
from remaster_ros.calibration.sampling import sample_posterior
from remaster_ros.calibration.surrogate import Surrogate, bent_pairs, second_derivatives


@pytest.fixture(scope='module')
def found():
    return estimate(Problem.of(scene(41, poses=12, sensor_count=2)[0]))


def test_second_derivatives_are_those_of_the_prediction(found) -> None:
    """Against differences of the first ones, at a point well away from the reference."""
    model, rows = found.model, found.posterior.rows
    z = found.mode.z + 0.05 * np.random.default_rng(1).standard_normal(model.size)
    pairs = bent_pairs(model, np.arange(model.size))
    bent = second_derivatives(model, z, rows, pairs)
    step = 1e-5
    for i in range(model.size):
        unit = step * np.eye(model.size)[i]
        numerical = (model.jacobian(z + unit, rows) - model.jacobian(z - unit, rows)) / (2 * step)
        for j in range(i, model.size):
            expected = numerical[:, :, j] * (0.5 if i == j else 1.0)
            at = [place for place, pair in enumerate(pairs) if sorted(pair) == [i, j]]
            ours = bent[:, :, at[0]] if at else np.zeros_like(expected)
            np.testing.assert_allclose(ours, expected, atol=2e-7)


@pytest.mark.parametrize('kind', ['two sensors', 'five poses', 'line of sight'])
def test_density_is_the_exact_one_where_it_matters(kind: str) -> None:
    """Centred difference on proposals, which go further than the posterior."""
    options = {'poses': 5, 'pose_sigma_m': 0.0} if kind == 'five poses' else {'poses': 12}
    sensors = 2 if kind == 'two sensors' else 1
    found = estimate(Problem.of(scene(42, sensor_count=sensors, **options)[0]))
    mode = found.mode
    if kind == 'line of sight':
        p = found.posterior
        split = type(p).of(p.model, p.rows, p.priors, p.free, mode.z, split=(0,))
        mode = find_mode(split)
    points, _ = LaplaceProposal(mode).sample(500, np.random.default_rng(2))
    surrogate = Surrogate.of(mode)
    difference = surrogate.log_density(points) - mode.linearisation.posterior.log_density(points)
    difference = np.abs(difference - np.median(difference))
    assert np.quantile(difference, 0.99) < 0.01
    assert surrogate.log_density_error(points) == pytest.approx(difference.max())


def test_an_expansion_that_is_too_rough_is_replaced_by_the_exact_density(
    found, monkeypatch
) -> None:
    usual = sample_posterior(found.mode, chains=4, draws=300, rng=np.random.default_rng(3))
    assert usual.run.checked == sampling.CHECKED_DRAWS
    assert 0.0 < usual.run.log_density_error < sampling.DENSITY_ERROR_LIMIT
    monkeypatch.setattr(sampling, 'DENSITY_ERROR_LIMIT', 0.0)
    exact = sample_posterior(found.mode, chains=4, draws=300, rng=np.random.default_rng(3))
    assert 'exact density' in exact.name
    assert exact.run.checked == 0
    assert np.isnan(exact.run.log_density_error)
    a, b = (s.run.draws.reshape(-1, found.posterior.size) for s in (usual, exact))
    # 1,000 effective draws each; 1 in 1,000 over all parameters.
    for index in range(found.posterior.size):
        assert ks_2samp(a[::3, index], b[::3, index]).pvalue > 1e-3 / found.posterior.size


def test_proposals_fit_a_pose_sigma_that_is_surely_zero() -> None:
    """Rows of a pose that differ more than poses do: the density falls steeply from zero."""
    session, _ = scene(44, poses=40, pose_sigma_m=0.0)
    found = estimate(Problem.of(session))
    rows = found.posterior.rows
    # Take most of each pose's mean error away.
    errors = rows.target - found.model.predict(found.mode.z, rows)
    means = rows.group_sum(errors) / rows.group_size[:, None]
    calmer = replace(rows, target=rows.target - 0.8 * means[rows.group_of_row])
    posterior = found.posterior
    mode = find_mode(
        Posterior.of(found.model, calmer, posterior.priors, posterior.free, posterior.reference)
    )
    assert mode.eta[-1] < 0.01
    sampled = sample_posterior(mode, chains=4, draws=500, rng=np.random.default_rng(7))
    assert sampled.run.acceptance_rate > 0.5


def test_sampling_goes_on_until_the_precision_is_reached() -> None:
    """Every mean is as near to that of a run many times as long as the precision promises."""
    session, _ = scene(43, poses=12)
    mode = estimate(Problem.of(session)).mode
    size = mode.linearisation.posterior.size
    long = sample_posterior(mode, chains=4, draws=10_000, rng=np.random.default_rng(50)).run.draws
    long = long.reshape(-1, size)
    lengths = []
    for precision in (0.02, 0.012):
        rng = np.random.default_rng(5)
        run, _ = sample_posterior(mode, chains=4, precision=precision, rng=rng)
        error = (run.draws.reshape(-1, size).mean(axis=0) - long.mean(axis=0)) / long.std(axis=0)
        # A normal number is beyond 3.9 in 1 of 10,000 cases.
        assert np.abs(error).max() < 3.9 * precision
        info = fit_session(session, rng=np.random.default_rng(5), precision=precision).sampler
        assert info.converged
        assert info.message.startswith('converged')
        assert info.precision <= info.precision_wanted == precision
        lengths.append(info.draws)
    assert lengths[1] > lengths[0]


def test_a_precision_that_is_not_reached_is_reported(monkeypatch) -> None:
    monkeypatch.setattr(sampling, 'ALLOWANCE', 900)
    session, _ = scene(43, poses=12)
    result = fit_session(session, rng=np.random.default_rng(6), precision=0.005)
    assert not result.sampler.converged
    assert result.sampler.draws == 900
    assert result.sampler.message.startswith('NOT converged within 900 draws a chain')
    assert '0.5 % wanted' in result.sampler.message
