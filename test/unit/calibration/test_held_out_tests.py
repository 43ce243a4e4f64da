# SPDX-License-Identifier: Apache-2.0
"""Held-out poses are held against poses left out of the fit, sensor by sensor."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from worlds.calibration_scenes import scene

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.left_out import Contrasts, held_out_tests, left_out_distances
from remaster_ros.calibration.residual_structure import StructureTest
from remaster_ros.calibration.smooth_functions import whitened
from remaster_ros.reports.fit_judgement import verdict
from remaster_ros.types import FloatArray, Session

NONE = np.zeros(0, np.int64)


def by_sensor(session: Session) -> dict[tuple[str, bool], StructureTest]:
    found = estimate(Problem.of(session))
    tests = held_out_tests(found.mode, found.problem.measurements, NONE)
    assert all(test.driver == 'held_out' for test in tests)
    return {(test.sensor, test.between_poses): test for test in tests}


def with_held_out_errors(session: Session, errors: FloatArray) -> Session:
    """Add errors (n, 3) or (3,) to the held-out readings of the first sensor."""
    m = session.measurements
    mine = m.is_validation & (m.sensor == 0)
    return replace(session, measurements=replace(m, position=m.position + mine[:, None] * errors))


def moved(seed: int, step_m: float = 1e-3) -> Session:
    """A session whose first sensor is moved before the held-out poses."""
    session, _ = scene(seed, poses=18, validation=12, sensor_count=2, pose_sigma_m=0.1e-3)
    return with_held_out_errors(session, np.array([step_m, 0.0, 0.0]))


def dense(found: Estimate) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return poses, sensors, derivative and errors of the numbers 3 n, in units of the noise."""
    rows = found.posterior.rows
    white = whitened(found.mode, rows, {})
    pose = found.problem.measurements.pose[rows.source]
    sensor = rows.group_sensor[rows.group_of_row]
    X, e = white['model'], white['errors'].ravel()
    return np.repeat(pose, 3), np.repeat(sensor, 3), X.reshape(-1, X.shape[2]), e


def directions(rows: int, is_mean: bool) -> FloatArray:
    """Return an orthonormal basis of means or of deviations, one of its vectors a row."""
    mean = np.tile(np.eye(3), rows) / np.sqrt(rows)
    return mean if is_mean else np.linalg.svd(mean)[2][3:]


