# SPDX-License-Identifier: Apache-2.0
"""A sensor's node reports a simulated clock that is not published yet, and stamps nothing.

A node that is started again in a running simulation receives the clock late; what it measured
until then would be stamped with the beginning of time.
"""

import signal
import socket

import pytest
import yaml
from rigs.ros_rig import call, node_arguments, wait_until

from remaster_ros.demo.processes import free_ports
from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.setup import make_world

pytestmark = [pytest.mark.ros, pytest.mark.timeout(900)]

TIME_S = 5000


@pytest.fixture
def said(client):
    """Return the last summary of each node: its message and values."""
    from remaster_ros.nodes.status import listen

    summaries = {}
    listen(
        client,
        lambda event: None,
        lambda node, message, values: summaries.update({node: (message, values)}),
    )
    return summaries


@pytest.fixture
def world(tmp_path):
    make_world(tmp_path / 'world', read_cell('demo'), 3, 1.0)
    return tmp_path / 'world'


def tick(client, publisher, seconds):
    from rosgraph_msgs.msg import Clock

    message = Clock()
    message.clock.sec = TIME_S + int(seconds)
    message.clock.nanosec = int(1e9 * (seconds % 1.0))
    publisher.publish(message)
    client.spin_some()


def until_it_says(client, said, node, ready, words, turn=lambda: None):
    def heard():
        turn()
        client.spin_some()
        message, values = said.get(node, ('', {}))
        return values.get('ready') == ready and words in message

    wait_until(heard, 60, f'{node} to say {words!r}')


def follow_the_clock(client, said, node):
    """Check what a node reports before there is a clock, and when there is one."""
    from rosgraph_msgs.msg import Clock

    until_it_says(client, said, node, 'no', 'which node publishes /clock?')
    clock, ticks = client.create_publisher(Clock, '/clock', 10), iter(range(10**6))

    def turn():
        tick(client, clock, 0.02 * next(ticks))

    until_it_says(client, said, node, 'yes', '', turn)
    return turn


@pytest.mark.qualify
def test_the_laser_tracker_measures_nothing_without_it(start, client, said, world):
    (port,) = free_ports(socket.SOCK_STREAM)
    start(
        'remaster_ros.nodes.fake_laser_tracker',
        *node_arguments(world=world, port=port, warm_up_s=0.0),
    )
    node = 'laser_tracker_markers'
    start(
        f'remaster_ros.nodes.{node}',
        *node_arguments(use_sim_time=True, host='127.0.0.1', port=port),
    )
    until_it_says(client, said, node, 'no', '')
    response = call(client, '/laser_tracker/measure')
    assert not response.success
    assert 'which node publishes /clock?' in response.message
    follow_the_clock(client, said, node)


def test_the_bar_publishes_nothing_without_it(start, client, said, world):
    from geometry_msgs.msg import PointStamped

    stamps = []
    client.create_subscription(
        PointStamped,
        '/optitrack/marker',
        lambda message: stamps.append(message.header.stamp.sec),
        10,
    )
    command, data = free_ports(socket.SOCK_DGRAM, socket.SOCK_DGRAM)
    ports = {'command_port': command, 'data_port': data}
    start('remaster_ros.nodes.fake_optitrack', *node_arguments(world=world, **ports))
    node = 'optitrack_markers'
    address = {'server': '127.0.0.1', 'local_interface': '127.0.0.1'}
    start(f'remaster_ros.nodes.{node}', *node_arguments(use_sim_time=True, **address, **ports))
    turn = follow_the_clock(client, said, node)
    wait_until(lambda: turn() or stamps, 30, 'a reading')
    assert min(stamps) >= TIME_S - 1


def test_a_bag_begins_with_the_clock_and_keeps_what_came_before(start, client, said, tmp_path):
    """At time 0 it would last as long as the simulation has been running."""
    from geometry_msgs.msg import PoseStamped
    from rosgraph_msgs.msg import Clock

    from remaster_ros.nodes.status import RELIABLE

    session = tmp_path / 'session'
    node = start(
        'remaster_ros.nodes.recorder',
        *node_arguments(use_sim_time=True, cell='demo', session=session, call_measure=False),
    )
    until_it_says(client, said, 'recorder', None, '')
    # A topic that the recorder takes reliably: of joint states the first may be lost.
    poses = client.create_publisher(PoseStamped, '/remaster/target_pose', RELIABLE)
    wait_until(lambda: client.spin_some() or poses.get_subscription_count(), 20, 'the recorder')
    for _ in range(5):
        poses.publish(PoseStamped())
    for _ in range(20):
        client.spin_some()
    clock = client.create_publisher(Clock, '/clock', 10)
    wait_until(lambda: client.spin_some() or clock.get_subscription_count(), 20, 'the recorder')
    for i in range(150):
        tick(client, clock, 0.02 * i)
    node.send_signal(signal.SIGINT)
    assert node.wait(900) == 0
    reader = BagReader(session / 'bag')
    assert reader.whole.first_ns >= TIME_S * 10**9
    assert reader.whole.last_ns - reader.whole.first_ns < 20 * 10**9
    messages = list(reader)
    # The first says that the recorder began, which a replay must know first.
    assert messages[0][0] == '/remaster/events'
    assert b'"kind":"began"' in messages[0][2]
    assert sum(topic == '/remaster/target_pose' for topic, *_ in messages) == 5
    text = (session / 'bag' / 'metadata.yaml').read_text(encoding='utf-8')
    information = yaml.safe_load(text)['rosbag2_bagfile_information']
    assert information['starting_time']['nanoseconds_since_epoch'] == reader.whole.first_ns
    assert information['duration']['nanoseconds'] < 20 * 10**9
