"""Collect what the preflight asks for from /remaster/status; make single-shot sensors measure."""

from __future__ import annotations

import time

from rclpy.client import Client
from rclpy.node import Node
from std_srvs.srv import Trigger

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
        self._said: dict[str, tuple[float, str, dict[str, str]]] = {}
        self._clients: dict[str, Client] = {
            name: node.create_client(Trigger, sensor.measure_service)
            for name, sensor in cell.sensors.items()
            if sensor.single_shot and sensor.measure_service
        }
        self._measured = dict.fromkeys(self._clients, float('-inf'))

    def on_summary(self, node: str, message: str, values: dict[str, str]) -> None:
        """Take a summary from /remaster/status."""
        key = f'sensor {values["sensor"]}' if 'sensor' in values else node
        self._said[key] = time.monotonic(), message, values

    def required(self) -> list[str]:
        """Return the sensors that the arm waits for, by the recorder's word."""
        require = self._values('recorder').get('require', 'all')
        return [name for name in self._cell.sensors if require in ('all', 'any', name)]

    @property
    def any_sensor(self) -> bool:
        """Whether one of them is enough."""
        return self._values('recorder').get('require') == 'any'

    def findings(self, *, seen_before: bool) -> tuple[str, ...]:
        """Return what is in the way.

        Parameters
        ----------
        seen_before
            The sensors have seen their markers in this session, and the arm may stand where
            they do not: a collection that is resumed.
        """
        bridge = self._values('robot_bridge')
        sensors = [self._sensor(name, seen_before) for name in self.required()]
        for sensor in sensors:
            if sensor.ready and sensor.read_age_s:
                self._measure(sensor.name)
        facts = Facts(
            joints_age_s=float(bridge.get('joints_age_s', 'inf')),
            joints_message=bridge.get('joints_trouble', ''),
            bridge_age_s=self._age_s('robot_bridge'),
            recorder_age_s=self._age_s('recorder'),
            sensors=sensors,
            any_sensor=self.any_sensor,
        )
        return preflight(facts)

    def _sensor(self, name: str, seen_before: bool) -> SensorFacts:
        key = f'sensor {name}'
        read_age_s = float(self._values('recorder').get(f'read_age_s_{name}', 'inf'))
        return SensorFacts(
            name=name,
            node_age_s=self._age_s(key),
            ready=self._values(key).get('ready') == 'yes',
            message=self._values(key).get('trouble', ''),
            read_age_s=0.0 if seen_before else read_age_s + self._age_s('recorder'),
        )

    def _measure(self, name: str) -> None:
        """Let a single-shot sensor show that it sees its marker."""
        now, client = time.monotonic(), self._clients.get(name)
        if client is None or now - self._measured[name] < MEASURE_EVERY_WALL_S:
            return
        if client.service_is_ready():
            self._measured[name] = now
            client.call_async(Trigger.Request())

    def _age_s(self, key: str) -> float:
        return time.monotonic() - self._said[key][0] if key in self._said else float('inf')

    def _values(self, key: str) -> dict[str, str]:
        return self._said[key][2] if key in self._said else {}
