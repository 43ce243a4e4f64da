"""Subscribe to a topic of another package's node for `remaster_ros.sensors.topic`."""

from __future__ import annotations

import importlib

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from remaster_ros.errors import InputError
from remaster_ros.nodes.endpoints import node_of
from remaster_ros.sensors.topic.driver import TopicDriver
from remaster_ros.session.workcell import CellSensor

ANY = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches publishers that are reliable, best-effort, volatile or latched."""


def subscribe_to_source(node: Node, driver: TopicDriver, sensor: CellSensor) -> None:
    """Hand all messages of a sensor's source to its driver.

    Raises
    ------
    InputError
        The package of the message type is not installed.
    """
    package, _, name = sensor.message_type.partition('/msg/')
    try:
        kind = getattr(importlib.import_module(f'{package}.msg'), name)
    except ImportError:
        raise InputError(
            f'{node.get_name()}: message_type is {sensor.message_type}, and {package} is not '
            'installed here; install that package, or have its driver publish PointStamped'
        ) from None
    topic = node.resolve_topic_name(sensor.source)

    def publishers() -> list[tuple[str, str]]:
        return [
            (node_of(info), info.topic_type) for info in node.get_publishers_info_by_topic(topic)
        ]

    driver.follow(topic, sensor.message_type, sensor.marker, publishers)
    group = MutuallyExclusiveCallbackGroup()
    node.create_subscription(kind, sensor.source, driver.take, ANY, callback_group=group)
