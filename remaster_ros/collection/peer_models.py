"""Whether all nodes of a cell compute with the same arm; times are arguments.

Two cell files with the joints of the same names (two types of one maker's arms) fit each other in
every message, and nothing but their checksums tells them apart.
"""

from __future__ import annotations

from remaster_ros.collection.events import ArmModel, EventRecord, PlannerState

SILENT_S = 3.0
"""A node without a record for so long (wall time) was ended, s: what it had counts no more."""


class PeerModels:
    """The arms that the other nodes compute with.

    Parameters
    ----------
    node
        This node's name with its namespace.
    model
        The arm that it computes with.
    """

    def __init__(self, node: str, model: ArmModel) -> None:
        self._node, self._model = node, model
        # When each node was last heard, wall time, s, and how its arm differs.
        self._peers: dict[str, tuple[float, str]] = {}

    def take(self, record: EventRecord, now: float) -> None:
        """Take the record of any node; wall time, s."""
        if record.node == self._node:
            return
        if record.model is not None:
            own, other = (name.rpartition('/')[2] for name in (self._node, record.node))
            self._peers[record.node] = now, self._model.difference(own, record.model, other)
        elif isinstance(record.body, PlannerState):
            # Whoever sends an arm somewhere must name it.
            why = f'the records of {record.node} do not tell which arm it plans for: run all nodes'
            self._peers[record.node] = now, f'{why} with the same version of remaster_ros'

    def trouble(self, now: float) -> str:
        """Return which node computes with another arm, ''."""
        troubles = (text for seen, text in self._peers.values() if now - seen <= SILENT_S)
        return next(filter(None, troubles), '')
