"""World time, shared by the processes of all fakes, which waits for who cannot keep up.

World time runs `rate` times as fast as the wall clock up to a limit, and stands there. The fake
robot moves the limit on as the programs that are tested, and the fake sensors, have kept up: on a
busy machine the world is slower, and nothing in it is late. A file of a few numbers holds the line
and the limit; every process computes the same time from it and from the machine's monotonic clock.

A limit that is not renewed for `HELD_WALL_S` no longer holds: a fake robot that was killed or
paused is a fault that a test injects, and the world goes on without it.
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
"""A limit that its owner does not renew holds so long, s of wall time."""
POLL_WALL_S = 2e-3
"""How often a sleeper looks whether time stands, s of wall time."""
SLOTS = 16
"""So many fakes may take part."""
_VERSION, _LINE, _SLOT = struct.Struct('=Q'), struct.Struct('=dddd'), struct.Struct('=Qd')


class WorldClock:
    """See the module's text.

    Parameters
    ----------
    folder
        Of the World; `create` has written the file.
    rate
        World time over wall time.
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
