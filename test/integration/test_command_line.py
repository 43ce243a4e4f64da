# SPDX-License-Identifier: Apache-2.0
"""The command line at its work: simulate, fit, judge, as real processes.

The seeds are fixed. Were they drawn afresh, a correct program would fail this file less than once
in five hundred draws.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rigs.command_line import ROOT, refusal, remaster

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import (
    apply,
    inverse,
    matrix_from_quaternion_xyzw,
    transform,
)
from remaster_ros.session.records.reader import read_session
from remaster_ros.types import Session

DATA = ROOT.parent / 'shared/data'
SIZE = ('--poses', 24, '--validation', 10)


def simulate(out: Path, *options: object) -> tuple[Session, dict]:
    assert remaster('simulate', out, *SIZE, '--quiet', *options) == ('', '')
    return read_session(out), json.loads((out / 'truth.json').read_text(encoding='utf-8'))


def fit(session: Path, out: Path, *options: object) -> dict:
    remaster('fit', session, '--out', out, '--no-figures', *options)
    return json.loads((out / 'fit.json').read_text(encoding='utf-8'))


@pytest.fixture(scope='module')
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session in `session` and its fit in `fit`."""
    folder = tmp_path_factory.mktemp('made')
    simulate(folder / 'session')
    fit(folder / 'session', folder / 'fit')
    return folder


def expected_positions(session: Session, truth: dict) -> np.ndarray:
    """Return where the sensors would see the markers without noise, by truth.json."""
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    rows = session.measurements
    offsets = np.radians([row['offset_deg'] for row in truth['joint_offsets']])
    expected = np.empty((len(rows), 3))
    for index, (sensor, marker) in enumerate(session.sensors.items()):
        mine = rows.sensor == index
        frame = truth['registration'][sensor]
        rotation = matrix_from_quaternion_xyzw(frame['rotation_xyzw'])
        T_R_N = transform(rotation, frame['translation_m'])
        points = chain.positions(rows.q[mine], truth['markers'][marker]['position_m'], offsets)
        expected[mine] = apply(inverse(T_R_N), points)
    return expected


def test_a_simulated_session_agrees_with_its_truth(tmp_path: Path) -> None:
    session, truth = simulate(
        tmp_path / 's', '--noise-mm', 0, '--pose-noise-mm', 0, '--outliers', 0.03, '--seed', 4
    )
    rows = session.measurements
    error = np.linalg.norm(rows.position - expected_positions(session, truth), axis=1)
    gross = np.isin(rows.observation, truth['outliers'])
    assert gross.any()
    np.testing.assert_allclose(error[gross], 0.02, atol=1e-9)
    assert error[~gross].max() < 1e-9
    assert truth['noise']['mocap'] == {'sigma_m': 0.0, 'pose_sigma_m': 0.0}


def test_a_simulated_session_looks_recorded(made: Path) -> None:
    session = read_session(made / 'session')
    rows = session.measurements
    assert list(session.sensors) == ['mocap', 'tracker']
    first = np.flatnonzero(np.diff(rows.configuration, prepend=-1))
    assert np.isnan(rows.from_q[0]).all()
    np.testing.assert_array_equal(rows.from_q[first[1:]], rows.q[first[:-1]])
    splits = [set(rows.pose[rows.is_validation == split]) for split in (False, True)]
    assert all(splits)
    assert splits[0].isdisjoint(splits[1])
    # All joint solutions of a pose, not one.
    assert len(np.unique(rows.configuration)) > 3 * len(np.unique(rows.pose))


def test_the_seed_decides_all_and_noise_nothing_else(made: Path, tmp_path: Path) -> None:
    def files(folder: Path) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    simulate(tmp_path / 'same')
    assert files(tmp_path / 'same') == files(made / 'session')
    noisy, truth = simulate(tmp_path / 'noisy', '--noise-mm', 1, '--pose-noise-mm', 2)
    first = read_session(made / 'session')
    np.testing.assert_array_equal(noisy.measurements.q, first.measurements.q)
    before = json.loads((made / 'session/truth.json').read_text(encoding='utf-8'))
    assert truth['joint_offsets'] == before['joint_offsets']
    assert truth['registration'] == before['registration']
    _, other = simulate(tmp_path / 'other', '--seed', 1)
    assert other['joint_offsets'] != before['joint_offsets']
    assert other['registration'] != before['registration']


def test_one_sensor_can_be_chosen(tmp_path: Path) -> None:
    session, truth = simulate(tmp_path / 's', '--sensors', 'mocap')
    assert list(session.sensors) == list(truth['registration']) == ['mocap']
    assert len(session.measurements) == len(np.unique(session.measurements.configuration))


