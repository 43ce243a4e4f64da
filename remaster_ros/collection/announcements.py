# SPDX-License-Identifier: Apache-2.0
"""Announcements of the visit under way: repeated if bridge or recorder missed one.

A late node gets the same announcement again, with the same stamp; nodes that have it already
ignore it. If a node was restarted, the remaining solutions are announced with a new stamp.

Times are wall time and arguments.
"""

from __future__ import annotations

from enum import Enum

from remaster_ros.collection.events import BridgeState, RecorderState
from remaster_ros.collection.peers import LastState, Peers

ANNOUNCE_WALL_S = 5.0
"""First time after which an announcement counts as missed, s."""
LONGEST_WALL_S = 80.0
"""Longest such time, s: it doubles with each repetition, as the node or network is overloaded."""
MATCH_WALL_S = 0.5
"""Longest delay of the other side of a DDS match, s."""
PEERS = BridgeState.sender, RecorderState.sender
"""Nodes that need an announcement, unlike viewers or `ros2 topic echo`."""


class Lack(Enum):
    """Why bridge or recorder does not have the visit under way."""

    NOTHING = 'both have it, or may still get it'
    LATE = 'it lags: the announcement is repeated as it was'
    ANEW = 'not announced yet, or the node was started since: what is left is announced anew'


class Announcements:
    """State of the announcement of the visit under way at bridge and recorder."""

    def __init__(self, peers: Peers) -> None:
        self._peers = peers
        # Stamp of the last announcement; '' if a new one is necessary.
        self.stamp = ''
        self._announced_wall, self._wait_wall = 0.0, ANNOUNCE_WALL_S
        # Start time of each node that was there at the announcement.
        self._started: dict[str, str] = {}
        self._matched_wall: float | None = None

    def matched(self, subscribers: int, now: float) -> bool:
        """Whether bridge and recorder are ready for the next pose.

        They are once both have reported and subscribed for `MATCH_WALL_S`; not while the
        recorder's session is complete, until it has reopened it. ``subscribers``: number of
        subscribers of the solutions by DDS; ``now``: wall time, s.
        """
        recorder = self._peers.recorder
        if subscribers < len(PEERS) or self._peers.bridge is None or recorder is None:
            self._matched_wall = None
            return False
        if self._matched_wall is None:
            self._matched_wall = now
        if recorder.exit_status == 'complete':
            return False
        return now - self._matched_wall > MATCH_WALL_S

    def announced(self, stamp: str, now: float) -> None:
        """Note an announcement at `now`, wall time, s; it counts as missed after a wait.

        ``stamp``: of the announcement. The wait is `ANNOUNCE_WALL_S`; for a repetition, which
        has the same stamp as the announcement before, it is twice the wait before, at most
        `LONGEST_WALL_S`.
        """
        is_repeated = stamp == self.stamp
        self._wait_wall = (
            min(2.0 * self._wait_wall, LONGEST_WALL_S) if is_repeated else ANNOUNCE_WALL_S
        )
        self.stamp, self._announced_wall = stamp, now
        self._started = {node: heard.started for node, heard in self._heard()}

    def lack(self) -> Lack:
        """Return whether, and how, the visit under way has to be announced (again).

        `Lack.ANEW` if it was not announced, or if bridge or recorder shows another pose and
        was started since the announcement. `Lack.LATE` if the last state of one of them shows
        another pose and came after the wait of `announced`. Else `Lack.NOTHING`; also while
        the recorder measures, since the outcome changes the remaining solutions.
        """
        if (recorder := self._peers.recorder) is not None and recorder.state == 'measuring':
            return Lack.NOTHING
        if not self.stamp:
            return Lack.ANEW
        lacking = [(node, state) for node, state in self._heard() if state.body.pose != self.stamp]
        if any(state.started != self._started.get(node) for node, state in lacking):
            return Lack.ANEW
        missed_wall = self._announced_wall + self._wait_wall
        return Lack.LATE if any(state.wall > missed_wall for _, state in lacking) else Lack.NOTHING

    def _heard(self) -> list[tuple[str, LastState]]:
        """Return name and last state of bridge and recorder, if it has come."""
        states = [(node, self._peers.heard(node)) for node in PEERS]
        return [(node, heard) for node, heard in states if heard is not None]

    def retract(self) -> None:
        """Forget the announcement, so that what remains is announced with a new stamp."""
        self.stamp = ''
