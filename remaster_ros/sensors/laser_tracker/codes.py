# SPDX-License-Identifier: Apache-2.0
"""Numbers of the Leica emScon protocol and what they mean, in words and with a remedy.

The commands carry the layout of their packets, so that one table serves both directions.
"""

from __future__ import annotations

from enum import IntEnum
from struct import Struct


class DataType(IntEnum):
    """Type of a packet."""

    COMMAND = 0
    """Command or reply."""
    ERROR = 1
    SINGLE_RESULT = 2
    STATUS_CHANGE = 8


class Command(IntEnum):
    """Command with the layouts of its request and its reply.

    A member is ``code, request, reply``: `struct` formats (little-endian, packed) of the values
    after the command in a request, and after the status in a successful reply. Truth values are
    ``i``.
    """

    request: Struct
    reply: Struct

    def __new__(cls, code: int, request: str = '', reply: str = '') -> Command:
        """Member of a code and two layouts."""
        member = int.__new__(cls, code)
        member._value_ = code
        member.request, member.reply = Struct('<' + request), Struct('<' + reply)
        return member

    EXIT_APPLICATION = 0
    GET_SYSTEM_STATUS = 1, '', '4I3iIii'
    GET_TRACKER_STATUS = 2, '', 'I'
    SET_UNITS = 5, '5I'  # length, angle, temperature, pressure, humidity
    GET_UNITS = 6, '', '5I'
    INITIALIZE = 7
    ACTIVATE_CAMERA_VIEW = 9
    PARK = 10
    SET_STATION_ORIENTATION = 12, '6d'
    GET_STATION_ORIENTATION = 13, '', '6d'
    SET_TRANSFORMATION = 14, '7d'
    GET_TRANSFORMATION = 15, '', '7d'
    SET_ENVIRONMENT = 20, '3d'  # temperature, pressure, humidity
    GET_ENVIRONMENT = 21, '', '3d'
    SET_REFRACTION = 22, '2d'
    GET_REFRACTION = 23, '', '2d'
    SET_MEASUREMENT_MODE = 24, 'I'
    GET_MEASUREMENT_MODE = 25, '', 'I'
    SET_COORDINATE_SYSTEM_TYPE = 26, 'I'
    GET_COORDINATE_SYSTEM_TYPE = 27, '', 'I'
    SET_STATIONARY_MODE = 28, '2i'  # integration time in ms, use ADM
    GET_STATIONARY_MODE = 29, '', '2i'
    SET_REFLECTOR = 40, 'i'
    GET_REFLECTOR = 41, '', 'i'
    GET_REFLECTORS = 42, '', '2iId64s'  # one reply per reflector
    SET_SEARCH = 43, 'di'  # radius, time-out in ms
    GET_SEARCH = 44, '', 'di'
    SET_SYSTEM_SETTINGS = 47, 'I8i'
    GET_SYSTEM_SETTINGS = 48, '', 'I8i'
    START_MEASUREMENT = 49
    START_NIVEL_MEASUREMENT = 51
    STOP_MEASUREMENT = 52
    CHANGE_FACE = 53
    GO_BIRD_BATH = 54
    GO_POSITION = 55, '3di'  # three coordinates, use ADM
    GO_POSITION_HVD = 56, '3di'
    POSITION_RELATIVE_HV = 57, '2d'
    POINT_LASER = 58, '3d'
    POINT_LASER_HVD = 59, '3d'
    MOVE_HV = 60, '2i'
    GO_NIVEL_POSITION = 61, 'I'
    GO_LAST_MEASURED_POINT = 62
    FIND_REFLECTOR = 63, 'd'  # approximate distance
    UNKNOWN = 64
    GET_DIRECTION = 66, '', '2d'
    CALL_ORIENT_TO_GRAVITY = 67, '', '2d'
    SET_COMPENSATION = 79, 'i'
    SET_STATISTIC_MODE = 80, '2I'  # stationary, continuous
    GET_STATISTIC_MODE = 81, '', '2I'
    SET_CAMERA = 83, '3i'
    GET_CAMERA = 84, '', '3i'
    GET_COMPENSATION = 85, '', 'i'
    GET_COMPENSATIONS = 86, '', '2i64s256s64si'
    GET_TP_INFO = 90, '', '6i2IiI'
    GET_NIVEL_INFO = 91, '', '3i'
    SET_LASER_ON_TIMER = 92, '2i'
    GET_LASER_ON_TIMER = 93, '', '2i'
    GO_BIRD_BATH_2 = 95, 'i'
    GET_FACE = 98, '', 'I'
    SET_LONG_PARAMETER = 120, 'Ii'
    GET_LONG_PARAMETER = 121, 'I', 'Ii'
    GET_MEASUREMENT_STATUS_INFO = 122, '', 'Ii'
    GET_COMPENSATIONS_2 = 123, '', '2i64s256s64s256s2i'
    SET_DOUBLE_PARAMETER = 125, 'Id'
    GET_DOUBLE_PARAMETER = 126, 'I', 'Id'
    GET_OBJECT_TEMPERATURE = 127, '', 'd'
    GET_OVERVIEW_CAMERA_INFO = 129, '', 'I64si3d2i'
    CLEAR_COMMAND_QUEUE = 130, 'I'
    GET_ADM_INFO_2 = 131, '', 'I64s3i2did'
    GET_TRACKER_INFO = 132, '', 'I64s5i3d2i2dI2i'
    GET_NIVEL_INFO_2 = 133, '', 'I64s3i3d'
    RESTORE_STARTUP_CONDITIONS = 134
    GO_AND_MEASURE = 135, '3d'
    GET_ATR_INFO = 138, '', 'I64s6i4d'
    GET_METEO_STATION_INFO = 139, '', 'I64s2i'
    GET_AT4XX_INFO = 140, '', 'I64s10i2Ii6d'
    GET_SYSTEM_SOFTWARE_VERSION = 142, '', '64s'