@pytest.mark.parametrize(
    ('robot', 'joints'),
    [
        ('iiwa7', 7),
        ('iiwa14', 7),
        (DATA / 'ur10_two_solutions/robot.urdf', 6),
        (DATA / 'irb120_three_points/robot.urdf', 6),
    ],
    ids=['iiwa7', 'iiwa14', 'ur10', 'irb120'],
)
def test_other_robots(robot: str | Path, joints: int, tmp_path: Path) -> None:
    if isinstance(robot, Path) and not robot.is_file():
        pytest.skip('the URDF of a six-joint robot is not beside this repository (../shared)')
    session, truth = simulate(tmp_path / 's', '--robot', robot, '--noise-mm', 0.01)
    assert session.measurements.q.shape[1] == len(truth['joint_offsets']) == joints
    assert len(np.unique(session.measurements.configuration)) > len(
        np.unique(session.measurements.pose)
    )


def test_the_truth_is_found_within_three_std(made: Path, tmp_path: Path) -> None:
    """15 intervals of 3 std miss at least once in 25 draws; of 4 std, as asked for, in 1,000."""
    worst = []
    for seed, sensors in ((0, 'mocap,tracker'), (1, 'mocap'), (2, 'tracker')):
        if seed == 0:
            folder = made / 'session'
            result = json.loads((made / 'fit/fit.json').read_text(encoding='utf-8'))
            truth = json.loads((folder / 'truth.json').read_text(encoding='utf-8'))
        else:
            folder = tmp_path / f'session_{seed}'
            _, truth = simulate(folder, '--seed', seed, '--sensors', sensors)
            result = fit(folder, tmp_path / f'fit_{seed}')
        true = {row['joint']: row['offset_deg'] for row in truth['joint_offsets']}
        found = [row for row in result['joint_offsets'] if row['identifiable']]
        assert [row['joint'] for row in found] == [f'joint_{n}' for n in range(2, 7)]
        # The simulated arm is exactly its drawing.
        std = 'std_if_exactly_drawn_deg'
        z = [(row['mean_deg'] - true[row['joint']]) / row[std] for row in found]
        print(f'seed {seed}, {sensors}: {np.round(z, 2)}')
        worst.append(np.abs(z).max())
        for row in found:
            assert row[std] < 0.02
    assert max(worst) < 4.0


def test_the_fit_does_not_read_the_truth(made: Path, tmp_path: Path) -> None:
    session = tmp_path / 'session'
    session.mkdir()
    for name in ('session.yaml', 'observations.csv', 'robot.urdf'):
        (session / name).write_bytes((made / 'session' / name).read_bytes())
    with_truth = json.loads((made / 'fit/fit.json').read_text(encoding='utf-8'))
    without = fit(session, tmp_path / 'fit')
    for content in (with_truth, without):
        content['sampler'].pop('seconds')
    assert without == with_truth


def test_priors_and_a_precision_are_taken(made: Path, tmp_path: Path) -> None:
    usual = json.loads((made / 'fit/fit.json').read_text(encoding='utf-8'))
    priors = tmp_path / 'priors.yaml'
    priors.write_text('joint_offsets: {joint_1: {mean_deg: 0.1, std_deg: 0.05}}\n')
    fitted = fit(
        made / 'session', tmp_path / 'fit', '--prior', priors, '--precision', 0.04, '--chains', 3
    )
    # The data say nothing of joint 1: the posterior is the prior, to five standard errors.
    first = fitted['joint_offsets'][0]
    assert first['mean_deg'] == pytest.approx(0.1, abs=5 * 0.04 * 0.05)
    assert first['std_deg'] == pytest.approx(0.05, rel=0.15)
    assert 'joint_1' in fitted['gauge'][0]['fixed_by']
    assert usual['joint_offsets'][0]['std_deg'] > 100.0
    sampler = fitted['sampler']
    assert sampler['chains'] == 3
    assert sampler['precision'] <= sampler['precision_wanted'] == 0.04
    assert '4 % wanted' in sampler['message']
    assert usual['sampler']['precision'] <= usual['sampler']['precision_wanted'] == 0.02


