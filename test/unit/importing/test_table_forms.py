# SPDX-License-Identifier: Apache-2.0
"""Tables, logs and programs as people really have them: each is read, or refused in one line."""

import gzip
import re

import numpy as np
import pytest
from foreign.makers import KINDS
from foreign.streams import arm_of, log_of, run_of, take_of
from foreign.tables import measured, text, write

from remaster_ros.errors import InputError
from remaster_ros.importing.columns import ColumnChoice
from remaster_ros.importing.makers import motive
from remaster_ros.importing.rows import TableOptions, read_rows

COUNT = 12
POINTS = [f'P{i}' for i in range(1, COUNT + 1)]
AXES = [f'A{i}' for i in range(1, 7)]


@pytest.fixture(scope='module')
def arm():
    return measured(rows=COUNT)


def degrees(arm):
    return [*np.rad2deg(arm.q).T]


def millimetres(arm):
    return [*(1e3 * arm.points).T]


def joints_table(arm, names=POINTS, header='Point'):
    return text([header, *AXES], [names, *degrees(arm)])


def points_table(arm, names=POINTS, header='Point'):
    return text([header, 'X', 'Y', 'Z'], [names, *millimetres(arm)])


def rows_of(arm, folder, *contents, **options):
    paths = [write(folder, f't{i}.txt', content) for i, content in enumerate(contents)]
    return read_rows(paths, arm.chain, TableOptions(**options))


def assert_rows(rows, arm, which=slice(None)):
    np.testing.assert_allclose(rows.q, arm.q[which], atol=2e-6)
    np.testing.assert_allclose(rows.position, arm.points[which], atol=2e-6)


def full_table(arm, cell=str, separator=';'):
    """Return a table of names, joints and points, each number written by `cell`."""
    columns = [[cell(value) for value in column] for column in (*degrees(arm), *millimetres(arm))]
    return text(['Punkt', *AXES, 'X', 'Y', 'Z'], [POINTS, *columns], separator)


@pytest.mark.parametrize(
    'cell',
    [
        lambda v: f'{v:,.6f}'.replace(',', '\u202f').replace('.', ','),
        lambda v: f'{v:,.6f}'.replace(',', '\u00a0').replace('.', ','),
        lambda v: f'{v:,.6f}'.replace(',', ' ').replace('.', ','),
        lambda v: f'{v:,.6f}'.replace(',', "'"),
        lambda v: f'{v:.6f}'.replace('-', '\u2212'),
    ],
    ids=['thin blank', 'no-break blank', 'blank', 'apostrophe', 'minus sign'],
)
def test_numbers_as_spreadsheets_write_them(cell, arm, tmp_path):
    assert_rows(rows_of(arm, tmp_path, full_table(arm, cell)), arm)


@pytest.mark.parametrize('sign', [' ', "'", '\u00a0'])
def test_a_stray_sign_is_no_group(sign, arm, tmp_path):
    content = full_table(arm, lambda v: f'{v:.6f}')
    large = re.search(r'(?<=;)-?\d{4}\.\d+', content)[0]
    for wrong in (
        large.replace('.', f'{sign}', 1),
        f'{large[:-3]}{sign}{large[-3:]}',
        f'{large[:2]}{sign}{large[2:]}',
    ):
        with pytest.raises(InputError, match='is not a number'):
            rows_of(arm, tmp_path, content.replace(large, wrong, 1))


def test_units_in_the_cells(arm, tmp_path):
    columns = [[f'{v:.6f}°' for v in column] for column in degrees(arm)]
    columns += [[f'{v:.6f} mm' for v in column] for column in millimetres(arm)]
    table = text(['Punkt', *AXES, 'X', 'Y', 'Z'], [POINTS, *columns])
    rows = rows_of(arm, tmp_path, table)
    assert_rows(rows, arm)
    assert (rows.angle_unit, rows.length_unit) == ('deg', 'mm')
    with pytest.raises(InputError, match=r"line 2, column A4: '.* rad' is not a number"):
        rows_of(arm, tmp_path, table.replace('°', '', 3).replace('°', ' rad', 2))


@pytest.mark.parametrize(
    ('brackets', 'between', 'separator'), [('[]', ', ', ';'), ('()', ',', '\t'), ('[]', ' ', ',')]
)
def test_lists_in_the_cells(brackets, between, separator, arm, tmp_path):
    def cells(values):
        return [between.join(f'{v:.8f}' for v in row).join(brackets) for row in values]

    content = text(
        ['name', 'actual_q', 'marker'], [POINTS, cells(arm.q), cells(arm.points)], separator
    )
    rows = rows_of(arm, tmp_path, content)
    assert_rows(rows, arm)
    assert rows.joint_columns[0] == 'actual_q 1'


def test_a_pendants_words_of_which_some_are_numbered(tmp_path):
    arm = measured('ur5e', rows=COUNT)
    words = ['Basis', 'Schulter', 'Ellbogen', 'Handgelenk_1', 'Handgelenk_2', 'Handgelenk_3']
    header = ['Punkt', *(word.replace('_', ' ') for word in words), 'Xmm', 'Ymm', 'Zmm']
    content = text(header, [POINTS, *degrees(arm), *millimetres(arm)])
    assert_rows(rows_of(arm, tmp_path, content), arm)


