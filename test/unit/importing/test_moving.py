# SPDX-License-Identifier: Apache-2.0
"""Rows of a moving arm from recordings in a world with dynamics of its own."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from worlds.moving_bags import (
    CELL,
    CHAIN,
    held_out_standing,
    imported,
    recorded,
    standing,
    write_bag,
)
from worlds.moving_world import Dynamics, Errors, without_dynamics

from remaster_ros.calibration.dynamics import TRAVELS_RAD, clocks_of, estimate_moving
from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.mistakes import UNKNOWN_MARKER_STD_M
from remaster_ros.cli.main import main
from remaster_ros.errors import InputError
from remaster_ros.importing import bags
from remaster_ros.importing.joint_motion import JointMotion
from remaster_ros.importing.moving import _Frames, effective_turns, with_proof
from remaster_ros.importing.standstills import Stream
from remaster_ros.reports.fit_json import fit_content, read_fit
from remaster_ros.reports.fit_judgement import verdict
from remaster_ros.reports.fit_page import motion_rows
from remaster_ros.session.records.reader import read_session, write_session
from remaster_ros.types import Session

SEED = 7
QUIET = Errors(white_m=2e-5, field_m=0.0)


@pytest.fixture(scope='module')
def recording():
    print(f'moving world, seed {SEED}')
    return recorded(SEED, seconds=15.0)


@pytest.fixture(scope='module')
def session(recording) -> Session:
    return imported(*recording)[0]


def inner(found):
    """Return offsets and stds of the joints that are neither first nor last, rad."""
    model, free = found.model, found.posterior.free
    std = np.sqrt(np.diag(found.mode.covariance))
    of = {int(index): value for index, value in zip(free, std, strict=False)}
    joints = range(1, model.joints - 1)
    return model.offsets(model.natural(found.mode.z))[1:-1], np.array([of[j] for j in joints])


def test_splines_have_the_motion():
    """Positions to the noise, speeds and accelerations to what that makes of them."""
    rng = np.random.default_rng(0)
    t = np.sort(np.arange(0.0, 10.0, 0.008) + rng.normal(0.0, 5e-5, 1250))
    q = np.stack((np.sin(t), 0.5 * np.cos(2.0 * t)), axis=1)
    motion = JointMotion.of(Stream.of(t, q + rng.normal(0.0, 1e-5, q.shape)), 'x')
    at = np.linspace(0.5, 9.5, 200)
    for derivative, expected, tolerance in (
        (0, np.stack((np.sin(at), 0.5 * np.cos(2 * at)), axis=1), 1e-5),
        (1, np.stack((np.cos(at), -np.sin(2 * at)), axis=1), 4e-4),
        (2, np.stack((-np.sin(at), -2.0 * np.cos(2 * at)), axis=1), 2e-2),
    ):
        assert np.sqrt(np.mean((motion.at(at, derivative) - expected) ** 2)) < tolerance
    assert np.all((motion.noise > 5e-6) & (motion.noise < 6e-5))
    assert np.isnan(motion.at(np.array([-1.0, 11.0]))).all()


def test_rows_segments_and_frames(session):
    m = session.measurements
    assert session.is_moving
    assert m.velocity is not None
    rows = np.unique(m.configuration, return_index=True)[1]
    assert np.all(np.bincount(m.configuration) == 4)
    assert np.median(np.diff(m.stamp_s[rows])) == pytest.approx(0.1, abs=0.01)
    assert np.all(np.abs(m.velocity).max(axis=1) > 0.02)
    sizes = np.bincount(m.pose[rows])
    assert np.all((sizes >= 3) & (sizes <= 7))
    held_out = np.unique(m.pose[m.is_validation])
    assert len(held_out) == round(0.25 * len(sizes))
    assert np.all(np.isin(m.samples, range(6, 14)))


def test_a_session_is_written_and_read_to_the_last_digit(session, tmp_path):
    write_session(tmp_path / 's', session)
    again = read_session(tmp_path / 's')
    assert again.clock_offset_s == session.clock_offset_s
    for name, value in vars(session.measurements).items():
        np.testing.assert_array_equal(getattr(again.measurements, name), value, err_msg=name)
    header = (tmp_path / 's' / 'session.yaml').read_text(encoding='utf-8')
    assert header.startswith('format: remaster-session/1.1\n')
    (tmp_path / 's' / 'session.yaml').write_text(header.replace('/1.1', '/1'), encoding='utf-8')
    # Columns of a later format are not known to this one.
    assert not read_session(tmp_path / 's').is_moving
    still = replace(session.measurements, velocity=None, acceleration=None)
    write_session(tmp_path / 't', replace(session, measurements=still, clock_offset_s={}))
    header = (tmp_path / 't' / 'session.yaml').read_text(encoding='utf-8')
    assert header.startswith('format: remaster-session/1\n')
    (tmp_path / 't' / 'session.yaml').write_text(header.replace('/1', '/1.1'), encoding='utf-8')
    with pytest.raises(InputError, match='velocity'):
        read_session(tmp_path / 't')


@pytest.mark.parametrize(
    'clock_s', [0.02, *(pytest.param(c, marks=pytest.mark.qualify) for c in (-0.7, 1.9))]
)
def test_the_offset_of_the_clocks_is_found(clock_s):
    world, recording = recorded(3, seconds=12.0, dynamics=without_dynamics(Dynamics(clock_s=0.0)))
    moved = replace(recording, frame_stamps=recording.frame_stamps - clock_s)
    session, how = imported(world, moved, places={})
    assert session.marker_std_m == UNKNOWN_MARKER_STD_M
    # Its standard deviation is 0.2 ms: the error of the sensor follows the motion.
    assert session.clock_offset_s['bar'] == pytest.approx(clock_s, abs=1e-3)
    assert any('early' in line if clock_s > 0 else 'late' in line for line in how)
    session_at_offset, _ = imported(world, moved, clock_offset_s=clock_s)
    assert session_at_offset.clock_offset_s['bar'] == clock_s


def test_stamps_that_wander_are_replaced_by_the_constant_rate_of_the_frames():
    """By a millisecond or so, as an estimate of the clocks' offset does that is renewed."""
    dynamics = replace(without_dynamics(Dynamics(clock_s=0.0)), jitter_s=0.0)
    world, recording = recorded(3, seconds=12.0, dynamics=dynamics, errors=QUIET)
    t = recording.frame_stamps
    wandering = t + 1.5e-3 * np.sin(2.0 * t) + 0.3e-3 * np.sign(np.sin(9.0 * t))
    session, how = imported(world, replace(recording, frame_stamps=wandering))
    assert any('scatter by 1.' in line and 'a constant rate of 120.00 Hz' in line for line in how)
    given, how = imported(world, recording)
    assert not any('constant rate' in line for line in how)
    assert session.clock_offset_s['bar'] == pytest.approx(given.clock_offset_s['bar'], abs=2e-4)
    # Rows of the wandering stamps themselves err by a tenth of a millimetre and more.
    found = estimate_moving(Problem.of(session))
    rows = found.posterior.rows
    errors = rows.target - found.model.predict(found.mode.z, rows)
    assert np.sqrt(np.mean(errors**2)) < 5e-5


