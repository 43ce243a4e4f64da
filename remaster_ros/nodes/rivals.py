# SPDX-License-Identifier: Apache-2.0
"""Who else publishes on a topic that moves the arm, or that reports where it is.

The graph lists the publishers of a killed process for some 20 s more. Those with a liveliness
lease (ours have one) are distinguished from the living by the lease: where several are listed, a
subscription that requires the lease counts those that are alive. Publishers without one count as
long as they are listed: a driver that was killed is gone for good, or was started again, and then
a person has to look at the arm anyway.

On joint_states drivers of grippers and other devices publish joints of their own, as is usual in
ROS. Only messages that name a joint of the arm count, and those come from one publisher: each
numbers its messages, and where they do not increase from one to the next there are two of them.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.event_handler import QoSLivelinessChangedInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from remaster_ros.nodes.qos import node_of
from remaster_ros.nodes.status import LEASED

COUNT_WALL_S = 3.0
"""After so long the lease of whoever was killed has ended; wall time, s."""


class OnlyPublisher:
    """Check that a topic has at most `allowed` publishers (1 or 0), leaving out killed ones."""

    def __init__(self, node: Node, topic: str, message_type: Any, allowed: int = 1) -> None:
        self._node, self._type, self._allowed = node, message_type, allowed
        self._topic = node.resolve_topic_name(topic)
        self._counter: Subscription | None = None
        # Since when several are listed, all of them with a lease; wall time, s.
        self._several_wall: float | None = None
        self._alive = 0

    def trouble(self) -> str:
        """Sentence on the topic's publishers if there are more than allowed; '' if not.

        If any listed publisher has no liveliness lease, all that are listed count, at once. If
        all have one, those whose lease is alive count, and '' is returned for the first
        `COUNT_WALL_S` after too many were listed.
        """
        if self._node.count_publishers(self._topic) <= self._allowed:
            self._several_wall = None
            return ''
        listed = self._node.get_publishers_info_by_topic(self._topic)
        leased = [info for info in listed if _has_lease(info)]
        if len(leased) < len(listed):
            # One without a lease beside another one.
            return self._words(listed) if len(listed) > self._allowed else ''
        self._count()
        now = time.monotonic()
        if self._several_wall is None:
            self._several_wall = now
        known = now - self._several_wall > COUNT_WALL_S
        return self._words(listed) if known and self._alive + self._own() > self._allowed else ''

    def _own(self) -> int:
        """Return the number of this node's own publishers, whose leases are not counted.

        Fast DDS reports no lease of a node's own publishers.
        """
        return sum(publisher.topic_name == self._topic for publisher in self._node.publishers)

    def _count(self) -> None:
        """Subscribe, once, to count the living publishers of the topic by their leases.

        The subscription is kept for good: a new one would get no report from Fast DDS on
        publishers whose lease was seen before.
        """
        if self._counter is None:
            self._counter = self._node.create_subscription(
                self._type,
                self._topic,
                lambda message: None,
                LEASED,
                event_callbacks=SubscriptionEventCallbacks(
                    liveliness=self._on_liveliness, use_default_callbacks=False
                ),
            )

    def _on_liveliness(self, change: QoSLivelinessChangedInfo) -> None:
        """Keep the number of publishers whose lease is alive."""
        self._alive = change.alive_count

    def _words(self, listed: list[TopicEndpointInfo]) -> str:
        """Sentence on publishers that are too many on the topic, with their nodes.

        ``listed``: all that the ROS graph lists, those of killed processes included.
        """
        names = sorted(node_of(info) for info in listed)
        count = '1 publisher' if len(listed) == 1 else f'{len(listed)} publishers'
        may = 'one' if self._allowed else 'none'
        return (
            f'{count} on {self._topic}, where {may} may be: {", ".join(names)}; '
            'end the others (those of a killed process are listed for some 20 s)'
        )


def _has_lease(info: TopicEndpointInfo) -> bool:
    """Whether a publisher has a liveliness lease (of less than an hour)."""
    # Without a lease it lasts some hundred years.
    return bool(info.qos_profile.liveliness_lease_duration.nanoseconds < 3600 * 10**9)
