# SPDX-License-Identifier: Apache-2.0
"""``remaster compensate``: a table of joint targets, corrected and back, and what is refused."""

import csv
import json

import numpy as np
import pytest
from rigs.command_line import refusal, remaster
from worlds.compensation_files import arm, save
from worlds.hidden_tours import robot

import remaster_ros
from remaster_ros.compensation.arm_model import Function, Geometry, JointTerm

URDF = robot('lwr4plus')
JOINTS = 7


@pytest.fixture(scope='module')
def file(tmp_path_factory):
    """Return the compensation of an arm with offsets, a soft joint and a length."""
    rng = np.random.default_rng(1)
    shifts = np.zeros((JOINTS + 1, 3))
    shifts[3, 2] = 5e-4
    soft = JointTerm(1, 'x', Function('gravity_torque', 'linear', 1), np.full(1, 3e-5))
    model = arm(
        URDF,
        joint_offsets=np.radians(0.3) * rng.standard_normal(JOINTS),
        joint_terms=(soft,),
        geometry=Geometry(shifts, np.zeros((JOINTS + 1, 3))),
    )
    return save(tmp_path_factory.mktemp('apply'), model, URDF)


def table(path, q, unit='deg', separator=',', decimal='.', time=True):
    names = ['name', *(['time_s'] if time else []), *(f'joint_{j + 1} [{unit}]' for j in range(7))]
    values = np.degrees(q) if unit == 'deg' else q
    with path.open('w', encoding='utf-8', newline='') as out:
        writer = csv.writer(out, delimiter=separator)
        writer.writerow(names)
        for i, row in enumerate(values):
            numbers = [f'{v:.9f}'.replace('.', decimal) for v in row]
            writer.writerow([f'P{i}', *([str(2 * i)] if time else []), *numbers])
    return path


def angles(path, separator=',', decimal='.'):
    with path.open(encoding='utf-8', newline='') as lines:
        rows = list(csv.reader(lines, delimiter=separator))
    return rows[0], np.array([[float(v.replace(decimal, '.')) for v in r[-7:]] for r in rows[1:]])


def wanted(count=20):
    return np.random.default_rng(2).uniform(-1.4, 1.4, (count, JOINTS))


@pytest.mark.parametrize(('unit', 'separator', 'decimal'), [('deg', ',', '.'), ('rad', ';', ',')])
def test_a_table_is_corrected_and_comes_back(file, tmp_path, unit, separator, decimal):
    q = wanted()
    given = table(tmp_path / 'program.csv', q, unit, separator, decimal)
    out, back = tmp_path / 'corrected.csv', tmp_path / 'back.csv'
    facts = json.loads(remaster('compensate', file, given, '--out', out, '--json').stdout)
    header, found = angles(out, separator, decimal)
    assert header == angles(given, separator, decimal)[0]
    found = np.radians(found) if unit == 'deg' else found
    correction = remaster_ros.read_compensation(file)
    np.testing.assert_allclose(found, correction.command(q), rtol=0, atol=2e-8)
    done = correction.compensator.correct(q)
    assert facts['rows'] == len(q)
    assert facts['faded_rows'] == (np.flatnonzero(done.incomplete) + 1).tolist()
    assert facts['residual_mm']['max'] == pytest.approx(1e3 * done.residual_m.max(), abs=1e-4)
    changes = np.degrees(np.abs(found - q).max(axis=0))
    np.testing.assert_allclose(list(facts['change_deg'].values()), changes, atol=1e-5)
    assert all(abs(share) < 10.0 for share in facts['added_speed_percent'].values())
    assert facts['expected_error_mm'] > 0.0
    remaster('compensate', file, out, '--out', back, '--inverse', '--quiet')
    again = angles(back, separator, decimal)[1]
    np.testing.assert_allclose(np.radians(again) if unit == 'deg' else again, q, rtol=0, atol=1e-6)


def test_without_times_there_is_no_added_speed(file, tmp_path):
    given = table(tmp_path / 'program.csv', wanted(3), time=False)
    output = remaster('compensate', file, given, '--out', tmp_path / 'o.csv', '--json').stdout
    assert set(json.loads(output)['added_speed_percent'].values()) == {None}


def test_what_is_refused_is_one_line(file, tmp_path):
    q = wanted(4)
    out = tmp_path / 'out.csv'

    def refused(given, *more):
        line = refusal('compensate', file, given, '--out', out, *more)
        assert not out.exists()
        return line

    good = table(tmp_path / 'good.csv', q)
    bare = tmp_path / 'bare.csv'
    bare.write_text(good.read_text(encoding='utf-8').replace(' [deg]', ''), encoding='utf-8')
    assert '--angles' in refused(bare)
    assert '--max-change-deg' in refused(good, '--max-change-deg', '0.01')
    six = tmp_path / 'six.csv'
    six.write_text(
        '\n'.join(line.rpartition(',')[0] for line in good.read_text().splitlines()) + '\n'
    )
    assert '--joints' in refused(six)
    beyond = q.copy()
    beyond[2, 1] = np.radians(125.0)
    assert 'line 4' in refused(table(tmp_path / 'beyond.csv', beyond))
    assert str(tmp_path / 'none.csv') in refused(tmp_path / 'none.csv')
    assert 'compensation.json' in refusal('compensate', good, good, '--out', out)
