"""Stands between two nodes and hands on what the one tells the other, as it is or spoiled."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Relay:
    """Hand messages on, as they are or spoiled.

    Attributes
    ----------
    spoil
        Returns what becomes of a message; None hands it on.
    delay_s
        How much later it is handed on, wall time.
    """

    def __init__(self, node, topic: str, kind) -> None:
        from remaster_ros.nodes.status import LEASED, RELIABLE

        self.spoil: Callable | None = None
        self.delay_s, self._last = 0.0, None
        self._publisher = node.create_publisher(kind, topic, LEASED)
        node.create_subscription(kind, f'bench/{topic}', self._take, RELIABLE)

    def _take(self, message) -> None:
        self._last = message
        if self.delay_s:
            threading.Timer(self.delay_s, self._send, [message]).start()
        else:
            self._send(message)

    def _send(self, message) -> None:
        self._publisher.publish(self.spoil(message) if self.spoil else message)

    def say_again(self) -> None:
        """Send the last message again."""
        self._send(self._last)
