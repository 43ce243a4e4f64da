# SPDX-License-Identifier: Apache-2.0
"""Joints from the text of each maker's controller; what is damaged is read right or refused."""

import random
import re
from collections import Counter

import numpy as np
import pytest
from foreign.makers import KINDS, names_of
from foreign.tables import measured, text, write
from rigs.command_line import remaster

from remaster_ros.errors import InputError
from remaster_ros.importing.column_search import find_columns
from remaster_ros.importing.columns import ColumnChoice
from remaster_ros.importing.makers import READERS
from remaster_ros.importing.rows import TableOptions, read_rows
from remaster_ros.importing.text_table import read_table
from remaster_ros.importing.units import ANGLES
from remaster_ros.importing.values import angle_unit, numbers
from remaster_ros.session.records.reader import read_session

JOINTS = tuple(f'joint_{i}' for i in range(1, 7))


def joints_of(count=12, seed=0):
    return np.random.default_rng(seed).uniform(-170.0, 170.0, (count, 6)).round(4)


def read_text(content):
    found = [named for read in READERS if (named := read(content)) is not None]
    assert len(found) == 1
    return found[0]


@pytest.mark.parametrize('kind', KINDS)
def test_joints_and_names_are_those_that_were_written(kind, tmp_path):
    q = joints_of()
    names = names_of(kind, len(q))
    table = read_table(write(tmp_path, 'program.txt', KINDS[kind].write(names, q)))
    found = find_columns(table, JOINTS)
    unit, how = angle_unit(table, found, '')
    assert how == ('guessed' if kind == 'calls' else 'header')
    got = np.rad2deg(numbers(table, found.joints) * ANGLES[unit])
    np.testing.assert_allclose(got, q, atol=1e-6)
    if KINDS[kind].named:
        assert [row[found.first_of_kind('name')] for row in table.rows] == names


def test_the_coupling_of_fanuc_and_the_names_are_kept(tmp_path, imported):
    arm = measured(rows=30)
    pad = np.rad2deg(arm.q)
    pad[:, 2] -= pad[:, 1]
    names = names_of('fanuc', len(pad))
    program = write(tmp_path, 'calib.ls', KINDS['fanuc'].write(names, pad))
    points = write(tmp_path, 'points.csv', text(['Name', 'X', 'Y', 'Z'], [names, *arm.points.T]))
    (out, _), session = imported(arm.urdf, program, points)
    assert 'as a FANUC controller counts them: --couple J3=J2' in out
    np.testing.assert_allclose(session.measurements.q, arm.q, atol=2e-6)
    assert session.controller.maker == 'FANUC'
    assert session.controller.joints['joint_3'].coupling == {'joint_2': 1}


@pytest.mark.parametrize('axis', ['E1', 'EXT1'])
def test_a_rail_of_fanuc_is_read_under_both_of_its_names(axis, tmp_path):
    arm = measured(rows=12)
    program = KINDS['fanuc'].write(names_of('fanuc', len(arm.q)), np.rad2deg(arm.q))
    places = iter(range(10, 1000))
    along = re.sub(
        '(J6 *= *[-.0-9]+ *deg)', lambda j6: f'{j6[1]}, {axis}= {next(places)}.0 mm', program
    )
    assert f'{axis}= 10.0 mm' in along
    table = read_table(write(tmp_path, 'calib.ls', along))
    assert [row[table.names.index('E1')] for row in table.rows][:2] == ['10.0', '11.0']
    # An axis that stands at 0 throughout is left out, as of other makers.
    parked = re.sub(f'{axis}= [0-9.]+', f'{axis}= 0.0', along)
    assert 'E1' not in read_table(write(tmp_path, 'calib.ls', parked)).names
    twice = along.replace(f'{axis}= 10.0 mm', 'E1= 10.0 mm, EXT1= 10.0 mm')
    with pytest.raises(InputError, match='each axis once'):
        read_table(write(tmp_path, 'calib.ls', twice))


