# SPDX-License-Identifier: Apache-2.0
"""World time, shared by the processes of all fakes, which waits for who cannot keep up.

World time runs `rate` times as fast as the wall clock up to a limit, and stands there. The fake
robot moves the limit on as the programs that are tested, and the fake sensors, have kept up: on a
busy machine the world is slower, and nothing in it is late. Before the arm's first motion, while
nodes start and plan, it runs no faster than the wall clock, since nothing happens in it. A file of
a few numbers holds the line and the limit; every process computes the same time from it and from
the machine's monotonic clock.

A limit that is not renewed for `HELD_WALL_S` no longer holds: a fake robot that was killed or
paused is a fault that a test injects, and the world goes on without it.
"""

from __future__ import annotations

import math
import mmap
import os
import struct
import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

# How far world time may go: no further than the programs in it have kept up.
#
# Two kinds of participants count: nodes that publish which of the robot's reports they have
# taken, or until when all that came from a sensor, and fake sensors, which note until when they
# have done what was due (`world_clock`). One that was killed or paused (SIGSTOP) is not waited
# for, since that is a fault that a test injects; one that is merely busy is, up to
# `PATIENCE_WALL_S`.


AHEAD_S, AHEAD_WALL_S = 0.15, 0.05
"""World time may be ahead of a participant by so much, s, and by so much wall time at its rate:
half of what the bridge allows an arm to lag (0.35 s and 0.1 s of wall time), since a command takes
a while to get to the arm."""
LEAD_AHEAD_S = 0.1
"""World time is ahead of a report that who leads the arm has not taken by no more than this, s,
however fast it runs: a move begins so long after it was decided (`motion.pieces.AHEAD_S`), and the
next piece of a move comes before the stop of the piece under way."""
LEAD_PATIENCE_WALL_S = 20.0
"""Who leads the arm and gives no sign for so long is waited for as others are, s of wall time."""
PATIENCE_WALL_S = 120.0
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

    Whoever has this owns the clock. What was taken is confirmed no more often than
    ``confirmed_every_s``, s: the last reports before a silence may never be confirmed, and count
    as taken.
    """

    def __init__(self, clock: WorldClock, confirmed_every_s: float = 0.0) -> None:
        self._clock, self._confirmed_every_s = clock, confirmed_every_s
        self._ahead_s = AHEAD_S + AHEAD_WALL_S * clock.rate
        # Reports arrive and are taken in different threads.
        self._lock = threading.Lock()
        # Stamp of each report not taken by all, and when it was published, s of world time. The
        # stamps of a robot that is out of order may go back.
        self._reports: deque[tuple[float, float]] = deque(maxlen=10_000)
        self._took: dict[int, _Participant] = {}
        # Which of them lead the arm.
        self._leads: set[int] = set()
        self._fakes: dict[int, _Participant] = {}

    def published(self, stamp_s: float) -> None:
        """Note that a report with this stamp leaves now."""
        with self._lock:
            self._reports.append((stamp_s, self._clock.now()))

    def took(self, pid: int, stamp_s: float, *, leads: bool = False) -> None:
        """Note that a process has taken all reports up to the one with this stamp.

        A stamp of no report is a time of the World, until which it has done all. One that leads
        the arm confirms each report, behind the command that it has sent by it.
        """
        with self._lock:
            now = self._clock.now()
            known = [published_s for stamp, published_s in self._reports if stamp == stamp_s]
            known = known or [min(stamp_s, now)]
            if pid in self._took:
                known.append(self._took[pid].done_s)
            self._took[pid] = _Participant(max(known), time.monotonic())
            if leads:
                self._leads.add(pid)

    def go_on(self, most_s: float = math.inf) -> None:
        """Let world time run as far as it may, and not past `most_s`."""
        wall, now = time.monotonic(), self._clock.now()
        for pid, done_s in self._clock.slots().values():
            known = self._fakes.get(pid)
            if known is None or known.done_s != done_s:
                self._fakes[pid] = _Participant(done_s, wall)
        with self._lock:
            taken_s = min(_waited_for(self._took, wall), default=math.inf)
            leads = {pid: self._took[pid] for pid in self._leads}
            led_s = min(_waited_for(leads, wall, LEAD_PATIENCE_WALL_S), default=math.inf)
            taken_s += self._confirmed_every_s
            while self._reports and self._reports[0][1] <= min(taken_s, led_s):
                self._reports.popleft()
            reports = [published_s for _, published_s in self._reports]
        since = [one for one in reports if one > taken_s][:1]
        since += _waited_for(self._fakes, wall)
        untaken = [one + LEAD_AHEAD_S for one in reports if one > led_s][:1]
        self._clock.hold(min([*untaken, min([now, *since]) + self._ahead_s, most_s]))


def _waited_for(
    participants: dict[int, _Participant], wall: float, patience_s: float = PATIENCE_WALL_S
) -> Iterable[float]:
    """Yield until when each process that is waited for has done what was due, s."""
    for pid, p in participants.items():
        if wall - p.looked_wall > LOOK_WALL_S:
            p.runs, p.looked_wall = is_running(pid), wall
        if p.runs and wall - p.came_wall <= patience_s:
            yield p.done_s


CLOCK_FILE = 'clock'
HELD_WALL_S = 3.0
"""A limit that its owner does not renew holds so long, s of wall time."""
POLL_WALL_S = 2e-3
"""How often a sleeper looks whether time stands, s of wall time."""
SLOTS = 16
"""So many fakes may take part."""
_VERSION, _LINE, _SLOT = struct.Struct('=Q'), struct.Struct('=dddd'), struct.Struct('=Qd')


class WorldClock:
    """See the module's text.

    ``folder``: of the World; `create` has written the file; ``rate``: world time over wall time.
    """

    def __init__(self, folder: Path, rate: float) -> None:
        self.rate = rate
        with (folder / CLOCK_FILE).open('r+b') as file:
            self._memory = mmap.mmap(file.fileno(), 0)

    @staticmethod
    def create(folder: Path, start_s: float, started_wall_s: float) -> None:
        """Write the file: world time was `start_s` at `started_wall_s` of the monotonic clock."""
        line = _LINE.pack(started_wall_s, start_s, math.inf, math.inf)
        (folder / CLOCK_FILE).write_bytes(_VERSION.pack(0) + 2 * line + bytes(SLOTS * _SLOT.size))

    def now(self, wall_s: float | None = None) -> float:
        """World time now, s, or when the monotonic clock has `wall_s`."""
        base_wall, base, limit, held_until = self._line()
        wall = time.monotonic() if wall_s is None else wall_s
        held = min(base + (min(wall, held_until) - base_wall) * self.rate, limit)
        return held + max(wall - held_until, 0.0) * self.rate

    def sleep_until(self, t: float) -> None:
        """Wait until world time t.

        Not for a while: who is held up before such a wait begins would wait for a time that
        comes after the limit, and the limit waits for him.
        """
        while (left := t - self.now()) > 0.0:
            # Where time stands what is left does not shrink.
            time.sleep(max(left / self.rate, POLL_WALL_S))

    def hold(self, limit_s: float) -> None:
        """Let world time run up to `limit_s`, and no further before this is called again.

        For one process alone, the owner of the clock.
        """
        wall = time.monotonic()
        now = self.now(wall)
        # Written beside the line in force: whoever is killed meanwhile leaves that one behind.
        (version,) = _VERSION.unpack_from(self._memory)
        line = wall, now, max(limit_s, now), wall + HELD_WALL_S
        _LINE.pack_into(self._memory, _line_at(version + 1), *line)
        _VERSION.pack_into(self._memory, 0, version + 1)

    def kept_up(self, slot: int, now_s: float) -> None:
        """Note that this process, a fake sensor, has done all that was due until `now_s`."""
        _SLOT.pack_into(self._memory, _slot_at(slot), os.getpid(), now_s)

    def slots(self) -> dict[int, tuple[int, float]]:
        """Return (process id, until when all is done, s) of each fake sensor that takes part."""
        found = {i: _SLOT.unpack_from(self._memory, _slot_at(i)) for i in range(SLOTS)}
        return {slot: (pid, done_s) for slot, (pid, done_s) in found.items() if pid}

    def _line(self) -> tuple[float, float, float, float]:
        while True:
            (version,) = _VERSION.unpack_from(self._memory)
            line = _LINE.unpack_from(self._memory, _line_at(version))
            if _VERSION.unpack_from(self._memory) == (version,):
                return line


def _line_at(version: int) -> int:
    return _VERSION.size + version % 2 * _LINE.size


def _slot_at(slot: int) -> int:
    return _line_at(1) + _LINE.size + slot * _SLOT.size


def is_running(pid: int) -> bool:
    """Whether a process of this machine lives and was not paused (SIGSTOP)."""
    try:
        text = Path(f'/proc/{pid}/stat').read_text()
    except OSError:
        return False
    # The name, in parentheses, may contain anything.
    return text.rpartition(')')[2].split()[0] not in 'TtZX'
