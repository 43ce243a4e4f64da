# SPDX-License-Identifier: Apache-2.0
"""Reading takes time in proportion to a file's length, whatever is in it, and ends.

Each text is read as `remaster import` reads it, at two lengths: a reader that is quadratic takes
sixteen times as long for four times the length. Processor time, and no absolute one.
"""

import shutil
import time
from contextlib import suppress

import numpy as np
import pytest
from foreign.bag_messages import STORE
from foreign.workbooks import workbook
from rosbags.rosbag2 import StoragePlugin, Writer

from remaster_ros.errors import InputError
from remaster_ros.importing import text_table
from remaster_ros.importing.bags import read_bag
from remaster_ros.importing.rows import TableOptions, read_rows
from remaster_ros.importing.text_table import read_table
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.records.journal import format_record, read_journal

JOINT_STATE, POINT = 'sensor_msgs/msg/JointState', 'geometry_msgs/msg/PointStamped'
PLANAR_URDF = '<robot name="r"><link name="base"/>' + ''.join(
    f'<joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
    '<origin xyz="0.3 0 0"/><axis xyz="0 0 1"/>'
    '<limit lower="-3" upper="3" velocity="1" effort="1"/></joint>'
    f'<link name="{child}"/>'
    for i, parent, child in ((1, 'base', 'upper'), (2, 'upper', 'tool'))
) + '</robot>'  # fmt: skip


