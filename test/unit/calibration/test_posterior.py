"""The log density against SciPy's, and the linear approximation against the exact density."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import scene
from scipy.stats import kstest, multivariate_normal, norm

from remaster_ros.calibration import convergence, importance, laplace, metropolis, sampling
from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.laplace import find_mode
from remaster_ros.calibration.linearisation import linearise
from remaster_ros.calibration.metropolis import random_walk_sampler
from remaster_ros.calibration.noise import RESOLUTION_M
from remaster_ros.calibration.priors import base_prior, marker_prior
from remaster_ros.calibration.proposal import LaplaceProposal
from remaster_ros.calibration.sampling import sample_posterior
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.transforms import quaternion_xyzw
from remaster_ros.types import BasePrior


@pytest.fixture(scope='module')
def found():
    return estimate(Problem.of(scene(11, poses=12, sensor_count=2)[0]))


def test_density_is_that_of_correlated_normal_errors(found) -> None:
    """The whole covariance matrix of every sensor's errors, written out."""
    posterior, model = found.posterior, found.model
    rng = np.random.default_rng(1)
    points, _ = LaplaceProposal(found.mode).sample(6, rng)
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
    point, _ = LaplaceProposal(found.mode).sample(1, np.random.default_rng(1))
    point[0, -1] *= -1.0
    assert found.posterior.log_density(point)[0] == -np.inf


def test_linearised_posterior_is_nearly_the_exact_one(found) -> None:
    """Conditional times marginal equals the density but for a constant, near the mode."""
    proposal = LaplaceProposal(found.mode)
    points, _ = proposal.sample(200, np.random.default_rng(2))
    f = len(found.posterior.free)
    mean, factor, marginal = found.mode.linearisation.conditional(points[:, f:])
    whitened = np.einsum('nji,nj->ni', factor, points[:, :f] - mean)
    log_root = np.sum(np.log(np.diagonal(factor, axis1=-2, axis2=-1)), axis=-1)
    linear = marginal - 0.5 * np.sum(whitened**2, axis=1) + log_root
    difference = found.posterior.log_density(points) - linear
    assert np.std(difference) < 0.05


@pytest.mark.parametrize('factorised', [False, True])
def test_proposal_reports_the_density_it_samples_from(found, factorised) -> None:
    proposal = LaplaceProposal(found.mode, factorised)
    points, density = proposal.sample(50, np.random.default_rng(3))
    np.testing.assert_allclose(proposal.log_density(points), density)
    assert np.all(points[:, -2:] >= 0.0)


def test_mode_is_where_the_exact_density_peaks(found) -> None:
    """Given the noise: every step of half a standard deviation lowers the density."""
    posterior, mode = found.posterior, found.mode
    top = np.concatenate((mode.z[posterior.free], mode.eta))
    value = posterior.log_density(top[None])[0]
    width = np.sqrt(np.diag(mode.covariance))
    for index, std in enumerate(width):
        for sign in (0.5, -0.5):
            beside = top.copy()
            beside[index] += sign * std
            assert posterior.log_density(beside[None])[0] < value


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
    again = find_mode(found.posterior, begun)
    np.testing.assert_allclose(again.eta, found.mode.eta, atol=1e-3)


@pytest.mark.parametrize('seed', [60, pytest.param(61, marks=pytest.mark.qualify)])
def test_few_poses_do_not_take_long_chains(seed) -> None:
    """Five poses, two sensors, noise by direction: the part common to a pose reaches far up."""
    session, _ = scene(seed, poses=5, sensor_count=2, pose_sigma_m=0.1e-3)
    found = estimate(Problem.of(session))
    p = found.posterior
    mode = find_mode(type(p).of(p.model, p.rows, p.priors, p.free, found.mode.z, split=(0, 1)))
    run, name = sample_posterior(mode, chains=4, rng=np.random.default_rng(seed))
    assert 'factorised for every draw' in name
    # 100,000 did not suffice in such a session.
    assert run.draws.shape[1] < 12_000


def test_what_the_length_is_judged_by_is_what_is_stated() -> None:
    """R-hat and effective draws are computed once, of the draws that are returned."""
    fit = fit_session(scene(60, poses=12)[0], rng=np.random.default_rng(4))
    assert fit.sampler.method == 'metropolis'
    for stated, of in (
        (fit.sampler.r_hat, convergence.r_hat),
        (fit.sampler.ess_bulk, convergence.ess_bulk),
        (fit.sampler.ess_tail, convergence.ess_tail),
    ):
        np.testing.assert_allclose(stated, of(fit.draws), rtol=1e-9)


@pytest.mark.qualify
def test_the_draws_do_not_depend_on_the_proposal() -> None:
    """Independent proposals and a random walk of the same target; KS at 1 in 1,000."""
    # Few rows, noise at zero: as far from Gaussian as a session gets.
    session, _ = scene(12, poses=5, pose_sigma_m=0.0)
    mode = estimate(Problem.of(session)).mode
    rng = np.random.default_rng(4)
    independent, name = sample_posterior(mode, chains=4, draws=1500, rng=rng)
    assert 'Laplace' in name
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