def test_a_description_that_couples_itself_is_left_as_it_is(tmp_path, imported):
    arm = measured(rows=30)
    names = names_of('fanuc', len(arm.q))
    program = write(tmp_path, 'calib.ls', KINDS['fanuc'].write(names, np.rad2deg(arm.q)))
    points = write(tmp_path, 'points.csv', text(['Name', 'X', 'Y', 'Z'], [names, *arm.points.T]))
    (out, _), session = imported(arm.urdf, program, points)
    assert 'coupled' not in out
    np.testing.assert_allclose(session.measurements.q, arm.q, atol=2e-6)


def test_spatial_analyzers_names_are_joined_by_their_last_part(tmp_path):
    arm = measured(rows=12)
    program = write(
        tmp_path, 'p.dat', KINDS['kuka_dat'].write(names_of('kuka_dat', 12), np.rad2deg(arm.q))
    )
    lines = [
        f'A::KR6::P{i}, {x:.6f}, {y:.6f}, {z:.6f}' for i, (x, y, z) in enumerate(arm.points, 1)
    ]
    points = write(tmp_path, 'sa.txt', '\r\n'.join(['// Units: Meters', *reversed(lines)]))
    rows = read_rows([points, program], arm.chain, TableOptions())
    np.testing.assert_allclose(rows.q, arm.q[::-1], atol=2e-6)
    # Two groups with the same last parts are not joined by them.
    twice = write(tmp_path, 'sa.txt', '\r\n'.join([*lines, lines[0].replace('KR6', 'KR7')]))
    with pytest.raises(InputError, match='is also on line 1; keep one'):
        read_rows([twice, program], arm.chain, TableOptions())


def test_joints_that_ros_prints(tmp_path):
    q = np.deg2rad(joints_of(4))
    order = [2, 0, 1, 3, 5, 4]
    head = ['%time', 'field.header.seq', 'field.header.stamp', 'field.header.frame_id']
    head += [f'field.{what}{i}' for what in ('name', 'position') for i in range(6)]
    ros1 = [','.join(head)]
    ros2 = []
    for i, row in enumerate(q):
        names = [JOINTS[joint] for joint in order]
        cells = [f'{row[joint]:.9f}' for joint in order]
        ros1.append(
            ','.join(
                [
                    f'{1_700_000_000 + i}000000000',
                    str(i),
                    f'{1_700_000_000 + i}500000000',
                    '',
                    *names,
                    *cells,
                ]
            )
        )
        ros2.append(','.join([f'{1_700_000_000 + i}', '500000000', '', *names, *cells, *cells]))
    for lines in (ros1, ros2):
        table = read_table(write(tmp_path, 'echo.csv', '\n'.join(lines)))
        found = find_columns(table, JOINTS)
        np.testing.assert_allclose(numbers(table, found.joints), q, atol=1e-8)
        wrong = lines[2].replace('joint_2', 'joint_9')
        with pytest.raises(InputError, match=r"line 3: '.* is expected"):
            read_table(write(tmp_path, 'echo.csv', '\n'.join([*lines[:2], wrong, *lines[3:]])))


def test_columns_are_told_of_one_of_two_files_without_header(tmp_path):
    arm = measured(rows=8)
    joints = write(tmp_path, 'joints.txt', text([], [*np.rad2deg(arm.q).T, *np.zeros((3, 8))]))
    points = write(tmp_path, 'points.txt', text([], [*arm.points.T, *np.zeros((4, 8))]))
    chosen = ColumnChoice(joints=('joints.txt:1-6',), points=('points.txt:1-3',))
    options = TableOptions(chosen=chosen, join='order', length='m')
    rows = read_rows([points, joints], arm.chain, options)
    np.testing.assert_allclose(rows.q, arm.q, atol=1e-7)
    np.testing.assert_allclose(rows.position, arm.points, atol=1e-6)


@pytest.mark.parametrize('turns', [1, -1, 2])
def test_whole_turns_are_taken_off_where_the_limits_ask_for_it(turns, tmp_path, imported):
    arm = measured(rows=30)
    q = np.rad2deg(arm.q)
    q[::2, 1] += 360.0 * turns
    q[:, 4] = q[:, 4] % 360.0
    header = [*[f'A{i}' for i in range(1, 7)], 'X', 'Y', 'Z']
    table = write(tmp_path, 't.csv', text(header, [*q.T, *arm.points.T]))
    (out, _), session = imported(arm.urdf, table)
    assert 'whole turns were taken off, as the limits ask for it: joint_2 (15 rows)' in out
    np.testing.assert_allclose(session.measurements.q, arm.q, atol=2e-6)