def test_accuracy_on_the_own_session_and_on_another(made: Path, tmp_path: Path) -> None:
    offsets = ('--offsets', made / 'fit/fit.json')
    out = tmp_path / 'new' / 'accuracy.json'
    process = remaster('accuracy', made / 'session', *offsets, '--out', out)
    assert process.stderr == ''
    words = ('before', 'after', 'position, sensor', 'distances', 'posterior', 'validation')
    for word in (*words, str(out)):
        assert word in process.stdout
    found = json.loads(out.read_text(encoding='utf-8'))
    assert found['format'] == 'remaster-accuracy/1'
    fitted = json.loads((made / 'fit/fit.json').read_text(encoding='utf-8'))
    for split in ('optimization', 'validation'):
        for metric in ('relative', 'post_registration', 'theoretical'):
            for side in ('before', 'after'):
                mean = found['accuracy'][split][metric][side]['mean_mm']
                expected = fitted['accuracy'][split][metric][side]['mean_mm']
                assert mean == pytest.approx(expected, rel=0.05)

    # Another placement, other markers and another truth: these offsets are of no use there.
    simulate(tmp_path / 'other', '--seed', 9)
    process = remaster('accuracy', tmp_path / 'other', *offsets, '--out', out, '--quiet')
    assert process == ('', '')
    other = json.loads(out.read_text(encoding='utf-8'))['accuracy']['validation']
    assert other['relative']['after']['mean_mm'] > 1.0
    # The offsets of the other arm the wrong way round do harm.
    fit = json.loads((made / 'fit/fit.json').read_text(encoding='utf-8'))
    for row in fit['joint_offsets']:
        row['mean_deg'] *= -1.0
    (tmp_path / 'turned').mkdir()
    (tmp_path / 'turned/fit.json').write_text(json.dumps(fit))
    process = remaster('accuracy', made / 'session', '--offsets', tmp_path / 'turned/fit.json')
    assert process.stderr.count('turned/fit.json: with these offsets the mean error') == 2
    assert 'or it uses them already' in process.stderr


def test_json_is_all_that_is_printed_and_what_the_files_hold(made: Path, tmp_path: Path) -> None:
    session, file = made / 'session', made / 'fit/fit.json'
    out = ('--out', tmp_path / 'fit', '--no-figures')
    found = {}
    for verb, *args in (
        ('simulate', tmp_path / 'made', *SIZE),
        ('fit', session, *out),
        ('accuracy', session, '--offsets', file),
    ):
        process = remaster(verb, *args, '--json')
        assert process.stderr == '', verb
        found[verb] = json.loads(process.stdout)
        assert isinstance(found[verb], dict)
    assert found['simulate'] == json.loads((tmp_path / 'made/truth.json').read_text())
    assert found['fit'] == json.loads((tmp_path / 'fit/fit.json').read_text())
    assert found['fit']['joint_offsets'] == json.loads(file.read_text())['joint_offsets']
    assert found['accuracy']['format'] == 'remaster-accuracy/1'


def test_figures_cost_their_libraries_only_where_they_are_drawn(
    made: Path, tmp_path: Path
) -> None:
    script = (
        'import sys\n'
        'from remaster_ros.cli.main import main\n'
        'status = main(sys.argv[1:])\n'
        "heavy = ('matplotlib', 'plotly', 'jinja2', 'rich', 'mcap', 'rosbags', 'rclpy')\n"
        "print('imported:', [name for name in heavy if name in sys.modules], status)\n"
    )
    command = [sys.executable, '-c', script, 'fit', str(made / 'session'), '--quiet']
    command += ['--out', str(tmp_path), '--no-figures']
    out = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert out == 'imported: [] 0\n'
    assert not (tmp_path / 'report.html').exists()


def test_help_needs_no_numpy() -> None:
    script = (
        'import sys\n'
        'from remaster_ros.cli.main import main\n'
        'try:\n'
        "    main(['--help'])\n"
        'except SystemExit as stop:\n'
        "    print(stop.code, 'numpy' in sys.modules)\n"
    )
    command = [sys.executable, '-c', script]
    out = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert out.splitlines()[-1] == '0 False'


def start(*args: object) -> subprocess.Popen[str]:
    command = [sys.executable, '-m', 'remaster_ros.cli.main', *map(str, args)]
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command,
        stdout=pipe,
        stderr=pipe,
        text=True,
        cwd=ROOT,
        # A shell that runs the tests in the background has them, and what they start, ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def test_a_reader_that_has_gone_is_no_error(made: Path) -> None:
    process = start('accuracy', made / 'session', '--offsets', made / 'fit/fit.json')
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == ''
    process.stderr.close()
    assert process.wait(60) == 128 + signal.SIGPIPE


def test_an_interrupt_stops_in_one_line(made: Path, tmp_path: Path) -> None:
    """The paper's sampler would take minutes; its output folder shows that it has begun."""
    out = tmp_path / 'fit'
    process = start('fit', made / 'session', '--out', out, '--sampler', 'paper')
    deadline = time.monotonic() + 60
    while not out.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGINT)
    stdout, stderr = process.communicate(timeout=30)
    assert (process.returncode, stdout, stderr) == (130, '', 'stopped\n')
    assert not out.exists()


def test_too_little_data_for_the_offsets_ends_with_1(tmp_path: Path) -> None:
    out = tmp_path / 's'
    remaster('simulate', out, '--poses', 2, '--validation', 0)
    assert 'saw 1 pose to fit; at least 3 are needed' in refusal(
        'fit', out, '--out', tmp_path / 'fit', status=1
    )
