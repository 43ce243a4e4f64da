# SPDX-License-Identifier: Apache-2.0
"""Effects of an arm that moves: columns by their own equations, and what discover says of them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from worlds.calibration_scenes import CHAIN
from worlds.discovery_scenes import residuals_of, session_with
from worlds.moving_bags import imported, recorded
from worlds.moving_world import Dynamics

from remaster_ros.cli.main import main
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS, MOTION
from remaster_ros.kinematics.transforms import apply
from remaster_ros.session.records.reader import write_session

STEP_S = 1e-4
SEED = 5


def q_at(t):
    k = np.arange(1, len(CHAIN) + 1)
    return 0.5 * np.sin(0.7 * np.outer(t, k) / len(CHAIN) + k)


@pytest.fixture(scope='module')
def scene() -> Context:
    """Readings along a smooth path, two sensors in turn."""
    still = residuals_of(session_with(11, poses=8, validation=0, sensor_count=2)).context
    n = len(still.measurements)
    t = 0.1 * np.arange(n)
    h = STEP_S
    m = replace(
        still.measurements,
        q=q_at(t),
        stamp_s=t,
        sensor=np.arange(n) % 2,
        velocity=(q_at(t + h) - q_at(t - h)) / (2.0 * h),
        acceleration=(q_at(t + h) - 2.0 * q_at(t) + q_at(t - h)) / h**2,
    )
    return replace(still, measurements=m, joint_offsets=np.zeros(len(CHAIN)))


def points(scene, q):
    return CHAIN.positions(q, scene.markers[scene.marker])


def column(scene, name, which=0, parameter=0):
    candidate = list(EFFECTS[name].candidates(scene))[which]
    return candidate.columns(scene).displacement(scene)[:, :, parameter]


def test_clocks_move_the_arm_on_in_time(scene):
    t = scene.measurements.stamp_s
    later = (points(scene, q_at(t + STEP_S)) - points(scene, q_at(t - STEP_S))) / (2.0 * STEP_S)
    for sensor in range(2):
        mine = (scene.sensor == sensor)[:, None]
        shift = column(scene, 'clock_offset', sensor)
        np.testing.assert_allclose(shift, later * mine, atol=1e-6)
        middle = t[scene.sensor == sensor].mean()
        drift = column(scene, 'clock_drift', sensor)
        np.testing.assert_allclose(drift, later * mine * (t - middle)[:, None], atol=1e-5)


@pytest.mark.parametrize('joint', [1, 2, 4])
def test_lag_and_inertia_turn_one_joint(scene, joint):
    q, unit = scene.measurements.q, np.eye(len(CHAIN))[joint - 1]
    t = scene.measurements.stamp_s
    late = q + unit * (q_at(t + 1e-5) - q) / 1e-5 * 1e-6
    expected = (points(scene, late) - points(scene, q)) / 1e-6
    np.testing.assert_allclose(column(scene, 'joint_lag', joint - 1), expected, atol=1e-4)
    torque = scene.motion.inertial_torque[:, [joint - 1]]
    bent = (points(scene, q + 1e-6 * unit * torque) - points(scene, q)) / 1e-6
    inertia = column(scene, 'inertial_deflection', joint - 1)
    np.testing.assert_allclose(inertia, bent, atol=1e-4 * np.abs(bent).max())


def test_the_tool_swings_behind_the_acceleration_of_its_frame_and_of_what_is_further_out(scene):
    t, h = scene.measurements.stamp_s, 1e-3
    turn = CHAIN.forward(q_at(t))[:, :3, :3]
    middle = scene.markers.mean(axis=0)
    for first, place in ((0, np.zeros(3)), (3, middle)):
        before, here, after = (apply(CHAIN.forward(q_at(t + s)), place) for s in (-h, 0.0, h))
        moved = (after - 2.0 * here + before) / h**2
        for axis in range(3):
            along = np.sum(moved * turn[:, :, axis], axis=1, keepdims=True)
            found = column(scene, 'tool_mode', 0, axis)
            if first:
                found = found + column(scene, 'tool_mode', 0, first + axis)
            np.testing.assert_allclose(
                found, -along * turn[:, :, axis], atol=1e-3 * np.abs(moved).max()
            )


@pytest.mark.parametrize('name', MOTION)
def test_each_has_words_and_columns_of_any_rows(name, scene):
    effect = MOTION[name]
    assert effect.name == name
    assert effect.needs(scene) == ''
    assert effect.equation
    assert effect.source
    assert effect.plausible[0] < effect.plausible[1]
    assert effect.remedy
    rows = np.random.default_rng(5).permutation(len(scene))[: len(scene) // 3]
    part = scene.at(rows)
    for candidate in effect.candidates(scene):
        columns = candidate.columns(scene)
        assert columns.displacement(scene).shape == (len(scene), 3, candidate.size)
        np.testing.assert_allclose(
            candidate.columns(part).displacement(part),
            columns.displacement(scene)[rows],
            rtol=1e-9,
            atol=1e-12,
        )
        draws = np.random.default_rng(1).normal(1e-4, 1e-5, (50, candidate.size))
        assert '±' in effect.size(scene, candidate, draws)


def test_they_are_tried_on_no_arm_that_stood_still(scene):
    assert not {*MOTION} & {*EFFECTS}
    # Pages find equation and source of either kind.
    assert EFFECTS.get('joint_lag') is EFFECTS['joint_lag'] is MOTION['joint_lag']
    assert EFFECTS.get('none') is None
    still = replace(
        scene, measurements=replace(scene.measurements, velocity=None, acceleration=None)
    )
    assert 'stood still' in MOTION['joint_lag'].needs(still)


def test_discover_names_friction_and_says_how_late_stamps_are(tmp_path, capsys):
    print(f'moving world, seed {SEED}')
    world, recording = recorded(SEED, seconds=20.0, dynamics=Dynamics(scale=3.0))
    write_session(tmp_path / 's', imported(world, recording)[0])
    command = ['discover', str(tmp_path / 's'), '--out', str(tmp_path / 'd'), '--no-figures']
    assert main(command) == 0
    assert "bar's stamps are" in capsys.readouterr().out
    found = json.loads((tmp_path / 'd' / 'discovery.json').read_text(encoding='utf-8'))
    late = found['clocks']['bar']
    assert abs(-late['late_ms'] - 1e3 * recording.delay_s) < 4.0 * late['std_ms']
    friction = next(effect for effect in found['effects'] if effect['name'] == 'friction_windup')
    # Two joints of the largest wind-up are among those named.
    largest = np.argsort(-np.abs(recording.windup_rad))[:2] + 1
    assert {*largest.tolist()} & {*friction['joints']}
    for parameter in friction['parameters']:
        if parameter['name'].startswith('windup'):
            truth = -recording.windup_rad[int(parameter['name'][-1]) - 1]
            assert abs(parameter['value'] - truth) < 5.0 * parameter['std'] + 2e-5
