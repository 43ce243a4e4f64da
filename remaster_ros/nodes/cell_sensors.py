# SPDX-License-Identifier: Apache-2.0
"""The sensors of a cell as the recorder follows them: readings, liveness, measure services."""

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
from remaster_ros.session.cells.workcell import Workcell
from remaster_ros.session.session_recorder import (
    Parameters,
    SessionRecorder,
)


class CellSensors:
    """Subscriptions to all sensors of a cell, and their liveness.

    Raises InputError if the parameter `require` names an unknown sensor.
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
        """Subscribe to all readings, which go to the bag and to the recorder."""
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
        """Return the callback for a marker's readings, which calls `recorder.take_marker`.

        If that accepts the reading, the sensor counts as alive.
        """

        def take(message: PointStamped | PoseStamped) -> None:
            if recorder.take_marker(sensor, marker, message):
                self._liveness.reads(sensor, self._steady_s())

        return take

    def take(self, record: EventRecord, report: SensorReport) -> None:
        """Update the liveness of a sensor by its node's report, carried by `record`."""
        self._liveness.node_reports(
            report.sensor,
            report.ready,
            report.message,
            self._steady_s(),
            record.started,
            hidden=report.hidden,
        )

    def missing(self) -> str:
        """Return the required sensors that are absent, and why, as text; '' if none is."""
        return self.required.missing(self._absent())

    def read_age_s(self) -> dict[str, float | None]:
        """Return the time since the last reading of each sensor, s; None if there was none."""
        now = self._steady_s()
        ages_s = {name: self._liveness.read_age_s(name, now) for name in self._sensors}
        return {name: age_s if np.isfinite(age_s) else None for name, age_s in ages_s.items()}

    def trigger(self, pairing: Pairing) -> None:
        """Request measurements that a configuration under way still needs of single-shot sensors.

        Absent sensors are left out. Returns at once; to be called until all sensors of the
        ``pairing`` (the readings of that configuration) are decided.
        """
        self._shots.look(pairing, self._absent(), self._steady_s())

    def give_up(self, recording: Recording) -> None:
        """Reject sensors whose readings of the configuration under way are overdue.

        Required sensors that are absent are waited for, see `Pairing.give_up`. Nothing if no
        configuration is being read.
        """
        recording.give_up(self._absent(), self._liveness.reports)

    def _absent(self) -> dict[str, str]:
        """Return the sensors that are absent now, name -> reason; {} if there are none."""
        return self._liveness.absent(self._steady_s(), self.required.names)
