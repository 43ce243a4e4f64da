# SPDX-License-Identifier: Apache-2.0
"""Registration of two frames by points."""

import numpy as np
import pytest

from remaster_ros.calibration.registration import register_points, register_ransac
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.kinematics.transforms import (
    apply,
    inverse,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
    transform,
)


def random_case(seed, points):
    rng = np.random.default_rng(seed)
    T_R_N = transform(rotation_vector_to_matrix(rng.normal(0, 2, 3)), rng.normal(0, 2, 3))
    points_R = rng.uniform(-0.5, 0.5, (points, 3))
    return rng, T_R_N, points_R, apply(inverse(T_R_N), points_R)


@pytest.mark.parametrize('points', [3, 4, 50])
@pytest.mark.parametrize('seed', range(5))
def test_exact_points_give_the_frame_exactly(seed, points):
    _, T_R_N, points_R, points_N = random_case(seed, points)
    found, rms = register_points(points_R, points_N)
    np.testing.assert_allclose(found, T_R_N, atol=1e-12)
    assert rms < 1e-14


def test_noise_is_averaged_and_reported():
    # Of 3n noisy coordinates 6 are fitted; at n = 400 the rms is known to about 2 %, tested to 10.
    noise = 1e-3
    rng, T_R_N, points_R, points_N = random_case(11, 400)
    found, rms = register_points(points_R, points_N + rng.normal(0, noise, points_N.shape))
    assert rms == pytest.approx(noise * np.sqrt(3 * (1 - 6 / 1200)), rel=0.1)
    error = inverse(T_R_N) @ found
    # Six sigma of the angle over points 0.5 m wide; the translation lies up to 5 m from them.
    assert np.linalg.norm(matrix_to_rotation_vector(error[:3, :3])) < 6 * noise / (
        0.29 * np.sqrt(400)
    )
    center = points_R.mean(axis=0)
    moved = apply(found, apply(inverse(T_R_N), center)) - center
    assert np.linalg.norm(moved) < 6 * noise / np.sqrt(400)


def test_least_squares_solution_cannot_be_improved():
    rng, _, points_R, points_N = random_case(12, 6)
    points_N = points_N + rng.normal(0, 0.01, points_N.shape)
    found, rms = register_points(points_R, points_N)
    for step in rng.normal(0, 1e-4, (100, 6)):
        nudged = transform(rotation_vector_to_matrix(step[3:]), step[:3]) @ found
        distances = np.linalg.norm(apply(nudged, points_N) - points_R, axis=1)
        assert np.sqrt(np.mean(distances**2)) > rms


def test_mirrored_points_still_give_a_rotation():
    _, _, points_R, points_N = random_case(13, 8)
    found, rms = register_points(points_R, points_N * [1, 1, -1])
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)
    assert rms > 0.05


LINE = np.array([[0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]])
NEARLY_LINE = np.array([[0, 0, 0], [0.1, 2e-3, 0], [0.3, 0, 0]])
TRIANGLE = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0]])


@pytest.mark.parametrize(
    ('points_R', 'points_N', 'message'),
    [
        (TRIANGLE[:2], TRIANGLE[:2], '2 points do not fix a frame; measure at least 3'),
        (LINE, TRIANGLE, "the robot's 3 points lie on a line .spread 124.7 mm along it, 0.00"),
        (TRIANGLE, NEARLY_LINE, "the sensor's 3 points lie on a"),
        (TRIANGLE * 0, TRIANGLE, 'lie on a line'),
    ],
)
def test_too_few_and_collinear_points_are_refused_with_a_remedy(points_R, points_N, message):
    with pytest.raises(InsufficientDataError, match=message):
        register_points(points_R, points_N)


@pytest.mark.parametrize(
    ('points_R', 'points_N', 'message'),
    [
        (TRIANGLE, TRIANGLE[:2], 'both must be'),
        (TRIANGLE[:, :2], TRIANGLE[:, :2], 'both must be'),
        (TRIANGLE, TRIANGLE * np.nan, 'not a finite number'),
    ],
)
def test_wrong_arrays_are_refused(points_R, points_N, message):
    with pytest.raises(InputError, match=message):
        register_points(points_R, points_N)


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('moved', [False, True])
def test_a_stray_at_one_point_is_found_by_the_next(seed, moved):
    """It stands still or moves; three points that disagree are refused, the fourth decides."""
    rng, T_R_N, points_R, points_N = random_case(seed, 5)
    points_R += rng.normal(0, 2e-3, points_R.shape)
    # A stray so near that the triangle is as it should be cannot be found.
    points_N[1] = points_N[0] + (points_N[1] - points_N[0]) * (1.6 if moved else 0.3)
    with pytest.raises(InsufficientDataError, match='of 3 points too few agree'):
        register_ransac(points_R[:3], points_N[:3], 0.025)
    for count in (4, 5):
        found, agree = register_ransac(points_R[:count], points_N[:count], 0.025)
        assert agree.tolist() == [True, False, True, True, True][:count]
        np.testing.assert_allclose(apply(found, points_N[:1]), points_R[:1], atol=0.01)
        assert np.linalg.norm(found[:3, 3] - T_R_N[:3, 3]) < 0.1


def test_a_stray_that_stands_still_at_every_point_is_no_frame():
    _, _, points_R, points_N = random_case(3, 6)
    points_N[1:] = points_N[0] + np.random.default_rng(3).normal(0, 1e-4, (5, 3))
    with pytest.raises(InsufficientDataError, match='too few agree'):
        register_ransac(points_R, points_N, 0.025)
