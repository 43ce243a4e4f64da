# SPDX-License-Identifier: Apache-2.0
"""Remaining time of a collection, by the finished configurations."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

FEWEST = 3
"""Fewest finished configurations for an estimate."""
KEPT = 30
"""Number of last configurations that count: motions get longer or shorter during a tour."""


class Pace:
    """Time per configuration while the collection runs; pauses do not count."""

    def __init__(self) -> None:
        self._running_s = 0.0
        self._last_s: float | None = None
        self._done: int | None = None
        self._durations_s: deque[float] = deque(maxlen=KEPT)
        self._since_s = 0.0

    def update(self, done: int, now_s: float, *, running: bool) -> None:
        """Record the progress of the collection.

        ``done``: number of configurations with an outcome; fewer than before begin anew;
        ``now_s``: time of a monotonic clock, s; ``running``: whether the arm may move: other time
        does not count.
        """
        if self._last_s is not None and running:
            self._running_s += max(now_s - self._last_s, 0.0)
        self._last_s = now_s
        if self._done is None or done < self._done:
            # This is the first number, or that of another plan.
            self._done, self._since_s = done, self._running_s
            self._durations_s.clear()
        elif done > self._done:
            each_s = (self._running_s - self._since_s) / (done - self._done)
            self._durations_s.extend([each_s] * min(done - self._done, KEPT))
            self._done, self._since_s = done, self._running_s

    def left_s(self, count: int) -> float | None:
        """Time of ``count`` more configurations, s; None before `FEWEST` are finished.

        At the mean pace of the last `KEPT`; 0 if none is left.
        """
        if count <= 0:
            return 0.0
        if len(self._durations_s) < FEWEST:
            return None
        return count * sum(self._durations_s) / len(self._durations_s)


def progress_text(counts: Mapping[str, Any], left_s: float | None) -> str:
    """Progress of a collection in a line; '' before it is planned.

    ``counts``: of `TourProgress.counts`; ``left_s``: remaining time, s, None if unknown.
    """
    done, total = counts['configurations_done'], counts['configurations']
    if counts['phase'] != 'collection' or not total:
        return ''
    remaining_time = minutes_text(left_s)
    return (
        f'{done} of {total} configurations, {counts["poses_done"]} of {counts["poses"]} poses'
        f'{f", {remaining_time}" if remaining_time else ""}'
    )


def minutes_text(left_s: float | None) -> str:
    """Remaining time in words: tens of seconds up to 90 s, then minutes; '' if unknown."""
    if left_s is None:
        return ''
    if left_s < 90.0:
        return f'about {max(round(left_s / 10.0), 1) * 10} s left'
    return f'about {round(left_s / 60.0)} min left'
