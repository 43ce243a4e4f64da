# SPDX-License-Identifier: Apache-2.0
"""A world with one reflector for the tests of the laser tracker: no arm, times as arguments."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

MARKER = np.array([2.0, 0.5, -0.3])
OTHER_BESIDE = np.array([0.0, 0.03, 0.14])
"""Another reflector of the tool, from the first one."""
RATE = 10.0


class ReflectorWorld:
    """A reflector at `path(t)` in the tracker's frame, hidden while `visible` is False."""

    def __init__(self, path: Callable[[float], np.ndarray] | None = None) -> None:
        self.path = path or (lambda t: MARKER)
        self.visible = True
        self.speed = lambda t: 0.0
        self.faulty: dict[str, float] = {}
        self._started = time.monotonic()

    def now(self) -> float:
        return 100.0 + (time.monotonic() - self._started) * RATE

    def sleep(self, seconds: float) -> None:
        time.sleep(max(seconds, 0.0) / RATE)

    def kept_up(self, sensor: str, t: float) -> None:
        pass

    def marker_in_sensor(self, sensor: str, t: float, marker: str = '') -> np.ndarray:
        return np.asarray(self.path(t), float) + (OTHER_BESIDE if marker else 0.0)

    def is_moving(self, t: float) -> bool:
        return self.joint_speed(t) > 1e-4

    def joint_speed(self, t: float) -> float:
        return self.speed(t)

    def line_of_sight(self, sensor: str, t: float, name: str = '') -> bool:
        return self.visible

    def faults(self, device: str) -> dict[str, float]:
        return self.faulty

    def warming_k(self, t: float) -> float:
        return 0.0


def across_and_along(error: np.ndarray, position: np.ndarray) -> tuple[float, float]:
    """Split an error into its lengths across the ray to `position` and along it."""
    ray = position / np.linalg.norm(position)
    along = float(error @ ray)
    return float(np.linalg.norm(error - along * ray)), along


def wait_for(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, 'waited in vain'
        time.sleep(0.005)
