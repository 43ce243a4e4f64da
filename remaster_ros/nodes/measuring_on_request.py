# SPDX-License-Identifier: Apache-2.0
"""Measurements on request: the service, where the marker should be, and when the arm arrives.

Between requests the driver may find a lost marker again: `prepare` is called as soon as the arm
has arrived, so that a search falls into the settle time. Several markers are measured one after
another, once the sensor is registered: before, it is not known where the others are.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from abc import abstractmethod
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState, Temperature
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection.events import ShotMeasured
from remaster_ros.collection.message_fields import JointOrder, seconds, temperature_topic
from remaster_ros.errors import DeviceError, InputError
from remaster_ros.kinematics import transforms
from remaster_ros.nodes.controller_link import COMMANDS, COPIES
from remaster_ros.nodes.messages import read_place, stamp_of, transform_array
from remaster_ros.nodes.running import RemasterNode
from remaster_ros.nodes.status import LATCHED, RELIABLE, NodeStatus
from remaster_ros.sensors.driver import TriggeredDriver
from remaster_ros.sensors.registry import kind_of
from remaster_ros.session.cells.workcell import Workcell
from remaster_ros.types import FloatArray, MarkerReading

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Of joint states only the last counts."""


class MeasuringNode(RemasterNode):
    """Base of a sensor's node, as `MeasureService` uses it; attributes as of `SensorNode`."""

    kind: str
    sensor: str
    trouble: str
    in_use: threading.Lock
    status: NodeStatus

    @abstractmethod
    def publish_reading(self, reading: MarkerReading) -> None:
        """Publish a reading on the topic of its marker."""


