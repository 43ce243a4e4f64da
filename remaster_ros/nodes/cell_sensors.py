"""The sensors of a cell as the recorder follows them: readings, heartbeats, measure services."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import Point, PointStamped, PoseStamped
from sensor_msgs.msg import Temperature
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from remaster_ros.collection.events import EventRecord, SensorReport
from remaster_ros.collection.recording import Recording
from remaster_ros.collection.required_sensors import RequiredSensors
from remaster_ros.errors import InputError
from remaster_ros.motion.liveness import Liveness
from remaster_ros.nodes.bagging import BagRecorder
from remaster_ros.nodes.messages import seconds, temperature_topic
from remaster_ros.nodes.recorder_parameters import Parameters
from remaster_ros.nodes.running import RemasterNode
from remaster_ros.nodes.simulated_clock import SteadyTime
from remaster_ros.nodes.triggered_sensors import TriggeredSensors
from remaster_ros.sensors.topic.messages import unit_quaternion
from remaster_ros.session.workcell import Workcell
from remaster_ros.types import FloatArray, MarkerReading


class CellSensors:
    """Hand the readings of all sensors to a recording, and find which sensors are missing.

    Parameters
    ----------
    node, p
        The recorder and its parameters.
    cell
        Its sensors.
    recording
        Takes the readings.
    on_reading
        Called after each reading that it has taken.

    Raises
    ------
    InputError
        The parameter ``require`` names no sensor of the cell.

    Attributes
    ----------
    required
        The sensors that the arm waits for.
    not_finite
        Readings that are no numbers, per sensor.
    """

    def __init__(
        self,
        node: RemasterNode,
        p: Parameters,
        cell: Workcell,
        recording: Recording,
        on_reading: Callable[[], None],
    ) -> None:
        try:
            self.required = RequiredSensors(cell.sensors, p.require)
        except InputError as error:
            raise InputError(f'{node.get_name()}: {error}') from None
        streams = [name for name, sensor in cell.sensors.items() if not sensor.single_shot]
        self._steady_s = SteadyTime(node, p.simulated_clock_rate)
        self._liveness = Liveness(cell.sensors, p.heartbeat_s, streams, since_s=self._steady_s())
        self._sensors, self._recording, self._on_reading = cell.sensors, recording, on_reading
        self.not_finite: Counter[str] = Counter()
        self._shots = TriggeredSensors(
            {
                name: node.create_client(Trigger, sensor.measure_service)
                for name, sensor in cell.sensors.items()
                if sensor.single_shot and sensor.measure_service and p.call_measure
            }
        )

    def subscribe(self, bag: BagRecorder) -> None:
        """Subscribe to the readings, through the bag."""
        for name, sensor in self._sensors.items():
            for marker, topic in sensor.topics.items():
                take = self._on_point(name, marker)
                bag.subscribe(PointStamped, topic, None if sensor.pose_topic else take)
            if sensor.pose_topic:
                bag.subscribe(PoseStamped, sensor.pose_topic, self._on_pose(name, sensor.marker))
            bag.subscribe(Temperature, temperature_topic(sensor.topic), self._on_temperature)

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

    def trigger(self) -> None:
        """Have single-shot sensors measure for the reading under way."""
        if self._recording.pairing is not None:
            self._shots.look(self._recording.pairing, self._absent(), self._steady_s())

    def give_up(self) -> None:
        """Reject what does not come in time."""
        self._recording.give_up(self._absent(), self._liveness.reports)

    def _absent(self) -> dict[str, str]:
        return self._liveness.absent(self._steady_s(), self.required.names)

    def _on_point(self, sensor: str, marker: str) -> Callable[[PointStamped], None]:
        take = self._taker(sensor, marker)
        return lambda message: take(message.header, message.point, None)

    def _on_pose(self, sensor: str, marker: str) -> Callable[[PoseStamped], None]:
        take = self._taker(sensor, marker)
        return lambda message: take(
            message.header, message.pose.position, unit_quaternion(message.pose.orientation)
        )

    def _taker(
        self, sensor: str, marker: str
    ) -> Callable[[Header, Point, FloatArray | None], None]:
        def receive(header: Header, point: Point, orientation: FloatArray | None) -> None:
            position = np.array([point.x, point.y, point.z])
            reading = MarkerReading(
                seconds(header.stamp), position, marker=marker, orientation=orientation
            )
            hidden = bool(np.all(np.isnan(position))) and len(self._sensors[sensor].markers) > 1
            # Hidden, while others of the frame are seen on topics of their own.
            if not (hidden or np.all(np.isfinite(position))):
                self.not_finite[sensor] += 1
                return
            if not hidden:
                self._liveness.reads(sensor, self._steady_s())
            self._recording.take_reading(sensor, reading)
            self._on_reading()

        return receive

    def _on_temperature(self, message: Temperature) -> None:
        if np.isfinite(message.temperature):
            self._recording.take_temperature(seconds(message.header.stamp), message.temperature)
