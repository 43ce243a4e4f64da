"""Planning beside the callbacks of a node."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from remaster_ros.types import FloatArray

MOVED_RAD = 0.005
"""An arm this far from where a way begins, in any joint, gets another one."""

Result = TypeVar('Result')


class PlanningThread:
    """Does one thing at a time beside the callbacks: a stop must not wait for the planning."""

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._q: FloatArray = np.empty(0)
        self._what: object = None
        self._outcome: list[Callable[[], Any]] = []

    def ask(self, what: object, q: FloatArray, job: Callable[[], Result]) -> tuple[Result] | None:
        """Return what a job found, in a tuple; None while it works.

        Parameters
        ----------
        what
            Tells jobs apart: what another job, or an arm that has moved since, was asked for is
            forgotten.
        q
            Where the arm stands, rad, (k,).
        job
            Called in a thread of its own; what it raises is raised here.
        """
        if self._thread is None:
            self._start(what, q, job)
            return None
        if self._thread.is_alive():
            return None
        self._thread = None
        if self._what != what or np.max(np.abs(self._q - q)) > MOVED_RAD:
            self._start(what, q, job)
            return None
        return (self._outcome.pop()(),)

    def _start(self, what: object, q: FloatArray, job: Callable[[], Any]) -> None:
        self._what, self._q, self._outcome = what, q, []
        outcome = self._outcome

        def work() -> None:
            try:
                found = job()
                outcome.append(lambda: found)
            except Exception as error:
                # Raised where it is asked for; the name is gone after this block.
                problem = error
                outcome.append(lambda: _raise(problem))

        # A daemon: the node need not wait for it at its end.
        self._thread = threading.Thread(target=work, name='planning', daemon=True)
        self._thread.start()


def _raise(error: Exception) -> None:
    raise error
