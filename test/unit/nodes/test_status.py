# SPDX-License-Identifier: Apache-2.0
"""What a node publishes of itself: a record for the nodes, the same as text for people."""

import time
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from std_msgs.msg import String

from remaster_ros.collection.events import (
    BridgeState,
    Decided,
    EventRecord,
    HaltCleared,
    RecorderState,
    SensorReport,
    encode,
)
from remaster_ros.nodes import status
from remaster_ros.nodes.qos import node_of
from remaster_ros.nodes.status import EVENTS, RELIABLE, NodeStatus, Summary, listen, pairs

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]
HALT = 'the robot does not follow'


class Bench:
    """A node in a namespace that publishes its status, and what comes of it."""

    def __init__(self, own_nodes):
        self.node, self.wait = own_nodes.make('robot_bridge', 'left'), own_nodes.until
        self.summary = Summary('error', HALT, {'commanded': 3}, BridgeState(halted=HALT))
        self.status = NodeStatus(self.node, lambda: self.summary, 'lwr4plus')
        self.records, self.summaries, self.diagnostics = [], [], []
        listen(self.node, self.records.append, lambda *seen: self.summaries.append(seen))
        self.node.create_subscription(
            DiagnosticArray, '/left/diagnostics', self._on_diagnostics, RELIABLE
        )

    def _on_diagnostics(self, array):
        self.diagnostics.append((time.monotonic(), array))


@pytest.fixture
def bench(own_nodes):
    return Bench(own_nodes)


def test_the_state_is_a_record_and_text(bench):
    bench.wait(lambda: len(bench.records) > 1 and bench.summaries)
    record = bench.records[0]
    assert (record.node, record.body) == ('/left/robot_bridge', BridgeState(halted=HALT))
    assert bench.records[1].started == record.started
    assert bench.records[1].uptime_s > record.uptime_s
    assert record.stamp_ns > 0
    name, message, values = bench.summaries[0]
    assert (name, message) == ('robot_bridge', HALT)
    assert (values['halted'], values['commanded'], values['started']) == (
        HALT,
        '3',
        record.started,
    )
    assert values['node'] == '/left/robot_bridge'


def test_diagnostics_come_once_a_second_with_name_level_and_hardware(bench):
    bench.wait(lambda: len(bench.diagnostics) > 2)
    _, arrays = zip(*bench.diagnostics)
    stamps = [array.header.stamp.sec + 1e-9 * array.header.stamp.nanosec for array in arrays]
    # No oftener; later only where the machine is busy.
    assert (stamps[-1] - stamps[0]) / (len(stamps) - 1) > 0.9
    (found,) = arrays[-1].status
    assert (found.name, found.hardware_id) == ('left/robot_bridge: state', 'lwr4plus')
    assert (found.level, found.message) == (DiagnosticStatus.ERROR, HALT)
    assert {pair.key: pair.value for pair in found.values}['commanded'] == '3'
    assert arrays[-1].header.stamp.sec > 0


def test_an_event_follows_the_state_that_was_published_before_it(bench):
    bench.wait(lambda: bench.records)
    bench.records.clear()
    bench.summary = Summary('ok', 'waiting for a pose', {}, BridgeState(halted=''))
    bench.status.publish()
    bench.status.event(HaltCleared(stamp='7.0'))
    bench.wait(lambda: any(isinstance(r.body, HaltCleared) for r in bench.records))
    bodies = [record.body for record in bench.records]
    assert bodies.index(BridgeState(halted='')) < bodies.index(HaltCleared(stamp='7.0'))


def test_what_cannot_be_decoded_is_left_out_and_logged_once_for_each_reason(bench, monkeypatch):
    logged, found = [], []
    logger = bench.node.get_logger()
    monkeypatch.setattr(type(logger), 'error', lambda self, text: logged.append(text))
    receive = status.receiver(bench.node, found.append)
    good = EventRecord(node='/robot_bridge', body=HaltCleared(stamp='7.0'))
    future = encode(good).replace('"version":1', '"version":2')
    for text in (future, 'garbage', future, encode(good), future):
        receive(String(data=text))
    assert found == [good]
    assert len(logged) == 2
    assert logged[0].startswith(f'{EVENTS}: a record of version 2, and this program reads ')
    for number in range(500):
        receive(String(data=f'garbage {number}'))
    assert len(logged) == 100, 'a stranger does not fill the memory'


def test_another_start_of_this_name_is_a_rival_only_where_another_node_publishes(bench):
    bench.wait(lambda: bench.status.alone_since is not None)
    other = EventRecord(
        node='/left/robot_bridge', body=BridgeState(halted=''), started='1', uptime_s=5e3
    )
    for _ in range(3):
        bench.status._on_record(other)
    assert not hasattr(bench.node, 'failure')
    bench.status._namesakes = lambda: 2
    for uptime_s in (5e3, 5001.0):
        bench.status._on_record(
            EventRecord(node=other.node, body=other.body, started='1', uptime_s=uptime_s)
        )
    assert 'is running already in this ROS domain, for 5001 s' in str(bench.node.failure)


@pytest.mark.parametrize(
    ('state', 'shown'),
    [
        (
            SensorReport(sensor='mocap', ready=True),
            {'sensor': 'mocap', 'ready': 'yes', 'trouble': '', 'message': '', 'hidden': 'no'},
        ),
        (
            BridgeState(halted='', joints_age_s=0.25),
            {
                'halted': '',
                'pose': '',
                'run': '',
                'asks_for_collect': '',
                'joints_age_s': '0.2',
                'joints_trouble': '',
                'correction': '',
            },
        ),
    ],
)
def test_a_state_as_text(state, shown):
    assert pairs(state) == shown


def test_tables_have_a_pair_for_each_entry():
    state = RecorderState(
        waiting_for='', decided=Decided(3, (1,)), read_age_s={'mocap': 0.04, 'tracker': None}
    )
    shown = pairs(state)
    assert (shown['read_age_s_mocap'], shown['read_age_s_tracker']) == ('0.0', 'none')
    assert (shown['changed_run'], shown['observations']) == ('none', '0')
    assert 'decided' not in shown


@pytest.mark.parametrize(
    ('namespace', 'name', 'called'),
    [
        ('/', 'recorder', '/recorder'),
        ('/cell', 'recorder', '/cell/recorder'),
        ('_NODE_NAMESPACE_UNKNOWN_', '_NODE_NAME_UNKNOWN_', 'a node that has just started'),
    ],
)
def test_a_node_is_called_by_its_full_name(namespace, name, called):
    assert node_of(SimpleNamespace(node_namespace=namespace, node_name=name)) == called
