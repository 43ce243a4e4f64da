"""Which joint configuration an arm is sent to, when it may move at all, and when it is halted.

The rules of the robot bridge as a state machine: reports come in with their times, what is to be
done goes out as actions. Two times are told apart. *Wall* time is when something arrived, and
silence is judged by it. *Robot* time is what the stamps of joint_states say has passed.

Three things end a motion. Its end. A *stop*: the rest of the line that is under way is left along
the same line, and the configuration is commanded again later. A *halt*: the arm stays where it is
until a person calls `clear_halt`. Where it is not known that the arm follows its path (emergency
stop, silence, reports that are not believed) nothing is commanded any more: whatever were
commanded then would begin where the arm is not.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from remaster_ros.motion.actions import (
    Action,
    CheckPath,
    Drive,
    Failed,
    Halted,
    PathAnswer,
    Settled,
    Stop,
    SupervisorRules,
)
from remaster_ros.motion.following import Following, Seen, allowed_lag_s
from remaster_ros.motion.interlocks import Interlocks
from remaster_ros.motion.joint_reports import JointReport, JointReports
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import (
    WAY_OUT_TOOL_SPEED,
    MotionGate,
    MotionRefusedError,
    StartMovedError,
)
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.settling import SettleDetector
from remaster_ros.motion.visit import Braking, Visit
from remaster_ros.types import FloatArray

PROBE = -1
"""The number of the move before the first one."""
WAY_OUT = -2
"""The number of a way out of a contact or a margin."""
STANDING = -3
"""The number of a question about where the arm stands, before it is moved at all."""
PROBE_RAD = 1e-6
"""How far the probe goes, rad: less than the arm repeats, more than the last bit."""
DOUBT_S = 0.5
"""Reports that are not believed for so long (wall time) halt the arm, s."""
STOPPED_S = 1.0
"""After the end of a stop the arm stands within so much time, s; the lag comes on top."""
REFUSED_IN_A_ROW = 12
"""So many configurations that could not be commanded, and none between that was reached, and the
arm is halted: planner and bridge do not agree on the arm, and a collection would be over in
seconds."""
NO_WAYPOINTS: Mapping[int, FloatArray] = {}


class ArmSupervisor:
    """Visit the joint solutions of a pose one by one, and stop or halt when anything is wrong.

    Every method that returns actions wants them carried out in their order.

    Parameters
    ----------
    gate
        Every command comes from it.
    reports
        Judges the reports of the joints.
    rules
        See `SupervisorRules`.
    halted
        A halt that was there before this process was; ''.

    Attributes
    ----------
    halted
        Why the arm stays where it is until a person clears the halt; ''.
    """

    def __init__(
        self, gate: MotionGate, reports: JointReports, rules: SupervisorRules, halted: str = ''
    ) -> None:
        self.gate, self.reports, self.rules = gate, reports, rules
        self.halted = halted
        self._interlocks = Interlocks(rules.heartbeat_s)
        self._failures = self._refusals = 0
        self._paused = False
        self._must_probe = self._must_look = True
        self._seen: Seen | None = None
        self._doubted_wall: float | None = None
        self._braking: Braking | None = None
        self._offered: FreePath | None = None
        self._way_out: FreePath | None = None
        self._requests = 0
        # The number of the path that is asked for, and of the solution that it leads to.
        self._pending: tuple[int, int] | None = None
        self._visit: Visit | None = None
        self._solutions: FloatArray | tuple[()] = ()
        self._waypoints = NO_WAYPOINTS
        self._next = 0

    # What comes in

    def planner_is(self, state: str, wall_s: float, run: str = '') -> list[Action]:
        """Take the planner's state; anything but ``running`` stops the arm.

        Parameters
        ----------
        state
            As in its summary.
        wall_s
            Now, s.
        run
            Names the run of a collection: by another one a person's /remaster/collect is known.
        """
        reason = '' if state == 'running' else f'planner is {state}'
        self._paused = state == 'paused'
        if self._interlocks.planner(reason, run, wall_s):
            self._failures = self._refusals = 0
        return self.tick(wall_s)

    def recorder_waits(self, waiting_for: str, wall_s: float) -> list[Action]:
        """Take the recorder's sign of life, and which required sensor it misses ('' for none)."""
        why = f'waiting for {waiting_for}' if waiting_for else ''
        return self._note_alive('recorder', why, wall_s)

    def plan(
        self,
        solutions: FloatArray,
        wall_s: float,
        waypoints: Mapping[int, FloatArray] = NO_WAYPOINTS,
    ) -> list[Action]:
        """Take the solutions of a pose in the order of visiting; none to stop.

        Parameters
        ----------
        solutions
            rad, (m, k).
        wall_s
            Now, s.
        waypoints
            Number of a solution -> what to go through on the way to it, rad, (n, k).
        """
        actions = self._stop('another pose' if len(solutions) else 'stopped', wall_s)
        self._begin(solutions, waypoints)
        return actions + self.tick(wall_s)

    def answered(self, solution: int, wall_s: float) -> list[Action]:
        """Take the recorder's answer that it is done with a settled configuration."""
        visit = self._visit
        if visit is not None and visit.settled and visit.solution == solution:
            self._leave(visit)
        return self.tick(wall_s)

    def unreadable(self, why: str, wall_s: float) -> list[Action]:
        """Take a report that does not tell where the joints are."""
        return self._doubt(why, wall_s)

    def emergency(self, stopped: bool, wall_s: float) -> list[Action]:
        """Take the state of the robot's own safety circuit."""
        reason = 'the robot reports an emergency stop' if stopped else ''
        self._interlocks.set('safety', reason)
        return self.tick(wall_s)

    def observe(self, name: str, trouble: str, wall_s: float) -> list[Action]:
        """Take what else must be right before the arm may move.

        Parameters
        ----------
        name
            One of `interlocks.OBSERVED`: the link to the safety circuit, the controller, the
            node's clock, who else publishes what moves the arm. The last always halts a
            collection; the others where they were right before, and else only hold it: they take
            a while at the start.
        trouble
            What is wrong; '' for nothing.
        wall_s
            Now, s.
        """
        halts = name == 'rivals' or self._interlocks.was_right(name)
        self._interlocks.set(name, trouble)
        if trouble and halts and self._engaged and not self.halted:
            return self._halt(trouble, stop_wall_s=wall_s)
        return self.tick(wall_s)

    def report(self, report: JointReport) -> list[Action]:
        """Take a report of the joints."""
        wall_s = report.wall_s
        if not self.reports.believes(report):
            jumped = self._seen is not None and self.reports.kind in ('too_fast', 'outside_limits')
            return self._doubt(self.reports.trouble, wall_s, jumped=jumped)
        self._doubted_wall = None
        gap = self._gap(report)
        self._excuse_gap(report)
        self._seen = seen = Seen.after(self._seen, report, self.rules, self.reports.late_s)
        actions: list[Action] = []
        visit = self._visit
        if gap:
            actions = self._halt(gap)
        elif visit is not None and visit.settled:
            waits = bool(self._interlocks.reason('recorder'))
            outcome = visit.judge_settled(seen, recorder_waits=waits)
            actions = self._conclude(visit, *outcome, seen)
        elif visit is not None:
            actions = self._conclude(visit, *visit.judge(seen, self._rate), seen)
        elif self._braking is not None:
            actions = self._watch_braking(self._braking, seen)
        return actions + self._note_alive('robot', '', wall_s)

    def path_found(self, number: int, answer: PathAnswer, wall_s: float) -> list[Action]:
        """Take the answer to a `CheckPath`; one that was asked before the last counts nothing."""
        request, seen = self._pending, self._seen
        if request is None or request[0] != number:
            return []
        self._pending = None
        if seen is None or self.blocked(wall_s) or not seen.stands(wall_s):
            return []
        solution = request[1]
        if answer.path is None and answer.at_start:
            return self._halt(self._offer(answer))
        if solution == STANDING:
            self._must_look = False
            return self.tick(wall_s)
        if answer.path is None:
            return self._give_up(solution, f'no free path: {answer.why}', wall_s)
        return self._drive(solution, answer.path, seen, wall_s)

    def clear_halt(self) -> str:
        """Take a person's word that the arm may be moved again; return why not, '' if so.

        What stands in the way of a motion still does; nothing moves before the collection is
        begun again.
        """
        if self._interlocks.reason('safety'):
            return self._interlocks.reason('safety')
        if not self.halted:
            return 'the arm is not halted'
        self.halted = ''
        self._interlocks.must_collect = True
        self._must_probe = self._must_look = True
        self._way_out, self._offered = self._offered, None
        # What was not believed may be the truth now: a robot that was mastered, a clock that was
        # set. It is learned anew while the arm stands.
        self.reports.forget()
        self._seen, self._doubted_wall, self._braking = None, None, None
        self._interlocks.set('robot', '')
        return ''

    def use_limits(self, limits: MotionLimits, wall_s: float) -> list[Action]:
        """Use other limits from now on; a move under way is stopped and commanded again."""
        actions = self._stop('other limits', wall_s)
        self.gate.limits = limits
        return actions + self.tick(wall_s)

    def not_sent(self, command: Drive | Stop, wall_s: float) -> list[Action]:
        """Take that a command was not published: this process was paused since it was decided.

        A move is asked for again when all that came in meanwhile was taken; an arm that was to be
        stopped goes on, and where it is now is not known.
        """
        if isinstance(command, Drive):
            self._visit = None
            return []
        self._braking = None
        late_s = wall_s - command.wall_s
        return self._halt(
            f'{command.reason}; this process was paused for {late_s:.2f} s just then: nothing is '
            'commanded'
        )

    def tick(self, wall_s: float) -> list[Action]:
        """Look at the time: stop or halt on silence, go on when nothing is in the way."""
        self._interlocks.look(wall_s)
        if self.halted:
            return []
        emergency = self._interlocks.reason('safety')
        if emergency:
            return self._halt(emergency)
        silent = self._interlocks.fell_silent('robot', wall_s)
        if silent and self._engaged:
            return self._halt(silent)
        blocked = self.blocked(wall_s)
        return self._stop(blocked, wall_s) if blocked else self._go_on(wall_s)

    # What it tells

    @property
    def busy(self) -> bool:
        """Whether a configuration is under way."""
        return self._visit is not None

    @property
    def moving(self) -> bool:
        """Whether the arm is on its way."""
        return self._visit is not None and not self._visit.settled

    @property
    def trouble(self) -> str:
        """What is wrong with the reports of the joints; ''."""
        return self._interlocks.reason('robot')

    def report_age_s(self, wall_s: float) -> float:
        """Time since a report was believed, s; infinite if none was."""
        return self._interlocks.silence_s('robot', wall_s)

    def blocked(self, wall_s: float) -> str:
        """Why the arm must not move; '' if it may."""
        return self.halted or self._interlocks.blocked(wall_s)

    # Inside: reasons not to move

    @property
    def _rate(self) -> float:
        """Seconds of the robot per second of wall time; at least 1."""
        return max(self.reports.clock.rate, 1.0)

    @property
    def _engaged(self) -> bool:
        """Whether a collection is running: what is wrong with the robot then halts it."""
        return self._interlocks.collecting or self._visit is not None

    def _note_alive(self, name: str, reason: str, wall_s: float) -> list[Action]:
        self._interlocks.note_alive(name, reason, wall_s)
        return self.tick(wall_s)

    def _doubt(self, why: str, wall_s: float, *, jumped: bool = False) -> list[Action]:
        """Take a report that is not believed; where that goes on it halts a collection."""
        if self._doubted_wall is None:
            self._doubted_wall = wall_s
        if wall_s - self._doubted_wall <= DOUBT_S:
            return self.tick(wall_s)
        self._interlocks.set('robot', why)
        if (self._engaged or jumped) and not self.halted:
            return self._halt(why)
        if self._paused:
            # Amid a collection nothing is learned anew: reports that come late for good would be
            # the usual ones when it goes on.
            return self.tick(wall_s)
        # Nothing moves, so that what is usual can be learned anew: a driver that was restarted, a
        # clock that was set.
        self.reports.forget()
        self._seen = None
        return self.tick(wall_s)

    def _gap(self, report: JointReport) -> str:
        """Return in words that the arm was not observed for long while it was to be; ''."""
        if self._seen is None or not self._engaged or self.halted:
            return ''
        gap = (report.stamp_s - self._seen.stamp) / self._rate
        too_long = gap > self.rules.heartbeat_s
        return f'the robot was not observed for {gap:.1f} s' if too_long else ''

    def _excuse_gap(self, report: JointReport) -> None:
        """Give an arm that was not seen for a while as much longer to arrive."""
        if self._seen is None or self._visit is None:
            return
        gap = report.stamp_s - self._seen.stamp
        if gap > self.rules.settle.max_gap_s:
            self._visit.deadline += gap

    # Inside: the next configuration

    def _begin(self, solutions: FloatArray, waypoints: Mapping[int, FloatArray]) -> None:
        """Begin another pose."""
        self._solutions, self._waypoints, self._next = solutions, waypoints, 0
        self._visit, self._pending = None, None

    def _go_on(self, wall_s: float) -> list[Action]:
        """Ask for the way to the next solution of the pose, if the arm stands."""
        actions: list[Action] = []
        seen = self._seen
        idle = self._visit is None and self._pending is None and self._braking is None
        if seen is None or not idle or not seen.stands(wall_s):
            return actions
        if self._way_out is not None:
            path, self._way_out = self._way_out, None
            return self._drive(WAY_OUT, path, seen, wall_s)
        if self._must_look:
            return [self._ask(STANDING, seen.q, seen.q)]
        while self._next < len(self._solutions):
            target = self._solutions[self._next]
            outside = self.gate.limits.outside(target)
            if self._must_probe:
                return [*actions, self._ask(PROBE, seen.q, self._probe(seen.q))]
            if not outside:
                return [*actions, self._ask(self._next, seen.q, target)]
            actions += self._refuse(self._next, outside)
            if self.halted:
                break
        return actions

    def _ask(self, solution: int, start: FloatArray, target: FloatArray) -> CheckPath:
        self._requests += 1
        self._pending = self._requests, solution
        none = np.empty((0, len(target)))
        return CheckPath(self._requests, start, target, self._waypoints.get(solution, none))

    def _probe(self, q: FloatArray) -> FloatArray:
        """Return a place a micrometre away: no measurement comes back to it to the bit."""
        limits = self.gate.limits
        low, high = np.clip((limits.lower, limits.upper), -1e3, 1e3)
        return q + np.where(2 * q > low + high, -PROBE_RAD, PROBE_RAD)

    def _drive(self, solution: int, path: FreePath, seen: Seen, wall_s: float) -> list[Action]:
        try:
            admitted = self.gate.admit(path, seen.q)
        except StartMovedError:
            # It has moved since it was asked: asked again as soon as it stands.
            return []
        except MotionRefusedError as error:
            return self._give_up(solution, str(error), wall_s)
        trajectory, rules = admitted.trajectory, self.rules
        assert trajectory is not None
        time = seen.now(wall_s, self._rate)
        deadline = time + trajectory.duration_s + rules.settle.settle_s + rules.arrive_timeout_s
        detector = SettleDetector(trajectory.end, rules.settle)
        following = Following(trajectory, time, wall_s, rules)
        self._visit = Visit(solution, following, detector, rules, seen.stamp, deadline)
        return [Drive(solution, admitted, wall_s)]

    def _give_up(self, solution: int, reason: str, wall_s: float) -> list[Action]:
        """Go on with the next solution where the gate or the path refuses one."""
        if solution < 0:
            return self._halt(reason)
        actions = self._refuse(solution, reason)
        return [*actions, *self.tick(wall_s)]

    def _refuse(self, solution: int, reason: str) -> list[Action]:
        """Give up a configuration that is not commanded; halt where that goes on."""
        self._next = solution + 1
        self._refusals += 1
        failed = Failed(solution, reason)
        if self._refusals < REFUSED_IN_A_ROW:
            return [failed]
        return [failed, *self._halt(f'{self._refusals} configurations refused in a row: {reason}')]

    def _offer(self, answer: PathAnswer) -> str:
        """Remember a way out for the person who clears the halt; return what to tell them."""
        self._offered = answer.way_out
        stands = f'the arm stands where it must not: {answer.why}'
        if answer.way_out is None:
            return f'{stands}; no way out is known: move it by hand, then /remaster/clear_halt'
        way = np.max(np.abs(np.diff(answer.way_out.points, axis=0)), axis=0)
        names = self.gate.limits.names
        joints = ', '.join(
            f'{name} by {np.rad2deg(angle):.1f} deg' for name, angle in zip(names, way) if angle
        )
        return (
            f'{stands}; /remaster/clear_halt and /remaster/collect let it leave slowly '
            f'(at most {WAY_OUT_TOOL_SPEED:g} m/s): {joints}'
        )

    def _leave(self, visit: Visit) -> None:
        """Be done with a configuration: the next one follows."""
        self._visit, self._next = None, visit.solution + 1

    # Inside: the configuration under way

    def _conclude(self, visit: Visit, outcome: str, why: str, seen: Seen) -> list[Action]:
        """Do what follows from what became of the configuration."""
        if outcome == 'halted':
            return self._halt(why)
        if outcome == 'over':
            self._visit, self._must_probe = None, visit.solution != PROBE
        if outcome == 'settled':
            self._failures = self._refusals = 0
            detector = visit.detector
            assert detector.still_since is not None
            motion_s = detector.still_since - visit.sent_stamp
            settle_s = seen.stamp - detector.still_since
            return [Settled(visit.solution, seen.stamp, detector.mean, motion_s, settle_s)]
        if outcome == 'failed' and visit.settled:
            self._leave(visit)
            return [Failed(visit.solution, why)]
        return self._fail(visit, why) if outcome == 'failed' else []

    def _watch_braking(self, braking: Braking, seen: Seen) -> list[Action]:
        """See that a stop is a stop."""
        outcome, why = braking.judge(seen)
        if outcome:
            self._braking = None
        return self._halt(why) if outcome == 'halted' else []

    # Inside: ends of a motion

    def _fail(self, visit: Visit, reason: str) -> list[Action]:
        """Give a configuration up; halt where that happens too often in a row.

        Its trajectory has ended: there is nothing to be stopped.
        """
        self._failures += 1
        if self._failures >= self.rules.failures_in_a_row:
            why = f'{self._failures} configurations not reached: {reason}'
            return self._halt(why)
        self._leave(visit)
        return [Failed(visit.solution, reason)]

    def _halt(self, reason: str, stop_wall_s: float | None = None) -> list[Action]:
        """Halt; with a time the arm is stopped first, where it is known to follow its path."""
        visit, seen = self._visit, self._seen
        actions: list[Action] = []
        if (
            stop_wall_s is not None
            and visit is not None
            and seen is not None
            and not visit.settled
        ):
            known = not visit.following.lost(seen, stop_wall_s)
            actions = self._brake(visit, seen, reason, stop_wall_s) if known else []
        self.halted = reason
        self._visit, self._pending = None, None
        return [*actions, Halted(reason)]

    def _stop(self, reason: str, wall_s: float) -> list[Action]:
        """Stop an arm that is on its way; the configuration is commanded again later.

        An arm that has settled stands already: its reading goes on, only no command follows it.
        """
        visit, seen = self._visit, self._seen
        if visit is None or visit.settled or seen is None:
            return []
        lost = visit.following.lost(seen, wall_s)
        if lost:
            return self._halt(f'{reason}; {lost}: nothing is commanded')
        return self._brake(visit, seen, reason, wall_s)

    def _brake(self, visit: Visit, seen: Seen, reason: str, wall_s: float) -> list[Action]:
        """Leave the rest of the line along the line."""
        self._visit, self._pending = None, None
        if visit.following.has_ended(seen, wall_s, self._rate):
            return []
        admitted = self.gate.stop(*visit.following.window(seen, wall_s, self._rate))
        (stop,) = admitted.waypoints
        deadline = (
            seen.now(wall_s, self._rate)
            + stop.time_s
            + allowed_lag_s(self.rules, self._rate)
            + STOPPED_S
        )
        self._braking = Braking(stop.q, deadline)
        return [Stop(admitted, reason, wall_s)]