def test_poor_proposals_are_adapted_and_the_name_shows_it() -> None:
    """A Laplace proposal with the noise three standard deviations off and half as wide."""
    found = estimate(Problem.of(scene(13, poses=8)[0]))
    width = np.sqrt(np.diag(found.mode.eta_covariance))
    narrow = replace(found.mode, eta=found.mode.eta + 3.0 * width)
    # In place of what would be computed when it is asked for.
    vars(narrow)['eta_covariance'] = 0.25 * found.mode.eta_covariance
    run, name = sample_posterior(narrow, chains=4, draws=1000, rng=np.random.default_rng(5))
    assert 'adapted' in name
    right, _ = sample_posterior(found.mode, chains=4, draws=1000, rng=np.random.default_rng(6))
    ours, theirs = (r.draws.reshape(-1, found.posterior.size) for r in (run, right))
    shift = np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) / theirs.std(axis=0)
    # Some 500 effective draws on either side.
    assert shift.max() < 0.25
    np.testing.assert_allclose(ours.std(axis=0), theirs.std(axis=0), rtol=0.25)


def test_a_random_walk_is_the_last_resort(found, monkeypatch) -> None:
    monkeypatch.setattr(sampling, 'POOR_ACCEPTANCE', 1.1)
    monkeypatch.setattr(importance, 'PARETO_LIMIT', -np.inf)
    monkeypatch.setattr(sampling, 'WALK_STEPS_PER_DRAW', 2)
    stages: set[str] = set()
    run, name = sample_posterior(
        found.mode,
        chains=4,
        draws=50,
        rng=np.random.default_rng(7),
        report=lambda stage, share: stages.add(stage),
    )
    assert name.startswith('random-walk')
    assert run.draws.shape == (4, 50, found.posterior.size)
    assert 0.05 < run.acceptance_rate < 0.6
    assert stages == {'sampling', 'adapting the sampler', 'sampling by random walk'}


@pytest.mark.qualify
def test_a_random_walk_to_a_precision_is_as_long_as_it_takes(found, monkeypatch) -> None:
    """Against the independent sampler of the same posterior; more chains than were asked for."""
    monkeypatch.setattr(sampling, 'POOR_ACCEPTANCE', 1.1)
    monkeypatch.setattr(sampling, 'FIRST_DRAWS', 40)
    monkeypatch.setattr(sampling, 'WARM_UP', 10)
    monkeypatch.setattr(sampling, 'R_HAT_LIMIT', 1.1)
    monkeypatch.setattr(importance, 'PARETO_LIMIT', -np.inf)
    ask = {'chains': 4, 'precision': 0.2}
    run, name = sample_posterior(found.mode, rng=np.random.default_rng(7), **ask)
    assert name.startswith('random-walk')
    assert run.draws.shape[0] == sampling.WALKS
    monkeypatch.undo()
    right, _ = sample_posterior(found.mode, rng=np.random.default_rng(8), **ask)
    ours, theirs = (r.draws.reshape(-1, found.posterior.size) for r in (run, right))
    # Each mean is known to the precision asked for: five standard errors.
    shift = np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) / theirs.std(axis=0)
    assert shift.max() < 5 * np.sqrt(2) * ask['precision']


@pytest.mark.parametrize(('step', 'enough'), [(1.0, True), (0.01, False)])
def test_a_walk_that_promises_too_little_ends_early(step, enough) -> None:
    """Of a Gaussian, with its best steps and with a hundredth of them."""
    d, rng = 6, np.random.default_rng(10)
    task = sampling._Task(None, 0.05, lambda x: x, rng, lambda stage, share: None, 10**6)
    start = rng.standard_normal((sampling.WALKS, d))
    run, found_enough = task.walk(
        lambda x: -0.5 * np.sum(x**2, axis=1), step * np.eye(d), start, 2000
    )
    assert found_enough == enough
    assert run.draws.shape[1] <= 500


def test_the_step_of_a_walk_suits_the_bulk_of_what_has_long_tails() -> None:
    """A Gaussian takes its own best step; a narrow core in a wide shell a shorter one."""
    rng, d = np.random.default_rng(9), 6
    start = rng.standard_normal((32, d))
    gaussian = metropolis.step_scale(lambda x: -0.5 * np.sum(x**2, axis=1), np.eye(d), start, rng)
    assert gaussian >= 0.7
    core = metropolis.step_scale(
        lambda x: -0.5 * np.sum(x**2, axis=1), 5.0 * np.eye(d), start, rng
    )
    assert core == 0.25


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
    near = find_mode(posterior)
    std = np.sqrt(np.diag(usual.covariance))
    off = near.z[posterior.free] - usual.z[posterior.free]
    assert np.all(np.abs(off) < 1e-2 * std[: len(off)])
    monkeypatch.setattr(laplace, 'NEAR_ENOUGH', 0.0)
    with pytest.raises(InsufficientDataError, match='does not settle'):
        find_mode(posterior)
