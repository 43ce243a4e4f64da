"""Collect the facts of the preflight from the nodes' states; make single-shot sensors measure."""

from __future__ import annotations

import time

from rclpy.client import Client
from rclpy.node import Node
from std_srvs.srv import Trigger

from remaster_ros.collection.events import (
    BridgeState,
    Event,
    RecorderState,
    SensorReport,
    State,
)
from remaster_ros.motion.preflight import Facts, SensorFacts, preflight
from remaster_ros.session.workcell import Workcell

MEASURE_EVERY_WALL_S = 5.0


class PreflightMonitor:
    """Whether the arm may move for the first time.

    Parameters
    ----------
    node
        The node that asks.
    cell
        Its sensors.
    """

    def __init__(self, node: Node, cell: Workcell) -> None:
        self._cell = cell
        self._bridge, self._recorder = BridgeState(halted=''), RecorderState(waiting_for='')
        self._sensors: dict[str, SensorReport] = {}
        # When each of them came, wall time, s.
        self._came: dict[str, float] = {}
        self._clients: dict[str, Client] = {
            name: node.create_client(Trigger, sensor.measure_service)
            for name, sensor in cell.sensors.items()
            if sensor.single_shot and sensor.measure_service
        }
        self._measured = dict.fromkeys(self._clients, float('-inf'))

    def take(self, state: State | Event) -> None:
        """Take what a node published."""
        match state:
            case BridgeState():
                self._bridge, source = state, state.sender
            case RecorderState():
                self._recorder, source = state, state.sender
            case SensorReport(sensor=name):
                self._sensors[name], source = state, f'sensor {name}'
            case _:
                return
        self._came[source] = time.monotonic()

    def required(self) -> list[str]:
        """Return the sensors that the arm waits for, as the recorder is set."""
        require = self._recorder.require
        return [name for name in self._cell.sensors if require in ('all', 'any', name)]

    @property
    def any_sensor(self) -> bool:
        """Whether one of them is enough."""
        return self._recorder.require == 'any'

    def findings(self, *, seen_before: bool) -> tuple[str, ...]:
        """Return what is in the way.

        Parameters
        ----------
        seen_before
            The sensors have seen their markers in this session, and the arm may stand where
            they do not: a collection that is resumed.
        """
        bridge = self._bridge
        sensors = [self._sensor(name, seen_before) for name in self.required()]
        for sensor in sensors:
            if sensor.ready and sensor.read_age_s:
                self._measure(sensor.name)
        facts = Facts(
            joints_age_s=_age(bridge.joints_age_s),
            joints_message=bridge.joints_trouble,
            bridge_age_s=self._age_s('robot_bridge'),
            recorder_age_s=self._age_s('recorder'),
            sensors=sensors,
            any_sensor=self.any_sensor,
        )
        return preflight(facts)

    def _sensor(self, name: str, seen_before: bool) -> SensorFacts:
        report = self._sensors.get(name, SensorReport(sensor=name, ready=False))
        read_age_s = _age(self._recorder.read_age_s.get(name)) + self._age_s('recorder')
        return SensorFacts(
            name=name,
            said_age_s=self._age_s(f'sensor {name}'),
            ready=report.ready,
            message=report.trouble,
            read_age_s=0.0 if seen_before else read_age_s,
        )

    def _measure(self, name: str) -> None:
        """Let a single-shot sensor show that it sees its marker."""
        now, client = time.monotonic(), self._clients.get(name)
        if client is None or now - self._measured[name] < MEASURE_EVERY_WALL_S:
            return
        if client.service_is_ready():
            self._measured[name] = now
            client.call_async(Trigger.Request())

    def _age_s(self, source: str) -> float:
        return time.monotonic() - self._came.get(source, float('-inf'))


def _age(age_s: float | None) -> float:
    """Return an age, s; infinite for what never was."""
    return float('inf') if age_s is None else age_s
