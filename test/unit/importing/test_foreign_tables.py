# SPDX-License-Identifier: Apache-2.0
"""Tables of five other programs become sessions, and each session can be fitted."""

import json

import numpy as np
import pytest
from foreign.tables import MARKER, measured, text, write
from rigs.command_line import remaster

from remaster_ros.calibration.fit import fit_session
from remaster_ros.session.records.reader import read_session


@pytest.fixture
def arm():
    return measured()


def assert_fits(session, arm):
    """Assert that the offsets of the inner joints are found, and that some poses are held out."""
    result = fit_session(session, rng=np.random.default_rng(0), draws=300)
    off = (result.joint_offsets - arm.offsets)[1:-1] / result.joint_offsets_std[1:-1]
    assert np.all(np.abs(off) < 5.0), off
    after = result.accuracy['validation']['post_registration']['after']['mean_mm']
    assert after < 0.3


def degrees(arm):
    return list(np.rad2deg(arm.q).T)


def joint_names(arm):
    return [f'A{i + 1}' for i in range(arm.q.shape[1])]


def test_degrees_millimetres_decimal_commas(arm, imported, tmp_path):
    header = ['Nr', *(f'{name} [°]' for name in joint_names(arm)), 'X [mm]', 'Y [mm]', 'Z [mm]']
    columns = [range(1, 41), *degrees(arm), *(1e3 * arm.points.T)]
    path = write(tmp_path, 'messung.csv', text(header, columns, ';', ','), 'cp1252')
    (out, _), session = imported(arm.urdf, path)
    assert 'semicolons between the columns, decimal comma, CP1252' in out
    assert 'A3 [°]  joint 3 (joint_3), deg (header)' in out
    assert 'Y [mm]  y of the marker, mm (header)' in out
    assert '10 of 40 poses held out' in out
    np.testing.assert_allclose(session.measurements.q, arm.q, atol=1e-8)
    np.testing.assert_allclose(session.measurements.position, arm.points, atol=1e-8)
    assert not session.timed
    assert session.created == ''
    assert_fits(session, arm)


def test_a_trackers_export_and_the_joints_beside_it(arm, imported, tmp_path):
    """SpatialAnalyzer writes comments, group and name; the controller has its own order."""
    order = np.random.default_rng(1).permutation(40)
    points = '// SpatialAnalyzer export\n// Units: Millimeters\n' + text(
        ['Group', 'Point Name', 'X', 'Y', 'Z', 'Timestamp'],
        [
            ['Main'] * 40,
            [f'p{i + 1:03d}' for i in order],
            *(1e3 * arm.points[order].T),
            [f'2026-05-04 10:{minute:02d}:30' for minute in range(40)],
        ],
        ', ',
    )
    joints = text(
        ['name', *(f'joint_{i}' for i in range(1, 7))],
        [[f'P{i + 1}' for i in range(40)], *degrees(arm)],
        '\t',
    )
    files = write(tmp_path, 'points.txt', points), write(tmp_path, 'joints.txt', joints)
    (out, _), session = imported(arm.urdf, *files)
    assert '40 rows joined by Point Name and name' in out
    assert 'X           x of the marker, mm' in out.replace('points.txt: ', '')
    assert session.timed
    assert np.ptp(session.measurements.stamp_s) == 39 * 60
    assert session.created == '2026-05-04T10:00:30'
    assert session.exit_status == 'complete'
    np.testing.assert_allclose(session.measurements.q, arm.q[order], atol=1e-8)
    assert_fits(session, arm)


def test_no_times_no_units_no_header(arm, imported, tmp_path):
    """Numbers alone, in rad and m, between blanks; the point's name stands before them."""
    columns = [[f'P{i}' for i in range(40)], *arm.q.T, *arm.points.T]
    path = write(tmp_path, 'table.txt', text([], columns, '  '))
    (out, _), session = imported(arm.urdf, path)
    assert 'no header' in out
    assert 'rad (guessed), by its place' in out
    assert 'm (guessed), by its place' in out
    assert 'no times: causes driven by time are untestable' in out
    assert not session.timed
    assert_fits(session, arm)


