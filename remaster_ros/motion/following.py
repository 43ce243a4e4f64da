# SPDX-License-Identifier: Apache-2.0
"""Where the arm is, and whether it follows the trajectory that it was sent along."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from remaster_ros.motion.actions import SupervisorRules
from remaster_ros.motion.joint_reports import JointReport
from remaster_ros.motion.trajectory import RAMP_S, Trajectory
from remaster_ros.types import BoolArray, FloatArray

STANDING_S = 0.25
"""An arm that has not moved for so long stands; it must before it is sent anywhere, s."""
FRESH_S = 0.25
"""A report older than this (wall time) does not show any more where the arm is, s."""
ASTRAY_S = 0.3
"""An arm that is off its path for so long (wall time) is halted, s."""
LATENCY_S = 0.1
"""What a busy machine may add to the lag of an arm, or to its lead, s of wall time."""
JITTER_S = 0.02
"""By so much a command's way to the robot may differ from another's, s of wall time."""
EARLY_S = 0.1
"""An arm may be so far ahead of its path, s of robot time; `LATENCY_S` comes on top."""
# Of a joint that slides these angles are 0.25 m times as much in m (`JointUnits`).
ON_PATH_RAD = 0.02
"""An arm is on its path that is no further from it, rad: its servo overshoots, by as much more as
it is faster. A slide is by 5 mm: at 0.25 m/s, the default limit of the fastest point, that is the
way of 20 ms, as 20 mrad are of a joint at 1 rad/s."""
SLOWED_S, SLOWED_LONGEST_S = 0.1, 0.3
"""Loss of speed is judged over a time between these two, s."""
SLOWED_RAD = 5e-3
"""Only where its path leads on by so much in this time, rad."""
SLOWED_SHARE = 0.5
"""An arm that has gone less than this share of it is being stopped."""
STANDS_SHARE = 0.2
"""And one that has gone less than this share of what it is behind its path stands: an arm that may
lag so far (`SupervisorRules.lag_s`) has gone more."""
JUST_S = 0.02
"""A report is of just now that is no older, s of wall time: a piece of a move is sent for an arm
that is seen to move, not for one that was seen to a moment ago."""
LOOKED_FOR = 3.0
"""On a curve the arm is looked for up to so many times as far behind and ahead as it may be."""
LAG_CHANGES_S = 0.1
"""By so much the lag of an arm that follows may have changed in this time, s."""
VARIES_S = 1.0
"""A measured joint position differs from the report before it at least once in so much time: no
encoder reads the same to the last bit for long. One that does may be frozen, s."""
STOPPED_ON_ITS_WAY = 'the robot stopped on its way: an emergency or protective stop?'


@dataclass(frozen=True)
class Seen:
    """State of the arm after the last report that was believed: positions, times, standstill."""

    q: FloatArray  # Joint positions, rad or m, (k,)
    # Its stamp, wall time and robot time, s
    stamp: float
    wall: float
    time: float
    # Where (rad or m, (k,)) and since when (robot time, s) the arm has been standing
    stands_at: FloatArray
    stands_since: float
    late_s: float  # How much later than usual it came, s: the arm has gone on meanwhile
    # When each joint's position last differed from the report before (robot time, s, (k,))
    changed: FloatArray = field(default_factory=lambda: np.array(-np.inf))
    resumed: float = -np.inf  # Of the first report after the last gap, robot time, s

    @classmethod
    def after(
        cls, last: Seen | None, report: JointReport, rules: SupervisorRules, late_s: float
    ) -> Seen:
        """Return the arm's state after a report; ``last``: state before it, None at first.

        Robot time goes on by the stamps. The standstill begins anew after a motion of more than
        `still_tolerance`, or a gap of more than `max_gap_s`. ``late_s``: of `JointReports.late_s`.
        """
        q, stamp, wall = report.q, report.stamp_s, report.wall_s
        if last is None:
            return cls(q, stamp, wall, stamp, q, stamp, late_s, np.full(len(q), -np.inf), stamp)
        time = last.time + stamp - last.stamp
        changed = np.where(q != last.q, time, last.changed)
        moved = rules.units.largest(q - last.stands_at) > rules.settle.still_tolerance
        is_gap = stamp - last.stamp > rules.settle.max_gap_s
        resumed = time if is_gap else last.resumed
        if moved or is_gap:
            return cls(q, stamp, wall, time, q, time, late_s, changed, resumed)
        at, since = last.stands_at, last.stands_since
        return cls(q, stamp, wall, time, at, since, late_s, changed, resumed)

    def is_fresh(self, wall_s: float) -> bool:
        """Whether this report is at most `FRESH_S` old.

        ``wall_s``: now, wall time, s.
        """
        return wall_s - self.wall <= FRESH_S

    def stands(self, wall_s: float) -> bool:
        """Whether the arm has stood for `STANDING_S`, and the report is fresh (`is_fresh`).

        ``wall_s``: now, wall time, s.
        """
        return self.time - self.stands_since >= STANDING_S and self.is_fresh(wall_s)

    def frozen(self) -> BoolArray:
        """Whether each joint's position has not changed by a bit for `VARIES_S`, (k,)."""
        return self.time - self.changed > VARIES_S

    def now(self, wall_s: float, rate: float) -> float:
        """Return robot time now, s, for a clock that runs at `rate`.

        ``wall_s``: wall time now, s; ``rate``: robot time per wall time.
        """
        return self.time + rate * (wall_s - self.wall)


