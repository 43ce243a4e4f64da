"""Writing to a disk that may be full: what it does not take is kept and tried again."""

from __future__ import annotations

import time
from collections.abc import Callable

from remaster_ros.errors import DiskError, MovedError

RETRY_S = 1.0
"""How often a full disk is tried again, s of wall time."""


class RetryingWriter:
    """One thing at a time that is to be written.

    Parameters
    ----------
    complain
        Called with the reason when the disk begins to be full.

    Attributes
    ----------
    full
        Why the disk does not take what waits; '' where nothing waits.
    """

    def __init__(self, complain: Callable[[str], object]) -> None:
        self._complain = complain
        self._waiting: Callable[[], object] | None = None
        self._tried = 0.0
        self._moved = False
        self.full = ''

    @property
    def why(self) -> str:
        """What is waited for, in words."""
        return self.full if self._moved else f'room on the disk: {self.full}'

    def write(self, write: Callable[[], object]) -> None:
        """Write; where the disk does not take it, `look` tries it again."""
        self._waiting, self._tried = None, time.monotonic()
        try:
            write()
        except DiskError as error:
            if not self.full:
                self._complain(str(error))
            self._waiting, self.full = write, str(error)
            self._moved = isinstance(error, MovedError)
        else:
            self.full = ''

    def look(self) -> None:
        """Try again what waits, now and then."""
        if self._waiting is not None and time.monotonic() - self._tried > RETRY_S:
            self.write(self._waiting)