@pytest.mark.parametrize(
    'change',
    [
        lambda t: t.replace('\n', '\r'),
        lambda t: t + t,
        lambda t: '| ' + t.replace(';', ' | ').replace('\n', ' |\n|---|---|\n| ', 1),
        lambda t: t.replace('P', '#P').replace('#Punkt', 'Punkt'),
    ],
    ids=['old line ends', 'twice', 'Markdown', 'names like comments'],
)
def test_lines_that_are_no_rows(change, arm, tmp_path):
    table = change(full_table(arm, lambda v: f'{v:.6f}'))
    if table.startswith('| '):
        table = table.replace('\n', ' |\n| ').replace('|\n| | ', '|\n| ').removesuffix('| ')
    twice = table.count('Punkt') > 1
    rows = rows_of(arm, tmp_path, table)
    assert_rows(rows, arm, np.tile(np.arange(COUNT), 2) if twice else slice(None))


@pytest.mark.parametrize('word', ['NaN', 'None', '', '-', 'n/a', '#N/A', '#NV', 'NULL'])
def test_rows_without_a_point_or_joints_are_left_out_and_listed(word, arm, tmp_path):
    columns = [[f'{v:.6f}' for v in column] for column in (*degrees(arm), *millimetres(arm))]
    for column in columns[6:]:
        column[3] = word
    for column in columns[:6]:
        column[7] = word
    rows = rows_of(arm, tmp_path, text(['Punkt', *AXES, 'X', 'Y', 'Z'], [POINTS, *columns], ';'))
    assert_rows(rows, arm, np.delete(np.arange(COUNT), [3, 7]))
    assert 'line 5: no point, left out' in ' '.join(rows.warnings)
    assert 'line 9: no joints, left out' in ' '.join(rows.warnings)
    columns[6][5] = word
    with pytest.raises(InputError, match='line 7, column X'):
        rows_of(arm, tmp_path, text(['Punkt', *AXES, 'X', 'Y', 'Z'], [POINTS, *columns], ';'))


@pytest.mark.parametrize(
    ('names', 'other_names', 'headers'),
    [
        ([f'KR6_{p}' for p in POINTS], POINTS, ('Point', 'Point')),
        ([f'{p}_meas' for p in POINTS], [f'Pose {p[1:]}' for p in POINTS], ('Point', 'Point')),
        ([f'{p[1:]}.0' for p in POINTS], [p[1:] for p in POINTS], ('id', 'id')),
        (POINTS, POINTS, ('Bezeichnung', 'Lfd. Nr.')),
        ([f'Point {p[1:]}' for p in POINTS], POINTS, ('Name', 'Pose')),
        ([*range(COUNT)], [*range(COUNT)], ('', 'Unnamed: 0')),
    ],
    ids=['prefix', 'suffix', 'decimals', 'any header', 'pose', 'index'],
)
def test_names_that_differ_in_what_all_have(names, other_names, headers, arm, tmp_path):
    order = np.random.default_rng(1).permutation(COUNT)[:-2]
    points = text(
        [headers[0], 'X', 'Y', 'Z'],
        [[names[i] for i in order], *(column[order] for column in millimetres(arm))],
    )
    rows = rows_of(arm, tmp_path, points, joints_table(arm, other_names, headers[1]))
    assert_rows(rows, arm, order)
    assert 'rows joined by' in rows.description[-1]


def test_names_whose_last_words_are_those_of_the_other(arm, tmp_path):
    """Points of the instrument alone stand between."""
    names = ['REF1', 'REF_2', *(f'KR6_{name}' for name in POINTS)]
    points = [np.concatenate((column[:2], column)) for column in millimetres(arm)]
    content = text(['Point', 'X', 'Y', 'Z'], [names, *points])
    assert_rows(rows_of(arm, tmp_path, content, joints_table(arm)), arm)


def test_numbers_of_columns_are_of_the_table_without_names(arm, tmp_path):
    content = text([], [POINTS, *millimetres(arm), *3 * [[0.011] * COUNT]])
    chosen = ColumnChoice(points=('2', '3', '4'))
    assert_rows(rows_of(arm, tmp_path, content, joints_table(arm), chosen=chosen), arm)


def test_numbers_of_a_log_are_no_names_of_points(arm, tmp_path):
    log = text(['index', *AXES], [range(4 * COUNT), *(np.tile(c, 4) for c in degrees(arm))])
    for header, names in (('Point', POINTS), ('index', range(COUNT))):
        with pytest.raises(InputError, match='neither names nor times in common'):
            rows_of(arm, tmp_path, points_table(arm, names, header), log)


def test_two_collections_of_an_instrument_and_a_group(arm, tmp_path):
    lines = [f'A Main {p} {x:.6f} {y:.6f} {z:.6f}' for p, (x, y, z) in zip(POINTS, arm.points)]
    rows = rows_of(arm, tmp_path, '\n'.join(reversed(lines)) + '\n', joints_table(arm))
    assert_rows(rows, arm, slice(None, None, -1))


def test_times_to_the_minute_do_not_join(arm, tmp_path):
    times = [f'05.03.2026 10:{i // 2:02d}' for i in range(COUNT)]
    tables = points_table(arm, times, 'Zeit'), joints_table(arm, times, 'Zeit')
    with pytest.raises(InputError, match='is the time of line 2 as well'):
        rows_of(arm, tmp_path, *tables)
    assert_rows(rows_of(arm, tmp_path, *tables, join='order'), arm)


def test_dates_of_a_spreadsheet_are_days(arm, tmp_path):
    days = [f'{46_086.4 + 30.0 * i / 86_400.0:.9f}' for i in range(COUNT)]
    rows = rows_of(arm, tmp_path, points_table(arm, days, 'Zeit'), joints_table(arm, days, 'Zeit'))
    assert_rows(rows, arm)
    # 5 March 2026, 09:36.
    np.testing.assert_allclose(rows.stamp_s - 1_772_703_360.0, 30.0 * np.arange(COUNT), atol=1e-3)


