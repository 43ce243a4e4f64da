# SPDX-License-Identifier: Apache-2.0
"""Interface of a sensor's driver, without ROS.

`remaster_ros.nodes.sensor_markers` runs any driver.

A device is one folder next to this file with one class that derives from `StreamDriver` or from
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
    """From the cell file, not a parameter of the node: further markers, and each marker's number
    at the device. Only for drivers with `several_markers`."""


@dataclass(frozen=True)
class SensorClock:
    """Clock of the readings' stamps."""

    # Time and waiting, s
    now: Callable[[], float] = time.time
    sleep: Callable[[float], None] = time.sleep
    # Whether the clock runs at another speed than the wall clock and may stop
    simulated: bool = False


@dataclass(frozen=True)
class SensorState:
    """Present state of a sensor."""

    # Whether the sensor can measure a visible marker. A hidden marker does not make it unready:
    # the marker may be visible at the next configuration.
    ready: bool = True
    trouble: str = ''  # Fault with its remedy; '' without a fault
    message: str = 'ok'  # Message for a person if there is no fault
    level: str = 'ok'  # ``ok``, ``warn`` or ``error``
    # Counts and settings, for the search for a cause
    values: Mapping[str, Any] = field(default_factory=dict)


class Driver(ABC):
    """Driver of one device. The constructor refuses settings that can never work; `open` connects.

    ``parameters``: an instance of `parameters_type`; ``clock``: for the stamps of the readings.
    """

    parameters_type: ClassVar[type[SensorParameters]]
    """Frozen dataclass of the driver's parameters."""
    device: ClassVar[str]
    """Name of the device in messages."""
    several_markers: ClassVar[bool] = False
    """Whether the driver measures several markers, in one frame or one after another."""
    phase: str = 'connecting'
    """``connecting`` until `open` has returned, then ``ready``; set by the node. During a long
    `open` the driver may set another text."""

    @abstractmethod
    def __init__(self, parameters: Any, clock: SensorClock) -> None: ...

    @property
    def connected(self) -> bool:
        """Whether the device can be reached after `open`; if False it is opened again.

        Always True unless a driver overrides it, as one that can notice a lost connection does.
        """
        return True

    @abstractmethod
    def open(self) -> None:
        """Connect, or raise DeviceError with the remedy; called again after that."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect; may be repeated, and called while another thread reads or measures."""

    def state(self) -> SensorState:
        """Present state of the device; called from any thread. By default ready, no fault."""
        return SensorState()


class StreamDriver(Driver):
    """Driver of a device that sends readings by itself."""

    received_s: float = 0.0
    """Time of arrival of the last reading that `read` returned, by the driver's clock, s."""

    @abstractmethod
    def read(self) -> MarkerReading | None:
        """Next reading, stamped with its time of capture.

        None if none arrives within tenths of a second.

        Several markers of one frame are returned one after another, with the same stamp. Only
        measured positions are returned: never occluded, predicted, model-filled or repeated ones.
        Raises DeviceError if the device is lost; the node then closes and opens it again.
        """


class TriggeredDriver(Driver):
    """Driver of a device that measures on request."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        # The check is made when the class is defined, not while an arm waits for a reading.
        if cls.several_markers and cls.turn_to is TriggeredDriver.turn_to:
            raise TypeError(f'{cls.__name__} has several_markers, and no turn_to')

    @abstractmethod
    def measure(self, expected: FloatArray | None) -> MarkerReading:
        """Measure once, and return the reading.

        Parameters
        ----------
        expected
            Expected position of the marker in the sensor's frame, m, (3,); None until the sensor
            is registered and a pose has been announced.

        Raises
        ------
        DeviceError
            If there is no reading, with reason and remedy. A moving target is refused.
        """

    def turn_to(self, marker: str, expected: FloatArray) -> None:
        """Turn to the marker that is measured next, unless the device points at it already.

        Only for drivers with `several_markers`, before each `measure` once the sensor is
        registered.

        Parameters
        ----------
        marker
            One of the parameters' `further_markers`; '' for the marker that the sensor follows.
        expected
            As in `measure`.

        Raises
        ------
        DeviceError
            If the marker was not found. No other marker is measured in its place.
        """

    def prepare(self, expected: FloatArray | None) -> None:
        """Prepare for the next request; called when the arm has arrived. By default nothing.

        ``expected``: as in `measure`. A `DeviceError` raised here is shown, and the request is
        made all the same.
        """
