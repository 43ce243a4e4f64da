# SPDX-License-Identifier: Apache-2.0
"""Whether the arm has arrived and has stood still long enough. Time stamps are arguments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from remaster_ros.motion.joint_units import TURNING, JointUnits
from remaster_ros.types import FloatArray

SettleState = Literal['moving', 'elsewhere', 'settling', 'settled']


@dataclass(frozen=True)
class SettleRules:
    """Tolerances and times by which an arm has arrived and stands still.

    Of a joint that slides the tolerances are 0.25 m times as much (`JointUnits`), by default 0.5
    and 0.05 mm: as near as that at which a joint that turns has a point 0.25 m from its axis.
    """

    # How long the arm must have stood still, s (3 s in Van Wyk et al., section III-A)
    settle_s: float = 3.0
    arrive_tolerance: float = 2e-3  # Largest distance of any joint from its target, rad
    # Largest spread (maximum - minimum) of any reported joint position while still, rad
    still_tolerance: float = 2e-4
    # A longer gap in joint_states starts the waiting again: the arm was not observed then, s
    max_gap_s: float = 0.5
    units: JointUnits = TURNING


@dataclass(frozen=True)
class _Standstill:
    """Reports between which no joint moved: first and last stamp (s), range and sum."""

    since: float
    last: float
    low: FloatArray
    high: FloatArray
    total: FloatArray
    count: int


class SettleDetector:
    """Judge from reported joint positions whether the arm stands still at its target.

    The arm is *still* since the first report from which on no joint's spread exceeds
    ``still_tolerance``; it has *settled* when that has lasted ``settle_s`` and it is at the
    target. A slow drift breaks the spread and starts the waiting anew, unlike a velocity
    threshold.

    ``target``: commanded joint positions, rad or m, shape (k,).
    """

    def __init__(self, target: FloatArray, rules: SettleRules) -> None:
        self.target, self.rules = target, rules
        self._still: _Standstill | None = None

    def update(self, stamp: float, q: FloatArray) -> SettleState:
        """Process one report and return the state.

        Still for `settle_s`: 'settled' if within `arrive_tolerance` of the target, else
        'elsewhere'. Not still for so long: 'settling' if within it, else 'moving', whether or
        not the joints move. 'moving' also if a position is not finite; the standstill is
        forgotten then.

        ``stamp``: time of the report, s; ``q``: reported joint positions in the order of the
        target, rad or m, (k,).
        """
        if not np.all(np.isfinite(q)):
            self._still = None
            return 'moving'
        still = self._still = self._goes_on(stamp, q) or _Standstill(stamp, stamp, q, q, q, 1)
        waited = stamp - still.since >= self.rules.settle_s
        if self.rules.units.largest(q - self.target) > self.rules.arrive_tolerance:
            return 'elsewhere' if waited else 'moving'
        return 'settled' if waited else 'settling'

    def _goes_on(self, stamp: float, q: FloatArray) -> _Standstill | None:
        """Return the standstill extended by a report; None if it has ended or has not begun.

        It ends with a spread above `still_tolerance`, a gap above `max_gap_s` or an earlier stamp.
        """
        still = self._still
        if still is None or not 0.0 <= stamp - still.last <= self.rules.max_gap_s:
            return None
        low, high = np.minimum(still.low, q), np.maximum(still.high, q)
        if self.rules.units.largest(high - low) > self.rules.still_tolerance:
            return None
        return _Standstill(still.since, stamp, low, high, still.total + q, still.count + 1)

    @property
    def still_since(self) -> float | None:
        """Stamp of the first report of the standstill, s; None if there is none."""
        return None if self._still is None else self._still.since

    @property
    def farthest(self) -> float:
        """Largest distance of a report from the target since the arm stands still, rad.

        The arm must stand still. A slide counts as in `JointUnits`.
        """
        assert self._still is not None
        ends = np.array([self._still.low, self._still.high])
        return self.rules.units.largest(ends - self.target)

    @property
    def mean(self) -> FloatArray:
        """Mean reported position since the arm stands still, rad or m, (k,).

        The arm must stand still, else AssertionError.
        """
        assert self._still is not None
        return self._still.total / self._still.count
