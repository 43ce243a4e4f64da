# SPDX-License-Identifier: Apache-2.0
"""What configurations tell: exact under shared noise, and the standard deviations of the fit."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.designed_sessions import MARKER_STD, measured
from worlds.measured_rows import predict_in_sensor

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import inverse, rotation_vector_to_matrix, transform
from remaster_ros.planning.candidates import PlannedPose
from remaster_ros.planning.design_information import DesignInformation
from remaster_ros.planning.expected_sensors import (
    ExpectedSensor,
    ToolBox,
    expected_measurements,
    nominal_model,
)
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.types import Priors

CELL = read_cell('demo')
CHAIN = CELL.chain()


def planned(count, seed=1):
    scene = CELL.planning_scene(CHAIN)
    return scene.plan(count, scene.rough_R, np.random.default_rng(seed)).poses


def sensors(frame_sigma_m=0.0):
    """Return a bar that sees three markers, one of them also followed by a tracker."""
    body = {'a': np.array([0.1, 0, 0]), 'b': np.array([-0.1, 0, 0]), 'c': np.array([0, 0, 0.06])}
    return (
        ExpectedSensor('bar', np.array([1.9, 0, 1.3]), body, 1e-4, 2e-4, frame_sigma_m),
        ExpectedSensor('tracker', np.array([1.9, 0, 1.1]), {'b': body['b']}, 2e-5, 5e-5),
    )


POSES = planned(14)
WHOLE = DesignInformation.of(CHAIN, POSES, sensors(3e-5), MARKER_STD)


def dense_std(q, pose, expected):
    """Return the offsets' standard deviations by the whole covariance of all readings, rad.

    With derivatives by differences of the prediction in the sensors' own frames.
    """
    model, x = nominal_model(CHAIN, q, expected, Priors())
    rows = expected_measurements(model, q, pose, expected)
    # Where joint 1 and joint 7 are held nothing is left undetermined.
    fixed_joints = [0, 6]
    free = np.setdiff1d(np.arange(model.size), fixed_joints)
    reference = model.reference

    def predicted(values):
        full = x.copy()
        full[free] = values
        parts = full[7:19].reshape(2, 6)
        C = transform(rotation_vector_to_matrix(parts[:, 3:]), parts[:, :3])
        T_R_N = inverse(C) @ reference
        return predict_in_sensor(CHAIN, rows, full[:7], T_R_N, model.markers(full)).ravel()

    step = 1e-6
    J = np.array(
        [
            (predicted(x[free] + step * e) - predicted(x[free] - step * e)) / (2 * step)
            for e in np.eye(len(free))
        ]
    ).T
    axis_covariance = np.zeros((len(rows), len(rows)))
    for i in range(len(rows)):
        sensor = expected[rows.sensor[i]]
        same = rows.sensor == rows.sensor[i]
        axis_covariance[i] += sensor.pose_sigma_m**2 * (same & (rows.pose == rows.pose[i]))
        frame = same & (rows.configuration == rows.configuration[i])
        axis_covariance[i] += sensor.frame_sigma_m**2 * frame
        axis_covariance[i, i] += sensor.sigma_m**2
    covariance = np.kron(axis_covariance, np.eye(3))
    information = J.T @ np.linalg.solve(covariance, J)
    markers = np.isin(free, np.arange(19, model.size))
    information[markers, markers] += 1 / MARKER_STD**2
    return np.sqrt(np.diag(np.linalg.inv(information)))[:5]


def test_it_is_the_information_under_the_whole_covariance_of_all_readings():
    chosen = np.sort(np.random.default_rng(3).permutation(len(WHOLE))[:25])
    expected = dense_std(WHOLE.q[chosen], WHOLE.pose[chosen], sensors(3e-5))
    found = list(WHOLE.joint_std(chosen).values())
    assert found[0] is None
    assert found[6] is None
    np.testing.assert_allclose(found[1:6], expected, rtol=1e-4)


def test_one_more_is_the_sum_with_one_more_and_gains_what_first_order_says():
    rng = np.random.default_rng(4)
    chosen = rng.permutation(len(WHOLE))[:20].tolist()
    candidates = np.setdiff1d(np.arange(len(WHOLE)), chosen)
    each = WHOLE.with_each(chosen, candidates)
    for matrix, other in zip(each, candidates):
        total = WHOLE.total([*chosen, int(other)])
        np.testing.assert_allclose(matrix, total, rtol=1e-9, atol=1e-9 * np.abs(total).max())
    root = rng.standard_normal((len(WHOLE.scale), 3))
    more = each - WHOLE.total(chosen)
    expected = np.einsum('ij,nik,kj->n', root, more, root)
    np.testing.assert_allclose(WHOLE.gains(chosen, root)[candidates], expected, rtol=1e-6)


def test_a_repeat_at_a_pose_tells_less_than_the_same_at_another_pose():
    # Where nearly all noise is the pose's, further solutions add little to it.
    noise = replace(sensors()[0], sigma_m=1e-6)
    split_poses = [PlannedPose(p.T_R_T, q[None]) for p in POSES for q in p.solutions]
    shared = DesignInformation.of(CHAIN, POSES, [noise], MARKER_STD)
    split_information = DesignInformation.of(CHAIN, split_poses, [noise], MARKER_STD)
    assert len(split_information) == len(shared)
    chosen = range(len(split_information))
    loss = np.linalg.eigvalsh(split_information.total(chosen) - shared.total(chosen))
    # Sharing a pose helps directions that differ between its solutions and hurts the others.
    assert loss.max() > 0


def test_the_fit_states_the_standard_deviations_that_were_expected():
    expected = sensors()
    information = DesignInformation.of(CHAIN, POSES, expected, MARKER_STD)
    chosen = np.arange(0, len(information), 2)
    q, pose = information.q[chosen], information.pose[chosen]
    promised = np.array(list(information.joint_std(chosen).values())[1:6], dtype=float)
    rng = np.random.default_rng(5)
    ratios, errors = [], []
    for _ in range(12):
        session, offsets = measured(CHAIN, CELL.urdf_text, (q, pose), expected, rng)
        found = estimate(Problem.of(session))
        free = found.posterior.free.tolist()
        std = np.sqrt(np.diag(found.mode.covariance))
        places = [free.index(joint) for joint in range(1, 6)]
        ratios.append(std[places] / promised)
        natural = found.model.natural(found.mode.z)
        errors.append((natural[1:6] - offsets[1:6]) / promised)
    # The noise is estimated from 50 frames: its standard deviation is known to a tenth.
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1.0, atol=0.06)
    # 60 errors, not all independent: their RMS is 1 within 3 of its standard deviations.
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.3


def test_what_is_known_of_a_joint_beforehand_counts():
    known = Priors(joint_offsets={'joint_2': (0.0, np.radians(1e-4))})
    without = DesignInformation.of(CHAIN, POSES, sensors(), MARKER_STD)
    with_it = DesignInformation.of(CHAIN, POSES, sensors(), MARKER_STD, known)
    few = range(12)
    assert with_it.joint_std(few)['joint_2'] < np.radians(1e-4)
    assert without.joint_std(few)['joint_2'] > np.radians(1e-4)


def test_the_tool_s_box_holds_what_counts_and_an_empty_one_is_refused():
    tips = CHAIN.positions(WHOLE.q, np.zeros(3))
    corner = ToolBox(tips[0], np.array([0.05, 0.05, 0.05]))
    here = DesignInformation.of(CHAIN, POSES, sensors(), MARKER_STD, box=corner)
    assert here.tool_rms(range(20)) != pytest.approx(WHOLE.tool_rms(range(20)))
    nowhere = ToolBox(np.array([5.0, 0, 0]), np.ones(3))
    with pytest.raises(InputError, match='has the tool in poses'):
        DesignInformation.of(CHAIN, POSES, sensors(), MARKER_STD, box=nowhere)
    with pytest.raises(InputError, match='no configuration to choose from'):
        DesignInformation.of(CHAIN, [], sensors(), MARKER_STD)
