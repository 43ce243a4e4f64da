# SPDX-License-Identifier: Apache-2.0
"""Errors of a camera on the tool are those of what it measures, in its own frame.

Its place in front of the board, by its readings, has the noise of the orientation at the distance.
"""

from functools import cache

import numpy as np
import pytest

from remaster_ros import simulate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.predictions import Coverage, predict
from remaster_ros.calibration.result import FitResult
from remaster_ros.reports.fit_judgement import verdict

SIGMA_M, POSE_SIGMA_M = 1e-4, 2e-4


@cache
def fitted() -> FitResult:
    """Of noise alone; the boards are 2 m away, where 0.05 degrees are 1.7 mm."""
    made = simulate(
        seed=14,
        poses=40,
        validation_poses=40,
        noise_m=SIGMA_M,
        pose_noise_m=POSE_SIGMA_M,
        orientation_noise_rad=np.radians(0.05),
        on_tool=True,
    )
    return fit_session(made.session, rng=np.random.default_rng(1), draws=1000)


def test_held_out_poses_of_noise_are_no_finding():
    result = fitted()
    assert result.structure is not None
    tests = [test for test in result.structure.tests if test.driver == 'held_out']
    assert len(tests) == 4
    assert min(test.p_value for test in tests) > 1e-3
    assert all(0.6 < test.ratio < 1.6 for test in tests)
    assert verdict(result).mood == 'good'


def test_what_is_left_is_the_noise_of_the_readings():
    result = fitted()
    noise = np.hypot(SIGMA_M, POSE_SIGMA_M)
    held_out = result.measurements.is_validation
    for rows in (held_out, ~held_out):
        assert np.std(result.residuals_after[rows]) == pytest.approx(noise, rel=0.15)
    for check in result.noise_checks:
        assert check.within_pose_std_m == pytest.approx(SIGMA_M, rel=0.2)
    # What the posterior predicts is what is measured.
    metrics = result.accuracy['validation']
    measured, predicted = (
        metrics[name]['after']['mean_mm'] for name in ('post_registration', 'theoretical')
    )
    assert measured == pytest.approx(predicted, rel=0.15)


def test_predicted_regions_hold_as_often_as_stated():
    result = fitted()
    found = predict(result, result.measurements)
    np.testing.assert_allclose(
        result.measurements.position - found.position, result.residuals_after, atol=1e-12
    )
    assert found.widening < 1.2
    assert Coverage.of(found.inside[result.measurements.is_validation]).share > 0.85
    assert np.sqrt(np.linalg.eigvalsh(found.covariance).max()) < 1e-3
