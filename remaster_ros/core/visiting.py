"""Which joint configuration an arm is sent to, and when it may move at all; no ROS, no clocks.

The rules of the robot bridge as a state machine: reports come in with their times, what is to be
done goes out as actions. Two times are told apart. *Wall* time is when something was heard, and
silence is judged by it. *Robot* time is what the stamps of joint_states say has passed; a clock
that jumps adds at most `LONGEST_STEP_S`, so that no deadline comes early or never.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from remaster_ros.core.motion import MotionLimits, Move, Waypoint
from remaster_ros.core.settling import SettleDetector, SettleRules
from remaster_ros.core.types import FloatArray

LONGEST_STEP_S = 0.5
"""Robot time that passes at most between two reports, s."""
PROBE = -1
"""The number of the move before the first one."""
PROBE_RAD = 1e-6
"""How far it goes, rad: less than the arm repeats, more than the last bit."""
PROBE_WAIT_S = 0.5
"""After its end a robot that copies commands has copied this one, s."""
STANDING_S = 0.2
"""An arm that has not moved for so long stands; it must before it is sent anywhere, s."""
OLD_REPORT_S = 0.2
"""A report older than this (wall time) no longer tells where a moving arm is, s."""
LAG_S = 0.5
"""How far an arm may lag behind its trajectory and still follow it, s."""
ON_PATH_RAD = 0.05
"""How far an arm that follows its trajectory may be beside it, rad."""
EARLY_S = 0.1
"""An arm that stands so long before its trajectory ends has been stopped, s."""
REACTION_WALL_S = 0.5
"""Wall time that a command may take to reach the robot and be seen in its reports, s."""


@dataclass(frozen=True)
class Drive:
    """Send the arm along these waypoints."""

    solution: int
    waypoints: tuple[Waypoint, ...]


@dataclass(frozen=True)
class Stop:
    """Stop the arm now, for this reason."""

    waypoint: Waypoint
    reason: str


@dataclass(frozen=True)
class Settled:
    """The arm stands still at a configuration.

    Attributes
    ----------
    solution
        Its number.
    stamp_s
        Stamp of the report that completed the settling, s.
    q
        Mean reported joint positions since it stands still, rad, (k,).
    motion_s, settle_s
        How long it moved and how long it stood, s.
    """

    solution: int
    stamp_s: float
    q: FloatArray
    motion_s: float
    settle_s: float


@dataclass(frozen=True)
class Failed:
    """A configuration is given up."""

    solution: int
    reason: str


@dataclass(frozen=True)
class Halted:
    """The arm stays where it is until somebody starts the collection again."""

    reason: str


Action = Drive | Stop | Settled | Failed | Halted


@dataclass(frozen=True)
class VisitRules:
    """When to wait, to give up and to stop. Times in s.

    Attributes
    ----------
    settle
        What counts as arrived and still.
    arrive_timeout_s
        Beyond the expected motion and the settling: not arrived (robot time).
    answer_timeout_s
        Longest wait for the recorder's word on a settled configuration (robot time).
    heartbeat_s
        Longest silence of planner, recorder or robot (wall time).
    stall_s
        An arm that stands for so long and not at its target will not get there (robot time).
    attempts
        How often a command that the robot did not take is given.
    failures_in_a_row
        So many configurations that the robot did not reach, and it is halted.
    """

    settle: SettleRules = field(default_factory=SettleRules)
    arrive_timeout_s: float = 10.0
    answer_timeout_s: float = 180.0
    heartbeat_s: float = 3.0
    stall_s: float = 1.0
    attempts: int = 2
    failures_in_a_row: int = 3


@dataclass
class _Visit:
    """The configuration under way; times are robot times except `sent_wall`."""

    solution: int
    move: Move
    detector: SettleDetector
    sent: float
    sent_stamp: float
    sent_wall: float
    deadline: float
    settled: bool = False


class Visitor:
    """Visit the joint solutions of a pose one by one, and stop when anything is wrong.

    Every method that returns actions wants them carried out in their order.

    Parameters
    ----------
    limits
        Nothing outside them is ever commanded.
    rules
        See `VisitRules`.

    Attributes
    ----------
    halted
        Why the arm stays where it is until somebody starts the collection again; ''.
    trouble
        What is wrong with the reports of the joints; ''.
    """

    def __init__(self, limits: MotionLimits, rules: VisitRules) -> None:
        self.limits, self.rules = limits, rules
        self.halted = ''
        self._heard = dict.fromkeys(('planner', 'recorder', 'robot'), -np.inf)
        self._planner_state = 'unknown'
        self._waiting_for = ''
        self.trouble = ''
        self._emergency = False
        self._solutions: FloatArray | None = None
        self._next, self._attempt = 0, 1
        self._visit: _Visit | None = None
        self._failures = 0
        self._probed = False
        # What the reports say.
        self._q: FloatArray | None = None
        self._velocity = np.zeros(len(limits.lower))
        self._stamp = 0.0
        self._report_wall = 0.0
        self._time = 0.0
        self._stands_at = np.full(len(limits.lower), np.nan)
        self._stands_since = 0.0

    # What comes in

    def planner_says(self, state: str, wall_s: float) -> list[Action]:
        """Take the planner's state; anything but ``running`` stops the arm.

        The change from another state to ``running`` is somebody's word to go on after a halt.
        """
        self._heard['planner'] = wall_s
        if state == 'running' and self._planner_state != 'running':
            self.halted, self._failures = '', 0
        self._planner_state = state
        return self.tick(wall_s)

    def recorder_says(self, waiting_for: str, wall_s: float) -> list[Action]:
        """Take the recorder's sign of life, and which required sensor it misses ('' for none)."""
        self._heard['recorder'] = wall_s
        self._waiting_for = waiting_for
        return self.tick(wall_s)

    def plan(self, solutions: FloatArray, wall_s: float) -> list[Action]:
        """Take the solutions of a pose, rad, (m, k), in the order of visiting; none to stop."""
        actions = self._stop('another pose' if len(solutions) else 'stopped', wall_s)
        self._solutions, self._visit = solutions, None
        self._next, self._attempt = 0, 1
        return actions + self.tick(wall_s)

    def answered(self, solution: int, wall_s: float) -> list[Action]:
        """Take the recorder's word that it is done with a settled configuration."""
        visit = self._visit
        if visit is not None and visit.settled and visit.solution == solution:
            self._leave(visit)
        return self.tick(wall_s)

    def unreadable(self, why: str, wall_s: float) -> list[Action]:
        """Take a report that says nothing about the joints."""
        self._heard['robot'] = wall_s
        self.trouble = why
        return self.tick(wall_s)

    def emergency(self, stopped: bool, wall_s: float) -> list[Action]:
        """Take the word of the robot's own safety circuit."""
        self._emergency = stopped
        return self.tick(wall_s)

    def report(self, stamp_s: float, q: FloatArray, wall_s: float) -> list[Action]:
        """Take reported joint positions, rad, (k,)."""
        if not np.all(np.isfinite(q)):
            return self.unreadable('joint_states are not finite', wall_s)
        self._heard['robot'] = wall_s
        self.trouble = ''
        self._follow(stamp_s, q, wall_s)
        visit = self._visit
        actions: list[Action] = []
        if visit is not None and not visit.settled:
            actions = self._judge(visit, stamp_s, q, wall_s)
        elif visit is not None and self._waiting_for:
            visit.deadline = self._time + self.rules.answer_timeout_s
        elif visit is not None and self._time > visit.deadline:
            self._leave(visit)
            actions = [Failed(visit.solution, 'the recorder did not say what became of it')]
        return actions + self.tick(wall_s)

    def tick(self, wall_s: float) -> list[Action]:
        """Look at the time: stop on silence, go on when nothing is in the way."""
        if self._emergency and not self.halted:
            return self._halt('the robot says emergency stop', wall_s)
        blocked = self.blocked(wall_s)
        return self._stop(blocked, wall_s) if blocked else self._go_on(wall_s)

    # What it knows

    @property
    def busy(self) -> bool:
        """Whether a configuration is under way."""
        return self._visit is not None

    def report_age_s(self, wall_s: float) -> float:
        """Time since the robot was heard, s; infinite if it never was."""
        return wall_s - self._heard['robot']

    def blocked(self, wall_s: float) -> str:
        """Why the arm must not move; '' if it may."""
        limit = self.rules.heartbeat_s
        silent = [name for name, heard in self._heard.items() if wall_s - heard > limit]
        if self.halted:
            return self.halted
        if silent:
            return f'no sign of {", ".join(silent)} for {limit:g} s'
        if self._planner_state != 'running':
            return f'planner is {self._planner_state}'
        if self._waiting_for:
            return f'waiting for {self._waiting_for}'
        return self.trouble

    # Inside

    def _follow(self, stamp_s: float, q: FloatArray, wall_s: float) -> None:
        """Keep robot time, velocity and standstill."""
        passed = stamp_s - self._stamp
        seen_all_along = 0.0 < passed <= LONGEST_STEP_S
        self._velocity = np.zeros_like(q)
        if self._q is not None and seen_all_along:
            self._velocity = (q - self._q) / passed
        self._time += min(max(passed, 0.0), LONGEST_STEP_S)
        still = np.all(np.abs(q - self._stands_at) <= self.rules.settle.still_tolerance)
        if not (still and seen_all_along):
            self._stands_at, self._stands_since = q, self._time
        self._q, self._stamp, self._report_wall = q, stamp_s, wall_s

    def _go_on(self, wall_s: float) -> list[Action]:
        """Command the next solution of the pose, if the arm stands."""
        actions: list[Action] = []
        while self._visit is None and self._solutions is not None and self._q is not None:
            stands = self._time - self._stands_since >= STANDING_S
            if not stands or self._next >= len(self._solutions):
                break
            if not self._probed:
                return [self._probe(self._q, wall_s)]
            target = self._solutions[self._next]
            outside = self.limits.outside(target)
            if outside:
                actions.append(Failed(self._next, outside))
                self._next += 1
            else:
                move = self.limits.move(self._q, target)
                actions.append(self._drive(self._next, move, wall_s))
        return actions

    def _probe(self, q: FloatArray, wall_s: float) -> Drive:
        """Command where the arm stands, but for a micrometre: it must not come back to the bit."""
        low, high = np.clip((self.limits.lower, self.limits.upper), -1e3, 1e3)
        inward = np.where(2 * q > low + high, -PROBE_RAD, PROBE_RAD)
        return self._drive(PROBE, self.limits.move(q, q + inward), wall_s)

    def _drive(self, solution: int, move: Move, wall_s: float) -> Drive:
        rules = self.rules
        deadline = self._time + move.duration_s + rules.settle.settle_s + rules.arrive_timeout_s
        detector = SettleDetector(move.end, rules.settle)
        self._visit = _Visit(solution, move, detector, self._time, self._stamp, wall_s, deadline)
        return Drive(solution, move.waypoints())

    def _leave(self, visit: _Visit) -> None:
        """Be done with a configuration: the next one follows."""
        self._visit, self._next, self._attempt = None, visit.solution + 1, 1

    def _judge(self, visit: _Visit, stamp_s: float, q: FloatArray, wall_s: float) -> list[Action]:
        """Say what becomes of the configuration that the arm is on its way to."""
        detector, rules = visit.detector, self.rules
        arrived = self._time - visit.sent > visit.move.duration_s + PROBE_WAIT_S
        settled = detector.update(stamp_s, q) == 'settled'
        if (arrived or settled) and np.array_equal(q, visit.move.end):
            why = 'joint_states repeat what was commanded to the last bit: no measurement'
            return self._halt(f'{why}; switch the driver to measured positions', wall_s)
        if visit.solution == PROBE:
            if arrived:
                self._visit, self._probed = None, True
            return []
        if settled:
            assert detector.still_since is not None
            visit.settled, self._failures = True, 0
            visit.deadline = self._time + rules.answer_timeout_s
            motion_s = detector.still_since - visit.sent_stamp
            settle_s = stamp_s - detector.still_since
            return [Settled(visit.solution, stamp_s, detector.mean, motion_s, settle_s)]
        distance = float(np.max(np.abs(q - visit.move.end)))
        stood_s = self._time - max(self._stands_since, visit.sent)
        reacted = wall_s - visit.sent_wall > REACTION_WALL_S
        if distance > rules.settle.arrive_tolerance and stood_s >= rules.stall_s and reacted:
            return self._stalled(visit, q, distance, wall_s)
        if self._time > visit.deadline:
            return self._fail(visit, 'did not come to rest at its target in time', wall_s)
        return []

    def _stalled(
        self, visit: _Visit, q: FloatArray, distance: float, wall_s: float
    ) -> list[Action]:
        """The arm stands, and not where it was sent."""
        if np.max(np.abs(q - visit.move.start)) <= self.rules.settle.arrive_tolerance:
            if self._attempt < self.rules.attempts:
                self._visit, self._attempt = None, self._attempt + 1
                return []
            return self._halt('the robot does not take commands: see its controller', wall_s)
        if self._stands_since - visit.sent < visit.move.duration_s - EARLY_S:
            why = 'the robot stopped on its way: an emergency or protective stop?'
            return self._halt(why, wall_s)
        return self._fail(visit, f'arrived elsewhere: {distance:.4f} rad off', wall_s)

    def _fail(self, visit: _Visit, reason: str, wall_s: float) -> list[Action]:
        """Give a configuration up; halt where that happens too often in a row."""
        self._failures += 1
        if self._failures >= self.rules.failures_in_a_row:
            return self._halt(f'{self._failures} configurations not reached: {reason}', wall_s)
        actions = self._stop(reason, wall_s)
        self._leave(visit)
        return [*actions, Failed(visit.solution, reason)]

    def _halt(self, reason: str, wall_s: float) -> list[Action]:
        self.halted = reason
        return [*self._stop(reason, wall_s), Halted(reason)]

    def _stop(self, reason: str, wall_s: float) -> list[Action]:
        """Stop an arm that is on its way; the configuration is commanded again later.

        An arm that has settled stands already: its reading goes on, only no command follows it.
        """
        visit = self._visit
        if visit is None or visit.settled or self._q is None:
            return []
        q, velocity = self._q, self._velocity
        age_s = wall_s - self._report_wall
        if age_s > OLD_REPORT_S and self._follows(visit):
            # It has gone on since; where it stood would be a way back at many times its speed.
            q, velocity = visit.move.at(self._time - visit.sent + age_s)
        self._visit, self._attempt = None, 1
        return [Stop(self.limits.stop(q, velocity), reason)]

    def _follows(self, visit: _Visit) -> bool:
        """Whether the last report was where the trajectory led."""
        assert self._q is not None
        time_s = self._time - visit.sent
        lags = np.linspace(0.0, LAG_S, 6)
        return any(
            np.max(np.abs(self._q - visit.move.at(time_s - lag)[0])) <= ON_PATH_RAD for lag in lags
        )