def test_a_wrong_tip_is_named_by_the_marker(arm, imported, tmp_path):
    """The marker's place is of the tool frame, and the flange before it was given."""
    header = [*joint_names(arm), 'X_mm', 'Y_mm', 'Z_mm']
    path = write(tmp_path, 't.csv', text(header, [*degrees(arm), *(1e3 * arm.points.T)]))
    marker = ('--marker-mm', *(1e3 * MARKER), '--marker-std-mm', 1)
    tip, other = arm.chain.tip_link, 'link_5'
    # link_5 lies before the last joint.
    (_, error), _ = imported(arm.urdf, path, *marker, '--tip-link', other, status=2)
    assert f"5 joints between 'base_link' and '{other}'" in error
    (_, error), _ = imported(arm.urdf, path, *marker, '--tip-link', 'link_6', status=1)
    assert f'with the tip link {tip} the marker is ' in error
    assert f'add --tip-link {tip};' in error
    assert_fits(imported(arm.urdf, path, *marker, '--tip-link', tip)[1], arm)


def test_a_name_that_the_table_has_otherwise_is_said_not_to_be_used(arm, imported, tmp_path):
    header = [*(f'{name} [deg]' for name in joint_names(arm)), 'x [mm]', 'y [mm]', 'z [mm]']
    columns = [*degrees(arm), *(1e3 * arm.points.T)]
    table = write(
        tmp_path, 'own.csv', text([*header, 'sensor'], [*columns, ['lt'] * 40], ',', '.')
    )
    (out, _), session = imported(arm.urdf, table, '--sensor', 'camera', '--marker', 'ball')
    assert '--sensor camera is not used: the table names its sensors (lt)' in out
    assert session.sensors == {'lt': 'ball'}
    assert '--marker' not in out
    assert 'not used' not in imported(arm.urdf, table, '--sensor', 'lt')[0].stdout


def test_a_cell_file_has_robot_sensor_and_marker(arm, tmp_path):
    (tmp_path / 'arm.urdf').write_text(arm.urdf)
    cell = tmp_path / 'cell.yaml'
    cell.write_text(
        'robot: {urdf: arm.urdf, base_link: base_link, tip_link: tool0}\n'
        f'markers: {{smr: {MARKER.tolist()}}}\n'
        'marker_std_m: 0.001\n'
        'sensors: {leica: {marker: smr, topic: t, rough_position_m: [2.0, 0.0, 0.5]}}\n'
        'aim_at: leica\n'
    )
    header = [*joint_names(arm), 'X_mm', 'Y_mm', 'Z_mm']
    path = write(tmp_path, 't.csv', text(header, [*degrees(arm), *(1e3 * arm.points.T)]))
    out = tmp_path / 'session'
    remaster('import', path, '--cell', cell, '--out', out)
    session = read_session(out)
    assert (session.sensors, session.tip_link) == ({'leica': 'smr'}, 'tool0')
    np.testing.assert_allclose(session.markers['smr'], MARKER)
    assert session.marker_std_m == 0.001
    other = ('--out', f'{out}2', '--tip-link', 'link_6')
    error = remaster('import', path, '--cell', cell, *other, status=1).stderr
    assert 'with the tip link tool0 the marker is' in error


def test_json_has_the_columns_and_the_hint(arm, imported, tmp_path):
    header = [*joint_names(arm), 'X', 'Y', 'Z', 'remark']
    reversed_ = arm.q * [1, -1, 1, -1, 1, 1]
    columns = [*np.rad2deg(reversed_).T, *(1e3 * arm.points.T), ['x'] * 40]
    path = write(tmp_path, 't.csv', text(header, columns))
    found = json.loads(imported(arm.urdf, path, '--json', status=1)[0].stdout)
    assert found['session'] is None
    assert found['hint'].endswith('--reverse A2,A4')
    assert found['columns']['A1'] == 'joint 1 (joint_1), deg (guessed)'
    assert found['columns']['remark'] == 'not used'
    (out, _), session = imported(arm.urdf, path, '--json', '--unchecked')
    assert json.loads(out)['session'] is not None
    np.testing.assert_allclose(session.measurements.q, reversed_, atol=1e-8)


@pytest.mark.parametrize(
    ('options', 'kinds'),
    [
        ((), {}),
        (('--sensor', 'camera'), {'camera': 'camera'}),
        (('--sensor', 'leica_at960'), {'leica_at960': 'tracker'}),
        (('--sensor', 'tracker', '--sensor-kind', 'controller'), {'tracker': 'controller'}),
        (('--sensor-kind', 'tracker'), {'sensor': 'tracker'}),
    ],
)
def test_what_measured_is_known_by_its_name_or_is_said(arm, imported, tmp_path, options, kinds):
    """A lens is looked for only where there may be one."""
    header = ['A1', 'A2', 'A3', 'A4', 'A5', 'A6', 'X', 'Y', 'Z']
    table = write(tmp_path, 'own.csv', text(header, [*np.rad2deg(arm.q).T, *(1e3 * arm.points).T]))
    _, session = imported(arm.urdf, table, *options)
    assert session.sensor_kinds == kinds
