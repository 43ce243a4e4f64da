# SPDX-License-Identifier: Apache-2.0
"""Session and bag of the recorder on a disk that may be full: failed writes are repeated."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from remaster_ros.collection.events import RecorderBegan
from remaster_ros.errors import DiskError, MovedError
from remaster_ros.nodes.bagging import BagRecorder
from remaster_ros.nodes.running import RemasterNode
from remaster_ros.session.records.session_journal import SessionJournal
from remaster_ros.session.records.session_yaml import ExitStatus
from remaster_ros.types import Session

RETRY_S = 1.0
"""Interval at which a failed write is repeated, s of wall time."""
CHECK_S = 1.0
"""Interval at which the session's files are checked for changes by others, s."""


class SessionKeeper:
    """Journal and bag of a session; a write that fails for lack of disk space is repeated.

    ``began``: first record of a bag; None for no bag.
    Attributes: ``journal, bag``; ``full``: why a write waits, '' if none does; ``restored``:
    the last repair of files that others had changed, '' before any.
    """

    def __init__(
        self, node: RemasterNode, folder: Path, header: Session, began: RecorderBegan | None
    ) -> None:
        self._node = node
        self.journal = SessionJournal(folder, header)
        self.bag = BagRecorder(node, folder / 'bag', began, begin=not self.journal.closed)
        self._waiting: Callable[[], object] | None = None
        self._tried_wall = self._checked_wall = time.monotonic()
        self._moved = False
        self.full = self.restored = ''

    @property
    def waits_for(self) -> str:
        """Condition under which the waiting write can succeed, as text; '' if none waits."""
        return self.full if self._moved or not self.full else f'room on the disk: {self.full}'

    def write(self, write: Callable[[], object]) -> None:
        """Call `write` now; if it raises DiskError, `full` says why, and `look` repeats it.

        One write waits at most, and a new one takes its place. Other errors are raised.
        """
        self._waiting, self._tried_wall = None, time.monotonic()
        try:
            write()
        except DiskError as error:
            if not self.full:
                self._node.get_logger().error(f'the arm is held: {error}')
            self._waiting, self.full = write, str(error)
            self._moved = isinstance(error, MovedError)
        else:
            self.full = ''

    def look(self) -> bool:
        """Repeat a failed write, and repair session files that others changed.

        Return whether a file was repaired since the last check. A write is repeated every
        `RETRY_S`, files are checked every `CHECK_S`; False between two checks. To be called
        often, by a timer.
        """
        now = time.monotonic()
        if self._waiting is not None and now - self._tried_wall > RETRY_S:
            self.write(self._waiting)
        if now - self._checked_wall < CHECK_S:
            return False
        self._checked_wall = now
        if not self.full:
            self.write(self.journal.check)
        return self._report_restored()

    def _report_restored(self) -> bool:
        """Log repairs of the session's files since the last call; return whether there were any.

        The last one is kept in `restored`.
        """
        lines = self.journal.take_restored()
        for line in lines:
            self._node.get_logger().error(line)
            self.restored = line
        return bool(lines)

    def reopen(self, *, go_further: bool = False) -> None:
        """Reopen a stopped session and its bag; with `go_further`, also a complete one.

        Without it a complete session stays closed. Raises InputError as `SessionWriter` and
        `BagRecorder.reopen`.
        """
        self.journal.reopen(go_further=go_further)
        self.bag.reopen()

    def close(self, exit_status: ExitStatus) -> None:
        """Close session and bag with an exit status.

        If the session could only be closed with a different status, since files were damaged
        beyond repair, that is logged as an error. Raises DiskError if the session remains
        open; the bag does too then.
        """
        self.journal.close(exit_status)
        self._report_restored()
        if self.journal.closed != exit_status:
            self._node.get_logger().error(
                f'the session is closed as {self.journal.closed}, not as {exit_status}: '
                f'{self.journal.beyond_repair}; its observations are all there'
            )
        self.bag.close()
