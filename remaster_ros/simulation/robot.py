# SPDX-License-Identifier: Apache-2.0
"""Fake arm behind ros2_control: joint_trajectory_controller and joint_state_broadcaster.

As the real controller of Jazzy, it permutes a trajectory by joint name, drops a trajectory that it
cannot follow with a log line, an empty one too, and does not clamp to limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from remaster_ros.simulation.arm_motion import ServoPoint, from_now
from remaster_ros.simulation.faults import Numbers, in_outage
from remaster_ros.simulation.world import World
from remaster_ros.types import FloatArray

REPEATABILITY_RAD = 2e-5
"""Standard deviation with which a joint comes back to a commanded position. Here and below a joint
that slides has `SerialChain.per_radian` (0.25 m) times as much: 5 and 0.5 micrometres."""
ENCODER_RAD = 2e-6
"""Standard deviation of the noise of a reported joint position."""


class FakeArm:
    """Arm that follows trajectories in the hidden World and reports joint states.

    It is the only fake that moves the World. ``rng``: randomness of repeatability errors, of
    encoder noise and of the order of the reported joints.
    """

    def __init__(self, world: World, rng: np.random.Generator) -> None:
        self.world = world
        self.names = world.chain.joint_names
        self._rng = rng
        # joint_state_broadcaster reports in an order of its own; subscribers must permute by name.
        self._order = rng.permutation(len(self.names))
        self._commanded: tuple[float, FloatArray] | None = None
        self._braked = False
        self._last: tuple[float, list[str], FloatArray, FloatArray] | None = None
        self._reports = 0
        self._wrapped_once = False
        # Of the last trajectory: its stamp, s, and how far beside it the arm comes, rad, (k,).
        self._begun_s, self._stray = 0.0, np.zeros(len(self.names))

    def command(
        self, names: Sequence[str], points: Sequence[ServoPoint], start_s: float = 0.0
    ) -> str | None:
        """Follow a trajectory, in place of the present one; a refused one changes nothing.

        ``names, points``: as in the message; ``start_s``: stamp of the header, s, 0 for now.
        Returns the reason why the trajectory was dropped, for the log; None if the arm follows
        it. Each move misses its target by a random error, of 20 µrad standard deviation in
        each joint; consecutive trajectories with the same stamp are one move, with one error.
        """
        now = self.world.now()
        faults = self.world.faults('robot')
        reason = _fault_reason(faults, now) or self._refuse(names, points, start_s, now)
        if reason is not None:
            return reason
        columns = [list(names).index(name) for name in self.names]
        # Random error of a repeated position.
        per_radian = self.world.chain.per_radian
        if not start_s or start_s != self._begun_s:
            self._stray = self._rng.normal(0.0, REPEATABILITY_RAD, len(columns)) * per_radian
        # The error is the same for all parts of one move.
        stray, self._begun_s = self._stray, start_s
        # Faults: a wrong target, or a slow motion.
        slow, offset = faults.get('slow', 1.0), faults.get('elsewhere', 0.0) * per_radian
        waypoints = [
            ServoPoint(
                slow * point.time_s,
                point.q[columns] + stray + offset,
                None if point.velocity is None else point.velocity[columns] / slow,
            )
            for point in points
        ]
        begin = start_s or now
        remaining, reference = from_now(now, begin, waypoints)
        # Far from now, world time in a float does not tell points apart that nanoseconds do.
        times = [0.0, *(point.time_s for point in remaining)]
        if any(later <= earlier for earlier, later in pairwise(times)):
            return 'its points are too close in time for a stamp so far from now'
        self._commanded = begin + waypoints[-1].time_s, points[-1].q[columns]
        self.world.begin_motion(now, remaining, reference)
        return None

    def _refuse(
        self, names: Sequence[str], points: Sequence[ServoPoint], start_s: float, now: float
    ) -> str | None:
        """Reason why a trajectory is refused, in a controller's words; None if it is accepted.

        ``start_s``: stamp of the trajectory, s, 0 for at once; ``now``: present world time, s.
        """
        unknown = sorted(set(names) - set(self.names))
        missing = sorted(set(self.names) - set(names))
        if unknown or missing or len(names) != len(self.names):
            return f'incoming joints do not match: unknown {unknown}, missing {missing}'
        if not points:
            return 'the trajectory is empty'
        times = [point.time_s for point in points]
        if times[0] < 0.0 or (times[0] == 0.0 and not start_s):
            return 'time_from_start does not increase'
        if any(later <= earlier for earlier, later in pairwise(times)):
            return 'time_from_start does not increase'
        for point in points:
            for what, values in (('positions', point.q), ('velocities', point.velocity)):
                if values is None:
                    continue
                if len(values) != len(self.names):
                    return f'{len(values)} {what} for {len(self.names)} joints'
                if not np.all(np.isfinite(values)):
                    return 'a position or velocity is not finite'
        if points[-1].velocity is not None and np.any(points[-1].velocity != 0.0):
            return 'velocity of the last point is not zero'
        if start_s and start_s + times[-1] <= now:
            return 'the trajectory ends in the past'
        return None

    def joint_state(self) -> tuple[float, list[str], FloatArray, FloatArray] | None:
        """Present report: time (s), joint names in the arm's own order, positions, velocities.

        With encoder noise and the faults of the robot, rad and rad/s (m for slides), (k,), in
        the order of the names. None if nothing is reported: the robot is off, or a report is
        lost. An emergency stop brakes the arm in the first call.
        """
        now, faults = self.world.now(), self.world.faults('robot')
        if not _is_stopped(faults):
            self._braked = False
        elif not self._braked:
            self._brake(now)
        self._reports += 1
        lost = 'lost' in faults and self._reports % int(faults['lost']) != 0
        if lost or 'off' in faults or in_outage(faults.get('intermittent'), now):
            return None
        if 'repeated' in faults and self._last is not None:
            return self._last
        now -= faults.get('late', 0.0)
        q, velocity = self.world.encoders(now), self.world.reported(now)[1]
        per_radian = self.world.chain.per_radian
        q = q + self._rng.normal(0.0, ENCODER_RAD, len(q)) * per_radian
        if 'copy' in faults and self._commanded is not None and now >= self._commanded[0]:
            q = self._commanded[1]
        if 'drift' in faults:
            q = q + faults['drift'] * np.arcsin(np.sin(now)) * per_radian
        if 'nan' in faults:
            q = np.where(np.arange(len(q)) == 2, np.nan, q)
        if 'reordered' in faults:
            self._order = self._rng.permutation(len(q))
        q = q + self._wrap(faults)
        order = self._order
        prefix = 'other_' if 'renamed' in faults else ''
        names = [prefix + self.names[i] for i in order]
        stamp, q, velocity = now + faults.get('clock', 0.0), q[order], velocity[order]
        if self.world.dynamics is not None:
            stamp += self._rng.normal(0.0, self.world.dynamics.jitter_s)
        if 'frozen' in faults and self._last is not None:
            _, names, q, velocity = self._last
        self._last = stamp, names, q, velocity
        return self._last

    @property
    def reports_stop(self) -> bool:
        """Whether the safety circuit reports that it stops the arm."""
        return 'estop_reported' in self.world.faults('robot')

    @property
    def copies(self) -> int:
        """Number of copies of each report: 2 with the fault ``doubled``, else 1."""
        return 2 if 'doubled' in self.world.faults('robot') else 1

    def _wrap(self, faults: Numbers) -> FloatArray:
        """Error of the reported positions by a joint that is a turn off, rad, (k,); else zeros.

        By the fault ``wrapped`` in each call; by ``wrapped_once`` only in the first one with
        it.
        """
        turn = np.zeros(len(self.names))
        if 'wrapped' in faults:
            turn[int(faults['wrapped']) - 1] = 2 * np.pi
        if 'wrapped_once' in faults and not self._wrapped_once:
            turn[int(faults['wrapped_once']) - 1] = 2 * np.pi
        self._wrapped_once = 'wrapped_once' in faults
        return turn

    def _brake(self, now: float) -> None:
        """Brake the arm to a standstill within 0.15 s from ``now``, world time, s."""
        self._braked = True
        q, velocity = self.world.reported(now)
        braking_s = 0.15
        end = q + 0.5 * braking_s * velocity
        self.world.begin_motion(now, [ServoPoint(braking_s, end, np.zeros_like(end))])


def _is_stopped(faults: Numbers) -> bool:
    """Whether the faults contain an emergency stop, reported or not."""
    return 'estop' in faults or 'estop_reported' in faults


def _fault_reason(faults: Numbers, now: float) -> str:
    """Reason why a robot with these faults accepts no command at time `now`, s; '' if it does."""
    for name in ('off', 'dropped', 'estop', 'estop_reported'):
        if name in faults:
            return f'fault injected: {name}'
    return 'fault injected: intermittent' if in_outage(faults.get('intermittent'), now) else ''
