# SPDX-License-Identifier: Apache-2.0
"""The one move or stop under way: how it begins, what becomes of it, how it is stopped."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from remaster_ros.motion.actions import Drive, Renew, Settled, Stop, SupervisorRules
from remaster_ros.motion.following import (
    ASTRAY_S,
    ON_PATH_RAD,
    STANDING_S,
    Following,
    Seen,
    allowed_lag_s,
)
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.led_last import LedLast
from remaster_ros.motion.motion_gate import START_RAD, MotionGate
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.pieces import (
    AHEAD_S,
    GUARD_S,
    JOINED_S,
    RENEWED_S,
    STEP_REST_S,
    STOP_AHEAD_S,
    Piece,
)
from remaster_ros.motion.settling import SettleDetector
from remaster_ros.motion.states import HAS_STOP, HAS_VISIT, Arm
from remaster_ros.motion.trajectory import RAMP_S, Trajectory
from remaster_ros.types import BoolArray, FloatArray

PROBE_WAIT_S = 0.5
"""After its end a robot that copies commands has copied this one, s."""
MOVED_RAD = 0.02
"""An arm at rest that has moved by so much was not moved by a command, rad; a slide by 5 mm."""
ELSEWHERE = 'an emergency stop, or an arm less precise than arrive_tolerance?'

Outcome = tuple[Literal['', 'over', 'settled', 'failed', 'halted'], str]
"""The outcome, and why, as text; '' while it is under way."""
UNDER_WAY: Outcome = '', ''
STOPPED_S = 1.0
"""After the end of a stop the arm stands within so much time, s; the lag comes on top."""
OTHER_PLACES = 2.0
"""An arm may stand so many times as far from its end as it was seen to elsewhere: a servo that
gives way under the arm's weight does so by another amount in every configuration."""


@dataclass
class Visit:
    """A move that was sent: its trajectory, when it was sent, and until when it must arrive."""

    solution: int  # Its number; negative where nothing is measured at the end
    following: Following
    detector: SettleDetector
    rules: SupervisorRules
    sent_stamp: float
    deadline: float

    @property
    def trajectory(self) -> Trajectory:
        """Trajectory that was sent to the controller, that of `following`."""
        return self.following.trajectory

    def judge(self, seen: Seen, rate: float) -> Outcome:
        """Return the outcome of a report, for an arm on its way to the end of the move.

        'halted' if it is off its path, stands for `stall_s` off its target after the move's
        time, or reports at the end the target to the last bit (an echo of the command);
        'settled' if it stands still at its target (`SettleDetector`), which sets the deadline
        of the recorder's answer; 'failed' after the deadline (this, and the halt after
        `stall_s`, only once the arm is seen to have left its start); 'over' `PROBE_WAIT_S`
        after the end of a probe or a way out, where nothing is measured; else UNDER_WAY.
        ``rate``: robot time per wall time.
        """
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
            self.deadline = seen.time + rules.answer_timeout_s
            return 'settled', ''
        if not self.following.reacted:
            # On a simulated clock that runs fast its time is over before a command is seen.
            return UNDER_WAY
        off = seen.q - trajectory.end
        stood_s = min(seen.time - seen.stands_since, elapsed - trajectory.duration_s)
        is_there = rules.units.largest(off) <= rules.settle.arrive_tolerance
        if not is_there and stood_s >= rules.stall_s:
            # However near: an emergency stop in the last moment of a move looks like this.
            text = rules.units.in_radians(off, 4)
            return 'halted', f'the robot stands {text} from its target: {ELSEWHERE}'
        if seen.time > self.deadline:
            return 'failed', 'did not come to rest at its target in time'
        return UNDER_WAY

    def set_back(self, by_s: float) -> None:
        """Shift the rest of the move and its deadline later by `by_s`, s; negative for earlier."""
        self.following.set_back(by_s)
        self.deadline += by_s

    def settled_at(self, seen: Seen) -> Settled:
        """Return the action that reports the arm as settled, by the report that completed it.

        The arm must stand still (`SettleDetector.still_since`).
        """
        still_since = self.detector.still_since
        assert still_since is not None
        motion_s, settle_s = still_since - self.sent_stamp, seen.stamp - still_since
        return Settled(self.solution, seen.stamp, self.detector.mean, motion_s, settle_s)

    def judge_settled(self, seen: Seen, *, recorder_waits: bool) -> Outcome:
        """Return the outcome of a report, for an arm that must stand until the recorder answers.

        'halted' if the arm is more than `MOVED_RAD` from its target, 'failed' if the answer is
        late, else UNDER_WAY. ``recorder_waits``: whether the recorder waits on purpose: then
        the deadline is `rules.answer_timeout_s` after this report.
        """
        moved, units = np.abs(seen.q - self.trajectory.end), self.rules.units
        if units.largest(moved) > MOVED_RAD:
            joint = units.farthest(moved)
            text = units.in_degrees(joint, float(moved[joint]), 1)
            return 'halted', f'the arm was moved by {text}, and not by a command'
        if recorder_waits:
            self.deadline = seen.time + self.rules.answer_timeout_s
        elif seen.time > self.deadline:
            return 'failed', 'the recorder did not answer in time'
        return UNDER_WAY


