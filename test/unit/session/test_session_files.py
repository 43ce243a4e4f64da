# SPDX-License-Identifier: Apache-2.0
"""The session reader refuses with one clear line; writer and reader agree to the last bit."""

import logging
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.session.records.reader import read_session, write_session

DATA = Path(__file__).parents[4] / 'shared' / 'data'


@pytest.fixture
def folder(session, tmp_path):
    write_session(tmp_path / 'session', session)
    return tmp_path / 'session'


def assert_same(a, b):
    for name, value in vars(a.measurements).items():
        np.testing.assert_array_equal(getattr(b.measurements, name), value, err_msg=name)
    for name in ('urdf', 'base_link', 'tip_link', 'sensors', 'marker_std_m', 'settle_s'):
        assert getattr(a, name) == getattr(b, name), name
    for name in ('exit_status', 'notes', 'created', 'extra'):
        assert getattr(a, name) == getattr(b, name), name
    assert list(a.markers) == list(b.markers)
    for name, position in a.markers.items():
        np.testing.assert_array_equal(b.markers[name], position)
    assert list(a.base_prior) == list(b.base_prior)
    for name, prior in a.base_prior.items():
        for key, value in vars(prior).items():
            np.testing.assert_allclose(getattr(b.base_prior[name], key), value, rtol=1e-15)


def test_what_is_written_is_read_back_exactly(session, folder):
    assert_same(session, read_session(folder))


@pytest.mark.parametrize('name', ['ur10_two_solutions', 'irb120_three_points'])
def test_real_sets_are_read_as_they_are(name, tmp_path, caplog):
    if not (DATA / name).is_dir():
        pytest.skip('the measured sets are not part of this repository')
    session = read_session(DATA / name)
    lines = (DATA / name / 'observations.csv').read_text().splitlines()
    assert len(session.measurements) == len(lines) - 1
    assert not caplog.records
    write_session(tmp_path / 'copy', session)
    assert_same(session, read_session(tmp_path / 'copy'))


def cell(folder, line, column, value):
    path = folder / 'observations.csv'
    lines = path.read_text().splitlines()
    i = lines[0].split(',').index(column)
    cells = lines[line - 1].split(',')
    cells[i] = value
    lines[line - 1] = ','.join(cells)
    path.write_text('\n'.join(lines) + '\n')


def refused(folder, *parts):
    with pytest.raises(InputError) as caught:
        read_session(folder)
    message = str(caught.value)
    assert '\n' not in message
    for part in parts:
        assert part in message, message
    return message


@pytest.mark.parametrize(
    ('column', 'value', 'problem'),
    [
        ('x_m', 'nan', 'not a finite number'),
        ('x_m', 'inf', 'not a finite number'),
        ('x_m', '1e999', 'not a finite number'),
        ('x_m', '', 'not a finite number'),
        ('x_m', 'abc', 'not a finite number'),
        ('x_m', '1_0', 'not a finite number'),
        ('x_m', ' 1', 'not a finite number'),
        ('x_m', '١', 'not a finite number'),
        ('x_m', '0x1', 'not a finite number'),
        ('y_m', '512.3', 'are the units metres?'),
        ('y_m', '-1e200', 'are the units metres?'),
        ('q2_rad', 'NaN', 'not a finite number'),
        ('q2_rad', '2.1', 'outside the limits of joint_2'),
        ('from_q2_rad', '-2.1', 'outside the limits of joint_2'),
        ('from_q1_rad', '', 'fill all of them or none'),
        ('std_y_m', '', 'fill all of them or none'),
        ('std_y_m', '-1e-5', 'negative'),
        ('temperature_c', 'nan', 'leave the field empty where unknown'),
        ('samples', '2.0', 'not an integer'),
        ('samples', '0', 'less than 1'),
        ('samples', '-1', 'less than 1'),
        ('pose', '', 'not an integer'),
        ('pose', '99999999999999999999', 'not an integer'),
        ('observation', '3', 'already on line 5'),
        ('stamp_s', '0.0', 'time runs backwards'),
        ('sensor', 'camera', 'not among the sensors of session.yaml (mocap, tracker)'),
        ('marker', 'ball', 'not among the markers of session.yaml (sir, smr)'),
        ('split', 'test', 'none of optimization, validation, reference'),
        ('split', 'validation', 'give a pose one split'),
        ('configuration', '0', 'give a configuration one pose'),
    ],
)
def test_a_wrong_cell_is_named(folder, column, value, problem):
    cell(folder, 11, column, value)
    refused(folder, 'observations.csv', 'line 11', f'column {column}', problem)


