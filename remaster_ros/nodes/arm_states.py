# SPDX-License-Identifier: Apache-2.0
"""Joint positions of an arm from joint_states, whoever else publishes there."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import JointState

from remaster_ros.collection.message_fields import JointOrder
from remaster_ros.nodes.qos import node_of
from remaster_ros.nodes.rivals import OnlyPublisher
from remaster_ros.types import FloatArray

JOINTS = 'joint_states'
NUMBER = 'publication_sequence_number'
"""Of a message, by its publisher; None from a middleware that has none."""


class ArmStates:
    """Joint positions of an arm from joint_states, on which other devices may publish as well.

    ``hold_s``: a second publisher of the arm's joints is reported for so long after it was
    last noticed, s of wall time.
    Attributes: ``others``: sentence on the last message that names none of the arm's joints;
    '' if none has come.
    """

    def __init__(self, node: Node, names: Sequence[str], hold_s: float) -> None:
        self._node, self._hold_s = node, hold_s
        self._order = JointOrder(names)
        self._topic = node.resolve_topic_name(JOINTS)
        self._only = OnlyPublisher(node, JOINTS, JointState)
        # Of the last message: None before the first, and where it has no number.
        self._number: int | None = None
        self._is_counted = False
        self._rival_until_wall = 0.0
        self.others = ''

    def take(self, message: JointState, info: Mapping[str, Any]) -> FloatArray | None:
        """Return the arm's joint positions in a message, rad or m, (k,).

        None if the message names no joint of the arm. ``info``: message info of rclpy. Raises
        InputError as `JointOrder.positions`. A second publisher is noted as by `note`.
        """
        return self._order.positions(message) if self.note(message, info) else None

    def note(self, message: JointState, info: Mapping[str, Any]) -> bool:
        """Note a second publisher of the arm's joints; return whether a message names any of them.

        A second publisher shows if the publication sequence number in `info` (message info of
        rclpy) does not increase from one message of the arm to the next. A message that names
        no joint of the arm only sets `others`.
        """
        if not self._order.concerns(message):
            found = ', '.join(message.name) or 'no joints'
            self.others = (
                f"{JOINTS} has {found}, none of the cell's joints: does the cell file name the "
                'robot that is running?'
            )
            return False
        number = info.get(NUMBER)
        if number is not None and self._number is not None and number <= self._number:
            self._rival_until_wall = time.monotonic() + self._hold_s
        self._number, self._is_counted = number, number is None
        return True

    def rival(self) -> str:
        """Sentence that several publishers send the arm's joints, with their nodes; '' if not.

        Returned for `hold_s` after a second publisher was last noticed. If messages have no
        sequence numbers, all publishers of the topic in the ROS graph count (`OnlyPublisher`).
        """
        if self._is_counted:
            # Nothing but the graph tells publishers apart.
            return self._only.trouble()
        if time.monotonic() >= self._rival_until_wall:
            return ''
        listed = self._node.get_publishers_info_by_topic(self._topic)
        return (
            f"the arm's joints come on {self._topic} from more than one publisher, or from one "
            f'that was started again; on it are {", ".join(sorted(map(node_of, listed)))}: end '
            "all others that publish the arm's joints"
        )
