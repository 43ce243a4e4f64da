# SPDX-License-Identifier: Apache-2.0
"""Separators, decimal signs and encodings are found; damaged tables give one clear error."""

import random
from contextlib import suppress

import numpy as np
import pytest
from foreign.tables import text, write
from hypothesis import given, settings
from hypothesis import strategies as st

from remaster_ros.errors import InputError
from remaster_ros.importing.column_search import find_columns
from remaster_ros.importing.columns import ColumnChoice
from remaster_ros.importing.rows import TableOptions, read_rows
from remaster_ros.importing.text_table import decode, parse_number, read_table
from remaster_ros.importing.values import numbers, times
from remaster_ros.kinematics.serial_chain import SerialChain

HEADERS = {
    'plain': ['name', 'J1', 'J2', 'X', 'Y', 'Z'],
    'units': ['Nr.', 'A1 [deg]', 'A2 [deg]', 'X [mm]', 'Y [mm]', 'Z [mm]'],
    'german': ['Prüfpunkt', 'Achse1 (°)', 'Achse2 (°)', 'X (mm)', 'Y (mm)', 'Z (mm)'],
    'ros': ['index', 'shoulder_pan_joint', 'elbow_joint', 'x_m', 'y_m', 'z_m'],
}
JOINTS = ('shoulder_pan_joint', 'elbow_joint')
finite = st.floats(-5e3, 5e3).map(lambda value: round(value, 4))
tables = st.lists(st.tuples(*[finite] * 5), min_size=1, max_size=8)


@settings(max_examples=150)
@given(
    rows=tables,
    header=st.sampled_from(sorted(HEADERS)),
    separator=st.sampled_from([';', '\t', ',', '|', '  ', '\t ', ', ']),
    decimal=st.sampled_from('.,'),
    encoding=st.sampled_from(['utf-8', 'utf-8-sig', 'cp1252', 'utf-16', 'utf-16-le']),
    line_end=st.sampled_from(['\n', '\r\n']),
    trailing=st.booleans(),
)
def test_what_was_written_is_read(
    tmp_path_factory, rows, header, separator, decimal, encoding, line_end, trailing
):
    if decimal == ',' and ',' in separator:
        separator = ';'
    names = [f'P{i}' for i in range(len(rows))]
    content = text(HEADERS[header], [names, *map(list, zip(*rows))], separator, decimal)
    if trailing and separator.strip():
        content = content.replace('\n', f'{separator}\n')
    content = content.replace('\n', line_end)
    path = write(tmp_path_factory.mktemp('table'), 't.csv', content, encoding)
    table = read_table(path)
    assert table.has_header
    # Integers alone have no decimal sign, and need none.
    assert table.decimal == decimal or '.' not in text([], [[value] for value in rows[0]])
    columns = find_columns(table, JOINTS)
    values = numbers(table, (*columns.joints, *columns.point))
    np.testing.assert_array_equal(values, np.array(rows))
    assert [row[columns.first_of_kind('name')] for row in table.rows] == names


@pytest.mark.parametrize(
    ('cell', 'decimal', 'value'),
    [
        ('1.234,56', ',', 1234.56),
        ('-1,234,567.5', '.', -1234567.5),
        ('1,5', ',', 1.5),
        ('1,5', '.', None),
        ('1.5', ',', None),
        ('1.234.5', '.', None),
        ('12,34,5', ',', None),
        ('1e-3', '.', 1e-3),
        ('nan', '.', None),
        ('inf', '.', None),
        ('1_000', '.', None),
        ('٣', '.', None),
        ('', '.', None),
        ('1e999', '.', None),
    ],
)
def test_numbers(cell, decimal, value):
    assert parse_number(cell, decimal) == value


@pytest.mark.parametrize(
    ('names', 'joints', 'point'),
    [
        (['A1', 'A2', 'X', 'Y', 'Z'], (0, 1), (2, 3, 4)),
        (['x', 'y', 'z', 'J1', 'J2'], (3, 4), (0, 1, 2)),
        # The other words tell what is meant.
        (['target_q1', 'target_q2', 'actual_q1', 'actual_q2', 'X', 'Y', 'Z'], (2, 3), (4, 5, 6)),
        (['q0', 'q1', 'Px', 'Py', 'Pz', 'Rx', 'Ry', 'Rz'], (0, 1), (2, 3, 4)),
        (['Axis 1 (deg)', 'Axis 2 (deg)', 'X, mm', 'Y, mm', 'Z, mm'], (0, 1), (2, 3, 4)),
        (
            [
                '/joint_states/elbow_joint/position',
                '/joint_states/shoulder_pan_joint/position',
                '/joint_states/elbow_joint/velocity',
                '/joint_states/shoulder_pan_joint/velocity',
                '/tracker/point/x',
                '/tracker/point/y',
                '/tracker/point/z',
            ],
            (1, 0),
            (4, 5, 6),
        ),
        (['θ1', 'θ2', 'PosX', 'PosY', 'PosZ', 'StdX', 'StdY', 'StdZ'], (0, 1), (2, 3, 4)),
        (['TCP_X', 'TCP_Y', 'TCP_Z', 'meas X', 'meas Y', 'meas Z', 'A1', 'A2'], (6, 7), (3, 4, 5)),
    ],
)
def test_headers_in_any_words(names, joints, point, tmp_path):
    path = write(tmp_path, 't.csv', text(names, [[0.5, 1.5]] * len(names), ';'))
    found = find_columns(read_table(path), JOINTS)
    assert (found.joints, found.point) == (joints, point)


