# SPDX-License-Identifier: Apache-2.0
"""The sensors of a cell as the recorder follows them: readings, heartbeats, measure services."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from remaster_ros.collection.events import EventRecord, SensorReport
from remaster_ros.collection.message_fields import temperature_topic
from remaster_ros.collection.pairing import Pairing
from remaster_ros.collection.peers import RequiredSensors
from remaster_ros.collection.recording import Recording
from remaster_ros.errors import InputError
from remaster_ros.motion.liveness import Liveness
from remaster_ros.nodes.bagging import BagRecorder
from remaster_ros.nodes.measure_services import TriggeredSensors
from remaster_ros.nodes.running import RemasterNode
from remaster_ros.nodes.simulated_clock import SteadyTime
from remaster_ros.session.session_recorder import (
    Parameters,
    SessionRecorder,
)
from remaster_ros.session.workcell import Workcell


class CellSensors:
    """Subscribe to all sensors and find which are missing; `InputError` for a wrong require."""

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
