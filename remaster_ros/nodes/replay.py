# SPDX-License-Identifier: Apache-2.0
"""Publish a recorded bag again, byte for byte and in its own time, as ``ros2 bag play`` does.

It never publishes onto a live graph: where other nodes publish what robot, bridge and planner
publish, or where a controller subscribes, it ends. Commands to the arm are left out by default.
Other messages are not: it waits for a recorder until that has taken what was sent, so that no rate
is too fast; where some messages did not reach a subscriber, or a bag has a torn end, it names them
and ends with status 1.
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import String
from std_srvs.srv import Trigger

from remaster_ros.collection import events
from remaster_ros.errors import InputError, InsufficientDataError, RemasterError
from remaster_ros.nodes.messages import message_class, stamp_of
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.qos import node_of
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.status import EVENTS, MESSAGES_TAKEN, taken_key
from remaster_ros.nodes.status import TOPIC as STATUS
from remaster_ros.session.bags.bag import LATCHED_TOPICS, RECORDED, BagReader, live_name

CLOCK = '/clock'
COMMANDS = '/joint_trajectory_controller/joint_trajectory'
SOURCES = (
    'joint_states',
    COMMANDS.lstrip('/'),
    'remaster/joint_solutions',
    'remaster/joint_waypoints',
    'remaster/settled',
)
"""What robot, bridge and planner publish: with one of them there, the graph is live."""
DISCOVERY_S = 4.0
"""How long the graph is checked before the first message, s: a participant announces itself every
3 s, and its first announcement can get lost on a busy machine."""
NEWCOMER_S = 0.5
"""How long after its first endpoint all others of a node are known, s."""
DEPTH = 20_000
"""Messages that a publisher keeps for subscribers that have not taken them yet."""
BEHIND_S = 0.05
"""So much of a delay of its own a replay makes up for, s; the rest it goes on later."""
TAKEN_S = 10.0
"""How long a subscriber may take for half of them before they count as dropped, s."""
WINDOW = 500
"""So many messages are sent at most before a recorder is waited for: it keeps four times as many
of each topic. Among them topics come in any order, which their stamps make good."""
IN_ORDER = ('/remaster/settled', '/remaster/joint_solutions')
"""Between these and what was sent before and after, the order counts as well."""
ORDERED_EVENTS = (
    events.PoseAnnounced,
    events.SolutionFailed,
    events.ArmStopped,
    events.ConfigurationEnded,
    events.ReadByHand,
    events.RecorderBegan,
)
"""Events that a recorder acts on, besides changes of the planner's state."""
SHOWN_S = 5.0
"""How often it is logged how far the replay is, s."""
LOOK_S = 1.0
"""How often the graph is checked again for other nodes, s."""


@dataclass(frozen=True)
class Parameters:
    """ROS parameters of the replay."""

    bag: str = parameter('', 'folder of the bag, or of the session that holds it')
    rate: float = parameter(1.0, 'how many times as fast as recorded', low=0.01, high=100.0)
    publish_clock: bool = parameter(True, 'publish /clock with the recorded times')
    wait_for: str = parameter(
        '', 'a topic whose first subscriber is waited for before the first message'
    )
    wait_s: float = parameter(30.0, 'how long at most', unit='s', low=0.0, high=3600.0)
    with_commands: bool = parameter(
        False, 'publish also the commands to the controller; refused where a controller subscribes'
    )


