# SPDX-License-Identifier: Apache-2.0
"""The log density against SciPy's, and the linear approximation against the exact density."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest, multivariate_normal, norm
from worlds.calibration_scenes import one_tool_direction, scene

from remaster_ros.calibration import convergence, laplace, sampling
from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.laplace import find_mode
from remaster_ros.calibration.linearisation import linearise
from remaster_ros.calibration.metropolis import random_walk_sampler
from remaster_ros.calibration.noise import RESOLUTION_M
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.calibration.priors import base_prior, marker_prior
from remaster_ros.calibration.proposal import AdaptedProposal, StudentT, Weighted
from remaster_ros.calibration.sampling import sample_posterior
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.transforms import quaternion_xyzw
from remaster_ros.types import BasePrior, FloatArray, Session


@pytest.fixture(scope='module')
def found():
    return estimate(Problem.of(scene(11, poses=12, sensor_count=2)[0]))


def test_density_is_that_of_correlated_normal_errors(found) -> None:
    """The whole covariance matrix of every sensor's errors, written out."""
    posterior, model = found.posterior, found.model
    rng = np.random.default_rng(1)
    points, _ = AdaptedProposal.about(found.mode).sample(6, rng)
    expected = []
    for point in points:
        noise = posterior.noise(point[len(posterior.free) :])
        sigma, pose_sigma = noise.sigma, noise.pose_sigma
        z = posterior.parameters(point)
        errors = posterior.rows.target - model.predict(z, posterior.rows)
        value = 0.0
        group = posterior.rows.group_of_row
        for sensor, span in posterior.rows.spans:
            same = group[span, None] == group[None, span]
            covariance = sigma[sensor] ** 2 * np.eye(same.shape[0])
            covariance += pose_sigma[sensor] ** 2 * same
            for axis in range(3):
                value += multivariate_normal(cov=covariance).logpdf(errors[span, axis])
            # Flat in log sigma above the resolution; half-Cauchy ratio with d ratio / d asinh.
            ratio = pose_sigma[sensor] / sigma[sensor]
            value += -0.5 * (RESOLUTION_M / sigma[sensor]) ** 2
            value += -np.log1p(ratio**2) + 0.5 * np.log1p(ratio**2)
        x = model.natural(z)
        for index, nominal in enumerate(found.problem.markers):
            value += multivariate_normal(nominal, 0.25e-6 * np.eye(3)).logpdf(
                x[model.marker(index)]
            )
        # Five degrees for each offset that the gauge does not hold.
        for joint in posterior.free[posterior.free < model.joints]:
            value += norm(0.0, np.radians(5.0)).logpdf(x[joint])
        expected.append(value)
    ours = posterior.log_density(points)
    np.testing.assert_allclose(ours - ours[0], np.array(expected) - expected[0], atol=1e-6)


def test_negative_ratios_have_no_density(found) -> None:
    point, _ = AdaptedProposal.about(found.mode).sample(1, np.random.default_rng(1))
    point[0, -1] *= -1.0
    assert found.posterior.log_density(point)[0] == -np.inf


def test_linearised_posterior_is_nearly_the_exact_one(found) -> None:
    """Conditional times marginal equals the density but for a constant, near the mode."""
    proposal = AdaptedProposal.about(found.mode)
    points, _ = proposal.sample(200, np.random.default_rng(2))
    f = len(found.posterior.free)
    mean, factor, marginal = found.mode.linearisation.conditional(points[:, f:])
    whitened = np.einsum('nji,nj->ni', factor, points[:, :f] - mean)
    log_root = np.sum(np.log(np.diagonal(factor, axis1=-2, axis2=-1)), axis=-1)
    linear = marginal - 0.5 * np.sum(whitened**2, axis=1) + log_root
    difference = found.posterior.log_density(points) - linear
    assert np.std(difference) < 0.05


