"""Has the arm arrived, and has it stood still long enough? Time stamps are arguments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from remaster_ros.core.types import FloatArray

SettleState = Literal['moving', 'elsewhere', 'settling', 'settled']


@dataclass(frozen=True)
class SettleRules:
    """What counts as arrived and as still.

    Attributes
    ----------
    settle_s
        How long the arm must have stood still, s (3 s in Van Wyk et al., section III-A).
    arrive_tolerance
        Largest distance of any joint from its target, rad.
    still_tolerance
        Largest spread (maximum - minimum) of any reported joint position while still, rad.
    max_gap_s
        A longer silence of joint_states starts the waiting anew: nobody saw the arm then, s.
    """

    settle_s: float = 3.0
    arrive_tolerance: float = 2e-3
    still_tolerance: float = 2e-4
    max_gap_s: float = 0.5


class SettleDetector:
    """Judge from reported joint positions whether the arm stands still at its target.

    The arm is *still* since the first report from which on no joint's spread exceeds
    ``still_tolerance``; it has *settled* when that has lasted ``settle_s`` at the target.
    A slow drift breaks the spread and starts the waiting anew, unlike a velocity threshold.

    Parameters
    ----------
    target
        Commanded joint positions, rad, shape (k,).
    rules
        See `SettleRules`.
    """

    def __init__(self, target: FloatArray, rules: SettleRules) -> None:
        self.target = np.asarray(target, float)
        self.rules = rules
        self.still_since: float | None = None
        self.last_stamp: float | None = None
        self._low = self._high = self.target
        self._sum = np.zeros_like(self.target)
        self._count = 0

    def update(self, stamp: float, q: FloatArray) -> SettleState:
        """Take one report and return the state.

        Parameters
        ----------
        stamp
            Time of the report, s.
        q
            Reported joint positions in the order of the target, rad, (k,).
        """
        backwards_or_gap = self.last_stamp is not None and not (
            0.0 <= stamp - self.last_stamp <= self.rules.max_gap_s
        )
        self.last_stamp = stamp
        if not np.all(np.isfinite(q)):
            self.still_since = None
            return 'moving'
        low, high = np.minimum(self._low, q), np.maximum(self._high, q)
        if (
            self.still_since is None
            or backwards_or_gap
            or np.any(high - low > self.rules.still_tolerance)
        ):
            self.still_since = stamp
            low = high = np.array(q, float)
            self._sum = np.zeros_like(low)
            self._count = 0
        self._low, self._high = low, high
        self._sum = self._sum + q
        self._count += 1
        if stamp == self.still_since:
            return 'moving'
        waited = stamp - self.still_since >= self.rules.settle_s
        if np.max(np.abs(q - self.target)) > self.rules.arrive_tolerance:
            return 'elsewhere' if waited else 'moving'
        return 'settled' if waited else 'settling'

    @property
    def mean(self) -> FloatArray:
        """Mean reported position since the arm stands still, rad, (k,)."""
        return self._sum / max(self._count, 1)
