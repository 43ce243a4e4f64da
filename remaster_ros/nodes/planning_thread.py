"""Planning beside the callbacks of a node."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

import numpy as np

from remaster_ros.types import FloatArray

MOVED_RAD = 0.005
"""An arm this far from where a way begins, in any joint, gets another one."""

Result = TypeVar('Result')


class PlanningThread:
    """Does one thing at a time beside the callbacks: a stop must not wait for the planning."""

    def __init__(self) -> None:
        self._q: FloatArray = np.empty(0)
        self._what: object = None
        self._future: Future[Any] | None = None

    def ask(self, what: object, q: FloatArray, job: Callable[[], Result]) -> tuple[Result] | None:
        """Return what a job found, in a tuple; None while it works.

        Parameters
        ----------
        what
            Identifies the job: the result of another job, or for an arm that has moved since, is
            forgotten.
        q
            Where the arm stands, rad, (k,).
        job
            Called in a thread of its own; what it raises is raised here.
        """
        future = self._future
        if future is not None and not future.done():
            return None
        is_same = self._what == what and np.max(np.abs(self._q - q)) <= MOVED_RAD
        if future is None or not is_same:
            self._start(what, q, job)
            return None
        self._future = None
        return (future.result(),)

    def _start(self, what: object, q: FloatArray, job: Callable[[], Any]) -> None:
        self._what, self._q = what, q
        future: Future[Any] = Future()
        self._future = future

        def work() -> None:
            try:
                future.set_result(job())
            except Exception as error:
                future.set_exception(error)

        # A daemon, which no executor's thread is: the node need not wait for it at its end.
        threading.Thread(target=work, name='planning', daemon=True).start()
