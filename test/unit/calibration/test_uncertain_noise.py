"""Regions of a fit whose noise few poses determine: as wide as its posterior makes the errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy
from worlds.calibration_scenes import scene

from remaster_ros import simulate
from remaster_ros.calibration.estimate import Problem
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.predictions import predict
from remaster_ros.errors import InsufficientDataError


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
