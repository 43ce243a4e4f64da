"""Which joint configuration an arm is sent to, and when it may move at all; no ROS, no clocks.

The rules of the robot bridge as a state machine: reports come in with their times, what is to be
done goes out as actions. Two times are told apart. *Wall* time is when something was heard, and
silence is judged by it. *Robot* time is what the stamps of joint_states say has passed; a clock
that jumps adds at most `LONGEST_STEP_S`, so that no deadline comes early or never.
"""

from __future__ import annotations

from collections.abc import Sequence
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
STANDING_S = 0.25
"""An arm that has not moved for so long stands; it must before it is sent anywhere, s."""
OLD_REPORT_S = 0.25
"""A report older than this (wall time) no longer tells where a moving arm is, s."""
LAG_S = 0.25
"""An arm that is not further from its trajectory than it goes in this time follows it, s."""
EARLY_S = 0.125
"""An arm that stands so long before its trajectory ends has been stopped, s."""


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
    reaction_s
        A command may take so long to reach the robot and be seen in its reports (wall time).
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
    reaction_s: float = 0.5
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


@dataclass(frozen=True)
class _Seen:
    """The last report: positions (rad), speeds (rad/s), stamp, wall time and robot time (s).

    And where, and since when in robot time, the arm has been standing.
    """

    q: FloatArray
    velocity: FloatArray
    stamp: float
    wall: float
    time: float
    stands_at: FloatArray
    stands_since: float


