# SPDX-License-Identifier: Apache-2.0
"""Whether noise explains what a fit leaves: by what is stated and by the scatter within poses."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.calibration_scenes import scene
from worlds.measured_rows import measured_rows

from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.noise import MEDIAN_LENGTH
from remaster_ros.calibration.noise_check import (
    MEAN_LENGTH,
    NoiseCheck,
    check_noise,
)
from remaster_ros.reports.fit_judgement import verdict
from remaster_ros.types import Measurements

POSES, EACH = 40, 5


def measurements(
    std_m: float = np.nan, validation: bool = True, samples: int = 100
) -> Measurements:
    """Return rows of one sensor and marker; every third pose is held out.

    ``std_m`` is of a reading, the mean of its samples.
    """
    rows = POSES * EACH
    pose = np.repeat(np.arange(POSES), EACH)
    return measured_rows(
        np.zeros((rows, 2)),
        np.zeros((rows, 3)),
        pose=pose,
        is_validation=(pose % 3 == 2) & validation,
        std=np.full((rows, 3), std_m * np.sqrt(max(samples, 1))),
        samples=np.full(rows, samples),
    )


def noise(sigma_m: float, pose_sigma_m: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    common = np.repeat(rng.standard_normal((POSES, 3)), EACH, axis=0)
    return sigma_m * rng.standard_normal((POSES * EACH, 3)) + pose_sigma_m * common


def check(m: Measurements, residuals: np.ndarray, left_out: tuple[int, ...] = ()) -> NoiseCheck:
    (found,) = check_noise(m, ('mocap',), residuals, np.array(left_out, np.int64), parameters=14)
    return found


def test_the_constants_are_those_of_three_normal_numbers():
    lengths = np.linalg.norm(np.random.default_rng(1).standard_normal((400_000, 3)), axis=1)
    assert lengths.mean() == pytest.approx(MEAN_LENGTH, rel=3e-3)
    assert np.median(lengths) == pytest.approx(MEDIAN_LENGTH, rel=3e-3)


def test_noise_with_a_part_common_to_the_pose_is_explained():
    """As in the source paper: 0.23 mm and 0.5 mm."""
    for seed in range(10):
        found = check(measurements(), noise(0.23e-3, 0.5e-3, seed))
        assert found.within_pose_std_m == pytest.approx(0.23e-3, rel=0.25)
        assert found.stated_std_m is None
        assert found.explained, found


def test_an_error_ten_times_the_scatter_is_not():
    moved = np.where(np.arange(POSES * EACH) < 100, 2e-3, -2e-3)[:, None] * [0.0, 1.0, 0.0]
    found = check(measurements(), noise(0.11e-3, 0.0) + moved)
    assert found.within_pose_std_m == pytest.approx(0.11e-3, rel=0.2)
    assert found.after_m == pytest.approx(2e-3, rel=0.05)
    assert not found.explained


def test_a_sensor_moved_during_one_pose_does_not_become_scatter():
    residuals = noise(0.1e-3, 0.0)
    residuals[101:] += [0.0, 4e-3, 0.0]
    found = check(measurements(), residuals)
    assert found.within_pose_std_m == pytest.approx(0.1e-3, rel=0.2)
    assert not found.explained


def test_scatter_far_beyond_what_the_sensor_states_is_not_its_noise():
    """A soft joint errs differently at each solution of a pose."""
    errors = noise(0.8e-3, 0.0)
    assert check(measurements(), errors).explained
    assert not check(measurements(std_m=0.02e-3), errors).explained
    assert check(measurements(std_m=0.4e-3), errors).explained
    assert check(measurements(std_m=0.8e-3), errors).noise_std_m == pytest.approx(0.8e-3, rel=0.1)


@pytest.mark.parametrize('samples', [1, 16, 120])
def test_the_noise_of_a_reading_is_that_of_the_mean_of_its_frames(samples):
    """The scatter of the frames, 0.1 mm, is a fact about frames; no pose has two readings."""
    frames = 0.1e-3
    m = measurements(frames / np.sqrt(samples), samples=samples)
    single_rows = replace(m, pose=np.arange(len(m)))
    found = check(single_rows, noise(frames / np.sqrt(samples), 0.0))
    assert found.stated_std_m == pytest.approx(frames / np.sqrt(samples))
    assert found.noise_m == pytest.approx(found.after_m, rel=0.15)
    assert found.explained
    # Errors as large as the scatter of the frames are more than 16 or 120 frames leave.
    assert check(single_rows, noise(frames, 0.0)).explained == (samples == 1)


def test_samples_that_are_not_known_count_as_one():
    found = check(measurements(1e-4, samples=-1), noise(1e-4, 0.0))
    assert found.stated_std_m == pytest.approx(1e-4)


def test_a_stated_noise_of_zero_is_none():
    assert check(measurements(std_m=0.0), noise(0.1e-3, 0.0)).stated_std_m is None


def test_single_gross_errors_change_nothing_and_many_do():
    residuals = noise(0.1e-3, 0.1e-3)
    held_out = np.flatnonzero(measurements().is_validation)
    residuals[held_out[:2]] += 0.02
    assert check(measurements(), residuals).explained
    residuals[held_out[:12]] += 0.02
    assert not check(measurements(), residuals).explained


def test_rows_left_out_are_not_judged():
    residuals = noise(0.1e-3, 0.1e-3)
    residuals[30:60] += 0.02
    assert not check(measurements(validation=False), residuals).explained
    found = check(measurements(validation=False), residuals, left_out=tuple(range(30, 60)))
    assert found.explained
    assert found.poses == POSES - 6
    assert found.spread == 1.0


def test_held_out_rows_are_judged_where_there_are_any():
    m, residuals = measurements(), noise(0.1e-3, 0.0)
    residuals[m.is_validation] += [2e-3, 0.0, 0.0]
    found = check(m, residuals)
    assert found.poses == 13
    assert found.after_m == pytest.approx(2e-3, rel=0.05)
    assert found.spread == pytest.approx(np.sqrt(1.0 + 14 / (3 * 27 - 15)))


def test_without_std_and_second_solutions_nothing_tells():
    m = measurements()
    single_rows = replace(m, pose=np.arange(len(m)))
    found = check(single_rows, noise(0.1e-3, 0.0))
    assert found.noise_std_m is found.noise_m is None
    assert found.explained is None
    assert check(replace(single_rows, std=np.full((len(m), 3), 1e-3)), noise(1e-4, 0.0)).explained


def test_two_markers_at_one_configuration_are_no_second_solution():
    m = measurements()
    both = replace(m, pose=np.arange(len(m)) // 2, marker=np.arange(len(m)) % 2)
    assert check(both, noise(0.1e-3, 0.0)).within_pose_std_m is None


def test_every_sensor_is_judged_by_its_own_noise():
    m, errors = measurements(), noise(0.1e-3, 0.0)
    sensor = np.arange(len(m)) % 2
    errors[sensor == 1] *= 0.02
    errors[sensor == 1] += [0.15e-3, 0.0, 0.0]
    first, second, *further_checks = check_noise(
        replace(m, sensor=sensor), ('mocap', 'tracker', 'off'), errors, np.array([], int), 14
    )
    assert (first.sensor, first.explained) == ('mocap', True)
    assert (second.sensor, second.explained) == ('tracker', False)
    assert further_checks == []


def test_held_out_gross_errors_that_make_up_the_error_are_named_and_not_green():
    session, _ = scene(61, poses=30, validation=20, sigma_m=0.1e-3, pose_sigma_m=0.0)
    clean = fit_session(session, rng=np.random.default_rng(0), precision=0.05)
    assert [check.spoilt for check in clean.noise_checks] == ['']
    assert verdict(clean).mood == 'good'
    m = session.measurements
    wrong = np.flatnonzero(m.is_validation)[3::25]
    position = m.position.copy()
    position[wrong] += 0.04
    spoilt = replace(session, measurements=replace(m, position=position))
    result = fit_session(spoilt, rng=np.random.default_rng(0), precision=0.05)
    (check,) = result.noise_checks
    assert check.gross == tuple(m.observation[wrong].tolist())
    assert str(m.observation[wrong[0]]) in check.spoilt
    found = verdict(result)
    assert found.mood == 'caution'
    assert check.spoilt in found.points
