# SPDX-License-Identifier: Apache-2.0
"""How long a collection still takes, from the configurations that are done."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

FEWEST = 3
"""Configurations before a time is stated."""
KEPT = 30
"""The last so many count: the ways get longer or shorter in the course of a tour."""


class Pace:
    """Time per configuration while the collection runs; pauses do not count."""

    def __init__(self) -> None:
        self._running_s = 0.0
        self._last_s: float | None = None
        self._done: int | None = None
        self._took_s: deque[float] = deque(maxlen=KEPT)
        self._since_s = 0.0

    def update(self, done: int, now_s: float, *, running: bool) -> None:
        """Take how far the collection is.

        Parameters
        ----------
        done
            Configurations with an outcome.
        now_s
            Of a clock that cannot be set, s.
        running
            Whether the arm may move.
        """
        if self._last_s is not None and running:
            self._running_s += max(now_s - self._last_s, 0.0)
        self._last_s = now_s
        if self._done is None or done < self._done:
            # The first figure, or another plan.
            self._done, self._since_s = done, self._running_s
            self._took_s.clear()
        elif done > self._done:
            each_s = (self._running_s - self._since_s) / (done - self._done)
            self._took_s.extend([each_s] * min(done - self._done, KEPT))
            self._done, self._since_s = done, self._running_s

    def left_s(self, left: int) -> float | None:
        """Return how long so many configurations take, s; None before enough are done."""
        if left <= 0:
            return 0.0
        if len(self._took_s) < FEWEST:
            return None
        return left * sum(self._took_s) / len(self._took_s)


def progress_text(counts: Mapping[str, Any], left_s: float | None) -> str:
    """Return how far a collection is, in a line; '' before it is planned.

    Parameters
    ----------
    counts
        As of `TourProgress.counts`.
    left_s
        Time that is left, s; None where it is unknown.
    """
    done, of = counts['configurations_done'], counts['configurations']
    if counts['phase'] != 'collection' or not of:
        return ''
    left = minutes_text(left_s)
    return (
        f'{done} of {of} configurations, {counts["poses_done"]} of {counts["poses"]} poses'
        f'{f", {left}" if left else ""}'
    )


def minutes_text(left_s: float | None) -> str:
    """Return a time that is left in words; '' where it is unknown."""
    if left_s is None:
        return ''
    if left_s < 90.0:
        return f'about {max(round(left_s / 10.0), 1) * 10} s left'
    return f'about {round(left_s / 60.0)} min left'
