# SPDX-License-Identifier: Apache-2.0
"""The same rows as text, workbook, JSON, YAML and arrays are the same to the last digit."""

import json
import re

import numpy as np
import pytest
import yaml
from foreign.tables import measured, text, write
from foreign.workbooks import Day, workbook

from remaster_ros.errors import InputError
from remaster_ros.importing.column_search import find_columns
from remaster_ros.importing.makers.named import NUMBER
from remaster_ros.importing.rows import TableOptions, read_rows
from remaster_ros.importing.text_table import read_table
from remaster_ros.importing.values import times

JOINTS = [f'A{i}' for i in range(1, 7)]
NAMES = [f'P{i:02d}' for i in range(1, 41)]


@pytest.fixture(scope='module')
def arm():
    return measured()


def rounded(arm):
    return np.rad2deg(arm.q).round(4), (1e3 * arm.points).round(3)


def csv_file(folder, q, points):
    return write(folder, 't.csv', text(['name', *JOINTS, *'XYZ'], [NAMES, *q.T, *points.T]))


def sheet(folder, q, points):
    rows = [['Calibration', None, 'cell 3'], [], ['name', *JOINTS, *'XYZ']]
    rows += [[n, *map(float, a), *map(float, p)] for n, a, p in zip(NAMES, q, points)]
    content = workbook({'Notes': [['operator', 'A. B.']], 'Data': rows}, first='B2')
    return write_bytes(folder, 't.xlsx', content)


def sheet_of_texts(folder, q, points):
    rows = [['name', *JOINTS, *'XYZ']]
    for n, a, p in zip(NAMES, q, points):
        rows.append([n, *(f'{v:.4f}'.replace('.', ',') for v in a), *map(float, p)])
    return write_bytes(folder, 't.xlsx', workbook({'Data': rows}))


def two_sheets(folder, q, points):
    joints = [['name', *JOINTS], *([n, *map(float, a)] for n, a in zip(NAMES, q))]
    places = [['name', *'XYZ'], *([n, *map(float, p)] for n, p in zip(NAMES, points))]
    sheets = {'joints': joints, 'points': places, 'old': places}
    return write_bytes(folder, 't.xlsx', workbook(sheets, hidden=['old']))


def records_of(q, points):
    return [
        {'name': n, 'angles': a.tolist(), 'marker': dict(zip('xyz', p.tolist()))}
        for n, a, p in zip(NAMES, q, points)
    ]


def json_lines(folder, q, points):
    lines = [json.dumps(record) for record in records_of(q, points)]
    return write(folder, 't.jsonl', '\n'.join(lines))


def json_list(folder, q, points):
    data = {'robot': 'arm', 'samples': records_of(q, points)}
    return write(folder, 't.json', json.dumps(data, indent=1))


def json_columns(folder, q, points):
    data = {'joint_names': JOINTS, 'q': q.tolist(), 'points': points.tolist()}
    return write(folder, 't.json', json.dumps(data))


def yaml_list(folder, q, points):
    return write(folder, 't.yaml', yaml.safe_dump(records_of(q, points)))


def arrays(folder, q, points):
    path = folder / 't.npz'
    np.savez(path, joints=q, points=points, camera=np.eye(3))
    return path


def one_array(folder, q, points):
    path = folder / 't.npy'
    np.save(path, np.column_stack((q, points)))
    return path


def write_bytes(folder, name, content):
    path = folder / name
    path.write_bytes(content)
    return path


FORMS = [sheet, sheet_of_texts, two_sheets, json_lines, json_list, json_columns, yaml_list]
FORMS += [arrays, one_array]


@pytest.mark.parametrize('form', FORMS)
def test_the_same_content_is_the_same_rows(form, arm, tmp_path):
    q, points = rounded(arm)
    right = read_rows([csv_file(tmp_path, q, points)], arm.chain, TableOptions())
    found = read_rows([form(tmp_path, q, points)], arm.chain, TableOptions())
    np.testing.assert_array_equal(found.q, right.q)
    np.testing.assert_array_equal(found.position, right.position)


@pytest.mark.parametrize('wide', [False, True])
def test_matrices_of_numpy_are_poses(wide, arm, tmp_path):
    poses = arm.chain.forward(arm.q)
    path = tmp_path / 't.npy'
    if wide:
        np.save(path, np.column_stack((arm.q, poses.reshape(-1, 16))))
    else:
        path = tmp_path / 't.npz'
        np.savez(path, joints=arm.q, board=poses.swapaxes(1, 2))
    rows = read_rows([path], arm.chain, TableOptions(length='m'))
    np.testing.assert_array_equal(rows.q, arm.q)
    np.testing.assert_array_equal(rows.position, poses[:, :3, 3])
    assert rows.orientation is not None


def test_dates_of_a_sheet_are_times(tmp_path):
    days = [Day(46_000.0 + i / 1440.0) for i in range(5)]
    rows = [['time', *JOINTS], *([day, *map(float, range(6))] for day in days)]
    table = read_table(write_bytes(tmp_path, 't.xlsx', workbook({'Data': rows})))
    np.testing.assert_allclose(np.diff(times(table, find_columns(table, JOINTS))), 60.0)


