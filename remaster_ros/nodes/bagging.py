# SPDX-License-Identifier: Apache-2.0
"""Subscribe raw, write the bytes into the bag as they came, then hand the message on."""

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
from remaster_ros.session.bag import RECORDED
from remaster_ros.session.bag_writer import BagWriter

DEEP = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
"""What a busy recorder has not yet taken is kept for it: seconds of the fastest stream."""
MOST_AT_ONCE = 100
"""Of one topic, before the others have their turn: some 20 ms of a processor."""
MOST_EARLY = 20_000
"""Messages that are kept while there is no clock: some ten seconds of the fastest streams."""


class BagRecorder:
    """Record topics of a node into a bag.

    ``folder``: the bag's folder, gone on with where there is one; ``began``: what it begins with;
    None records nothing and only hands messages on; ``begin``: false to record nothing before
    `reopen`.
    Attributes: ``notes``: how the bag was found, for the user; ``dropped``: messages that found no
    room, neither on the disk nor in memory; ``taken``: how many messages of each topic, by its
    name in bags, were handed on and received.
    """

    def __init__(
        self, node: Node, folder: Path, began: RecorderBegan | None, *, begin: bool = True
    ) -> None:
        self._node, self._folder, self._began = node, folder, began
        self.taken: Counter[str] = Counter()
        self._writer: BagWriter | None = None
        # Received while the node's clock, a simulated one, had no time: topic, type, bytes.
        self._early: list[tuple[str, str, bytes]] = []
        self.notes: list[str] = []
        self.dropped = 0
        if begin:
            self.reopen()

    def reopen(self) -> None:
        """Go on with the bag after it was closed."""
        if self._began is None:
            return
        try:
            self._writer = BagWriter(self._folder, resume=True)
        except InputError as error:
            # The bag is never the only copy of an observation: its damage stops nothing.
            self._folder = _free(self._folder)
            self.notes.append(f'{error}; recording into {self._folder}')
            self._writer = BagWriter(self._folder)
        # First in each file: a replay begins anew there, as this recorder did.
        began = EventRecord(node=self._node.get_fully_qualified_name(), body=self._began)
        self._began = msgspec.structs.replace(self._began, continued=True)
        data = serialize_message(String(data=encode(began)))
        self._write(name_in_bag(EVENTS), 'std_msgs/msg/String', data)

    def _write(self, topic: str, type_name: str, data: bytes) -> None:
        """Write a message under the node's time; what came before there was one comes first.

        A bag that began at time 0 would last as long as the simulation has been running.
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

        ``with_info`` gives it the message's info of rclpy as well.

        In the bag it has the name of `name_in_bag`: without this node's namespace and as if it was
        not remapped, so that a bag can be replayed in any namespace.
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
                    # Bytes that are no message: rclpy raises whatever the middleware does.
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
                    further = subscription.handle.take_message(kind, True)
                if further is None:
                    return
                take(*further)

        # rclpy's types have no callback with a message's info beside raw bytes.
        subscription = self._node.create_subscription(
            kind,
            topic,
            take_all,  # type: ignore[arg-type]
            qos,
            raw=True,
        )

    def subscribe_rest(self) -> None:
        """Record the topics that the recorder itself has no use for."""
        if self._began is None:
            return
        self.subscribe(PoseStamped, 'remaster/target_pose')
        self.subscribe(DiagnosticArray, TOPIC)
        self.subscribe(TransformStamped, 'remaster/registration', qos=LATCHED)
        self.subscribe(JointState, 'remaster/joint_offsets', qos=LATCHED)
        self.subscribe(JointState, 'remaster/joint_offsets_std', qos=LATCHED)

    def close(self) -> None:
        """Close the bag; messages that come later are not recorded.

        Where the disk does not take its end, it stays as that of a killed recorder.
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
    """Return the name in bags of a topic as this package's code names it, relative or not.

    What moves an arm has another one there (`session.bag.RECORDED`).
    """
    name = f'/{topic.lstrip("/")}'
    return RECORDED.get(name, name)


def _free(folder: Path) -> Path:
    """Return the first of bag_1, bag_2, … that is not there."""
    number = 1
    while (free := folder.with_name(f'{folder.name}_{number}')).exists():
        number += 1
    return free
