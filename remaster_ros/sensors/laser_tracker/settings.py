"""Settings of the laser tracker's client, and what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.parameters import check_all, parameter
from remaster_ros.sensors.laser_tracker.protocol import packets
from remaster_ros.sensors.laser_tracker.protocol.packets import Change, Command, Value
from remaster_ros.types import FloatArray, MarkerReading

_UNITS = (
    packets.METRE,
    packets.RADIAN,
    packets.CELSIUS,
    packets.MILLIBAR,
    packets.RELATIVE_HUMIDITY,
)
SET_FOR_READINGS: tuple[tuple[Command, Command, tuple[Value, ...], str], ...] = (
    (Command.SET_UNITS, Command.GET_UNITS, _UNITS, 'units (metre, radian, °C, mbar)'),
    (
        Command.SET_COORDINATE_SYSTEM_TYPE,
        Command.GET_COORDINATE_SYSTEM_TYPE,
        (packets.RIGHT_HANDED_CARTESIAN,),
        'coordinate system (right-handed Cartesian)',
    ),
    (
        Command.SET_MEASUREMENT_MODE,
        Command.GET_MEASUREMENT_MODE,
        (packets.STATIONARY,),
        'measurement mode (stationary)',
    ),
)
"""What a reading depends on: the command that sets it, the one that reads it back, the values, and
what they are."""
CHANGES_OF_READINGS = (Change.UNITS, Change.COORDINATE_SYSTEM_TYPE, Change.MEASUREMENT_MODE)
"""Status changes after which these are read back."""


class TrackerStatus(Enum):
    """What the instrument last reported."""

    DISCONNECTED = 'disconnected'
    NOT_READY = 'not ready'
    """Warming up, not initialised, or no reflector locked."""
    BUSY = 'busy'
    READY = 'ready'
    """A reflector is locked; it can be measured."""


@dataclass(frozen=True)
class Environment:
    """The air between tracker and reflector; it sets the refractive index."""

    temperature_c: float
    pressure_hpa: float
    humidity_percent: float


@dataclass(frozen=True)
class LaserTrackerSettings:
    """What the client sets on the instrument, and how long it waits.

    Those made with `parameter` are parameters of the node as well.
    """

    # The instrument's number of the reflector mounted; None leaves the one it has set
    reflector_id: int | None = None
    search_radius_m: float = parameter(
        0.05,
        'how far about the expected place it searches, at the distance of the reflector',
        unit='m',
        low=1e-3,
        high=5.0,
    )
    search_timeout_s: float = parameter(20.0, 'longest search', unit='s', low=0.1, high=600.0)
    integration_s: float = parameter(
        1.0, 'averaging time of one measurement', unit='s', low=0.05, high=60.0
    )
    # None leaves the instrument's own weather station, or what is set there
    environment: Environment | None = None
    connect_timeout_s: float = 5.0  # Of the TCP connection, in wall time
    reply_timeout_s: float = 5.0  # Of a command that only sets or reads something
    initialise_timeout_s: float = 300.0  # Of the initialisation, waiting for the warm-up included

    def __post_init__(self) -> None:
        """Refuse what no instrument can do.

        Raises InputError: naming the setting.
        """
        check_all('laser tracker', self)
        for name, value in vars(self).items():
            if name.endswith(('_s', '_m')) and not 0 < value < np.inf:
                raise InputError(f'laser tracker: {name} is {value}; it must be above 0')


@dataclass(frozen=True, kw_only=True)
class TrackerReading(MarkerReading):
    """One ADM measurement.

    Attributes: ``stamp_s``: middle of the integration on the injected clock, s.
    """

    std: FloatArray  # The instrument's own standard deviation per axis, m, (3,)
    pressure_hpa: float
    humidity_percent: float