def test_times_of_day_are_those_of_the_dates_beside(arm, tmp_path):
    clock = [f'10:{i:02d}:30' for i in range(COUNT)]
    dates = [f'2026-03-05T{time}' for time in clock]
    for times in (clock, [f'{(10 + (i + 0.5) / 60) / 24:.9f}' for i in range(COUNT)]):
        tables = points_table(arm, times, 'Zeit'), joints_table(arm, times, 'Zeit')
        assert_rows(rows_of(arm, tmp_path, *tables), arm)
    tables = points_table(arm, clock, 'Zeit'), joints_table(arm, dates, 'stamp')
    assert_rows(rows_of(arm, tmp_path, *tables), arm)


def test_quaternions_beside_the_joints(arm, tmp_path):
    header = ['Point', *AXES, 'X', 'Y', 'Z', 'Q0', 'Q1', 'Q2', 'Q3']
    turns = [np.ones(COUNT), *3 * [np.zeros(COUNT)]]
    content = text(header, [POINTS, *degrees(arm), *millimetres(arm), *turns])
    assert_rows(rows_of(arm, tmp_path, content), arm)
    content = text(
        [*header[:-4], 'qx', 'qy', 'qz', 'qw'],
        [POINTS, *degrees(arm), *millimetres(arm), *4 * [np.zeros(COUNT)]],
    )
    with pytest.raises(
        InputError, match=r't0.txt, line 2, column qx: .* no quaternion of length 1'
    ):
        rows_of(arm, tmp_path, content)


def test_expanded_uncertainties_and_columns_that_a_program_counted(arm, tmp_path):
    header = ['X [mm]', 'Y [mm]', 'Z [mm]', 'U(95) X [mm]', 'U(95) Y [mm]', 'U(95) Z [mm]']
    shots = text(header, [*millimetres(arm), *np.full((3, COUNT), 0.01)])
    joints = text([str(i) for i in range(6)], degrees(arm))
    rows = rows_of(arm, tmp_path, shots, joints, join='order')
    assert_rows(rows, arm)
    assert any('line 1 (0,1,2,3,4,5): no row' in line for line in rows.warnings)
    # With the number of each row beside them.
    joints = text(['', *map(str, range(6))], [range(COUNT), *degrees(arm)])
    chosen = ColumnChoice(joints=('2', '3', '4', '5', '6', '7'))
    assert_rows(rows_of(arm, tmp_path, shots, joints, chosen=chosen, join='order'), arm)


def test_surveyors_letters(arm, tmp_path):
    header = ['Point Id', 'Easting [m]', 'Northing [m]', 'Ortho. Height [m]']
    for names in (header, ['Pt', 'E', 'N', 'H']):
        table = text(names, [POINTS, *arm.points.T])
        assert_rows(rows_of(arm, tmp_path, table, joints_table(arm)), arm)


def test_the_robots_own_tool_is_no_measured_point(tmp_path, imported):
    arm = measured(rows=30)
    believed = 1e3 * arm.chain.forward(arm.q)[:, :3, 3]
    head = ['pose', *AXES, 'px', 'py', 'pz', 'mx', 'my', 'mz']
    table = text(head, [range(30), *degrees(arm), *believed.T, *millimetres(arm)])
    path = write(tmp_path, 't.csv', table)
    error = imported(arm.urdf, path, status=1)[0].stderr
    assert 'name the columns of the measured point with --points' in error
    imported(arm.urdf, path, '--points', 'mx,my,mz')


def test_the_robots_own_tool_in_a_log_of_joints_is_left_out(arm, tmp_path):
    log = text(['Point', *AXES, 'px', 'py', 'pz'], [POINTS, *degrees(arm), *3 * [degrees(arm)[0]]])
    rows = rows_of(arm, tmp_path, log, points_table(arm))
    assert_rows(rows, arm)
    assert 'px, py, pz left out, the points are in' in ' '.join(rows.warnings)


def axes_of(row, letter='A'):
    return ', '.join(f'{letter}{i} {v:.6f}' for i, v in enumerate(np.rad2deg(row), 1))


def listed(row, degrees=True):
    return ', '.join(f'{v:.8f}' for v in (np.rad2deg(row) if degrees else row))


