# SPDX-License-Identifier: Apache-2.0
"""Which reports of the joints are believed.

They are finite, within limits and no faster than the arm can be; their stamps advance and are not
late.

Three clocks meet here. *Wall* time is this process's own and always runs. The *node's* time is the
system's, or a simulated one that may run faster. *Stamps* come from the robot's host, whose clock
may be off by any constant. A report is late if it took longer than the others between its stamp
and its arrival; a constant difference of the clocks is the same for all and learned from them.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from remaster_ros.motion.joint_units import TURNING, JointUnits
from remaster_ros.types import FloatArray

LIMIT_TOLERANCE_RAD = 0.05
"""A joint may be reported so far outside its limits, rad; one that slides by 12.5 mm."""
SPEED_TOLERANCE = 1.5
"""A joint may be reported so many times as fast as its limit."""
JITTER_S = 0.02
"""Stamps may be off by so much, s."""
LATE_S = 0.15
"""A report may come so much later than the others, s of the node's time."""
LATE_WALL_S = 0.1
"""And so much, s of wall time: a busy machine delays by wall time, however fast a clock runs."""
FAST, LATE_FAST_WALL_S = 5.0, 0.5
"""A clock that runs so many times as fast is a simulation's: no person stands beside the arm, and
the machine, busy with the simulation, may delay by so much, s of wall time."""
SAME_CLOCK_S = 0.1
"""Stamps that usually come so soon, s of wall time, are of the node's own clock. Others are of
another host's, or late from the start, which is not to be told from that."""
DRIFT = 2e-4
"""Two clocks may run apart by so many seconds a second."""
SHORTEN = 0.05
"""Where reports come sooner than was learned, what is usual follows by so many seconds a second.

What was learned from reports that a network held up would excuse late ones afterwards.
"""
LEARN, LEARN_WALL_S = 5, 1.0
"""The usual delay is learned from so many reports at least, over so much wall time (s).

The shortest counts: those that waited in a queue while this process was starting took longer.
"""
RATE_WINDOW_S = 2.0
"""The rate of the node's clock is taken over so much wall time, s."""
RATE_LEAST_S = 0.3
"""And over so much at least, s."""
UNKNOWN_SPEED = 4.0
"""Where a robot model has no velocity limit an arm may be reported so fast, rad/s. One that slides
at 1 m/s: by default no point of an arm is commanded at more than a quarter of that."""


@dataclass(frozen=True)
class JointReport:
    """The content of a message on joint_states, and its times."""

    stamp_s: float  # Its stamp, s
    q: FloatArray  # Joint positions, rad or m, (k,)
    clock_s: float  # The node's time at its arrival, s
    wall_s: float  # Wall time at its arrival, s


