"""Measurements on request: the service, where the marker should be, and when the arm arrives.

Between requests the driver may find a lost marker again: `prepare` is called as soon as the arm
has arrived, so that a search falls into the settle time.
"""

from __future__ import annotations

import math
import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection.events import ShotMeasured
from remaster_ros.errors import DeviceError, InputError
from remaster_ros.kinematics import transforms
from remaster_ros.nodes.messages import stamp_of, temperature_topic, transform_array
from remaster_ros.nodes.status import LATCHED, RELIABLE
from remaster_ros.sensors.driver import TriggeredDriver
from remaster_ros.sensors.registry import kind_of
from remaster_ros.session.workcell import Workcell
from remaster_ros.types import FloatArray, MarkerReading

if TYPE_CHECKING:
    from remaster_ros.nodes.sensor_node import SensorNode


class MeasureService:
    """What a node adds for a sensor that measures on request.

    Parameters
    ----------
    node
        Of the sensor.
    driver
        Of the device.
    cell
        The workcell.
    ending
        Set when the node ends.

    Raises
    ------
    InputError
        The node listens to the arm's commands under a name by which the bridge would take it for
        a controller.
    """

    def __init__(
        self, node: SensorNode, driver: TriggeredDriver, cell: Workcell, ending: threading.Event
    ) -> None:
        self._node, self._driver, self._ending = node, driver, ending
        sensor = cell.sensors[node.sensor]
        self._marker_T = np.array(cell.markers[sensor.marker])
        self._T_N_R: FloatArray | None = None
        self._marker_R: FloatArray | None = None
        self._arrival_s = 0.0
        self._commanded = threading.Event()
        self._temperatures = node.create_publisher(
            Temperature, temperature_topic(sensor.topic), RELIABLE
        )
        node.create_subscription(PoseStamped, 'remaster/target_pose', self._on_pose, RELIABLE)
        node.create_subscription(
            TransformStamped, 'remaster/registration', self._on_registration, LATCHED
        )
        if type(driver).prepare is not TriggeredDriver.prepare:
            if not kind_of(node.get_name()):
                raise InputError(
                    f'{node.get_name()}: this node listens to the commands of the arm, and the '
                    'robot_bridge takes a node of this name for a controller; begin its name '
                    f'with {node.kind}'
                )
            node.create_subscription(
                JointTrajectory,
                'joint_trajectory_controller/joint_trajectory',
                self._on_trajectory,
                RELIABLE,
            )
        node.create_service(
            Trigger,
            sensor.measure_service or f'{node.kind.removesuffix("_markers")}/measure',
            self._on_measure,
            callback_group=MutuallyExclusiveCallbackGroup(),
        )

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
        if message.child_frame_id == self._node.sensor:
            self._T_N_R = transforms.inverse(transform_array(message))

    def _on_trajectory(self, message: JointTrajectory) -> None:
        # One point alone is a stop on the way, where nothing is to be found.
        if len(message.points) > 1:
            duration = message.points[-1].time_from_start
            self._arrival_s = self._node.now_s() + duration.sec + 1e-9 * duration.nanosec
            self._commanded.set()

    def _expected(self) -> FloatArray | None:
        """Where the marker should be in the sensor's frame; None before registration."""
        if self._T_N_R is None or self._marker_R is None:
            return None
        return transforms.apply(self._T_N_R, self._marker_R)

    def step(self) -> None:
        """Wait half a second for a command of the arm; prepare the driver when it has arrived."""
        if not self._commanded.wait(0.5):
            return
        self._commanded.clear()
        while self._node.now_s() < self._arrival_s:
            if self._ending.wait(0.005):
                return
        with self._node.in_use:
            try:
                self._driver.prepare(self._expected())
            except DeviceError as error:
                # The request that follows tries again, and reports.
                self._node.trouble = str(error)

    def _on_measure(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """One measurement; the point is published before the answer goes out."""
        node = self._node
        if node.clock_trouble:
            response.message = node.clock_trouble
            return response
        if self._driver.phase != 'ready':
            response.message = f'the {self._driver.device} is {self._driver.phase}: {node.trouble}'
            return response
        began = time.monotonic()
        with node.in_use:
            try:
                reading = self._driver.measure(self._expected())
            except DeviceError as error:
                node.trouble = response.message = str(error)
                return response
        took = time.monotonic() - began
        node.trouble = ''
        self._publish_temperature(reading)
        # For the report of times: what the instrument took is not the software's.
        node.status.event(ShotMeasured(took))
        node.publish_reading(reading)
        response.success, response.message = True, 'measured'
        return response

    def _publish_temperature(self, reading: MarkerReading) -> None:
        """Publish it under the reading's stamp, before the point."""
        if not math.isfinite(reading.temperature_c):
            return
        message = Temperature(temperature=float(reading.temperature_c))
        message.header.stamp = stamp_of(reading.stamp_s)
        message.header.frame_id = self._node.sensor
        self._temperatures.publish(message)
