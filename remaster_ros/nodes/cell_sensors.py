"""The sensors of a cell as the recorder follows them: readings, heartbeats, measure services."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.client import Client
from rclpy.task import Future
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from remaster_ros.collection.events import EventRecord, SensorReport
from remaster_ros.collection.message_fields import temperature_topic
from remaster_ros.collection.pairing import Pairing
from remaster_ros.collection.recording import Recording
from remaster_ros.collection.required_sensors import RequiredSensors
from remaster_ros.errors import InputError
from remaster_ros.motion.liveness import Liveness
from remaster_ros.nodes.bagging import BagRecorder
from remaster_ros.nodes.running import RemasterNode
from remaster_ros.nodes.simulated_clock import SteadyTime
from remaster_ros.session.session_recorder import Parameters, SessionRecorder
from remaster_ros.session.workcell import Workcell

PATIENCE_WALL_S = 1.0
"""An answer counts after so long: in this time the status of the node may show that the instrument
is gone, and the reading of a measurement arrives."""
MISSING_WALL_S = 5.0
"""A service that is not there counts after so long: by then a node that died is absent."""


@dataclass
class _Shot:
    """A measurement: since when it is needed, the request, and when it was answered."""

    since_wall: float
    future: Future | None = None
    answered_wall: float | None = None


class TriggeredSensors:
    """The measurements that one configuration after the other needs.

    Parameters
    ----------
    clients
        Client of the measure service (std_srvs/Trigger), per sensor.
    """

    def __init__(self, clients: Mapping[str, Client]) -> None:
        self._clients = clients
        self._pairing: Pairing | None = None
        self._shots: dict[str, _Shot] = {}

    def look(self, pairing: Pairing, absent: Mapping[str, str], now: float) -> None:
        """Send the requests that this pairing still needs, and note the refusals.

        ``now`` is of the recorder's watchdogs, s.

        The request is sent again to a sensor that was absent meanwhile, and to one whose reading
        was lost.
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


class CellSensors:
    """Subscribe to the readings of all sensors, and find which sensors are missing.

    Parameters
    ----------
    node, p
        The recorder and its parameters.
    cell
        Its sensors.

    Raises
    ------
    InputError
        The parameter ``require`` names no sensor of the cell.

    Attributes
    ----------
    required
        The sensors that the arm waits for.
    """

    def __init__(self, node: RemasterNode, p: Parameters, cell: Workcell) -> None:
        try:
            self.required = RequiredSensors(cell.sensors, p.require)
        except InputError as error:
            raise InputError(f'{node.get_name()}: {error}') from None
        streams = [name for name, sensor in cell.sensors.items() if not sensor.single_shot]
        self._steady_s = SteadyTime(node, p.simulated_clock_rate)
        self._liveness = Liveness(cell.sensors, p.heartbeat_s, streams, since_s=self._steady_s())
        self._sensors = cell.sensors
        self._shots = TriggeredSensors(
            {
                name: node.create_client(Trigger, sensor.measure_service)
                for name, sensor in cell.sensors.items()
                if sensor.single_shot and sensor.measure_service and p.call_measure
            }
        )

    def subscribe(self, bag: BagRecorder, recorder: SessionRecorder) -> None:
        """Subscribe to the readings, through the bag."""
        for name, sensor in self._sensors.items():
            for marker, topic in sensor.topics.items():
                take = self._taker(recorder, name, marker)
                bag.subscribe(PointStamped, topic, None if sensor.pose_topic else take)
            if sensor.pose_topic:
                take = self._taker(recorder, name, sensor.marker)
                bag.subscribe(PoseStamped, sensor.pose_topic, take)
            topic = temperature_topic(sensor.topic)
            bag.subscribe(Temperature, topic, recorder.take_temperature)

    def _taker(self, recorder: SessionRecorder, sensor: str, marker: str) -> Callable[[Any], None]:
        def take(message: PointStamped | PoseStamped) -> None:
            if recorder.take_marker(sensor, marker, message):
                self._liveness.reads(sensor, self._steady_s())

        return take

    def take(self, record: EventRecord, report: SensorReport) -> None:
        """Take the state of a sensor's node."""
        self._liveness.node_reports(
            report.sensor,
            report.ready,
            report.message,
            self._steady_s(),
            record.started,
            hidden=report.hidden,
        )

    def missing(self) -> str:
        """Return which sensors the arm has to wait for, and why; ''."""
        return self.required.missing(self._absent())

    def read_age_s(self) -> dict[str, float | None]:
        """Return the time since the last reading of each sensor, s; None for never."""
        now = self._steady_s()
        ages_s = {name: self._liveness.read_age_s(name, now) for name in self._sensors}
        return {name: age_s if np.isfinite(age_s) else None for name, age_s in ages_s.items()}

    def trigger(self, pairing: Pairing) -> None:
        """Have single-shot sensors measure for the reading under way."""
        self._shots.look(pairing, self._absent(), self._steady_s())

    def give_up(self, recording: Recording) -> None:
        """Reject what does not come in time."""
        recording.give_up(self._absent(), self._liveness.reports)

    def _absent(self) -> dict[str, str]:
        return self._liveness.absent(self._steady_s(), self.required.names)