def test_frames_of_no_constant_rate_keep_their_stamps():
    rng = np.random.default_rng(SEED)
    number = np.concatenate((np.arange(400), np.arange(9_000, 9_400), np.arange(9_411, 9_800)))
    regular = 5.0 + number / 119.9
    jittered_stamps = regular + rng.normal(0.0, 5e-4, len(regular))

    def frames(stamps):
        positions = np.zeros((len(stamps), 1, 3))
        return _Frames(np.sort(stamps), positions, np.zeros(1, int)).at_constant_rate()

    # Across a gap of a minute, too.
    np.testing.assert_allclose(frames(jittered_stamps).stamps, regular, atol=1e-4)
    assert frames(np.cumsum(rng.exponential(1.0 / 120.0, 1000))) is None
    assert frames(np.cumsum(rng.choice([0.008, 0.013], 1000))) is None
    assert frames(np.array([1.0])) is None
    # A host that was held up for a moment: its frames come together, and count all the same.
    late = regular.copy()
    late[200:206] = late[205] + 1e-5 * np.arange(6)
    steady = frames(late)
    assert len(steady.stamps) == len(regular)
    np.testing.assert_allclose(steady.stamps, regular, atol=5e-4)


def test_frames_that_are_late_for_a_while_are_not_lost_ones():
    """An estimate of the clocks' offset that wanders by half a period, and ten lost frames."""
    rng = np.random.default_rng(SEED)
    number = np.setdiff1d(np.arange(6000), np.arange(2500, 2510))
    regular = number / 120.0
    late = regular + rng.normal(0.0, 5e-4, len(number))
    for begin, end in ((1000, 1120), (4000, 4200)):
        late[begin:end] += 4.5e-3
    # And a host that is held up again and again: its frames come together.
    for begin in range(300, 5900, 700):
        late[begin : begin + 25] = late[begin + 25] - 1e-6 * np.arange(25, 0, -1)
    positions = np.zeros((len(late), 1, 3))
    steady = _Frames(np.sort(late), positions, np.zeros(1, int)).at_constant_rate()
    assert len(steady.stamps) > 0.99 * len(regular)
    nearest = regular[np.argmin(np.abs(regular[:, None] - steady.stamps), axis=0)]
    np.testing.assert_allclose(steady.stamps, nearest, atol=1e-3)
    assert np.all(np.diff(steady.stamps) > 8e-3)


