"""Configurations that tell two causes apart, and what they are said to bring."""

import numpy as np
import pytest

from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.planning import separating_design as module
from remaster_ros.planning.design_information import nominal_context
from remaster_ros.planning.expected_sensors import (
    ExpectedSensor,
    expected_measurements,
    nominal_model,
)
from remaster_ros.planning.separating_design import FoundCause, further_scene, separate
from remaster_ros.session.workcell import read_cell
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
    others = look_alikes or (('encoder_eccentricity', (2,), 'the whole range'),)
    return FoundCause('joint_compliance', (2,), {'compliance_2': size}, others)


def separated(*causes, pool=POOL):
    return separate(CHAIN, MEASURED, pool, [BAR], MARKER_STD, causes, Priors())


def dense_apart(poses):
    """By the whole covariance of all readings: how well the size of the sag is determined."""
    q = np.concatenate([pose.solutions for pose in poses])
    pose = np.repeat(np.arange(len(poses)), [len(one.solutions) for one in poses])
    model, x = nominal_model(CHAIN, q, [BAR], Priors())
    rows = expected_measurements(model, q, pose, [BAR])
    context = nominal_context(model, x, rows)
    # Offsets of the inner joints, a registration, a marker: about the points in R.
    points = CHAIN.positions(q, BAR.markers['sir'])
    turns = np.stack([np.cross(axis, points) for axis in np.eye(3)], axis=-1)
    torque = context.gravity_torque[:, 1]
    waves = [wave(order * q[:, 1]) for order in (1, 2) for wave in (np.sin, np.cos)]
    by_joint_2 = CHAIN.position_jacobian(q, BAR.markers['sir'])[:, :, 1]
    tool = CHAIN.forward(q)[:, :3, :3]
    J = np.concatenate(
        [
            CHAIN.position_jacobian(q, BAR.markers['sir'])[:, :, 1:6],
            np.tile(np.eye(3), (len(q), 1, 1)),
            turns,
            tool,
            *(by_joint_2[:, :, None] * wave[:, None, None] for wave in waves),
            2e-5 * by_joint_2[:, :, None] * torque[:, None, None],
        ],
        axis=2,
    ).reshape(3 * len(q), -1)
    one = BAR.sigma_m**2 * np.eye(len(q)) + BAR.pose_sigma_m**2 * (pose[:, None] == pose)
    information = J.T @ np.linalg.solve(np.kron(one, np.eye(3)), J)
    # Offsets, translation and turn, marker, waves, size.
    largest = EFFECTS['encoder_eccentricity'].plausible[1]
    prior = [0.0] * 11 + [MARKER_STD] * 3 + [largest] * 4 + [0.0]
    information += np.diag([1.0 / std**2 if std else 0.0 for std in prior])
    return 1.0 / np.sqrt(np.linalg.inv(information)[-1, -1])


def test_it_says_by_how_many_standard_deviations_the_two_differ():
    found = separated(sag())
    (pair,) = found.pairs
    assert (pair.cause, pair.look_alike) == (
        'joint compliance of joint 2',
        'encoder eccentricity of joint 2',
    )
    assert pair.before == pytest.approx(dense_apart(MEASURED), rel=1e-3)
    assert pair.after == pytest.approx(dense_apart([*MEASURED, *found.poses]), rel=1e-3)


def test_what_is_chosen_tells_more_than_any_of_the_pool():
    found = separated(sag())
    (pair,) = found.pairs
    count = sum(len(pose.solutions) for pose in found.poses)
    assert count == module.MOST_FURTHER
    # As many taken blindly, pose after pose.
    rng = np.random.default_rng(3)
    blind = []
    for _ in range(5):
        poses, left = [], count
        for index in rng.permutation(len(POOL)):
            poses.append(POOL[index])
            left -= len(POOL[index].solutions)
            if left <= 0:
                break
        blind.append(dense_apart([*MEASURED, *poses]))
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
        'encoder_scale', (6,), {'scale_6': 1e-3}, (('encoder_eccentricity', (6,), 'range'),)
    )
    found = separated(sag(), scale)
    assert len(found.pairs) == 2
    assert all(pair.after > 1.1 * pair.before for pair in found.pairs)
    assert sum(len(pose.solutions) for pose in found.poses) <= module.MOST_FURTHER


def test_other_postures_of_a_held_joint_are_candidates():
    further = further_scene(SCENE)
    np.testing.assert_allclose(
        further.inverse_kinematics.held[2], np.radians([-60, -30, 0, 30, 60]), atol=1e-9
    )
    wide = separated(sag(), pool=planned(60, 2, further))
    assert wide.pairs[0].after > separated(sag()).pairs[0].after