UNUSED = '[9E9,9E9,9E9,9E9,9E9,9E9]'
PROGRAMS = {
    'array of KUKA': lambda q: ''.join(
        f'POSE[{i}]={{{axes_of(row)}}}\n' for i, row in enumerate(q, 1)
    ),
    'log of KUKA': lambda q: ''.join(
        f'P{i}: {{E6AXIS: {axes_of(row)}}}\n' for i, row in enumerate(q, 1)
    ),
    'array of RAPID': lambda q: (
        f'MODULE Calib\n  CONST jointtarget jCal{{{len(q)}}}:=['
        + ',\n'.join(f'[[{listed(row)}],{UNUSED}]' for row in q)
        + '];\nENDMODULE\n'
    ),
    'assigned in RAPID': lambda q: (
        'MODULE Calib(SYSMODULE)\n'
        + ''.join(f'  VAR jointtarget p{i};\n' for i in range(1, len(q) + 1))
        + '  CONST robtarget pHome:=[[364,0,594],[0.5,0,0.9,0],[0,0,0,0],'
        + f'{UNUSED}];\n  PROC init()\n'
        + ''.join(f'    p{i}:=[[{listed(row)}],{UNUSED}];\n' for i, row in enumerate(q, 1))
        + '  ENDPROC\nENDMODULE\n'
    ),
    'Rokae without semicolons': lambda q: ''.join(
        f'LOCAL VAR jointtarget j{i} = j:{{{listed(row)}\t\t,0}}\t{{EJ 0,0,0,0,0,0}}\n'
        for i, row in enumerate(q, 1)
    ),
    'Staubli without keys': lambda q: (
        '<dataList><jointRxData name="jPos" public="true">\n'
        + ''.join(
            '<valueJointRx '
            + ' '.join(f'j{i}="{v:.6f}"' for i, v in enumerate(np.rad2deg(row), 1))
            + '/>\n'
            for row in q
        )
        + '</jointRxData></dataList>\n'
    ),
    'list of URScript': lambda q: (
        'def calib():\n  poses = ['
        + ', '.join(f'[{listed(row, False)}]' for row in q)
        + ']\n  movej(poses[0], a=1)\nend\n'
    ),
    'list of URScript in lines': lambda q: (
        'def calib():\n  poses = [\n'
        + ',\n'.join(f'    [{listed(row, False)}]' for row in q)
        + '\n  ] # all\n  movej(poses[0], a=1)\nend\n'
    ),
    'log with names': lambda q: ''.join(
        f'P{i}: [{listed(row, False)}]\n' for i, row in enumerate(q, 1)
    ),
    'log of a call': lambda q: ''.join(
        f'get_actual_joint_positions() = [{listed(row, False)}]\n' for row in q
    ),
    'array of NumPy': lambda q: (
        '[' + '\n '.join('[' + ' '.join(f'{v: .8f}' for v in row) + ']' for row in q) + ']\n'
    ),
    'calls of Mecademic': lambda q: ''.join(f'MoveJoints({listed(row)})\nDelay(2)\n' for row in q),
    'braces of Comau': lambda q: (
        'PROGRAM calib\nBEGIN\n'
        + ''.join(f'  MOVE TO {{{listed(row)}}}\n' for row in q)
        + 'END calib\n'
    ),
    'Python for a UR': lambda q: ''.join(
        f'rtde_c.moveJ([{listed(row, False)}], 1.05, 1.4)\n' for row in q
    ),
    'source of VAL 3': lambda q: (
        'begin\n' + ''.join(f'  jP[{i}]={{{listed(row)}}}\n' for i, row in enumerate(q)) + 'end\n'
    ),
    'names and numbers': lambda q: ''.join(
        f'P{i} {axes_of(row).replace(",", "")}\n' for i, row in enumerate(q, 1)
    ),
    'moves of Doosan': lambda q: ''.join(f'movej(posj({listed(row)}), vel=30)\n' for row in q),
    'points of Kawasaki': lambda q: ''.join(
        f'  POINT #P{i} = #PPOINT({listed(row)})\n' for i, row in enumerate(q, 1)
    ),
    'YAML': lambda q: 'poses:\n' + ''.join(f'  - [{listed(row, False)}]\n' for row in q),
    'small letters of KUKA': lambda q: ''.join(f'ptp {{{axes_of(row, "a")}}}\n' for row in q),
    'degrees of a Yaskawa job': lambda q: (
        '/JOB\n//NAME C\n//POS\n///NPOS 12,0,0,0,0,0\n///POSTYPE ANGLE\n///ANGLE\n'
        + ''.join(f'C{i:05d}={listed(row)}\n' for i, row in enumerate(q, 1))
        + '//INST\nNOP\nEND\n'
    ),
    'groups of FANUC': lambda q: (
        '/PROG  CALIB\n/POS\n'
        + ''.join(
            f'P[{i}]{{\n   GP1:\n\tUF : 0, UT : 1,\t\n\t'
            + ',\t'.join(f'J{j}= {v:.6f} deg' for j, v in enumerate(np.rad2deg(row), 1))
            + '\n   GP2:\n\tUF : 0, UT : 1,\t\n\tJ1=   250.000  mm\n};\n'
            for i, row in enumerate(q, 1)
        )
        + '/END\n'
    ),
}


@pytest.mark.parametrize('form', PROGRAMS)
@pytest.mark.parametrize(
    'change',
    [
        lambda text: text.replace('\n', '\r\n'),
        lambda text: text.replace('\n', '   \n'),
        lambda text: text.replace('\n', '\n\n'),
    ],
    ids=['line ends', 'blanks', 'empty lines'],
)
def test_programs_that_an_editor_has_touched(change, form, arm, tmp_path):
    content = change(PROGRAMS[form](arm.q))
    points = text(['X', 'Y', 'Z'], [*millimetres(arm)])
    assert_rows(rows_of(arm, tmp_path, points, content, join='order'), arm)


WITHOUT_NAMES = (
    *('log of a call', 'array of NumPy', 'calls of Mecademic', 'braces of Comau', 'YAML'),
    *('Python for a UR', 'moves of Doosan', 'small letters of KUKA'),
)


@pytest.mark.parametrize('form', PROGRAMS)
def test_joints_of_programs_and_logs(form, arm, tmp_path):
    content = PROGRAMS[form](arm.q)
    rows = rows_of(
        arm, tmp_path, text(['X', 'Y', 'Z'], [*millimetres(arm)]), content, join='order'
    )
    assert_rows(rows, arm)
    if form not in WITHOUT_NAMES:
        first = 0 if form.startswith(('Staubli', 'list of URScript', 'source')) else 1
        names = range(first, COUNT + first)
        assert_rows(rows_of(arm, tmp_path, points_table(arm, names), content), arm)