def lines(line, head=''):
    """Repeat a line; `{i}` is its number."""
    each = len(line.format(i=1000))
    return lambda n: head + ''.join(line.format(i=i) for i in range(1, n // each + 1))


def same(part, head='', end='\n'):
    """Repeat a part, in one line unless it ends one."""
    return lambda n: head + part * (n // len(part)) + end


def wide(cell, value, rows=2, head='', sign=';'):
    """Return a table of many columns."""

    def text(n):
        count = n // (len(cell) + 4 + rows * len(value))
        names = sign.join(cell.format(i=i) for i in range(count))
        return f'{head}{names}\n' + f'{sign.join([value] * count)}\n' * rows

    return text


COLUMNS = 'name;j1;j2;x;y;z'
SIX = '[1,2,3,4,5,6]'
TEXTS = {
    # Text of no maker
    'empty lines': same('\n'),
    'blank lines': same(' \n'),
    'returns': same('\r'),
    'empty lines above a row': same('\n', end='1 2 3 4 5\n'),
    'one line of numbers': same('1.234 '),
    'one line of numbers and commas': same('1.234,'),
    'one number': same('1'),
    'one word': same('a'),
    'blanks': same(' '),
    'blanks and tabs': same(' \t', end='x\n'),
    **{f'of {sign}': same(sign) for sign in '[({<"-.,;|'},
    'quotes in words': same('"a'),
    'rows': lines('p{i};0.1;0.2;{i};2;3\n', f'{COLUMNS}\n'),
    'rows of empty cells': same('|1|2|\n', '|a|b|\n|-|-|\n'),
    'rows of thousands': same('1.000.000,5;1.000,5\n'),
    'groups in one cell': same("'000", 'a;b\n1', ';2\n'),
    'cells with units': same('1 mm;2 mm;3 mm\n', 'a;b;c\n'),
    'lists in cells': same('t;[1 2 3]\n'),
    'one list in a cell': same('1 ', 't;[', ']\n'),
    'empty cells in place of a list': lambda n: f't;[{"1 " * (n // 4)}]\n' + 't;-\n' * (n // 8),
    'sums': same('mean;3;4\n', 'a;b\n1;2\n'),
    'names again and again': same('a;b\n', 'a;b\n1;2\n'),
    'comments': same('# a b c\n'),
    'many columns': wide('c{i}', '1'),
    'many markers': wide('m{i}_x;m{i}_y;m{i}_z', '1;2;3', head=f'{COLUMNS};'),
    'a name of many words': same('a ', f'{COLUMNS};', f'\n{"p;1;2;3;4;5;6" * 3}\n'),
    'a time of many digits': same('1', 'time;j1;j2;x;y;z\n', ';1;2;3;4;5\n'),
    'a time of many words': same('1:2 ', 'time;j1;j2;x;y;z\n', ';1;2;3;4;5\n'),
    'a unit in the preamble': same('unit ', end=f'\n{COLUMNS}\np;1;2;3;4;5\n'),
    'a row for each axis': lines('p{i};X;1;2\np{i};Y;1;2\np{i};Z;1;2\n', 'name;axis;a;b\n'),
    'a name of signs': same('-', 'name;a;b\n', 'X;1;2\n'),
    # Text of makers
    'URScript': same(f'movej({SIX})\n'),
    'URScript in one line': same(f'movej({SIX}) '),
    'URScript with names': lines('movej(p{i})\n'),
    'a list of URScript': same(f'{SIX},', 'movej(x)\nx=[', ']\n'),
    'an open list of URScript': same('1,2\n', f'movej({SIX})\nx=[\n'),
    'PolyScope': same('<JointAngles angles="1,2,3,4,5,6"/>\n'),
    'FANUC': lines('P[{i}]{{\n GP1:\n J1= 1 deg, J2= 2 deg\n}};\n'),
    'FANUC in one line': same('P[1]{ J1= 1 deg, J2= 2 deg}; '),
    'an open position of FANUC': same(' GP1: ', 'P[1]{'),
    'registers of FANUC': lines(
        "[1,{i}] = '' Group: 1\n J1 = 1 deg J2 = 2 deg\n", '[*POSREG*]$POSREG ARRAY[9]\n'
    ),
    'KUKA': same('XP1={E6AXIS: A1 1,A2 2}\n', 'DEF a()\n'),
    'KUKA in one line': same('XP1={E6AXIS: A1 1,A2 2} ', 'DEF a()\n'),
    'a word of KUKA': same('a', 'DEF a()\n', '{A1 1,A2 2}\n'),
    'RAPID': lines('CONST jointtarget j{i}:=[[1,2,3,4,5,6],[9E9,9E9]];\n', 'MODULE a\n'),
    'an array of RAPID': same(f'[{SIX},[9E9]],', 'CONST jointtarget j{3}:=[', '];\n'),
    'external axes of RAPID': same('1,', f'CONST jointtarget j:=[{SIX},[', '1]];\n'),
    'no semicolon in RAPID': same('x\n', 'MODULE a\nCONST jointtarget j:=\n'),
    'lists': same(f'P1: {SIX}\n'),
    'lists in one line': same(f'{SIX} '),
    'keys': same('P1 X=1.5 Y=2.5 Z=3.5\n'),
    'keys in one line': same('P1 X=1.5 Y=2.5 Z=3.5 '),
    'axes by line': same('P1.X;1,5\nP1.Y;1,5\nP1.Z;1,5\n'),
    'GSI': same(
        '*110001+0000000000000001 81..00+0000000000002787 82..00+0000000000002787 '
        '83..00+0000000000002787\n'
    ),
    'GSI in one line': same('110001+0000000000000001 ', '*'),
    'Doosan': same('movej(posj(1,2,3,4,5,6))\n'),
    'Doosan in one line': same('movej(posj(1,2,3,4,5,6)) '),
    'Kawasaki': lines('#p{i} 1 2 3 4 5 6\n', '.JOINTS\n'),
    'many axes of Kawasaki': same('1 ', '.JOINTS\n#p '),
    'Yaskawa': lines('C{i}=1,2,3,4,5,6\n', '/JOB\n///POSTYPE ANGLE\n'),
    'Staubli': lines('<a name="p{i}" j1="1" j2="2"/>\n'),
    'Staubli without keys': same('<v j1="1" j2="2"/>\n', '<a name="p">\n'),
    'attributes of Staubli': same('j1="1" ', '<a ', '/>\n'),
    'Motive': same(',', 'Format Version,1.23,Length Units,Meters\n'),
    'Vicon': lines(
        '{i},0,1,2,3\n', 'Trajectories\n100\n,,a,,\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n'
    ),
    'rostopic': same('1,a,b,0,0\n', '%time,' + ','.join(
        f'field.{what}{i}' for what in ('name', 'position') for i in (0, 1)
    ) + '\n'),
    'messages as YAML': same('position:\n- 1\n---\n'),
    'JSON lines': lines('{{"t": {i}, "q": [1, 2, 3], "p": [3, 4, 5]}}\n'),
    'JSON': same('[1,2],', '{"q": [', '[1,2]]}'),
    'PacScript': lines('J[{i}] = J(1, 2, 3, 4, 5, 6, 0, 0)\n'),
    'replies': same('[2026-01-01 10:00:00] 0,{1,2,3,4,5,6},GetAngle();\n'),
    'Qualisys': lines('{i}\t{i}.5\t1\t2\t3\n', 'NO_OF_FRAMES\t9\nMARKER_NAMES\ta\n'
        'Frame\tTime\ta X\ta Y\ta Z\n'),
}  # fmt: skip
SHORT, LONG = 10_000, 40_000
# Of four times the length twice three times the time, as of a reader that takes less than three
# times as long for twice the length; below the second figure a clock tells too little.
MOST_TIMES, SOON_S = 9.0, 0.1
# An idle computer takes less than 5 s for 1 MB of any of them; one whose processors and caches are
# shared up to three times as long.
MOST_S_PER_MB = 20.0
TRIES = 3


@pytest.fixture(scope='module')
def chain(tmp_path_factory):
    chain = SerialChain.from_urdf(PLANAR_URDF, 'base', 'tool')
    # What is imported with the first table is no time of a reader.
    seconds(tmp_path_factory.mktemp('first') / 'table.txt', TEXTS['rows'](1000), chain)
    return chain


def seconds(path, text, chain):
    path.write_text(text)
    begun = time.process_time()
    with suppress(InputError):
        read_rows([path], chain, TableOptions())
    return time.process_time() - begun


@pytest.mark.timeout(300)
@pytest.mark.parametrize('name', TEXTS)
def test_time_is_in_proportion_to_length(name, tmp_path, chain):
    path = tmp_path / 'table.txt'
    texts = TEXTS[name](SHORT), TEXTS[name](LONG)
    assert len(texts[1]) > 3 * len(texts[0])
    for _ in range(TRIES):
        # What else the machine does takes caches away, and so the least of some tries counts.
        short, long = (seconds(path, text, chain) for text in texts)
        if long < max(SOON_S, min(MOST_TIMES * short, MOST_S_PER_MB * LONG / 1e6)):
            return
    pytest.fail(f'{SHORT} characters take {short:.2f} s, {LONG} {long:.2f} s')


def workbook_of(folder, count):
    path = folder / 't.xlsx'
    rows = [[f'p{i}', 0.1, 0.2, float(i), 2.0, 3.0] for i in range(count)]
    path.write_bytes(workbook({'Data': [COLUMNS.split(';'), *rows]}))
    return path


def array_of(folder, count):
    path = folder / 't.npy'
    np.save(path, np.random.default_rng(0).uniform(0.1, 0.9, (count, 5)))
    return path


def archive_of(folder, count):
    path = folder / 't.npz'
    values = np.random.default_rng(0).uniform(0.1, 0.9, (count, 5))
    np.savez(path, joints=values[:, :2], points=values[:, 2:])
    return path


def of_table(path, chain):
    with suppress(InputError):
        read_rows([path], chain, TableOptions())


def journal_of(folder, count):
    path = folder / 'journal.jsonl'
    record = {'row': 1, 'q_rad': [0.1] * 7, 'sensor': 'mocap', 'note': 'a' * 40}
    path.write_bytes(b''.join(format_record({**record, 'row': i}) for i in range(count)))
    return path


def torn_journal_of(folder, count):
    """Nothing but lines cut off: each may be the last one."""
    path = folder / 'journal.jsonl'
    path.write_bytes(b'{"row":1,"q_rad":[0.1\n' * count)
    return path


def of_journal(path, chain):
    with suppress(InputError):
        read_journal(path)


def bag_of(folder, count, plugin):
    path = folder / 'bag'
    shutil.rmtree(path, ignore_errors=True)
    kinds = STORE.types
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        topics = {'/joint_states': JOINT_STATE, '/camera/marker': POINT}
        to = {
            topic: writer.add_connection(topic, kind, typestore=STORE)
            for topic, kind in topics.items()
        }
        for i in range(count):
            # Three quarters of a second of standing, a quarter of moving, again and again.
            ns = 1_700_000_000_000_000_000 + 25_000_000 * i
            stamp = kinds['builtin_interfaces/msg/Time'](ns // 10**9, ns % 10**9)
            header = kinds['std_msgs/msg/Header'](stamp, '')
            at = 0.1 * (i // 40 + max(0, i % 40 - 30) / 10.0)
            at = at % 2.0
            q, empty = np.array([at, 0.5 * at]), np.zeros(0)
            state = kinds[JOINT_STATE](header, ['j1', 'j2'], q, empty, empty)
            place = kinds['geometry_msgs/msg/Point'](at, 1.0, 0.5)
            for topic, message in (
                ('/joint_states', state),
                ('/camera/marker', kinds[POINT](header, place)),
            ):
                writer.write(to[topic], ns, STORE.serialize_cdr(message, topics[topic]))
    return path


def of_bag(path, chain):
    with suppress(InputError):
        read_bag(path, chain)


def mcap_of(folder, count):
    return bag_of(folder, count, StoragePlugin.MCAP)


def sqlite_of(folder, count):
    return bag_of(folder, count, StoragePlugin.SQLITE3)


# What makes a file of so many rows, how many, and what reads it.
BINARY = {
    'workbook': (workbook_of, 400, of_table),
    'array': (array_of, 2000, of_table),
    'archive': (archive_of, 2000, of_table),
    'journal': (journal_of, 4000, of_journal),
    'torn journal': (torn_journal_of, 20_000, of_journal),
    'mcap': (mcap_of, 1500, of_bag),
    'sqlite': (sqlite_of, 1500, of_bag),
}


@pytest.mark.timeout(300)
@pytest.mark.parametrize('name', BINARY)
def test_time_is_in_proportion_to_rows(name, tmp_path, chain):
    make, count, read = BINARY[name]
    for _ in range(TRIES):
        took = []
        for times_as_long in (1, 4):
            path = make(tmp_path, times_as_long * count)
            begun = time.process_time()
            read(path, chain)
            took.append(time.process_time() - begun)
        print(f'{name}: {count} rows {took[0]:.3f} s, four times as many {took[1]:.3f} s')
        if took[1] < max(SOON_S, MOST_TIMES * took[0]):
            return
    pytest.fail(f'{count} rows take {took[0]:.2f} s, four times as many {took[1]:.2f} s')


def test_what_takes_too_long_all_the_same_ends_with_the_file_and_the_remedy(tmp_path, monkeypatch):
    # An expression of a reader to come, with two ways to match each letter.
    slow = text_table.re.compile('(a|a)*b')
    monkeypatch.setattr(text_table, 'READERS', (slow.match,))
    monkeypatch.setattr(text_table, 'CPU_S', 0.2)
    path = tmp_path / 'table.txt'
    path.write_text('a' * 60)
    begun = time.process_time()
    with pytest.raises(InputError, match=r'table.txt: not read after .* s of processor time'):
        read_table(path)
    assert time.process_time() - begun < 10.0
    monkeypatch.undo()
    path.write_text('a;b\n1;2\n')
    assert len(read_table(path).rows) == 1