def test_proposal_reports_the_density_it_samples_from(found) -> None:
    """Also of the shared parts of the noise, which are folded at zero: it has the integral 1."""
    proposal = AdaptedProposal.about(found.mode)
    points, density = proposal.sample(4000, np.random.default_rng(3))
    np.testing.assert_allclose(proposal.log_density(points), density)
    assert np.all(points[:, -2:] >= 0.0)
    # Of two of them the mean ratio over draws of one is 1, to five standard errors.
    even = Weighted(points, np.zeros(len(points)), np.full(len(points), 1 / len(points)), 0.0)
    other = proposal.adapted(even)
    points, density = proposal.sample(4000, np.random.default_rng(5))
    ratio = np.exp(other.log_density(points) - density)
    assert abs(ratio.mean() - 1.0) < 5.0 * ratio.std() / np.sqrt(len(ratio))


def test_mode_is_where_the_exact_density_peaks(found) -> None:
    """Given the noise: every step of half a standard deviation lowers the density."""
    posterior, mode = found.posterior, found.mode
    top = np.concatenate((mode.z[posterior.free], mode.eta))
    value = posterior.log_density(top[None])[0]
    width = np.sqrt(np.diag(mode.covariance))
    for index, std in enumerate(width):
        for sign in (0.5, -0.5):
            moved_point = top.copy()
            moved_point[index] += sign * std
            assert posterior.log_density(moved_point[None])[0] < value


@pytest.mark.parametrize('along', [(), (0,)])
def test_the_density_of_the_noise_depends_on_each_variance_as_is_said(found, along) -> None:
    """Against differences; two sensors, and one with a noise along its line of sight."""
    p = found.posterior
    split = type(p).of(p.model, p.rows, p.priors, p.free, found.mode.z, split=along)
    eta = find_mode(split).eta + 0.2
    linearisation = linearise(split, found.mode.z)
    _, slope, _ = linearisation.by_variances(eta)
    of_groups = split.variances(eta)

    class Scaled:
        """The posterior with the variance of each error group times exp(logs)."""

        def __init__(self, logs):
            self.logs = logs

        def __getattr__(self, name):
            return getattr(split, name)

        def variances(self, _):
            return of_groups * np.exp(self.logs)

    step = 1e-4
    for group in range(len(of_groups)):
        unit = step * np.eye(len(of_groups))[group]
        values = [
            replace(linearisation, posterior=Scaled(sign * unit)).whitened(eta)[2]
            for sign in (1.0, -1.0)
        ]
        assert slope[group] == pytest.approx((values[0] - values[1]) / (2.0 * step), abs=1e-4)


def test_a_search_of_the_noise_that_begins_at_zero_does_not_stay_there(found) -> None:
    """The density is even in a ratio: it has no slope at zero, where it may well be lowest."""
    begun = found.mode.eta.copy()
    begun[2:] = 0.0
    assert np.all(found.mode.eta[2:] > 0.5)
    again = find_mode(found.posterior, replace(found.mode, eta=begun))
    np.testing.assert_allclose(again.eta, found.mode.eta, atol=1e-3)


@pytest.mark.parametrize('seed', [60, pytest.param(61, marks=pytest.mark.qualify)])
def test_few_poses_do_not_take_long_chains(seed) -> None:
    """Five poses, two sensors, noise by direction: the part common to a pose reaches far up."""
    session, _ = scene(seed, poses=5, sensor_count=2, pose_sigma_m=0.1e-3)
    found = estimate(Problem.of(session))
    p = found.posterior
    mode = find_mode(type(p).of(p.model, p.rows, p.priors, p.free, found.mode.z, split=(0, 1)))
    run, _ = sample_posterior(mode, chains=4, rng=np.random.default_rng(seed))
    assert run.method == 'metropolis'
    # 100,000 did not suffice in such a session.
    assert run.draws.shape[1] < 50_000


def test_what_the_length_is_judged_by_is_what_is_stated() -> None:
    """R-hat and effective draws are computed once, of the draws that are returned."""
    fit = fit_session(scene(60, poses=12)[0], rng=np.random.default_rng(4))
    assert fit.sampler.method == 'metropolis'
    for stated, of in (
        (fit.diagnostics.r_hat, convergence.r_hat),
        (fit.diagnostics.ess_bulk, convergence.ess_bulk),
        (fit.diagnostics.ess_tail, convergence.ess_tail),
    ):
        np.testing.assert_allclose(stated, of(fit.draws), rtol=1e-9)