def test_the_bend_of_a_path_moves_no_row():
    """An arm at the speeds of its maker: 0.1 s bends by a millimetre, rows are right to 0.02."""
    dynamics = replace(without_dynamics(Dynamics(clock_s=0.0)), jitter_s=0.0)
    world, recording = recorded(4, seconds=12.0, tool_speed=None, dynamics=dynamics, errors=QUIET)
    session, _ = imported(world, recording)
    found = estimate_moving(Problem.of(session))
    assert np.all(np.abs(inner(found)[0] - world.joint_offsets[1:-1]) < np.radians(5e-3))
    rows = found.posterior.rows
    errors = rows.target - found.model.predict(found.mode.z, rows)
    assert np.sqrt(np.mean(errors**2)) < 2e-5


def test_offsets_with_honest_intervals_from_motion(session, recording):
    """One of the campaign's sessions, of half the length; beside it the fit without dynamics."""
    world, recording = recording
    found = estimate_moving(Problem.of(session))
    offsets, std = inner(found)
    z = (offsets - world.joint_offsets[1:-1]) / std
    # Five normal numbers are longer than this in 1 of 1,000 worlds.
    assert np.sum(z**2) < 20.5
    naive, naive_std = inner(estimate(Problem.of(session)))
    z = (naive - world.joint_offsets[1:-1]) / naive_std
    assert np.sum(z**2) > 20.5
    late_s, std_s = clocks_of(found)['bar']
    assert abs(-late_s - recording.delay_s) < 4.0 * std_s < 4e-3


def test_fit_has_the_dynamics_and_the_paper_sampler_refuses(session):
    result = fit_session(session, rng=np.random.default_rng(0))
    assert {'clock_bar', 'lag_2', 'windup_3', 'inertia_2', 'tool_mode_x'} <= {*result.theta_names}
    assert result.accuracy['optimization']['relative']['before'] is None
    with pytest.raises(InputError, match='no dynamics'):
        fit_session(session, rng=np.random.default_rng(0), sampler='paper')


@pytest.mark.parametrize('kind', ['point', pytest.param('pose', marks=pytest.mark.qualify)])
def test_a_bag_becomes_a_session(kind, recording, tmp_path, capsys):
    world, recording = recording
    write_bag(tmp_path / 'bag', world, recording, kind)
    (tmp_path / 'arm.urdf').write_text(CELL.urdf_text, encoding='utf-8')
    command = ['import', '--moving', str(tmp_path / 'bag'), '--out', str(tmp_path / 's')]
    command += ['--urdf', str(tmp_path / 'arm.urdf'), '--tip-link', 'tool']
    if kind == 'pose':
        topics = ','.join(f'/bar/ball_{i}/pose' for i in range(1, 5))
        assert main(command) == 2
        command += ['--points', topics]
    assert main(command) == 0
    assert 'the stamps of bar are ' in capsys.readouterr().out
    session = read_session(tmp_path / 's')
    assert list(session.sensors) == ['bar']
    assert len(session.markers) == 4
    assert session.clock_offset_s['bar'] == pytest.approx(recording.delay_s, abs=2e-3)


