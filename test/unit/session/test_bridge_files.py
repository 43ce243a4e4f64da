# SPDX-License-Identifier: Apache-2.0
"""What a bridge keeps on the disk: a halt, and where the arm was led last."""

import json
import re
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from remaster_ros.errors import RemasterError
from remaster_ros.session import bridge_files
from remaster_ros.session.bridge_files import HaltFile, LastCommandFile


@pytest.fixture
def file(tmp_path):
    return HaltFile('/robot_bridge', {'ROS_HOME': str(tmp_path), 'ROS_DOMAIN_ID': '7'})


def test_it_is_named_by_home_domain_and_node(tmp_path, monkeypatch):
    environment = {'ROS_HOME': str(tmp_path), 'ROS_DOMAIN_ID': '7'}
    folder = tmp_path / 'remaster_ros'
    assert HaltFile('/robot_bridge', environment).path == folder / 'halt_7_robot_bridge.json'
    nested = HaltFile('/left/robot_bridge', environment).path
    assert nested == folder / 'halt_7_left.robot_bridge.json'
    monkeypatch.setenv('HOME', str(tmp_path / 'me'))
    expected = tmp_path / 'me' / '.ros' / 'remaster_ros' / 'halt_0_robot_bridge.json'
    assert HaltFile('/robot_bridge', {}).path == expected
    assert HaltFile('/robot_bridge', {'ROS_HOME': '', 'ROS_DOMAIN_ID': ''}).path == expected
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    monkeypatch.setenv('ROS_DOMAIN_ID', '3')
    assert HaltFile('/robot_bridge').path == folder / 'halt_3_robot_bridge.json'


def test_no_two_bridges_have_the_same_file(tmp_path):
    """The halt of one cell must not be cleared with that of another."""
    environment = {'ROS_HOME': str(tmp_path)}
    names = ['/a/b/bridge', '/a_b/bridge', '/a/b_bridge', '/a_b_bridge', '/bridge', '/X/bridge']
    assert len({HaltFile(name, environment).path for name in names}) == len(names)
    assert all(
        HaltFile(name, environment).path.parent == tmp_path / 'remaster_ros' for name in names
    )


def test_a_halt_is_kept_until_it_is_cleared(file):
    file.clear()
    assert file.read() == ''
    assert not file.path.parent.exists()
    file.write('the arm was pushed')
    pattern = (
        r'the arm was pushed \(halted \d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC, '
        r'before this bridge was started\)'
    )
    assert re.fullmatch(pattern, file.read())
    assert json.loads(file.path.read_text())['halted'] == 'the arm was pushed'
    file.write('again')
    assert file.read().startswith('again (halted ')
    file.clear()
    assert file.read() == ''
    assert list(file.path.parent.iterdir()) == []
    file.clear()


@pytest.mark.parametrize(
    ('content', 'reason'),
    [
        (b'', 'truncated'),
        (b'{"halted": "x"}', 'since'),
        (b'{"halted": 3, "since": "x"}', 'str'),
        (b'\xff\xfe', 'malformed'),
        (b' ' * 65537, 'larger than 65536 bytes'),
    ],
)
def test_a_damaged_file_is_a_halt(file, content, reason):
    file.path.parent.mkdir()
    file.path.write_bytes(content)
    found = file.read()
    assert found.startswith(f'{file.path}: a halt that cannot be read (')
    assert reason in found
    assert found.endswith(')')
    file.clear()
    assert file.read() == ''


def test_a_file_of_the_largest_size_is_read(file):
    file.path.parent.mkdir()
    halt = json.dumps({'halted': 'full', 'since': 'then'}).encode()
    file.path.write_bytes(halt + b' ' * (64 * 1024 - len(halt)))
    assert file.read() == 'full (halted then, before this bridge was started)'