@dataclass
class Braking:
    """A stop under way: where and when it ends."""

    end: FloatArray  # Where it leads, rad or m, (k,)
    # Robot time at which the arm has begun it, however late it reacts, s. Before that an arm may
    # stand where its move ended.
    begins: float
    over: float  # Robot time at which it has come to its end, s
    deadline: float  # Robot time until which it must stand there, s
    near: float  # How far from the end it may stand: what this arm was seen to stand off, rad
    patience_s: float  # `ASTRAY_S`, s of robot time
    units: JointUnits

    def judge(self, seen: Seen) -> Outcome:
        """Return the outcome of a report for a braking arm.

        While the stop's time is not over: 'halted' if the arm has stood for `patience_s`, more
        than `ON_PATH_RAD` from the stop's end, else UNDER_WAY. After that: 'over' if it stands
        within `near` of the stop's end; 'halted' if it does not by the deadline, whether it
        stands elsewhere or moves; else UNDER_WAY. After a gap in the reports the deadline is
        at least 2 × `STANDING_S` after the first report that follows.
        """
        stands, way = seen.stands(seen.wall), seen.q - self.end
        off, text = self.units.largest(way), self.units.in_radians(way, 4)
        elsewhere = f'the arm stands {text} from where its stop led: an emergency stop?'
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


def _led_now(seen: Seen, wall_s: float) -> float:
    """Robot time now, s: that of the last report and the wall time since; for moves in pieces.

    The clock's rate is not used: a simulated clock that is faster than the wall's waits until
    each report is taken (`simulated_clock.LEADS`), so that it has not gone on at its rate
    since.
    """
    return seen.now(wall_s, 1.0)