@pytest.mark.parametrize(
    ('form', 'line', 'expected'),
    [
        ('calls of Mecademic', 'MoveLin(1, 2, 3, 4, 5, 6)', 'of one call'),
        ('calls of Mecademic', 'MoveJoints(1, 2, 3, 4, 5)', 'a list of 6 numbers'),
        ('Python for a UR', 'rtde_c.moveL([1, 2, 3, 4, 5, 6], 1, 2)', 'of one call'),
        ('YAML', '  - p[1, 2, 3, 4, 5, 6]', 'of one call'),
        ('moves of Doosan', 'movej(posj(1, 2, 3, 4, 5, 6), mod=DR_MV_MOD_REL)', 'an angle in deg'),
        ('moves of Doosan', 'movej(posj(*home), vel=30)', 'an angle in degrees for each joint'),
        (
            'points of Kawasaki',
            'POINT #P13 = #PPOINT(1, 2, a, 4, 5, 6)',
            'an angle for each joint',
        ),
        ('small letters of KUKA', 'PTP_REL {A1 1, A2 2, A3 3, A4 4, A5 5, A6 6}', 'a position'),
    ],
)
def test_what_is_no_position_of_joints_is_refused(form, line, expected, arm, tmp_path):
    program = PROGRAMS[form](arm.q) + line + '\n'
    number = program.count('\n')
    with pytest.raises(InputError, match=f'line {number}: .*{expected}'):
        rows_of(arm, tmp_path, points_table(arm), program)


def test_a_program_that_polyscope_packed(arm, tmp_path):
    names = [f'P{i}' for i in range(1, COUNT + 1)]
    path = tmp_path / 'calib.urp'
    packed = gzip.compress(KINDS['ur_polyscope'].write(names, np.rad2deg(arm.q)).encode())
    path.write_bytes(packed)
    points = write(tmp_path, 'points.csv', points_table(arm))
    assert_rows(read_rows([points, path], arm.chain, TableOptions()), arm)
    path.write_bytes(packed[:-9])
    with pytest.raises(InputError, match='packed with gzip, and damaged'):
        read_rows([points, path], arm.chain, TableOptions())


def test_positions_that_were_never_taught_or_are_ways(arm, tmp_path):
    pad = np.rad2deg(arm.q)
    names = [f'P[{i}]' for i in range(1, COUNT + 1)]
    program = KINDS['fanuc'].write(names, pad)
    untaught = ',\t'.join(f'J{i}= ******** deg' for i in range(1, 7))
    more = program.replace('/END', f'P[13]{{\n   GP1:\n\t{untaught}\n}};\n/END')
    rows = rows_of(arm, tmp_path, points_table(arm, names), more)
    assert_rows(rows, arm)
    assert '1 positions that were never taught were left out' in rows.warnings
    ways = program.replace('FINE    ;', 'FINE INC ;', 1)
    with pytest.raises(InputError, match=r'line 5: .*not an increment \(INC\)'):
        rows_of(arm, tmp_path, points_table(arm, names), ways)


@pytest.mark.parametrize(
    ('old', 'new'), [('{12}', '{13}'), (',\n[[', ',\n[[1,2,3,4,5,6],[9E9]],[['), (']],\n', ']]\n')]
)
def test_an_array_has_as_many_targets_as_it_says(old, new, arm, tmp_path):
    module = PROGRAMS['array of RAPID'](arm.q)
    assert old in module
    with pytest.raises(InputError, match=r't1.txt, line 2: .* of 1[23] \[\['):
        rows_of(arm, tmp_path, points_table(arm), module.replace(old, new, 1))


def test_joints_that_val_3_does_not_write_are_at_0(arm, tmp_path):
    lines = [
        f'<Value key="{i}" ' + ' '.join(f'j{j}="{v:.6f}"' for j, v in enumerate(row, 1)) + ' />'
        for i, row in enumerate(np.rad2deg(arm.q))
    ]
    lines[2] = '<Value key="2" j3="90" j5="-45" />'
    data = '<Data name="jPos" xsi:type="array" type="jointRx" size="12">{}</Data>'
    names = [f'jPos[{i}]' for i in range(COUNT)]
    rows = rows_of(arm, tmp_path, points_table(arm, names), data.format('\n'.join(lines)))
    np.testing.assert_allclose(np.rad2deg(rows.q[2]), [0, 0, 90, 0, -45, 0], atol=1e-9)
    for wrong in ('k4="90"', 'j5="90"', '=90'):
        lines[2] = f'<Value key="2" j5="-45" {wrong} />'
        with pytest.raises(InputError, match='once each and nothing else'):
            rows_of(arm, tmp_path, points_table(arm, names), data.format('\n'.join(lines)))


def test_a_log_with_times(arm, tmp_path):
    times = [f'2026-03-05 10:{i:02d}:00.123' for i in range(COUNT)]
    content = ''.join(f'{t} INFO joints=[{listed(row, False)}]\n' for t, row in zip(times, arm.q))
    table = points_table(arm, times, 'time')
    assert_rows(rows_of(arm, tmp_path, table, content), arm)
    lines = content.splitlines()
    between = '\n'.join([*lines[:2], 'stopped', *lines[2:]])
    rows = rows_of(arm, tmp_path, table, between)
    assert_rows(rows, arm)
    assert '1 lines without a list were left out' in rows.warnings
    damaged = '\n'.join([*lines[:2], lines[2].rstrip(']'), *lines[3:]])
    with pytest.raises(InputError, match=r'line 3: .*, where a list of 6 numbers'):
        rows_of(arm, tmp_path, table, damaged)


