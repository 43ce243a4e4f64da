# SPDX-License-Identifier: Apache-2.0
"""World time, common to the processes of all fakes, which waits for slow processes.

World time runs `rate` times as fast as the wall clock up to a limit, and stops there. The fake
robot raises the limit as the tested programs, and the fake sensors, have kept up: on a busy
machine the world is slower, and nothing in it is late. Before the arm's first motion, while nodes
start and plan, it runs no faster than the wall clock, since nothing happens in it. A file of a few
numbers holds the line and the limit; every process computes the same time from this file and the
machine's monotonic clock.

A limit that is not renewed for `HELD_WALL_S` is void: a fake robot that was killed or paused is a
fault injected by a test, and the world continues without it.
"""

from __future__ import annotations

import math
import mmap
import os
import struct
import time
from pathlib import Path

CLOCK_FILE = 'clock'
HELD_WALL_S = 3.0
"""Wall time, s, for which a limit is valid without renewal by its owner."""
POLL_WALL_S = 2e-3
"""Wall time, s, between checks of a sleeping process whether world time has stopped."""
SLOTS = 16
"""Largest number of fake sensors."""
_VERSION, _LINE, _SLOT = struct.Struct('=Q'), struct.Struct('=dddd'), struct.Struct('=Qd')


class WorldClock:
    """Clock of a World, shared by all processes through a file; see the module's docstring.

    ``folder``: folder of the World with the file by `create`; ``rate``: world time over wall
    time.
    """

    def __init__(self, folder: Path, rate: float) -> None:
        self.rate = rate
        with (folder / CLOCK_FILE).open('r+b') as file:
            self._memory = mmap.mmap(file.fileno(), 0)

    @staticmethod
    def create(folder: Path, start_s: float, started_wall_s: float) -> None:
        """Write the file: world time was ``start_s`` at ``started_wall_s`` of the monotonic clock.

        Time then runs without a limit, and without fake sensors.
        """
        line = _LINE.pack(started_wall_s, start_s, math.inf, math.inf)
        (folder / CLOCK_FILE).write_bytes(_VERSION.pack(0) + 2 * line + bytes(SLOTS * _SLOT.size))

    def now(self, wall_s: float | None = None) -> float:
        """World time, s, now or at ``wall_s`` of the monotonic clock; at most the valid limit."""
        base_wall, base, limit, held_until = self._line()
        wall = time.monotonic() if wall_s is None else wall_s
        world_s = min(base + (min(wall, held_until) - base_wall) * self.rate, limit)
        return world_s + max(wall - held_until, 0.0) * self.rate

    def sleep_until(self, t: float) -> None:
        """Wait until world time t, s; returns at once if it has passed.

        The argument is a time, not a duration: a process delayed before the wait would
        otherwise wait for a time after the limit, and the limit waits for the process.
        """
        while (remaining := t - self.now()) > 0.0:
            # If world time has stopped, the remaining time does not decrease.
            time.sleep(max(remaining / self.rate, POLL_WALL_S))

    def hold(self, limit_s: float) -> None:
        """Set the limit of world time to ``limit_s``, but not before now, until the next call.

        For one process only, the owner of the clock. Without another call the limit is void
        after 3 s of wall time (`HELD_WALL_S`).
        """
        wall = time.monotonic()
        now = self.now(wall)
        # Written next to the valid line: if the process is killed meanwhile, that line stays
        # valid.
        (version,) = _VERSION.unpack_from(self._memory)
        line = wall, now, max(limit_s, now), wall + HELD_WALL_S
        _LINE.pack_into(self._memory, _line_at(version + 1), *line)
        _VERSION.pack_into(self._memory, 0, version + 1)

    def kept_up(self, slot: int, now_s: float) -> None:
        """Record that this process, a fake sensor, has done everything due until ``now_s``.

        ``now_s``: world time, s; ``slot``: number of the sensor, 0 to 15.
        """
        _SLOT.pack_into(self._memory, _slot_at(slot), os.getpid(), now_s)

    def slots(self) -> dict[int, tuple[int, float]]:
        """Fake sensors in use: slot -> (process id, world time until which it has done all, s)."""
        found = {i: _SLOT.unpack_from(self._memory, _slot_at(i)) for i in range(SLOTS)}
        return {slot: (pid, done_s) for slot, (pid, done_s) in found.items() if pid}

    def _line(self) -> tuple[float, float, float, float]:
        """Last line of the clock's file, from which world time is computed.

        Wall time and world time of its writing, limit, and wall time until which the limit is
        valid, s. Read again if a writer came in between.
        """
        while True:
            (version,) = _VERSION.unpack_from(self._memory)
            line = _LINE.unpack_from(self._memory, _line_at(version))
            if _VERSION.unpack_from(self._memory) == (version,):
                return line


def _line_at(version: int) -> int:
    """Byte offset in the clock's file of the line of a version; two places are used in turn."""
    return _VERSION.size + version % 2 * _LINE.size


def _slot_at(slot: int) -> int:
    """Byte offset in the clock's file of a fake sensor's slot; ``slot`` counts from 0."""
    return _line_at(1) + _LINE.size + slot * _SLOT.size


def is_running(pid: int) -> bool:
    """Whether a process of this machine is alive and not stopped (SIGSTOP) or a zombie."""
    try:
        text = Path(f'/proc/{pid}/stat').read_text()
    except OSError:
        return False
    # The name, in parentheses, may contain anything.
    return text.rpartition(')')[2].split()[0] not in 'TtZX'
