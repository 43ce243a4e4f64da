# SPDX-License-Identifier: Apache-2.0
"""Arrays, bags and pulses with one thing wrong: read right but for it, or refused in one line."""

import random

import numpy as np
import pytest
from foreign.bag_messages import STORE
from foreign.tables import measured, text
from foreign.workbooks import workbook
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from test_makers import mutated

from remaster_ros.errors import InputError
from remaster_ros.importing.bags import read_bag
from remaster_ros.importing.rows import TableOptions, read_rows
from remaster_ros.session.bags.bag_writer import BagWriter
from remaster_ros.types import FARTHEST_M

COUNTS = pytest.mark.parametrize(
    ('count', 'seed'), [(60, 31), pytest.param(2000, 32, marks=pytest.mark.qualify)]
)
JOINT_STATE, POINT = 'sensor_msgs/msg/JointState', 'geometry_msgs/msg/PointStamped'
PULSES = (1341.4, 1341.4, 1306.9, 1000.0, 1022.7, 602.7)
ROWS = 12
# A bag of stops that a reader takes for stops: reports at 20 Hz for a second each.
STOPS, REPORTS, STEP_MS = 3, 20, 50


@pytest.fixture(scope='module')
def arm():
    return measured()


def damaged(rng, content):
    """Return bytes with one thing wrong."""
    at = rng.randrange(len(content))
    what = rng.choice(['change', 'bit', 'remove', 'insert', 'cut', 'zeros', 'twice'])
    if what == 'change':
        return content[:at] + bytes([rng.randrange(256)]) + content[at + 1 :]
    if what == 'bit':
        return content[:at] + bytes([content[at] ^ 1 << rng.randrange(8)]) + content[at + 1 :]
    if what == 'remove':
        return content[:at] + content[at + 1 :]
    if what == 'insert':
        return content[:at] + bytes([rng.randrange(256)]) + content[at:]
    if what == 'cut':
        return content[:at]
    length = rng.choice([1, 8, 64])
    if what == 'zeros':
        return content[:at] + bytes(min(length, len(content) - at)) + content[at + length :]
    return content[: at + length] + content[at:]


def rows_or_none(read, path, refusals):
    """Return what was read; None where it was refused, in one line that names the file."""
    try:
        return read()
    except InputError as error:
        line = str(error)
        assert '\n' not in line
        assert str(path) in line, line
        refusals.append(line)
        return None


def as_set(rows):
    return {tuple(row) for row in np.column_stack((rows.q, rows.position)).tolist()}


@COUNTS
@pytest.mark.parametrize('kind', ['npz', 'xlsx'])
def test_a_mutated_archive_is_read_right_or_refused(kind, arm, count, seed, tmp_path):
    """Parts of an archive have checksums: what is read is what was written."""
    print(f'mutations of {kind}: {count}, seed {seed}')
    rng, path, refusals = random.Random(seed), tmp_path / f't.{kind}', []
    if kind == 'npz':
        np.savez(path, joints=arm.q[:ROWS], points=arm.points[:ROWS])
    else:
        both = np.column_stack((arm.q, arm.points))[:ROWS].round(6).tolist()
        head = [*(f'A{i}' for i in range(1, 7)), *'XYZ']
        path.write_bytes(workbook({'Data': [head, *both]}))
    content, read = path.read_bytes(), 0
    options = TableOptions(length='m', angles='rad')
    true = as_set(read_rows([path], arm.chain, options))
    for _ in range(count):
        path.write_bytes(damaged(rng, content))
        rows = rows_or_none(lambda: read_rows([path], arm.chain, options), path, refusals)
        if rows is not None:
            read += 1
            assert as_set(rows) == true
    assert refusals
    assert read


@COUNTS
def test_a_mutated_array_is_read_right_but_for_it_or_refused(arm, count, seed, tmp_path):
    """An array has no checksum: what was changed is read as it stands, and nothing else is."""
    print(f'mutations: {count}, seed {seed}')
    rng, path, refusals = random.Random(seed), tmp_path / 't.npy', []
    np.save(path, np.column_stack((arm.q, arm.points))[:ROWS])
    content, read = path.read_bytes(), 0
    options = TableOptions(length='m', angles='rad')
    true = as_set(read_rows([path], arm.chain, options))
    head = content.index(b'\n') + 1
    for _ in range(count):
        broken = damaged(rng, content)
        path.write_bytes(broken)
        rows = rows_or_none(lambda: read_rows([path], arm.chain, options), path, refusals)
        if rows is None:
            continue
        read += 1
        found = as_set(rows)
        assert np.isfinite([*found]).all()
        assert all(abs(value) <= FARTHEST_M for row in found for value in row[-3:])
        if len(broken) == len(content):
            # Of so many bytes in a row no more than two rows.
            same_head = broken[:head] == content[:head]
            assert not same_head or len(found - true) <= 2, broken
    assert refusals
    assert read