def test_what_tells_no_joints_says_what_to_give(arm, tmp_path):
    job = PROGRAMS['degrees of a Yaskawa job'](arm.q)
    module = f'MODULE M\n  CONST robtarget p1:=[[1,2,3],[1,0,0,0],[0,0,0,0],{UNUSED}];\nENDMODULE'
    for content, words in (
        (job.replace('ANGLE', 'PULSE'), 'pulses of the motors'),
        (job.replace('POSTYPE ANGLE', 'POSTYPE BASE'), 'no position of joints in this job'),
        (module, 'there is no joint target in it'),
        ('[{"q": [1, 2], "p": [3, 4, 5]}]', 'line 1: JSON without a list of records'),
        ('<table>\n<tr><td>1.5</td><td>2.5</td></tr>\n</table>', 'this is HTML or XML'),
        ('[*POSREG*]$POSREG  Storage: CMOS  : ARRAY[1,1] OF Position Reg\n', 'record them so'),
        ('.JOINTS\n.END\n', 'line 1: there are no joint displacements in it'),
        (
            'header:\n  stamp:\nname:\n- a\nposition:\n- 1.0\n---\n',
            'line 1: YAML without a list of records',
        ),
        ('*110001+00000000000000P1 21.102+0000000012345678\r\n', 'export coordinates'),
    ):
        with pytest.raises(InputError, match=re.escape(words)):
            rows_of(arm, tmp_path, points_table(arm), content)


@pytest.mark.parametrize(('width', 'unit', 'scale'), [(16, '8', 1e5), (8, '6', 1e4)])
def test_coordinates_of_a_total_station(width, unit, scale, arm, tmp_path):
    lines = []
    for i, (name, point) in enumerate(zip(POINTS, arm.points), 1):
        line = f'110{i:03d}+{name.rjust(width, "0")}'
        for word, value in zip((81, 82, 83), np.round(scale * point).astype(int)):
            line += f' {word}..1{unit}{"-" if value < 0 else "+"}{abs(value):0{width}d}'
        lines.append('*' * (width == 16) + line + ' ')
    rows = rows_of(arm, tmp_path, '\r\n'.join(lines), joints_table(arm))
    np.testing.assert_allclose(rows.q, arm.q, atol=2e-6)
    np.testing.assert_allclose(rows.position, arm.points, atol=0.51 / scale)


# Lines that are no rows, and columns of reports


@pytest.mark.parametrize(
    'lines',
    [
        ['End of report'],
        ['Number of points: 12', 'RMS 0.031 mm'],
        ['Mittelwert;1.5;2.5;3.5', 'Max;9.5;9.5;9.5', 'Std. Dev.;0.5;0.5;0.5'],
        ['Summe;12 Punkte;;', ';;;', 'Ende des Berichts;;;'],
        ['Seite 1 von 2', 'Point;X;Y;Z'],
    ],
    ids=['end', 'text', 'sums', 'short', 'page'],
)
@pytest.mark.parametrize('separator', [';', '\t'])
def test_footers_and_pages_are_left_out_and_listed(lines, separator, arm, tmp_path):
    table = points_table(arm).replace(',', ';').splitlines()
    content = '\n'.join([*table[:5], *lines[-2:], *table[5:], *lines, '']).replace(';', separator)
    rows = rows_of(arm, tmp_path, content, joints_table(arm))
    assert_rows(rows, arm)
    assert 'no row, left out' in ' '.join(rows.warnings)


@pytest.mark.parametrize('cut', [1, 2])
def test_a_row_that_was_cut_off_is_refused(cut, arm, tmp_path):
    lines = points_table(arm).splitlines()
    broken = '\n'.join([*lines[:-1], lines[-1].rsplit(',', cut)[0], ''])
    with pytest.raises(InputError, match=r'line 13: . columns, where most rows have 4'):
        rows_of(arm, tmp_path, broken, joints_table(arm))


@pytest.mark.parametrize(
    'form',
    [
        '{} X={:.6f} Y={:.6f} Z={:.6f}',
        '{}, X: {:.6f} mm, Y: {:.6f} mm, Z: {:.6f} mm',
        '<Point name="{}" x="{:.6f}" y="{:.6f}" z="{:.6f}"/>',
        '{};({:.6f}, {:.6f}, {:.6f})',
    ],
)
def test_points_with_their_axes_or_in_brackets(form, arm, tmp_path):
    points = np.column_stack(millimetres(arm))
    lines = [form.format(name, *point) for name, point in zip(POINTS, points)]
    rows = rows_of(arm, tmp_path, '\n'.join([*lines, '']), joints_table(arm))
    assert_rows(rows, arm)


def test_a_title_with_many_numbers_between_blanks(arm, tmp_path):
    title = 'AT960-MR\tS/N 750123\tTemp 20.8\tPress 1013.2\tHum 45\n'
    columns = [*millimetres(arm), *3 * [[0.004] * COUNT]]
    table = text(['Point', 'X', 'Y', 'Z', 'Sx', 'Sy', 'Sz'], [POINTS, *columns], '\t')
    assert_rows(rows_of(arm, tmp_path, title + table, joints_table(arm)), arm)


