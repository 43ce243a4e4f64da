# SPDX-License-Identifier: Apache-2.0
"""The token of a collection run, and the sign of life of the planner that runs it.

A planner that was killed may go on by itself only if it is certain that the same run is still
under way: the same boot of this computer, a short time by a clock that cannot be set, and recorder
and bridge that hold the token in memory. Dates of files prove nothing of that.
"""

from __future__ import annotations

import contextlib
import os
import time
import uuid
from pathlib import Path

from remaster_ros.nodes.runtime_files import runtime_folder

ALIVE_S = 1.0
"""How often a planner renews its sign of life, s."""


def boot_id() -> str:
    """Return what this boot of this computer is called by its kernel."""
    return Path('/proc/sys/kernel/random/boot_id').read_text().strip()


def since_boot_s() -> float:
    """Return the time since boot, s; it goes on while the computer is suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def new_token() -> str:
    """Return a token for a run that begins now."""
    return uuid.uuid4().hex[:12]


class LivingRun:
    """A run under way in this process; its sign of life is a file outside of every session."""

    def __init__(self, token: str) -> None:
        self.token = token
        self._renewed = float('-inf')
        self.stay_alive()

    def stay_alive(self) -> None:
        """Renew the sign of life, at most once a second; where that fails, no planner goes on."""
        now = since_boot_s()
        if now - self._renewed < ALIVE_S:
            return
        self._renewed = now
        path = _path(self.token)
        with contextlib.suppress(OSError):
            # It need not survive a power cut: another boot is another run.
            new = path.with_suffix('.new')
            new.write_text(f'{boot_id()} {now!r}\n')
            os.replace(new, path)

    def end(self) -> None:
        """End the run: no planner goes on with it."""
        with contextlib.suppress(OSError):
            _path(self.token).unlink()


def silence_s(token: str) -> float | None:
    """Return for how long the planner of a run has given no sign of life, s.

    None where it gave none in this boot of this computer, or the run was ended.
    """
    if not token.isalnum():
        return None
    try:
        boot, _, sign = _path(token).read_text().strip().partition(' ')
        passed_s = since_boot_s() - float(sign)
    except (OSError, ValueError):
        return None
    return passed_s if boot == boot_id() and passed_s >= 0.0 else None


def _path(token: str) -> Path:
    return runtime_folder() / f'run_{token}'
