# SPDX-License-Identifier: Apache-2.0
"""Predicted positions with their covariance: as wide as errors on other poses are."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from scipy.stats import binom, chi2
from worlds.calibration_scenes import scene

from remaster_ros import simulate
from remaster_ros.calibration.estimate import Problem
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.predictions import Coverage, predict
from remaster_ros.errors import InsufficientDataError


def predicted(session):
    fit = fit_session(session, rng=np.random.default_rng(0), draws=1000)
    measurements = Problem.of(session).measurements
    return fit, measurements, predict(fit, measurements)


@pytest.mark.parametrize('sensors', [pytest.param(1, marks=pytest.mark.qualify), 2])
def test_held_out_rows_lie_in_their_regions_as_often_as_stated(sensors):
    session, _ = scene(51, poses=40, validation=60, sensor_count=sensors)
    fit, measurements, found = predicted(session)
    np.testing.assert_allclose(
        measurements.position - found.position, fit.residuals_after, atol=1e-12
    )
    held_out = found.inside[measurements.is_validation]
    coverage = Coverage.of(held_out)
    assert coverage.rows == len(held_out)
    # By pose, whose rows share an error: within what chance does once in 10,000.
    poses = len(np.unique(measurements.pose[measurements.is_validation]))
    low, high = binom.ppf([5e-5, 1.0 - 5e-5], poses, 0.95) / poses
    assert low < coverage.share <= min(1.0, high + 1e-9)
    assert coverage.interval95[0] < coverage.share < coverage.interval95[1] or coverage.share == 1
    assert 1.0 <= found.widening < 1.2
    # Symmetric, positive, and at least the noise.
    np.testing.assert_allclose(found.covariance, np.swapaxes(found.covariance, 1, 2), atol=1e-15)
    noise = min(noise.sigma_m for noise in fit.noise.values())
    assert np.linalg.eigvalsh(found.covariance).min() > 0.9 * noise**2


@pytest.mark.qualify
def test_errors_with_long_tails_widen_the_regions():
    session, _ = scene(52, poses=60, validation=60, sigma_m=1e-6, pose_sigma_m=0.0)
    seed = 3
    print(f'seed {seed}')
    m = session.measurements
    errors = np.random.default_rng(seed).standard_t(3.0, m.position.shape) * 0.1e-3
    session = replace(session, measurements=replace(m, position=m.position + errors))
    fit, measurements, found = predicted(session)
    assert found.widening > 1.03
    held_out = measurements.is_validation
    residuals = fit.residuals_after
    narrow = found.covariance / found.widening**2
    distance = np.einsum(
        'ni,ni->n', residuals, np.linalg.solve(narrow, residuals[..., None])[..., 0]
    )
    without = np.mean(distance[held_out] <= chi2.ppf(0.95, 3))
    print(found.widening, without, np.mean(found.inside[held_out]))
    assert without < np.mean(found.inside[held_out])
    assert abs(np.mean(found.inside[held_out]) - 0.95) < 0.035


@pytest.mark.parametrize('seed', [0, pytest.param(5, marks=pytest.mark.qualify)])
def test_poses_that_alone_determine_parameters_do_not_spoil_the_factor(seed):
    """Three poses determine where the second sensor stands: none of them can be left out."""
    session, _ = scene(seed, poses=12, validation=10, sensor_count=2)
    m = session.measurements
    seen = np.isin(m.pose, np.unique(m.pose[~m.is_validation])[:3])
    few = m.select((m.sensor == 0) | m.is_validation | seen)
    _, measurements, found = predicted(replace(session, measurements=few))
    assert 1.0 <= found.widening < 1.5
    # Rows of a pose share an error: far fewer than 95 % by chance, but not none.
    assert 0.7 < np.mean(found.inside[measurements.is_validation]) <= 1.0


def test_without_rows_there_is_no_coverage():
    assert Coverage.of(np.zeros(0, dtype=bool)) == Coverage(0, 0, None, None)


@pytest.mark.parametrize(('poses', 'least', 'most'), [(3, 1.05, 3.0), (25, 1.0, 1.02)])
def test_regions_hold_what_the_posterior_predicts(poses, least, most):
    """Errors drawn with parameters and noise together lie in them as often as stated.

    No pose of three can be left out to show it.
    """
    session, _ = scene(4, poses=poses, validation=6)
    fit = fit_session(session, rng=np.random.default_rng(0), draws=1000)
    measurements = Problem.of(session).measurements
    found = predict(fit, measurements)
    assert least <= found.widening < most
    posterior, rng = fit.predictive, np.random.default_rng(1)
    held_out = np.flatnonzero(measurements.is_validation)
    rows = posterior.model.rows(measurements, held_out)
    shift = (posterior.draws - posterior.draws.mean(axis=0)) @ np.swapaxes(
        posterior.model.jacobian(posterior.after, rows), 1, 2
    )
    noise = posterior.sigma[:, 0, 1, None] * rng.standard_normal(shift.shape)
    # Covariances are in the frame of the sensor, as the reference is.
    errors = (shift + noise) @ posterior.model.reference[0, :3, :3]
    solved = np.linalg.solve(found.covariance[rows.source], np.swapaxes(errors, 1, 2))
    distance = np.einsum('nid,ndi->nd', solved, errors)
    inside = np.mean(distance <= scipy.special.chdtri(3, 0.05))
    assert inside == pytest.approx(0.95, abs=0.02)


@pytest.mark.qualify
@pytest.mark.parametrize('poses', [3, 5, 8])
def test_held_out_rows_of_few_poses_lie_in_their_regions(poses):
    """Over sessions; by chance the mean of 40 is 0.03 off."""
    shares = []
    for seed in range(1000, 1040):
        session = simulate(seed=seed, poses=max(16, 3 * poses), validation_poses=40).session
        m = session.measurements
        few = np.unique(m.pose[~m.is_validation])[:poses]
        session = replace(session, measurements=m.select(m.is_validation | np.isin(m.pose, few)))
        try:
            fit = fit_session(session, rng=np.random.default_rng(seed), draws=1000)
        except InsufficientDataError:
            continue
        found = predict(fit, Problem.of(session).measurements)
        shares.append(np.mean(found.inside[session.measurements.is_validation]))
    print(poses, np.mean(shares))
    assert 0.91 < np.mean(shares) < 0.99