@pytest.mark.parametrize(
    ('nominal', 'measured_', 'deviation'),
    [
        ('{} Nennwert', '{} Istwert', '{} Abweichung'),
        ('{}Soll', '{}Ist', '{}Diff'),
        ('{} théorique', '{} mesuré', '{} écart'),
        ('{}_ref', '{}', 'd{}'),
        ('CAD {}', '{}', 'Err {}'),
    ],
)
def test_the_measured_ones_of_a_report(nominal, measured_, deviation, arm, tmp_path):
    header = [form.format(axis) for form in (nominal, measured_, deviation) for axis in 'XYZ']
    off = [column + 0.5 for column in millimetres(arm)]
    columns = [*off, *millimetres(arm), *3 * [[0.5] * COUNT]]
    table = text(['Point', *header], [POINTS, *columns], ';')
    assert_rows(rows_of(arm, tmp_path, table, joints_table(arm)), arm)
    # Nominal points alone are none that was measured.
    wrong = table.replace(measured_.format('Z'), 'Height over all', 1)
    if measured_ == '{}':
        return
    with pytest.raises(InputError, match='--points'):
        rows_of(arm, tmp_path, wrong, joints_table(arm))


def inspected(arm, names=POINTS, once=False, suffix=False):
    """Return the lines of a report that has a row for each axis."""
    lines = ['Name;Control;Nom;Meas;Tol;Dev;Test']
    for name, point in zip(names, np.column_stack(millimetres(arm))):
        for axis, value in zip('XYZ', point):
            shown = f'{name}.{axis};Koord.' if suffix else f'{name};{axis}'
            shown = f';{axis}' if once and axis != 'X' else shown
            lines.append(f'{shown};{value + 0.5:.6f};{value:.6f};\u00b10.5;-0.500000;Pass')
    return lines


@pytest.mark.parametrize('form', ['', 'once', 'suffix'])
def test_a_report_with_a_row_for_each_axis(form, arm, tmp_path):
    lines = inspected(arm, **({form: True} if form else {}))
    if form != 'suffix':
        # Of each point its distance as well.
        lines = [
            lines[0],
            *(x for i in range(1, 37, 3) for x in (*lines[i : i + 3], _distance(i))),
        ]
    rows = rows_of(arm, tmp_path, '\n'.join([*lines, '']), joints_table(arm))
    assert_rows(rows, arm)
    assert [*rows.points.values()] == [('Meas X', 'Meas Y', 'Meas Z')]


@pytest.mark.parametrize(
    'form',
    [
        '{0}.X;{1}\n{0}.Y;{2}\n{0}.Z;{3}',
        '{0}\n X  {1}\n Y  {2}\n Z  {3}',
        '{0};X;{1}\n{0};Y;{2}\n{0};Z;{3}',
    ],
)
@pytest.mark.parametrize('sign', '.,')
def test_a_report_with_one_number_a_line(form, sign, arm, tmp_path):
    points = np.column_stack(millimetres(arm))
    shown = [[f'{v:.6f}'.replace('.', sign) for v in point] for point in points]
    lines = ['Element;Ist', *(form.format(p, *cells) for p, cells in zip(POINTS, shown))]
    content = '\n'.join([*lines, ''])
    assert_rows(rows_of(arm, tmp_path, content, joints_table(arm)), arm)
    lost = content.replace(shown[3][1], 'lost')
    with pytest.raises(InputError, match=r't0.txt, line \d+: .*Y'):
        rows_of(arm, tmp_path, lost, joints_table(arm))


def _distance(i):
    return f'P{(i + 2) // 3};3D;0.0;0.5;\u00b10.5;0.5;Pass'


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (lambda lines: lines[:20] + lines[21:], 'line 21: Z of P7, where Y is expected'),
        (lambda lines: lines[:-1], 'line 36: the last one, where Z is expected'),
        (
            lambda lines: [*lines[:20], lines[20].replace('P7', 'P8'), *lines[21:]],
            'line 21: Y of P8, where Y of P7 is expected',
        ),
    ],
    ids=['lost', 'cut', 'name'],
)
def test_a_report_that_lost_an_axis_is_refused(change, words, arm, tmp_path):
    with pytest.raises(InputError, match=words):
        rows_of(arm, tmp_path, '\n'.join([*change(inspected(arm)), '']), joints_table(arm))


@pytest.mark.parametrize(
    ('unit', 'words'),
    [
        ('mrad', r'column A1 \[mrad\]: mrad, where one of rad, deg'),
        ('counts', r'A1 \[counts\] … A6 \[counts\] are pulses of the motors \(by their header\)'),
    ],
)
def test_a_unit_that_is_not_converted_is_refused(unit, words, arm, tmp_path):
    header = ['Point', *(f'{axis} [{unit}]' for axis in AXES)]
    table = text(header, [POINTS, *degrees(arm)])
    with pytest.raises(InputError, match=words):
        rows_of(arm, tmp_path, points_table(arm), table)


def test_names_in_two_lines(arm, tmp_path):
    over = ';Joints;;;;;;Ball 1;;;Ball 2;;\n'
    header = ['Point', *AXES, *2 * 'XYZ', '']
    second_ball = [column + 10.0 for column in millimetres(arm)]
    table = text(header[:-1], [POINTS, *degrees(arm), *millimetres(arm), *second_ball], ';')
    rows = rows_of(arm, tmp_path, over + table, chosen=ColumnChoice(points=('Ball 1',)))
    assert_rows(rows, arm)
    both = rows_of(arm, tmp_path, over + table)
    assert {*both.labels['marker']} == {'Ball 1', 'Ball 2'}
    units = 'text;' + 'deg;' * 6 + 'mm;' * 5
    with pytest.raises(InputError, match="line 3: 'm9', where a unit is expected"):
        rows_of(
            arm,
            tmp_path,
            f'{over}{table.replace(chr(10), f"{chr(10)};{units[5:]}m9{chr(10)}", 1)}',
        )