def test_rows_are_in_the_order_measured(folder):
    cell(folder, 11, 'observation', '100')
    refused(folder, 'line 12', 'column observation', 'in the order measured')


@pytest.mark.parametrize(('excess_deg', 'accepted'), [(0.9, True), (1.1, False)])
def test_joint_limits_have_one_degree_of_grace(folder, excess_deg, accepted):
    cell(folder, 7, 'q1_rad', repr(3.0 + math.radians(excess_deg)))
    if accepted:
        assert read_session(folder).measurements.q[5, 0] > 3.0
    else:
        refused(folder, 'line 7', 'q1_rad')


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ('file', 'old', 'new', 'problem'),
    [
        ('observations.csv', 'x_m,', '', ('line 1', 'column x_m is missing')),
        ('observations.csv', 'samples,', '', ('line 2: ', 'columns instead of')),
        ('observations.csv', 'y_m,', 'x_m,', ("column 'x_m' is given twice",)),
        ('observations.csv', 'q2_rad,', 'q3_rad,', ('for the 2 joints',)),
        ('observations.csv', 'effort2_nm', 'effort3_nm', ('columns effort',)),
        ('observations.csv', '\n1,', '\n\xff1,', ('line 3', 'UTF-8')),
        ('robot.urdf', 'joint_2" type="revolute', 'joint_2" type="fixed', ('q1_rad', '1 joints')),
        (
            'robot.urdf',
            'joint_2" type="revolute',
            'joint_2" type="prismatic',
            ('q2_rad', 'slides', 'q2_m'),
        ),
    ],
)
def test_wrong_columns_are_named(folder, file, old, new, problem):
    path = folder / file
    text = path.read_text()
    assert old in text
    path.write_bytes(text.replace(old, new, 1).encode('latin-1'))
    refused(folder, 'observations.csv', *problem)


def test_missing_parts_are_named(folder, tmp_path):
    refused(tmp_path / 'nowhere', 'nowhere', 'no such session folder')
    for name in ('robot.urdf', 'observations.csv', 'session.yaml'):
        (folder / name).rename(tmp_path / name)
        refused(folder, name, 'no such file')
        (tmp_path / name).rename(folder / name)
    read_session(folder)


@pytest.mark.parametrize('rows', ['', 'header'])
def test_an_empty_session_is_refused(folder, rows):
    path = folder / 'observations.csv'
    path.write_text('' if not rows else path.read_text().splitlines()[0] + '\n')
    refused(folder, 'observations.csv', 'no ')


def test_windows_line_ends_byte_order_mark_and_quotes_are_tolerated(session, folder):
    path = folder / 'observations.csv'
    text = path.read_text().replace(',mocap,', ',"mocap",').replace('\n', '\r\n')
    path.write_bytes(b'\xef\xbb\xbf' + text.encode() + b'\r\n')
    yaml_path = folder / 'session.yaml'
    yaml_path.write_bytes(b'\xef\xbb\xbf' + yaml_path.read_bytes())
    assert_same(session, read_session(folder))


def test_unknown_columns_are_reported_and_left_out(session, folder, caplog):
    path = folder / 'observations.csv'
    lines = path.read_text().splitlines()
    lines = [lines[0] + ',operator', *(line + ',"a,b"' for line in lines[1:])]
    path.write_text('\n'.join(lines) + '\n')
    with caplog.at_level(logging.WARNING, 'remaster_ros'):
        assert_same(session, read_session(folder))
    assert "'operator'" in caplog.text


def test_only_a_line_without_its_end_counts_as_torn(session, folder, caplog):
    path = folder / 'observations.csv'
    data = path.read_bytes()
    last = data.rstrip(b'\n').rfind(b'\n') + 1
    for cut in (*range(last + 1, len(data) - 1, 9), len(data) - 1):
        path.write_bytes(data[:cut])
        caplog.clear()
        with caplog.at_level(logging.WARNING, 'remaster_ros'):
            assert len(read_session(folder).measurements) == len(session.measurements) - 1
        assert 'line 21: cut off' in caplog.text
    path.write_bytes(data[:last] + b'17,\n')
    refused(folder, 'line 21', '2 columns')


