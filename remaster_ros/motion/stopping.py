# SPDX-License-Identifier: Apache-2.0
"""How an arm that is on a line comes to rest on it.

Where on the line the arm is, is known to a stretch of time only: it lags behind the reference that
its controller follows, and a controller may begin a new command at the one or the other. The same
stop is right from all of this stretch: from each place and speed on it, the cubic to the stop's
end stays on the line, within its end, its cruising speed and the accelerations, and never goes
back. With x and v the share gone and its rate, r the cruising rate and T the time of the stop that
is where

    x + v T/3 <= end <= min(x + 2/3 r T, 1).

A stretch that reaches into the last moments of the line has no such stop: a slow arm needs time,
in which a fast one would pass the end. The end of the stop is then put so far before that of the
line that no arm of the stretch passes the latter; a fast one comes back by a little.
"""

from __future__ import annotations

import numpy as np

from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.trajectory import HEADROOM, Line, Waypoint
from remaster_ros.types import FloatArray

STOP_S = 0.4
"""A stop takes at least so long, s."""
END_OF_STOP_S = 0.1
"""A stop in the last moments of a line takes at least so long, s."""
LONGEST_S, LONGEST_SHARE = 4.0, 6.0
"""A stop takes no longer, s; or times the stretch, where that is longer."""
TRIED = 80
"""Number of durations of a stop that are tried."""
PLACES = 33
"""A stop is checked at so many places of the stretch, and where the speed changes."""
ROUNDS = 32
"""So often the interval is halved in which the end of such a stop is searched."""


def stop_on_line(line: Line, low_s: float, high_s: float, limits: MotionLimits) -> Waypoint:
    """Return position and time at which an arm on a line comes to rest if it stops now.

    ``low_s, high_s``: the arm's place is that of the line at a time between these, s since its
    start; ``limits``: for the accelerations. A stop is right if it is from all of these places
    (`_Stretch.first`). Of the durations tried it is the shortest of at least `STOP_S` that is
    right; else the longest below `STOP_S` that is; else the stop of `_Stretch.rest_of_line`.
    The waypoint's time is from now.
    """
    stretch = _Stretch(line, low_s, high_s, limits)
    longest = max(LONGEST_S, LONGEST_SHARE * (high_s - low_s))
    early = np.geomspace(END_OF_STOP_S, STOP_S, TRIED // 4, endpoint=False)
    late = np.geomspace(STOP_S, longest, TRIED)
    # The shortest one that takes its time; else the slowest of the quick ones.
    found = stretch.first(late) or stretch.first(early[::-1])
    time, end = found or stretch.rest_of_line()
    return Waypoint(time, line.start + end * line.way, np.zeros_like(line.end))


class _Stretch:
    """The places on a line at which an arm may be, and stops that are right from all of them."""

    def __init__(self, line: Line, low_s: float, high_s: float, limits: MotionLimits) -> None:
        kinks = [time for time in line.kinks_s if low_s < time < high_s]
        times = [*np.linspace(low_s, high_s, PLACES), *kinks]
        self._x, self._v = np.array([line.share(time) for time in times]).T
        self._here = line.share(high_s)
        self._rate, self._left_s = line.rate, line.duration_s - low_s
        self._hardness = float(np.max(np.abs(line.way) / limits.acceleration))

    def first(self, times: FloatArray) -> tuple[float, float] | None:
        """Return time (s) and end (share) of the first stop that is right; None if none is.

        ``times``: durations to try, s, (n,), in this order. Right: from every place of the
        stretch its cubic stays on the line, up to the stop's end, never goes back, and has at
        most the cruising speed and `HEADROOM` times the acceleration limits.
        """
        x, v, T = self._x[:, None], self._v[:, None], times
        least = np.max(x + v * T / 3, axis=0)
        most = np.minimum(np.min(x + self._rate * T * 2 / 3, axis=0), 1.0)
        # Braked evenly from the reference on, or what is gentler on all.
        share, rate = self._here
        even = np.clip(share + 0.5 * rate * T, least, np.maximum(least, most))
        for time, low, high, end in zip(times, least, most, even):
            if low > high:
                continue
            for tried in (end, 0.5 * (low + high)):
                if self._acceleration(time, tried) <= HEADROOM:
                    return float(time), float(tried)
        return None

    def rest_of_line(self) -> tuple[float, float]:
        """Return duration, s, and end, share of the line, of a stop near the line's end.

        For a stretch in the line's last moments, from which `first` finds no stop. The
        duration is the largest of: the time left on the line from the first place of the
        stretch, 1.5 times the time that the rest of the way takes from there at cruising
        speed, and `END_OF_STOP_S`. The end is the largest share for which no cubic of the
        stretch passes the line's end; an arm that is beyond it comes back a little.
        """
        time = max(self._left_s, 1.5 * (1.0 - self._x[0]) / self._rate, END_OF_STOP_S)
        low, high = -1.0, 1.0
        for _ in range(ROUNDS):
            end = 0.5 * (low + high)
            low, high = (low, end) if self._farthest(time, end) > 1.0 else (end, high)
        return time, low

    def _coefficients(self, time: float, end: float) -> tuple[FloatArray, FloatArray]:
        """Return the coefficients of u² and u³ of the stop's cubic from each place, (n,) each.

        u is the share of the stop's time, 0 to 1; the cubic's value is a share of the line.
        ``time``: duration of the stop, s; ``end``: share of the line at which it ends.
        """
        gap, v = end - self._x, self._v * time
        return 3 * gap - 2 * v, v - 2 * gap

    def _acceleration(self, time: float, end: float) -> float:
        """Return the largest acceleration of a stop, as a share of its limit.

        Over all places and joints; ``time``: s; ``end``: share of the line.
        """
        second, third = self._coefficients(time, end)
        largest = np.maximum(np.abs(2 * second), np.abs(2 * second + 6 * third))
        return float(np.max(largest)) / time**2 * self._hardness

    def _farthest(self, time: float, end: float) -> float:
        """Return the largest share of the line that any of the cubics reaches.

        ``time``: of the stop, s; ``end``: share at which it ends.
        """
        second, third = self._coefficients(time, end)
        # Its speed is zero at the end, and at the share v T / (3 third). That is the farthest only
        # where it comes first, with a positive third; else the end is, or the start.
        turn = self._v * time / np.where(third > 0.0, 3 * third, np.inf)
        place = self._x + turn * (self._v * time + turn * (second + turn * third))
        return float(np.max(place, initial=end))
