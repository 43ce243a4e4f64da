# SPDX-License-Identifier: Apache-2.0
"""The node of any sensor: its markers' readings out, and whether the sensor is ready.

Its name begins with that of its driver: ``ros2 run remaster_ros sensor_markers --ros-args -r
__node:=NAME -p sensor:=…``; which names there are stands in `remaster_ros.sensors.registry`. Its
parameters are those below and the driver's own. Two devices have executables of their own.

What is particular to a device lies in its driver (`remaster_ros.sensors`). The node opens the
driver, tries again while that fails, publishes readings with their time of capture, and publishes
the state that preflight, planner and recorder need.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from remaster_ros.collection.events import SensorReport
from remaster_ros.errors import DeviceError, InputError, RemasterError
from remaster_ros.kinematics import transforms
from remaster_ros.nodes.measuring_on_request import MeasureService, MeasuringNode
from remaster_ros.nodes.messages import message_class, stamp_of
from remaster_ros.nodes.parameters import declare
from remaster_ros.nodes.qos import node_of
from remaster_ros.nodes.running import fault_of_this_program, run
from remaster_ros.nodes.simulated_clock import ReportsTaken
from remaster_ros.nodes.status import RELIABLE, NodeStatus, Summary
from remaster_ros.sensors.driver import SensorClock, StreamDriver, TriggeredDriver
from remaster_ros.sensors.driver import SensorParameters as Parameters
from remaster_ros.sensors.registry import GENERIC, TOPIC, kind_of, load_driver
from remaster_ros.sensors.topic.driver import TopicDriver
from remaster_ros.session.cells.workcell import CellSensor, read_cell
from remaster_ros.types import MarkerReading

__all__ = ['Parameters', 'SensorNode', 'main', 'run_sensor']
ANY = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches publishers that are reliable, best-effort, volatile or latched."""
RETRY_S = 0.5


def subscribe_to_source(node: Node, driver: TopicDriver, sensor: CellSensor) -> None:
    """Hand all messages of a sensor's source to its driver.

    Raises InputError if the message type is not installed.
    """
    try:
        kind = message_class(sensor.message_type)
    except InputError:
        package = sensor.message_type.partition('/msg/')[0]
        raise InputError(
            f'{node.get_name()}: message_type is {sensor.message_type}, and {package} is not '
            'installed here; install that package, or have its driver publish PointStamped'
        ) from None
    topic = node.resolve_topic_name(sensor.source)

    def publishers() -> list[tuple[str, str]]:
        return [
            (node_of(info), info.topic_type) for info in node.get_publishers_info_by_topic(topic)
        ]

    on_tool = bool(sensor.mounted_on)
    driver.follow(topic, sensor.message_type, sensor.marker, publishers, on_tool)
    group = MutuallyExclusiveCallbackGroup()
    node.create_subscription(kind, sensor.source, driver.take, ANY, callback_group=group)