def test_markers_of_one_message_are_of_one_sensor(recording, monkeypatch):
    """As mocap4r2 publishes them."""
    recording = recording[1]

    def messages(path, seen):
        seen |= {'/joint_states': bags.JOINT_STATE, '/markers': 'mocap4r2_msgs/msg/Markers'}
        for t, q in zip(recording.joint_stamps, recording.joints, strict=True):
            state = SimpleNamespace(
                header=header(t), name=[f'joint_{i}' for i in range(1, 8)], position=q
            )
            yield '/joint_states', bags.JOINT_STATE, state, t
        for t, frame in zip(recording.frame_stamps, recording.points, strict=True):
            markers = [
                SimpleNamespace(
                    marker_name='',
                    marker_index=i,
                    translation=SimpleNamespace(**dict(zip('xyz', place, strict=True))),
                )
                for i, place in enumerate(frame, start=1)
            ]
            message = SimpleNamespace(header=header(t), markers=markers)
            yield '/markers', 'mocap4r2_msgs/msg/Markers', message, t

    def header(t):
        stamp = SimpleNamespace(sec=int(t), nanosec=round(1e9 * (t % 1.0)))
        return SimpleNamespace(stamp=stamp)

    monkeypatch.setattr(bags, '_messages', messages)
    _, streams, columns = bags.read_streams(Path('bag'), CHAIN, point_topics=('/markers',))
    assert [(stream.sensor, stream.marker) for stream in streams] == [
        ('markers', str(i)) for i in range(1, 5)
    ]
    assert columns['/markers/1'] == 'marker 1 of sensor markers, m'
    np.testing.assert_array_equal(streams[2].stream.values, recording.points[:, 2])
    names = {f'/markers/{i}': ('bar', f'ball_{i}') for i in range(1, 5)}
    _, streams, _ = bags.read_streams(Path('bag'), CHAIN, point_topics=('/markers',), names=names)
    assert streams[0].marker == 'ball_1'


@pytest.mark.qualify
def test_moving_frames_agree_with_the_standstills_between_them(tmp_path, capsys):
    print('moving world, seed 5002')
    recording = recorded(5002, seconds=7.0, stops=True, joints_hz=125.0, camera_hz=60.0)
    moving, still = imported(*recording)[0], standing(*recording)
    of_motion, std = inner(estimate_moving(Problem.of(moving)))
    at_rest, rest_std = inner(estimate(Problem.of(still)))
    # Five normal numbers are longer than this in 1 of 1,000 recordings.
    assert np.sum((of_motion - at_rest) ** 2 / (std**2 + rest_std**2)) < 20.5
    for name, session in (('still', still), ('moving', moving)):
        write_session(tmp_path / name, session)
    command = ['fit', str(tmp_path / 'still'), str(tmp_path / 'moving'), '--no-figures']
    assert main([*command, '--out', str(tmp_path / 'fit')]) == 0
    # Of the sensor that saw the arm move, alone.
    assert capsys.readouterr().out.count('stamps are') == 1
    fitted = read_fit(tmp_path / 'fit' / 'fit.json')
    assert list(fitted.clocks) == ['bar_2']
    command = ['discover', str(tmp_path / 'still'), '--out', str(tmp_path / 'd')]
    assert main([*command, '--confirm', str(tmp_path / 'moving')]) == 2
    assert 'was measured while the arm moved' in capsys.readouterr().err


@pytest.fixture(scope='module')
def stopped():
    """Return a recording with standstills, its rows of motion, and the standstills, held out."""
    print('moving world, seed 5003')
    recording = recorded(5003, seconds=7.0, stops=True, joints_hz=125.0, camera_hz=60.0)
    return recording, imported(*recording)[0], held_out_standing(*recording)


def joints_of(recording):
    return Stream.of(recording[1].joint_stamps, recording[1].joints)


def test_standstills_are_held_out_rows_of_a_moving_session(stopped, tmp_path):
    recording, moving, still = stopped
    proved = with_proof(moving, joints_of(recording), 'still', still)
    m, at_rest = proved.measurements, np.all(proved.measurements.velocity == 0.0, axis=1)
    assert at_rest.sum() == len(still.measurements)
    assert np.all(m.is_validation[at_rest])
    assert len(m) == len(moving.measurements) + at_rest.sum()
    assert not set(m.pose[at_rest]) & set(m.pose[~at_rest])
    assert np.all(np.diff(m.stamp_s) >= 0.0)
    np.testing.assert_array_equal(m.observation, np.arange(len(m)))
    write_session(tmp_path / 'proved', proved)
    again = read_session(tmp_path / 'proved').measurements
    np.testing.assert_array_equal(again.velocity, m.velocity)
    np.testing.assert_allclose(again.from_q, m.from_q, atol=1e-12)


@pytest.mark.qualify
def test_standstills_prove_a_fit_of_motion_or_doubt_it(stopped):
    recording, moving, still = stopped
    proved = with_proof(moving, joints_of(recording), 'still', still)
    result = fit_session(proved, rng=np.random.default_rng(0))
    assert result.motion_proof.poses == len(np.unique(still.measurements.pose))
    assert not result.motion_proof.disagree
    assert result.motion_proof.words in verdict(result).points
    rows = dict(motion_rows(fit_content(result)))
    assert rows['stamps of bar'].endswith(('late', 'early'))
    assert [what for what in rows if what.startswith('joint_')] == list(CHAIN.joint_names)
    assert f'{result.motion_proof.standstill_mm:.3f} mm' in [*rows.values()][-1]
    # A joint that stands half a tenth of a degree elsewhere than it did in motion.
    other = replace(still, measurements=replace(still.measurements, q=still.measurements.q + 1e-3))
    doubted = fit_session(
        with_proof(moving, joints_of(recording), 'still', other), rng=np.random.default_rng(0)
    )
    assert doubted.motion_proof.disagree
    assert doubted.motion_proof.words in verdict(doubted).disagreements
    assert verdict(doubted).mood == 'caution'


