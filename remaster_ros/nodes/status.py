# SPDX-License-Identifier: Apache-2.0
"""How a node reports: records to the other nodes, and its state to people.

`remaster/events` carries the records of `remaster_ros.collection.events`, on which the nodes act.
`remaster/status` and `diagnostics` show people the same states, with counts and reasons; no node
reads them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgspec
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from remaster_ros.collection.events import (
    STATES,
    Alive,
    ArmModel,
    Event,
    EventRecord,
    State,
    decode,
    encode,
)
from remaster_ros.errors import InputError
from remaster_ros.motion.rivalry import DuplicateNodeCheck
from remaster_ros.nodes.qos import mismatches
from remaster_ros.session.bags.bag_metadata import LATCHED_DEPTH

TOPIC = 'remaster/status'
EVENTS = 'remaster/events'
DIAGNOSTICS = 'diagnostics'
PRECISION_TOPIC = 'remaster/precision'
MESSAGES_TAKEN = 'remaster/taken'
"""Relative like every name: a cell in a namespace has its own, for an aggregator of its own."""
RELIABLE = QoSProfile(depth=200, reliability=ReliabilityPolicy.RELIABLE)
JOINT_STATES = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Of subscribers of joint_states: it matches reliable and best-effort publishers alike, and keeps
what a busy node has not yet taken, seconds of the fastest stream."""
LATCHED = QoSProfile(
    depth=LATCHED_DEPTH,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
LEASED = QoSProfile(
    depth=200,
    reliability=ReliabilityPolicy.RELIABLE,
    liveliness=LivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=2.0),
)
"""Of publishers whose commands move the arm: a killed one stays in the graph for some 20 s, but is
no longer alive for its subscribers 2 s after its end."""
STATE_EVERY_S = 0.5
"""How often the state is published without a change, wall time: a node that starts late has it
then, and a node that is silent for longer than its heartbeat is missed."""
DIAGNOSTICS_EVERY_S = 1.0
QOS_EVERY_S = 3.0
"""How often the graph is looked at for endpoints that do not match, wall time."""
LEVELS = {
    'ok': DiagnosticStatus.OK,
    'warn': DiagnosticStatus.WARN,
    'error': DiagnosticStatus.ERROR,
}


class Summary(NamedTuple):
    """Present status of a node: level, message, values for people, and state for other nodes."""

    level: str  # ``ok``, ``warn`` or ``error``
    message: str  # For people
    values: Mapping[str, Any]  # Counts and settings, for people
    state: State = Alive()  # For the other nodes; people are shown its fields too