class SensorNode(MeasuringNode):
    """Node that publishes the marker positions measured by one of the cell's sensors.

    ``name``: of the node, if none is given on its command line. The driver is that of
    ``name``, or, if no registered sensor has it, that of the name on the command line.
    Attributes: ``kind``: key of the driver in `remaster_ros.sensors.registry.DRIVERS`;
    ``sensor``: its name in the cell, which is the frame of its readings; ``trouble``: why the
    device was not opened, or what it refused last, '' if nothing; ``in_use``: lock, held while
    a command of the device is under way.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.kind = kind_of(name) or kind_of(self.get_name())
        driver = load_driver(self.kind or self.get_name())
        p = declare(self, driver.parameters_type)
        cell, self.sensor = read_cell(p.cell), p.sensor
        if self.sensor not in cell.sensors:
            raise InputError(
                f'{self.get_name()}: parameter sensor is {self.sensor!r}; the cell has '
                f'{", ".join(cell.sensors)}'
            )
        described = cell.sensors[self.sensor]
        triggered = issubclass(driver, TriggeredDriver)
        if described.single_shot != triggered:
            raise InputError(
                f'{self.get_name()}: sensor {self.sensor} of {p.cell} has single_shot '
                f'{str(described.single_shot).lower()}, but a {driver.device} '
                f'{"measures on request" if triggered else "streams"}; correct single_shot'
            )
        if bool(described.source) != issubclass(driver, TopicDriver):
            raise InputError(
                f'{self.get_name()}: sensor {self.sensor} of {p.cell} '
                + (
                    f'has a message_type; its node is a {TOPIC}'
                    if described.source
                    else 'has no message_type; give that of its topic, such as '
                    'geometry_msgs/msg/PoseStamped'
                )
            )
        if described.further_markers and not driver.several_markers:
            raise InputError(
                f'{self.get_name()}: sensor {self.sensor} of {p.cell} has further_markers, but a '
                f'{driver.device} measures one marker alone; leave them out'
            )
        p = replace(p, further_markers=described.further_markers)
        self._readings = {
            '' if marker == described.marker else marker: self.create_publisher(
                PointStamped, topic, RELIABLE
            )
            for marker, topic in described.topics.items()
        }
        self._poses = (
            self.create_publisher(PoseStamped, described.pose_topic, RELIABLE)
            if described.pose_topic
            else None
        )
        self._on_tool = bool(described.mounted_on)
        self.published = 0
        self.trouble = ''
        self.in_use = threading.Lock()
        self._ending = threading.Event()
        self._start_by = time.monotonic() + p.start_timeout_s
        self._started = False
        simulated = bool(self.get_parameter('use_sim_time').value)
        self.driver = driver(p, SensorClock(self.now_s, self._sleep, simulated))
        # What measures on request waits for a world that would wait for it.
        streams = isinstance(self.driver, StreamDriver)
        self._taken = ReportsTaken(self, simulated and streams)
        if isinstance(self.driver, TopicDriver):
            subscribe_to_source(self, self.driver, described)
        if isinstance(self.driver, TriggeredDriver):
            self._step: Callable[[], float | None] = MeasureService(
                self, self.driver, cell, self._ending
            ).step
        elif isinstance(self.driver, StreamDriver):
            self._step = partial(self._read, self.driver)
        self.status = NodeStatus(self, self._summary, self.sensor, cell.model())
        self._thread = threading.Thread(target=self._work, name=self.sensor, daemon=True)
        self._thread.start()

    def _sleep(self, duration_s: float) -> None:
        """Wait on the node's clock, which may be simulated and may stand still.

        It waits as long as the clock stands, and returns early only if the node ends.
        """
        until = self.now_s() + duration_s
        while self.now_s() < until and not self._ending.wait(0.002):
            pass

    def _work(self) -> None:
        """Thread: keep the device open and serve it until the node ends.

        An unforeseen exception becomes the node's `failure`.
        """
        try:
            while not (self._ending.is_set() or self.failure):
                came_s = None
                if self.driver.phase == 'ready' and self.driver.connected:
                    came_s = self._step()
                else:
                    self._open()
                self._taken.take(stamp_of(self.now_s() if came_s is None else came_s))
        except Exception as error:
            if not self._ending.is_set():
                self.failure = fault_of_this_program(error)

    def _open(self) -> None:
        """Try to open the device once; if that fails, keep why, and wait `RETRY_S`.

        Before the device has worked, a failure after the start time-out ends the node.
        """
        with self.in_use:
            self.driver.phase = 'connecting'
            try:
                self.driver.open()
            except DeviceError as error:
                self.driver.phase = 'connecting'
                self.trouble = str(error)
                self.driver.close()
                self._require_start(error)
            else:
                self.driver.phase, self.trouble = 'ready', ''
                self._started = self._started or isinstance(self.driver, TriggeredDriver)
        if self.trouble:
            self._ending.wait(RETRY_S)

    def _require_start(self, error: RemasterError) -> None:
        """End the node with this error if its start time-out is over before the device worked."""
        over = time.monotonic() > self._start_by
        if over and not (self._started or self._ending.is_set()):
            self.failure = error

    def _read(self, driver: StreamDriver) -> float | None:
        """Publish the next reading of a stream; return when it was received, s.

        None if there was no reading; without any within the start time-out the node ends.
        After a DeviceError the driver is closed, to be opened again after `RETRY_S`.
        """
        try:
            reading = driver.read()
        except DeviceError as error:
            self.trouble, driver.phase = str(error), 'connecting'
            driver.close()
            self._require_start(error)
            self._ending.wait(RETRY_S)
            return None
        if reading is not None:
            self._started = True
            self.publish_reading(reading)
            return driver.received_s
        why = driver.state().trouble or 'no reading of the marker'
        self._require_start(DeviceError(f'{driver.device}: {why}'))
        return None

    def publish_reading(self, reading: MarkerReading) -> None:
        """Publish a measured position, m, and the pose, if any, with its time of capture.

        A missing orientation is NaN in the pose. Of a sensor on the tool the point is the camera's
        in the board's frame.
        """
        message = PointStamped()
        message.header.stamp = stamp_of(reading.stamp_s)
        message.header.frame_id = self.sensor
        position = np.asarray(reading.position, float)
        place = position
        if self._on_tool and reading.orientation is not None:
            # The board's frame is the sensor's: what moves in it is the camera.
            place, _ = transforms.inverse_poses(position, reading.orientation)
        message.point.x, message.point.y, message.point.z = map(float, place)
        self._readings[reading.marker].publish(message)
        if self._poses is not None:
            pose = PoseStamped(header=message.header)
            point = pose.pose.position
            point.x, point.y, point.z = map(float, position)
            turn, xyzw = pose.pose.orientation, reading.orientation
            turn.x, turn.y, turn.z, turn.w = map(float, (np.nan,) * 4 if xyzw is None else xyzw)
            self._poses.publish(pose)
        self.published += reading.seen

    def _summary(self) -> Summary:
        """Summary for the status: readiness, and the trouble of clock, node or driver.

        Trouble of the clock counts before the node's, the node's before the driver's.
        """
        state = self.driver.state()
        open_now = self.driver.phase == 'ready' and self.driver.connected
        trouble, level = state.trouble, state.level
        if self.trouble:
            trouble, level = self.trouble, 'warn' if self.driver.phase == 'ready' else 'error'
        if self.clock_trouble:
            trouble, level = self.clock_trouble, 'error'
        ready = open_now and state.ready and not self.clock_trouble
        report = SensorReport(
            sensor=self.sensor,
            ready=ready,
            trouble=trouble,
            message=trouble or state.message,
            hidden=state.values.get('fault') == 'marker',
        )
        values = {'state': self.driver.phase, 'published': self.published, **state.values}
        return Summary(level, report.message, values, report)

    def close(self) -> None:
        """Disconnect from the device, and wait for the thread, 2 s at most."""
        self._ending.set()
        self.driver.close()
        self._thread.join(2.0)


def run_sensor(name: str, args: list[str] | None = None, threads: int = 3) -> int:
    """Run the node of a sensor until it ends; return its exit status, see `running.run`.

    ``name``: default name of the node, by which the driver is chosen, see `SensorNode`;
    ``args``: command line, None for that of the process; ``threads``: of its executor.
    """
    return run(lambda: SensorNode(name), args, threads=threads)


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal or an error ends it; return its exit status."""
    return run_sensor(GENERIC, args)


if __name__ == '__main__':
    raise SystemExit(main())
