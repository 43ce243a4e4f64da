# SPDX-License-Identifier: Apache-2.0
"""Slow work of a node in a thread beside its callbacks: path checks, planning, disk writes."""

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
"""Motion of any joint after which a path is planned again, rad (1.25 mm of a prismatic joint)."""


class Background:
    """Thread that runs one job after the other, and gives the results to a node's callbacks."""

    def __init__(self, node: Node) -> None:
        self._work: SimpleQueue[tuple[Work, Then] | None] = SimpleQueue()
        self._results: deque[tuple[Then, Any]] = deque()
        self._guard = node.create_guard_condition(self._deliver)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def submit(self, work: Work, then: Then) -> None:
        """Queue a job for the thread, and return; `then` is called later with the job's result.

        `then` runs in the node's executor, like any callback. If the job raises an exception,
        the result is that exception.
        """
        self._work.put((work, then))

    def close(self, timeout_s: float = 5.0) -> None:
        """End the thread after the jobs queued so far; wait for its end `timeout_s` at most.

        Jobs queued later never run. The thread is a daemon: what takes longer ends with the
        process.
        """
        self._work.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        """Thread: run queued jobs in order, store each result or exception.

        It ends at a None in the queue.
        """
        while (item := self._work.get()) is not None:
            work, then = item
            try:
                result = work()
            except Exception as error:  # Any error, since the node must go on.
                result = error
            self._results.append((then, result))
            # A node that has ended meanwhile has no guard condition any more.
            with contextlib.suppress(InvalidHandle):
                self._guard.trigger()

    def _deliver(self) -> None:
        """Call `then` with the result of every finished job, among the node's callbacks."""
        while self._results:
            then, result = self._results.popleft()
            then(result)


class PlanningThread:
    """Run one planning job at a time in the background, so that a stop need not wait for it."""

    def __init__(self, background: Background, units: JointUnits = TURNING) -> None:
        self._background, self._units = background, units
        self._q: FloatArray = np.empty(0)
        self._what: object = None
        self._is_working = False
        # Result of the last job in a tuple; None if it was fetched.
        self._result: tuple[Any] | None = None

    def ask(self, what: object, q: FloatArray, job: Callable[[], Result]) -> tuple[Result] | None:
        """Return a job's result in a tuple, or raise its exception; None while a job runs.

        To be called again and again: the first call starts `job` in the background, a later one
        with the same arguments fetches its result, once. ``what``: identifier of the job; ``q``:
        configuration of the arm, rad or m, (k,). A result of another job, or for an arm that has
        moved by more than `MOVED_RAD` since, is dropped, and `job` is started anew.
        """
        if self._is_working:
            return None
        result, self._result = self._result, None
        if (
            result is None
            or self._what != what
            or not self._units.largest(self._q - q) <= MOVED_RAD
        ):
            self._what, self._q, self._is_working = what, q, True
            self._background.submit(job, self._store)
            return None
        if isinstance(result[0], Exception):
            raise result[0]
        return result

    def _store(self, result: Any) -> None:
        """Keep a job's result (or exception) for `ask`, which may start another job then."""
        self._result, self._is_working = (result,), False
