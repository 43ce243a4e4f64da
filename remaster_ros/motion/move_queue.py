# SPDX-License-Identifier: Apache-2.0
"""Which move comes next: the configurations of a pose, and what must come before any of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from remaster_ros.motion.actions import CheckPath, PathAnswer
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import WAY_OUT_TOOL_SPEED
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.states import PLACE, Finding, Place, after
from remaster_ros.types import FloatArray

PROBE = -1
"""The number of the move before the first one."""
WAY_OUT = -2
"""The number of a way out of a contact or a margin."""
STANDING = -3
"""The number of a question about where the arm stands, before it is moved at all."""
PROBE_RAD = 1e-6
"""How far the probe goes, rad, a slide a quarter of a micrometre: less than the arm repeats, more
than the last bit."""
NO_WAYPOINTS: Mapping[int, FloatArray] = {}
NO_SHARES: Mapping[int, FloatArray] = {}
"""Shares of the curves through the waypoints, by solution; none for straight lines."""
NO_REFUSALS: Mapping[int, str] = {}


class MoveQueue:
    """The configurations of a pose in the order of visiting, and the last path that was asked for.

    Attributes: ``next``: the index of the next solution; ``place``: see `states.PLACE`; it
    says what must come before any solution.
    """

    def __init__(self) -> None:
        self._solutions: FloatArray | tuple[()] = ()
        self._waypoints, self._shares = NO_WAYPOINTS, NO_SHARES
        self._refused = NO_REFUSALS
        self.next = 0
        self._requests = 0
        self.place = Place.UNKNOWN
        # The solution whose path is asked for, and the question.
        self._asked: tuple[int, CheckPath] | None = None
        # Out of a contact or a margin: offered to the person who clears the halt, then allowed.
        self._offered: FreePath | None = None
        self._way_out: FreePath | None = None

    def begin(
        self,
        solutions: FloatArray,
        waypoints: Mapping[int, FloatArray],
        refused: Mapping[int, str],
        shares: Mapping[int, FloatArray] = NO_SHARES,
    ) -> None:
        """Begin another pose, with its first solution next; see `ArmSupervisor.plan`.

        ``waypoints``: on the way to a solution, ``refused``: why one is not visited, ``shares``:
        of a curve through the waypoints, each by the solution's index.
        """
        self._solutions, self._waypoints, self.next = solutions, waypoints, 0
        self._refused, self._shares = refused, shares

    def found(self, finding: Finding) -> None:
        """Process a finding about the arm's place, by the table `states.PLACE`."""
        self.place = after(PLACE, self.place, finding)

    def clear_halt(self) -> None:
        """Note that a person has cleared a halt, and so allowed a way out that was offered."""
        self._way_out, self._offered = self._offered, None
        self.found(Finding.CLEARED if self._way_out is None else Finding.ALLOWED)

    def take_way_out(self) -> FreePath:
        """Return the way out that is allowed, once; it is no longer allowed then.

        There must be one, else AssertionError.
        """
        path, self._way_out = self._way_out, None
        assert path is not None
        self.found(Finding.LEFT)
        return path

    @property
    def target(self) -> FloatArray | None:
        """Next configuration, rad or m, (k,); None after the last one."""
        return self._solutions[self.next] if self.next < len(self._solutions) else None

    @property
    def refused(self) -> str:
        """Why the next configuration was refused and must not be commanded; '' if it was not."""
        return self._refused.get(self.next, '')

    def ask(self, solution: int, start: FloatArray, target: FloatArray) -> CheckPath:
        """Return a request to check whether the way to a solution is free, with a new number.

        ``solution``: its index, or `STANDING`; ``start, target``: rad or m, (k,). The
        planner's waypoints to it are included. `asked` answers for the last request only.
        """
        self._requests += 1
        none = np.empty((0, len(target)))
        waypoints = self._waypoints.get(solution, none)
        shares = self._shares.get(solution, np.empty(0))
        asked = CheckPath(self._requests, start, target, waypoints, shares)
        self._asked = solution, asked
        return asked

    def asked(self, number: int) -> tuple[int, FloatArray] | None:
        """Return solution and start, (k,), of the last request of `ask` if it has this number.

        None if it has another one, or there was none.
        """
        if self._asked is None or self._asked[1].number != number:
            return None
        return self._asked[0], self._asked[1].start

    def offer(self, answer: PathAnswer, limits: MotionLimits) -> str:
        """Keep a way out for the person who clears the halt; return the reason of the halt.

        The reason names the contact, and the way out or that none is known. ``answer``: that
        the arm stands where it must not; ``limits``: of the arm, for the names and the units
        of its joints.
        """
        self._offered = answer.way_out
        stands = f'the arm stands where it must not: {answer.why}'
        if answer.way_out is None:
            return f'{stands}; no way out is known: move it by hand, then /remaster/clear_halt'
        way = np.max(np.abs(np.diff(answer.way_out.points, axis=0)), axis=0)
        joints = ', '.join(
            f'{name} by {limits.units.in_degrees(joint, way[joint], 1)}'
            for joint, name in enumerate(limits.names)
            if way[joint]
        )
        return (
            f'{stands}; /remaster/clear_halt and /remaster/collect let it leave slowly '
            f'(at most {WAY_OUT_TOOL_SPEED:g} m/s): {joints}'
        )


def probe_path(q: FloatArray, limits: MotionLimits) -> FreePath:
    """Return the way of a probe: from `q`, where the arm stands (rad or m, (k,)), by `PROBE_RAD`.

    Each joint moves towards the middle of its range, by that or, if it slides, `per_radian`
    times as much. Reports that are measured do not agree with its end to the last bit.
    """
    low, high = np.clip((limits.lower, limits.upper), -1e3, 1e3)
    step = PROBE_RAD * limits.units.per_radian
    return FreePath(np.array([q, q + np.where(2 * q > low + high, -step, step)]))