class ClockRate:
    """Rate of the node's clock, estimated from times read together; 1 for the system's clock.

    Attributes: ``rate``: seconds of the node's clock per second of wall time.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float]] = deque()
        self.rate = 1.0

    def update(self, clock_s: float, wall_s: float) -> None:
        """Update `rate` by the times of the node's clock and of the wall, read together, s.

        The rate is that over the last `RATE_WINDOW_S` of wall time; it stays until there are
        times `RATE_LEAST_S` apart. If the node's clock goes back, earlier times are forgotten.
        """
        seen = self._seen
        if seen and clock_s < seen[-1][1]:
            # Set back: nothing before it counts.
            seen.clear()
        # More often would be no better, and a robot may report a thousand times a second.
        if not seen or wall_s - seen[-1][0] > RATE_WINDOW_S / 40:
            seen.append((wall_s, clock_s))
        while wall_s - seen[0][0] > RATE_WINDOW_S:
            seen.popleft()
        since_wall, since_clock = seen[0]
        if wall_s - since_wall >= RATE_LEAST_S:
            self.rate = (clock_s - since_clock) / (wall_s - since_wall)


class JointReports:
    """Plausibility checks of joint reports, one after the other.

    Parameters
    ----------
    lower, upper
        Joint limits, rad or m, (k,); infinite where there is none.
    velocity
        Velocity limits of the robot itself, rad/s or m/s, (k,); infinite where unknown.
    units
        Units of the joints.

    Attributes
    ----------
    refused
        Reason -> number of reports that were not believed.
    trouble, kind
        Why the last report was not believed, as text and as a key of `refused`; '' if it was
        believed.
    late_s
        How much later than usual the last report came that was believed, s of the node's time.
    clock
        The rate of the node's clock.
    """

    def __init__(
        self,
        lower: FloatArray,
        upper: FloatArray,
        velocity: FloatArray,
        units: JointUnits = TURNING,
    ) -> None:
        self.units = units
        tolerance = LIMIT_TOLERANCE_RAD * units.per_radian
        self._lower, self._upper = lower - tolerance, upper + tolerance
        speed = np.where(np.isfinite(velocity), velocity, UNKNOWN_SPEED * units.per_radian)
        self._speed = SPEED_TOLERANCE * speed
        self.refused: Counter[str] = Counter()
        self.trouble = self.kind = ''
        self.clock = ClockRate()
        self.forget()

    def forget(self) -> None:
        """Forget the last report and the usual delay, after a person's work or a clock change."""
        self._last: JointReport | None = None
        self._delays: list[tuple[float, float]] = []
        self._delay: float | None = None
        self.late_s = 0.0

    @property
    def is_on_time(self) -> bool:
        """Whether stamps are known to be of the node's clock, and to come at once.

        That is, within `SAME_CLOCK_S` times the clock's rate; False before the delay is learned.
        """
        if self._delay is None:
            return False
        # A clock that runs fast is published in steps.
        return abs(self._delay) <= SAME_CLOCK_S * max(self.clock.rate, 1.0)

    def believes(self, report: JointReport) -> bool:
        """Return whether a report is believed; else `kind` and `trouble` are the reason.

        A report that is believed becomes the last one, and its delay is learned.
        """
        self.clock.update(report.clock_s, report.wall_s)
        self.kind, self.trouble = self._doubt(report)
        if self.kind:
            self.refused[self.kind] += 1
            return False
        if self._delay is not None:
            self.late_s = max(report.clock_s - report.stamp_s - self._delay, 0.0)
        self._learn(report)
        self._last = report
        return True

    def _doubt(self, report: JointReport) -> tuple[str, str]:
        """Return why a report is not believed: key of `refused`, text; ('', '') if it is.

        In this order: not finite; outside the limits by more than `LIMIT_TOLERANCE_RAD`; a
        stamp that does not advance; faster than `SPEED_TOLERANCE` times the limit; late or
        early.
        """
        q, last = report.q, self._last
        if not np.all(np.isfinite(q)):
            return 'not_finite', 'joint_states are not finite'
        if np.any((q < self._lower) | (q > self._upper)):
            beyond = np.maximum(self._lower - q, q - self._upper)
            joint = int(np.argmax(beyond / self.units.per_radian))
            at = self.units.in_degrees(joint, q[joint], 1)
            return 'outside_limits', f'joint {joint + 1} is reported at {at}, outside its limits'
        if last is not None:
            passed = report.stamp_s - last.stamp_s
            if passed <= 0.0:
                return 'stamp', 'the stamps of joint_states do not advance'
            moved = np.abs(q - last.q) - self._speed * (passed + JITTER_S)
            if np.any(moved > 0.0):
                joint = int(np.argmax(moved / self.units.per_radian))
                jump = self.units.in_degrees(joint, abs(q[joint] - last.q[joint]), 1)
                return 'too_fast', (
                    f'joint {joint + 1} is reported {jump} away after {passed:.3f} s'
                )
        return self._doubt_time(report)

    def _doubt_time(self, report: JointReport) -> tuple[str, str]:
        """Kind ('late', 'early') and text if a report's delay is unusual; else ('', '').

        Unusual: it differs from the usual delay by more than `LATE_S` + r × `LATE_WALL_S`,
        with `LATE_FAST_WALL_S` in its place if r is above `FAST`; r is the clock's rate, or 1
        if that is less. ('', '') also before the usual delay is known.
        """
        if self._delay is None:
            return '', ''
        late = report.clock_s - report.stamp_s - self._delay
        rate = max(self.clock.rate, 1.0)
        tolerance = LATE_S + (LATE_FAST_WALL_S if rate > FAST else LATE_WALL_S) * rate
        if late > tolerance:
            return 'late', f'joint_states come {late:.2f} s late'
        if late < -tolerance:
            return 'early', f'joint_states are stamped {-late:.2f} s ahead of their time'
        return '', ''

    def _learn(self, report: JointReport) -> None:
        """Update the usual delay of reports, from stamp to arrival, by a report.

        At first it is the least delay of the first reports: `LEARN` of them or more, over
        `LEARN_WALL_S` or more. After that each report's delay moves it, by at most `SHORTEN`
        down and `DRIFT` up, s for each second since the last report.
        """
        delay = report.clock_s - report.stamp_s
        if self._delay is None:
            self._delays.append((report.wall_s, delay))
            since_wall, _ = self._delays[0]
            if len(self._delays) >= LEARN and report.wall_s - since_wall >= LEARN_WALL_S:
                self._delay = min(delay for _, delay in self._delays)
            return
        assert self._last is not None
        passed = min(report.wall_s - self._last.wall_s, 1.0)
        passed *= max(self.clock.rate, 1.0)
        self._delay += float(np.clip(delay - self._delay, -SHORTEN * passed, DRIFT * passed))