@pytest.mark.parametrize('letters', ['ABC', '123'])
def test_markers_with_letters(letters, arm, tmp_path):
    header = ['Point', *AXES, *(f'Marker {letter} {axis}' for letter in letters for axis in 'XYZ')]
    table = text(header, [POINTS, *degrees(arm), *3 * millimetres(arm)], ';')
    rows = rows_of(arm, tmp_path, table)
    assert {*rows.labels['marker']} == {f'Marker {letter}' for letter in letters}


def test_a_pendants_words_with_numbers(tmp_path):
    arm = measured('ur5e', rows=COUNT)
    words = ['base', 'shoulder', 'elbow', 'wrist 1', 'wrist 2', 'wrist 3']
    for form in ('J{} {}', 'Joint {} ({})'):
        header = ['Point', *(form.format(i, word) for i, word in enumerate(words, 1)), *'XYZ']
        content = text(header, [POINTS, *degrees(arm), *millimetres(arm)])
        assert_rows(rows_of(arm, tmp_path, content), arm)


def test_text_between_numbers_without_a_header_is_no_table(arm, tmp_path):
    columns = [*degrees(arm)[:3], ['x'] * COUNT, *degrees(arm)[3:]]
    with pytest.raises(InputError, match='no header, and 6 columns of numbers'):
        rows_of(arm, tmp_path, points_table(arm), text([], [POINTS, *columns]))


# Streams


@pytest.fixture(scope='module')
def run():
    return run_of(arm_of())


def assert_stops(rows, arm):
    np.testing.assert_allclose(rows.q, arm.q, atol=2e-6)
    assert np.linalg.norm(rows.position - arm.points, axis=1).max() < 2e-4


@pytest.mark.parametrize('form', ['without words', 'without the first line', 'a marker alone'])
def test_takes_of_other_settings(form, run, tmp_path):
    lines = take_of(run).split('\r\n')
    if form == 'without words':
        lines = [re.sub('^,(?:Type|Name|ID),', ',,', line) for line in lines]
    if form == 'without the first line':
        lines = lines[1:]
    if form == 'a marker alone':
        lines = fragments(lines)
    rows = rows_of(run.arm, tmp_path, '\r\n'.join(lines), log_of(run))
    assert_stops(rows, run.arm)
    if form == 'a marker alone':
        assert '3 pieces of markers without a label are of 1' in ' '.join(rows.warnings)


def fragments(lines):
    """Return a take in which a marker without a label has another name each time it is seen."""
    start = next(i for i, line in enumerate(lines) if line.startswith('Frame,'))
    place = lines[start - 1].split(',').index('Position')
    kinds, names = ',Type' + 12 * ',Marker', ',Name'
    for i in range(3):
        names += 3 * f',Unlabeled {1000 + i}'
    names += 3 * ',Unlabeled 2000'
    head = [lines[0], kinds, names, ',' + 12 * ',Position', 'Frame,Time (Seconds)' + 4 * ',X,Y,Z']
    found = [line.split(',') for line in lines[start + 1 :] if line]
    return head + [
        ','.join(
            (
                *cells[:2],
                *at * 3 * [''],
                *cells[place : place + 3],
                *(2 - at) * 3 * [''],
                '500.0',
                '0.0',
                '0.0',
            )
        )
        for i, cells in enumerate(found)
        for at in [3 * i // len(found)]
    ]


def test_a_labelled_marker_that_its_body_has_as_well(run, tmp_path):
    """The measured marker, beside the one that the solution of the body puts there."""
    take = take_of(run).split('\r\n')
    head = [line.split(',') for line in take[2:4]]
    for i, (kind, name) in enumerate(zip(*head)):
        if (kind, name) == ('Marker', 'Unlabeled 1004'):
            head[1][i] = 'tool:Marker1'
    take[2:4] = [','.join(line) for line in head]
    read = motive.read('\r\n'.join(take))
    assert set(read.groups) == {'tool', 'base', 'tool:Marker1', 'Rigid Body Marker tool:Marker1'}


def test_a_log_whose_topics_have_rows_of_their_own(run, tmp_path):
    head, *lines = log_of(run).splitlines()
    table = [f'{head},/other/value']
    for line in lines:
        stamp = float(line.split(',')[0])
        table += [f'{line},', f'{stamp + 0.01:.6f}{"," * head.count(",")},1.5']
    rows = rows_of(run.arm, tmp_path, take_of(run), '\n'.join(table) + '\n')
    assert_stops(rows, run.arm)


def test_points_that_ros_prints(run, tmp_path):
    take = take_of(run).split('\r\n')
    start = next(i for i, line in enumerate(take) if line.startswith('Frame,'))
    place = take[start - 1].split(',').index('Position')
    lines = []
    for cells in (line.split(',') for line in take[start + 1 :] if line):
        if cells[place]:
            second, nanosecond = divmod(round(1e9 * float(cells[1])), 10**9)
            x, y, z = (float(cell) / 1e3 for cell in cells[place : place + 3])
            lines.append(f'{second},{nanosecond},tracker,{x:.9f},{y:.9f},{z:.9f}')
    rows = rows_of(run.arm, tmp_path, '\n'.join(lines) + '\n', log_of(run))
    assert_stops(rows, run.arm)
    assert rows.length_unit == 'm'


def test_whose_clock_a_time_is(run, tmp_path):
    log = log_of(run).replace('__time', 'pc_ts')
    assert_stops(rows_of(run.arm, tmp_path, take_of(run), log), run.arm)
