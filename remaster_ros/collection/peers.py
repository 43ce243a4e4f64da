# SPDX-License-Identifier: Apache-2.0
"""Other nodes of a cell by their records: their last states, and whether all compute with one arm.

Times are wall time and arguments. Two cell files with the same joint names (two types of one
maker's arms) fit each other in every message: only their checksums differ.
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
"""Time without a record, s of wall time, after which a node has ended and its state is void."""


class PeerModels:
    """Comparison of the arm models that other nodes compute with to that of this node.

    ``node``: name of this node with its namespace; ``model``: arm that it computes with.
    """

    def __init__(self, node: str, model: ArmModel) -> None:
        self._node, self._model = node, model
        # Wall time of each node's last record, s, and the difference of its arm.
        self._peers: dict[str, tuple[float, str]] = {}

    def take(self, record: EventRecord, now: float) -> None:
        """Compare the arm model in another node's record with this node's; keep the difference.

        A planner that names no arm is a fault; records of this node, and of other nodes
        without a model, are ignored. ``now``: wall time, s.
        """
        if record.node == self._node:
            return
        if record.model is not None:
            own_name, other = (name.rpartition('/')[2] for name in (self._node, record.node))
            self._peers[record.node] = now, self._model.difference(own_name, record.model, other)
        elif isinstance(record.body, PlannerState):
            # A node that moves an arm must name it.
            why = f'the records of {record.node} do not tell which arm it plans for: run all nodes'
            self._peers[record.node] = now, f'{why} with the same version of remaster_ros'

    def trouble(self, now: float) -> str:
        """Sentence on a node that computes with another arm; '' if none does.

        Nodes that were silent for more than `SILENT_S` do not count. ``now``: wall time, s.
        """
        troubles = (text for seen, text in self._peers.values() if now - seen <= SILENT_S)
        return next(filter(None, troubles), '')


class RequiredSensors:
    """Sensors of a cell that the arm waits for.

    Parameters
    ----------
    names
        All sensors of the cell.
    require
        ``all``, ``any`` (one of them is enough), or the name of one.

    Raises
    ------
    InputError
        If `require` is none of these.

    Attributes
    ----------
    names
        Sensors that the arm waits for, or for one of which it waits.
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
        """Sensors that have to come back before the arm continues, with reasons, as text.

        '' if there is none: no sensor that the arm waits for is absent, or, of `any_of_them`,
        not all are. ``absent``: reason by name of each absent sensor.
        """
        gone = [name for name in self.names if name in absent]
        if not gone or (self.any_of_them and len(gone) < len(self.names)):
            return ''
        return '; '.join(f'{name}: {absent[name]}' for name in gone)

    def are_among(self, found: Collection[str]) -> bool:
        """Whether `found` has all sensors that the arm waits for, or, of `any_of_them`, one."""
        known = [name in found for name in self.names]
        return any(known) if self.any_of_them else all(known)


class LastState(NamedTuple):
    """Last state of a node, its wall time of arrival, s, and the start of that node."""

    body: BridgeState | RecorderState
    wall: float
    started: str


class Peers:
    """Last states of bridge, recorder and sensors, by their records.

    ``sensors``: all sensors of the cell.
    """

    def __init__(self, sensors: Iterable[str]) -> None:
        self._names = tuple(sensors)
        self._heard: dict[str, LastState] = {}
        # Report of each sensor, and wall time of its arrival, s.
        self._reports: dict[str, tuple[SensorReport, float]] = {}

    def take(self, record: EventRecord, now: float) -> None:
        """Keep the state of bridge, recorder or a sensor in a record; other records are ignored.

        ``now``: wall time of its arrival, s.
        """
        match record.body:
            case BridgeState() | RecorderState() as body:
                self._heard[body.sender] = LastState(body, now, record.started)
            case SensorReport() as report:
                self._reports[report.sensor] = report, now

    def heard(self, node: str) -> LastState | None:
        """Last state of ``robot_bridge`` or ``recorder``; None before the first."""
        return self._heard.get(node)

    @property
    def bridge(self) -> BridgeState | None:
        """Last state of the bridge; None before the first."""
        heard = self._heard.get(BridgeState.sender)
        return heard.body if heard and isinstance(heard.body, BridgeState) else None

    @property
    def recorder(self) -> RecorderState | None:
        """Last state of the recorder; None before the first."""
        heard = self._heard.get(RecorderState.sender)
        return heard.body if heard and isinstance(heard.body, RecorderState) else None

    def required(self) -> RequiredSensors:
        """Sensors that the arm waits for, by the recorder's last state; before one, all.

        Raises InputError if the recorder waits for a sensor that this cell does not have.
        """
        recorder = self.recorder
        return RequiredSensors(self._names, 'all' if recorder is None else recorder.require)

    def facts(self, now: float, *, seen_before: bool) -> Facts:
        """Present facts for the preflight; raises `InputError` as `required`.

        ``seen_before``: whether the sensors have seen their markers earlier in this session,
        as in a collection that is resumed: then the arm may stand where no marker is in view,
        and the age of the readings is 0. ``now``: wall time, s.
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
        """Facts on a sensor: age of node and reading, s, whether it is ready, and its message.

        A sensor without a report is not ready, and its node infinitely old. The age of the reading
        is 0 if ``seen_before``; else its age in the recorder's last state plus the time since that
        state; infinite if the recorder has sent no state or has no reading of the sensor. ``now``:
        wall time, s.
        """
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
        """Wall time since a node's last state, s; infinite before the first.

        ``node``: the sender's name; ``now``: wall time, s.
        """
        heard = self._heard.get(node)
        return NEVER_S if heard is None else now - heard.wall


def _age_s(age_s: float | None) -> float:
    """Age, s; infinite for None."""
    return NEVER_S if age_s is None else age_s
