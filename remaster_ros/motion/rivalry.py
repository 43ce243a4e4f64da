# SPDX-License-Identifier: Apache-2.0
"""Which of two nodes of one name ends: the one that has been running for less long.

Each node publishes when it was started (an identity: text that no other start has) and for how
long it has been running. The rule needs no common clock of two hosts. Both never go on.
Both may end, where both were started within 1.5 s and their hosts' clocks differ.
"""

from __future__ import annotations

LISTEN_S = 1.5
"""A node without a summary of a rival for so long is alone, s. Summaries come twice a second."""
SHORTER_S = 0.5
"""A node that has been running for less time than its rival, by more than this, ends, s."""
SAME_S = 1.5
"""Up to this difference the identities decide, s. Wider than `SHORTER_S`: a message that is late
by up to half a second may make the two sides see different differences, and one still ends."""


class DuplicateNodeCheck:
    """Finds other nodes of the same name, and decides which of them has to give way.

    Parameters
    ----------
    started
        The identity of this node's start.

    Attributes
    ----------
    alone_since_s
        When the last summary of a rival came, or else the first own one, s of a monotonic clock;
        None before this node has received its own summary.
    """

    def __init__(self, started: str) -> None:
        self._started = started
        self.alone_since_s: float | None = None
        # For how long each rival had been running by its last summary, s.
        self._uptimes_s: dict[str, float] = {}

    def update_own(self, now_s: float) -> None:
        """Note the receipt of this node's own summary: it would receive others', too.

        ``now_s``: of a monotonic clock, s. Only the first one counts.
        """
        if self.alone_since_s is None:
            self.alone_since_s = now_s

    def update_other(
        self, started: str, uptime_s: float, own_uptime_s: float, now_s: float
    ) -> bool:
        """Process a summary of another node of this name.

        Parameters
        ----------
        started, uptime_s
            The other node's identity, and for how long it has been running, s.
        own_uptime_s, now_s
            For how long this node has been running, and the time, s.

        Returns
        -------
        bool
            Whether this node must end. Only from the second summary on: the last summary of a
            process that was killed may arrive after its successor was started.
        """
        before_s = self._uptimes_s.get(started)
        self._uptimes_s[started] = uptime_s
        if self.alone_since_s is not None:
            self.alone_since_s = now_s
        if before_s is None or not uptime_s > before_s:
            return False
        shorter_by_s = uptime_s - own_uptime_s
        if abs(shorter_by_s) <= SAME_S and self._started > started:
            return True
        return shorter_by_s > SHORTER_S

    def alone(self, now_s: float) -> bool:
        """Whether this node has listened for `LISTEN_S` without a summary of a rival.

        ``now_s``: of a monotonic clock, s; False before its own first summary.
        """
        return self.alone_since_s is not None and now_s - self.alone_since_s >= LISTEN_S