NAMES = ('planner', 'recorder', 'robot')
"""Who must be heard; what they say about themselves counts in this order."""


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
    """

    def __init__(self, limits: MotionLimits, rules: VisitRules) -> None:
        self.limits, self.rules = limits, rules
        self.halted = ''
        self._heard: dict[str, float] = {}
        # Why the arm must not move, by the word of each; '' if it may.
        self._words: dict[str, str] = {}
        self._failures = 0
        self._must_probe = True
        self._seen: _Seen | None = None
        self._begin(())

    # What comes in

    def planner_says(self, state: str, wall_s: float) -> list[Action]:
        """Take the planner's state; anything but ``running`` stops the arm.

        The change from another state to ``running`` is somebody's word to go on after a halt.
        """
        word = '' if state == 'running' else f'planner is {state}'
        if self._words.get('planner') and not word:
            self.halted, self._failures = '', 0
        return self._hear('planner', word, wall_s)

    def recorder_says(self, waiting_for: str, wall_s: float) -> list[Action]:
        """Take the recorder's sign of life, and which required sensor it misses ('' for none)."""
        return self._hear('recorder', f'waiting for {waiting_for}' if waiting_for else '', wall_s)

    def plan(self, solutions: FloatArray, wall_s: float) -> list[Action]:
        """Take the solutions of a pose, rad, (m, k), in the order of visiting; none to stop."""
        actions = self._stop('another pose' if len(solutions) else 'stopped', wall_s)
        self._begin(solutions)
        return actions + self.tick(wall_s)

    def answered(self, solution: int, wall_s: float) -> list[Action]:
        """Take the recorder's word that it is done with a settled configuration."""
        visit = self._visit
        if visit is not None and visit.settled and visit.solution == solution:
            self._leave(visit)
        return self.tick(wall_s)

    def unreadable(self, why: str, wall_s: float) -> list[Action]:
        """Take a report that says nothing about the joints."""
        return self._hear('robot', why, wall_s)

    def emergency(self, stopped: bool, wall_s: float) -> list[Action]:
        """Take the word of the robot's own safety circuit."""
        self._words['safety'] = 'the robot says emergency stop' if stopped else ''
        return self.tick(wall_s)

    def report(self, stamp_s: float, q: FloatArray, wall_s: float) -> list[Action]:
        """Take reported joint positions, rad, (k,)."""
        if not np.all(np.isfinite(q)):
            return self.unreadable('joint_states are not finite', wall_s)
        self._seen = seen = self._look(stamp_s, q, wall_s)
        visit = self._visit
        actions: list[Action] = []
        if visit is not None and not visit.settled:
            actions = self._judge(visit, seen)
        elif visit is not None and self._words.get('recorder'):
            visit.deadline = seen.time + self.rules.answer_timeout_s
        elif visit is not None and seen.time > visit.deadline:
            self._leave(visit)
            actions = [Failed(visit.solution, 'the recorder did not say what became of it')]
        return actions + self._hear('robot', '', wall_s)

    def tick(self, wall_s: float) -> list[Action]:
        """Look at the time: stop on silence, go on when nothing is in the way."""
        emergency = self._words.get('safety')
        if emergency and not self.halted:
            return self._halt(emergency, wall_s)
        blocked = self.blocked(wall_s)
        return self._stop(blocked, wall_s) if blocked else self._go_on(wall_s)

    # What it knows

    @property
    def busy(self) -> bool:
        """Whether a configuration is under way."""
        return self._visit is not None

    @property
    def trouble(self) -> str:
        """What is wrong with the reports of the joints; ''."""
        return self._words.get('robot', '')

    def report_age_s(self, wall_s: float) -> float:
        """Time since the robot was heard, s; infinite if it never was."""
        return self._silence_s('robot', wall_s)

    def blocked(self, wall_s: float) -> str:
        """Why the arm must not move; '' if it may."""
        limit = self.rules.heartbeat_s
        silent = [name for name in NAMES if self._silence_s(name, wall_s) > limit]
        if self.halted:
            return self.halted
        if silent:
            return f'no sign of {", ".join(silent)} for {limit:g} s'
        return next(filter(None, (self._words[name] for name in NAMES)), '')

    # Inside

    def _hear(self, name: str, word: str, wall_s: float) -> list[Action]:
        self._heard[name], self._words[name] = wall_s, word
        return self.tick(wall_s)

    def _silence_s(self, name: str, wall_s: float) -> float:
        return wall_s - self._heard[name] if name in self._heard else np.inf

    def _begin(self, solutions: Sequence[FloatArray] | FloatArray) -> None:
        """Begin another pose."""
        self._solutions, self._next, self._attempt = solutions, 0, 1
        self._visit: _Visit | None = None

    def _look(self, stamp_s: float, q: FloatArray, wall_s: float) -> _Seen:
        """Follow robot time, speed and standstill; a gap begins them anew."""
        last, time = self._seen, stamp_s
        if last is not None:
            passed = stamp_s - last.stamp
            time = last.time + min(max(passed, 0.0), LONGEST_STEP_S)
            if 0.0 < passed <= LONGEST_STEP_S:
                velocity = (q - last.q) / passed
                moved = np.abs(q - last.stands_at) > self.rules.settle.still_tolerance
                stands = (q, time) if np.any(moved) else (last.stands_at, last.stands_since)
                return _Seen(q, velocity, stamp_s, wall_s, time, *stands)
        return _Seen(q, q - q, stamp_s, wall_s, time, q, time)

    def _go_on(self, wall_s: float) -> list[Action]:
        """Command the next solution of the pose, if the arm stands."""
        actions: list[Action] = []
        seen = self._seen
        stands = seen is not None and seen.time - seen.stands_since >= STANDING_S
        while stands and self._visit is None and self._next < len(self._solutions):
            assert seen is not None
            target = self._solutions[self._next]
            outside = self.limits.outside(target)
            if self._must_probe:
                actions.append(self._drive(PROBE, self._probe(seen.q), wall_s))
            elif outside:
                actions.append(Failed(self._next, outside))
                self._next += 1
            else:
                actions.append(self._drive(self._next, self.limits.move(seen.q, target), wall_s))
        return actions

    def _probe(self, q: FloatArray) -> Move:
        """Return a move by a micrometre: no measurement comes back to its end to the bit."""
        low, high = np.clip((self.limits.lower, self.limits.upper), -1e3, 1e3)
        inward = np.where(2 * q > low + high, -PROBE_RAD, PROBE_RAD)
        return self.limits.move(q, q + inward)

    def _drive(self, solution: int, move: Move, wall_s: float) -> Drive:
        assert self._seen is not None
        time, rules = self._seen.time, self.rules
        deadline = time + move.duration_s + rules.settle.settle_s + rules.arrive_timeout_s
        detector = SettleDetector(move.end, rules.settle)
        self._visit = _Visit(solution, move, detector, time, self._seen.stamp, wall_s, deadline)
        return Drive(solution, move.waypoints())

    def _leave(self, visit: _Visit) -> None:
        """Be done with a configuration: the next one follows."""
        self._visit, self._next, self._attempt = None, visit.solution + 1, 1

    def _judge(self, visit: _Visit, seen: _Seen) -> list[Action]:
        """Say what becomes of the configuration that the arm is on its way to."""
        detector, rules, wall_s = visit.detector, self.rules, seen.wall
        under_way_s = seen.time - visit.sent
        reacted = wall_s - visit.sent_wall > rules.reaction_s
        arrived = under_way_s > visit.move.duration_s + PROBE_WAIT_S
        settled = detector.update(seen.stamp, seen.q) == 'settled'
        if (arrived or settled) and np.array_equal(seen.q, visit.move.end):
            why = 'joint_states repeat what was commanded to the last bit: no measurement'
            return self._halt(f'{why}; switch the driver to measured positions', wall_s)
        if visit.solution == PROBE:
            if arrived:
                self._visit, self._must_probe = None, False
            return []
        if settled:
            assert detector.still_since is not None
            visit.settled, self._failures = True, 0
            visit.deadline = seen.time + rules.answer_timeout_s
            motion_s = detector.still_since - visit.sent_stamp
            settle_s = seen.stamp - detector.still_since
            return [Settled(visit.solution, seen.stamp, detector.mean, motion_s, settle_s)]
        distance = float(np.max(np.abs(seen.q - visit.move.end)))
        stood_s = min(seen.time - seen.stands_since, under_way_s)
        if distance > rules.settle.arrive_tolerance and stood_s >= rules.stall_s and reacted:
            return self._stalled(visit, seen, distance)
        if seen.time > visit.deadline:
            return self._fail(visit, 'did not come to rest at its target in time', wall_s)
        return []

    def _stalled(self, visit: _Visit, seen: _Seen, distance: float) -> list[Action]:
        """Act on an arm that stands, and not where it was sent."""
        if np.max(np.abs(seen.q - visit.move.start)) <= self.rules.settle.arrive_tolerance:
            if self._attempt < self.rules.attempts:
                self._visit, self._attempt = None, self._attempt + 1
                return []
            return self._halt('the robot does not take commands: see its controller', seen.wall)
        if seen.stands_since - visit.sent < visit.move.duration_s - EARLY_S:
            why = 'the robot stopped on its way: an emergency or protective stop?'
            return self._halt(why, seen.wall)
        return self._fail(visit, f'arrived elsewhere: {distance:.4f} rad off', seen.wall)

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
        visit, seen = self._visit, self._seen
        if visit is None or visit.settled or seen is None:
            return []
        q, velocity = seen.q, seen.velocity
        age_s = wall_s - seen.wall
        if age_s > OLD_REPORT_S and self._follows(visit, seen):
            # It has gone on since; where it stood would be a way back at many times its speed.
            q, velocity = visit.move.at(seen.time - visit.sent + age_s)
        self._visit, self._attempt = None, 1
        return [Stop(self.limits.stop(q, velocity), reason)]

    def _follows(self, visit: _Visit, seen: _Seen) -> bool:
        """Whether the last report was where the trajectory led."""
        expected, _ = visit.move.at(seen.time - visit.sent)
        return bool(np.all(np.abs(seen.q - expected) <= LAG_S * self.limits.velocity))