def test_a_pose_left_out_is_judged_as_by_a_fit_without_it():
    """The same by dense algebra: the fit, the noise and the distance, each without the pose."""
    found = estimate(Problem.of(scene(3, poses=12, sensor_count=2)[0]))
    pose, sensor, X, e = dense(found)
    precision = np.linalg.inv(found.mode.covariance)
    rows, white = found.posterior.rows, whitened(found.mode, found.posterior.rows, {})
    joined = np.concatenate((white['model'], white['errors']), axis=2)
    fitted = Contrasts.of(rows, found.problem.measurements, joined)
    judged = left_out_distances(fitted, found.mode.covariance)
    for number, chosen in enumerate(np.unique(pose)):
        out = pose == chosen
        P = np.linalg.inv(precision - X[out].T @ X[out])
        residuals = e + X @ P @ (X[out].T @ e[out])
        for index in (0, 1):
            groups = np.unique(pose[sensor == index])
            rows = {g: np.flatnonzero((sensor == index) & (pose == g)) for g in groups}
            for is_mean in (True, False):
                basis = {g: directions(len(r) // 3, is_mean) for g, r in rows.items()}
                kept_poses = [g for g in groups if g != chosen]
                Q = block_diag(*(basis[g] for g in kept_poses))
                at = np.concatenate([rows[g] for g in kept_poses])
                W = Q @ X[at]
                noise = np.sum((Q @ residuals[at]) ** 2) / (len(Q) - np.sum((W @ P) * W))
                directions_out = basis[chosen]
                V, d = directions_out @ X[rows[chosen]], directions_out @ residuals[rows[chosen]]
                expected = d @ np.linalg.solve(np.eye(len(d)) + V @ P @ V.T, d) / len(d) / noise
                assert judged[2 * index + is_mean][number] == pytest.approx(expected, rel=1e-6)


def test_a_sensor_that_was_moved_is_named_and_the_page_is_not_green():
    session = moved(5)
    tests = by_sensor(session)
    assert tests['mocap', True].p_value < 1e-4
    assert tests['mocap', True].ratio > 2.0
    assert min(test.p_value for key, test in tests.items() if key != ('mocap', True)) > 1e-3
    result = fit_session(session, rng=np.random.default_rng(1))
    # By what is known of the noise alone it passes.
    assert all(check.explained for check in result.noise_checks)
    assert result.other_errors
    judged = verdict(result)
    assert judged.mood == 'caution'
    said = 'On held-out poses the error of mocap from pose to pose is'
    assert any(finding.startswith(said) for finding in judged.findings)


def test_errors_that_differ_between_the_joint_solutions_are_seen_within_the_poses():
    session, _ = scene(6, poses=18, validation=12, sensor_count=2)
    m = session.measurements
    # Less than the noise that all solutions of a pose share, but not common to them.
    wrong = 0.8e-3 * np.random.default_rng(6).standard_normal((len(m), 3))
    tests = by_sensor(with_held_out_errors(session, wrong))
    assert tests['mocap', False].p_value < 1e-4
    assert 'within the poses is' in tests['mocap', False].words()
    assert tests['tracker', False].p_value > 1e-3


@pytest.mark.parametrize(
    ('seeds', 'most'), [(6, 3), pytest.param(60, 8, marks=pytest.mark.qualify)]
)
def test_healthy_sessions_are_left_alone(seeds, most):
    """More p-values than `most` are below 0.01 in 0.1 % of all runs; the mean by 4.5 std."""
    values = []
    for seed in range(seeds):
        session, _ = scene(seed, poses=18, validation=12, sensor_count=2)
        values += [test.p_value for test in by_sensor(session).values()]
    assert len(values) == 4 * seeds
    assert np.sum(np.array(values) < 0.01) <= most
    assert abs(np.mean(values) - 0.5) < 4.5 / np.sqrt(12.0 * len(values))


def test_one_gross_error_is_not_a_finding():
    session, _ = scene(7, poses=18, validation=12)
    first = np.arange(len(session.measurements)) == np.argmax(session.measurements.is_validation)
    tests = by_sensor(with_held_out_errors(session, 0.1 * first[:, None] * np.ones(3)))
    assert all(test.p_value > 1e-3 for test in tests.values())
    found = estimate(Problem.of(session))
    measurements = found.problem.measurements
    gross = measurements.observation[measurements.is_validation]
    assert held_out_tests(found.mode, measurements, gross) == ()


@pytest.mark.parametrize(('poses', 'validation'), [(7, 12), (18, 3), (18, 0)])
def test_too_few_poses_are_not_judged(poses, validation):
    assert by_sensor(scene(8, poses=poses, validation=validation)[0]) == {}


def test_readings_without_noise_are_not_judged():
    """What rounding leaves has structure."""
    session, _ = scene(9, poses=18, validation=12, sigma_m=0.0, pose_sigma_m=0.0)
    assert by_sensor(session) == {}


def test_poses_of_one_solution_are_judged_by_their_means():
    session = moved(10)
    m = session.measurements
    first = np.unique(np.stack((m.pose, m.sensor)), axis=1, return_index=True)[1]
    tests = by_sensor(replace(session, measurements=m.select(np.sort(first))))
    assert set(tests) == {('mocap', True), ('tracker', True)}


def test_a_pose_that_alone_determines_a_direction_is_not_left_out():
    derivative = np.zeros((9, 3, 2))
    derivative[:, 0, 0] = 1.0
    derivative[4] = np.diag([0.0, 1.0, 0.0])[:, :2]
    fitted = Contrasts(np.arange(9), np.ones(9, np.int64), derivative, np.ones((9, 3)))
    judged = left_out_distances(fitted, np.diag([1.0 / 8.0, 1.0]))
    assert len(judged[1]) == 8
