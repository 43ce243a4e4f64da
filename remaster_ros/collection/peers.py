# SPDX-License-Identifier: Apache-2.0
"""The other nodes of a cell, by their records: their last states, and whether they mean one arm.

Times are wall time and arguments.

Two cell files with the joints of the same names (two types of one maker's arms) fit each other in
every message, and nothing but their checksums tells them apart.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

from remaster_ros.collection.events import (
    ArmModel,
    BridgeState,
    EventRecord,
    PlannerState,
    RecorderState,
    SensorReport,
)
from remaster_ros.errors import InputError
from remaster_ros.motion.preflight import Facts, SensorFacts

NEVER_S = float('inf')
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


class RequiredSensors:
    """The sensors of a cell that the arm waits for.

    Parameters
    ----------
    names
        All sensors of the cell.
    require
        ``all``, ``any`` (one of them is enough), or the name of one.

    Raises
    ------
    InputError
        `require` is none of these.

    Attributes
    ----------
    names
        The sensors that the arm waits for, or for one of them.
    any_of_them
        Whether one of them is enough.
    """

    def __init__(self, names: Iterable[str], require: str) -> None:
        known = tuple(names)
        if require not in ('all', 'any', *known):
            raise InputError(
                f'parameter require is {require!r}; it must be all, any or one of '
                f'{", ".join(known)}'
            )
        self.names = [name for name in known if require in ('all', 'any', name)]
        self.any_of_them = require == 'any'

    def missing(self, absent: Mapping[str, str]) -> str:
        """Return which sensors have to come back before the arm goes on, and why; ''.

        Parameters
        ----------
        absent
            The sensors that are not there, and why.
        """
        gone = [name for name in self.names if name in absent]
        if not gone or (self.any_of_them and len(gone) < len(self.names)):
            return ''
        return '; '.join(f'{name}: {absent[name]}' for name in gone)

    def are_among(self, found: Collection[str]) -> bool:
        """Whether what the arm waits for is among these sensors."""
        known = [name in found for name in self.names]
        return any(known) if self.any_of_them else all(known)


class Heard(NamedTuple):
    """A node's last state: what it was, when it came, s, and which start of the node sent it."""

    body: BridgeState | RecorderState
    wall: float
    started: str


class Peers:
    """The last states of bridge, recorder and sensors.

    Parameters
    ----------
    sensors
        All sensors of the cell.
    """

    def __init__(self, sensors: Iterable[str]) -> None:
        self._names = tuple(sensors)
        self._heard: dict[str, Heard] = {}
        # Of each sensor, and when it came, s.
        self._reports: dict[str, tuple[SensorReport, float]] = {}

    def take(self, record: EventRecord, now: float) -> None:
        """Take what a node published; anything but these states is ignored."""
        match record.body:
            case BridgeState() | RecorderState() as body:
                self._heard[body.sender] = Heard(body, now, record.started)
            case SensorReport() as report:
                self._reports[report.sensor] = report, now

    def heard(self, node: str) -> Heard | None:
        """Return what came last of ``robot_bridge`` or ``recorder``; None before the first."""
        return self._heard.get(node)

    @property
    def bridge(self) -> BridgeState | None:
        """Its last state; None before the first."""
        heard = self._heard.get(BridgeState.sender)
        return heard.body if heard and isinstance(heard.body, BridgeState) else None

    @property
    def recorder(self) -> RecorderState | None:
        """Its last state; None before the first."""
        heard = self._heard.get(RecorderState.sender)
        return heard.body if heard and isinstance(heard.body, RecorderState) else None

    def required(self) -> RequiredSensors:
        """Return the sensors that the arm waits for, as the recorder is set.

        Raises
        ------
        InputError
            The recorder waits for a sensor that this cell does not have.
        """
        recorder = self.recorder
        return RequiredSensors(self._names, 'all' if recorder is None else recorder.require)

    def facts(self, now: float, *, seen_before: bool) -> Facts:
        """Return what the preflight judges now; `InputError` as `required`.

        Parameters
        ----------
        seen_before
            The sensors have seen their markers in this session, and the arm may stand where
            they do not: a collection that is resumed.
        """
        required, bridge = self.required(), self.bridge or BridgeState(halted='')
        return Facts(
            joints_age_s=_age_s(bridge.joints_age_s),
            joints_message=bridge.joints_trouble,
            bridge_age_s=self._since_s(BridgeState.sender, now),
            recorder_age_s=self._since_s(RecorderState.sender, now),
            sensors=[self._sensor_facts(name, now, seen_before) for name in required.names],
            any_sensor=required.any_of_them,
        )

    def _sensor_facts(self, name: str, now: float, seen_before: bool) -> SensorFacts:
        nothing = SensorReport(sensor=name, ready=False), -NEVER_S
        report, came = self._reports.get(name, nothing)
        age_s = None if self.recorder is None else self.recorder.read_age_s.get(name)
        read_s = _age_s(age_s) + self._since_s(RecorderState.sender, now)
        return SensorFacts(
            name=name,
            node_age_s=now - came,
            ready=report.ready,
            message=report.trouble,
            read_age_s=0.0 if seen_before else read_s,
        )

    def _since_s(self, node: str, now: float) -> float:
        heard = self._heard.get(node)
        return NEVER_S if heard is None else now - heard.wall


def _age_s(age_s: float | None) -> float:
    return NEVER_S if age_s is None else age_s