class Following:
    """Comparison of the arm's reports with the trajectory that it was sent along.

    ``trajectory``: where it was sent; ``sent, sent_wall``: when, robot time and wall time, s;
    ``rules``: how far it may lag and how long a command may take to be seen. Attributes:
    ``sent``: when the trajectory began, robot time, s, as shifted by `set_back`; ``reacted``:
    whether the arm has left its start, or goes too short a way for that to be seen.
    """

    def __init__(
        self, trajectory: Trajectory, sent: float, sent_wall: float, rules: SupervisorRules
    ) -> None:
        self.trajectory, self._rules = trajectory, rules
        self.sent, self._sent_wall = sent, sent_wall
        self.reacted = False
        self._lag_s = 0.0
        # The last moments: time since it was sent (s), where the arm was, its lag (s).
        self._trail: deque[tuple[float, FloatArray, float]] = deque()
        self._allowed_s, self._early_s = rules.lag_s, EARLY_S + LATENCY_S
        self._astray = ''
        self._astray_wall: float | None = None

    def elapsed_s(self, time: float) -> float:
        """Return the time since the trajectory was sent, s; ``time``: robot time, s."""
        return time - self.sent

    def set_back(self, by_s: float) -> None:
        """Shift the rest of the trajectory later by `by_s`, s; negative for earlier.

        To be called while the arm rests before the next line of the trajectory.
        """
        self.sent += by_s
        self._trail = deque((t - by_s, q, lag - by_s) for t, q, lag in self._trail)

    def update(self, seen: Seen, rate: float) -> str:
        """Process a report; return in words how the arm is off its path, '' if it is not.

        Only what lasts for more than `ASTRAY_S` of wall time counts. ``rate``: robot time per wall
        time.
        """
        self._allowed_s = allowed_lag_s(self._rules, rate)
        # A clock that runs faster stands still, too, while a busy machine catches up: when a move
        # was sent is then reckoned too late.
        self._early_s = EARLY_S + LATENCY_S * max(rate, 1.0)
        elapsed = self.elapsed_s(seen.time)
        self._astray = self._look(seen, elapsed)
        self._trail.append((elapsed, seen.q, self._lag_s))
        while len(self._trail) > 1 and elapsed - self._trail[1][0] >= SLOWED_S:
            self._trail.popleft()
        if not self._astray:
            self._astray_wall = None
        elif self._astray_wall is None:
            self._astray_wall = seen.wall
        lasts = self._astray_wall is not None and seen.wall - self._astray_wall > ASTRAY_S
        return self._astray if lasts else ''

    def lost(self, seen: Seen, wall_s: float) -> str:
        """Return why the arm's place on its path is unknown, or '' if it is known.

        Unknown: the last report is not fresh (`Seen.is_fresh`); or by it the arm has not begun
        to move although more than the allowed lag has passed, is off its path, or loses speed
        (`_is_slowed`). ``wall_s``: now, wall time, s.
        """
        if not seen.is_fresh(wall_s):
            return f'the last report of the joints is {wall_s - seen.wall:.1f} s old'
        if self._lag_s > self._allowed_s and not self._astray:
            return 'the arm is not seen to move yet'
        return self._astray or (STOPPED_ON_ITS_WAY if self._is_slowed() else '')

    def unseen(self, seen: Seen, wall_s: float, rate: float) -> str:
        """Return why the latest reports do not show the arm going on along its path, or ''.

        They show it if the last one is at most `JUST_S` old, reports over some `SLOWED_S` to
        `SLOWED_LONGEST_S` can be compared, and the last position is within `ON_PATH_RAD` of
        the planned one. An arm that is farther from it must lag evenly: its lag has grown by
        at most `SLOWED_SHARE` of the time, and it has moved by at least `STANDS_SHARE` of its
        distance from the planned position.

        That is asked before a further piece of a move is sent; a stop needs only `lost`. A
        controller may join such a piece by a jump to an arm that was stopped meanwhile.
        ``wall_s``: now, s; ``rate``: robot time per wall time.
        """
        if wall_s - seen.wall > JUST_S or not self._trail:
            return 'joint_states do not come'
        (before, q_before, lag_before), (now, q, lag) = self._trail[0], self._trail[-1]
        passed_s = now - before
        # A robot of a clock that runs faster leaves out as many more of its reports.
        longest_s = SLOWED_LONGEST_S + LATENCY_S * (max(rate, 1.0) - 1.0)
        if not SLOWED_S - JITTER_S <= passed_s <= longest_s:
            return f'joint_states come {passed_s:.2f} s apart'
        largest = self._rules.units.largest
        behind = largest(self.trajectory.at(now)[0] - q)
        if behind <= ON_PATH_RAD:
            return ''
        # A moment ago it went on, and now it does not.
        last, _, lag_last = next(
            entry for entry in reversed(self._trail) if now - entry[0] >= JUST_S
        )
        moments = (passed_s, lag_before), (now - last, lag_last)
        grows = any(lag - then > SLOWED_SHARE * since_s for since_s, then in moments)
        stands = largest(q - q_before) < STANDS_SHARE * behind
        return 'the arm is not seen to go on' if grows or stands else ''

    def window(self, seen: Seen, wall_s: float, rate: float) -> tuple[float, float]:
        """Return the earliest and latest time on the trajectory, s, at which the arm may be now.

        Times since its start. Latest: that of the controller's reference, which is the time
        that has passed since the start, plus the delay of the last report beyond the usual
        one, plus `JITTER_S`. Earliest: where the arm was by the last report, with its lag,
        less `JITTER_S`: it may have been stopped by itself since. ``wall_s``: now, s;
        ``rate``: robot time per wall time.
        """
        reported, jitter = self.elapsed_s(seen.time), JITTER_S * rate
        elapsed = self.elapsed_s(seen.now(wall_s, rate))
        # In a rest the lag is what the arm still has to the end of the line.
        index, since_s = self.trajectory.line_at(reported)
        rested_s = max(since_s - self.trajectory.lines[index].duration_s, 0.0)
        low_s = reported - rested_s - self._lag_s - jitter
        return low_s, elapsed + seen.late_s + jitter

    def has_ended(self, seen: Seen, wall_s: float, rate: float) -> bool:
        """Whether the arm is at the end of the trajectory, or will be without any command.

        That is when the time since its start, less the lag seen last and `JITTER_S`, has
        reached the trajectory's duration. ``wall_s``: now, s; ``rate``: robot time per wall
        time.
        """
        elapsed = self.elapsed_s(seen.now(wall_s, rate))
        return elapsed - self._lag_s - JITTER_S * rate >= self.trajectory.duration_s

    def _look(self, seen: Seen, elapsed: float) -> str:
        """Deviation of the arm from its path in words, '' if it follows; sets the lag.

        It follows if it is within `ON_PATH_RAD` of the path and, along the path, within
        `ON_PATH_RAD` of its planned place or within the allowed lag and lead. Before it is
        seen to move it may stand at its start for `rules.reaction_s`. ``elapsed``: robot time
        since the trajectory was sent, s.
        """
        if not self.reacted:
            still = self._is_still_at_start(seen)
            if still and seen.wall - self._sent_wall <= self._rules.reaction_s:
                self._lag_s = max(elapsed, 0.0)
                return ''
            if still:
                return 'the robot does not take commands: see its controller, and its driver'
            self.reacted = True
        lag, off, is_near = self._lag(elapsed, seen.q)
        self._lag_s = float(np.clip(lag, 0.0, self._allowed_s))
        units = self._rules.units
        is_beside = units.largest(off) > ON_PATH_RAD
        if not is_beside and (is_near or -self._early_s <= lag <= self._allowed_s):
            return ''
        if seen.time - seen.stands_since >= STANDING_S:
            return STOPPED_ON_ITS_WAY
        if is_beside:
            joint = units.farthest(off)
            text = units.in_degrees(joint, abs(off[joint]), 1)
            return f'the robot does not follow its path: {text} beside it'
        if lag < 0.0:
            return (
                f'the robot does not follow its path: {-lag:.2f} s ahead of it; does something '
                'else move it, or are joint_states stamped late?'
            )
        return (
            f'the robot does not follow its path: {lag:.2f} s behind it; is its speed override '
            'below 100 %, or do joint_states come late?'
        )

    def _is_slowed(self) -> bool:
        """Whether the arm loses speed although its path goes on, long before its lag shows it.

        It does if in the last `SLOWED_S` to `SLOWED_LONGEST_S` it has gone less than
        `SLOWED_SHARE` of its path's way (of at least `SLOWED_RAD`). The path is the trajectory,
        delayed by about what the arm lagged a moment ago. False without reports over such a time.
        """
        if not self._trail:
            return False
        (before, q_before, lag), (now, q, _) = self._trail[0], self._trail[-1]
        index, since_s = self.trajectory.line_at(before - lag)
        line = self.trajectory.lines[index]
        # Where a line begins it is not known by how much the arm lags.
        least_s = self._allowed_s if index else 0.5 * RAMP_S
        passed_s = now - before
        if since_s < least_s or not SLOWED_S <= passed_s <= SLOWED_LONGEST_S:
            return False
        units = self._rules.units
        expected = min(
            units.largest(line.at(since_s + passed_s + change)[0] - line.at(since_s + change)[0])
            for change in (-LAG_CHANGES_S, 0.0, LAG_CHANGES_S)
        )
        moved = units.largest(q - q_before)
        return expected > SLOWED_RAD and moved < SLOWED_SHARE * expected

    def _is_still_at_start(self, seen: Seen) -> bool:
        """Whether nothing of a move has been seen yet: the arm is within `arrive_tolerance`.

        False for a move of less than `ON_PATH_RAD`, such as the probe: it is too short to be seen.
        """
        start, units = self.trajectory.start, self._rules.units
        longest = units.largest(self.trajectory.points - start)
        distance = units.largest(seen.q - start)
        return longest > ON_PATH_RAD and distance <= self._rules.settle.arrive_tolerance

    def _lag(self, elapsed: float, q: FloatArray) -> tuple[float, FloatArray, bool]:
        """Return the lag of `q`, s, its offset from the path, (k,), and whether it is near.

        ``q``: reported configuration, rad or m, (k,); ``elapsed``: time since the start, s. A
        lead is a negative lag. The offset, rad or m, is from the nearest place on the path.
        Near: this place is within `ON_PATH_RAD` of the planned one; at the ends of a line,
        where the arm is slow, even so small a distance is a long lag.
        """
        trajectory, units = self.trajectory, self._rules.units
        index, since_s = trajectory.line_at(elapsed)
        found: list[tuple[float, float, bool, FloatArray]] = []
        # Just after a rest an arm that lags may still be on the line before it.
        for number in {index, max(index - 1, 0)} if since_s < self._allowed_s else {index}:
            line = trajectory.lines[number]
            begun_s = trajectory.starts_s[number]
            gone_s = elapsed - begun_s
            window_s = gone_s - LOOKED_FOR * self._allowed_s, gone_s + LOOKED_FOR * self._early_s
            share, off = line.project(q, units, window_s)
            lag = min(gone_s, line.duration_s) - line.time_s(share)
            place = line.place(share)
            is_near = units.largest(line.at(gone_s)[0] - place) <= ON_PATH_RAD
            found.append((off, lag, is_near, q - place))
        _, lag, is_near, offset = min(found, key=lambda candidate: candidate[:3])
        return lag, offset, is_near


def path_tolerance(speeds: FloatArray, rules: SupervisorRules) -> FloatArray:
    """Largest deviation of joints from their planned position that is allowed, rad or m, (k,).

    ON_PATH_RAD beside the path, and allowed lag times speed behind it, as in `Following`; for a
    controller that watches its path itself.

    Parameters
    ----------
    speeds
        Largest speed of each joint in the move, rad/s or m/s, (k,).
    rules
        How far the arm may lag.
    """
    return ON_PATH_RAD * rules.units.per_radian + allowed_lag_s(rules, 1.0) * speeds


def allowed_lag_s(rules: SupervisorRules, rate: float) -> float:
    """Return the largest allowed lag of an arm behind its trajectory, s of robot time.

    ``rate``: robot time per wall time.
    """
    return rules.lag_s + LATENCY_S * max(rate, 1.0)
