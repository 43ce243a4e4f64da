"""The node of any sensor: its markers' readings out, and whether the sensor is ready.

What is particular to a device lies in its driver (`remaster_ros.sensors`). The node opens the
driver, tries again while that fails, publishes readings with their time of capture, and publishes
the state that preflight, planner and recorder need.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from functools import partial

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped

from remaster_ros.collection.events import SensorReport
from remaster_ros.errors import DeviceError, InputError, RemasterError
from remaster_ros.nodes.measure_service import MeasureService
from remaster_ros.nodes.messages import stamp_of
from remaster_ros.nodes.parameters import declare
from remaster_ros.nodes.running import RemasterNode, fault_of_this_program, run
from remaster_ros.nodes.status import RELIABLE, NodeStatus, Summary
from remaster_ros.nodes.topic_source import subscribe_to_source
from remaster_ros.sensors.driver import SensorClock, StreamDriver, TriggeredDriver
from remaster_ros.sensors.registry import TOPIC, kind_of, load_driver
from remaster_ros.sensors.topic.driver import TopicDriver
from remaster_ros.session.workcell import read_cell
from remaster_ros.types import MarkerReading

RETRY_S = 0.5


class SensorNode(RemasterNode):
    """A node that publishes the markers which one of the cell's sensors measures.

    Parameters
    ----------
    name
        Of the node, where none is given on its command line; it chooses the driver, unless it is
        that of no registered sensor: then the given one does.

    Attributes
    ----------
    kind
        Key of the driver in `remaster_ros.sensors.registry.DRIVERS`.
    driver
        Of the device.
    sensor
        Its name in the cell, which is the frame of its readings.
    published
        Number of readings.
    trouble
        Why the device was not opened, or what it refused last; ''.
    in_use
        Held while a command of the device is under way.
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
        self.published = 0
        self.trouble = ''
        self.in_use = threading.Lock()
        self._ending = threading.Event()
        self._start_by = time.monotonic() + p.start_timeout_s
        self._started = False
        simulated = bool(self.get_parameter('use_sim_time').value)
        self.driver = driver(p, SensorClock(self.now_s, self._sleep, simulated))
        if isinstance(self.driver, TopicDriver):
            subscribe_to_source(self, self.driver, described)
        if isinstance(self.driver, TriggeredDriver):
            self._step = MeasureService(self, self.driver, cell, self._ending).step
        elif isinstance(self.driver, StreamDriver):
            self._step = partial(self._read, self.driver)
        self.status = NodeStatus(self, self._summary, self.sensor, cell.model())
        self._thread = threading.Thread(target=self._work, name=self.sensor, daemon=True)
        self._thread.start()

    def _sleep(self, duration_s: float) -> None:
        """Wait on the node's clock, which may be simulated and may stand still."""
        until = self.now_s() + duration_s
        while self.now_s() < until and not self._ending.wait(0.002):
            pass

    def _work(self) -> None:
        """Keep the device open and serve it; the body of the thread."""
        try:
            while not (self._ending.is_set() or self.failure):
                if self.driver.phase == 'ready' and self.driver.connected:
                    self._step()
                else:
                    self._open()
        except Exception as error:
            if not self._ending.is_set():
                self.failure = fault_of_this_program(error)

    def _open(self) -> None:
        """Try to open the device; the first time until the start time-out."""
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
        """End the node with this error where the device has never worked and the time is over."""
        over = time.monotonic() > self._start_by
        if over and not (self._started or self._ending.is_set()):
            self.failure = error

    def _read(self, driver: StreamDriver) -> None:
        """Publish the next reading of a stream."""
        try:
            reading = driver.read()
        except DeviceError as error:
            self.trouble, driver.phase = str(error), 'connecting'
            driver.close()
            self._require_start(error)
            self._ending.wait(RETRY_S)
            return
        if reading is not None:
            self._started = True
            self.publish_reading(reading)
        else:
            why = driver.state().trouble or 'no reading of the marker'
            self._require_start(DeviceError(f'{driver.device}: {why}'))

    def publish_reading(self, reading: MarkerReading) -> None:
        """Publish a measured position under its time of capture."""
        message = PointStamped()
        message.header.stamp = stamp_of(reading.stamp_s)
        message.header.frame_id = self.sensor
        position = np.asarray(reading.position, float)
        message.point.x, message.point.y, message.point.z = map(float, position)
        self._readings[reading.marker].publish(message)
        if self._poses is not None:
            pose = PoseStamped(header=message.header)
            pose.pose.position = message.point
            turn, xyzw = pose.pose.orientation, reading.orientation
            turn.x, turn.y, turn.z, turn.w = map(float, (np.nan,) * 4 if xyzw is None else xyzw)
            self._poses.publish(pose)
        self.published += reading.seen

    def _summary(self) -> Summary:
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
        """Disconnect from the device."""
        self._ending.set()
        self.driver.close()
        self._thread.join(2.0)


def run_sensor(name: str, args: list[str] | None = None, threads: int = 3) -> int:
    """Run the node of a sensor; parameters as of `SensorNode` and `run`."""
    return run(lambda: SensorNode(name), args, threads=threads)
