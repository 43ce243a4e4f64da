"""Endpoints that find each other and exchange nothing, because their QoS does not match."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from remaster_ros.nodes.endpoints import node_of


def mismatch(offered: QoSProfile, wanted: QoSProfile) -> str:
    """Return why a subscriber gets nothing of a publisher; '' where it does.

    Leases and deadlines are not looked at: `nodes.rivals` requires a lease that foreign publishers
    do not offer, in order to leave them out.
    """
    best_effort = offered.reliability == ReliabilityPolicy.BEST_EFFORT
    if best_effort and wanted.reliability == ReliabilityPolicy.RELIABLE:
        return 'publishes best-effort, wanted is reliable'
    volatile = offered.durability == DurabilityPolicy.VOLATILE
    if volatile and wanted.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        return 'publishes volatile, wanted is transient local'
    return ''


def mismatches(node: Node) -> str:
    """Return what a node's topics lose by QoS, as text; '' where nothing.

    By the graph, not by events of the middleware: rclpy looks at each event handler for every
    message, half of what a message costs.
    """
    found = set()
    for subscription in node.subscriptions:
        topic = subscription.topic_name
        for info in node.get_publishers_info_by_topic(topic):
            if why := mismatch(info.qos_profile, subscription.qos_profile):
                found.add(f'nothing of {topic} comes from {node_of(info)}: it {why}')
    for publisher in node.publishers:
        topic = publisher.topic_name
        for info in node.get_subscriptions_info_by_topic(topic):
            if why := mismatch(publisher.qos_profile, info.qos_profile):
                found.add(f'nothing of {topic} reaches {node_of(info)}: this node {why}')
    return '; '.join(sorted(found))
