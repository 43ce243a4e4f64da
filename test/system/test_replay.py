# SPDX-License-Identifier: Apache-2.0
"""A replay moves no arm: on a live graph it ends with status 2, and it leaves commands out."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from rigs.ros_rig import node_arguments, wait_until
from worlds.recorded_bags import RecordedArm

from remaster_ros.session.bag_replay import differences, record_from_bag
from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.bags.bag_writer import BagWriter
from remaster_ros.session.cells.workcell import read_cell

pytestmark = [pytest.mark.ros, pytest.mark.timeout(900)]

COMMANDS = '/joint_trajectory_controller/joint_trajectory'
STATE, TRAJECTORY = 'sensor_msgs/msg/JointState', 'trajectory_msgs/msg/JointTrajectory'
NAMES = list(read_cell('demo').chain().joint_names)
AT_REST = np.full(len(NAMES), 0.2)


@pytest.fixture(params=[pytest.param('old', marks=pytest.mark.qualify), 'new'])
def bag(request, tmp_path):
    """Two seconds of an arm and its commands, as older bags hold them and as bags do now."""
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    commands = COMMANDS if request.param == 'old' else '/remaster/recorded/joint_trajectory'
    trajectory = JointTrajectory(joint_names=NAMES)
    trajectory.points = [JointTrajectoryPoint(positions=[0.5] * 7)]
    with BagWriter(tmp_path / 'bag') as writer:
        for number in range(40):
            stamp_ns = 10**18 + number * 5 * 10**7
            state = JointState(name=NAMES, position=[0.1] * 7)
            state.header.stamp.sec = number + 1
            data = serialize_message(state)
            writer.write('/joint_states', STATE, data, stamp_ns)
            data = serialize_message(trajectory)
            writer.write(commands, TRAJECTORY, data, stamp_ns)
    return tmp_path / 'bag'


@pytest.fixture
def old_bag(bag, request):
    if request.node.callspec.params['bag'] != 'old':
        pytest.skip('one of the two is enough')
    return bag


def until(client, condition, timeout_s, what):
    def turn():
        for _ in range(5):
            client.spin_some()
        return condition()

    wait_until(turn, timeout_s, what)


def refusal(process):
    out, err = process.communicate(timeout=900)
    assert process.returncode == 2, out + err
    (line,) = (line for line in err.splitlines() if line.startswith('error:'))
    assert 'Traceback' not in err
    return line


def spun(client, process):
    until(client, lambda: process.poll() is not None, 60, 'the replay to end')
    return process


def test_commands_are_left_out(start, client, bag):
    from sensor_msgs.msg import JointState

    heard = []
    client.create_subscription(JointState, '/joint_states', heard.append, 100)
    process = start('remaster_ros.cli.main', 'replay', bag, '--wait-for', '/joint_states')
    until(client, lambda: heard, 60, 'the joint states')
    assert not client.get_publishers_info_by_topic(COMMANDS)
    until(client, lambda: process.poll() is not None, 60, 'the end')
    assert process.returncode == 0, process.communicate()
    assert len(heard) == 40


@pytest.mark.parametrize('more', [(), ('--with-commands',)])
def test_a_controller_that_subscribes_receives_no_command(start, client, bag, more):
    from trajectory_msgs.msg import JointTrajectory

    heard = []
    client.create_subscription(JointTrajectory, COMMANDS, heard.append, 100)
    process = start('remaster_ros.cli.main', 'replay', bag, *more)
    line = refusal(spun(client, process))
    # On a busy machine the endpoint may be known before the name of its node.
    who = ('/test_client', 'a node that has just started')
    assert any(f'this graph is live: {node} listens to {COMMANDS}' in line for node in who)
    assert not heard


@pytest.mark.qualify
def test_a_controller_that_subscribes_later_receives_no_command(start, client, old_bag):
    """Not one message reaches it: who is matched is looked at before each command."""
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    heard, commands = [], []
    client.create_subscription(JointState, '/joint_states', heard.append, 100)
    process = start('remaster_ros.cli.main', 'replay', old_bag, '--rate', '0.1', '--with-commands')
    until(client, lambda: heard, 60, 'the joint states')
    client.create_subscription(JointTrajectory, COMMANDS, commands.append, 100)
    assert f'/test_client listens to {COMMANDS}' in refusal(spun(client, process))
    assert not commands


def test_a_robot_is_refused(start, client, old_bag):
    from sensor_msgs.msg import JointState

    client.create_publisher(JointState, '/joint_states', 10)
    process = start('remaster_ros.cli.main', 'replay', old_bag)
    line = refusal(spun(client, process))
    # A publisher may be discovered before the name of its node.
    named = '(/test_client|a node that has just started)'
    assert re.search(f'this graph is live: {named} publishes /joint_states', line)


@pytest.mark.qualify
def test_a_robot_that_comes_later_ends_it(start, client, old_bag):
    from sensor_msgs.msg import JointState

    heard = []
    client.create_subscription(JointState, '/joint_states', heard.append, 100)
    process = start('remaster_ros.cli.main', 'replay', old_bag, '--rate', '0.1')
    until(client, lambda: heard, 60, 'the joint states')
    client.create_publisher(JointState, '/joint_states', 10)
    line = refusal(spun(client, process))
    assert re.search('(/test_client|a node that has just started) publishes /joint_states', line)


def test_a_bridge_is_refused(start, client, old_bag):
    start(
        'remaster_ros.nodes.robot_bridge',
        *node_arguments(cell='demo', emergency_stop_topic='none'),
    )
    until(client, lambda: client.get_publishers_info_by_topic('/remaster/settled'), 60, 'it')
    line = refusal(spun(client, start('remaster_ros.cli.main', 'replay', old_bag)))
    assert '/robot_bridge' in line


def test_a_recorder_only_listens_and_writes_commands_under_another_name(
    start, client, bag, tmp_path
):
    session = tmp_path / 'again'
    recorder = start(
        'remaster_ros.nodes.recorder', *node_arguments(session=session, call_measure=False)
    )
    until(client, lambda: client.get_subscriptions_info_by_topic(COMMANDS), 60, 'the recorder')
    process = start(
        'remaster_ros.cli.main', 'replay', bag, '--with-commands', '--wait-for', '/joint_states'
    )
    assert spun(client, process).returncode == 0, process.communicate()
    recorder.terminate()
    assert recorder.wait(900) == 0
    counts = BagReader(session / 'bag').counts
    assert counts['/remaster/recorded/joint_trajectory'] == counts['/joint_states'] == 40
    assert COMMANDS not in counts


@pytest.mark.qualify
def test_another_namespace_is_another_graph(start, client, old_bag):
    """A robot in /left neither prevents a replay in /right nor receives its messages."""
    from sensor_msgs.msg import JointState

    heard = {'left': [], 'right': []}
    client.create_publisher(JointState, '/left/joint_states', 10)
    for name, messages in heard.items():
        client.create_subscription(JointState, f'/{name}/joint_states', messages.append, 100)
    arguments = node_arguments(bag=old_bag, wait_for='/joint_states')
    process = start('remaster_ros.nodes.replay', *arguments, '-r', '__ns:=/right')
    until(client, lambda: process.poll() is not None, 60, 'the end')
    assert process.returncode == 0, process.communicate()
    assert (len(heard['left']), len(heard['right'])) == (0, 40)


def test_a_torn_end_is_told_and_ends_with_1(start, client, bag):
    from sensor_msgs.msg import JointState

    heard = []
    client.create_subscription(JointState, '/joint_states', heard.append, 100)
    (file,) = bag.glob('*.mcap')
    (bag / 'SHA256SUMS').unlink(missing_ok=True)
    count = BagReader(bag).counts['/joint_states']
    data = file.read_bytes()
    # In the middle of a message, as a killed writer leaves it.
    file.write_bytes(data[: data.rindex(b'joint_7') - 10])
    process = start('remaster_ros.cli.main', 'replay', bag, '--wait-for', '/joint_states')
    out, err = spun(client, process).communicate()
    assert process.returncode == 1, out + err
    (line,) = (line for line in err.splitlines() if line.startswith('error:'))
    assert 'bytes of the bag are no whole message' in line
    assert 0 < len(heard) < count + 1


def test_messages_that_a_subscriber_does_not_take_are_told(monkeypatch, bag):
    """A publisher that is never acknowledged stands for a subscriber that hangs."""
    import rclpy

    from remaster_ros.errors import InsufficientDataError
    from remaster_ros.nodes import replay

    monkeypatch.setattr(replay, 'DISCOVERY_S', 0.1)
    monkeypatch.setattr(replay, 'DEPTH', 20)
    monkeypatch.setattr(replay.Publisher, 'wait_for_all_acked', lambda self, timeout: False)
    rclpy.init(args=['--ros-args', '-p', f'bag:={bag}', '-p', 'rate:=100.0'])
    try:
        node = replay.Replay()
        wait_until(lambda: node.failure or node.finished, 30, 'the end')
        assert isinstance(node.failure, InsufficientDataError)
        assert 'up to 40 messages of /joint_states did not reach a subscriber' in str(node.failure)
        node.close()
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


@pytest.fixture(params=[0, pytest.param(4, marks=pytest.mark.qualify)])
def busy(request):
    """Run beside it what takes all processors: so many for each."""
    loop = [sys.executable, '-c', 'while True: pass']
    processes = [subprocess.Popen(loop) for _ in range(request.param * (os.cpu_count() or 1))]
    yield
    for process in processes:
        process.kill()
        process.wait()


def test_a_replay_waits_for_a_busy_recorder_and_gives_every_row(start, client, tmp_path, busy):
    """A hundred times as fast as it was, and on a machine that is busy with other work."""
    arm = RecordedArm(tmp_path / 'session' / 'bag', 5)
    arm.began()
    arm.register()
    for _ in range(8):
        arm.visit()
    # A device that refuses: its end is in no message but the recorder's own event.
    arm.announce('optimization', [AT_REST])
    arm.stand(AT_REST, 0.8)
    arm.ended(0, 'partial', 'tracker: device: no reflector')
    arm.visit('validation')
    arm.planner('complete')
    arm.close()
    session, offline = tmp_path / 'again', tmp_path / 'offline'
    done = record_from_bag(BagReader(tmp_path / 'session' / 'bag'), offline)
    assert done.observations == 2 * 18 + 1
    recorder = start(
        'remaster_ros.nodes.recorder', *node_arguments(session=session, call_measure=False)
    )
    settled = '/remaster/settled'
    until(client, lambda: client.get_subscriptions_info_by_topic(settled), 90, 'the recorder')
    process = start(
        'remaster_ros.cli.main', 'replay', tmp_path / 'session', '--rate', '100', '--wait-for',
        settled,
    )  # fmt: skip
    until(client, lambda: process.poll() is not None, 150, 'the replay to end')
    assert process.returncode == 0, process.communicate()
    recorder.terminate()
    assert recorder.wait(60) == 0
    assert not differences(offline, session)
