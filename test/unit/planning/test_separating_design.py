# SPDX-License-Identifier: Apache-2.0
"""Configurations that tell two causes apart, and what they are said to bring."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.sliding_cells import rail, sliding_cell

from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.planning import separating_design as module
from remaster_ros.planning.design_information import nominal_context
from remaster_ros.planning.expected_sensors import (
    ExpectedSensor,
    expected_measurements,
    nominal_model,
)
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.planning.separating_design import (
    measured_so_far,
    scene_with_other_elbows,
    separate,
)
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.types import Priors

CELL = read_cell('demo')
CHAIN = CELL.chain()
SCENE = CELL.planning_scene(CHAIN)
BAR = ExpectedSensor('bar', np.array([1.9, 0, 1.3]), {'sir': np.array([0.1, 0.0, 0.0])})
MARKER_STD = 0.5e-3


def planned(count, seed, scene=SCENE):
    return scene.plan(count, scene.rough_R, np.random.default_rng(seed)).poses


MEASURED, POOL = planned(30, 1), planned(60, 2)


def sag(size=2e-5, *look_alikes):
    alternatives = look_alikes or (('encoder_eccentricity', (2,), 'the whole range'),)
    return FoundCause('joint_compliance', (2,), {'compliance_2': size}, alternatives)


def separated(*causes, pool=POOL):
    return separate(CHAIN, MEASURED, pool, [BAR], MARKER_STD, causes, Priors())


def dense_apart(poses, given=None):
    """By the whole covariance of all readings: how well the amplitude of one is determined.

    Of the sag; and of the waves which imitate that best in the poses given: the smaller.
    """
    base, waves, torque = dense_columns(poses)
    largest = EFFECTS['encoder_eccentricity'].plausible[1]
    soft = EFFECTS['joint_compliance'].plausible[1] / 2e-5
    forward = dense_information(poses, base, waves, torque, largest)
    given_base, given_waves, given_torque = dense_columns(given or poses)
    known = dense_information(given or poses, given_base, given_waves, given_torque, largest)
    imitation = np.linalg.solve(known[:-1, :-1], known[:-1, -1])[-4:]
    backward = dense_information(poses, base, torque, waves @ imitation[:, None], soft)
    return min(1.0 / np.sqrt(np.linalg.inv(matrix)[-1, -1]) for matrix in (forward, backward))


def dense_columns(poses):
    """Return what offsets, registration and marker do; the waves of joint 2; its sag."""
    q = np.concatenate([pose.solutions for pose in poses])
    model, x = nominal_model(CHAIN, q, [BAR], Priors())
    context = nominal_context(model, x, expected_measurements(model, q, np.arange(len(q)), [BAR]))
    # Offsets of the inner joints, a registration, a marker: about the points in R.
    points = CHAIN.positions(q, BAR.markers['sir'])
    jacobian = CHAIN.position_jacobian(q, BAR.markers['sir'])
    turns = np.stack([np.cross(axis, points) for axis in np.eye(3)], axis=-1)
    shifts = np.tile(np.eye(3), (len(q), 1, 1))
    tool = CHAIN.forward(q)[:, :3, :3]
    base = np.concatenate([jacobian[:, :, 1:6], shifts, turns, tool], axis=2)
    waves = [wave(order * q[:, 1]) for order in (1, 2) for wave in (np.sin, np.cos)]
    by_joint_2 = jacobian[:, :, 1, None]
    torque = 2e-5 * by_joint_2 * context.gravity_torque[:, 1, None, None]
    return base, by_joint_2 * np.stack(waves, axis=-1)[:, None], torque


def dense_information(poses, base, other, column, std):
    """Return the information on base, another cause of any size and the amplitude of one."""
    pose = np.repeat(
        np.arange(len(poses)), [len(planned_pose.solutions) for planned_pose in poses]
    )
    J = np.concatenate([base, other, column], axis=2).reshape(3 * len(pose), -1)
    noise = BAR.sigma_m**2 * np.eye(len(pose)) + BAR.pose_sigma_m**2 * (pose[:, None] == pose)
    prior = [0.0] * 11 + [MARKER_STD**-2] * 3 + [std**-2] * other.shape[2] + [0.0]
    return J.T @ np.linalg.solve(np.kron(noise, np.eye(3)), J) + np.diag(prior)


def test_it_says_by_how_many_standard_deviations_the_two_differ():
    found = separated(sag())
    (pair,) = found.pairs
    assert (pair.cause, pair.look_alike) == (
        'joint compliance of joint 2',
        'encoder eccentricity of joint 2',
    )
    assert pair.before == pytest.approx(dense_apart(MEASURED), rel=1e-3)
    together = [*MEASURED, *found.poses]
    assert pair.after == pytest.approx(dense_apart(together, MEASURED), rel=1e-3)


def test_what_is_chosen_tells_more_than_any_of_the_pool():
    found = separated(sag())
    (pair,) = found.pairs
    count = sum(len(pose.solutions) for pose in found.poses)
    assert count == module.MOST_ADDED
    # As many taken blindly, pose after pose.
    rng = np.random.default_rng(3)
    blind = []
    for _ in range(5):
        poses, remaining_count = [], count
        for index in rng.permutation(len(POOL)):
            poses.append(POOL[index])
            remaining_count -= len(POOL[index].solutions)
            if remaining_count <= 0:
                break
        blind.append(dense_apart([*MEASURED, *poses], MEASURED))
    gained = pair.after**2 - pair.before**2
    assert gained > 2.0 * (np.mean(np.square(blind)) - pair.before**2)
    # All of them are among the candidates.
    allowed = np.concatenate([pose.solutions for pose in POOL])
    for pose in found.poses:
        for q in pose.solutions:
            assert np.any(np.all(allowed == q, axis=1))


def test_what_is_decided_already_takes_nothing():
    found = separated(sag(1e-3))
    assert found.poses == ()
    assert found.pairs[0].after == found.pairs[0].before > module.DECIDED


def test_time_and_the_way_there_are_asked_of_the_person():
    found = separated(
        sag(
            2e-5,
            ('backlash', (2,), 'both sides'),
            ('registration_drift', (), 'repeated in time'),
            ('unnamed', (2,), 'more poses'),
            ('encoder_scale', (2,), 'the whole range'),
        )
    )
    assert found.otherwise == (
        'joint compliance of joint 2 and backlash of joint 2: both sides',
        'joint compliance of joint 2 and registration drift: repeated in time',
        'joint compliance of joint 2 and unnamed of joint 2: more poses',
    )
    assert [pair.look_alike for pair in found.pairs] == ['encoder scale of joint 2']


def test_several_pairs_share_what_is_added():
    scale = FoundCause(
        'encoder_scale', (6,), {'scale_6': 4e-3}, (('encoder_eccentricity', (6,), 'range'),)
    )
    found = separated(sag(), scale)
    assert len(found.pairs) == 2
    assert all(pair.after > 1.1 * pair.before for pair in found.pairs)
    assert sum(len(pose.solutions) for pose in found.poses) <= module.MOST_ADDED


def test_other_postures_of_a_held_joint_are_candidates():
    further = scene_with_other_elbows(SCENE)
    np.testing.assert_allclose(
        further.inverse_kinematics.held[2], np.radians([-60, -30, 0, 30, 60]), atol=1e-9
    )
    wide = separated(sag(), pool=planned(60, 2, further))
    assert wide.pairs[0].after > separated(sag()).pairs[0].after


def test_a_rail_is_held_elsewhere_by_as_much_as_an_elbow_counts(tmp_path):
    options = {'held_joint': 'rail', 'held_values_deg': [], 'held_values_m': [0.0]}
    cell = read_cell(sliding_cell(tmp_path, rail(), **options))
    further = scene_with_other_elbows(cell.planning_scene(cell.chain()))
    steps = 0.25 * np.radians([-60, -30, 0, 30, 60])
    np.testing.assert_allclose(further.inverse_kinematics.held[0], steps, atol=1e-9)


def session_rows(seed=5):
    """Return measured rows of the poses, one after the other, the arm getting warmer."""
    q = np.concatenate([pose.solutions for pose in MEASURED])
    pose = np.repeat(
        np.arange(len(MEASURED)), [len(planned_pose.solutions) for planned_pose in MEASURED]
    )
    order = np.random.default_rng(seed).permutation(len(q))
    model, _ = nominal_model(CHAIN, q, [BAR], Priors())
    rows = expected_measurements(model, q[order], pose[order], [BAR])
    time_s = 12.0 * np.arange(len(q))
    return replace(
        rows,
        from_q=np.concatenate((np.full((1, len(CHAIN)), np.nan), q[order][:-1])),
        stamp_s=1e9 + time_s,
        temperature_c=21.0 + 8.0 * (1.0 - np.exp(-time_s / 1500.0)),
    )


def test_ways_and_times_of_a_session_count_and_the_order_of_the_visits_is_that_of_the_choice():
    rows = session_rows()
    planned_poses, so_far = measured_so_far(rows)
    assert sum(len(pose.solutions) for pose in planned_poses) == len(rows)
    np.testing.assert_array_equal(so_far.last_q, rows.q[-1])
    backlash = FoundCause(
        'backlash', (4,), {'half_backlash_4': 5e-4}, (('encoder_eccentricity', (4,), 'sides'),)
    )
    drift = FoundCause(
        'registration_drift',
        (),
        {'drift_x_bar': 4e-7, 'drift_y_bar': 0.0, 'drift_z_bar': 2e-7},
        (('thermal_growth', (), 'cold and warm'),),
    )
    found = separate(
        CHAIN, planned_poses, POOL, [BAR], MARKER_STD, [backlash, drift], Priors(), so_far
    )
    assert found.otherwise == ()
    assert [pair.look_alike for pair in found.pairs] == [
        'encoder eccentricity of joint 4',
        'thermal growth',
    ]
    assert all(pair.after > pair.before for pair in found.pairs)
    visits = [
        (pose, place)
        for pose, kept in enumerate(found.poses)
        for place in range(len(kept.solutions))
    ]
    assert sorted(found.order) == visits
    # Joint 4 comes from both sides.
    q = np.array([so_far.last_q, *(found.poses[a].solutions[b] for a, b in found.order)])
    sides = np.sign(np.diff(q[:, 3]))
    assert np.sum(sides > 0) >= len(sides) // 4 <= np.sum(sides < 0)


def test_a_part_of_a_cause_is_tested_against_that_alone_and_all_parameters_have_their_cell():
    both = FoundCause(
        'joint_compliance',
        (2, 4),
        {'compliance_2': 2e-5, 'compliance_4': 2e-5},
        (('joint_compliance', (2,), 'more poses'), ('sensor_scale', (), 'none')),
    )
    unknown = FoundCause('joint_compliance', (2,), {'compliance_9': 1.0}, both.look_alikes[:1])
    found = separated(both, unknown)
    assert [(pair.cause, pair.look_alike) for pair in found.pairs] == [
        ('joint compliance of joints 2, 4', 'joint compliance of joint 2'),
        ('joint compliance of joints 2, 4', 'sensor scale'),
    ]
    assert found.otherwise == (
        'joint compliance of joint 2 and joint compliance of joint 2: more poses',
    )


def test_a_pair_that_no_candidate_separates_takes_nothing():
    found = separated(sag(2e-7))
    assert found.poses == ()
    assert found.pairs == ()
    assert found.otherwise == (
        'joint compliance of joint 2 and encoder eccentricity of joint 2: the whole range',
    )
