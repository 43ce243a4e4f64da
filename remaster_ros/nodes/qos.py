# SPDX-License-Identifier: Apache-2.0
"""Quality of service: profiles of the nodes, and publishers and subscribers that do not match."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

UNNAMED = '_NODE_NAME_UNKNOWN_'
"""What rmw calls a node whose name it has not received yet; its endpoints may be known before."""


def node_of(info: TopicEndpointInfo) -> str:
    """Return the full name of an endpoint's node; 'a node that has just started' if unknown."""
    if info.node_name == UNNAMED:
        return 'a node that has just started'
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def mismatch(offered: QoSProfile, wanted: QoSProfile) -> str:
    """Return why a subscriber gets no messages of a publisher by their QoS; '' if it does.

    ``offered``: the publisher's; ``wanted``: the subscriber's; reliability and durability count.
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
    """Return a text on the topics of a node that lose messages by QoS; '' if none does.

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
