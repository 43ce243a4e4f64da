# SPDX-License-Identifier: Apache-2.0
"""The link to the robot's safety circuit: when its state is known, and when it is missed."""

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool

from remaster_ros.nodes import emergency_link
from remaster_ros.nodes.emergency_link import EmergencyLink

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]

TOPIC = 'robot/emergency_stop'
SILENT = f'/{TOPIC} (emergency_stop_topic) is silent: nothing moves without it'
LATCHED = QoSProfile(
    depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE
)
VOLATILE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


class Bench:
    """A listener and a robot, on a clock of the test."""

    def __init__(self, monkeypatch, own_nodes):
        self.now, self.states = 500.0, []
        monkeypatch.setattr(emergency_link, 'time', SimpleNamespace(monotonic=lambda: self.now))
        self.node = own_nodes.make('listener')
        self.robot = own_nodes.make('robot', is_spun=False, beside=self.node)
        self.spin = own_nodes.until

    def link(self, topic=TOPIC, silence_s=3.0):
        made = EmergencyLink(self.node, topic, self.states.append, silence_s)
        self.made = made
        return made

    def publisher(self, qos=LATCHED):
        return self.robot.create_publisher(Bool, TOPIC, qos)

    def say(self, publisher, state, times):
        """Publish, and let the link hear it `times` times (once a subscription that matches)."""
        count = len(self.states)
        publisher.publish(Bool(data=state))
        self.spin(lambda: len(self.states) >= count + times)
        assert self.states[count:] == [state] * times


@pytest.fixture
def bench(monkeypatch, own_nodes):
    return Bench(monkeypatch, own_nodes)


def matched(bench, publisher, count):
    bench.spin(lambda: publisher.get_subscription_count() == count)


def test_without_a_topic_nothing_is_missed(bench):
    link = bench.link('')
    assert link.topic == ''
    assert link.trouble() == ''
    assert not list(bench.node.subscriptions)


def test_a_link_that_never_said_anything_is_silent(bench):
    link = bench.link()
    assert link.topic == f'/{TOPIC}'
    publisher = bench.publisher()
    matched(bench, publisher, 2)
    bench.now += 1e6
    assert link.trouble() == SILENT


@pytest.mark.parametrize('state', [False, True])
def test_the_last_state_of_a_publisher_that_keeps_it_is_enough(bench, state):
    publisher = bench.publisher()
    publisher.publish(Bool(data=state))
    link = bench.link()
    bench.spin(lambda: bench.states)
    assert set(bench.states) == {state}
    bench.now += 1e6
    assert link.trouble() == ''


@pytest.mark.parametrize(('qos', 'times'), [(LATCHED, 2), (VOLATILE, 1), (BEST_EFFORT, 1)])
def test_publishers_of_every_kind_are_heard(bench, qos, times):
    publisher = bench.publisher(qos)
    bench.link()
    matched(bench, publisher, times)
    bench.say(publisher, True, times)
    bench.say(publisher, False, times)


def test_a_publisher_that_is_gone_is_missed(bench):
    publisher = bench.publisher()
    link = bench.link()
    matched(bench, publisher, 2)
    bench.say(publisher, False, 2)
    assert link.trouble() == ''
    bench.robot.destroy_publisher(publisher)
    bench.spin(lambda: not bench.node.count_publishers(TOPIC))
    assert link.trouble() == f'/{TOPIC} (emergency_stop_topic) has no publisher any more'


def tick(bench, publisher, gaps):
    for gap in gaps:
        bench.now += gap
        bench.say(publisher, False, 1)


def test_regular_messages_that_end_are_missed(bench):
    publisher = bench.publisher(VOLATILE)
    link = bench.link(silence_s=3.0)
    matched(bench, publisher, 1)
    tick(bench, publisher, [0.0, 0.5, 0.5, 0.75, 0.5])
    bench.now += 1e6
    assert link.trouble() == '', 'five messages may be five presses of a button'
    bench.now -= 1e6
    tick(bench, publisher, [0.5])
    bench.now += 3.75
    assert link.trouble() == '', 'so much longer than the longest time between two: not yet'
    bench.now += 0.01
    assert link.trouble() == f'/{TOPIC} (emergency_stop_topic) has been silent for 3.8 s'
    tick(bench, publisher, [0.0])
    assert link.trouble() == ''


@pytest.mark.parametrize(('longest', 'missed'), [(3.0, True), (3.01, False)])
def test_messages_that_never_came_regularly_are_not_missed(bench, longest, missed):
    publisher = bench.publisher(VOLATILE)
    link = bench.link(silence_s=3.0)
    matched(bench, publisher, 1)
    tick(bench, publisher, [0.0, 0.5, longest, 0.5, 0.5, 0.5])
    bench.now += 1000.0
    assert bool(link.trouble()) == missed
    # What was long ago no longer counts.
    bench.now -= 1000.0
    tick(bench, publisher, [0.5] * 3)
    bench.now += 1000.0
    assert link.trouble()


def test_no_message_is_lost_in_a_burst(bench):
    """A press and a release between two turns of the node are both heard, in their order."""
    publisher = bench.publisher(VOLATILE)
    bench.link()
    matched(bench, publisher, 1)
    burst = [True] + [False] * 5
    for state in burst:
        publisher.publish(Bool(data=state))
    bench.spin(lambda: len(bench.states) == len(burst))
    assert bench.states == burst
