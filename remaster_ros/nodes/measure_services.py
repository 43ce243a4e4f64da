# SPDX-License-Identifier: Apache-2.0
"""Measure services of single-shot sensors: for a configuration, and for a preflight."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from remaster_ros.collection.pairing import Pairing
from remaster_ros.session.cells.workcell import Workcell

PATIENCE_WALL_S = 1.0
"""Time from an answer until it counts: meanwhile the reading arrives, or the status of the node
shows that the instrument is gone."""
MISSING_WALL_S = 5.0
"""Time until a missing service counts as a failure: by then a dead node is known as absent."""

MEASURE_EVERY_WALL_S = 5.0
"""Interval of a sensor's measurements until its marker was seen, s of wall time."""


@dataclass
class _Shot:
    """A measurement that a sensor's service is to make, and its request."""

    since_wall: float  # When it was first needed
    future: Future | None = None  # Of the request
    answered_wall: float | None = None


class TriggeredSensors:
    """Measurement requests to single-shot sensors, for one configuration after the other."""

    def __init__(self, clients: Mapping[str, Client]) -> None:
        self._clients = clients
        self._pairing: Pairing | None = None
        self._shots: dict[str, _Shot] = {}

    def look(self, pairing: Pairing, absent: Mapping[str, str], now: float) -> None:
        """Send measurement requests that a pairing still needs; report failures to the pairing.

        Returns at once, to be called again until all sensors are decided. A service that is
        missing for `MISSING_WALL_S` is a failure, as is a refusal. A request is repeated to a
        sensor that was absent meanwhile, and to one whose reading was lost. ``absent``: sensor
        -> why; ``now``: time of the recorder's watchdogs, s.
        """
        if pairing is not self._pairing:
            self._pairing, self._shots = pairing, {}
        for name, client in self._clients.items():
            if name in absent or name in pairing.decided:
                self._shots.pop(name, None)
                continue
            shot = self._shots.setdefault(name, _Shot(now))
            if shot.future is not None:
                self._take_answer(name, shot, pairing, now)
            elif client.service_is_ready():
                shot.future = client.call_async(Trigger.Request())
            elif now - shot.since_wall > MISSING_WALL_S:
                pairing.fail(name, f'the service {client.srv_name} is not there')

    def _take_answer(self, name: str, shot: _Shot, pairing: Pairing, now: float) -> None:
        """Report a refused request to the pairing; forget an accepted one whose reading was lost.

        Until `PATIENCE_WALL_S` after the service's answer nothing is done, as the reading may
        still come. A lost reading is requested again by the next `look`. ``name``: the sensor;
        ``now``: wall time, s.
        """
        assert shot.future is not None
        response = shot.future.result() if shot.future.done() else None
        if response is None:
            return
        if shot.answered_wall is None:
            shot.answered_wall = now
        if now - shot.answered_wall <= PATIENCE_WALL_S:
            return
        if not response.success:
            pairing.fail(name, response.message)
        elif not pairing.has_reading(name):
            del self._shots[name]


class MeasureCalls:
    """Measurement requests to single-shot sensors until they have seen their markers."""

    def __init__(self, node: Node, cell: Workcell) -> None:
        self._clients: dict[str, Client] = {
            name: node.create_client(Trigger, sensor.measure_service)
            for name, sensor in cell.sensors.items()
            if sensor.single_shot and sensor.measure_service
        }
        self._called_wall = dict.fromkeys(self._clients, float('-inf'))

    def call(self, names: Collection[str], now: float) -> None:
        """Request a measurement of these sensors, each at most every `MEASURE_EVERY_WALL_S`.

        ``now``: wall time, s. Sensors without a service, or whose service is not ready, are left
        out. Answers are ignored.
        """
        for name, client in self._clients.items():
            due = now - self._called_wall[name] >= MEASURE_EVERY_WALL_S
            if name in names and due and client.service_is_ready():
                self._called_wall[name] = now
                client.call_async(Trigger.Request())