class MeasureService:
    """Measure service of a sensor's node, with the expected positions of its markers.

    ``ending``: set when the node ends.
    Raises InputError: the node listens to the arm's commands under a name by which the bridge
    would take it for a controller.
    """

    def __init__(
        self, node: MeasuringNode, driver: TriggeredDriver, cell: Workcell, ending: threading.Event
    ) -> None:
        self._node, self._driver, self._ending = node, driver, ending
        sensor = cell.sensors[node.sensor]
        self._markers_T = {
            '' if name == sensor.marker else name: np.array(cell.markers[name])
            for name in sensor.markers
        }
        # The one that was measured last is measured first: the beam may be on it still.
        self._last = ''
        self._T_N_R: FloatArray | None = None
        self._T_R_T: FloatArray | None = None
        self._arrival_s = 0.0
        self._commanded = threading.Event()
        self._temperatures = node.create_publisher(
            Temperature, temperature_topic(sensor.topic), RELIABLE
        )
        if len(self._markers_T) > 1:
            # Which of them the beam is on shows by their places alone, and a node that was
            # started again in the middle of a pose has not heard of the pose.
            self._chain = cell.chain()
            self._joint_order = JointOrder(self._chain.joint_names)
            node.create_subscription(JointState, 'joint_states', self._on_joints, NEWEST)
        else:
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
            for commands in (COMMANDS, COPIES):
                node.create_subscription(JointTrajectory, commands, self._on_trajectory, RELIABLE)
        node.create_service(
            Trigger,
            sensor.measure_service or f'{node.kind.removesuffix("_markers")}/measure',
            self._on_measure,
            callback_group=MutuallyExclusiveCallbackGroup(),
        )

    def _on_pose(self, message: PoseStamped) -> None:
        """Keep the tool's target pose, T_R_T (4, 4). Raises InputError as `read_place`."""
        self._T_R_T = read_place(message.pose.position, message.pose.orientation)

    def _on_joints(self, message: JointState) -> None:
        """Keep the tool's pose by a joint state; ignore an invalid or non-finite one."""
        # What is wrong with joint states, the bridge reports.
        with contextlib.suppress(InputError):
            q = self._joint_order.positions(message)
            if np.all(np.isfinite(q)):
                self._T_R_T = self._chain.forward(q)

    def _on_registration(self, message: TransformStamped) -> None:
        """Keep the inverse of this sensor's registration, T_N_R; ignore those of other sensors."""
        if message.child_frame_id == self._node.sensor:
            self._T_N_R = transforms.inverse(transform_array(message))

    def _on_trajectory(self, message: JointTrajectory) -> None:
        """Note when a commanded trajectory ends, s, for `step`; ignore one of a single point."""
        # One point alone is a stop on the way, where nothing is to be found.
        if len(message.points) > 1:
            self._arrival_s = self._node.now_s() + seconds(message.points[-1].time_from_start)
            self._commanded.set()

    def _expected(self, marker: str = '') -> FloatArray | None:
        """Expected position of a marker in the sensor's frame, m, (3,).

        ``marker``: name; the sensor's main marker has the name ''. None before the sensor's
        registration, or before the first pose of the tool (with several markers: joint
        states).
        """
        if self._T_N_R is None or self._T_R_T is None:
            return None
        return transforms.apply(self._T_N_R @ self._T_R_T, self._markers_T[marker])

    def step(self) -> None:
        """Wait for a command of the arm; prepare the driver when the arm has arrived.

        Returns after half a second without a command, when the driver is prepared, or early if
        the node ends. A DeviceError of the driver becomes the node's `trouble`.
        """
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
        """Serve a request: measure each marker once; its point is published before the answer.

        Success if any marker was measured and the device is still connected; the other markers
        are published as NaN then. Otherwise, and without a clock or a ready device, no
        success, and the response has the reason. Failed measurements are also in the node's
        `trouble`.
        """
        node = self._node
        if node.clock_trouble:
            response.message = node.clock_trouble
            return response
        if self._driver.phase != 'ready':
            response.message = f'the {self._driver.device} is {self._driver.phase}: {node.trouble}'
            return response
        began = time.monotonic()
        failures: list[str] = []
        stamps_s: dict[str, float] = {}
        with node.in_use:
            for marker in self._order():
                try:
                    stamps_s[marker] = self._measure(marker)
                except DeviceError as error:
                    failures.append(str(error))
        node.trouble = '; '.join(failures)
        # A device that was lost is opened and asked again; the readings so far remain the first.
        if not stamps_s or not self._driver.connected:
            response.message = node.trouble
            return response
        for marker in self._markers_T.keys() - stamps_s:
            # Who waits for all of them learns that this one does not come.
            none = MarkerReading(max(stamps_s.values()), np.full(3, np.nan), marker=marker)
            node.publish_reading(none)
        # For the report of times: what the instrument took is not the software's.
        node.status.event(ShotMeasured(time.monotonic() - began))
        response.success, response.message = True, node.trouble or 'measured'
        return response

    def _order(self) -> list[str]:
        """Return the names of the markers in the order of measuring, the one measured last first.

        The sensor's main marker has the name ''. [''] alone if no position can be expected yet
        (before registration, or before the arm's pose is known): the driver finds a marker by
        itself then.
        """
        if self._expected() is None:
            return ['']
        return [self._last, *(name for name in self._markers_T if name != self._last)]

    def _measure(self, marker: str) -> float:
        """Measure a marker once, publish the reading and its temperature; return its stamp, s.

        ``marker``: name; the sensor's main marker has the name ''. Raises DeviceError if there
        is no measurement.
        """
        expected = self._expected(marker)
        if len(self._markers_T) > 1 and expected is not None:
            self._driver.turn_to(marker, expected)
        reading = replace(self._driver.measure(expected), marker=marker)
        self._last = marker
        self._publish_temperature(reading)
        self._node.publish_reading(reading)
        return reading.stamp_s

    def _publish_temperature(self, reading: MarkerReading) -> None:
        """Publish a reading's temperature, °C, under the reading's stamp; nothing without one."""
        if not math.isfinite(reading.temperature_c):
            return
        message = Temperature(temperature=float(reading.temperature_c))
        message.header.stamp = stamp_of(reading.stamp_s)
        message.header.frame_id = self._node.sensor
        self._temperatures.publish(message)