class MotionUnderWay:
    """State of the arm, and the move or stop under way by the last command.

    ``gate``: every command comes from it; ``end``: where the last command led that was sent
    before this process was started, rad or m, (k,); None if that is not known; ``state``: to
    begin in. Attributes: ``state``: see `states.ARM`; ``led``: where the last command led;
    ``visit``: the move under way, also while it is measured at its end; ``braking``: the stop
    under way; None in the states without one.
    """

    def __init__(
        self, gate: MotionGate, rules: SupervisorRules, end: FloatArray | None, state: Arm
    ) -> None:
        self.gate, self.rules, self.state = gate, rules, state
        settle, limits = rules.settle, gate.limits
        self.led = LedLast(
            limits.names, rules.units, settle.arrive_tolerance, end, '/remaster/clear_halt'
        )
        # The farthest that the arm was reported from an end while it stood there, rad.
        self._stood_off = -np.inf
        self.visit: Visit | None = None
        self.braking: Braking | None = None
        # What the controller has of the move, and when it was sent, s since the move's start.
        # How moves are sent from now on, and how the one under way is.
        self.horizon_s, self.keeps_stamps = rules.horizon_s, rules.keeps_stamps
        self._horizon_s, self._keeps_stamps = 0.0, True
        self._piece: Piece | None = None
        self._piece_sent_s = 0.0
        self._piece_before: tuple[Piece | None, float] = None, 0.0
        # By how much the last command has set the rest of the move back, s.
        self._set_back_s = 0.0

    def enter(self, state: Arm) -> None:
        """Enter a state; `visit` and `braking` become None in the states without one."""
        self.state = state
        self.visit = self.visit if state in HAS_VISIT else None
        self.braking = self.braking if state in HAS_STOP else None

    @property
    def near(self) -> float:
        """Largest allowed distance of an arm at rest from the end of a command, rad.

        `still_tolerance` plus `OTHER_PLACES` (2) times the largest distance of a report from
        the target where the arm has settled so far: noise, and what the servo leaves. At most
        `arrive_tolerance`, which is also the value before the arm has settled anywhere.
        """
        settle = self.rules.settle
        if not np.isfinite(self._stood_off):
            return settle.arrive_tolerance
        off = settle.still_tolerance + OTHER_PLACES * self._stood_off
        return min(off, settle.arrive_tolerance)

    def begin(
        self,
        solution: int,
        path: FreePath,
        seen: Seen,
        wall_s: float,
        rate: float,
        doubtful: BoolArray | None = None,
    ) -> Drive:
        """Admit a move along a free path, and return the action that sends it.

        Sets `visit` and `led`; `state` is not changed. ``solution``: its index, negative for a
        probe or a way out; ``path``: from where the arm stands; ``seen``: the last report;
        ``wall_s``: now, s; ``rate``: robot time per wall time; ``doubtful``: for a probe,
        which joints may be elsewhere than reported, (k,), else None.

        Raises MotionRefusedError as `MotionGate.admit`; nothing is changed then.
        """
        if doubtful is None:
            admitted = self.gate.admit(
                path, seen.q, self.horizon_s, keeps_stamps=self.keeps_stamps
            )
        else:
            admitted = self.gate.admit_probe(path, seen.q, doubtful)
        trajectory, rules = admitted.trajectory, self.rules
        assert trajectory is not None
        time = seen.now(wall_s, rate)
        self._horizon_s, self._keeps_stamps = self.horizon_s, self.keeps_stamps
        piece = admitted.piece
        # The stop of a curve is a piece with the same stamp.
        in_pieces = trajectory.is_curve or (piece is not None and not piece.is_last)
        has_stamp = self._keeps_stamps and in_pieces
        if has_stamp:
            # Where the last report came late more time has passed than it tells.
            time = _led_now(seen, wall_s) + seen.late_s + AHEAD_S
        deadline = time + trajectory.duration_s + rules.settle.settle_s + rules.arrive_timeout_s
        detector = SettleDetector(trajectory.end, rules.settle)
        following = Following(trajectory, time, wall_s, rules)
        self.visit = Visit(solution, following, detector, rules, seen.stamp, deadline)
        self._take(admitted.piece, 0.0)
        self.led.lead_to(admitted.waypoints[-1].q)
        return Drive(solution, admitted, wall_s, time if has_stamp else 0.0)

    @property
    def next_end(self) -> FloatArray | None:
        """End of the next piece of a move that is sent in pieces, rad or m, (k,); else None.

        If the present piece is the last one, the end of that.
        """
        return None if self.visit is None or self._piece is None else self._piece.next_end

    @property
    def patience_s(self) -> float:
        """Usual time from when a next piece is due until `due` returns 'missed', s.

        In robot time. A long move is sent in pieces. With stamps a piece is due `RENEWED_S`
        after the last one was sent. Without, the time is `STEP_REST_S`, and counts from the
        planned end of the last step.
        """
        if not self._keeps_stamps:
            return STEP_REST_S
        return self._horizon_s - RAMP_S - GUARD_S - RENEWED_S

    def due(self, seen: Seen, wall_s: float) -> Literal['', 'renew', 'missed']:
        """Return 'renew' if the move's next piece has to be sent now, 'missed' if it is too late.

        '' if it is not due yet, if the move has no pieces, or if its last piece was sent. With
        stamps: due `RENEWED_S` after the present piece was sent, at the earliest `JOINED_S`
        after the move's start; missed from `GUARD_S` before the present piece leaves the
        trajectory (`Piece.cut_s`), usually to begin its stop. Without stamps: due when the arm
        stands at the end of the present step; missed when the planned rest there is over.
        ``seen``: the last report; ``wall_s``: now, s.
        """
        piece, visit = self._piece, self.visit
        if piece is None or visit is None or piece.is_last:
            return ''
        elapsed_s = visit.following.elapsed_s(_led_now(seen, wall_s))
        if not self._keeps_stamps:
            if elapsed_s > piece.cut_s:
                return 'missed'
            off = self.rules.units.largest(seen.q - piece.end)
            is_there = elapsed_s > piece.end_s and off <= START_RAD
            return 'renew' if is_there and seen.stands(wall_s) else ''
        if elapsed_s > piece.cut_s - GUARD_S:
            return 'missed'
        return 'renew' if elapsed_s >= max(self._piece_sent_s + RENEWED_S, JOINED_S) else ''

    def renew(self, seen: Seen, wall_s: float) -> Renew:
        """Return the action that sends the next piece of the move; it becomes the present piece.

        Without stamps it is the next step, and the times of the rest of the move are shifted,
        so that the step begins now, sooner or later than planned. ``seen``: the last report;
        ``wall_s``: now, s.

        Raises MotionRefusedError as `MotionGate.renew` and `MotionGate.step`. There must be a
        move in pieces.
        """
        assert self.visit is not None
        assert self._piece is not None
        following = self.visit.following
        sent_s = following.elapsed_s(_led_now(seen, wall_s))
        begins_s, by_s = following.sent, 0.0
        if self._keeps_stamps:
            admitted = self.gate.renew(sent_s, self._horizon_s)
        else:
            # The rest before it ends now.
            index, begins_s = self.visit.trajectory.starts_s.index(self._piece.cut_s), 0.0
            admitted = self.gate.step(index, seen.q)
            by_s, sent_s = sent_s - self._piece.cut_s, self._piece.cut_s
            self.visit.set_back(by_s)
        self._take(admitted.piece, sent_s, by_s)
        self.led.lead_to(admitted.waypoints[-1].q)
        return Renew(admitted, wall_s, begins_s)

    def _take(self, piece: Piece | None, sent_s: float, set_back_s: float = 0.0) -> None:
        """Make a piece the present one, sent at `sent_s` of the motion; keep the previous one.

        ``set_back_s``: by how much it begins later than planned, s; for `take_back`.
        """
        self._piece_before = self._piece, self._piece_sent_s
        self._set_back_s = set_back_s
        self._piece, self._piece_sent_s = piece, sent_s

    def end_piece(self, seen: Seen, wall_s: float, rate: float) -> None:
        """Begin to watch the present piece end in its stop, as no further one is sent.

        Sets `braking`; there must be a visit and a piece. ``rate``: robot time per wall time.
        """
        assert self.visit is not None
        assert self._piece is not None
        begins = self.visit.following.sent + min(self._piece.cut_s, self._piece.end_s)
        over = self.visit.following.sent + self._piece.end_s + allowed_lag_s(self.rules, rate)
        self._brake(self._piece.end, max(begins, seen.now(wall_s, rate)), over, rate)

    def judge(self, seen: Seen, rate: float, *, recorder_waits: bool) -> Outcome:
        """Return the outcome of a report for the stop or the move that is under way.

        Of a stop by `Braking.judge`; of a move that is measured at its end (`Arm.MEASURES`) by
        `Visit.judge_settled`, of another move by `Visit.judge`; UNDER_WAY if there is neither.
        When the arm settles, its distance from the target is kept for `near`. ``seen``: the
        arm's state after the report; ``rate``: robot time per wall time; ``recorder_waits``:
        as of `Visit.judge_settled`.
        """
        if self.braking is not None:
            return self.braking.judge(seen)
        if self.visit is None:
            return UNDER_WAY
        if self.state is Arm.MEASURES:
            return self.visit.judge_settled(seen, recorder_waits=recorder_waits)
        outcome = self.visit.judge(seen, rate)
        if outcome[0] == 'settled':
            self._stood_off = max(self._stood_off, self.visit.detector.farthest)
        return outcome

    def lost(self, seen: Seen, wall_s: float) -> str:
        """Return why a moving arm's place on its path is unknown, or ''; see `Following.lost`.

        ``wall_s``: now, s. There must be a visit.
        """
        assert self.visit is not None
        return self.visit.following.lost(seen, wall_s)

    def unseen(self, seen: Seen, wall_s: float, rate: float) -> str:
        """Return why reports do not show a moving arm going on along its path, or ''.

        See `Following.unseen`; '' for a controller that does not keep stamps, whose arm stands.
        ``wall_s``: now, s; ``rate``: robot time per wall time. There must be a visit.
        """
        assert self.visit is not None
        if not self._keeps_stamps:
            # It stands where its next step begins.
            return ''
        return self.visit.following.unseen(seen, wall_s, rate)

    def stop(self, reason: str, seen: Seen, wall_s: float, rate: float) -> Stop | None:
        """Return the stop of a moving arm along its line or curve, which `braking` watches.

        The arm must not be `lost`. None, and nothing is changed, if the arm is at its end, or
        will be without any command. ``reason``: for people; ``wall_s``: now, s; ``rate``:
        robot time per wall time. There must be a visit.
        """
        assert self.visit is not None
        following = self.visit.following
        if following.has_ended(seen, wall_s, rate):
            return None
        low_s, high_s = following.window(seen, wall_s, rate)
        if following.trajectory.is_curve and high_s >= JOINED_S:
            if high_s >= following.trajectory.duration_s:
                # Its controller rests at the end, and the arm comes there.
                return None
            return self._stop_on_curve(reason, seen, wall_s, rate)
        if self._piece is not None:
            # Behind that it is on the stop of its piece.
            high_s = min(high_s, self._piece.cut_s)
        admitted = self.gate.stop(min(low_s, high_s), high_s)
        (stop,) = admitted.waypoints
        begins = seen.now(wall_s, rate) + allowed_lag_s(self.rules, rate)
        self._brake(stop.q, begins, begins + stop.time_s, rate)
        self._set_back_s = 0.0
        self.led.lead_to(stop.q)
        return Stop(admitted, reason, wall_s)

    def _stop_on_curve(self, reason: str, seen: Seen, wall_s: float, rate: float) -> Stop:
        """Return the stop of an arm on a curve, as a piece with the same stamp as the move.

        The piece follows the curve until `STOP_AHEAD_S` from now (but until `JOINED_S` +
        `STOP_AHEAD_S` after the move's start at least), or until the present piece would begin
        to stop if that is sooner; there it begins to brake. Arguments as of `stop`.
        """
        assert self.visit is not None
        assert self._piece is not None
        following = self.visit.following
        sent_s = following.elapsed_s(_led_now(seen, wall_s)) + seen.late_s
        # Before that the controller joins the curve from where the arm stood.
        cut_s = min(max(sent_s, JOINED_S) + STOP_AHEAD_S, self._piece.cut_s)
        admitted = self.gate.stop_on_curve(min(sent_s, cut_s), cut_s)
        assert admitted.piece is not None
        self._take(admitted.piece, sent_s)
        self.end_piece(seen, wall_s, rate)
        self.led.lead_to(admitted.piece.end)
        return Stop(admitted, reason, wall_s, following.sent)

    def _brake(self, end: FloatArray, begins: float, over: float, rate: float) -> None:
        """Set `braking` to a stop that ends at `end`, rad or m, (k,).

        ``begins``: robot time at which the arm has begun it, s; ``over``: at which it has
        ended. ``rate``: robot time per wall time; above 1 it lengthens the patience.
        """
        patience_s = ASTRAY_S * max(rate, 1.0)
        deadline = over + max(STOPPED_S, patience_s)
        units = self.rules.units
        self.braking = Braking(end, begins, over, deadline, self.near, patience_s, units)

    def take_back(self) -> None:
        """Undo the last command, which was not sent; the state is not changed.

        Restored to what they were before it: where the arm was led (`led`), the present piece
        of the move and when that was sent, and the times of the visit if `renew` has shifted
        them. `visit` and `braking` are kept. Of two commands in a row only the last can be
        undone.
        """
        self.led.take_back()
        self._piece, self._piece_sent_s = self._piece_before
        if self.visit is not None and self._set_back_s:
            self.visit.set_back(-self._set_back_s)
        self._set_back_s = 0.0