@pytest.mark.parametrize(
    ('old', 'new', 'problem'),
    [
        ('remaster-session/1', 'remaster-session/2', "key 'format'"),
        ('format: remaster-session/1', '- a\n#', 'line'),
        ('settle_s: 2.5', 'settle_s: 2.5\ntimes: unknown', 'times'),
        ('settle_s: 2.5', 'settle_s: -1', 'settle_s'),
        ('settle_s: 2.5', 'settle_s: .nan', 'settle_s'),
        ('settle_s: 2.5', 'settle_s: "2.5"', 'settle_s'),
        ('settle_s: 2.5', 'settle_s: 2.5\nsettle_s: 2.5', 'twice'),
        ('settle_s: 2.5', 'settle_s: [', 'line'),
        ('exit_status: complete', 'exit_status: fine', 'exit_status'),
        ('urdf: robot.urdf', 'urdf: /etc/passwd', 'inside the session folder'),
        ('urdf: robot.urdf', 'urdf: ../robot.urdf', 'inside the session folder'),
        ('urdf: robot.urdf', 'urdf: .', 'inside the session folder'),
        ('tip_link: tool', 'tip_link: gripper', 'gripper'),
        ('{marker: sir}', '{marker: ball}', "'ball' is not among the markers"),
        ('sir: [0.1, 0.0, 0.02]', 'sir: [0.1, 0.0]', 'markers'),
        ('sir: [0.1, 0.0, 0.02]', 'sir: [0.1, 0.0, .inf]', 'markers.sir'),
        ('[0.0, 0.0, 0.6, 0.8]', '[0.0, 0.0, 0.6, 0.9]', 'unit quaternion'),
        ('created: ', 'created: yesterday # ', 'ISO 8601'),
    ],
)
def test_a_wrong_session_yaml_is_refused(folder, old, new, problem):
    edit(folder / 'session.yaml', old, new)
    refused(folder, problem)


def test_unknown_yaml_keys_are_reported_and_kept(folder, caplog):
    with caplog.at_level(logging.WARNING, 'remaster_ros'):
        extra = read_session(folder).extra
    assert extra == {'cell': {'operator': 'no', 'humidity': 0.4}, 'robot': {'serial': '0123'}}
    assert re.findall("unknown key '(.*?)'", caplog.text) == ['robot.serial', 'cell']


def test_existing_files_are_not_overwritten(session, folder):
    with pytest.raises(InputError, match='already holds files'):
        write_session(folder, session)


def test_an_output_folder_that_cannot_be(session, tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(InputError, match='cannot be written'):
        write_session(tmp_path / 'file' / 'session', session)


def test_the_writer_refuses_what_the_reader_would(session, tmp_path):
    measurements = replace(session.measurements, q=session.measurements.q + 2)
    with pytest.raises(InputError, match='outside the limits'):
        write_session(tmp_path / 'a', replace(session, measurements=measurements))
    with pytest.raises(InputError, match='no usable name'):
        write_session(tmp_path / 'a', replace(session, sensors={'a,b': 'sir'}))
    assert not (tmp_path / 'a').exists()


def test_references_stay_apart_from_what_is_fitted(session, tmp_path):
    """And survive the round trip, in the order measured."""
    m = session.measurements
    of_references = m.pose == 2
    split_session = replace(
        session,
        measurements=m.select(~of_references),
        references=m.select(of_references),
    )
    write_session(tmp_path / 'session', split_session)
    text = (tmp_path / 'session' / 'observations.csv').read_text()
    assert text.count(',reference,') == 4
    found = read_session(tmp_path / 'session')
    for rows, wanted in (
        (found.measurements, split_session.measurements),
        (found.references, split_session.references),
    ):
        np.testing.assert_array_equal(rows.observation, wanted.observation)
        np.testing.assert_array_equal(rows.position, wanted.position)
        assert rows.is_reference is None or rows.is_reference.all()
    assert not set(found.measurements.pose) & set(found.references.pose)
    write_session(tmp_path / 'again', found)
    assert (tmp_path / 'again' / 'observations.csv').read_text() == text
    assert read_session(tmp_path / 'again').select(np.array([0])).references is not None


def test_a_session_of_references_alone_has_nothing_to_fit(folder):
    path = folder / 'observations.csv'
    for split in ('optimization', 'validation'):
        path.write_text(path.read_text().replace(f',{split},', ',reference,'))
    refused(folder, 'reference alone; measure before fitting')


def test_a_pose_is_not_reference_and_fitted(folder):
    edit(folder / 'observations.csv', ',optimization,', ',reference,')
    refused(folder, 'column split: pose 0 is reference on line 2 and optim')