def test_a_file_that_cannot_be_looked_at_is_a_halt(tmp_path):
    """What the disk answers with an error may be a halt: it does not let the arm move."""
    file = HaltFile('/robot_bridge', {'ROS_HOME': str(tmp_path / ('x' * 300))})
    assert 'a halt that cannot be read' in file.read()
    assert 'too long' in file.read()


def test_a_folder_that_cannot_be_made_is_one_error(tmp_path):
    (tmp_path / 'home').write_text('a file')
    file = HaltFile('/robot_bridge', {'ROS_HOME': str(tmp_path / 'home')})
    with pytest.raises(RemasterError, match='home'):
        file.write('x')


def test_its_time_is_utc(file, monkeypatch):
    monkeypatch.setenv('TZ', 'XXX-9')
    time.tzset()
    try:
        file.write('x')
        since = json.loads(file.path.read_text())['since']
    finally:
        monkeypatch.undo()
        time.tzset()
    then = datetime.strptime(since, '%Y-%m-%d %H:%M:%S UTC').replace(tzinfo=UTC)
    assert abs((datetime.now(UTC) - then).total_seconds()) < 600


def test_a_halt_that_was_cleared_does_not_come_back_after_a_power_cut(file, monkeypatch):
    file.write('x')
    synced = []
    monkeypatch.setattr(
        bridge_files, 'sync_folder', lambda folder: synced.append((folder, file.path.exists()))
    )
    file.clear()
    assert synced == [(file.path.parent, False)]


def test_the_folder_may_be_there_with_others_in_it(file):
    other = Path(file.path.parent) / 'halt_7_other.json'
    file.path.parent.mkdir()
    other.write_text('x')
    file.write('x')
    file.clear()
    assert other.read_text() == 'x'


JOINTS = ['joint_1', 'joint_2']
NOW_NS = 1_800_000_000_123_456_789


def command(folder, joints=JOINTS, node='/left/robot_bridge'):
    return LastCommandFile(node, joints, {'ROS_HOME': str(folder), 'ROS_DOMAIN_ID': '7'})


def test_the_last_command_is_beside_the_halt(tmp_path):
    environment = {'ROS_HOME': str(tmp_path), 'ROS_DOMAIN_ID': '7'}
    assert command(tmp_path).path.parent == HaltFile('/left/robot_bridge', environment).path.parent
    assert command(tmp_path).path.name == 'command_7_left.robot_bridge.json'


def test_the_end_of_a_command_comes_back_to_the_last_bit(tmp_path):
    assert command(tmp_path).read(NOW_NS) is None
    end = np.array([0.1 + 0.2, -np.pi])
    command(tmp_path).write(end, NOW_NS)
    last = command(tmp_path).read(NOW_NS + 2_500_000_000)
    assert last.end.tolist() == end.tolist()
    assert last.age_s == 2.5


@pytest.mark.parametrize(
    'joints', [['joint_2', 'joint_1'], ['joint_1'], ['joint_1', 'joint_2', 'joint_3']]
)
def test_of_another_arm_it_is_not_known_where_the_command_led(tmp_path, joints):
    command(tmp_path).write(np.zeros(2), NOW_NS)
    last = command(tmp_path, joints).read(NOW_NS)
    assert (last.end, last.age_s) == (None, 0.0)


@pytest.mark.parametrize(
    'text',
    ['', 'x', '{}', '{"joints": ["joint_1", "joint_2"], "end": [0.1], "sent_ns": "now"}'],
)
def test_of_a_damaged_one_nothing_is_known(tmp_path, text):
    path = command(tmp_path).path
    path.parent.mkdir()
    path.write_text(text)
    last = command(tmp_path).read(NOW_NS)
    assert (last.end, last.age_s) == (None, np.inf)


def test_after_the_clock_was_set_back_it_is_not_known_how_long_ago_it_was(tmp_path):
    command(tmp_path).write(np.zeros(2), NOW_NS)
    last = command(tmp_path).read(NOW_NS - 1)
    assert last.end is not None
    assert last.age_s == np.inf
