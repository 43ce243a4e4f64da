"""remaster/status: every node's state, counts and reasons, and the events of a configuration.

A DiagnosticArray carries either a node's *summary* (name = the node; published twice a second and
at each change; what rqt_robot_monitor shows) or an *event* (name = ``node: event``), by which the
nodes keep step: the planner announces a pose, the bridge and the recorder say what became of each
of its joint solutions. Events are identified by the pose's stamp and the solution's number.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

from remaster_ros.errors import InputError
from remaster_ros.motion.rivalry import DuplicateNodeCheck
from remaster_ros.nodes.qos_mismatch import mismatches
from remaster_ros.session.bag_metadata import LATCHED_DEPTH

TOPIC = 'remaster/status'
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
QOS_EVERY_S = 3.0
"""How often the graph is looked at for endpoints that do not match, wall time."""
LEVELS = {
    'ok': DiagnosticStatus.OK,
    'warn': DiagnosticStatus.WARN,
    'error': DiagnosticStatus.ERROR,
}


@dataclass(frozen=True)
class Event:
    """One event: which node, what happened, in words, with values."""

    node: str
    event: str
    message: str
    values: dict[str, str]


class NodeStatus:
    """Publish a node's summary and events; end the node where another of its name is longer there.

    Parameters
    ----------
    node
        The node that reports. Its `failure` is set where it must end.
    summary
        Returns (level, message, values) now; level is ``ok``, ``warn`` or ``error``.
    """

    def __init__(self, node: Node, summary: Callable[[], tuple[str, str, dict[str, Any]]]) -> None:
        self._node = node
        self._summary = summary
        # Tells a node that was started again from the one before it.
        self._started, self._started_wall = str(time.time_ns()), time.monotonic()
        self._duplicates = DuplicateNodeCheck(self._started)
        self._publisher = node.create_publisher(DiagnosticArray, TOPIC, RELIABLE)
        # Where the executor has threads, heartbeats go on while a callback plans or writes.
        group = MutuallyExclusiveCallbackGroup()
        # What is published last must have been true last.
        self._order = threading.Lock()
        # A wall timer: status must go on when the simulated clock stands still.
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(0.5, self.publish, callback_group=group, clock=self.steady)
        self._qos_trouble = ''
        self._qos_timer = node.create_timer(
            QOS_EVERY_S, self._look_at_qos, callback_group=group, clock=self.steady
        )
        receive = receiver(lambda event: None, self._on_summary)
        node.create_subscription(DiagnosticArray, TOPIC, receive, RELIABLE, callback_group=group)

    @property
    def alone_since(self) -> float | None:
        """Since when no other of this name was heard, `time.monotonic`; None where not yet."""
        return self._duplicates.alone_since_s

    def alone(self, now: float) -> bool:
        """Whether this node has listened for 1.5 s and heard of no other of its name.

        Parameters
        ----------
        now
            `time.monotonic`, s.
        """
        return self._duplicates.alone(now)

    def _look_at_qos(self) -> None:
        self._qos_trouble = mismatches(self._node)

    def _on_summary(self, name: str, message: str, values: dict[str, str]) -> None:
        own = self._node.get_fully_qualified_name()
        started = values.get('started', '')
        if name != self._node.get_name() or values.get('node', own) != own or not started:
            return
        now = time.monotonic()
        if started == self._started:
            self._duplicates.update_own(now)
            return
        try:
            uptime_s = float(values['uptime_s'])
        except (KeyError, ValueError):
            return
        # A replay publishes what a node of this name once said, and is another node.
        if self._namesakes() < 2:
            return
        if self._duplicates.update_other(started, uptime_s, now - self._started_wall, now):
            self._node.failure = InputError(  # type: ignore[attr-defined]
                f'{own} is running already in this ROS domain, for {uptime_s:.0f} s, on another '
                'computer or for another user; end that one, or give this one a namespace '
                '(__ns:=/…) or a domain (ROS_DOMAIN_ID) of its own'
            )

    def _namesakes(self) -> int:
        """Return how many publishers of this topic are of nodes with this node's name."""
        own = self._node.get_name(), self._node.get_namespace()
        found = self._node.get_publishers_info_by_topic(self._publisher.topic_name)
        return sum((info.node_name, info.node_namespace) == own for info in found)

    def publish(self) -> None:
        """Publish the summary now; from any thread."""
        with self._order:
            level, message, values = self._summary()
            if self._qos_trouble and level == 'ok':
                level, message = 'warn', self._qos_trouble
            own = {
                'qos_trouble': self._qos_trouble,
                'node': self._node.get_fully_qualified_name(),
                'started': self._started,
                'uptime_s': f'{time.monotonic() - self._started_wall:.3f}',
            }
            self._send(self._node.get_name(), level, message, {**values, **own})

    def event(self, event: str, message: str, level: str = 'ok', **values: Any) -> None:
        """Publish an event now."""
        self._send(f'{self._node.get_name()}: {event}', level, message, values)

    def _send(self, name: str, level: str, message: str, values: dict[str, Any]) -> None:
        status = DiagnosticStatus(
            name=name,
            level=LEVELS[level],
            message=message,
            hardware_id='remaster_ros',
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        message_out = DiagnosticArray(status=[status])
        message_out.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message_out)


def receiver(
    on_event: Callable[[Event], None],
    on_summary: Callable[[str, str, dict[str, str]], None] | None = None,
) -> Callable[[DiagnosticArray], None]:
    """Return a callback that calls `on_event` for every event in a message.

    `on_summary(node, message, values)` is called for every summary.
    """

    def receive(array: DiagnosticArray) -> None:
        for status in array.status:
            values = {pair.key: pair.value for pair in status.values}
            name, separator, event = status.name.partition(': ')
            if separator:
                on_event(Event(name, event, status.message, values))
            elif on_summary is not None:
                on_summary(name, status.message, values)

    return receive


def listen(
    node: Node,
    on_event: Callable[[Event], None],
    on_summary: Callable[[str, str, dict[str, str]], None] | None = None,
) -> None:
    """Subscribe `node` to /remaster/status with a `receiver` of these callbacks."""
    node.create_subscription(DiagnosticArray, TOPIC, receiver(on_event, on_summary), RELIABLE)


def run_after(run: str, planner: Mapping[str, str]) -> str:
    """Return the token to hold after a summary of the planner.

    The recorder and the bridge hold it in memory and publish it as `run`: by that a planner which
    is started again finds whether its run still lives. A pause or a stop ends the run; a planner
    that has just been started and has not decided yet (``idle``) does not.

    Parameters
    ----------
    run
        The token held so far, '' for none.
    planner
        The values of the planner's summary.
    """
    state = planner.get('state', '')
    if state in ('running', 'held'):
        return planner.get('run', '') or run
    return run if state in ('idle', '') else ''
