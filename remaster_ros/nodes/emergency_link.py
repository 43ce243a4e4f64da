# SPDX-License-Identifier: Apache-2.0
"""Link to the robot's own safety circuit: a std_msgs/Bool, true while it stops the arm."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from itertools import pairwise

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool

PERIODIC = 6
"""By so many messages it is judged whether they come regularly."""


class EmergencyLink:
    """Subscription to the state of the robot's safety circuit, and whether that has gone silent.

    ``topic``: of std_msgs/Bool; '' for no subscription; ``on_state``: called with the value of
    every message; ``silence_s``: if messages came regularly, at most this far apart, a silence
    that is longer than their longest interval by more than this is trouble, s of wall time.
    """

    def __init__(
        self, node: Node, topic: str, on_state: Callable[[bool], None], silence_s: float
    ) -> None:
        self._node, self._on_state, self._silence_s = node, on_state, silence_s
        self.topic = node.resolve_topic_name(topic) if topic else ''
        self._stamps: deque[float] = deque(maxlen=PERIODIC)
        if not topic:
            return
        # The last value of a publisher that keeps it, and whatever any publisher sends from now
        # on: one subscription cannot have both.
        for durability, reliability in (
            (DurabilityPolicy.TRANSIENT_LOCAL, ReliabilityPolicy.RELIABLE),
            (DurabilityPolicy.VOLATILE, ReliabilityPolicy.BEST_EFFORT),
        ):
            qos = QoSProfile(depth=50, durability=durability, reliability=reliability)
            node.create_subscription(Bool, self.topic, self._on_message, qos)

    def trouble(self) -> str:
        """Return why the state of the safety circuit is unknown; '' if it is known.

        Unknown if no message has come, no publisher is left, or the last `PERIODIC` messages
        came regularly (at most `silence_s` apart) and the silence since exceeds their longest
        interval by more than `silence_s`. '' without a topic.
        """
        if not self.topic:
            return ''
        if not self._stamps:
            return f'{self.topic} (emergency_stop_topic) is silent: nothing moves without it'
        if not self._node.count_publishers(self.topic):
            return f'{self.topic} (emergency_stop_topic) has no publisher any more'
        if len(self._stamps) == PERIODIC:
            longest = max(later - earlier for earlier, later in pairwise(self._stamps))
            silent_s = time.monotonic() - self._stamps[-1]
            if longest <= self._silence_s < silent_s - longest:
                return f'{self.topic} (emergency_stop_topic) has been silent for {silent_s:.1f} s'
        return ''

    def _on_message(self, message: Bool) -> None:
        """Keep the wall time of a message, and call `on_state` with its value."""
        self._stamps.append(time.monotonic())
        self._on_state(message.data)
