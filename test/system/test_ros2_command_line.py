# SPDX-License-Identifier: Apache-2.0
"""What a user does with the real `ros2` command line; beside each, the same through rclpy.

Parameters are in test_parameters_live.py, launch files in unit/nodes/test_launching.py.
"""

import shutil
import subprocess

import pytest
import yaml
from rigs.ros_rig import node_arguments, wait_until

from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.bags.bag_writer import BagWriter
from remaster_ros.session.cells.workcell import read_cell

pytestmark = [pytest.mark.ros, pytest.mark.timeout(900)]

needs_ros2 = pytest.mark.skipif(shutil.which('ros2') is None, reason='no ros2 command line here')
COMMANDS = '/joint_trajectory_controller/joint_trajectory'
NAMES = list(read_cell('demo').chain().joint_names)


def ros2(environment, *args, timeout=900):
    return subprocess.run(
        ['ros2', *map(str, args)],
        env=environment, capture_output=True, text=True, timeout=timeout, check=False,
    )  # fmt: skip


def until(client, condition, timeout_s, what):
    wait_until(lambda: client.spin_some() or condition(), timeout_s, what)


@pytest.fixture
def session_bag(start, client, tmp_path):
    """Return the bag of a real recorder during which an arm was commanded and poses published."""
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    kinds = {
        'joint_states': JointState,
        COMMANDS: JointTrajectory,
        'remaster/joint_solutions': JointTrajectory,
    }
    publishers = {
        topic: client.create_publisher(kind, topic, QoSProfile(depth=10))
        for topic, kind in kinds.items()
    }
    session = tmp_path / 'session'
    recorder = start(
        'remaster_ros.nodes.recorder', *node_arguments(session=session, call_measure=False)
    )
    until(
        client,
        lambda: all(p.get_subscription_count() for p in publishers.values()),
        60,
        'the recorder',
    )
    trajectory = JointTrajectory(joint_names=NAMES)
    trajectory.points = [JointTrajectoryPoint(positions=[0.5] * 7)]
    for _ in range(20):
        publishers['joint_states'].publish(JointState(name=NAMES, position=[0.1] * 7))
        publishers[COMMANDS].publish(trajectory)
        publishers['remaster/joint_solutions'].publish(trajectory)
        client.spin_some()
    until(client, lambda: (session / 'bag').is_dir(), 20, 'the bag')
    recorder.terminate()
    assert recorder.wait(30) == 0
    for publisher in publishers.values():
        client.destroy_publisher(publisher)
    return session / 'bag'


def test_a_bag_names_nothing_that_moves_an_arm(session_bag):
    """What any player that takes a bag as it is would publish."""
    counts = BagReader(session_bag).counts
    assert counts['/joint_states'] > 0
    assert counts['/remaster/recorded/joint_trajectory'] > 0
    assert counts['/remaster/recorded/joint_solutions'] > 0
    assert not {COMMANDS, '/remaster/joint_solutions', '/remaster/joint_waypoints'} & set(counts)


@needs_ros2
def test_ros2_bag_play_moves_nothing(client, session_bag, ros_environment):
    from trajectory_msgs.msg import JointTrajectory

    commands = []
    for topic in (COMMANDS, '/remaster/joint_solutions'):
        client.create_subscription(JointTrajectory, topic, commands.append, 100)
    played = ros2(ros_environment, 'bag', 'play', session_bag)
    assert played.returncode == 0, played.stderr
    until(client, lambda: True, 5, 'what is left')
    assert not commands


@needs_ros2
def test_ros2_bag_play_of_an_old_bag_with_the_topics_excluded(client, tmp_path, ros_environment):
    from rclpy.serialization import serialize_message
    from trajectory_msgs.msg import JointTrajectory

    data = serialize_message(JointTrajectory(joint_names=NAMES))
    with BagWriter(tmp_path / 'old') as writer:
        for topic in (COMMANDS, '/remaster/joint_solutions'):
            writer.write(topic, 'trajectory_msgs/msg/JointTrajectory', data, 10**18)
    commands = []
    for topic in (COMMANDS, '/remaster/joint_solutions'):
        client.create_subscription(JointTrajectory, topic, commands.append, 100)
    excluded = ('--exclude-topics', COMMANDS, '/remaster/joint_solutions')
    played = ros2(ros_environment, 'bag', 'play', tmp_path / 'old', *excluded)
    assert played.returncode == 0, played.stderr
    until(client, lambda: True, 5, 'what is left')
    assert not commands


@pytest.mark.parametrize('key', ['/**/recorder', '/left/recorder'])
def test_a_parameter_file_holds_in_a_namespace(start, client, tmp_path, key):
    """A shipped file, or a user's own, for a node that was moved by `-r __ns`."""
    path = tmp_path / 'mine.yaml'
    values = {'require': 'tracker', 'session': str(tmp_path / 'session')}
    path.write_text(yaml.safe_dump({key: {'ros__parameters': values}}))
    client_status = []
    from diagnostic_msgs.msg import DiagnosticArray

    client.create_subscription(DiagnosticArray, '/left/remaster/status', client_status.append, 10)
    start('remaster_ros.nodes.recorder', *node_arguments(path), '-r', '__ns:=/left')

    def required():
        return {
            pair.value
            for array in client_status
            for status in array.status
            for pair in status.values
            if pair.key == 'require'
        }

    until(client, required, 60, 'the recorder')
    assert required() == {'tracker'}


@needs_ros2
def test_ros2_node_list_shows_the_namespace(start, client, tmp_path, ros_environment):
    start(
        'remaster_ros.nodes.recorder',
        *node_arguments(session=tmp_path / 'session'), '-r', '__ns:=/left',
    )  # fmt: skip
    until(
        client, lambda: ('recorder', '/left') in client.get_node_names_and_namespaces(), 60, 'it'
    )
    assert '/left/recorder' in ros2(ros_environment, 'node', 'list').stdout.split()
