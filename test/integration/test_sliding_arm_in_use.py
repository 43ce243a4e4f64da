# SPDX-License-Identifier: Apache-2.0
"""Offsets of an arm with a joint that slides, through all that applies and judges them.

The arm is pinocchio's, and what is reported of it lacks the offsets.
"""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from rigs.command_line import refusal, remaster
from worlds.arms import STANFORD as URDF
from worlds.measured_rows import measured_rows

from remaster_ros.compensation.file import read_compensation
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.records.reader import read_session, write_session
from remaster_ros.types import Session

pin = pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

SEED = 23
NOISE_M = 3e-5
SLIDE = 2
MARKER = np.array([0.03, -0.02, 0.12])
CHAIN = SerialChain.from_urdf(URDF)
OFFSETS = np.array([0.004, -0.006, 2.4e-3, 0.005, 0.007, -0.003])
KNOWN = np.array([False, True, True, True, True, False])
TURN = pin.exp3(np.array([0.3, -0.8, 1.1]))


def places(q: np.ndarray, urdf: str = URDF) -> np.ndarray:
    """Return where the marker is in the base, m, (n, 3)."""
    model = pin.buildModelFromXML(urdf)
    data, frame = model.createData(), model.getFrameId('tool0')
    found = []
    for row in q:
        pin.framesForwardKinematics(model, data, row)
        found.append(data.oMf[frame].act(MARKER))
    return np.array(found)


def seen(reported: np.ndarray, rng: np.random.Generator, more=0.0) -> np.ndarray:
    """Return what a sensor measures of the true arm."""
    points = places(reported + OFFSETS + more) @ TURN.T + np.array([2.0, -1.0, 0.8])
    return points + rng.normal(0.0, NOISE_M, points.shape)


def sampled_angles(rng: np.random.Generator, rows: int) -> np.ndarray:
    margin = 0.05 * (CHAIN.upper - CHAIN.lower)
    return rng.uniform(CHAIN.lower + margin, CHAIN.upper - margin, (rows, len(CHAIN)))


