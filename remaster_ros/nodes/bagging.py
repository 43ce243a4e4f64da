# SPDX-License-Identifier: Apache-2.0
"""Raw subscriptions: the bag gets the bytes as received, then the message is decoded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from remaster_ros.collection.events import EventRecord, RecorderBegan, encode
from remaster_ros.errors import DiskError, InputError
from remaster_ros.nodes.status import EVENTS, LATCHED, TOPIC
from remaster_ros.session.bags.bag import RECORDED
from remaster_ros.session.bags.bag_writer import BagWriter

DEEP = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
"""Queue of a busy recorder: seconds of the fastest stream."""
MOST_AT_ONCE = 100
"""Most messages of one topic before others have their turn: about 20 ms of a processor."""
MOST_EARLY = 20_000
"""Most messages kept while the node has no time: about ten seconds of the fastest streams."""


class BagRecorder:
    """Records topics of a node into a bag.

    ``folder``: the bag's, resumed if it exists; ``began``: first record of the bag; None to record
    nothing and only hand messages on; ``begin``: False to record nothing before `reopen`.
    Attributes: ``notes``: messages on the state of the bag; ``dropped``: messages lost for lack of
    space on the disk and in memory; ``taken``: number of messages received and handed on, by the
    topic's name in bags.
    """

    def __init__(
        self, node: Node, folder: Path, began: RecorderBegan | None, *, begin: bool = True
    ) -> None:
        self._node, self._folder, self._began = node, folder, began
        self.taken: Counter[str] = Counter()
        self._writer: BagWriter | None = None
        # Messages received before the simulated clock had a time: topic, type, bytes.
        self._early: list[tuple[str, str, bytes]] = []
        self.notes: list[str] = []
        self.dropped = 0
        if begin:
            self.reopen()

    def reopen(self) -> None:
        """Resume the bag after it was closed, or begin it; nothing if `began` is None.

        If the bag is damaged, another one (``bag_1``, …) is begun, with a line in `notes`. The
        first record is written again, marked as continued. Raises InputError if that fails too.
        """
        if self._began is None:
            return
        try:
            self._writer = BagWriter(self._folder, resume=True)
        except InputError as error:
            # The bag is never the only copy of an observation: recording continues.
            self._folder = _free(self._folder)
            self.notes.append(f'{error}; recording into {self._folder}')
            self._writer = BagWriter(self._folder)
        # First in each file: a replay restarts there, as this recorder did.
        began = EventRecord(node=self._node.get_fully_qualified_name(), body=self._began)
        self._began = msgspec.structs.replace(self._began, continued=True)
        data = serialize_message(String(data=encode(began)))
        self._write(name_in_bag(EVENTS), 'std_msgs/msg/String', data)

    def _write(self, topic: str, type_name: str, data: bytes) -> None:
        """Write a serialised message to the bag, stamped with the time of the node's clock.

        Before a simulated clock has begun, messages are kept in memory, `MOST_EARLY` at most,
        and written with the first later one. Nothing is written while the bag is closed.
        Messages that are lost, for lack of space on the disk or in memory, are counted in
        `dropped`; no error is raised.
        """
        if self._writer is None:
            return
        now_ns = self._node.get_clock().now().nanoseconds
        if now_ns == 0:
            if len(self._early) < MOST_EARLY:
                self._early.append((topic, type_name, data))
            else:
                self.dropped += 1
            return
        waiting, self._early = [*self._early, (topic, type_name, data)], []
        for message in waiting:
            try:
                self._writer.write(*message, now_ns)
            except DiskError:
                self.dropped += 1

    def subscribe(
        self,
        kind: Any,
        topic: str,
        receive: Callable[..., None] | None = None,
        qos: QoSProfile = DEEP,
        *,
        with_info: bool = False,
    ) -> None:
        """Record `topic`; call `receive` with each decoded message, if given.

        ``kind``: the message's class; ``with_info``: call `receive` with (message, rclpy's
        message info). In the bag the topic is named by `name_in_bag`, without namespace and
        remapping, so that a bag can be replayed in any namespace. Without `receive` messages
        are recorded undecoded. With it a message that cannot be decoded is not recorded: the
        callback raises InputError, which `RemasterNode` logs.
        """
        module = kind.__module__.split('.')[0]
        type_name = f'{module}/msg/{kind.__name__}'
        name = name_in_bag(topic)
        if receive is not None:
            self.taken[name] = 0

        def take(data: bytes, info: Mapping[str, Any]) -> None:
            message = None
            if receive is not None:
                try:
                    message = deserialize_message(data, kind)
                except Exception as error:
                    # Invalid bytes: rclpy raises various errors of the middleware.
                    raise InputError(f'not a {type_name} ({type(error).__name__})') from None
            # Raw, because serialising again can leave uninitialised bytes behind the message.
            self._write(name, type_name, data)
            if receive is not None:
                receive(message, info) if with_info else receive(message)
                self.taken[name] += 1

        def take_all(data: bytes, info: Mapping[str, Any]) -> None:
            # rclpy takes one message of each topic in turn: those of a fast sensor would wait for
            # ever longer while the joint states, of which there are fewer, are up to date.
            take(data, info)
            for _ in range(MOST_AT_ONCE):
                with subscription.handle:
                    message_and_info = subscription.handle.take_message(kind, True)
                if message_and_info is None:
                    return
                take(*message_and_info)

        # rclpy's types have no callback with a message's info beside raw bytes.
        subscription = self._node.create_subscription(
            kind,
            topic,
            take_all,  # type: ignore[arg-type]
            qos,
            raw=True,
        )

    def subscribe_rest(self) -> None:
        """Record the topics that the recorder node does not use itself; nothing without a bag.

        They are the target pose, status, registrations, and joint offsets with their standard
        deviations.
        """
        if self._began is None:
            return
        self.subscribe(PoseStamped, 'remaster/target_pose')
        self.subscribe(DiagnosticArray, TOPIC)
        self.subscribe(TransformStamped, 'remaster/registration', qos=LATCHED)
        self.subscribe(JointState, 'remaster/joint_offsets', qos=LATCHED)
        self.subscribe(JointState, 'remaster/joint_offsets_std', qos=LATCHED)

    def close(self) -> None:
        """Close the bag; later messages are not recorded.

        If the disk is full, the bag remains like that of a killed recorder, with a warning.
        """
        writer, self._writer = self._writer, None
        self.dropped += len(self._early)
        self._early = []
        if writer is not None:
            try:
                writer.close()
            except DiskError as error:
                self._node.get_logger().warning(f'{error}; `remaster recover` finishes the bag')


def name_in_bag(topic: str) -> str:
    """Return the name in bags of a topic, relative or not, of this package's code.

    Topics that move an arm have other names there (`session.bag.RECORDED`).
    """
    name = f'/{topic.lstrip("/")}'
    return RECORDED.get(name, name)


def _free(folder: Path) -> Path:
    """Return the first of the folders NAME_1, NAME_2, … beside `folder` that does not exist."""
    number = 1
    while (free := folder.with_name(f'{folder.name}_{number}')).exists():
        number += 1
    return free