def test_what_could_be_several_columns_is_asked_for(tmp_path):
    names = ['A1', 'A2', 'J1', 'J2', 'LT_X', 'LT_Y', 'LT_Z', 'IR_X', 'IR_Y', 'IR_Z']
    path = write(tmp_path, 't.csv', text(names, [[0.5, 1.5]] * len(names), ';'))
    with pytest.raises(InputError, match=r'A1, A2; J1, J2; name them, base to tip, with --joints'):
        find_columns(read_table(path), JOINTS)
    chosen = ColumnChoice(joints=('J2', 'J1'))
    with pytest.raises(InputError, match=r'LT_X, LT_Y, LT_Z; IR_X, IR_Y, IR_Z; .*--points'):
        find_columns(read_table(path), JOINTS, chosen)
    found = find_columns(read_table(path), JOINTS, ColumnChoice(('J2', 'J1'), ('8', '9', '10')))
    assert (found.joints, found.point) == ((3, 2), (7, 8, 9))


@pytest.mark.parametrize(
    ('content', 'wanted'),
    [
        ('# made by X\n# name x y z\nP1 1.5 2 3\nP2 4 5 6.5\n', (1, 2, 3)),
        ('Report;;;\n\nName;X;Y;Z\n-;mm;mm;mm\nP1;1,5;2;3\n# a note\nP2;4;5;6,5\n', (1, 2, 3)),
        ('P1,1.5,2,3\nP2,4,5,6.5\n', (1, 2, 3)),
        ('#,X,Y,Z\n1,1.5,2,3\n2,4,5,6.5\n', (1, 2, 3)),
        ('"P;1";1,5;2;3\n"P;2";4;5;6,5\n', (1, 2, 3)),
    ],
)
def test_comments_titles_and_units(content, wanted, tmp_path):
    table = read_table(write(tmp_path, 't.csv', content))
    found = find_columns(table, ('joint_1',))
    assert found.point == wanted
    assert numbers(table, found.point).tolist() == [[1.5, 2.0, 3.0], [4.0, 5.0, 6.5]]
    assert (found.units.get(1) == 'mm') == ('mm' in content)


@pytest.mark.parametrize(
    ('column', 'cells', 'seconds'),
    [
        ('t', ['1.5', '2.5'], [1.5, 2.5]),
        ('Time [ms]', ['1500', '2500'], [1.5, 2.5]),
        ('stamp_s', ['1.5', '2.5'], [1.5, 2.5]),
        ('timestamp', ['1700000000000', '1700000001000'], [1700000000.0, 1700000001.0]),
        ('Timestamp', ['2026-05-04 10:00:00', '2026-05-04T10:00:01.5'], [0.0, 1.5]),
        ('Zeit', ['04.05.2026 10:00:00', '05.05.2026 10:00:00'], [0.0, 86400.0]),
        ('DateTime', ['5/4/2026 1:00:00 PM', '5/4/2026 1:00:02 PM'], [0.0, 2.0]),
        ('Time', ['11.59.59 AM 3/5/2026', '12.00.01 PM 3/5/2026'], [0.0, 2.0]),
        ('Zeit', ['5. März 2026 10:00:00', '5. Mrz. 2026 10:00:02 Uhr'], [0.0, 2.0]),
        ('Zeit', ['Do., 5. März 2026 um 10:00', 'Fr, 6. März 2026 um 10:00'], [0.0, 86400.0]),
        ('Heure', ['5 août 2026 10:00:00', '1 septembre 2026 10:00:00'], [0.0, 27 * 86400.0]),
        ('Time', ['20260305235959', '20260306000001'], [0.0, 2.0]),
        ('Time', ['05.03.2026_23:59:59', '06.03.2026_00:00:01'], [0.0, 2.0]),
        ('Time', ['2026-03-05 23-59-59', '2026-03-06 00-00-01'], [0.0, 2.0]),
        ('Time', ['05.03.2026 10.05.13', '05.03.2026 10.06.13'], [0.0, 60.0]),
        ('Time', ['12/03/2026 23:59:59', '13/03/2026 00:00:01'], [0.0, 2.0]),
        ('Time', ['06/03/2026 23:59:59', '07/03/2026 00:00:01'], [0.0, 2.0]),
        ('Time', ['2026-03-05 10:00:00.5 UTC', '2026-03-05 10:00:02.5 UTC'], [0.0, 2.0]),
        ('Time', ['2026-03-05 10:00:00:250', '2026-03-05 10:00:01:750'], [0.0, 1.5]),
    ],
)
def test_times(column, cells, seconds, tmp_path):
    content = text([column, 'X', 'Y', 'Z'], [cells, *[[0.5, 1.5]] * 3], ';')
    table = read_table(write(tmp_path, 't.csv', content))
    found = times(table, find_columns(table, JOINTS))
    assert np.ptp(found) == pytest.approx(seconds[1] - seconds[0])
    assert '2026' in cells[0] or found.tolist() == seconds


