# SPDX-License-Identifier: Apache-2.0
"""What the driver of a sensor gives; no ROS. `remaster_ros.nodes.sensor_markers` runs any of them.

A device is one folder beside this file with one class that derives from `StreamDriver` or from
`TriggeredDriver`, and one line in `remaster_ros.sensors.registry`.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from remaster_ros.parameters import parameter
from remaster_ros.types import FloatArray, MarkerReading


@dataclass(frozen=True)
class SensorParameters:
    """Parameters of every sensor's node; a driver adds those of its device."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    sensor: str = parameter('', "its name among the cell's sensors")
    start_timeout_s: float = parameter(
        20.0,
        'how long to try the first connection and, for a stream, to wait for the first reading, '
        'wall time',
        unit='s',
        low=0.1,
        high=3600.0,
    )
    further_markers: Mapping[str, int] = field(default_factory=dict)
    """Of the cell file, no parameter of the node: further markers, and what the device knows each
    by. Only for drivers that are `several_markers`."""


@dataclass(frozen=True)
class SensorClock:
    """The clock by which readings are stamped."""

    # Time and waiting, s
    now: Callable[[], float] = time.time
    sleep: Callable[[float], None] = time.sleep
    # Whether it runs at another speed than the wall clock and may stand still
    simulated: bool = False


@dataclass(frozen=True)
class SensorState:
    """How a sensor is now."""

    # It can measure a marker that is in view. A hidden marker does not make it unready: the next
    # configuration may show the marker again.
    ready: bool = True
    trouble: str = ''  # What is wrong, with the remedy; ''
    message: str = 'ok'  # What to show a person where nothing is wrong
    level: str = 'ok'  # ``ok``, ``warn`` or ``error``
    # Counts and settings for the search of a cause
    values: Mapping[str, Any] = field(default_factory=dict)


class Driver(ABC):
    """One device. The constructor refuses what waiting cannot mend; `open` connects.

    ``parameters``: an instance of `parameters_type`; ``clock``: gives the stamps of the readings.
    """

    parameters_type: ClassVar[type[SensorParameters]]
    """The driver's frozen dataclass of parameters."""
    device: ClassVar[str]
    """What it is, for messages."""
    several_markers: ClassVar[bool] = False
    """Whether it measures several markers: in one frame, or one after another on request."""
    phase: str = 'connecting'
    """``connecting`` until `open` has returned, then ``ready``; set by the node. `open` may set
    another text while it takes long."""

    @abstractmethod
    def __init__(self, parameters: Any, clock: SensorClock) -> None: ...

    @property
    def connected(self) -> bool:
        """Whether the device can still be reached after `open`; False has it opened again."""
        return True

    @abstractmethod
    def open(self) -> None:
        """Connect; called again after a `DeviceError`."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect; may be repeated, and called while another thread reads or measures."""

    def state(self) -> SensorState:
        """Return how the device is; called from any thread."""
        return SensorState()


class StreamDriver(Driver):
    """A device that sends readings by itself."""

    received_s: float = 0.0
    """When what `read` returned last has come, by the driver's clock, s."""

    @abstractmethod
    def read(self) -> MarkerReading | None:
        """Return the next reading, stamped with its time of capture.

        Of several markers in one frame one after the other, with the same stamp.
        Only measured positions: nothing occluded, predicted, filled in or held over. Waits some
        tenths of a second at most, then returns None.

        Raises
        ------
        DeviceError
            The device is lost; it is closed and opened again.
        """


class TriggeredDriver(Driver):
    """A device that measures on request."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        # Where the class is defined, not in front of an arm that stands and waits.
        if cls.several_markers and cls.turn_to is TriggeredDriver.turn_to:
            raise TypeError(f'{cls.__name__} has several_markers, and no turn_to')

    @abstractmethod
    def measure(self, expected: FloatArray | None) -> MarkerReading:
        """Measure once.

        Parameters
        ----------
        expected
            Where the marker should be, in the sensor's frame, m, (3,); None until the sensor is
            registered and a pose has been announced.

        Raises
        ------
        DeviceError
            Why there is no reading, with the remedy. A moving target is refused.
        """

    def turn_to(self, marker: str, expected: FloatArray) -> None:
        """Turn to the marker that is measured next, unless it is on it already.

        Of drivers that are `several_markers` alone, before each `measure` once the sensor is
        registered.

        Parameters
        ----------
        marker
            One of `further_markers` of the parameters; '' for the one that the sensor follows.
        expected
            As of `measure`.

        Raises
        ------
        DeviceError
            It was not found. Another one is not measured in its place.
        """

    def prepare(self, expected: FloatArray | None) -> None:
        """Get ready for the request that follows; called when the arm has arrived.

        What it raises (`DeviceError`) is shown, and the request is made all the same.
        """