def test_only_standstills_of_the_same_arm_and_sensors_prove_anything(stopped):
    recording, moving, still = stopped
    joints = joints_of(recording)
    fitted = replace(still.measurements, is_validation=np.zeros(len(still.measurements), bool))
    for other, why in (
        (replace(still, urdf=still.urdf + ' '), 'has another URDF'),
        (moving, 'is itself of a moving arm'),
        (replace(still, measurements=fitted), 'no held-out pose of bar'),
        (replace(still, sensors={'tracker': 'ball_1'}), 'no held-out pose of bar'),
    ):
        with pytest.raises(InputError, match=why):
            with_proof(moving, joints, 'still', other)


def test_the_effective_turn_leaves_the_friction_of_the_whole_way():
    """A servo that overshoots by a tenth of a milliradian, comes back, and rests."""
    t = np.arange(0.0, 8.0, 0.004)
    decay = np.exp(-9.8 * np.maximum(t - 3.0, 0.0)) * np.cos(10.0 * np.maximum(t - 3.0, 0.0))
    q = np.where(t < 3.0, 0.1 * (t - 3.0), 0.0) - np.where(t >= 3.0, 4e-3 * (1.0 - decay), 0.0)
    q = np.stack((q, -q), axis=1)
    noise = np.random.default_rng(0).normal(0.0, 1e-6, q.shape)
    motion = JointMotion.of(Stream.of(t, q + noise), 'x')
    turned = effective_turns(motion, np.array([7.5, 20.0]))
    assert np.isnan(turned[1]).all()
    share, travel = np.zeros(2), float(np.sqrt(np.prod(TRAVELS_RAD)))
    for step in np.diff(q, axis=0):
        side = np.sign(step)
        share = side + (share - side) * np.exp(-np.abs(step) / travel)
    way = q[-1] - turned[0]
    found = np.sign(way) * (1.0 - 2.0 * np.exp(-np.abs(way) / travel))
    assert 0.1 < abs(share[0]) < 0.999
    np.testing.assert_allclose(found, share, atol=0.05)


def test_what_cannot_be_measured_in_motion_is_refused(recording, tmp_path, capsys):
    world, recording = recording
    tenth = slice(None, None, 10)
    rare = replace(
        recording, joint_stamps=recording.joint_stamps[tenth], joints=recording.joints[tenth]
    )
    with pytest.raises(InputError, match='joint states at 25 Hz; at least 40 Hz'):
        imported(world, rare)
    single = replace(
        recording,
        frame_stamps=recording.frame_stamps[::60],
        points=recording.points[::60],
    )
    with pytest.raises(InputError, match='single points'):
        imported(world, single)
    still = replace(recording, joints=np.broadcast_to(recording.joints[0], recording.joints.shape))
    with pytest.raises(InputError, match=r'saw the arm move for 0\.0 s'):
        imported(world, still, clock_offset_s=0.0)
    (tmp_path / 'table.csv').write_text('a,b\n1,2\n', encoding='utf-8')
    command = ['import', '--moving', str(tmp_path / 'table.csv'), '--cell', 'demo']
    assert main([*command, '--out', str(tmp_path / 's')]) == 2
    assert '--moving takes one bag' in capsys.readouterr().err
    command = ['import', str(tmp_path / 'table.csv'), '--cell', 'demo', '--proof', str(tmp_path)]
    assert main([*command, '--out', str(tmp_path / 's')]) == 2
    assert '--proof is for a bag of a moving arm' in capsys.readouterr().err
    # A session is no bag: it is not written again as it is.
    session = tmp_path / 'session'
    (session / 'bag').mkdir(parents=True)
    (session / 'session.yaml').write_text('format: remaster-session/1\n', encoding='utf-8')
    (session / 'bag' / 'metadata.yaml').write_text('', encoding='utf-8')
    command = ['import', '--moving', str(session), '--cell', 'demo', '--out', str(tmp_path / 's')]
    assert main(command) == 2
    assert f'that of this session is {session / "bag"}' in capsys.readouterr().err
