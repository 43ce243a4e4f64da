# SPDX-License-Identifier: Apache-2.0
"""What comes fast does not wait behind what comes seldom."""

import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from geometry_msgs.msg import PointStamped
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState

from remaster_ros.nodes.bagging import DEEP, BagRecorder

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]
MANY = 60


def test_all_messages_of_a_topic_that_wait_are_taken_in_its_turn(own_nodes, tmp_path):
    node = own_nodes.make('taker', is_spun=False)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    points, states = [], []
    bag = BagRecorder(node, tmp_path / 'bag', None)
    bag.subscribe(PointStamped, 'taker/fast', lambda m: points.append(m.point.x))
    bag.subscribe(JointState, 'taker/slow', states.append)
    fast = node.create_publisher(PointStamped, 'taker/fast', DEEP)
    slow = node.create_publisher(JointState, 'taker/slow', DEEP)
    until = time.monotonic() + 30.0
    while not (fast.get_subscription_count() and slow.get_subscription_count()):
        assert time.monotonic() < until
        time.sleep(0.01)
    for number in range(MANY):
        message = PointStamped()
        message.point.x = float(number)
        fast.publish(message)
    slow.publish(JointState())
    time.sleep(1.0)
    turns = 0
    while not (states and len(points) == MANY):
        executor.spin_once(timeout_sec=1.0)
        turns += 1
        assert time.monotonic() < until
    assert turns < MANY / 2
    assert points == [float(number) for number in range(MANY)]
    assert bag.taken == {'/taker/fast': MANY, '/taker/slow': 1}