@COUNTS
@pytest.mark.parametrize('kind', ['csv', 'jbi'])
def test_mutated_pulses_are_read_right_but_for_it_or_refused(kind, arm, count, seed, tmp_path):
    print(f'mutations of {kind}: {count}, seed {seed}')
    rng, refusals = random.Random(seed), []
    path, points = tmp_path / f'pulses.{kind}', tmp_path / 'points.csv'
    pulses = np.rint(np.rad2deg(arm.q[:ROWS]) * PULSES).astype(int)
    places = arm.points[:ROWS].round(6)
    names = [f'C{i:05d}' for i in range(ROWS)]
    if kind == 'csv':
        content = text([*'SLURBT', 'X', 'Y', 'Z'], [*pulses.T, *places.T])
        files = [path]
    else:
        lines = [f'{name}={",".join(map(str, row))}' for name, row in zip(names, pulses)]
        head = ['/JOB', '//NAME CAL', '//POS', f'///NPOS {ROWS},0,0,0,0,0', '///TOOL 0']
        head += ['///POSTYPE PULSE', '///PULSE']
        content = '\n'.join([*head, *lines, '//INST', '///DATE 2026/11/28 10:00', 'NOP', 'END'])
        points.write_text(text(['name', *'XYZ'], [names, *places.T]))
        files = [path, points]
    options = TableOptions(length='m', pulses_per_degree=PULSES)
    path.write_text(content)
    right = read_rows(files, arm.chain, options)
    np.testing.assert_allclose(right.q, np.deg2rad(pulses / PULSES), rtol=0.0, atol=1e-12)
    true, read = as_set(right), 0
    for _ in range(count):
        broken, _ = mutated(rng, content, True, '#/!*')
        path.write_text(broken)
        rows = rows_or_none(lambda: read_rows(files, arm.chain, options), tmp_path, refusals)
        if rows is None:
            continue
        read += 1
        # Exchanged lines of a job without names give one point to another's joints; a number that
        # was changed is in one row.
        other = as_set(rows) - true
        assert len(other) <= 2, (broken, other)
    assert refusals
    assert read


def stream_messages(arm):
    types = STORE.types
    for i in range(STOPS):
        for k in range(REPORTS):
            ms = 1_700_000_000_000 + STEP_MS * (2 * REPORTS * i + k)
            stamp = types['builtin_interfaces/msg/Time'](ms // 1000, ms % 1000 * 1_000_000)
            header = types['std_msgs/msg/Header'](stamp, '')
            names, empty = list(arm.chain.joint_names), np.zeros(0)
            state = types[JOINT_STATE](header, names, arm.q[i], empty, empty)
            place = types['geometry_msgs/msg/Point'](*arm.points[i].tolist())
            yield '/joint_states', JOINT_STATE, state, ms * 1_000_000
            yield '/camera/marker', POINT, types[POINT](header, place), ms * 1_000_000


def bag_of(folder, plugin, arm):
    """Write a bag, and return its file."""
    if plugin == 'ours':
        with BagWriter(folder) as writer:
            for topic, kind, message, ns in stream_messages(arm):
                writer.write(topic, kind, bytes(STORE.serialize_cdr(message, kind)), ns)
    else:
        with RosbagsWriter(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            connections = {}
            for topic, kind, message, ns in stream_messages(arm):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
                writer.write(connections[topic], ns, STORE.serialize_cdr(message, kind))
    (file,) = [path for path in folder.iterdir() if path.suffix in ('.mcap', '.db3')]
    return file


@COUNTS
@pytest.mark.parametrize('plugin', ['ours', 'sqlite3'])
def test_a_mutated_bag_is_read_right_but_for_it_or_refused(plugin, arm, count, seed, tmp_path):
    """An mcap has checksums, SQLite none: there one message may be other than written."""
    print(f'mutations of {plugin}: {count}, seed {seed}')
    rng, folder, refusals, read = random.Random(seed), tmp_path / 'bag', [], 0
    file = bag_of(folder, plugin, arm)
    content = file.read_bytes()

    def rows():
        return read_bag(folder, arm.chain, clock_offset_s=0.0)

    true = as_set(rows())
    assert len(true) == STOPS
    for _ in range(count):
        file.write_bytes(damaged(rng, content))
        found = rows_or_none(rows, folder, refusals)
        if found is not None:
            read += 1
            assert np.isfinite(found.q).all()
            assert np.isfinite(found.position).all()
            if plugin == 'ours':
                assert as_set(found) <= true
    assert refusals
    assert read or plugin == 'ours'