def session_of(q: np.ndarray, points: np.ndarray, **columns) -> Session:
    m = measured_rows(q, points, **columns)
    return Session(URDF, 'base', 'tool0', {'ball': MARKER}, {'mocap': 'ball'}, m)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A session of 60 rows to fit and 40 held out, and its fit in f."""
    print(f'seed {SEED}')
    rng, folder = np.random.default_rng(SEED), tmp_path_factory.mktemp('slide')
    q = sampled_angles(rng, 100)
    held_out = np.arange(100) >= 60
    write_session(folder / 's', session_of(q, seen(q, rng), is_validation=held_out))
    remaster('fit', folder / 's', '--out', folder / 'f', '--quiet', '--no-figures')
    return folder


def test_each_form_holds_the_offset_in_mm(folder, tmp_path):
    for row, truth in zip(
        json.loads((folder / 'f/fit.json').read_text())['joint_offsets'], OFFSETS
    ):
        if row['joint'] == 'j3':
            assert row['std_if_exactly_drawn_mm'] < 0.05
            assert abs(row['mean_mm'] - 1e3 * truth) < 4.5 * row['std_mm']
    file = folder / 'f/apply/compensation.json'
    found = read_compensation(file)
    part = json.loads(file.read_text())['joints'][SLIDE]
    assert part['offset_m'] == found.model.joint_offsets[SLIDE]
    assert 'offset_rad' not in part
    for form in ('urdf', 'pad', 'rising'):
        remaster('export', file, '--to', form, '--out', tmp_path / form, '--quiet')
    urdf = (tmp_path / 'urdf/robot_calibrated.urdf').read_text()
    q = sampled_angles(np.random.default_rng(1), 50)
    true = places(q + np.where(KNOWN, OFFSETS, 0.0))
    assert np.linalg.norm(places(q, urdf) - true, axis=1).max() < 0.3e-3
    assert np.linalg.norm(places(found.command(q), urdf) - places(q), axis=1).max() < 1e-6
    (line,) = (
        line
        for line in (tmp_path / 'pad/remaster.txt').read_text().splitlines()
        if line.startswith('  j3 ')
    )
    assert line.count(' mm') == 4
    assert 'deg' not in line


def test_the_corrected_model_leaves_nothing_to_fit(folder, tmp_path):
    session = read_session(folder / 's')
    urdf = (folder / 'f/apply/robot_calibrated.urdf').read_text()
    write_session(tmp_path / 's', replace(session, urdf=urdf))
    remaster('fit', tmp_path / 's', '--out', tmp_path / 'f', '--quiet', '--no-figures')
    for row in json.loads((tmp_path / 'f/fit.json').read_text())['joint_offsets']:
        if row['identifiable']:
            unit = row['unit']
            assert abs(row[f'mean_{unit}']) < 0.3 * row[f'std_{unit}'] + 1e-4, row


@pytest.mark.parametrize('state', ['in_use', 'not_in_use'])
def test_verify_tells_whether_it_is_in_use(folder, tmp_path, state):
    rng = np.random.default_rng(3)
    file = folder / 'f/apply/compensation.json'
    wanted = sampled_angles(rng, 12)
    reported = read_compensation(file).command(wanted) if state == 'in_use' else wanted
    on = np.ones(len(wanted), np.int64)
    session = session_of(reported, seen(reported, rng), wanted=wanted, correction=on)
    write_session(tmp_path / 's', session)
    assert 'wanted3_m' in (tmp_path / 's/observations.csv').read_text()
    found = json.loads(remaster('verify', tmp_path / 's', '--compensation', file, '--json').stdout)
    assert found['verdict'] == state
    assert found['joints'][SLIDE]['verdict'] == state


def test_a_check_names_a_slide_whose_zero_has_moved_and_by_how_many_mm(folder, tmp_path):
    rng, file = np.random.default_rng(4), folder / 'f/apply/compensation.json'
    q, moved = sampled_angles(rng, 8), 0.5e-3 * (np.arange(6) == SLIDE)
    given = ('--baseline', file, '--history', tmp_path / 'arm.jsonl')
    for day in range(16):
        # The rail stands a little elsewhere each day: that is the same pose.
        at = q + 1e-4 * rng.standard_normal(q.shape)
        session = session_of(at, seen(at, rng, moved if day > 11 else 0.0))
        write_session(tmp_path / f'{day}', session)
        printed = remaster(
            'check', tmp_path / f'{day}', *given, '--out', tmp_path / 'p.html'
        ).stdout
        assert printed.startswith('unchanged') or day > 11, printed
    assert printed.startswith('changed: Changed since check 13 (12): j3; 0.')
    (line,) = (line for line in printed.splitlines() if line.startswith('  j3: '))
    change, unit = re.match(r'  j3: (\S+) ± \S+ (\S+), ', line).groups()
    assert unit == 'mm'
    assert float(change) == pytest.approx(0.5, abs=0.06)
    assert 'deg' not in line
    assert 'j3: changed' in (tmp_path / 'p.html').read_text()


def test_a_table_of_targets_is_corrected_in_its_own_units(folder, tmp_path):
    file = folder / 'f/apply/compensation.json'
    q = sampled_angles(np.random.default_rng(6), 20)
    shown = np.degrees(q)
    shown[:, SLIDE] = 1e3 * q[:, SLIDE]
    units = ['deg', 'deg', 'mm', 'deg', 'deg', 'deg']
    head = ','.join(f'{name} [{unit}]' for name, unit in zip(CHAIN.joint_names, units))
    np.savetxt(tmp_path / 't.csv', shown, '%.6f', ',', header=head, comments='')
    out = ('--out', tmp_path / 'o.csv')
    printed = remaster('compensate', file, tmp_path / 't.csv', *out)
    found = np.loadtxt(tmp_path / 'o.csv', delimiter=',', skiprows=1)
    found /= CHAIN.shown_scale
    assert np.allclose(found, read_compensation(file).command(q), atol=1e-7)
    assert 'j3 changes most, by 2.4' in printed.stdout
    np.savetxt(
        tmp_path / 't.csv', shown, '%.6f', ',', header=head.replace(' [mm]', ''), comments=''
    )
    assert 'the header states no unit of j3, which slides' in refusal(
        'compensate', file, tmp_path / 't.csv', *out
    )


def test_reports_have_no_angle_of_a_slide(folder, tmp_path):
    args = ('--offsets', folder / 'f/fit.json', '--json')
    judged = json.loads(remaster('accuracy', folder / 's', *args).stdout)
    assert judged['joint_offsets_mm']['j3'] == pytest.approx(2.4, abs=0.1)
    assert 'j3' not in judged['joint_offsets_deg']
    for split in ('optimization', 'validation'):
        errors = judged['accuracy'][split]['post_registration']
        assert errors['after']['mean_mm'] < 0.1 < errors['before']['mean_mm']
    out = tmp_path / 'r'
    answer = remaster('report', folder / 's', folder / 'f', '--out', out, '--json').stdout
    steps = [step for group in json.loads(answer)['on_the_pad'] for step in group]
    assert [step['unit'] for step in steps] == ['deg', 'mm', 'deg', 'deg']
    page = (out / 'report.html').read_text(encoding='utf-8')
    assert 'remaster verify' in page
    rows = [row for row in page.split('<tr>') if row.startswith('<td>j3</td>')]
    assert sum(' mm' in row for row in rows) == 2
    assert not any('°' in row for row in rows)
