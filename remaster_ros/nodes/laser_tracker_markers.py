"""Measure the reflector with a laser tracker on request; find it again when the beam has broken.

``/laser_tracker/measure`` takes one ADM measurement and publishes it. Between requests the node
looks for a lost reflector as soon as the arm has arrived, so that the search falls into the settle
time; once the tracker is registered it knows where to look.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection.events import ShotMeasured
from remaster_ros.errors import DeviceError
from remaster_ros.kinematics import transforms
from remaster_ros.nodes.messages import stamp_of, temperature_topic, transform_array
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import run
from remaster_ros.nodes.sensor_node import SensorNode, SensorState
from remaster_ros.nodes.status import LATCHED, RELIABLE
from remaster_ros.sensors.laser_tracker.client import (
    LaserTrackerClient,
    LaserTrackerError,
    LaserTrackerSettings,
    TrackerReading,
    TrackerStatus,
)
from remaster_ros.types import FloatArray


@dataclass(frozen=True)
class Parameters:
    """Parameters of the laser tracker's node."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    sensor: str = parameter('tracker', "the tracker's name among the cell's sensors")
    host: str = parameter('192.168.0.1', 'address of the instrument')
    port: int = parameter(700, 'TCP port of the instrument', low=1, high=65535)
    start_timeout_s: float = parameter(
        20.0, 'how long to try the first connection, wall time', unit='s', low=0.1, high=3600.0
    )
    integration_s: float = parameter(
        1.0, 'averaging time of one measurement', unit='s', low=0.05, high=60.0
    )
    first_search_radius_m: float = parameter(
        0.6,
        'how far about where it points the tracker searches before it is registered',
        unit='m',
        low=1e-3,
        high=5.0,
    )
    search_radius_m: float = parameter(
        0.05,
        'how far about the expected place it searches afterwards',
        unit='m',
        low=1e-3,
        high=5.0,
    )
    search_timeout_s: float = parameter(20.0, 'longest search', unit='s', low=0.1, high=600.0)
    attempts: int = parameter(3, 'searches and measurements tried for one request', low=1, high=20)
    max_deviation_m: float = parameter(
        0.05,
        'a reading further than this from the expected place is another reflector',
        unit='m',
        low=1e-3,
        high=5.0,
    )