class NodeStatus:
    """Publishes a node's state and events; ends the node if a namesake runs for longer.

    ``hardware_id``: in /diagnostics: the device that the node is for; ``model``: which arm the
    node computes with; every record carries it.
    """

    def __init__(
        self,
        node: Node,
        summary: Callable[[], Summary],
        hardware_id: str = 'none',
        model: ArmModel | None = None,
    ) -> None:
        self._node, self._summary, self._hardware_id = node, summary, hardware_id
        self._model = model
        # Distinguishes a node that was started again from the one before it.
        self._started, self._started_wall = str(time.time_ns()), time.monotonic()
        self._duplicates = DuplicateNodeCheck(self._started)
        self._events = node.create_publisher(String, EVENTS, RELIABLE)
        self._publisher = node.create_publisher(DiagnosticArray, TOPIC, RELIABLE)
        self._diagnostics = node.create_publisher(DiagnosticArray, DIAGNOSTICS, RELIABLE)
        # Where the executor has threads, heartbeats go on while a callback plans or writes.
        group = MutuallyExclusiveCallbackGroup()
        # What is published last must have been true last.
        self._order = threading.Lock()
        # A wall timer: status must go on when the simulated clock stands still.
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._qos_trouble = ''
        for period_s, callback in (
            (STATE_EVERY_S, self.publish),
            (DIAGNOSTICS_EVERY_S, self._publish_diagnostics),
            (QOS_EVERY_S, self._look_at_qos),
        ):
            node.create_timer(period_s, callback, callback_group=group, clock=self.steady)
        receive = receiver(node, self._on_record)
        node.create_subscription(String, EVENTS, receive, RELIABLE, callback_group=group)

    @property
    def started(self) -> str:
        """Identifier of this start of the node, as in its records."""
        return self._started

    @property
    def alone_since(self) -> float | None:
        """Time since which no other node of this name was heard, `time.monotonic`, s.

        None before this node has received its own first state.
        """
        return self._duplicates.alone_since_s

    def alone(self, now: float) -> bool:
        """Whether this node has listened for 1.5 s and found no other of its name.

        ``now``: `time.monotonic`, s.
        """
        return self._duplicates.alone(now)

    def _look_at_qos(self) -> None:
        """Keep which topics lose messages by QoS (`mismatches`)."""
        self._qos_trouble = mismatches(self._node)

    def _on_record(self, record: EventRecord) -> None:
        """Set the node's failure if another process with its name has run for longer.

        Only states of the same full name count, and only while the graph has two publishers of
        that name.
        """
        name = self._node.get_fully_qualified_name()
        if record.node != name or not record.started or not isinstance(record.body, STATES):
            return
        now = time.monotonic()
        if record.started == self._started:
            self._duplicates.update_own(now)
            return
        # A replay publishes the records of a node of this name, and is another node.
        if self._namesakes() < 2:
            return
        uptime_s = record.uptime_s
        if self._duplicates.update_other(record.started, uptime_s, now - self._started_wall, now):
            self._node.failure = InputError(  # type: ignore[attr-defined]
                f'{name} is running already in this ROS domain, for {uptime_s:.0f} s, on another '
                'computer or for another user; end that one, or give this one a namespace '
                '(__ns:=/…) or a domain (ROS_DOMAIN_ID) of its own'
            )

    def _namesakes(self) -> int:
        """Return the number of publishers of records by nodes of this name, itself included."""
        own_node = self._node.get_name(), self._node.get_namespace()
        found = self._node.get_publishers_info_by_topic(self._events.topic_name)
        return sum((info.node_name, info.node_namespace) == own_node for info in found)

    def publish(self) -> None:
        """Publish the state now, on remaster/events and remaster/status; from any thread."""
        with self._order:
            summary = self._summary()
            self._publish_record(summary.state)
            self._publish_status(self._publisher, summary)

    def event(self, event: Event) -> None:
        """Publish an event now, on remaster/events."""
        self._publish_record(event)

    def _publish_record(self, body: State | Event) -> None:
        """Publish a state or an event as a record of this node, with stamp and uptime."""
        record = EventRecord(
            node=self._node.get_fully_qualified_name(),
            body=body,
            started=self._started,
            uptime_s=time.monotonic() - self._started_wall,
            stamp_ns=self._node.get_clock().now().nanoseconds,
            model=self._model,
        )
        self._events.publish(String(data=encode(record)))

    def _publish_diagnostics(self) -> None:
        """Publish the summary on /diagnostics."""
        with self._order:
            self._publish_status(self._diagnostics, self._summary())

    def _publish_status(self, publisher: Any, summary: Summary) -> None:
        """Publish a summary as diagnostics; 'ok' becomes 'warn' if there is QoS trouble.

        ``publisher``: of remaster/status or of diagnostics, which name status and hardware
        differently.
        """
        level, message = summary.level, summary.message
        if self._qos_trouble and level == 'ok':
            level, message = 'warn', self._qos_trouble
        full_name = self._node.get_fully_qualified_name()
        values = {
            **pairs(summary.state),
            **summary.values,
            'qos_trouble': self._qos_trouble,
            'node': full_name,
            'started': self._started,
            'uptime_s': f'{time.monotonic() - self._started_wall:.3f}',
        }
        name, hardware_id = self._node.get_name(), 'remaster_ros'
        if publisher is self._diagnostics:
            name, hardware_id = f'{full_name.lstrip("/")}: state', self._hardware_id
        status = DiagnosticStatus(
            name=name,
            level=LEVELS[level],
            message=message,
            hardware_id=hardware_id,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        publisher.publish(array)


def pairs(state: State) -> dict[str, str]:
    """Return the fields of a state as text for people, name -> text.

    A dictionary becomes an entry ``NAME_KEY`` for each of its keys; nested structures are left
    out.
    """
    found = {}
    for name, value in msgspec.structs.asdict(state).items():
        if isinstance(value, dict):
            found.update({f'{name}_{key}': _text(entry) for key, entry in value.items()})
        elif not isinstance(value, msgspec.Struct):
            found[name] = _text(value)
    return found


def _text(value: Any) -> str:
    """Value as text: yes or no, a float with one decimal, 'none' for None."""
    if isinstance(value, bool):
        return 'yes' if value else 'no'
    return f'{value:.1f}' if isinstance(value, float) else 'none' if value is None else str(value)


def taken_key(record: EventRecord) -> str:
    """Return the key by which a recorder counts the records of a node's start: 'NODE STARTED'."""
    return f'{record.node} {record.started}'


def receiver(node: Node, on_record: Callable[[EventRecord], None]) -> Callable[[String], None]:
    """Return a callback that decodes a message and calls `on_record`.

    What cannot be decoded is left out, with an error in the node's log, once for each reason.
    """
    reasons: set[str] = set()

    def receive(message: String) -> None:
        try:
            record = decode(message.data)
        except InputError as error:
            # A stranger that invents reasons must not fill the memory.
            if str(error) not in reasons and len(reasons) < 100:
                reasons.add(str(error))
                node.get_logger().error(f'{EVENTS}: {error}')
            return
        on_record(record)

    return receive


def listen(
    node: Node,
    on_record: Callable[[EventRecord], None] | None = None,
    on_summary: Callable[[str, str, dict[str, str]], None] | None = None,
) -> None:
    """Subscribe to the records of all nodes, to their diagnostics, or to both.

    ``on_record``: called with every valid record, see `receiver`; ``on_summary``: called with
    (node, message, values) of every status; for programs that show them.
    """
    if on_record is not None:
        node.create_subscription(String, EVENTS, receiver(node, on_record), RELIABLE)
    if on_summary is not None:
        receive = summary_receiver(on_summary)
        node.create_subscription(DiagnosticArray, TOPIC, receive, RELIABLE)


def summary_receiver(
    on_summary: Callable[[str, str, dict[str, str]], None],
) -> Callable[[DiagnosticArray], None]:
    """Return a callback that calls `on_summary` with (node, message, values) of every status."""

    def receive(array: DiagnosticArray) -> None:
        for status in array.status:
            values = {pair.key: pair.value for pair in status.values}
            on_summary(status.name, status.message, values)

    return receive
