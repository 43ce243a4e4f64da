# SPDX-License-Identifier: Apache-2.0
"""The token of a collection run, and the liveness file of the planner that runs it.

A killed planner may resume by itself only if the same run is certainly still under way: the same
boot of this computer, a short time by a clock that cannot be set, and recorder and bridge that
hold the token in memory. Modification times of files prove none of that.
"""

from __future__ import annotations

import contextlib
import os
import time
import uuid
from pathlib import Path

from remaster_ros.nodes.runtime_files import runtime_folder

ALIVE_S = 1.0
"""Interval at which a planner renews its liveness file, s."""


def boot_id() -> str:
    """Return the kernel's identifier of the present boot of this computer."""
    return Path('/proc/sys/kernel/random/boot_id').read_text().strip()


def since_boot_s() -> float:
    """Return the time since boot, s, time of suspension included."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def new_token() -> str:
    """Return a random token for a new run: 12 hexadecimal digits."""
    return uuid.uuid4().hex[:12]


class LivingRun:
    """A collection run of this planner's process, and its liveness file.

    ``token``: of the run. The file is outside of every session.
    """

    def __init__(self, token: str) -> None:
        self.token = token
        self._renewed = float('-inf')
        self.stay_alive()

    def stay_alive(self) -> None:
        """Renew the liveness file, at most every `ALIVE_S`.

        A file that cannot be written is ignored; no planner can resume the run then.
        """
        now = since_boot_s()
        if now - self._renewed < ALIVE_S:
            return
        self._renewed = now
        path = _path(self.token)
        with contextlib.suppress(OSError):
            # Not synced to the disk: after a power cut the boot is another one.
            new = path.with_suffix('.new')
            new.write_text(f'{boot_id()} {now!r}\n')
            os.replace(new, path)

    def end(self) -> None:
        """Remove the liveness file: no planner resumes the run."""
        with contextlib.suppress(OSError):
            _path(self.token).unlink()


def silence_s(token: str) -> float | None:
    """Return the time since the planner of a run last renewed its liveness file, s.

    None if it did not in this boot of this computer, the run was ended, or `token` is no token.
    """
    if not token.isalnum():
        return None
    try:
        boot, _, renewed = _path(token).read_text().strip().partition(' ')
        passed_s = since_boot_s() - float(renewed)
    except (OSError, ValueError):
        return None
    return passed_s if boot == boot_id() and passed_s >= 0.0 else None


def _path(token: str) -> Path:
    """Return the path of the liveness file of a run. Raises InputError as `runtime_folder`."""
    return runtime_folder() / f'run_{token}'
