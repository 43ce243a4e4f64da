# SPDX-License-Identifier: Apache-2.0
"""Which joint configuration an arm is sent to, when it may move at all, and when it is halted.

This is the state machine of the robot bridge: reports and their times are its input, actions are
its output; the states and all ways between them stand in `states`. *Wall* time is when something
arrived; silence is judged by it. *Robot* time is what has passed according to the stamps of
joint_states.

A motion ends in one of three ways. It reaches its end. A *stop* brakes the arm along the line
that it is on, and the configuration is commanded again later. After a *halt* the arm stays where
it is until a person calls `clear_halt`. Where it is not known whether the arm follows its path
(emergency stop, silence, reports that are not believed) nothing is commanded any more, because
the command would begin at a place where the arm is not.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from remaster_ros.motion.actions import (
    Action,
    Drive,
    Failed,
    Halted,
    PathAnswer,
    Renew,
    Stop,
    SupervisorRules,
)
from remaster_ros.motion.following import Seen
from remaster_ros.motion.interlocks import Interlocks
from remaster_ros.motion.joint_reports import JointReport, JointReports
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import MotionGate, MotionRefusedError, StartMovedError
from remaster_ros.motion.motion_under_way import MotionUnderWay
from remaster_ros.motion.move_queue import (
    NO_REFUSALS,
    NO_SHARES,
    NO_WAYPOINTS,
    PROBE,
    STANDING,
    WAY_OUT,
    MoveQueue,
    probe_path,
)
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.states import (
    ARM,
    HAS_VISIT,
    Arm,
    Event,
    Finding,
    Place,
)
from remaster_ros.types import FloatArray

DOUBT_S = 0.5
"""The arm is halted if reports are not believed for this long (wall time), s."""
REFUSED_IN_A_ROW = 12
"""The arm is halted if so many configurations could not be commanded and none between them was
reached: planner and bridge then have different models of the arm."""
MISSED_IN_A_ROW = 3
"""The arm is halted if the next piece of a move came too late so often, and no configuration was
reached between: else it would stop and go on without end."""
TOO_SLOW = (
    'the next piece of a move came too late {count} times in a row ({why}): see what holds up the '
    'host of the bridge, or joint_states on their way to it, for {held_s:.1f} s'
)
BEGINS = {PROBE: Event.PROBE, WAY_OUT: Event.LEAVE}
"""What a move is by its number; the others lead to a configuration."""


class ArmSupervisor:
    """State machine that leads an arm to the solutions of a pose in turn, and stops or halts it.

    The actions that a method returns have to be carried out in their order.

    Parameters
    ----------
    gate
        Every command comes from it.
    reports
        Judges the reports of the joints.
    rules
        See `SupervisorRules`.
    halted
        Why the arm was halted already before this process started; ''.
    end
        Where the last command led before this process started, rad or m, (k,); None if that
        is not known.

    Attributes
    ----------
    halted
        Why the arm stays where it is until a person clears the halt; '' if it is not halted.
    missed
        How often the next piece of a move came too late, so that the arm stopped on its way.
    why_missed
        Why it did last; '' before that.
    """

    def __init__(
        self,
        gate: MotionGate,
        reports: JointReports,
        rules: SupervisorRules,
        halted: str = '',
        end: FloatArray | None = None,
    ) -> None:
        if not gate.limits.units == reports.units == rules.units:
            raise ValueError('gate, reports and rules are not of the same joints')
        self.gate, self.reports, self.rules = gate, reports, rules
        self.halted = halted
        self._interlocks = Interlocks(rules.heartbeat_s, rules.resume_alone_s)
        self._queue = MoveQueue()
        self._motion = MotionUnderWay(gate, rules, end, Arm.HALTED if halted else Arm.STANDS)
        # Whether it may be elsewhere than reported, until a probe has led it there to its end.
        self._unsure = end is None
        self._wall = -np.inf
        self._keeps_stamps = rules.keeps_stamps
        self.missed = self._failures = self._refusals = 0
        # Why the next piece of the move was not sent when it was due; ''.
        self._why_not = self.why_missed = ''
        # Since a configuration was reached, or a person has gone on.
        self._missed_in_a_row = 0
        self._seen: Seen | None = None
        self._doubted_wall: float | None = None
        # What else came on joint_states, and when (wall time, s).
        self._others, self._others_wall = '', -np.inf

    # What comes in

    def planner_is(self, state: str, wall_s: float, run: str = '') -> list[Action]:
        """Process the planner's state; return the actions of `tick`.

        Any state but ``running`` is a reason not to move, which stops an arm on its way.
        ``run``: token of the collection run, '' if none. A run that replaces an earlier one
        shows that a person has called /remaster/collect: the counts of failures in a row are
        cleared, and what is known of the arm's place is doubted (`Finding.DOUBT`). ``wall_s``:
        now, wall time, s.
        """
        if self._interlocks.planner(state, run, wall_s):
            self._failures = self._refusals = self._missed_in_a_row = 0
            # A person may have moved the arm meanwhile.
            self._queue.found(Finding.DOUBT)
        return self.tick(wall_s)

    def recorder_waits(self, waiting_for: str, wall_s: float) -> list[Action]:
        """Process a sign of life of the recorder; return the actions of `tick`.

        ``waiting_for``: what it waits for (a required sensor, room on the disk), a reason not
        to move, which stops an arm on its way; '' if it waits for nothing. ``wall_s``: now, s.
        """
        why = f'waiting for {waiting_for}' if waiting_for else ''
        self._interlocks.note_alive('recorder', why, wall_s)
        return self.tick(wall_s)

    def plan(
        self,
        solutions: FloatArray,
        wall_s: float,
        waypoints: Mapping[int, FloatArray] = NO_WAYPOINTS,
        refused: Mapping[int, str] = NO_REFUSALS,
        shares: Mapping[int, FloatArray] = NO_SHARES,
    ) -> list[Action]:
        """Begin to visit the solutions of a pose, in their order; return actions.

        A move under way is stopped first; with m = 0 no solution follows. ``solutions``: rad
        or m, (m, k). By a solution's index, from 0: ``waypoints``: configurations on the way
        to it, (n, k); ``shares``: if the way is a curve, which begins at the first waypoint,
        the share of the curve at each waypoint, (n,); ``refused``: why the solution must not
        be commanded. ``wall_s``: now, wall time, s.
        """
        actions = self._stop('another pose' if len(solutions) else 'stopped', wall_s)
        actions += self._step(Event.NEW_POSE)
        self._queue.begin(solutions, waypoints, refused, shares)
        return actions + self.tick(wall_s)

    def answered(self, solution: int, wall_s: float) -> list[Action]:
        """Process the recorder's answer that a settled configuration is done; return actions.

        ``solution``: index in the pose's solutions of the configuration that was answered;
        ``wall_s``: now, wall time, s. If the arm is being measured there, the next solution
        follows; an answer for another solution changes nothing. The actions are those of
        `tick` either way.
        """
        actions: list[Action] = []
        visit = self._motion.visit
        measures = self.state is Arm.MEASURES
        if visit is not None and measures and visit.solution == solution:
            self._queue.next = solution + 1
            actions = self._step(Event.ANSWERED)
        return actions + self.tick(wall_s)

    def emergency(self, stopped: bool, wall_s: float) -> list[Action]:
        """Process whether the robot's safety circuit stops the arm; return the actions of `tick`.

        ``stopped``: if True, the arm is halted without a command ([] if it is halted already);
        if False, an emergency stop is no longer a reason not to move, but a halt remains until
        a person clears it. ``wall_s``: now, wall time, s.
        """
        self._interlocks.set('safety', 'the robot reports an emergency stop' if stopped else '')
        return self.tick(wall_s)

    def observe(self, name: str, trouble: str, wall_s: float) -> list[Action]:
        """Process the state of something other than the joints that must be right; return actions.

        ``name``: one of `interlocks.OBSERVED`; ``trouble``: what is wrong with it, '' for
        nothing; ``wall_s``: now, wall time, s. A trouble is a reason not to move. During a
        collection or a motion it halts the arm, braked first if possible, if ``name`` is
        'rivals' (other publishers of what moves the arm) or was right before. Otherwise it
        only stops the arm: some of these take a while to become right at first.
        """
        halts = name == 'rivals' or self._interlocks.was_right(name)
        self._interlocks.set(name, trouble)
        if trouble and halts and self._engaged and not self.halted:
            return self._halt_braking(trouble, wall_s)
        return self.tick(wall_s)

    def report(self, report: JointReport) -> list[Action]:
        """Process a report of the joints; return actions, those of `tick` included.

        A report that `JointReports.believes` refuses goes to `doubt`. A believed one is
        compared with the move or stop under way; if, during a collection or a motion, its
        stamp is more than `rules.heartbeat_s` of wall time after that of the last one, it
        halts the arm instead.
        """
        wall_s = report.wall_s
        if not self.reports.believes(report):
            jumped = self._seen is not None and self.reports.kind in ('too_fast', 'outside_limits')
            return self.doubt(self.reports.trouble, wall_s, jumped=jumped)
        self._doubted_wall = None
        gap = self._gap(report)
        self._seen = seen = Seen.after(self._seen, report, self.rules, self.reports.late_s)
        if gap:
            actions = self._halt(gap)
        else:
            waits = bool(self._interlocks.reason('recorder'))
            outcome = self._motion.judge(seen, self._rate, recorder_waits=waits)
            actions = self._conclude(*outcome, seen)
        self._interlocks.note_alive('robot', '', wall_s)
        return actions + self.tick(wall_s)

    def other_joints(self, why: str, wall_s: float) -> None:
        """Note a message on joint_states that has none of the arm's joints: a gripper's, say.

        ``why``: text of `trouble` while the arm's own reports are silent and such messages
        come. ``wall_s``: when the message came, s.
        """
        self._others, self._others_wall = why, wall_s

    def doubt(self, why: str, wall_s: float, *, jumped: bool = False) -> list[Action]:
        """Process a report that is not believed or not readable; if that lasts, halt a collection.

        It lasts if more than `DOUBT_S` has passed since the first such report, with no
        believed report between. Until then the actions are those of `tick`. After that a
        collection or a motion is halted, and with ``jumped`` an idle arm, too. If neither
        applies or the arm is halted already, the last report and the usual delay of reports
        are forgotten, to be learned anew, unless the planner is paused; the actions are those
        of `tick`.

        ``jumped``: whether the arm was reported at a place that it cannot have reached;
        ``why``: for people; ``wall_s``: when the report came, s.
        """
        if self._doubted_wall is None:
            self._doubted_wall = wall_s
        if wall_s - self._doubted_wall <= DOUBT_S:
            return self.tick(wall_s)
        self._interlocks.set('robot', why)
        if (self._engaged or jumped) and not self.halted:
            return self._halt(why)
        if not self._interlocks.paused:
            # Nothing moves, so that what is usual can be learned again: a driver was restarted, a
            # clock was set. In a pause it is not, or late reports would be usual afterwards.
            self.reports.forget()
            self._seen = None
            self._queue.found(Finding.DOUBT)
        return self.tick(wall_s)

    def path_found(self, number: int, answer: PathAnswer, wall_s: float) -> list[Action]:
        """Process the answer to the last `CheckPath`, and return actions.

        [] for an answer to an earlier request, or if no request is open; [] also if the arm
        may not move, or has moved since the request: the path is requested again later. With a
        path the move begins, if the gate admits it. Without one the configuration is refused
        and the next one follows; but if the arm stands where it must not, it is halted. If the
        request was only whether the arm may stand where it is, no move begins, and an answer
        without a path halts.

        ``number``: that of the `CheckPath`; ``wall_s``: now, wall time, s.
        """
        asked, seen = self._queue.asked(number), self._seen
        if self.state is not Arm.ASKS or asked is None:
            return []
        solution, start = asked
        actions = self._step(Event.CHECKED)
        if seen is None or self.blocked(wall_s) or not seen.stands(wall_s):
            return actions
        if self._motion.led.differs(start, seen.q):
            # It was moved since: it is asked again.
            return []
        if answer.path is None and answer.at_start:
            return self._halt(self._queue.offer(answer, self.gate.limits))
        if solution == STANDING and answer.path is not None:
            self._queue.found(Finding.FREE)
            return self.tick(wall_s)
        if answer.path is None:
            return self._give_up(solution, f'no free path: {answer.why}', wall_s)
        return self._drive(solution, answer.path, seen, wall_s)

    def clear_halt(self) -> str:
        """End the halt, on behalf of a person; return why that is refused, '' if it is not.

        Refused during an emergency stop, and without a halt. Other reasons not to move remain,
        and nothing moves before a person begins the collection again. If the arm is reported
        elsewhere than the last command led, a person must have been told so before, by the
        reason of the halt or by a first call, which is refused; the arm must still be reported
        there.
        """
        if self._interlocks.reason('safety'):
            return self._interlocks.reason('safety')
        if not self.halted:
            return 'the arm is not halted'
        seen = self._seen
        led = self._motion.led
        if seen is not None and seen.is_fresh(self._wall) and led.elsewhere(seen.q):
            if refusal := led.confirm(seen.q):
                return refusal
            self._unsure = True
        led.forget_question()
        self.halted = ''
        self._step(Event.CLEARED)
        self._interlocks.revoke('the halt was cleared')
        self._queue.clear_halt()
        # Reports that were not believed may be right now: the robot was mastered, its clock was
        # set. What is usual is learned again while the arm stands.
        self.reports.forget()
        self._seen, self._doubted_wall = None, None
        self._interlocks.set('robot', '')
        return ''

    def use_limits(
        self, limits: MotionLimits, wall_s: float, *, raised: bool = False
    ) -> list[Action]:
        """Use other limits from now on, and return actions; a move under way is stopped first.

        It is commanded again later. ``raised``: whether a limit is higher than before; then
        nothing moves before a person calls /remaster/collect. ``wall_s``: now, wall time, s.
        """
        actions = self._stop('other limits', wall_s)
        self.gate.limits = limits
        if raised:
            self._interlocks.revoke('a limit was raised')
        return actions + self.tick(wall_s)

    def given_up(self, why: str) -> list[Action]:
        """Halt, as the controller refuses the newest command, or does not go on with it.

        ``why``: its reason. An arm that is halted already stays so, without an action; if it
        was still braking, its stop is not watched any more.
        """
        # Where a stop was refused the arm is not judged by it any more.
        return self._step(Event.GIVEN_UP) if self.halted else self._halt(why, Event.GIVEN_UP)

    def fault(self, why: str, wall_s: float) -> list[Action]:
        """Halt, as this program has failed in a step, which may be half done.

        The arm is stopped first if it is known to follow its path; [] if it is halted already.
        ``why``: the fault, for people; ``wall_s``: now, wall time, s.
        """
        return [] if self.halted else self._halt_braking(why, wall_s)

    def interrupted(self, since_wall_s: float) -> None:
        """Process that no bridge was running since a time before this process was started.

        If that is longer ago than `resume_alone_s`, a person has to call /remaster/collect to
        go on with a run; see `Interlocks.interrupted`. ``since_wall_s``: wall time, s.
        """
        self._interlocks.interrupted(since_wall_s)

    def not_sent(self, command: Drive | Renew | Stop, wall_s: float) -> list[Action]:
        """Actions for a command that was not published, as this process was paused meanwhile.

        A move is decided again after all that arrived meanwhile is processed. A stop that was not
        sent halts: the arm goes on, and its present place is unknown. A renewal needs no action:
        the piece before it ends in a stop. ``wall_s``: now, wall time, s.
        """
        self._motion.take_back()
        if isinstance(command, Renew):
            # The piece before it ends in a stop, if none comes in time.
            return []
        if isinstance(command, Drive):
            return self._step(Event.MOVE_NOT_SENT)
        late_s = wall_s - command.wall_s
        return self._halt(
            f'{command.reason}; this process was paused for {late_s:.2f} s just then: nothing is '
            'commanded',
            Event.STOP_NOT_SENT,
        )

    def tick(self, wall_s: float) -> list[Action]:
        """Check the time; return actions that stop or halt the arm, or else the next of its work.

        An emergency stop halts, as does a robot that falls silent during a collection or a
        motion; another reason not to move (`blocked`) stops. Without any, the next piece of a
        move is sent, or the next move is prepared or begun. [] once halted. ``wall_s``: now,
        wall time, s.
        """
        self._wall = wall_s
        self._interlocks.look(wall_s)
        self._interlocks.look_at_interruption(wall_s)
        if self.halted:
            return []
        emergency = self._interlocks.reason('safety')
        if emergency:
            return self._halt(emergency)
        silent = self._interlocks.fell_silent('robot', wall_s)
        if silent:
            self._queue.found(Finding.DOUBT)
        if silent and self._engaged:
            return self._halt('; '.join(filter(None, (silent, self.trouble))))
        blocked = self.blocked(wall_s)
        if blocked:
            return self._stop(blocked, wall_s)
        return self._go_on_moving(wall_s) or self._go_on(wall_s)

    # What is reported

    @property
    def state(self) -> Arm:
        """State of the arm in the table `states.ARM`."""
        return self._motion.state

    @property
    def under_way(self) -> bool:
        """Whether a collection runs, or the arm may still move by a command of this program."""
        idle = self.state in (Arm.STANDS, Arm.HALTED)
        return self._interlocks.was_right('planner') or not idle

    @property
    def asks_for_collect(self) -> str:
        """Why nothing moves before a person calls /remaster/collect; '' if that is not needed."""
        return self._interlocks.asks_for_collect

    @property
    def end(self) -> FloatArray | None:
        """End of the last command, rad or m, (k,); None if it is not known.

        Also None while it is doubtful whether the arm is there, until a probe has ended.
        """
        return None if self._unsure else self._motion.led.end

    @property
    def next_end(self) -> FloatArray | None:
        """End of the next piece of a move that is sent in pieces, rad or m, (k,); else None."""
        return self._motion.next_end

    def use_stamps(self, *, kept: bool) -> None:
        """Send moves from now on with stamps or without, as in `SupervisorRules.keeps_stamps`.

        ``kept``: whether the controller keeps the stamps of trajectories.
        """
        self._keeps_stamps = kept

    @property
    def busy(self) -> bool:
        """Whether a move or probe is under way, or a settled configuration awaits its answer."""
        return self.state in HAS_VISIT

    @property
    def trouble(self) -> str:
        """Trouble with the joint reports (refused, silent, of other joints), or ''.

        Messages of other joints count while the arm's have been silent for `rules.heartbeat_s`.
        """
        limit = self.rules.heartbeat_s
        silent = self._interlocks.silence_s('robot', self._wall) > limit
        has_other_joints = silent and self._wall - self._others_wall <= limit
        return self._interlocks.reason('robot') or (self._others if has_other_joints else '')

    def report_age_s(self, wall_s: float) -> float:
        """Time since a report was believed, s; infinite if none was.

        ``wall_s``: now, wall time, s.
        """
        return self._interlocks.silence_s('robot', wall_s)

    def blocked(self, wall_s: float) -> str:
        """Why the arm must not move; '' if it may.

        A halt, else the first reason of `Interlocks.blocked`; ``wall_s``: now, wall time, s.
        """
        return self.halted or self._interlocks.blocked(wall_s)

    # Inside: reasons not to move

    @property
    def _rate(self) -> float:
        """Seconds of the robot per second of wall time; at least 1."""
        return max(self.reports.clock.rate, 1.0)

    @property
    def _engaged(self) -> bool:
        """Whether trouble with the robot halts: a collection, a move or a stop is under way.

        Of these only a collection needs a person's consent to count; a consent that is held is
        enough. A settled configuration that waits for its answer counts as a move.
        """
        return self._interlocks.collecting or self.busy or self.state is Arm.BRAKES

    def _gap(self, report: JointReport) -> str:
        """Reason to halt, if the arm was not observed for too long during its work; else ''.

        Work: a collection or a motion (`_engaged`). Too long: the stamps of ``report`` and of
        the last one differ by more than `rules.heartbeat_s` of wall time. If they differ by
        more than `max_gap_s`, the deadline of a move under way is put off by the difference.
        """
        if self._seen is None:
            return ''
        gap_s = report.stamp_s - self._seen.stamp
        if self._motion.visit is not None and gap_s > self.rules.settle.max_gap_s:
            self._motion.visit.deadline += gap_s
        too_long = gap_s / self._rate > self.rules.heartbeat_s
        if not too_long or not self._engaged or self.halted:
            return ''
        return f'the robot was not observed for {gap_s / self._rate:.1f} s'

    # Inside: the rest of a move

    def _go_on_moving(self, wall_s: float) -> list[Action]:
        """Action that sends the next piece of a move, in a list; [] if none is due or can be sent.

        None is sent if the arm is not seen to follow, or the gate refuses it: the piece that
        the controller has ends in a stop. When that stop is about to begin, the move counts as
        missed, and the stop is watched. ``wall_s``: now, s.
        """
        seen = self._seen
        if seen is None or self.state not in (Arm.LEAVES, Arm.MOVES):
            return []
        due = self._motion.due(seen, wall_s)
        if due == 'missed':
            # The arm is about to stop by itself; whoever may sends it on from where it stands.
            self._motion.end_piece(seen, wall_s, self._rate)
            self.missed += 1
            self._missed_in_a_row += 1
            self.why_missed = self._why_not or 'the host of the bridge is held up'
            self._interlocks.stopped_on_its_way(wall_s)
            return self._step(Event.MISSED)
        if due == 'renew':
            unseen = self._motion.unseen(seen, wall_s, self._rate)
            self._why_not = self._motion.lost(seen, wall_s) or unseen
        if due != 'renew' or self._why_not:
            return []
        try:
            return self._step(Event.RENEW, self._motion.renew(seen, wall_s))
        except MotionRefusedError as error:
            # What it has ends in a stop.
            self._why_not = str(error)
            return []

    # Inside: the next configuration

    def _go_on(self, wall_s: float) -> list[Action]:
        """Actions that lead to the next move of an arm that stands; [] if it does not stand.

        In this order: halt after `MISSED_IN_A_ROW` moves in a row whose next piece came too
        late, or if the arm is reported elsewhere than it was led; ask whether it may stand
        where it is; begin the probe, or a way out that a person has allowed; ask for the way
        to the next solution. Solutions that the planner has refused or that are outside the
        limits go to `_refuse`. ``wall_s``: now, s.
        """
        seen, queue = self._seen, self._queue
        if seen is None or self.state is not Arm.STANDS or not seen.stands(wall_s):
            return []
        if self._missed_in_a_row >= MISSED_IN_A_ROW:
            why = TOO_SLOW.format(
                count=self._missed_in_a_row, why=self.why_missed, held_s=self._motion.patience_s
            )
            self._missed_in_a_row = 0
            return self._halt(why)
        elsewhere = self._motion.led.elsewhere(seen.q)
        if elsewhere:
            self._motion.led.ask(seen.q)
            return self._halt(elsewhere)
        if queue.place in (Place.UNKNOWN, Place.PROBED):
            return self._step(Event.ASK, queue.ask(STANDING, seen.q, seen.q))
        if queue.place is Place.MAY_LEAVE or (
            queue.place is Place.FREE and queue.target is not None
        ):
            return self._drive(PROBE, probe_path(seen.q, self.gate.limits), seen, wall_s)
        if queue.place is Place.LEAVES_NEXT:
            return self._drive(WAY_OUT, queue.take_way_out(), seen, wall_s)
        actions: list[Action] = []
        while (target := queue.target) is not None and not self.halted:
            outside = queue.refused or self.gate.limits.outside(target)
            if not outside:
                ask = queue.ask(queue.next, seen.q, target)
                return [*actions, *self._step(Event.ASK, ask)]
            actions += self._refuse(queue.next, outside)
        return actions

    def _drive(self, solution: int, path: FreePath, seen: Seen, wall_s: float) -> list[Action]:
        """Actions that begin a move; [] if the arm has moved since its path was checked.

        ``solution``: its index, or `PROBE` or `WAY_OUT`. If the gate refuses the move, the
        actions are those of `_give_up`. ``wall_s``: now, s.
        """
        # A stamp that is not of the controller's clock would lead the arm to another time.
        self._motion.keeps_stamps = self._keeps_stamps and self.reports.is_on_time
        doubtful = None
        if solution == PROBE:
            doubtful = np.logical_or(seen.frozen(), self._unsure)
        try:
            drive = self._motion.begin(solution, path, seen, wall_s, self._rate, doubtful)
        except StartMovedError:
            # The arm has moved since the path was asked for: it is asked for again.
            return []
        except MotionRefusedError as error:
            return self._give_up(solution, str(error), wall_s)
        self._interlocks.note_moved()
        self._why_not = ''
        return self._step(BEGINS.get(solution, Event.MOVE), drive)

    def _give_up(self, solution: int, reason: str, wall_s: float) -> list[Action]:
        """Actions after a move that is refused: those of `_refuse` and `tick`, or a halt.

        A halt if it is no move to a solution. ``solution``: its index; negative for a probe, a
        way out, or the check of where the arm stands. ``reason``: for people; ``wall_s``: now,
        s.
        """
        if solution < 0:
            return self._halt(reason)
        actions = self._refuse(solution, reason)
        return [*actions, *self.tick(wall_s)]

    def _refuse(self, solution: int, reason: str) -> list[Action]:
        """Actions after a configuration was refused: `Failed`; the next configuration follows.

        After `REFUSED_IN_A_ROW` refusals, with none reached between, also a halt.
        ``solution``: its index; ``reason``: for people.
        """
        self._queue.next = solution + 1
        self._refusals += 1
        failed = self._step(Event.REFUSED, Failed(solution, reason))
        if self._refusals < REFUSED_IN_A_ROW:
            return failed
        return failed + self._halt(f'{self._refusals} configurations refused in a row: {reason}')

    # Inside: what becomes of the motion under way

    def _conclude(self, outcome: str, why: str, seen: Seen) -> list[Action]:
        """Actions after the outcome of a visit or a stop was judged by a report.

        ``outcome``: 'halted' halts; 'settled' gives `Settled`, and the counts of failures
        begin anew; 'failed' gives the actions of `_fail`; 'over' (a stop, a probe or a way out
        has ended) and '' (still under way) give []. ``why``: reason for people; ``seen``: the
        arm's state after the report.
        """
        visit = self._motion.visit
        if outcome == 'halted':
            return self._halt(why, Event.ASTRAY)
        if outcome == 'over':
            if visit is not None:
                self._queue.found(Finding.ENDED)
                self._unsure = False
            return self._step(Event.ENDED)
        if outcome == 'settled' and visit is not None:
            self._failures = self._refusals = self._missed_in_a_row = 0
            return self._step(Event.SETTLED, visit.settled_at(seen))
        return self._fail(visit.solution, why) if outcome == 'failed' and visit is not None else []

    def _fail(self, solution: int, reason: str) -> list[Action]:
        """Actions after a configuration was not reached, or not answered, in time: `Failed`.

        The next configuration follows. `rules.failures_in_a_row` that were not reached halt;
        one that has settled does not count. Its move is over by then, so that no stop is
        commanded. ``solution``: its index; ``reason``: for people.
        """
        if self.state is Arm.MOVES:
            self._failures += 1
            if self._failures >= self.rules.failures_in_a_row:
                return self._halt(f'{self._failures} configurations not reached: {reason}')
        self._queue.next = solution + 1
        return self._step(Event.FAILED, Failed(solution, reason))

    def _halt(self, reason: str, event: Event = Event.HALT) -> list[Action]:
        """Actions of a halt without a stop; `halted` keeps the reason of an earlier halt.

        ``event``: why, for the table `states.ARM`.
        """
        # Why it was halted first is what a person has to see to.
        self.halted = self.halted or reason
        return self._step(event, Halted(self.halted))

    def _halt_braking(self, reason: str, wall_s: float) -> list[Action]:
        """Actions that halt an arm; it is stopped first if it is known to follow its path.

        Known is an arm that is not `lost`; otherwise nothing is commanded. ``reason``: for people;
        ``wall_s``: now, s.
        """
        seen = self._seen
        if seen is not None and self.state in (Arm.LEAVES, Arm.MOVES):
            known = not self._motion.lost(seen, wall_s)
            stop = self._motion.stop(reason, seen, wall_s, self._rate) if known else None
            if stop is not None:
                self.halted = reason
                return self._step(Event.HALT_BRAKING, stop, Halted(reason))
        return self._halt(reason)

    def _stop(self, reason: str, wall_s: float) -> list[Action]:
        """Actions that stop an arm on its way; the configuration is commanded again later.

        [] if no move or way out is under way (a probe is not braked), or if the arm comes to
        rest at the end of its move without a command. If its place on the path is unknown, the
        arm is halted, and nothing is commanded. ``reason``: for people; ``wall_s``: now, s.
        """
        seen = self._seen
        if seen is None or self.state not in (Arm.LEAVES, Arm.MOVES):
            return self._step(Event.STOP)
        lost = self._motion.lost(seen, wall_s)
        if lost:
            return self._halt(f'{reason}; {lost}: nothing is commanded')
        stop = self._motion.stop(reason, seen, wall_s, self._rate)
        if stop is None:
            return self._step(Event.STOP_AT_END)
        return self._step(Event.STOP, stop)

    def _step(self, event: Event, *actions: Action) -> list[Action]:
        """Enter the state that `states.ARM` has for an event; return the given actions.

        It is a fault of this program if the table has no row for the event in this state, or
        if the row names other types of actions than those given. Then commands among them are
        taken back, the arm is halted, and `Halted` is the only action.
        """
        state = self.state
        then = ARM[state].get(event)
        if then is not None and tuple(map(type, actions)) == then.actions:
            self._motion.enter(then.state)
            return list(actions)
        if any(isinstance(action, Drive | Renew | Stop) for action in actions):
            self._motion.take_back()
        self.halted = self.halted or f'a fault of this program: "{event}" while the arm {state}'
        self._motion.enter(Arm.HALTED)
        return [Halted(self.halted)]