def test_messages_that_ros_prints_are_rows(arm, tmp_path):
    order = [2, 0, 1, 3, 5, 4]
    names = arm.chain.joint_names
    messages = []
    for i, q in enumerate(arm.q):
        stamp = {'sec': 1_700_000_000 + 10 * i, 'nanosec': 5}
        listed = [float(q[j]) for j in order]
        named = {'name': [names[j] for j in order], 'position': listed}
        messages.append({'header': {'stamp': stamp, 'frame_id': ''}, **named})
    path = write(tmp_path, 'echo.yaml', yaml.safe_dump_all(messages, sort_keys=False))
    points = write(tmp_path, 'points.csv', text([*'XYZ'], arm.points.T))
    rows = read_rows([points, path], arm.chain, TableOptions(join='order', length='m'))
    np.testing.assert_array_equal(rows.q, arm.q)
    np.testing.assert_allclose(np.diff(rows.stamp_s), 10.0)


def test_bodies_of_qualisys_have_orientations(arm, tmp_path):
    poses = arm.chain.forward(arm.q)
    head = ['NO_OF_FRAMES\t40', 'FREQUENCY\t1', 'DATA_INCLUDED\t6D', 'BODY_NAMES\ttool']
    head += [
        '\t'.join(
            [
                'tool X',
                'Y',
                'Z',
                'Roll',
                'Pitch',
                'Yaw',
                'Residual',
                *(f'Rot[{i}]' for i in range(9)),
            ]
        )
    ]
    lines = []
    for T in poses:
        cells = [*1e3 * T[:3, 3], 0.0, 0.0, 0.0, 0.1, *T[:3, :3].T.ravel()]
        lines.append('\t'.join(f'{cell:.9f}' for cell in cells))
    lines[4] = '\t'.join(['0.000'] * 16)
    table = read_table(write(tmp_path, 'q.tsv', '\n'.join([*head, *lines])))
    assert table.rows[4][1:] == ('',) * 7
    places = np.array([row[1:4] for i, row in enumerate(table.rows) if i != 4], float)
    np.testing.assert_allclose(places, 1e3 * np.delete(poses[:, :3, 3], 4, axis=0), atol=1e-6)
    assert table.turns == {'tool': (4, 5, 6, 7)}


REFUSED = {
    'a key of one record': (
        '{"q": [1, 2], "p": [3, 4, 5]}\n' * 3 + '{"q": [1, 2], "o": [3, 4, 5]}',
        4,
    ),
    'a list that is longer': ('{"q": [1, 2]}\n{"q": [1, 2]}\n{"q": [1, 2, 3]}', 3),
    'a bracket': ('{"q": [1, 2]}\n{"q": [1, 2}\n{"q": [1, 2]}', 2),
    'a key twice': ('{"q": [1, 2]}\n{"q": [1, 2], "q": [1, 2]}\n', 2),
    'a joint of Denso': ('J[1] = J(1, 2, 3)\nJ[2] = J(1, 2)\n', 2),
    'a bracket of Denso': ('J[1] = J(1, 2, 3)\nJ[2] = J(1, 2, 3\n', 2),
    'a state of a reply': (
        '[10:00:00] 0,{1,2,3},GetAngle();\n[10:00:01] 3,{1,2,3},GetAngle();\n',
        2,
    ),
    'a bracket of a reply': (
        '[10:00:00] 0,{1,2,3},GetAngle();\n[10:00:01] 0,{1,2,3,GetAngle();\n',
        2,
    ),
    'a cell of Qualisys': (
        'NO_OF_FRAMES\t2\nFREQUENCY\t9\nMARKER_NAMES\ta\n1\t2\t3\n1\t2\n',
        5,
    ),
    'a key of YAML': ('- q: [1, 2]\n  p: [1, 2, 3]\n' * 3 + '- q: [1, 2]\n  r: [1, 2, 3]\n', 7),
    'aliases without end': (
        '- &a0 [1, 2]\n'
        + ''.join(f'- &a{i} [{", ".join([f"*a{i - 1}"] * 8)}]\n' for i in range(1, 9)),
        1,
    ),
}


@pytest.mark.parametrize('case', REFUSED)
def test_what_is_damaged_is_shown(case, tmp_path):
    content, line = REFUSED[case]
    path = write(tmp_path, 't.txt', content)
    with pytest.raises(InputError, match=rf'^{re.escape(str(path))}, line {line}: '):
        read_table(path)


def test_damaged_archives_are_read_right_or_refused(tmp_path):
    cells = [[float(i) for i in range(9)] for _ in range(3)]
    content = workbook({'Data': [['a', 'b'], *cells]})
    errors = []
    for at in range(30, len(content), 97):
        broken = content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :]
        try:
            table = read_table(write_bytes(tmp_path, 't.xlsx', broken))
        except InputError as error:
            errors.append(str(error))
        else:
            assert all(NUMBER.fullmatch(cell) for row in table.rows for cell in row if cell)
    assert errors
    assert not any('\n' in error for error in errors)
    path = tmp_path / 't.npy'
    np.save(path, np.array([{'a': 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match='no array of numbers'):
        read_table(path)
