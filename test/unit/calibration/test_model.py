# SPDX-License-Identifier: Apache-2.0
"""The prediction of a marker, its derivative, and the coordinates with the gauge taken out."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from worlds.calibration_scenes import CHAIN, extension, scene
from worlds.measured_rows import predict_in_sensor

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.model import Model
from remaster_ros.kinematics.transforms import apply, rotation_vector_to_matrix, transform


@pytest.fixture(scope='module')
def measured():
    return scene(1, poses=6, sensor_count=2)[0].measurements


@pytest.fixture(scope='module')
def model(measured) -> Model:
    rng = np.random.default_rng(2)
    turn = rotation_vector_to_matrix(rng.standard_normal((2, 3)))
    return Model(
        CHAIN,
        ('a', 'b'),
        ('p', 's'),
        transform(turn, rng.standard_normal((2, 3))),
        np.ones((2, 3)),
    )


@pytest.fixture
def x(model: Model) -> np.ndarray:
    return 0.1 * np.random.default_rng(3).standard_normal(model.size)


def rows_of(measured, model: Model) -> Rows:
    return Rows.of(measured, np.arange(len(measured)), model.reference)


def test_names_follow_the_layout(model: Model) -> None:
    assert model.names[0] == 'joint_1'
    assert model.names[model.registration(1)] == tuple(
        f'registration.b.{axis}' for axis in ('x', 'y', 'z', 'rx', 'ry', 'rz')
    )
    assert model.names[model.marker(1)] == ('marker.s.x', 'marker.s.y', 'marker.s.z')
    assert len(model.names) == model.size == 7 + 12 + 6


def test_predictions_are_those_in_the_sensor_frames(model: Model, measured, x) -> None:
    """By the reference, the predicted base points are where the sensors see the markers."""
    rows = rows_of(measured, model)
    in_sensor = predict_in_sensor(
        CHAIN, measured, model.offsets(x), model.T_R_N(x), model.markers(x)
    )
    expected = apply(model.reference[measured.sensor], in_sensor)[rows.source]
    np.testing.assert_allclose(model.predict(model.pinned(x), rows), expected, atol=1e-12)


def test_a_registration_moves_the_robot_s_points_along_the_base_axes(model: Model) -> None:
    x = np.zeros(model.size)
    x[model.registration(0)] = [0.01, 0.0, 0.0, 0.0, 0.0, 0.2]
    correction = model.corrections(x)[0]
    moved = apply(correction, model.centroid[0] + [0.1, 0.0, 0.0])
    expected = model.centroid[0] + [0.01 + 0.1 * np.cos(0.2), 0.1 * np.sin(0.2), 0.0]
    np.testing.assert_allclose(moved, expected, atol=1e-15)
    np.testing.assert_allclose(model.T_R_N(x)[1], model.reference[1])


def test_pinned_and_natural_are_inverse(model: Model, x) -> None:
    batch = np.stack((x, -x))
    np.testing.assert_allclose(model.natural(model.pinned(batch)), batch, atol=1e-12)


def test_the_outer_joints_move_no_prediction_in_pinned_coordinates(model, measured, x) -> None:
    rows = rows_of(measured, model)
    z = model.pinned(x)
    turned = z.copy()
    turned[[0, 6]] += [0.7, -1.3]
    np.testing.assert_allclose(model.predict(turned, rows), model.predict(z, rows), atol=1e-13)
    # The same in natural parameters: other offsets, registrations and markers, same robot.
    other = model.natural(turned)
    assert np.abs(other - x).max() > 0.1
    natural = [
        predict_in_sensor(CHAIN, measured, model.offsets(v), model.T_R_N(v), model.markers(v))
        for v in (x, other)
    ]
    np.testing.assert_allclose(natural[0], natural[1], atol=1e-12)


@pytest.mark.parametrize('kind', ['pinned', 'natural'])
def test_the_derivative_is_that_of_the_prediction(model: Model, measured, x, kind: str) -> None:
    rows = rows_of(measured, model)
    step = 1e-6
    steps = step * np.eye(model.size)
    if kind == 'pinned':
        derivative = model.jacobian(x, rows)
        around = [model.predict(x + sign * steps, rows) for sign in (1.0, -1.0)]
    else:
        derivative = model.natural_jacobian(x, rows)
        around = [model.predict(model.pinned(x + sign * steps), rows) for sign in (1.0, -1.0)]
    numerical = np.moveaxis(around[0] - around[1], 0, -1) / (2.0 * step)
    np.testing.assert_allclose(derivative, numerical, atol=1e-8)


@pytest.fixture
def arrays(measured) -> dict[str, Any]:
    """Three effects of no particular meaning, about as large as real ones."""
    rng = np.random.default_rng(4)
    n = len(measured)
    return {
        'names': ('a', 'b', 'c'),
        'units': ('rad', 'm', '1'),
        'joint': 0.01 * rng.standard_normal((n, 7, 3)),
        'displacement': 0.01 * rng.standard_normal((n, 3, 3)),
        'displacement0': 0.001 * rng.standard_normal((n, 3)),
        'theta0': rng.standard_normal(3),
        'prior_precision': np.diag([1.0, 4.0, 0.0]),
    }


@pytest.fixture
def extended(model: Model, arrays) -> Model:
    """The same model with these effects."""
    return replace(model, extension=extension(**arrays))


def test_effects_turn_joints_and_displace_markers(extended: Model, arrays, measured, x) -> None:
    """Row by row as the extension's documentation has it, joint 1 held as in most fits."""
    theta = np.array([1.0, -2.0, 0.5])
    x = np.concatenate((x, theta))
    x[[0, 6]] = 0.0
    rows = rows_of(measured, extended)
    assert extended.names[-3:] == ('effect.a', 'effect.b', 'effect.c')
    for place, row in enumerate(rows.source[:5]):
        q = measured.q[row] + arrays['joint'][row] @ theta
        point = CHAIN.positions(q, extended.markers(x)[measured.marker[row]], extended.offsets(x))
        step = theta - arrays['theta0']
        point += arrays['displacement0'][row] + arrays['displacement'][row] @ step
        expected = apply(extended.corrections(x)[measured.sensor[row]], point)
        for z in (x, np.stack((x, x))):
            predicted = extended.predict(z, rows)[..., place, :]
            np.testing.assert_allclose(predicted, np.broadcast_to(expected, predicted.shape))


@pytest.mark.parametrize('kind', ['pinned', 'natural'])
def test_the_derivative_with_effects_is_that_of_the_prediction(
    extended: Model, measured, x, kind: str
) -> None:
    x = np.concatenate((x, [0.7, -0.4, 0.2]))
    test_the_derivative_is_that_of_the_prediction(extended, measured, x, kind)


def test_rows_are_grouped_by_sensor_and_pose(measured, model: Model) -> None:
    rows = rows_of(measured, model)
    for start, size, sensor in zip(
        rows.group_start, rows.group_size, rows.group_sensor, strict=True
    ):
        source = rows.source[start : start + size]
        assert len(set(measured.pose[source])) == 1
        assert set(measured.sensor[source]) == {sensor}
    assert rows.group_size.sum() == len(measured)
    assert len(rows.group_start) == 12
