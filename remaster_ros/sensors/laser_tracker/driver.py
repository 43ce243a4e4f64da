# SPDX-License-Identifier: Apache-2.0
"""Laser tracker as the sensor of a node: one ADM measurement on request.

The reflector stays locked, and is searched again when the beam has broken. Once the tracker is
registered, the search begins at the expected position and is narrow. A tracker measures one
reflector at a time: it turns to several reflectors one after another while the arm stands still.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from remaster_ros.errors import DeviceError
from remaster_ros.parameters import parameter
from remaster_ros.sensors.driver import SensorClock, SensorParameters, SensorState, TriggeredDriver
from remaster_ros.sensors.laser_tracker.client import LaserTrackerClient
from remaster_ros.sensors.laser_tracker.link import (
    LaserTrackerError,
    LaserTrackerSettings,
    TrackerStatus,
)
from remaster_ros.types import FloatArray, MarkerReading


@dataclass(frozen=True)
class Parameters(LaserTrackerSettings, SensorParameters):
    """Parameters of the laser tracker's node."""

    sensor: str = parameter('tracker', "the tracker's name among the cell's sensors")
    host: str = parameter('192.168.0.1', 'address of the instrument')
    port: int = parameter(700, 'TCP port of the instrument', low=1, high=65535)
    first_search_radius_m: float = parameter(
        0.6,
        'how far about where it points the tracker searches before it is registered',
        unit='m',
        low=1e-3,
        high=5.0,
    )
    attempts: int = parameter(3, 'searches and measurements tried for one request', low=1, high=20)
    max_deviation_m: float = parameter(
        0.05,
        'a reading further than this from the expected place is another reflector',
        unit='m',
        low=1e-3,
        high=5.0,
    )


class LaserTrackerDriver(TriggeredDriver):
    """Driver of a laser tracker: one measurement of a reflector on request."""

    parameters_type = Parameters
    device = 'laser tracker'
    several_markers = True

    def __init__(self, parameters: Parameters, clock: SensorClock) -> None:
        self.p = parameters
        settings = replace(self.p, search_radius_m=self.p.first_search_radius_m)
        self.tracker = LaserTrackerClient(
            self.p.host, self.p.port, settings=settings, now=clock.now, sleep=clock.sleep
        )
        self._narrow = False
        # Name of the reflector that the beam is locked on; None if unknown.
        self._on: str | None = None
        # Reflectors that were not found the last time: one search is enough for these.
        self._missed: set[str] = set()
        self._temperature_c: float | None = None

    @property
    def connected(self) -> bool:
        """Whether the connection is open."""
        return self.tracker.connected

    def open(self) -> None:
        """Connect and initialise, with the wait for the instrument's warm-up."""
        self._on = None
        self.tracker.connect()
        self.phase = 'initialising'
        self.tracker.initialise()

    def close(self) -> None:
        """Close the connection."""
        self.tracker.close()

    def prepare(self, expected: FloatArray | None) -> None:
        """Search for the reflector once if the beam is broken.

        ``expected``: where the reflector should be, m, (3,); None for where the beam points.

        Raises LaserTrackerError if none is found.
        """
        if self.tracker.status is not TrackerStatus.READY:
            before, self._on = self._on, None
            searches = self._lock(expected)
            found = None if expected is None else ''
            self._on = found if searches else before

    def turn_to(self, marker: str, expected: FloatArray) -> None:
        """Search at the expected position, unless the beam is on the marker.

        ``marker``: name, '' for the marker that the sensor follows; ``expected``: position in
        the tracker's frame, m, (3,). Up to `attempts` searches, one for a marker that was
        missed last time. Raises LaserTrackerError if no reflector is found.
        """
        if marker == self._on:
            return
        self._on = None
        self._search_narrowly()
        attempts = 1 if marker in self._missed else self.p.attempts
        for attempt in range(1, attempts + 1):
            try:
                self.tracker.go_position(expected)
            except LaserTrackerError:
                if attempt == attempts or not self.tracker.connected:
                    self._missed.add(marker)
                    raise
            else:
                self._on = marker
                self._missed.discard(marker)
                return

    def _search_narrowly(self) -> None:
        """Set the instrument's search radius to `search_radius_m`, at the first call only."""
        if not self._narrow:
            self.tracker.set_search_radius(self.p.search_radius_m)
            self._narrow = True

    def _lock(self, expected: FloatArray | None) -> int:
        """Lock the reflector if the beam is broken, by one search; return the number of searches.

        ``expected``: where it should be, m, (3,), searched narrowly; None for where the beam
        points.

        Raises LaserTrackerError if it is not found.
        """
        if expected is not None:
            self._search_narrowly()
        return self.tracker.ensure_locked(expected, attempts=1)

    def measure(self, expected: FloatArray | None) -> MarkerReading:
        """Measure the reflector at the expected position; see `TriggeredDriver.measure`.

        Up to `attempts` times, until a reading is within `max_deviation_m` of that position,
        if one is given; the reflector is searched for first if the beam is broken. The last
        failure is raised, a lost connection at once.
        """
        failure: DeviceError | None = None
        for _ in range(self.p.attempts):
            try:
                self._lock(expected)
                reading = self.tracker.measure()
            except LaserTrackerError as error:
                if not self.tracker.connected:
                    raise
                failure = error
                continue
            deviation = 0.0 if expected is None else np.linalg.norm(reading.position - expected)
            if deviation <= self.p.max_deviation_m:
                self._temperature_c = reading.temperature_c
                return reading
            failure = DeviceError(
                f'{self.tracker.name}: the reading is {1e3 * deviation:.0f} mm from where the '
                'reflector should be; is another reflector in view, or the tracker moved?'
            )
        assert failure is not None
        raise failure

    def state(self) -> SensorState:
        """State of the sensor, always ready: lock, counts, and last temperature, °C, if any."""
        values: dict[str, Any] = {'lock': self.tracker.status.value, **self.tracker.counts}
        if self._temperature_c is not None:
            values['temperature_c'] = self._temperature_c
        return SensorState(message=self.phase, values=values)
