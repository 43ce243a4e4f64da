# SPDX-License-Identifier: Apache-2.0
"""Which nodes have the pose under way: an announcement that one of them missed is repeated.

A node that lags is sent the same announcement, with the same stamp: nodes that have it already
take it for the one that they have, and go on. Only for a node that was started anew the pose is
announced anew, with what is left of it.

Times are wall time and arguments.
"""

from __future__ import annotations

from enum import Enum

from remaster_ros.collection.events import BridgeState, RecorderState
from remaster_ros.collection.peers import Heard, Peers

ANNOUNCE_WALL_S = 5.0
"""A node that does not have an announcement so long after it has missed it, s: at first."""
LONGEST_WALL_S = 80.0
"""That wait doubles with each repetition up to this, s: the node or its network is overloaded, and
what is sent to it delays what it has still to take."""
MATCH_WALL_S = 0.5
"""The other side of a DDS match comes so much later than ours at most, s."""
PEERS = BridgeState.sender, RecorderState.sender
"""Nodes that a pose is announced to. A viewer or `ros2 topic echo` stands for none of them."""


class Lack(Enum):
    """Why bridge or recorder has not the open pose."""

    NOTHING = 'both have it, or may still get it'
    LATE = 'it lags: the announcement is repeated as it was'
    ANEW = 'not announced yet, or the node was started since: what is left is announced anew'


class Announcements:
    """Follow the announcements of the open pose, as bridge and recorder have them."""

    def __init__(self, peers: Peers) -> None:
        self._peers = peers
        # Of the last announcement, by which the others name it; '' where the pose is to be
        # announced anew.
        self.stamp = ''
        self._announced_wall, self._wait_wall = 0.0, ANNOUNCE_WALL_S
        # Which start of each peer was there when the pose was announced.
        self._told: dict[str, str] = {}
        self._matched_wall: float | None = None

    def matched(self, subscribers: int, now: float) -> bool:
        """Whether bridge and recorder are there for the next pose.

        A recorder with a complete session has to open that again first.

        Parameters
        ----------
        subscribers
            How many subscribe to the solutions, as DDS shows it.
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
        """Note that the pose is announced; with an unchanged stamp the next wait doubles."""
        again = stamp == self.stamp
        self._wait_wall = min(2.0 * self._wait_wall, LONGEST_WALL_S) if again else ANNOUNCE_WALL_S
        self.stamp, self._announced_wall = stamp, now
        self._told = {node: heard.started for node, heard in self._heard()}

    def lack(self) -> Lack:
        """Return whether the open pose is to be announced (again), and how.

        A peer that was started after the announcement lacks it, and one whose state shows another
        pose some time later. While the recorder measures nothing is announced: what comes of that
        is not left of the pose any more.
        """
        if (recorder := self._peers.recorder) is not None and recorder.state == 'measuring':
            return Lack.NOTHING
        if not self.stamp:
            return Lack.ANEW
        without = [(node, one) for node, one in self._heard() if one.body.pose != self.stamp]
        if any(one.started != self._told.get(node) for node, one in without):
            return Lack.ANEW
        missed_wall = self._announced_wall + self._wait_wall
        return Lack.LATE if any(one.wall > missed_wall for _, one in without) else Lack.NOTHING

    def _heard(self) -> list[tuple[str, Heard]]:
        found = [(node, self._peers.heard(node)) for node in PEERS]
        return [(node, heard) for node, heard in found if heard is not None]

    def retract(self) -> None:
        """Have what is left of the open pose announced anew before anything else."""
        self.stamp = ''
