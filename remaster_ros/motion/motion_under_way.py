"""The one move or stop under way: how it begins, what becomes of it, how it is stopped."""

from __future__ import annotations

from remaster_ros.motion.actions import Drive, Stop, SupervisorRules
from remaster_ros.motion.following import Following, Seen, allowed_lag_s
from remaster_ros.motion.motion_gate import MotionGate
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.settling import SettleDetector
from remaster_ros.motion.visit import UNDER_WAY, Braking, Outcome, Visit

STOPPED_S = 1.0
"""After the end of a stop the arm stands within so much time, s; the lag comes on top."""


class MotionUnderWay:
    """What the arm does by the last command.

    Parameters
    ----------
    gate
        Every command comes from it.
    rules
        See `SupervisorRules`.

    Attributes
    ----------
    visit
        The configuration under way, to its end; None where none is.
    braking
        The stop under way, until the arm stands.
    """

    def __init__(self, gate: MotionGate, rules: SupervisorRules) -> None:
        self.gate, self.rules = gate, rules
        self.visit: Visit | None = None
        self.braking: Braking | None = None

    @property
    def is_idle(self) -> bool:
        """Whether neither a move nor a stop is under way."""
        return self.visit is None and self.braking is None

    @property
    def is_moving(self) -> bool:
        """Whether the arm is on its way to a configuration, and could be stopped."""
        return self.visit is not None and not self.visit.settled

    def begin(
        self, solution: int, path: FreePath, seen: Seen, wall_s: float, rate: float
    ) -> Drive:
        """Return the move along a free path, which is under way from now on.

        Parameters
        ----------
        solution
            Its number.
        path
            From where the arm stands.
        seen
            The last report.
        wall_s
            Now, s.
        rate
            Seconds of the robot per second of wall time.

        Raises
        ------
        MotionRefusedError
            As of `MotionGate.admit`; nothing is under way then.
        """
        admitted = self.gate.admit(path, seen.q)
        trajectory, rules = admitted.trajectory, self.rules
        assert trajectory is not None
        time = seen.now(wall_s, rate)
        deadline = time + trajectory.duration_s + rules.settle.settle_s + rules.arrive_timeout_s
        detector = SettleDetector(trajectory.end, rules.settle)
        following = Following(trajectory, time, wall_s, rules)
        self.visit = Visit(solution, following, detector, rules, seen.stamp, deadline)
        return Drive(solution, admitted, wall_s)

    def judge(self, seen: Seen, rate: float, *, recorder_waits: bool) -> Outcome:
        """Return what becomes of the move or the stop by a report; see `Visit` and `Braking`."""
        if self.visit is not None and self.visit.settled:
            return self.visit.judge_settled(seen, recorder_waits=recorder_waits)
        if self.visit is not None:
            return self.visit.judge(seen, rate)
        if self.braking is None:
            return UNDER_WAY
        outcome = self.braking.judge(seen)
        if outcome != UNDER_WAY:
            self.braking = None
        return outcome

    def lost(self, seen: Seen, wall_s: float) -> str:
        """Return why it is not known where on its path a moving arm is; ''."""
        assert self.visit is not None
        return self.visit.following.lost(seen, wall_s)

    def stop(self, reason: str, seen: Seen, wall_s: float, rate: float) -> list[Stop]:
        """Return the stop of a moving arm that is not `lost`, along the rest of its line.

        None is needed where the arm is at its end, or will be without any command.
        """
        assert self.visit is not None
        following, self.visit = self.visit.following, None
        if following.has_ended(seen, wall_s, rate):
            return []
        admitted = self.gate.stop(*following.window(seen, wall_s, rate))
        (stop,) = admitted.waypoints
        over = seen.now(wall_s, rate) + stop.time_s + allowed_lag_s(self.rules, rate)
        self.braking = Braking(stop.q, over, over + STOPPED_S)
        return [Stop(admitted, reason, wall_s)]
