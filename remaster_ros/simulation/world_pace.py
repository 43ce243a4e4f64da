# SPDX-License-Identifier: Apache-2.0
"""How far world time may go: no further than the programs in it have kept up.

Two kinds of participants count: nodes that publish which of the robot's reports they have
taken, or until when all that came from a sensor, and fake sensors, which note until when they
have done what was due (`world_clock`). One that was killed or paused (SIGSTOP) is not waited
for, since that is a fault that a test injects; one that is merely busy is, up to
`PATIENCE_WALL_S`.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from remaster_ros.simulation.world_clock import WorldClock, is_running

AHEAD_S, AHEAD_WALL_S = 0.15, 0.05
"""Largest lead of world time over a participant, s, and its part in wall time, s: half of the lag
that the bridge allows an arm (0.35 s and 0.1 s of wall time), since a command takes some time to
reach the arm."""
LEAD_AHEAD_S = 0.1
"""Largest lead of world time, s, over a report that the process leading the arm has not received,
at any rate: a move begins this long after its decision (`motion.pieces.AHEAD_S`), and the next
piece of a move comes before the stop of the present piece."""
LEAD_PATIENCE_WALL_S = 20.0
"""Wall time without a sign, s, after which a process leading the arm is waited for like others."""
PATIENCE_WALL_S = 120.0
"""Wall time, s, after which world time no longer waits for a running process without progress."""
LOOK_WALL_S = 0.1
"""Wall time, s, between checks whether a process still runs."""


@dataclass
class _Participant:
    """Progress of a process in world time, s, and wall time of its last sign, s."""

    done_s: float
    came_wall: float
    looked_wall: float = -math.inf
    runs: bool = True


class Pace:
    """Limit of world time by the progress of the processes that take part in a World.

    The process with this object owns the clock. Progress is confirmed no more often than every
    ``confirmed_every_s``, s: the last reports before a silence may never be confirmed, and
    count as received.
    """

    def __init__(self, clock: WorldClock, confirmed_every_s: float = 0.0) -> None:
        self._clock, self._confirmed_every_s = clock, confirmed_every_s
        self._ahead_s = AHEAD_S + AHEAD_WALL_S * clock.rate
        # Reports arrive and are taken in different threads.
        self._lock = threading.Lock()
        # Stamp of each report that not all have received, and world time of its publication, s.
        # The stamps of a robot that is out of order may decrease.
        self._reports: deque[tuple[float, float]] = deque(maxlen=10_000)
        self._received: dict[int, _Participant] = {}
        # Process ids of those that lead the arm.
        self._leads: set[int] = set()
        self._fakes: dict[int, _Participant] = {}

    def published(self, stamp_s: float) -> None:
        """Record that a report of joint states with this stamp, s, is published just now."""
        with self._lock:
            self._reports.append((stamp_s, self._clock.now()))

    def took(self, pid: int, stamp_s: float, *, leads: bool = False) -> None:
        """Record that a process has received all reports up to the one with this stamp, s.

        ``pid``: its process id. If no report has the stamp, it is a world time until which the
        process has done everything. A process that ``leads`` the arm confirms each report
        after the command that it has sent. Progress never decreases.
        """
        with self._lock:
            now = self._clock.now()
            known = [published_s for stamp, published_s in self._reports if stamp == stamp_s]
            known = known or [min(stamp_s, now)]
            if pid in self._received:
                known.append(self._received[pid].done_s)
            self._received[pid] = _Participant(max(known), time.monotonic())
            if leads:
                self._leads.add(pid)

    def go_on(self, most_s: float = math.inf) -> None:
        """Raise the limit of world time as far as the participants allow, up to `most_s`.

        Up to `AHEAD_S`, and `AHEAD_WALL_S` of wall time, beyond the slowest participant, and
        `LEAD_AHEAD_S` beyond the first report that a process leading the arm has not received.
        """
        wall, now = time.monotonic(), self._clock.now()
        for pid, done_s in self._clock.slots().values():
            known = self._fakes.get(pid)
            if known is None or known.done_s != done_s:
                self._fakes[pid] = _Participant(done_s, wall)
        with self._lock:
            taken_s = min(_progress_of_running(self._received, wall), default=math.inf)
            leads = {pid: self._received[pid] for pid in self._leads}
            led_s = min(_progress_of_running(leads, wall, LEAD_PATIENCE_WALL_S), default=math.inf)
            taken_s += self._confirmed_every_s
            while self._reports and self._reports[0][1] <= min(taken_s, led_s):
                self._reports.popleft()
            untaken_s, not_led_s = self._first_after(taken_s), self._first_after(led_s)
        slowest_s = min([now, untaken_s, *_progress_of_running(self._fakes, wall)])
        self._clock.hold(min(not_led_s + LEAD_AHEAD_S, slowest_s + self._ahead_s, most_s))

    def _first_after(self, done_s: float) -> float:
        """World time, s, of the first publication of a report after ``done_s``; else infinity."""
        return next(
            (published_s for _, published_s in self._reports if published_s > done_s), math.inf
        )


def _progress_of_running(
    participants: dict[int, _Participant], wall: float, patience_s: float = PATIENCE_WALL_S
) -> Iterable[float]:
    """Yield the world time, s, until which each running process has done everything.

    Left out are processes without a sign for over ``patience_s`` of wall time. ``wall``:
    present time of the monotonic clock, s. Whether a process runs is looked up every 0.1 s.
    """
    for pid, p in participants.items():
        if wall - p.looked_wall > LOOK_WALL_S:
            p.runs, p.looked_wall = is_running(pid), wall
        if p.runs and wall - p.came_wall <= patience_s:
            yield p.done_s
