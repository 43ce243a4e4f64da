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
    """Take joint positions of an arm from joint_states, whoever else publishes there.

    ``hold_s``: a second publisher counts for so long after it was noticed last, s of wall time.
    Attributes: ``others``: what a message is that has none of the arm's joints, for whom the arm's
    do not come; ''.
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
        """Return the arm's positions, rad or m, (k,); None from a message of another device.

        ``info``: rclpy's of the message. Raises InputError as `JointOrder.positions`. Notes a
        rival too.
        """
        return self._order.positions(message) if self.note(message, info) else None

    def note(self, message: JointState, info: Mapping[str, Any]) -> bool:
        """Note a rival publisher of joint states; return whether the message is of this arm.

        A rival shows by `NUMBER` in `info`, where it does not increase from message to message. A
        message that names no joint of the arm sets `others`.
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
        """Return that the arm's joints come from several publishers, with the nodes; '' if not.

        Until `hold_s` after a rival was noticed; by the graph if messages have no numbers.
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