@pytest.mark.qualify
def test_the_draws_do_not_depend_on_the_proposal() -> None:
    """Independent proposals and a random walk of the same target; KS at 1 in 1,000."""
    # Few rows, noise at zero: as far from Gaussian as a session gets.
    session, _ = scene(12, poses=5, pose_sigma_m=0.0)
    mode = estimate(Problem.of(session)).mode
    rng = np.random.default_rng(4)
    independent, _ = sample_posterior(mode, chains=4, draws=1500, rng=rng)
    posterior = mode.linearisation.posterior
    factor = np.linalg.cholesky(np.cov(independent.draws.reshape(-1, posterior.size).T))
    step = 2.38 / np.sqrt(posterior.size)
    walk = random_walk_sampler(
        posterior.log_density,
        lambda source: step * source.standard_normal((60, posterior.size)) @ factor.T,
        start=independent.draws[:, :15].reshape(60, -1),
        steps=1000,
        burn_in=100,
        rng=rng,
        thin=150,
    )
    for index in range(posterior.size):
        sample = independent.draws[:, ::3, index].ravel()
        assert kstest(sample, walk.draws[..., index].ravel()).pvalue > 1e-3 / posterior.size


def test_poor_proposals_are_adapted() -> None:
    """A mode with the noise three standard deviations off and half as wide."""
    found = estimate(Problem.of(scene(13, poses=8)[0]))
    width = np.sqrt(np.diag(found.mode.eta_covariance))
    narrow = replace(found.mode, eta=found.mode.eta + 3.0 * width)
    # In place of what would be computed when it is asked for.
    vars(narrow)['eta_covariance'] = 0.25 * found.mode.eta_covariance
    run, _ = sample_posterior(narrow, chains=4, draws=1000, rng=np.random.default_rng(5))
    right, _ = sample_posterior(found.mode, chains=4, draws=1000, rng=np.random.default_rng(6))
    ours, theirs = (r.draws.reshape(-1, found.posterior.size) for r in (run, right))
    shift = np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) / theirs.std(axis=0)
    # Some 500 effective draws on either side.
    assert shift.max() < 0.25
    np.testing.assert_allclose(ours.std(axis=0), theirs.std(axis=0), rtol=0.25)


def test_the_linearised_density_gives_the_moments_of_the_exact_one(found, monkeypatch) -> None:
    """A good session of 12 poses, by either; five standard errors of the effective draws."""
    runs = []
    for limit, name in ((sampling.DENSITY_ERROR_LIMIT, 'linearised'), (-1.0, 'exact')):
        monkeypatch.setattr(sampling, 'DENSITY_ERROR_LIMIT', limit)
        run, stated = sample_posterior(found.mode, chains=4, rng=np.random.default_rng(3))
        assert f'on the {name} density' in stated
        runs.append(run.draws.reshape(-1, found.posterior.size))
    shift = np.abs(runs[0].mean(axis=0) - runs[1].mean(axis=0)) / runs[1].std(axis=0)
    assert shift.max() < 5.0 * np.sqrt(2.0 / 2500.0)
    np.testing.assert_allclose(runs[0].std(axis=0), runs[1].std(axis=0), rtol=0.1)


def test_chains_that_cannot_reach_the_precision_leave_the_gaussian_and_a_message(monkeypatch):
    """With too few evaluations: `converged` is false, and what is shown is named."""
    monkeypatch.setattr(sampling, 'EVALUATED_ROWS', 0)
    monkeypatch.setattr(sampling, 'FEWEST_EVALUATIONS', 1200)
    fit = fit_session(scene(60, poses=12)[0], rng=np.random.default_rng(4), precision=0.01)
    assert fit.sampler.method == 'laplace'
    assert not fit.sampler.converged
    assert 'Gaussian about the mode' in fit.sampler.name
    assert 'no chain came to its end' in fit.sampler.message
    assert np.all(np.isfinite(fit.joint_offsets))


