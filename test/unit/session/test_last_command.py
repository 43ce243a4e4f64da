"""The file that keeps where an arm was led last."""

import numpy as np
import pytest

from remaster_ros.session.bridge_files import HaltFile, LastCommandFile

JOINTS = ['joint_1', 'joint_2']
NOW_NS = 1_800_000_000_123_456_789


def file(folder, joints=JOINTS, node='/left/robot_bridge'):
    return LastCommandFile(node, joints, {'ROS_HOME': str(folder), 'ROS_DOMAIN_ID': '7'})


def test_it_is_beside_the_halt(tmp_path):
    environment = {'ROS_HOME': str(tmp_path), 'ROS_DOMAIN_ID': '7'}
    assert file(tmp_path).path.parent == HaltFile('/left/robot_bridge', environment).path.parent
    assert file(tmp_path).path.name == 'command_7_left.robot_bridge.json'


def test_what_is_written_comes_back_to_the_last_bit(tmp_path):
    assert file(tmp_path).read(NOW_NS) is None
    end = np.array([0.1 + 0.2, -np.pi])
    file(tmp_path).write(end, NOW_NS)
    last = file(tmp_path).read(NOW_NS + 2_500_000_000)
    assert last.end.tolist() == end.tolist()
    assert last.age_s == 2.5


@pytest.mark.parametrize(
    'joints', [['joint_2', 'joint_1'], ['joint_1'], ['joint_1', 'joint_2', 'joint_3']]
)
def test_of_another_arm_it_is_not_known_where_the_command_led(tmp_path, joints):
    file(tmp_path).write(np.zeros(2), NOW_NS)
    last = file(tmp_path, joints).read(NOW_NS)
    assert (last.end, last.age_s) == (None, 0.0)


@pytest.mark.parametrize(
    'text',
    ['', 'x', '{}', '{"joints": ["joint_1", "joint_2"], "end": [0.1], "sent_ns": "now"}'],
)
def test_of_a_damaged_one_nothing_is_known(tmp_path, text):
    path = file(tmp_path).path
    path.parent.mkdir()
    path.write_text(text)
    last = file(tmp_path).read(NOW_NS)
    assert (last.end, last.age_s) == (None, np.inf)


def test_after_the_clock_was_set_back_it_is_not_known_how_long_ago_it_was(tmp_path):
    file(tmp_path).write(np.zeros(2), NOW_NS)
    last = file(tmp_path).read(NOW_NS - 1)
    assert last.end is not None
    assert last.age_s == np.inf
