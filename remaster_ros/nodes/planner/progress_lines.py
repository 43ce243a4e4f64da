# SPDX-License-Identifier: Apache-2.0
"""Progress of a collection as lines of the log."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.clock import Clock
from rclpy.node import Node

from remaster_ros.collection.pace import Pace, progress_text

LOOK_S = 1.0
EVERY_S = 20.0
"""Least interval between two lines while the state is unchanged, s of wall time."""


class ProgressLines:
    """Logs the progress of a collection while it runs, and its end."""

    def __init__(
        self,
        node: Node,
        clock: Clock,
        counts: Callable[[], Mapping[str, Any]],
        state: Callable[[], str],
    ) -> None:
        self._log, self._counts, self._state = node.get_logger(), counts, state
        self._pace, self._last, self._last_s = Pace(), ('', 0), float('-inf')
        node.create_timer(LOOK_S, self._look, clock=clock)

    def _look(self) -> None:
        """Log a line if the progress has changed, while running at most every `EVERY_S`.

        Timer callback. A change of the state is logged at once; nothing before a collection is
        planned.
        """
        now, counts, state = time.monotonic(), self._counts(), self._state()
        done, of = counts['configurations_done'], counts['configurations']
        self._pace.update(done, now, running=state == 'running')
        if (state, done) == self._last or (state == 'running' and now - self._last_s < EVERY_S):
            return
        changed, self._last = state != self._last[0], (state, done)
        text = progress_text(counts, self._pace.left_s(of - done) if state == 'running' else None)
        if text and (changed or state == 'running'):
            self._last_s = now
            self._log.info(f'{state}: {text}')