@pytest.mark.parametrize('share', [0.0, 0.3])
def test_moments_of_weighted_draws_are_those_of_the_target(share) -> None:
    """Of a Gaussian proposed by a Student t that is off and too narrow by a share."""
    d, rng = 5, np.random.default_rng(8)
    proposal = StudentT(np.full(d, share), (1.2 - share) * np.eye(d), 8.0)
    points, log_proposal = proposal.sample(20_000, rng)
    drawn = Weighted.of(points, -0.5 * np.sum(points**2, axis=1) - log_proposal)
    assert drawn.pareto_k < 0.7
    # Five standard errors of a mean over that many effective draws.
    assert np.max(np.abs(drawn.weight @ points)) < 5.0 / np.sqrt(drawn.effective)


def test_priors_are_standard_normal_in_their_own_units(found) -> None:
    model = found.model
    x = np.zeros(model.size)
    x[model.marker(0)] = [0.101, 0.0, 0.022]
    residual = marker_prior(model, 0, np.array([0.1, 0.0, 0.02]), 1e-3).residual(x)
    np.testing.assert_allclose(residual, [1.0, 0.0, 2.0])
    T = model.reference[1]
    known = BasePrior(T[:3, 3] - [0.002, 0.0, 0.0], quaternion_xyzw(T[:3, :3]), 1e-3, 1e-2)
    np.testing.assert_allclose(
        base_prior(model, 1, known).residual(x), [2, 0, 0, 0, 0, 0], atol=1e-9
    )


def test_a_parameter_without_information_is_an_error_not_a_crash(found) -> None:
    bare = replace(found.posterior, priors=(), free=np.arange(found.model.size))
    with pytest.raises(InsufficientDataError, match='hardly determine'):
        find_mode(bare)


def test_steps_that_settle_slowly_are_near_enough_and_none_at_all_is_refused(monkeypatch) -> None:
    posterior = estimate(Problem.of(scene(47, poses=12)[0])).posterior
    usual = find_mode(posterior)
    monkeypatch.setattr(laplace, 'SETTLED', 0.0)
    unsettled_mode = find_mode(posterior)
    std = np.sqrt(np.diag(usual.covariance))
    off = unsettled_mode.z[posterior.free] - usual.z[posterior.free]
    assert np.all(np.abs(off) < 1e-2 * std[: len(off)])
    monkeypatch.setattr(laplace, 'NEAR_ENOUGH', 0.0)
    with pytest.raises(InsufficientDataError, match='does not settle'):
        find_mode(posterior)


@pytest.fixture(scope='module')
def one_direction() -> Session:
    return one_tool_direction(3)


def test_a_nearly_singular_session_ends_with_its_direction_named(
    one_direction, monkeypatch
) -> None:
    evaluated = 0
    density = Posterior._log_density

    def counted(self: Posterior, points: FloatArray) -> FloatArray:
        nonlocal evaluated
        evaluated += len(points) * len(self.rows)
        return density(self, points)

    monkeypatch.setattr(Posterior, '_log_density', counted)
    monkeypatch.setattr(sampling, 'EVALUATED_ROWS', 5_000_000)
    result = fit_session(one_direction, rng=np.random.default_rng(1))
    sampler = result.sampler
    assert evaluated < sampling.EVALUATED_ROWS
    assert sampler.method == 'laplace'
    assert not sampler.converged
    assert not sampler.wandering
    assert 'hardly determine registration.mocap.z (+1.00) and joint_2' in sampler.message
    assert f'Pareto k of the proposals {sampler.pareto_k:.2f}' in sampler.message
    assert np.all(np.isnan(result.diagnostics.r_hat))


@pytest.mark.qualify
def test_the_allowance_does_not_depend_on_the_machine(one_direction, monkeypatch) -> None:
    monkeypatch.setattr(sampling, 'EVALUATED_ROWS', 2_000_000)
    first, second = (fit_session(one_direction, rng=np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(first.draws, second.draws)