class LaserTrackerMarkers(SensorNode):
    """See the module's text."""

    def __init__(self) -> None:
        super().__init__('laser_tracker_markers')
        self.p = declare(self, Parameters)
        self.open_sensor(self.p.cell, self.p.sensor)
        sensor = self.cell.sensors[self.p.sensor]
        self._marker_T = np.array(self.cell.markers[sensor.marker])
        self._T_N_R: FloatArray | None = None
        self._marker_R: FloatArray | None = None
        self._state, self._trouble = 'connecting', ''
        self._temperature_c: float | None = None
        settings = LaserTrackerSettings(
            search_radius_m=self.p.first_search_radius_m,
            search_timeout_s=self.p.search_timeout_s,
            integration_s=self.p.integration_s,
        )
        self.tracker = LaserTrackerClient(
            self.p.host, self.p.port, settings=settings, now=self.now_s, sleep=self._sleep
        )
        # One command is under way at a time: a measurement waits for a search to end.
        self._instrument = threading.Lock()
        self._narrow = False
        self._arrival_s: float | None = None
        self._commanded = threading.Event()
        self._ending = threading.Event()
        self._temperatures = self.create_publisher(
            Temperature, temperature_topic(sensor.topic), RELIABLE
        )
        self.create_subscription(PoseStamped, 'remaster/target_pose', self._on_pose, RELIABLE)
        self.create_subscription(
            TransformStamped, 'remaster/registration', self._on_registration, LATCHED
        )
        self.create_subscription(
            JointTrajectory,
            'joint_trajectory_controller/joint_trajectory',
            self._on_trajectory,
            RELIABLE,
        )
        self.create_service(
            Trigger,
            sensor.measure_service or 'laser_tracker/measure',
            self._on_measure,
            callback_group=MutuallyExclusiveCallbackGroup(),
        )
        self.open_status()
        self._thread = threading.Thread(target=self._keep_locked, daemon=True)
        self._thread.start()

    def _sleep(self, duration_s: float) -> None:
        """Wait on the node's clock, which may be simulated and may stand still."""
        until = self.now_s() + duration_s
        while self.now_s() < until and not self._ending.wait(0.002):
            pass

    # What comes in

    def _on_pose(self, message: PoseStamped) -> None:
        position, quaternion = message.pose.position, message.pose.orientation
        T_R_T = transforms.transform(
            transforms.matrix_from_quaternion_xyzw(
                np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w])
            ),
            np.array([position.x, position.y, position.z]),
        )
        self._marker_R = transforms.apply(T_R_T, self._marker_T)

    def _on_registration(self, message: TransformStamped) -> None:
        if message.child_frame_id == self.p.sensor:
            self._T_N_R = transforms.inverse(transform_array(message))

    def _on_trajectory(self, message: JointTrajectory) -> None:
        # One point alone is a stop on the way, where nothing is to be found.
        if len(message.points) > 1:
            duration = message.points[-1].time_from_start
            self._arrival_s = self.now_s() + duration.sec + 1e-9 * duration.nanosec
            self._commanded.set()

    def _expected(self) -> FloatArray | None:
        """Where the reflector should be in the tracker's frame; None before registration."""
        if self._T_N_R is None or self._marker_R is None:
            return None
        return transforms.apply(self._T_N_R, self._marker_R)

    # The instrument

    def _keep_locked(self) -> None:
        """Connect, then look for a lost reflector whenever the arm has arrived."""
        if not self._connect():
            return
        while not self._ending.is_set():
            if not self._commanded.wait(0.5):
                self._reconnect_if_lost()
                continue
            self._commanded.clear()
            while self._arrival_s is not None and self.now_s() < self._arrival_s:
                if self._ending.wait(0.005):
                    return
            with self._instrument:
                try:
                    if self.tracker.status is not TrackerStatus.READY:
                        self._lock()
                except DeviceError as error:
                    # The request that follows tries again, and reports.
                    self._trouble = str(error)

    def _lock(self) -> FloatArray | None:
        """Search once if the beam is broken; returns where the reflector should be, if known."""
        expected = self._expected()
        if expected is not None and not self._narrow:
            self.tracker.set_search_radius(self.p.search_radius_m)
            self._narrow = True
        self.tracker.ensure_locked(expected, attempts=1)
        return expected

    def _connect(self) -> bool:
        """Try until the instrument answers; fails the node after the start time-out."""
        deadline = time.monotonic() + self.p.start_timeout_s
        while not self._ending.is_set():
            try:
                self.tracker.connect()
                self._state = 'initialising'
                self.tracker.initialise()
                self._state, self._trouble = 'ready', ''
                return True
            except DeviceError as error:
                self._state, self._trouble = 'connecting', str(error)
                self.tracker.close()
                if time.monotonic() > deadline:
                    self.failure = error
                    return False
                self._ending.wait(0.5)
        return False

    def _reconnect_if_lost(self) -> None:
        with self._instrument:
            if self.tracker.connected:
                return
            self._state = 'connecting'
            try:
                self.tracker.connect()
                self.tracker.initialise()
                self._state, self._trouble = 'ready', ''
            except DeviceError as error:
                self._trouble = str(error)
                self.tracker.close()

    def _on_measure(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """One measurement; the point is published before the answer goes out."""
        if self.clock_trouble:
            response.message = self.clock_trouble
            return response
        if self._state != 'ready':
            response.message = f'the laser tracker is {self._state}: {self._trouble}'
            return response
        began = time.monotonic()
        with self._instrument:
            try:
                reading = self._measure()
            except DeviceError as error:
                self._trouble = response.message = str(error)
                return response
        took = time.monotonic() - began
        self._trouble = ''
        self._publish_temperature(reading)
        # What the instrument took is not the software's time.
        self.status.event(ShotMeasured(took))
        self.publish_reading(reading.position, reading.stamp_s)
        response.success, response.message = True, 'measured'
        return response

    def _publish_temperature(self, reading: TrackerReading) -> None:
        """Publish it under the reading's stamp, before the point."""
        self._temperature_c = reading.temperature_c
        if not np.isfinite(reading.temperature_c):
            return
        message = Temperature(temperature=float(reading.temperature_c))
        message.header.stamp = stamp_of(reading.stamp_s)
        message.header.frame_id = self.p.sensor
        self._temperatures.publish(message)

    def _measure(self) -> TrackerReading:
        failure: DeviceError | None = None
        for _ in range(self.p.attempts):
            try:
                expected = self._lock()
                reading = self.tracker.measure()
            except LaserTrackerError as error:
                if not self.tracker.connected:
                    raise
                failure = error
                continue
            deviation = 0.0 if expected is None else np.linalg.norm(reading.position - expected)
            if deviation <= self.p.max_deviation_m:
                return reading
            failure = DeviceError(
                f'{self.tracker.name}: the reading is {1e3 * deviation:.0f} mm from where the '
                'reflector should be; is another reflector in view, or the tracker moved?'
            )
        assert failure is not None
        raise failure

    def state(self) -> SensorState:
        """Return how the instrument is, and what it has refused."""
        values: dict[str, Any] = {
            'state': self._state,
            'lock': self.tracker.status.value,
            **self.tracker.counts,
        }
        if self._temperature_c is not None:
            values['temperature_c'] = self._temperature_c
        can_measure = self._state == 'ready'
        return SensorState(
            ready=can_measure and self.tracker.connected,
            trouble=self._trouble,
            message=self._state,
            level='ok' if not self._trouble else 'warn' if can_measure else 'error',
            values=values,
        )

    def close(self) -> None:
        """Let the instrument go."""
        self._ending.set()
        self.tracker.close()
        self._thread.join(2.0)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(LaserTrackerMarkers, args, threads=3)


if __name__ == '__main__':
    raise SystemExit(main())
