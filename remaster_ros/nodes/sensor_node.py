"""What every sensor's node does: one marker's readings out, and whether it is ready.

A new sensor derives from `SensorNode`, calls `publish_reading` and gives `state`. Planner,
recorder and preflight need nothing else of it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from geometry_msgs.msg import PointStamped

from remaster_ros.collection.events import SensorReport
from remaster_ros.errors import InputError
from remaster_ros.nodes.messages import stamp_of
from remaster_ros.nodes.running import RemasterNode
from remaster_ros.nodes.status import RELIABLE, NodeStatus, Summary
from remaster_ros.session.workcell import Workcell, read_cell
from remaster_ros.types import FloatArray


@dataclass(frozen=True)
class SensorState:
    """How a sensor is now.

    Attributes
    ----------
    ready
        It can measure a marker that it sees. A hidden marker is no reason to say no: moving on
        shows it again.
    trouble
        What is wrong, with the remedy; ''.
    message
        What to show a person where nothing is wrong.
    level
        ``ok``, ``warn`` or ``error``.
    values
        Counts and settings for whoever looks for the cause of something.
    """

    ready: bool
    trouble: str = ''
    message: str = 'ok'
    level: str = 'ok'
    values: Mapping[str, Any] = field(default_factory=dict)


class SensorNode(RemasterNode):
    """A node that publishes the marker which one of the cell's sensors follows.

    Attributes
    ----------
    cell, sensor
        The workcell, and the sensor's name, which is the frame of its readings.
    published
        Number of readings.
    """

    cell: Workcell
    sensor: str

    def open_sensor(self, cell: str, sensor: str) -> None:
        """Read the cell and make the publisher; first of all in a node's constructor.

        Parameters
        ----------
        cell, sensor
            The cell file, and the name of this sensor in it.

        Raises
        ------
        InputError
            The cell has no such sensor.
        """
        self.cell, self.sensor, self.published = read_cell(cell), sensor, 0
        if sensor not in self.cell.sensors:
            raise InputError(
                f'{self.get_name()}: parameter sensor is {sensor!r}; the cell has '
                f'{", ".join(self.cell.sensors)}'
            )
        topic = self.cell.sensors[sensor].topic
        self._readings = self.create_publisher(PointStamped, topic, RELIABLE)

    def open_status(self) -> None:
        """Begin to publish the state; last of all in a node's constructor."""
        self.status = NodeStatus(self, self._summary, self.sensor)

    @abstractmethod
    def state(self) -> SensorState:
        """Return how the sensor is now; the node's clock need not be looked at."""

    def publish_reading(self, position: FloatArray, captured_s: float) -> None:
        """Publish a measured position.

        Parameters
        ----------
        position
            Of the marker in the sensor's frame, m, (3,). Nothing occluded, predicted or held over.
        captured_s
            When it was captured, s of the node's clock.
        """
        message = PointStamped()
        message.header.stamp = stamp_of(captured_s)
        message.header.frame_id = self.sensor
        message.point.x, message.point.y, message.point.z = map(float, position)
        self._readings.publish(message)
        self.published += 1

    def _summary(self) -> Summary:
        state = self.state()
        trouble = self.clock_trouble or state.trouble
        report = SensorReport(
            sensor=self.sensor,
            ready=state.ready and not self.clock_trouble,
            trouble=trouble,
            message=trouble or state.message,
            hidden=state.values.get('fault') == 'marker',
        )
        level = 'error' if self.clock_trouble else state.level
        return Summary(
            level, report.message, {'published': self.published, **state.values}, report
        )
