# SPDX-License-Identifier: Apache-2.0
"""A world with one marker for the tests of OptiTrack: no arm; and ports that are free."""

from __future__ import annotations

import contextlib
import gc
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

RATE = 10.0
SENSOR = 'mocap'


class MarkerWorld:
    """A marker that circles in the sensor's frame, hidden while `visible` is False."""

    def __init__(self) -> None:
        self.visible = True
        self.faulty: dict[str, float] = {}
        self._started = time.monotonic()

    def now(self) -> float:
        return 100.0 + (time.monotonic() - self._started) * RATE

    def sleep_until(self, t: float) -> None:
        time.sleep(max(t - self.now(), 0.0) / RATE)

    def kept_up(self, sensor: str, t: float) -> None:
        pass

    def marker_in_sensor(self, sensor: str, t: float) -> np.ndarray:
        assert sensor == SENSOR
        return np.array([0.3 * np.cos(t), 0.3 * np.sin(t), 2.0])

    def line_of_sight(self, sensor: str, t: float) -> bool:
        return self.visible

    def camera(self, sensor: str) -> None:
        """Frames are sent at the time that they show."""

    def faults(self, device: str) -> dict[str, float]:
        return self.faulty


class SteppedWorld(MarkerWorld):
    """The same, with a time that the test sets."""

    def __init__(self) -> None:
        super().__init__()
        self.time = 100.0

    def now(self) -> float:
        return self.time


def free_port() -> int:
    """Return a UDP port that nothing uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


def eventually(condition: Callable[[], object], within_s: float = 20.0) -> bool:
    """Wait until something holds; tests say what, never how fast."""
    deadline = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


def _descriptors() -> set[str]:
    """Return this process's open files and sockets, none of them of objects that are no more."""
    gc.collect()
    found = set()
    for link in Path('/proc/self/fd').iterdir():
        # The folder itself was open to be listed.
        with contextlib.suppress(FileNotFoundError):
            found.add(f'{link.name} {link.readlink()}')
    return found


@contextlib.contextmanager
def nothing_left() -> Iterator[None]:
    """Fail where a thread, file or socket is left; what another test left may end meanwhile."""
    threads, descriptors = set(threading.enumerate()), _descriptors()
    yield
    assert set(threading.enumerate()) <= threads
    assert _descriptors() <= descriptors