@pytest.mark.parametrize('cells', [['10.05.13', '10.13.13'], ['10.00.00', '10.01.00']])
def test_times_of_day_between_points_are_no_dates(cells, tmp_path):
    """10.05.13 would be a day of May."""
    content = text(['Time', 'X', 'Y', 'Z'], [cells, *[[0.5, 1.5]] * 3], ';')
    table = read_table(write(tmp_path, 't.csv', content))
    assert np.ptp(times(table, find_columns(table, JOINTS))) < 3600.0


@pytest.mark.parametrize('cell', ['10,5', '20261305100000', '1 5', '٣'])
def test_what_is_no_time(cell, tmp_path):
    content = text(['Time', 'X', 'Y', 'Z'], [[cell, '11:00'], *[[0.5, 1.5]] * 3], ';')
    table = read_table(write(tmp_path, 't.csv', content))
    with pytest.raises(InputError, match='is no time'):
        times(table, find_columns(table, JOINTS))


def test_a_date_and_a_time_in_two_columns(tmp_path):
    header = ['Datum', 'Uhrzeit', 'X', 'Y', 'Z']
    columns = [['4.5.2026', '5.5.2026'], ['23:59:59', '00:00:01'], *[[0.5, 1.5]] * 3]
    table = read_table(write(tmp_path, 't.csv', text(header, columns, ';', ',')))
    assert np.ptp(times(table, find_columns(table, JOINTS))) == pytest.approx(2.0)


GOOD = text(
    ['name', 'A1 [deg]', 'A2 [deg]', 'X [mm]', 'Y [mm]', 'Z [mm]'],
    [['P1', 'P2', 'P3'], *[[1.5, 2.5, 3.5]] * 5],
    ';',
)


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('P2;2.500000', 'P2;2.5o', "line 3, column A1 [deg]: '2.5o' is not a number"),
        ('P2;2.500000', 'P2;', "line 3, column A1 [deg]: '' is empty"),
        ('P2;2.500000', 'P2', 'line 3: 5 columns, where most rows have 6'),
        ('P2;2.500000', 'P2;nan', "column A1 [deg]: 'nan' is no value"),
        ('P2;2.500000', 'P2;"2.5', 'line 3: '),
        ('A2 [deg]', 'A1 [deg]', "two columns are named 'A1 [deg]'"),
        (
            'A2 [deg]',
            'A2 [rad]',
            'several units in the header (deg, rad); say which with --angles',
        ),
        ('name;A1 [deg]', 'name;Y1', 'no columns that could be the joint angles'),
        ('X [mm];', 'U;', 'no columns that could be a measured point'),
        (GOOD, 'a;b\n1;x\n', 'no row with two numbers'),
        (GOOD, '', 'no row with two numbers'),
        (GOOD, 'PK\x03\x04rest', 'a zip archive that is damaged or locked'),
        (GOOD, 'a\0b\0\0c', 'this is no text in'),
    ],
)
def test_damaged_tables_give_one_error(old, new, words, tmp_path, session):
    assert old in GOOD
    path = write(tmp_path, 't.csv', GOOD.replace(old, new, 1))
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    with pytest.raises(InputError) as error:
        read_rows([path], chain, TableOptions())
    assert str(error.value).startswith(str(path))
    assert words in str(error.value)


def test_nothing_but_the_one_error_comes_out_of_damaged_bytes(tmp_path):
    rng = random.Random(7)
    print('seed 7')
    data = GOOD.encode()
    for _ in range(300):
        broken = bytearray(data)
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(len(broken))
            broken[at : at + rng.randint(0, 3)] = bytes(
                rng.choices(range(256), k=rng.randint(0, 3))
            )
        path = tmp_path / 't.csv'
        path.write_bytes(bytes(broken))
        # Anything else than an InputError fails the test.
        with suppress(InputError):
            table = read_table(path)
            found = find_columns(table, JOINTS)
            numbers(table, (*found.joints, *found.point))
            times(table, found)


def test_a_told_encoding_is_used(tmp_path):
    data = 'Größe'.encode('cp850')
    assert decode(data, tmp_path, 'cp850')[0] == 'Größe'
    with pytest.raises(InputError, match='no such encoding'):
        decode(data, tmp_path, 'cp-nothing')
