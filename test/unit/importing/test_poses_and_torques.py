# SPDX-License-Identifier: Apache-2.0
"""Columns of 4×4 matrices are a point and a quaternion; those of torques go into the session."""

import numpy as np
import pytest
from foreign.tables import measured, text, write
from scipy.spatial.transform import Rotation

from remaster_ros.importing.assemble import SessionOptions, assemble
from remaster_ros.importing.rows import TableOptions, read_rows

ROWS = 24
NAMES = {
    'rows and columns from 0': [f'T{i}{j}' for i in range(4) for j in range(4)],
    'rows and columns from 1': [f'T_{i}_{j}' for i in range(1, 5) for j in range(1, 5)],
    'as in Python': [f'T[{i}][{j}]' for i in range(4) for j in range(4)],
    'counted from 0': [f'marker_{i}' for i in range(16)],
    'counted from 1': [f'H{i}' for i in range(1, 17)],
}


@pytest.fixture(scope='module')
def arm():
    return measured(rows=ROWS)


def joints_of(arm):
    return [f'J{i + 1}' for i in range(len(arm.chain))]


@pytest.mark.parametrize('by_column', [False, True])
@pytest.mark.parametrize('named', NAMES)
def test_a_matrix_is_a_pose(arm, named, by_column, tmp_path):
    rng = np.random.default_rng(3)
    turns = Rotation.random(ROWS, rng=rng)
    T = np.tile(np.eye(4), (ROWS, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = turns.as_matrix(), arm.points
    cells = (T.swapaxes(1, 2) if by_column else T).reshape(ROWS, 16)
    table = text([*joints_of(arm), *NAMES[named]], [*arm.q.T, *cells.T])
    rows = read_rows([write(tmp_path, 't.csv', table)], arm.chain, TableOptions())
    np.testing.assert_allclose(rows.position, arm.points, atol=1e-6)
    found = Rotation.from_quat(rows.orientation)
    assert np.max((found.inv() * turns).magnitude()) < 1e-5


def test_sixteen_columns_that_are_no_pose_are_none(arm, tmp_path):
    cells = np.random.default_rng(4).uniform(-1.0, 1.0, (ROWS, 16))
    header = [*joints_of(arm), *NAMES['counted from 0'], 'x', 'y', 'z']
    table = text(header, [*arm.q.T, *cells.T, *arm.points.T])
    rows = read_rows([write(tmp_path, 't.csv', table)], arm.chain, TableOptions())
    np.testing.assert_allclose(rows.position, arm.points, atol=1e-6)
    assert rows.orientation is None


@pytest.mark.parametrize('name', ['tau_{}', 'tau_J{}', 'effort{}', 'J{}_effort', 'torque {} [Nm]'])
@pytest.mark.parametrize(('couple', 'reverse'), [((), ()), ((('J3', ('J2', 1)),), ('J5',))])
def test_measured_torques_are_read(arm, name, couple, reverse, tmp_path):
    """Their power is the same however the joints are counted."""
    count = len(arm.chain)
    torques = np.random.default_rng(5).normal(0.0, 20.0, (ROWS, count))
    header = [*joints_of(arm), *(name.format(i + 1) for i in range(count)), 'x', 'y', 'z']
    table = text(header, [*arm.q.T, *torques.T, *arm.points.T])
    rows = read_rows([write(tmp_path, 't.csv', table)], arm.chain, TableOptions())
    np.testing.assert_allclose(rows.effort, torques, atol=1e-6)
    options = SessionOptions(couple=couple, reverse=reverse)
    session, _ = assemble(rows, arm.urdf, arm.chain, options, np.random.default_rng(0), '')
    m = session.measurements
    step, shown = np.diff(m.q, axis=0), np.diff(arm.q, axis=0)
    power = np.sum(m.effort[1:] * step, axis=1)
    np.testing.assert_allclose(power, np.sum(torques[1:] * shown, axis=1), atol=1e-3)
    assert bool(couple) == (not np.allclose(m.effort, torques, atol=1e-6))


@pytest.mark.parametrize('name', ['tau_ext_{}', 'target_torque_{}', 'tau_{} [mNm]'])
def test_other_torques_are_not(arm, name, tmp_path):
    count = len(arm.chain)
    header = [*joints_of(arm), *(name.format(i + 1) for i in range(count)), 'x', 'y', 'z']
    table = text(header, [*arm.q.T, *arm.q.T, *arm.points.T])
    rows = read_rows([write(tmp_path, 't.csv', table)], arm.chain, TableOptions())
    assert rows.effort is None