def test_times_that_are_all_the_same_are_no_times(tmp_path):
    arm = measured(rows=20)
    stamp = np.full(20, 1.7e9)
    stamp[-1] += 5.0
    header = [*[f'A{i}' for i in range(1, 7)], 'X', 'Y', 'Z', 'time']
    table = write(tmp_path, 't.csv', text(header, [*np.rad2deg(arm.q).T, *arm.points.T, stamp]))
    rows = read_rows([table], arm.chain, TableOptions())
    assert rows.stamp_s is None
    assert '19 of 20 configurations have one and the same time' in rows.warnings[0]


def test_a_log_of_one_target_is_no_matrix_of_two_configurations(tmp_path):
    """It is JSON as well: its unused external axes are no angles."""
    (q,) = joints_of(1)
    log = write(tmp_path, 'log.txt', KINDS['rapid_log'].write(('',), [q]))
    table = read_table(log)
    found = find_columns(table, JOINTS)
    np.testing.assert_allclose(numbers(table, found.joints), [q], atol=1e-9)
    # Of an axis in use, beside five that are not.
    rail = write(tmp_path, 'rail.txt', log.read_text().replace('9E+09', '120.5', 1))
    assert read_table(rail).rows[0][-1] == '120.5'
    # Without any of that value it is a matrix.
    matrix = write(tmp_path, 'matrix.json', f'[{[*map(float, q)]}, {[*map(float, -q)]}]')
    assert len(read_table(matrix).rows) == 2


def mutated(rng, content, one_line, comment):
    """Return a text with one thing wrong in it, and whether a row may be lost by it."""
    at = rng.randrange(len(content))
    letter = rng.choice('0123456789.,;:-+=[]{}()"\'<>!#/ \tABEJPXjpqx')
    what = rng.choice(['change', 'change', 'remove', 'insert', 'cut', 'line'])
    if what == 'change':
        return content[:at] + letter + content[at + 1 :], letter in comment
    if what == 'remove':
        return content[:at] + content[at + 1 :], False
    if what == 'insert':
        return content[:at] + letter + content[at:], letter in comment
    if what == 'cut':
        return content[:at], True
    lines = content.splitlines(keepends=True)
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    if one_line and rng.random() < 0.5:
        lines[i], lines[j] = lines[j], lines[i]
    else:
        lines[i : i + 1] = rng.choice([[], [lines[i]] * 2])
    return ''.join(lines), True


def rows_of(table, named):
    """Return the cells of names and joints, counted."""
    found = find_columns(table, JOINTS)
    columns = (*[found.first_of_kind('name')] * named, *found.joints)
    return Counter(tuple(row[i] for i in columns) for row in table.rows)


def changed_cell(other, true, broken):
    """Return the cell that was not written so, '' where there is none.

    One thing was wrong, so one row can be other than written, in one of its cells; and that cell
    stands in the text as it was read.
    """
    assert len(other) <= 1, (broken, other)
    for row in other:
        best = min(true, key=lambda line: sum(a != b for a, b in zip(line, row, strict=True)))
        changed = [b for a, b in zip(best, row, strict=True) if a != b]
        assert len(changed) == 1, (broken, row)
        return changed[0]
    return ''


