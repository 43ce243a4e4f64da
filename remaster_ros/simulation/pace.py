"""How far world time may go: no further than the programs in it have kept up.

Two kinds of participants count: nodes that publish which of the robot's reports they have taken,
and fake sensors, which note until when they have done what was due (`world_clock`). One that was
killed or paused (SIGSTOP) is not waited for, since that is a fault that a test injects; one that
is merely busy is, up to `PATIENCE_WALL_S`.
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
"""World time may be ahead of a participant by so much, s, and by so much wall time at its rate:
half of what the bridge allows an arm to lag (0.35 s and 0.1 s of wall time), since a command takes
a while to get to the arm."""
PATIENCE_WALL_S = 30.0
"""A process that runs and does nothing for so long is not waited for any more, s of wall time."""
LOOK_WALL_S = 0.1
"""How often it is looked whether a process that is waited for still runs, s of wall time."""


@dataclass
class _Participant:
    """What a process has done: until which world time, and the wall time of its last sign."""

    done_s: float
    came_wall: float
    looked_wall: float = -math.inf
    runs: bool = True


class Pace:
    """Follow the participants of a World, and move the limit of its time.

    Parameters
    ----------
    clock
        Of the World; its owner is whoever has this.
    """

    def __init__(self, clock: WorldClock) -> None:
        self._clock = clock
        self._ahead_s = AHEAD_S + AHEAD_WALL_S * clock.rate
        # Reports arrive and are taken in different threads.
        self._lock = threading.Lock()
        # Stamp of each report not taken by all, and when it was published, s of world time. The
        # stamps of a robot that is out of order may go back.
        self._reports: deque[tuple[float, float]] = deque(maxlen=10_000)
        self._took: dict[int, _Participant] = {}
        self._fakes: dict[int, _Participant] = {}

    def published(self, stamp_s: float) -> None:
        """Note that a report with this stamp leaves now."""
        with self._lock:
            self._reports.append((stamp_s, self._clock.now()))

    def took(self, pid: int, stamp_s: float) -> None:
        """Note that a process has taken all reports up to the one with this stamp."""
        with self._lock:
            known = [published_s for stamp, published_s in self._reports if stamp == stamp_s]
            if pid in self._took:
                known.append(self._took[pid].done_s)
            if known:
                self._took[pid] = _Participant(max(known), time.monotonic())

    def go_on(self) -> None:
        """Let world time run as far as it may."""
        wall, now = time.monotonic(), self._clock.now()
        for pid, done_s in self._clock.slots().values():
            known = self._fakes.get(pid)
            if known is None or known.done_s != done_s:
                self._fakes[pid] = _Participant(done_s, wall)
        with self._lock:
            taken_s = min(_waited_for(self._took, wall), default=math.inf)
            while self._reports and self._reports[0][1] <= taken_s:
                self._reports.popleft()
            since = [published_s for _, published_s in list(self._reports)[:1]]
        since += _waited_for(self._fakes, wall)
        self._clock.hold(min([now, *since]) + self._ahead_s)


def _waited_for(participants: dict[int, _Participant], wall: float) -> Iterable[float]:
    """Yield until when each process that is waited for has done what was due, s."""
    for pid, p in participants.items():
        if wall - p.looked_wall > LOOK_WALL_S:
            p.runs, p.looked_wall = is_running(pid), wall
        if p.runs and wall - p.came_wall <= PATIENCE_WALL_S:
            yield p.done_s
