"""Have single-shot sensors measure before the first motion."""

from __future__ import annotations

from collections.abc import Collection

from rclpy.client import Client
from rclpy.node import Node
from std_srvs.srv import Trigger

from remaster_ros.session.workcell import Workcell

MEASURE_EVERY_WALL_S = 5.0
"""How often a single-shot sensor measures until its marker was seen, wall time."""


class MeasureCalls:
    """Have single-shot sensors show that they see their markers.

    Parameters
    ----------
    node
        The node that calls.
    cell
        Its sensors.
    """

    def __init__(self, node: Node, cell: Workcell) -> None:
        self._clients: dict[str, Client] = {
            name: node.create_client(Trigger, sensor.measure_service)
            for name, sensor in cell.sensors.items()
            if sensor.single_shot and sensor.measure_service
        }
        self._called_wall = dict.fromkeys(self._clients, float('-inf'))

    def call(self, names: Collection[str], now: float) -> None:
        """Call the measure services of these sensors, each now and then; wall time, s."""
        for name, client in self._clients.items():
            due = now - self._called_wall[name] >= MEASURE_EVERY_WALL_S
            if name in names and due and client.service_is_ready():
                self._called_wall[name] = now
                client.call_async(Trigger.Request())
