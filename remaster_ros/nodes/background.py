# SPDX-License-Identifier: Apache-2.0
"""Slow work beside the callbacks of a node: path checks, planning, writing to a disk."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, TypeVar

import numpy as np
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node

from remaster_ros.motion.joint_units import TURNING, JointUnits
from remaster_ros.types import FloatArray

Result = TypeVar('Result')
Work = Callable[[], Any]
Then = Callable[[Any], object]

MOVED_RAD = 0.005
"""An arm this far from where a way begins, in any joint, gets another one (a slide 1.25 mm off).
"""


class Background:
    """One thread that does one thing after the other; a node's callbacks take the results."""

    def __init__(self, node: Node) -> None:
        self._work: SimpleQueue[tuple[Work, Then] | None] = SimpleQueue()
        self._results: deque[tuple[Then, Any]] = deque()
        self._guard = node.create_guard_condition(self._deliver)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def submit(self, work: Work, then: Then) -> None:
        """Do `work` in the thread, and call `then` with its result among the node's callbacks.

        The result is the exception where `work` raises one.
        """
        self._work.put((work, then))

    def close(self, timeout_s: float = 5.0) -> None:
        """End the thread when all is done, or after a time; results are no longer taken."""
        self._work.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (item := self._work.get()) is not None:
            work, then = item
            try:
                result = work()
            except Exception as error:  # Whatever it is, the node must go on.
                result = error
            self._results.append((then, result))
            # A node that has ended meanwhile takes no result, and has no guard any more.
            with contextlib.suppress(InvalidHandle):
                self._guard.trigger()

    def _deliver(self) -> None:
        while self._results:
            then, result = self._results.popleft()
            then(result)


class PlanningThread:
    """Does one thing at a time in the background: a stop must not wait for the planning."""

    def __init__(self, background: Background, units: JointUnits = TURNING) -> None:
        self._background, self._units = background, units
        self._q: FloatArray = np.empty(0)
        self._what: object = None
        self._works = False
        # What the last job gave, in a tuple; None where it was taken.
        self._found: tuple[Any] | None = None

    def ask(self, what: object, q: FloatArray, job: Callable[[], Result]) -> tuple[Result] | None:
        """Return what a job found, in a tuple, or raise what it raised; None while it works.

        `what` names the job: the result of another one, or for an arm that has moved since from
        `q`, rad or m, (k,), is forgotten.
        """
        if self._works:
            return None
        found, self._found = self._found, None
        if (
            found is None
            or self._what != what
            or not self._units.largest(self._q - q) <= MOVED_RAD
        ):
            self._what, self._q, self._works = what, q, True
            self._background.submit(job, self._take)
            return None
        if isinstance(found[0], Exception):
            raise found[0]
        return found

    def _take(self, result: Any) -> None:
        self._found, self._works = (result,), False