class Status(IntEnum):
    """Result of a command (values that our commands can return)."""

    ALL_OK = 0
    SERVER_BUSY = 1
    NOT_IMPLEMENTED = 2
    WRONG_PARAMETER = 3
    WRONG_PARAMETER_1 = 4
    WRONG_PARAMETER_2 = 5
    WRONG_CURRENT_REFLECTOR = 23
    NO_LAST_MEASURED_POINT = 28
    NO_ADM = 30
    NO_DISTANCE_SET = 37
    NO_TRACKER_CONNECTED = 38
    TRACKER_NOT_INITIALIZED = 39
    METEO_DATA_OUT_OF_RANGE = 57
    INVALID_INPUT_DATA = 98
    NO_VALID_ADM_COMPENSATION = 10002
    MEASUREMENT_STATUS_NOT_READY = 10004
    ADM_START_UP_BUSY = 10005
    NO_STATIONARY_RESULT = 10009
    SENSOR_NOT_LEVELED = 10010
    MULTI_CONNECTIONS_NOT_ALLOWED = 10011
    SENSOR_NOT_STABLE = 10013
    SYSTEM_NOT_READY = 10014
    COMMUNICATION_WITH_SENSOR_FAILED = 10015


_MEANING: dict[int, tuple[str, str]] = {
    Status.SERVER_BUSY: ('it is busy with another command', 'wait until that is done'),
    Status.NOT_IMPLEMENTED: (
        'it does not have this command',
        'check that it is an emScon instrument, and its firmware version',
    ),
    Status.WRONG_CURRENT_REFLECTOR: (
        'the reflector set is not the one it sees',
        'set the reflector that is mounted',
    ),
    Status.NO_LAST_MEASURED_POINT: ('nothing has been measured yet', 'go to a position instead'),
    Status.NO_ADM: ('it has no absolute distance meter', 'use a tracker with ADM'),
    Status.NO_DISTANCE_SET: ('it has no distance yet', 'find the reflector first'),
    Status.NO_TRACKER_CONNECTED: (
        'its controller sees no tracker head',
        'check the cable between controller and head',
    ),
    Status.TRACKER_NOT_INITIALIZED: ('it is not initialised', 'initialise it first'),
    Status.METEO_DATA_OUT_OF_RANGE: (
        'temperature, pressure or humidity is out of its range',
        'correct the environment settings',
    ),
    Status.INVALID_INPUT_DATA: ('it could not read the command', 'check its firmware version'),
    Status.NO_VALID_ADM_COMPENSATION: (
        'its distance meter is not calibrated',
        'activate a valid ADM compensation on the instrument',
    ),
    Status.MEASUREMENT_STATUS_NOT_READY: (
        'no reflector is locked (the beam is broken, or a search found nothing)',
        'clear the line of sight and find the reflector or go to its position',
    ),
    Status.ADM_START_UP_BUSY: (
        'it is still warming up',
        'wait: an instrument switched on cold takes up to two hours',
    ),
    Status.NO_STATIONARY_RESULT: ('the measurement gave no result', 'measure again'),
    Status.SENSOR_NOT_LEVELED: ('it is not levelled', 'level the instrument'),
    Status.MULTI_CONNECTIONS_NOT_ALLOWED: (
        'another program holds its only connection',
        'close that program',
    ),
    Status.SENSOR_NOT_STABLE: (
        'the target or the instrument moved while it measured',
        'wait until the arm has settled and measure again',
    ),
    Status.SYSTEM_NOT_READY: ('it is not ready to measure', 'initialise it first'),
    Status.COMMUNICATION_WITH_SENSOR_FAILED: (
        'its controller does not reach the tracker head',
        'check the cable between controller and head',
    ),
}


def describe_status(status: int) -> str:
    """Status as name, number, meaning and remedy, for one line of text.

    An unknown number refers to the instrument's manual.
    """
    try:
        name = Status(status).name.replace('_', ' ').lower()
    except ValueError:
        return f'result status {status}; look it up in the manual of the instrument'
    meaning, remedy = _MEANING.get(
        status, ('it refused a value', 'check the settings of the laser tracker')
    )
    return f'{name} ({status}): {meaning}; {remedy}'


class Change(IntEnum):
    """Content of a status change (values that matter here)."""

    ENVIRONMENT = 2
    REFRACTION = 3
    SEARCH = 4
    UNITS = 6
    REFLECTOR = 7
    SYSTEM_SETTINGS = 8
    COORDINATE_SYSTEM_TYPE = 12
    STATION_ORIENTATION = 15
    TRANSFORMATION = 16
    MEASUREMENT_MODE = 17
    STATIONARY_MODE = 18
    STATISTIC_MODE = 24
    NOT_READY = 25
    BUSY = 26
    READY = 27
    INITIALIZATION = 151
    SERVER_CLOSING = 998
    SERVER_STARTED = 999


class Readiness(IntEnum):
    """Reply to `Command.GET_TRACKER_STATUS`."""

    NOT_READY = 0
    BUSY = 1
    READY = 2


METRE, RADIAN, CELSIUS, MILLIBAR, RELATIVE_HUMIDITY = 0, 0, 0, 0, 0
"""Units that the client sets, in the order of `Command.SET_UNITS`; 1 mbar = 1 hPa."""
RIGHT_HANDED_CARTESIAN = 0
STATIONARY = 0
STANDARD_STATISTICS = 0
TRACKER_INITIALIZED = 5
"""Second value of the reply to `Command.GET_SYSTEM_STATUS` once initialised."""