@pytest.mark.parametrize(
    ('count', 'seed'), [(60, 11), pytest.param(2000, 12, marks=pytest.mark.qualify)]
)
@pytest.mark.parametrize('kind', KINDS)
def test_a_mutated_text_is_read_right_or_refused(kind, count, seed, tmp_path):
    """Each mutated text is refused, or its rows are those written, but for what was mutated."""
    print(f'mutations of {kind}: {count}, seed {seed}')
    rng = random.Random(seed)
    made = KINDS[kind]
    q, path = joints_of(8, seed), tmp_path / 'program.txt'
    content = made.write(names_of(kind, len(q)), q)
    path.write_text(content)
    true = rows_of(read_table(path), made.named)
    read, refusals = 0, []
    for _ in range(count):
        broken, may_lose = mutated(rng, content, made.one_line, [*made.comment])
        path.write_bytes(broken.encode())
        try:
            table = read_table(path)
            columns = find_columns(table, JOINTS)
        except InputError as error:
            refusals.append(str(error))
            continue
        if not table.kind:
            # As a plain table it has no joints.
            assert not columns.joints, broken
            continue
        read += 1
        rows = rows_of(table, made.named)
        # A line may stand twice: names given twice are refused where tables are joined.
        other = [row for row in (rows - true).elements() if row not in true]
        if len(found_joints := columns.joints) != len(JOINTS):
            # `read_rows` refuses another number of joints than the robot has.
            assert found_joints != JOINTS
            continue
        changed = changed_cell(other, true, broken)
        if changed and not (kind.startswith('ur') and changed not in broken):
            number = re.escape(changed.partition('[')[0] or changed)
            stands = rf'(?<![\w.]){number}(?![\w.])|X{number}\b|{number}(?:_q|deg)'
            if kind == 'keyed' and changed.startswith('P'):
                # Of the name all that stands before the first axis.
                stands = number
            if kind == 'fanuc_registers' and changed.startswith('PR'):
                stands = rf'\[1,{changed[3:-1]}\]'
            assert re.search(stands, broken), (changed, broken)
        lost = [*(true - rows).elements()]
        if not may_lose and len(lost) > len(other):
            raise AssertionError((broken, lost))
    assert read > 0
    assert all(re.match(r'.*: |.*, line \d+: ', text) for text in refusals)


def test_the_accuracy_option_of_a_kuka_is_asked_for_and_kept(tmp_path, imported):
    arm = measured(rows=30)
    names = names_of('kuka_src', len(arm.q))
    program = write(tmp_path, 'calib.src', KINDS['kuka_src'].write(names, np.rad2deg(arm.q)))
    points = write(tmp_path, 'points.csv', text(['Name', 'X', 'Y', 'Z'], [names, *arm.points.T]))
    args = [arm.urdf, program, points, '--length', 'm', '--join', 'order', '--unchecked']
    for chosen, option in (((), ''), (('--accuracy-option', 'active'), 'active')):
        (out, _), session = imported(*args, *chosen)
        assert ('--accuracy-option' in out) == (not chosen)
        assert session.accuracy_option == option
    # Of a session it can be said afterwards.
    chosen = ['--accuracy-option', 'inactive', '--unchecked', '--quiet']
    remaster('import', tmp_path / 'session1', '--out', tmp_path / 'c', *chosen)
    assert read_session(tmp_path / 'c').accuracy_option == 'inactive'


def test_a_program_gives_the_order_and_its_data_the_positions(tmp_path):
    """Both files of a KUKA program, as a controller exports them; HOME stands in a third one."""
    arm = measured(rows=12)
    data = write(
        tmp_path, 'Calib.dat', KINDS['kuka_dat'].write(names_of('kuka_dat', 12), np.rad2deg(arm.q))
    )
    visited = [4, 0, 1, 2, 3, 11, 10, 9, 8, 7, 6, 5]
    moves = [
        f';FOLD PTP P{i + 1} Vel=100 % PDAT{i} Tool[1] Base[0]\nFDAT_ACT=FP{i}\nPTP XP{i + 1}\n'
        f';ENDFOLD\nWAIT SEC 5'
        for i in visited
    ]
    program = write(
        tmp_path,
        'calib.src',
        '\n'.join(['DEF calib( )', 'PTP XHOME', *moves, 'SPTP XHOME', 'END']),
    )
    points = write(tmp_path, 'points.csv', text(['X', 'Y', 'Z'], arm.points[visited].T))
    rows = read_rows([program, data, points], arm.chain, TableOptions(join='order'))
    np.testing.assert_allclose(rows.q, arm.q[visited], atol=2e-6)
    assert 'calib.src: moves to HOME were left out: no axis positions' in rows.warnings
    other = write(tmp_path, 'other.src', 'DEF other( )\nPTP XP1\nEND')
    with pytest.raises(InputError, match='3 files; give one table, or two'):
        read_rows([other, data, points], arm.chain, TableOptions(join='order'))
