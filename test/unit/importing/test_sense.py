# SPDX-License-Identifier: Apache-2.0
"""What import says of rows that do not fit, of too few, and what it proposes."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from foreign.tables import measured, text, write

CASES = Path(__file__).parents[4] / 'shared' / 'cases'
NAMES = [f'A{i}' for i in range(1, 7)]


class Import:
    def __init__(self, folder, imported, rows):
        self.folder, self.imported, self.arm = folder, imported, measured(rows=rows)
        self.urdf = self.arm.urdf
        self.q, self.points = np.rad2deg(self.arm.q), 1e3 * self.arm.points

    def run(self, *args, points=('X', 'Y', 'Z'), status=0):
        """Import the table; return the JSON object, stderr and the session or None."""
        table = text([*NAMES, *points], [*self.q.T, *self.points.T])
        path = write(self.folder, 't.csv', table)
        printed, session = self.imported(self.urdf, path, '--json', *args, status=status)
        return json.loads(printed.stdout), printed.stderr, session


@pytest.fixture
def table(tmp_path, imported):
    return lambda rows=48: Import(tmp_path, imported, rows)


def exchanged(points, rows):
    """Exchange the points of neighbours."""
    moved = points.copy()
    moved[rows] = points[np.array(rows).reshape(-1, 2)[:, ::-1].reshape(-1)]
    return moved


def test_a_few_rows_that_do_not_fit_are_named_and_the_session_is_written(table):
    imported = table(72)
    rows = [7, 8, 30, 31]
    imported.points = exchanged(imported.points, rows)
    found, error, session = imported.run()
    assert found['fits']
    # The header is line 1.
    named = {row['where'] for row in found['rows_off']}
    assert named == {f'{imported.folder / "t.csv"}, line {row + 2}' for row in rows}
    moved = np.linalg.norm(imported.points - 1e3 * imported.arm.points, axis=1)[rows]
    errors = sorted(row['error_mm'] for row in found['rows_off'])
    np.testing.assert_allclose(errors, np.sort(moved), rtol=0.1)
    assert '4 of 72 rows do not fit' in found['warnings'][-1]
    assert 'line 9' in found['warnings'][-1]
    assert '4 of 72 rows do not fit' in error
    assert len(session.measurements) == 72


@pytest.mark.parametrize('count', [8, pytest.param(18, marks=pytest.mark.qualify)])
def test_more_rows_off_than_a_fit_leaves_out_are_no_session(table, count):
    """Of 48, and of them so many in a row that the median does not show them."""
    imported = table()
    imported.points = exchanged(imported.points, list(range(4, 4 + count)))
    found, error, _ = imported.run(status=1)
    assert (found['fits'], found['session']) == (False, None)
    assert len(found['rows_off']) == count
    assert f'{count} of 48 rows do not fit' in error
    assert 'more than a fit leaves out' in error
    imported.run('--unchecked')


def test_a_right_table_has_no_row_off(table):
    found, error, _ = table(100).run()
    assert (found['rows_off'], found['warnings'], error) == ([], [], '')


def test_no_row_is_to_be_removed_because_the_arm_bends(table):
    """By up to 5 mm at some places; what is further off was measured wrong."""
    imported = table(100)
    far = np.argsort(imported.points[:, 2])[-8:]
    imported.points[far, 2] -= np.linspace(2.0, 5.0, 8)
    found, error, session = imported.run()
    assert (found['fits'], found['rows_off'], found['warnings'], error) == (True, [], [], '')
    assert len(session.measurements) == 100
    imported.points[far[:2], 2] -= 30.0
    found, error, _ = imported.run()
    assert len(found['rows_off']) == 2
    assert '2 of 100 rows do not fit' in error


@pytest.mark.parametrize(('rows', 'enough'), [(2, False), (4, False), (5, True)])
def test_fewer_configurations_than_unknowns_are_refused(table, rows, enough):
    """Four offsets, six of the sensor, three of the marker: 13 unknowns, 3 numbers a row."""
    _, error, _ = table(rows).run(status=0 if enough else 1)
    if not enough:
        assert f'{rows} different configurations to fit are too few' in error
        assert '13 unknowns' in error
        assert 'at least 5, ' in error


def test_configurations_measured_again_count_once(table):
    imported = table(2)
    imported.q, imported.points = np.tile(imported.q, (20, 1)), np.tile(imported.points, (20, 1))
    _, error, _ = imported.run(status=1)
    assert '2 different configurations to fit are too few' in error


@pytest.mark.parametrize(
    ('spoil', 'chosen', 'points'),
    [
        (lambda q: q * [1, 1, -1, 1, -1, 1], ['--reverse', 'A3'], ('X', 'Y', 'Z')),
        pytest.param(
            *(lambda q: q, ['--reverse', 'A3'], ('X', 'Y', 'Z')), marks=pytest.mark.qualify
        ),
        pytest.param(
            *(lambda q: q - [0, 90, 0, 0, 0, 0], [], ('px_mm', 'py_mm', 'pz_mm')),
            marks=pytest.mark.qualify,
        ),
        (lambda q: q, [], ('Py [mm]', 'Px [mm]', 'Pz [mm]')),
        pytest.param(
            *(lambda q: q - np.eye(6)[2] * q[:, 1:2], ['--offset', 'A5=0'], ('X', 'Y', 'Z')),
            marks=pytest.mark.qualify,
        ),
    ],
)
def test_a_proposal_is_one_that_the_program_accepts_and_that_helps(table, spoil, chosen, points):
    """Whatever is proposed beside what was told already: added to the command, it is done."""
    imported = table()
    imported.q = spoil(imported.q)
    if points[0].startswith('Py'):
        imported.points = imported.points[:, [1, 0, 2]]
        points = ('Px [mm]', 'Py [mm]', 'Pz [mm]')
    _, error, _ = imported.run(*chosen, points=points, status=1)
    proposed = error.split('to write it so, add ')[1].split('; to write it as')[0]
    found, _, session = imported.run(*chosen, *shlex.split(proposed), points=points)
    assert found['fits'], proposed
    np.testing.assert_allclose(session.measurements.q, imported.arm.q, atol=1e-6, err_msg=proposed)


def test_points_in_a_table_of_their_own_are_exchanged_as_proposed(table):
    """The columns are named as that table has them, not as both are listed."""
    imported = table()
    names = [f'P{i}' for i in range(len(imported.q))]
    joints = write(imported.folder, 'j.csv', text(['name', *NAMES], [names, *imported.q.T]))
    mirrored = imported.points[:, [1, 0, 2]]
    points = write(imported.folder, 'p.csv', text(['name', 'X', 'Y', 'Z'], [names, *mirrored.T]))
    error = imported.imported(imported.urdf, joints, points, status=1)[0].stderr
    proposed = error.split('to write it so, add ')[1].split('; to write it as')[0]
    imported.imported(imported.urdf, joints, points, *shlex.split(proposed))


def test_a_proposal_beyond_the_limits_of_the_robot_is_not_made(table):
    """As if the arm were another: 90 degrees on joint 2 fits, and is refused by the URDF."""
    imported = table()
    right, spoilt = np.radians(imported.q[:, 1]), np.radians(imported.q[:, 1] - 90.0)
    imported.q = imported.q - [0, 90, 0, 0, 0, 0]
    before, joint = imported.arm.urdf.split('<joint name="joint_2" type', 1)
    joint, end, after = joint.partition('</joint>')
    low, high = spoilt.min() - 0.02, spoilt.max() + 0.02
    assert high < right.max()
    narrow = re.sub(
        r'upper="[^"]*"', f'upper="{high}"', re.sub(r'lower="[^"]*"', f'lower="{low}"', joint)
    )
    assert narrow != joint
    imported.urdf = f'{before}<joint name="joint_2" type{narrow}{end}{after}'
    _, error, _ = imported.run(status=1)
    assert 'to write it so, add' not in error
    assert 'nothing was written' in error


def test_an_offset_that_the_data_do_not_determine_is_no_reason_to_refuse(imported):
    """The last joint of the chain, a gripper's, never moves: the one before may be anywhere."""
    if not CASES.is_dir():
        pytest.skip('the tables of other arms are not part of this repository')
    table, urdf = CASES / '12_so101_five_joints.csv', (CASES / 'so101.urdf').read_text()
    for tip in ([], ['--tip-link', 'gripper_frame_link']):
        (out, _), session = imported(urdf, table, *tip)
        assert 'the robot fits to 0.46 mm (median)' in out
        assert len(session.measurements) == 50
