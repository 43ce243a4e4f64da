# SPDX-License-Identifier: Apache-2.0
"""Sessions of arrays, of columns by name, and of files, from Python."""

import numpy as np
import pytest
from foreign.tables import measured, text, write

import remaster_ros
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.session.cells.robot_description import read_arm


@pytest.fixture
def arm(tmp_path):
    (tmp_path / 'robot.urdf').write_text(measured().urdf)
    return measured()


@pytest.mark.parametrize('side', ['left', 'right'])
def test_of_two_arms_it_is_the_one_that_the_table_names(side, tmp_path):
    sides, parts = ('left', 'right'), ['<link name="base"/>']
    for name in sides:
        parts.append(
            f'<link name="{name}_arm"/><joint name="{name}_j" type="continuous">'
            f'<parent link="base"/><child link="{name}_arm"/><axis xyz="0 0 1"/></joint>'
        )
    urdf, table = tmp_path / 'two.urdf', tmp_path / 'table.csv'
    urdf.write_text(f'<robot name="two">{"".join(parts)}</robot>')
    table.write_text(f'{side}_j.pos,x,y,z\n')
    assert read_arm(urdf, tables=[table])[1].tip_link == f'{side}_arm'
    with pytest.raises(InputError, match='several arms of 1 joints'):
        read_arm(urdf)


def test_arrays_and_columns_by_name_are_a_session(arm, tmp_path):
    urdf = tmp_path / 'robot.urdf'
    session = remaster_ros.session_from(arm.q, arm.points, urdf)
    np.testing.assert_array_equal(session.measurements.q, arm.q)
    np.testing.assert_array_equal(session.measurements.position, arm.points)
    # The order of the columns is that of their names.
    joints = dict(reversed([*zip(arm.chain.joint_names, arm.q.T, strict=True)]))
    points = dict(zip('zyx', arm.points.T[::-1], strict=True))
    named = remaster_ros.session_from(joints, points, urdf)
    np.testing.assert_array_equal(named.measurements.q, arm.q)
    np.testing.assert_array_equal(named.measurements.position, arm.points)


def test_what_is_wrong_is_one_sentence(arm, tmp_path):
    urdf = tmp_path / 'robot.urdf'
    with pytest.raises(InputError, match=r'joints have 40 rows, points 39'):
        remaster_ros.session_from(arm.q, arm.points[1:], urdf)
    with pytest.raises(InputError, match=r"points: there is no column 'x'; it has a, y, z"):
        remaster_ros.session_from(arm.q, dict(zip('ayz', arm.points.T, strict=True)), urdf)
    with pytest.raises(InputError, match=r'joints: \(40, 5\) is not \(rows, 6\)'):
        remaster_ros.session_from(arm.q[:, 1:], arm.points, urdf)
    reversed_q = arm.q * [1, 1, -1, 1, 1, 1]
    with pytest.raises(InsufficientDataError, match='with joint_3 reversed the data fit'):
        remaster_ros.session_from(reversed_q, arm.points, urdf)


def test_a_table_is_imported_as_the_command_does(arm, tmp_path):
    q = np.rad2deg(arm.q) * [1, 1, -1, 1, 1, 1]
    header = [*[f'A{i}' for i in range(1, 7)], 'X', 'Y', 'Z']
    table = write(tmp_path, 't.csv', text(header, [*q.T, *arm.points.T]))
    session = remaster_ros.import_table(table, urdf=tmp_path / 'robot.urdf', reverse=['A3'])
    np.testing.assert_allclose(session.measurements.q, arm.q, atol=1e-7)
    assert session.controller.joints['joint_3'].sign == -1
