"""The outcome of a configuration under way, and of a stop, judged report by report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from remaster_ros.motion.actions import Settled, SupervisorRules
from remaster_ros.motion.following import ON_PATH_RAD, STANDING_S, Following, Seen
from remaster_ros.motion.settling import SettleDetector
from remaster_ros.motion.trajectory import Trajectory
from remaster_ros.types import FloatArray

PROBE_WAIT_S = 0.5
"""After its end a robot that copies commands has copied this one, s."""
MOVED_RAD = 0.02
"""An arm at rest that has moved by so much was not moved by a command, rad."""
ELSEWHERE = 'an emergency stop, or an arm less precise than arrive_tolerance?'

Outcome = tuple[Literal['', 'over', 'settled', 'failed', 'halted'], str]
"""The outcome, and why, as text; '' while it is under way."""
UNDER_WAY: Outcome = '', ''


@dataclass
class Visit:
    """The configuration under way: when it was sent (stamp) and must have arrived (robot time)."""

    solution: int  # Its number; negative where nothing is measured at the end
    following: Following
    detector: SettleDetector
    rules: SupervisorRules
    sent_stamp: float
    deadline: float
    settled: bool = False

    @property
    def trajectory(self) -> Trajectory:
        """Where it was sent."""
        return self.following.trajectory

    def judge(self, seen: Seen, rate: float) -> Outcome:
        """Return the outcome for an arm that is on its way, by a report."""
        detector, rules = self.detector, self.rules
        trajectory, elapsed = self.trajectory, self.following.elapsed_s(seen.time)
        settled = detector.update(seen.stamp, seen.q) == 'settled'
        arrived = elapsed > trajectory.duration_s + PROBE_WAIT_S
        if (arrived or settled) and np.array_equal(seen.q, trajectory.end):
            why = 'joint_states repeat what was commanded to the last bit: no measurement'
            return 'halted', f'{why}; switch the driver to measured positions'
        astray = self.following.update(seen, rate)
        if astray:
            return 'halted', astray
        if self.solution < 0:
            return ('over', '') if arrived else UNDER_WAY
        if settled:
            self.settled, self.deadline = True, seen.time + rules.answer_timeout_s
            return 'settled', ''
        if not self.following.reacted:
            # On a simulated clock that runs fast its time is over before a command is seen.
            return UNDER_WAY
        distance = float(np.max(np.abs(seen.q - trajectory.end)))
        stood_s = min(seen.time - seen.stands_since, elapsed - trajectory.duration_s)
        if distance > rules.settle.arrive_tolerance and stood_s >= rules.stall_s:
            # However near: an emergency stop in the last moment of a move looks like this.
            return 'halted', f'the robot stands {distance:.4f} rad from its target: {ELSEWHERE}'
        if seen.time > self.deadline:
            return 'failed', 'did not come to rest at its target in time'
        return UNDER_WAY

    def settled_at(self, seen: Seen) -> Settled:
        """Return the action that reports the arm as settled, by the report that completed it."""
        still_since = self.detector.still_since
        assert still_since is not None
        motion_s, settle_s = still_since - self.sent_stamp, seen.stamp - still_since
        return Settled(self.solution, seen.stamp, self.detector.mean, motion_s, settle_s)

    def judge_settled(self, seen: Seen, *, recorder_waits: bool) -> Outcome:
        """Return the outcome for an arm that must stand until the recorder answers."""
        moved = float(np.max(np.abs(seen.q - self.trajectory.end)))
        if moved > MOVED_RAD:
            return 'halted', (
                f'the arm was moved by {np.rad2deg(moved):.1f} deg, and not by a command'
            )
        if recorder_waits:
            self.deadline = seen.time + self.rules.answer_timeout_s
        elif seen.time > self.deadline:
            return 'failed', 'the recorder did not answer in time'
        return UNDER_WAY


@dataclass
class Braking:
    """A stop under way."""

    end: FloatArray  # Where it leads, rad, (k,)
    # Robot time at which the arm has begun it, however late it reacts, s. Before that an arm may
    # stand where its move ended.
    begins: float
    over: float  # Robot time at which it has come to its end, s
    deadline: float  # Robot time until which it must stand there, s
    near: float  # How far from the end it may stand: what this arm was seen to stand off, rad
    patience_s: float  # `ASTRAY_S`, s of robot time

    def judge(self, seen: Seen) -> Outcome:
        """Return whether the arm has come to rest where its stop ends, by a report."""
        stands, off = seen.stands(seen.wall), float(np.max(np.abs(seen.q - self.end)))
        elsewhere = f'the arm stands {off:.4f} rad from where its stop led: an emergency stop?'
        if seen.time < self.over:
            stood_s = seen.time - max(seen.stands_since, self.begins)
            # Nearer to its end it comes to rest.
            early = stands and off > ON_PATH_RAD and stood_s >= self.patience_s
            return ('halted', elsewhere) if early else UNDER_WAY
        if stands and off <= self.near:
            return 'over', ''
        # Whether an arm stands shows in its reports after a while; one may still come to rest.
        if seen.time > max(self.deadline, seen.resumed + 2.0 * STANDING_S):
            return 'halted', elsewhere if stands else 'the arm goes on after a stop'
        return UNDER_WAY
