# SPDX-License-Identifier: Apache-2.0
"""The session and the bag of the recorder on a disk that may be full."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from remaster_ros.collection.events import RecorderBegan
from remaster_ros.errors import DiskError, MovedError
from remaster_ros.nodes.bagging import BagRecorder
from remaster_ros.nodes.running import RemasterNode
from remaster_ros.session.session_journal import SessionJournal
from remaster_ros.session.session_yaml import ExitStatus
from remaster_ros.types import Session

RETRY_S = 1.0
"""How often a full disk is tried again, s of wall time."""
CHECK_S = 1.0
"""How often it is looked whether the session's files are still the ones that are written, s."""


class SessionKeeper:
    """Write a session, one thing at a time.

    ``began``: what a bag begins with; None to record none.
    Attributes: ``journal, bag``: what is written; ``full``: why the disk does not take what waits;
    '' where nothing waits; ``restored``: what was last found changed by others and restored; ''.
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
        """What has to happen before anything can be written; ''."""
        return self.full if self._moved or not self.full else f'room on the disk: {self.full}'

    def write(self, write: Callable[[], object]) -> None:
        """Call `write`; where the disk does not take it, `look` tries it again."""
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
        """Try again what waits, and restore what others did to the files, once a second.

        Returns whether something was restored.
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
        lines = self.journal.take_restored()
        for line in lines:
            self._node.get_logger().error(line)
            self.restored = line
        return bool(lines)

    def reopen(self, *, go_further: bool = False) -> None:
        """Go on with a session that was stopped; with `go_further`, with one that is complete."""
        self.journal.reopen(go_further=go_further)
        self.bag.reopen()

    def close(self, exit_status: ExitStatus) -> None:
        """Close session and bag; `DiskError` where the session remains open."""
        self.journal.close(exit_status)
        self._report_restored()
        if self.journal.closed != exit_status:
            self._node.get_logger().error(
                f'the session is closed as {self.journal.closed}, not as {exit_status}: '
                f'{self.journal.beyond_repair}; its observations are all there'
            )
        self.bag.close()
