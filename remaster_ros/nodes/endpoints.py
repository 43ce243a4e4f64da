"""What the node at the other end of a topic is called."""

from __future__ import annotations

from rclpy.topic_endpoint_info import TopicEndpointInfo

UNNAMED = '_NODE_NAME_UNKNOWN_'
"""What rmw calls a node whose name it has not received yet; its endpoints may be known before."""


def node_of(info: TopicEndpointInfo) -> str:
    """Return the full name of an endpoint's node, or words in its place where it is not known."""
    if info.node_name == UNNAMED:
        return 'a node that has just started'
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'
