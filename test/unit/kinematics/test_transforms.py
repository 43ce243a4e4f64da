# SPDX-License-Identifier: Apache-2.0
"""SE(3) on arrays."""

import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.kinematics import transforms

RNG_SEED = 7


@pytest.fixture
def rng():
    return np.random.default_rng(RNG_SEED)


def random_transforms(rng, *shape):
    rotation = transforms.rotation_vector_to_matrix(rng.normal(size=(*shape, 3)))
    return transforms.transform(rotation, rng.normal(size=(*shape, 3)))


@pytest.mark.parametrize('shape', [(), (5,), (2, 3)])
def test_inverse_undoes_for_any_leading_shape(rng, shape):
    T = random_transforms(rng, *shape)
    assert T.shape == (*shape, 4, 4)
    np.testing.assert_allclose(transforms.inverse(T) @ T, np.eye(4) + 0 * T, atol=1e-14)


def test_apply_maps_by_homogeneous_product_and_broadcasts(rng):
    T, points = random_transforms(rng, 4, 1), rng.normal(size=(6, 3))
    homogeneous = np.concatenate((points, np.ones((6, 1))), axis=1)
    expected = np.einsum('aij,bj->abi', T[:, 0], homogeneous)[..., :3]
    np.testing.assert_allclose(transforms.apply(T, points), expected, atol=1e-14)


def test_transform_broadcasts_one_rotation_over_many_translations(rng):
    T = transforms.transform(np.eye(3), rng.normal(size=(5, 3)))
    assert T.shape == (5, 4, 4)


@pytest.mark.parametrize('angle', [0.0, 1e-12, 1e-6, 1.0, 3.1, np.pi - 1e-9])
def test_rotation_vectors_round_trip(rng, angle):
    axis = rng.normal(size=3)
    vector = angle * axis / np.linalg.norm(axis)
    matrix = transforms.rotation_vector_to_matrix(vector)
    np.testing.assert_allclose(transforms.matrix_to_rotation_vector(matrix), vector, atol=1e-8)
    length = np.linalg.norm(transforms.matrix_to_rotation_vector(matrix))
    np.testing.assert_allclose(length, angle, atol=1e-15, rtol=1e-9)


def test_rotation_vectors_of_any_leading_shape(rng):
    vectors = rng.normal(size=(2, 0, 4, 3))
    assert transforms.rotation_vector_to_matrix(vectors).shape == (2, 0, 4, 3, 3)
    vectors = rng.normal(size=(2, 5, 3))
    matrices = transforms.rotation_vector_to_matrix(vectors)
    np.testing.assert_allclose(transforms.matrix_to_rotation_vector(matrices), vectors)


def test_a_half_turn_has_a_rotation_vector_of_length_pi():
    half_turn = np.diag([1.0, -1.0, -1.0])
    vector = transforms.matrix_to_rotation_vector(half_turn)
    assert np.linalg.norm(vector) == pytest.approx(np.pi)


@pytest.mark.parametrize('axis', [[0, 0, 1], [0, 0, -1], [0, 2, 0], [-3, 0, 0], [1, -2, 3]])
def test_with_z_along_is_a_rotation_whose_z_axis_lies_there(axis):
    R = transforms.with_z_along(axis)
    np.testing.assert_allclose(R[:, 2], np.array(axis) / np.linalg.norm(axis), atol=1e-15)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.parametrize('quaternion', [[0, 0, 0, 0], [0, 0, np.nan, 1], [np.inf, 0, 0, 1]])
def test_a_quaternion_without_direction_is_refused(quaternion):
    with pytest.raises(ValueError, match='is no rotation'):
        transforms.matrix_from_quaternion_xyzw(quaternion)


def test_quaternions_round_trip_with_positive_w(rng):
    R = transforms.rotation_vector_to_matrix(rng.uniform(-4, 4, size=(150, 3)))
    for matrix in R:
        q = transforms.quaternion_xyzw(matrix)
        assert q[3] >= 0
        back = transforms.matrix_from_quaternion_xyzw(-2.5 * q)
        np.testing.assert_allclose(back, matrix, atol=1e-14)


def test_quaternion_order_is_x_y_z_w():
    quarter_turn_about_z = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    s = np.sqrt(0.5)
    np.testing.assert_allclose(transforms.quaternion_xyzw(quarter_turn_about_z), [0, 0, s, s])


def test_the_mean_of_quaternions_lies_in_the_middle_whatever_their_signs(rng):
    middle = transforms.rotation_vector_to_matrix([0.3, -2.0, 1.1])
    turns = transforms.rotation_vector_to_matrix(rng.normal(0, 0.05, (40, 3)))
    # With each turn its inverse: their mean is none, to any order.
    both = [middle @ turn for turn in (*turns, *np.swapaxes(turns, 1, 2))]
    quaternions = np.array([transforms.quaternion_xyzw(R) for R in both])
    quaternions *= rng.choice([-1.0, 1.0], size=(len(both), 1))
    mean = transforms.mean_quaternion_xyzw(quaternions)
    np.testing.assert_allclose(mean, transforms.quaternion_xyzw(middle), atol=1e-12)


def test_rpy_is_yaw_times_pitch_times_roll():
    roll, pitch, yaw = 0.3, -0.4, 1.2

    def turn(axis, angle):
        return transforms.rotation_vector_to_matrix(angle * np.eye(3)[axis])

    expected = turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)
    np.testing.assert_allclose(transforms.matrix_from_rpy([roll, pitch, yaw]), expected)


@pytest.mark.parametrize('target', [[0.0, 0.1, 0.6], [1.9, 0.2, 5.0], [1.9, 0.2, -5.0]])
def test_looking_at_points_z_at_the_target_with_x_level(target):
    position = [1.9, 0.2, 1.3]
    R = transforms.looking_at(position, target)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
    assert np.linalg.det(R) == pytest.approx(1.0)
    line = np.subtract(target, position)
    np.testing.assert_allclose(R[:, 2], line / np.linalg.norm(line), atol=1e-14)
    assert R[2, 0] == pytest.approx(0.0, abs=1e-14)
    rolled = transforms.looking_at(position, target, 0.3)
    np.testing.assert_allclose(rolled[:, 2], R[:, 2], atol=1e-14)
    assert R[:, 0] @ rolled[:, 0] == pytest.approx(np.cos(0.3))


@pytest.mark.parametrize('x', [1.0, np.nan])
def test_looking_at_itself_is_refused(x):
    with pytest.raises(InputError, match='another place'):
        transforms.looking_at([x, 2.0, 3.0], [1.0, 2.0, 3.0])