class Replay(RemasterNode):
    """Node that publishes a bag again in its own time, and ends after the last message."""

    def __init__(self) -> None:
        super().__init__('replay')
        self.p = declare(self, Parameters)
        if not self.p.bag:
            raise InputError('replay: parameter bag is empty; give the folder of a bag')
        folder = Path(self.p.bag)
        self.get_logger().info(f'checking {folder}')
        self._reader = BagReader(folder / 'bag' if (folder / 'bag').is_dir() else folder)
        self._publishers_by_topic: dict[str, Publisher] = {}
        self._clock_publisher = (
            self.create_publisher(ClockMessage, 'clock', 10) if self.p.publish_clock else None
        )
        self._ending = threading.Event()
        self._clock_sent = 0.0
        # Number of subscribers, when last checked, of each topic that moves an arm.
        self._listeners: dict[str, int] = {}
        self.sent = 0
        # Sent since all subscribers had taken all, by topic; and what they did not take.
        self._untaken: Counter[str] = Counter()
        self._dropped: Counter[str] = Counter()
        self._acknowledged = Acknowledged(self)
        # Before anything is published, and again when discovery has found the other nodes.
        self._refuse_live()
        for topic, type_name in self._reader.topics.items():
            name = live_name(topic)
            left_out = name == COMMANDS and not self.p.with_commands
            if not left_out and (topic != CLOCK or self._clock_publisher is None):
                self._publishers_by_topic[topic] = self._publisher(name, type_name)
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def _publisher(self, topic: str, type_name: str) -> Publisher:
        """Return a publisher for the messages of a recorded topic.

        ``topic``: name on the live graph, without namespace; the publisher's is relative, for
        any namespace. Reliable, and latched if the topic is in `LATCHED_TOPICS`. Raises
        InputError if the message type is not installed.
        """
        latched = topic in LATCHED_TOPICS
        qos = QoSProfile(
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        # Relative: bags have names without a namespace.
        return self.create_publisher(message_class(type_name), topic.lstrip('/'), qos)

    def _play(self) -> None:
        """Thread: replay the bag; `finished` at its end, else `failure` is the RemasterError."""
        try:
            self._wait_for_subscriber()
            self._refuse_live()
            self._acknowledged.begin(self.p.wait_s, self._ending)
            self._send_all()
            # Give DDS the time to hand the last messages over.
            self._ending.wait(1.0)
            self._require_all()
            self.finished = True
        except RemasterError as error:
            self.failure = error

    def _wait_for_subscriber(self) -> None:
        """Wait for a subscriber of `wait_for`; InputError if none comes in `wait_s`.

        Then, or without such a topic, wait `DISCOVERY_S`. Ends early if the node is to end.
        """
        topic = self.p.wait_for
        if not topic:
            self._ending.wait(DISCOVERY_S)
            return
        deadline = time.monotonic() + self.p.wait_s
        # A recorded name stands for the topic that is published here, in any namespace.
        for recorded, publisher in self._publishers_by_topic.items():
            if live_name(recorded) == f'/{topic.lstrip("/")}':
                topic = publisher.topic_name
        while not self._ending.is_set() and self.count_subscribers(topic) == 0:
            if time.monotonic() > deadline:
                raise InputError(f'replay: no subscriber of {topic} in {self.p.wait_s:g} s')
            time.sleep(0.05)
        self._ending.wait(DISCOVERY_S)

    def _refuse_live(self) -> None:
        """Raise InputError if this ROS graph has a live arm or planner, which it might disturb.

        That is: another node publishes on a topic of `SOURCES`, or a node that publishes no
        status of this package subscribes to the commands. The error names the node. A node
        that was killed stays listed for some 20 s.
        """
        own_node = self.get_name(), self.get_namespace()
        for topic in SOURCES:
            name = self.resolve_topic_name(topic)
            for info in self.get_publishers_info_by_topic(name):
                if (info.node_name, info.node_namespace) != own_node:
                    raise InputError(_live(info, f'publishes {name}'))
        # Of nodes that publish a summary, recorder and laser tracker only listen to the commands.
        reporting = {
            (info.node_name, info.node_namespace)
            for info in self.get_publishers_info_by_topic(self.resolve_topic_name(STATUS))
        }
        name = self.resolve_topic_name(COMMANDS.lstrip('/'))
        for info in self.get_subscriptions_info_by_topic(name):
            if (info.node_name, info.node_namespace) not in reporting - {own_node}:
                raise InputError(_live(info, f'listens to {name}'))

    def _look_who_listens(self, publisher: Publisher) -> None:
        """Raise InputError if a live node has come to subscribe to a topic that moves an arm.

        Checked as by `_refuse_live`, only if the number of subscribers of ``publisher`` has
        changed since the last call. If there are any, the check waits `NEWCOMER_S`, until the
        other topics of a new node are discovered.
        """
        count = publisher.get_subscription_count()
        known = self._listeners.get(publisher.topic_name)
        if count != known:
            if count:
                # Its other endpoints are discovered a little later.
                self._ending.wait(NEWCOMER_S)
            self._refuse_live()
            self._listeners[publisher.topic_name] = count

    def _send_all(self) -> None:
        """Publish the bag's messages at `rate` times their speed, until the node is to end.

        A delay of more than `BEHIND_S` is not made up for. Topics left out are skipped. Raises
        InputError if the graph becomes live.
        """
        start_wall = first = None
        looked = shown = time.monotonic()
        last = self._reader.whole.last_ns or 0
        planner: events.PlannerState | None = None
        for topic, _, data, stamp_ns in self._reader:
            if start_wall is None or first is None:
                start_wall, first = time.monotonic(), stamp_ns
            due = start_wall + (stamp_ns - first) * 1e-9 / self.p.rate
            while (ahead := due - time.monotonic()) > 0 and not self._ending.is_set():
                self._publish_clock(first + (time.monotonic() - start_wall) * self.p.rate * 1e9)
                self._ending.wait(min(ahead, 0.01))
            if self._ending.is_set():
                return
            if -ahead > BEHIND_S:
                # Made up for at once, it would flood subscribers that keep a few messages only.
                start_wall -= ahead + BEHIND_S
            if time.monotonic() - looked > LOOK_S:
                looked = time.monotonic()
                self._refuse_live()
                if looked - shown > SHOWN_S:
                    shown = looked
                    remaining_s = (last - stamp_ns) * 1e-9 / self.p.rate
                    self.get_logger().info(
                        f'{self.sent} messages published, {remaining_s:.0f} s left'
                    )
            self._publish_clock(stamp_ns)
            publisher = self._publishers_by_topic.get(topic)
            if publisher is not None:
                record = _record(data) if topic == f'/{EVENTS}' else None
                in_order = live_name(topic) in IN_ORDER
                if record is not None and isinstance(record.body, events.PlannerState):
                    # Twice a second; what it changes counts.
                    in_order, planner = record.body != planner, record.body
                elif record is not None:
                    in_order = isinstance(record.body, ORDERED_EVENTS)
                if in_order or self._acknowledged.sent.total() >= WINDOW:
                    self._await_recorder()
                if live_name(topic) in RECORDED:
                    self._look_who_listens(publisher)
                publisher.publish(data)
                self.sent += 1
                self._untaken[topic] += 1
                if self._untaken[topic] >= DEPTH // 2:
                    self._await_taken(topic)
                self._acknowledged.sent[topic if record is None else taken_key(record)] += 1
                if in_order:
                    self._await_recorder()
        self.get_logger().info(f'{self.sent} messages published')

    def _await_recorder(self) -> None:
        """Wait until a recorder, if there is one, has taken the messages sent; count losses."""
        for topic, count in self._acknowledged.wait(self._ending).items():
            self._dropped[topic] += count

    def _await_taken(self, topic: str) -> None:
        """Wait until all subscribers of a topic have received its messages, at most `TAKEN_S`.

        After that time all messages sent since the last wait are counted in `_dropped`.
        Without waiting, later messages would overwrite those still in the queue of a slow
        subscriber.
        """
        publisher, count = self._publishers_by_topic[topic], self._untaken.pop(topic, 0)
        if not self._ending.is_set() and not publisher.wait_for_all_acked(
            Duration(seconds=TAKEN_S)
        ):
            self._dropped[topic] += count

    def _require_all(self) -> None:
        """Wait for the last messages; raise InsufficientDataError if any did not arrive.

        Either they were dropped on the way to a subscriber, or the bag ends in an incomplete
        message, as its writer was killed. The error has the topics and counts. Nothing is
        raised if the node is to end.
        """
        for topic in list(self._untaken):
            self._await_taken(topic)
        self._await_recorder()
        lost = [
            f'up to {count} messages of {topic} did not reach a subscriber in {TAKEN_S:g} s'
            for topic, count in sorted(self._dropped.items())
        ]
        if self._reader.torn_bytes:
            lost.append(
                f'the last {self._reader.torn_bytes} bytes of the bag are no whole message (its '
                'writer was killed)'
            )
        if lost and not self._ending.is_set():
            raise InsufficientDataError(f'replay: {"; ".join(lost)}; the rest was published')

    def _publish_clock(self, time_ns: float) -> None:
        """Publish a time, ns, on /clock, if it is replayed; at most every 9 ms."""
        now = time.monotonic()
        if self._clock_publisher is not None and now - self._clock_sent >= 0.009:
            self._clock_sent = now
            self._clock_publisher.publish(ClockMessage(clock=stamp_of(time_ns * 1e-9)))

    def close(self) -> None:
        """Stop publishing, and wait for the thread, 2 s at most."""
        self._ending.set()
        self._thread.join(2.0)


class Acknowledged:
    """Waits until the recorder has taken the messages of a replay, as its service reports.

    ``node``: the replay, which is spun by another thread than the one that waits here.
    Attributes: ``sent``: number of messages sent since the last wait, by topic; on
    remaster/events by `taken_key`.
    """

    def __init__(self, node: RemasterNode) -> None:
        self._node, self._client = node, node.create_client(Trigger, MESSAGES_TAKEN)
        self.sent: Counter[str] = Counter()
        self._before: dict[str, int] | None = None

    def begin(self, wait_s: float, ending: threading.Event) -> None:
        """Detect a recorder, and keep how many messages it has taken already.

        Nothing if no node named recorder subscribes to remaster/settled. ``ending``: set when
        the node ends. Raises InputError if that recorder has no such service within `wait_s`.
        """
        settled = self._node.resolve_topic_name(IN_ORDER[0].lstrip('/'))
        subscribers = self._node.get_subscriptions_info_by_topic(settled)
        if not any(info.node_name == 'recorder' for info in subscribers):
            return
        deadline = time.monotonic() + wait_s
        while not self._client.service_is_ready() and not ending.is_set():
            if time.monotonic() > deadline:
                raise InputError(
                    f'replay: no {self._client.srv_name} of the recorder in {wait_s:g} s: is it '
                    'of the same version of remaster_ros?'
                )
            ending.wait(0.05)
        self._before = self._ask(ending)

    def _ask(self, ending: threading.Event) -> dict[str, int] | None:
        """Number of messages that a recorder has taken, by topic.

        None without an answer in `TAKEN_S`, or if `ending` is set.
        """
        answered = threading.Event()
        future = self._client.call_async(Trigger.Request())
        future.add_done_callback(lambda _: answered.set())
        deadline = time.monotonic() + TAKEN_S
        while not answered.wait(0.05):
            if ending.is_set() or time.monotonic() > deadline:
                self._client.remove_pending_request(future)
                return None
        response = future.result()
        return None if response is None else json.loads(response.message)

    def wait(self, ending: threading.Event) -> dict[str, int]:
        """Wait until the recorder has taken all messages sent since the last call.

        Returns the number not taken, by topic, if none were taken for `TAKEN_S`; {} if all
        were, without a recorder, or if `ending` is set. With a recorder `sent` is empty
        afterwards.
        """
        if self._before is None or not self.sent:
            return {}
        missing: dict[str, int] = {}
        since = time.monotonic()
        while not ending.is_set():
            taken = self._ask(ending) or {}
            remaining_counts = {
                name: count - taken.get(name, 0) + self._before.get(name, 0)
                for name, count in self.sent.items()
                # It lists the topics that it takes; of records those that have come.
                if name in taken or ' ' in name
            }
            remaining_counts = {
                name: count for name, count in remaining_counts.items() if count > 0
            }
            if not remaining_counts:
                break
            if remaining_counts != missing:
                missing, since = remaining_counts, time.monotonic()
            elif time.monotonic() - since > TAKEN_S:
                self._before, self.sent = taken, Counter()
                return remaining_counts
            ending.wait(0.001)
        self._before = {
            name: self._before.get(name, 0) + self.sent[name]
            for name in {*self._before, *self.sent}
        }
        self.sent = Counter()
        return {}


def _record(data: bytes) -> events.EventRecord | None:
    """Return the record in a serialised message; None if it is not a valid record."""
    try:
        return events.decode(deserialize_message(data, String).data)
    except InputError:
        return None


def _live(info: TopicEndpointInfo, does: str) -> str:
    """Error message that a node makes this graph live, with the remedy.

    ``does``: its doing as a phrase, such as 'publishes /joint_states'.
    """
    return (
        f'replay: this graph is live: {node_of(info)} {does}; end it, or replay in another ROS '
        'domain (ROS_DOMAIN_ID) or namespace'
    )


def main(args: list[str] | None = None) -> int:
    """Run the node until the end of the bag, a signal or an error; return its exit status."""
    return run(Replay, args)


if __name__ == '__main__':
    raise SystemExit(main())
