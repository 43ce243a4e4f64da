"""Subscribe raw, write the bytes into the bag as they came, then hand the message on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from remaster_ros.nodes.status import LATCHED, RELIABLE
from remaster_ros.storage.bag_writer import BagWriter


class BagRecorder:
    """Record topics of a node into a bag.

    Parameters
    ----------
    node
        The node that subscribes.
    folder
        The bag's folder; None records nothing and only hands messages on.
    """

    def __init__(self, node: Node, folder: Path | None) -> None:
        self._node = node
        self._writer = BagWriter(folder) if folder is not None else None

    def subscribe(
        self,
        kind: Any,
        topic: str,
        receive: Callable[[Any], None] | None = None,
        qos: QoSProfile = RELIABLE,
    ) -> None:
        """Record `topic`; call `receive` with each decoded message, if given."""
        module = kind.__module__.split('.')[0]
        type_name = f'{module}/msg/{kind.__name__}'

        def take(data: bytes) -> None:
            # Raw, because serialising again can leave uninitialised bytes behind the message.
            if self._writer is not None:
                stamp_ns = self._node.get_clock().now().nanoseconds
                self._writer.write(topic, type_name, data, stamp_ns)
            if receive is not None:
                receive(deserialize_message(data, kind))

        self._node.create_subscription(kind, topic, take, qos, raw=True)

    def subscribe_rest(self) -> None:
        """Record the topics that the recorder itself has no use for."""
        if self._writer is None:
            return
        self.subscribe(PoseStamped, '/remaster/target_pose')
        self.subscribe(TransformStamped, '/remaster/registration', qos=LATCHED)
        self.subscribe(JointState, '/remaster/joint_offsets', qos=LATCHED)
        self.subscribe(JointState, '/remaster/joint_offsets_std', qos=LATCHED)

    def close(self) -> None:
        """Close the bag; messages that come later are not recorded."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
