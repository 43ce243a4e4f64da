# SPDX-License-Identifier: Apache-2.0
"""Who else publishes: told at once, or by their leases where a killed one may still be listed."""

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from rclpy.duration import Duration
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.qos import LivelinessPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool

from remaster_ros.nodes import rivals
from remaster_ros.nodes.rivals import OnlyPublisher
from remaster_ros.nodes.status import LEASED

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]

TOPIC = 'moves'
COUNT_WALL_S = 3.0
PLAIN = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
# For the graph as ours; but it lives only as long as it publishes, as a killed process does not.
MORTAL = QoSProfile(
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
    liveliness_lease_duration=Duration(seconds=0.2),
)


class Bench:
    """A node that depends on a topic and others that publish there, on a clock of the test."""

    def __init__(self, monkeypatch, own_nodes):
        self.now, self.nodes, self.spin = 500.0, own_nodes, own_nodes.until
        monkeypatch.setattr(rivals, 'time', SimpleNamespace(monotonic=lambda: self.now))
        self.node = own_nodes.make('bridge', '/left')
        self.only = OnlyPublisher(self.node, TOPIC, Bool)

    def other(self, name, qos=PLAIN, namespace='/left'):
        node = self.nodes.make(name, namespace, is_spun=False)
        count = self.node.count_publishers(f'/left/{TOPIC}')
        publisher = node.create_publisher(Bool, f'/left/{TOPIC}', qos)
        self.spin(lambda: self.node.count_publishers(f'/left/{TOPIC}') == count + 1)
        # The name of its node may come a little later.
        self.spin(
            lambda: all(
                'UNKNOWN' not in info.node_name
                for info in self.node.get_publishers_info_by_topic(f'/left/{TOPIC}')
            )
        )
        return publisher


@pytest.fixture
def bench(monkeypatch, own_nodes):
    return Bench(monkeypatch, own_nodes)


def words(*names):
    return (
        f'{len(names)} publishers on /left/moves, where one may be: {", ".join(names)}; '
        'end the others (those of a killed process are listed for some 20 s)'
    )


@pytest.mark.parametrize('qos', [PLAIN, LEASED])
def test_nobody_and_one_are_no_trouble(bench, qos):
    assert bench.only.trouble() == ''
    bench.other('planner', qos)
    bench.now += 100.0
    assert bench.only.trouble() == ''
    assert not list(bench.node.subscriptions)


def test_one_without_a_lease_beside_another_is_told_at_once(bench):
    bench.other('robot')
    bench.other('intruder', namespace='/')
    bench.other('driver', namespace='/stage_X')
    assert bench.only.trouble() == words('/intruder', '/left/robot', '/stage_X/driver')
    assert not list(bench.node.subscriptions), 'there is nothing to count'


def test_one_with_and_one_without_a_lease_are_told_at_once(bench):
    bench.other('planner', LEASED)
    bench.other('intruder')
    assert bench.only.trouble() == words('/left/intruder', '/left/planner')


def test_two_that_live_are_told_when_a_killed_one_would_be_dead(bench):
    bench.other('planner', LEASED)
    last = bench.other('second', LEASED)
    assert bench.only.trouble() == ''
    bench.spin(lambda: bench.only._alive == 2)
    bench.now += COUNT_WALL_S
    assert bench.only.trouble() == ''
    bench.now += 0.01
    assert bench.only.trouble() == words('/left/planner', '/left/second')
    # It goes: no trouble.
    last.destroy()
    bench.spin(lambda: bench.node.count_publishers('/left/moves') == 1)
    assert bench.only.trouble() == ''
    bench.spin(lambda: bench.only._alive == 1)
    # And another one comes: the time begins anew.
    bench.other('third', LEASED)
    assert bench.only.trouble() == ''
    bench.spin(lambda: bench.only._alive == 2)
    assert bench.only.trouble() == ''
    bench.now += COUNT_WALL_S + 0.01
    assert bench.only.trouble() == words('/left/planner', '/left/third')


@pytest.mark.parametrize('qos', [LEASED, MORTAL])
def test_the_nodes_own_publisher_counts_as_one(bench, qos):
    """The bridge publishes commands itself: one more that lives is one too many."""
    bench.node.create_publisher(Bool, TOPIC, LEASED)
    bench.node.create_publisher(Bool, 'another', LEASED)
    other = bench.other('second', qos)
    assert bench.only.trouble() == ''
    bench.spin(lambda: other.publish(Bool()) or bench.only._alive == 1)
    bench.now += COUNT_WALL_S + 0.01
    assert bench.only.trouble() == words('/left/bridge', '/left/second')
    if qos is MORTAL:
        bench.spin(lambda: bench.only._alive == 0)
        assert bench.only.trouble() == ''


def test_one_that_was_killed_does_not_count(bench):
    bench.other('planner', LEASED)
    dead = bench.other('killed', MORTAL)
    assert bench.only.trouble() == ''
    bench.spin(lambda: dead.publish(Bool()) or bench.only._alive == 2)
    bench.spin(lambda: bench.only._alive == 1)
    bench.now += 10.0
    assert bench.only.trouble() == ''
    assert bench.node.count_publishers('/left/moves') == 2
    # One more that lives does.
    bench.other('second', LEASED)
    bench.spin(lambda: bench.only._alive == 2)
    assert bench.only.trouble() == words('/left/killed', '/left/planner', '/left/second')


def test_one_that_was_dead_before_it_was_counted_does_not_count(bench):
    """A bridge that is started again soon after it was killed: only its own commands live."""
    bench.node.create_publisher(Bool, TOPIC, LEASED)
    bench.other('killed', MORTAL)
    assert bench.only.trouble() == ''
    bench.nodes.spin(0.5)
    bench.now += COUNT_WALL_S + 0.01
    assert bench.only.trouble() == ''
    assert bench.node.count_publishers('/left/moves') == 2


def test_one_that_goes_while_they_are_looked_up_is_no_trouble(bench, monkeypatch):
    bench.other('robot')
    monkeypatch.setattr(bench.node, 'count_publishers', lambda topic: 2)
    assert bench.only.trouble() == ''


def test_what_they_publish_is_taken_and_left(bench):
    """The subscription that counts takes the messages of both and does nothing with them."""
    first, _ = bench.other('planner', LEASED), bench.other('second', LEASED)
    bench.only.trouble()
    bench.spin(lambda: bench.only._alive == 2)
    first.publish(Bool(data=True))
    bench.nodes.spin(0.1)


def test_the_count_warns_of_nobody_that_it_cannot_hear(bench, capfd):
    """One without a lease is told by the bridge itself; its messages were never wanted."""
    set_logger_level('left.bridge', LoggingSeverity.INFO)
    bench.other('planner', LEASED)
    bench.other('second', LEASED)
    assert bench.only.trouble() == ''
    bench.spin(lambda: bench.only._alive == 2)
    bench.other('intruder')
    bench.nodes.spin(0.2)
    assert 'incompatible' not in capfd.readouterr().err


def test_a_lease_of_an_hour_is_none(bench):
    """A driver with so long a lease would count as alive for an hour after its end."""
    qos = QoSProfile(
        depth=1,
        liveliness=LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Duration(seconds=3600),
    )
    bench.other('first', qos)
    bench.other('second', qos)
    assert bench.only.trouble() == words('/left/first', '/left/second')
