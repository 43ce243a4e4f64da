# SPDX-License-Identifier: Apache-2.0
"""Sensors that measure poses, simulated: noise as asked for, and a fit that finds the truth."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rigs.command_line import refusal, remaster
from rigs.parallel import in_parallel
from scipy.spatial.transform import Rotation
from scipy.stats import binom
from worlds.calibration_scenes import CHAIN, MARKERS, URDF, random_poses, sensors
from worlds.simple_cells import edited_cell

import remaster_ros
from remaster_ros.calibration.fit import fit_session
from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import inverse, inverse_poses, transform
from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.effect_sampling import EffectSpec
from remaster_ros.simulation.simulated_session import simulate_session

ERROR_RATE = 1e-3
TURN = np.radians(0.02)
KINDS = {
    'tracker': {'turn_sigma_rad': TURN, 'pose_turn_sigma_rad': TURN},
    'camera_stands': {'turn_sigma_rad': TURN, 'depth_sigma_m': 0.2e-3},
    'camera_on_tool': {'turn_sigma_rad': TURN, 'depth_sigma_m': 0.2e-3, 'on_tool': True},
}
SILENT = {'sigma_m': 0.0, 'pose_sigma_m': 0.0, 'turn_sigma_rad': 0.0}


def measured(seed, *, poses=20, effects=(), markers=MARKERS, **sensor):
    """A session and its truth; ``sensor``: what the sensor of marker `sir` is like."""
    print(f'seed {seed}')
    rng = np.random.default_rng(seed)
    visited = random_poses(poses, rng)
    mocap = replace(sensors(rng, 1, 0.1e-3, 0.2e-3)['mocap'], **sensor)
    return simulate_session(
        CHAIN,
        URDF,
        rng,
        poses=visited,
        sensors={'mocap': mocap},
        markers=markers,
        effects=[EffectSpec.parse(effect) for effect in effects],
    )


def true_poses(session, truth):
    """T_N_B of every row by the chain, (n, 4, 4)."""
    body = transform(truth.bodies['sir'], truth.markers['sir'])
    reached = CHAIN.forward(session.measurements.q + truth.joint_offsets)
    return inverse(truth.sensors['mocap'].T_R_N) @ reached @ body


def turn_errors(session, truth):
    """Rotation vectors from the true to the measured orientation, in N, rad, (n, 3)."""
    true = Rotation.from_matrix(true_poses(session, truth)[:, :3, :3])
    return (Rotation.from_quat(session.measurements.orientation) * true.inv()).as_rotvec()


@pytest.mark.parametrize('on_tool', [False, True])
def test_without_noise_it_measures_the_true_pose(on_tool):
    session, truth = measured(61, poses=5, **SILENT, on_tool=on_tool)
    T = true_poses(session, truth)
    np.testing.assert_allclose(session.measurements.position, T[:, :3, 3], atol=1e-12)
    assert np.abs(turn_errors(session, truth)).max() < 1e-12


def test_orientations_change_nothing_else_of_a_seed():
    """What is new is drawn last; the figures are those before there were orientations."""
    plain, truth = measured(62, poses=8)
    turned, same_truth = measured(62, poses=8, turn_sigma_rad=TURN)
    m, other = plain.measurements, turned.measurements
    np.testing.assert_array_equal(m.position, other.position)
    np.testing.assert_array_equal(m.q, other.q)
    np.testing.assert_array_equal(truth.joint_offsets, same_truth.joint_offsets)
    assert m.orientation is None
    assert np.isfinite(other.orientation).all()
    np.testing.assert_allclose(m.position[-1], LAST_POSITION, atol=1e-9)


LAST_POSITION = (-0.6441542256656508, 0.037888999504272984, 1.135874620869191)


@pytest.mark.parametrize(
    'effect',
    ['joint_compliance', 'joint_axis_tilt', 'backlash', 'base_compliance', 'bumped_sensor'],
)
def test_a_hidden_effect_turns_the_body_as_it_turns_three_markers_of_it(effect):
    """The orientation is the one that best maps the markers on the tool to where they are seen."""
    markers = {**MARKERS, 'up': np.array([0.0, 0.0, 0.2])}
    session, truth = measured(
        63,
        poses=8,
        effects=[f'{effect}:2'],
        markers=markers,
        further={'smr': 2, 'up': 3},
        **SILENT,
    )
    m = session.measurements
    tool = np.array([truth.markers[name] for name in ('sir', 'smr', 'up')])
    seen = m.position.reshape(-1, 3, 3)
    assert np.isnan(m.orientation.reshape(-1, 3, 4)[:, 1:]).all()
    given = (
        Rotation.from_quat(m.orientation[::3]) * Rotation.from_matrix(truth.bodies['sir']).inv()
    )
    by_markers = Rotation.concatenate(
        [Rotation.align_vectors(s - s[0], tool - tool[0])[0] for s in seen]
    )
    angle = (given * by_markers.inv()).magnitude()
    as_drawn = inverse(truth.sensors['mocap'].T_R_N) @ CHAIN.forward(
        m.q[::3] + truth.joint_offsets
    )
    moved = (given * Rotation.from_matrix(as_drawn[:, :3, :3]).inv()).magnitude()
    assert moved.max() > 1e-4
    assert angle.max() < 1e-6 + 0.01 * moved.max()


def test_noise_is_what_was_asked_for():
    """600 readings at 150 poses; five standard deviations of each estimate."""
    session, truth = measured(64, poses=150, turn_sigma_rad=1e-3, pose_turn_sigma_rad=3e-3)
    error, pose = turn_errors(session, truth), session.measurements.pose
    poses = [error[pose == number] for number in np.unique(pose)]
    spare = 3 * sum(len(e) - 1 for e in poses)
    within = np.sqrt(np.sum([np.sum((e - e.mean(axis=0)) ** 2) for e in poses]) / spare)
    assert within == pytest.approx(1e-3, rel=5.0 / np.sqrt(2.0 * spare))
    means = np.array([e.mean(axis=0) for e in poses])
    assert means.std() == pytest.approx(3e-3, rel=5.0 / np.sqrt(2.0 * means.size) + 0.02)


@pytest.mark.parametrize('on_tool', [False, True])
def test_noise_along_the_line_of_sight_grows_with_the_square_of_the_distance(on_tool):
    silent = {**SILENT, 'turn_sigma_rad': 0.01, 'on_tool': on_tool, 'depth_sigma_m': 1e-3}
    session, truth = measured(65, poses=100, **silent)
    m = session.measurements
    position, true = m.position, true_poses(session, truth)[:, :3, 3]
    if on_tool:
        # A camera measures what stands in its own frame: how it is turned moves it no way there.
        position, _ = inverse_poses(position, m.orientation)
        T = inverse(true_poses(session, truth))
        true = T[:, :3, 3]
    distance = np.linalg.norm(true, axis=1)
    along = true / distance[:, None]
    error = position - true
    off = np.sum(error * along, axis=1)
    assert np.abs(error - off[:, None] * along).max() < 1e-9
    scaled = off / distance**2
    is_near = distance < np.median(distance)
    assert np.ptp(distance) > 0.5
    for part in (is_near, ~is_near):
        assert scaled[part].std() == pytest.approx(1e-3, rel=5.0 / np.sqrt(2.0 * part.sum()))


def one_session(seed_and_kind):
    """Whether each interval holds the truth, and how many std the body is off; for a pool."""
    seed, kind = seed_and_kind
    session, truth = measured(seed, **KINDS[kind])
    fit = fit_session(session, rng=np.random.default_rng(seed), draws=1000)
    assert fit.identifiable.tolist() == [False, *5 * [True], False]
    assert not fit.orientations.why_not
    low, high = fit.joint_offsets_interval95.T
    holds = (low < truth.joint_offsets) & (truth.joint_offsets < high)
    off = Rotation.from_matrix(truth.bodies['sir'] @ fit.orientations.R_T_B['sir'].T).as_rotvec()
    return holds[fit.identifiable].tolist(), (off / fit.orientations.std_rad['sir']).tolist()


@pytest.mark.timeout(3600)
@pytest.mark.parametrize('sessions', [1, pytest.param(150, marks=pytest.mark.qualify)])
@pytest.mark.parametrize('kind', KINDS)
def test_the_fit_finds_the_truth_as_often_as_it_says(kind, sessions):
    """Of five offsets of each session, as if half of them were independent; see ERROR_RATE."""
    jobs = [(seed, kind) for seed in range(6000, 6000 + sessions)]
    found = list(in_parallel(one_session, jobs, 2 if sessions > 3 else 1))
    inside = np.concatenate([holds for holds, _ in found])
    body = np.abs([off for _, off in found])
    print(f'{kind}: offsets held {inside.mean():.4f}, body {np.mean(body < 1.96):.4f}')
    count = len(inside) // 2
    low, high = binom.ppf((0.5 * ERROR_RATE, 1.0 - 0.5 * ERROR_RATE), count, 0.95) / count
    assert low <= inside.mean() <= high
    # Beyond five standard deviations is 1 of 2 million.
    assert body.max() < 5.0


def test_the_command_writes_what_a_recorder_would_and_the_truth(tmp_path):
    options = ('--sensors', 'mocap', '--poses', '8', '--validation', '0', '--quiet')
    given = ('--orientation-noise-deg', '0.05', '--pose-orientation-noise-deg', '0.1')
    for name, more in (('stands', ()), ('tool', ('--on-tool', '--depth-noise-mm', '0.3'))):
        remaster('simulate', tmp_path / name, *options, *given, *more)
    stands, tool = (read_session(tmp_path / name) for name in ('stands', 'tool'))
    assert (stands.oriented, stands.on_tool) == ({'mocap'}, frozenset())
    assert (tool.oriented, tool.on_tool) == ({'mocap'}, {'mocap'})
    text = (tmp_path / 'stands' / 'session.yaml').read_text()
    assert 'mocap: {marker: sir, orientation: true}' in text
    assert 'mounted_on: tool' in (tmp_path / 'tool' / 'session.yaml').read_text()
    # The board is in front of the camera, whose axis the tool's is.
    board, _ = inverse_poses(tool.measurements.position, tool.measurements.orientation)
    assert (board[:, 2] > 0.8 * np.linalg.norm(board, axis=1)).all()
    truth = json.loads((tmp_path / 'tool' / 'truth.json').read_text())
    noise = truth['noise']['mocap']
    assert noise['depth_sigma_m'] == pytest.approx(0.3e-3)
    assert noise['orientation_sigma_deg'] == pytest.approx(0.05)
    assert noise['pose_orientation_sigma_deg'] == pytest.approx(0.1)
    assert list(truth['bodies']) == ['sir']


def test_the_cell_says_which_of_its_sensors_measure_poses(tmp_path):
    cell = edited_cell(
        tmp_path / 'cell.yaml',
        (
            '    topic: optitrack/marker',
            '    topic: /board\n    message_type: geometry_msgs/msg/PoseStamped\n'
            '    mounted_on: tool',
        ),
    )
    options = ('--cell', cell, '--poses', '25', '--validation', '0', '--quiet', '--seed', '5')
    line = refusal('simulate', tmp_path / 'none', *options)
    assert 'state the noise of an orientation as well (--orientation-noise-deg' in line
    noise = ('--orientation-noise-deg', '0.02', '--depth-noise-mm', '0.2')
    remaster('simulate', tmp_path / 'both', *options, *noise)
    both = read_session(tmp_path / 'both')
    assert both.on_tool == both.oriented == {'mocap'}
    assert set(both.sensors) == {'mocap', 'tracker'}
    posed = both.measurements.sensor == both.sensor_names.index('mocap')
    assert np.isnan(both.measurements.orientation[~posed]).all()
    found = remaster_ros.fit(both)
    truth = json.loads((tmp_path / 'both' / 'truth.json').read_text())
    true = np.radians([row['offset_deg'] for row in truth['joint_offsets']])
    known = found.identifiable
    off = (found.joint_offsets - true)[known] / found.joint_offsets_std[known]
    print(off)
    # Of five, four beyond are less than one in 100,000.
    assert np.sum(np.abs(off) > 2.6) < 3


def test_without_the_options_the_files_of_a_seed_are_the_same_to_the_byte(tmp_path):
    options = ('--sensors', 'mocap', '--poses', '8', '--validation', '2', '--quiet')
    for name, more in (('plain', ()), ('turned', ('--orientation-noise-deg', '0.05'))):
        remaster('simulate', tmp_path / name, *options, *more)
    plain, turned = (
        (tmp_path / name / 'observations.csv').read_text().splitlines()
        for name in ('plain', 'turned')
    )
    assert plain == [line.rsplit(',', 4)[0] for line in turned]
    text = (tmp_path / 'turned' / 'session.yaml').read_text().replace(', orientation: true', '')
    assert (tmp_path / 'plain' / 'session.yaml').read_text() == text
    truth, other = (
        json.loads((tmp_path / name / 'truth.json').read_text()) for name in ('plain', 'turned')
    )
    assert other.pop('bodies')
    other['noise']['mocap'] = {
        key: other['noise']['mocap'][key] for key in truth['noise']['mocap']
    }
    assert list(truth['noise']['mocap']) == ['sigma_m', 'pose_sigma_m']
    assert truth == other


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        (('--on-tool',), 'sensors on the tool measure poses; state the noise of an orientation'),
        (
            ('--pose-orientation-noise-deg', '1'),
            'orientations measure poses; state the noise of an orientation',
        ),
        (
            ('--on-tool', '--orientation-noise-deg', '0.1', '--cell', 'quick'),
            'the marker of a sensor on the tool is its own origin',
        ),
        (('--orientation-noise-deg', '-1'), '--orientation-noise-deg: -1 is less than 0'),
    ],
)
def test_what_does_not_go_together_ends_in_one_line(options, words, tmp_path):
    assert words in refusal('simulate', tmp_path / 'o', '--quiet', *options)
    assert not (tmp_path / 'o').exists()


def test_a_program_simulates_what_the_command_does(tmp_path):
    options = (
        *('--sensors', 'mocap', '--poses', '8', '--validation', '2', '--seed', '7', '--on-tool'),
        *('--noise-mm', '0.2', '--pose-noise-mm', '0.1', '--depth-noise-mm', '0.3'),
        *('--orientation-noise-deg', '0.05', '--pose-orientation-noise-deg', '0.1'),
        *('--outliers', '0.1', '--offset-std-deg', '0.5', '--quiet'),
    )
    remaster('simulate', tmp_path / 's', *options)
    session = read_session(tmp_path / 's')
    made = remaster_ros.simulate(
        poses=8,
        validation_poses=2,
        seed=7,
        sensors=('mocap',),
        noise_m=0.2e-3,
        pose_noise_m=0.1e-3,
        depth_noise_m=0.3e-3,
        orientation_noise_rad=np.radians(0.05),
        pose_orientation_noise_rad=np.radians(0.1),
        on_tool=True,
        outlier_share=0.1,
        offset_std_rad=np.radians(0.5),
    )
    for name in ('q', 'position', 'orientation'):
        read = getattr(session.measurements, name)
        np.testing.assert_allclose(getattr(made.session.measurements, name), read, atol=1e-9)


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        ({'noise_m': -1e-3}, 'noise_m: -0.001 is no number from 0'),
        ({'outlier_share': 2.0}, 'outlier_share: 2 is no number from 0 to 1'),
        ({'offset_std_rad': np.nan}, 'offset_std_rad: nan is no number'),
        ({'on_tool': True}, 'in Python orientation_noise_rad'),
        ({'sensors': ('tracer',)}, "no sensor 'tracer' in the cell (mocap, tracker)"),
    ],
)
def test_a_program_is_told_what_is_wrong(options, words):
    with pytest.raises(InputError) as refused:
        remaster_ros.simulate(poses=8, validation_poses=2, **options)
    assert words in str(refused.value)


def test_a_simulation_without_a_pose_to_fit_is_refused():
    with pytest.raises(InputError, match='no pose to fit is asked for'):
        remaster_ros.simulate(poses=0)
