# SPDX-License-Identifier: Apache-2.0
"""Files of this user outside of every session: locks of nodes, and the way to the live page.

There is one process per node name and ROS domain on this computer, by a lock that the kernel
keeps. The lock (flock) goes with the process, however that ends: a node that was killed can be
started again at once. What runs on another computer, or for another user, is distinguished by
/remaster/events (see `remaster_ros.nodes.status.NodeStatus`).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
import time
from pathlib import Path

from remaster_ros.errors import InputError

PATIENCE_S = 1.0
"""How long a process that is just ending is waited for, s."""


def runtime_folder() -> Path:
    """Return this user's folder for locks and other runtime files; made if missing, mode 700.

    Always below /tmp: XDG_RUNTIME_DIR is set in one shell and not in the other (ssh,
    services), and two processes must find the same folder.

    Raises InputError: it belongs to another user, is open to others, or cannot be made.
    """
    folder = Path('/tmp') / f'remaster_ros_{os.getuid()}'
    try:
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        found = folder.lstat()
    except OSError as error:
        raise InputError(f'{folder}: cannot be made ({error.strerror})') from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise InputError(f'{folder} belongs to another user; remove it')
    if stat.S_IMODE(found.st_mode) & 0o077:
        raise InputError(f'{folder} is open to other users; chmod 700 {folder}')
    return folder


class NameLock:
    """The right to be the node of a name in a domain; kept until `release` or the process's end.

    ``name``: the node's fully qualified name, such as ``/left/recorder``.
    Raises InputError: another process of this user is that node; names its process id.
    """

    def __init__(self, domain: int, name: str, patience_s: float = PATIENCE_S) -> None:
        self.path = runtime_folder() / f'domain_{domain}{name.replace("/", ".")}.lock'
        try:
            self._file = os.open(
                self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600
            )
        except OSError as error:
            raise InputError(f'{self.path}: cannot be opened ({error.strerror})') from None
        try:
            self._lock(domain, name, patience_s)
        except BaseException:
            os.close(self._file)
            raise
        # A lock is shared with a forked child, and would live on in it.
        os.register_at_fork(after_in_child=self._close)
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, f'{os.getpid()}\n'.encode(), 0)

    def _lock(self, domain: int, name: str, patience_s: float) -> None:
        """Lock the file, waiting up to `patience_s`; InputError if another process holds it.

        The error has that process's id, if the file has it.
        """
        deadline = time.monotonic() + patience_s
        while True:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                if time.monotonic() < deadline:
                    time.sleep(0.02)
                    continue
            holder = os.pread(self._file, 32, 0).decode(errors='replace').strip()
            raise InputError(
                f'{name} is running already in ROS domain {domain}'
                f'{f" (process {holder})" if holder else ""}; end that one, or give this one a '
                'namespace (__ns:=/…) or a domain (ROS_DOMAIN_ID) of its own'
            )

    def release(self) -> None:
        """Let another process be this node; again does nothing."""
        self._close()

    def _close(self) -> None:
        """Close the lock's file, if open; the lock ends once no process has the file open."""
        file, self._file = self._file, -1
        if file >= 0:
            os.close(file)
