# SPDX-License-Identifier: Apache-2.0
"""Leica emScon subset of this package: bytes to events and back, both directions, without I/O.

Every packet is ``int32 size`` (of the whole packet), ``uint32 type`` and a body, little-endian and
packed. Commands and replies have type 0, so a reader is made for one side.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, fields
from enum import Enum, IntEnum
from itertools import islice
from struct import Struct
from typing import Any, Literal

# Numbers of the Leica emScon protocol and what they mean, in words and with a remedy.
#
# The commands carry the layout of their packets, so that one table serves both directions.


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


MIN_PACKET_SIZE = 12
MAX_PACKET_SIZE = 4096
"""Largest size of a packet, bytes; the largest known has 672. A larger size means damaged data."""

_HEADER = Struct('<iI')
_CODE = Struct('<I')
_COMMAND_AND_STATUS = Struct('<II')
_RESULT = Struct('<IIi17d')
_TRIPLES = ('values', 'std', 'pointing_error', 'a_priori_std')

Value = int | float | bytes
Triple = tuple[float, float, float]


class ProtocolError(Exception):
    """Bytes from the peer that are not emScon; the text states the error."""


class NeedData(Enum):
    """Value of `PacketReader.next_event` while the next packet is not complete."""

    NEED_DATA = 'need data'


NEED_DATA = NeedData.NEED_DATA


@dataclass(frozen=True)
class Request:
    """Command to the instrument with the values of its layout."""

    command: Command
    values: tuple[Value, ...] = ()


@dataclass(frozen=True)
class Reply:
    """Answer to a command; a failed one (`status` not 0) has no values."""

    command: Command
    status: int = 0
    values: tuple[Value, ...] = ()


@dataclass(frozen=True)
class ErrorReport:
    """Error that is reported after the reply, or without a command."""

    command: int
    status: int


@dataclass(frozen=True)
class StatusChange:
    """Change reported by the instrument: a `Change`, or an unknown number."""

    change: int


@dataclass(frozen=True)
class Measurement:
    """Result of one stationary measurement, in the units and coordinates set (156 bytes)."""

    status: int
    mode: int
    is_try: int
    # One number per coordinate each
    values: Triple
    std: Triple
    # Their root sums of squares
    std_total: float
    pointing_error: Triple
    a_priori_std: Triple
    a_priori_std_total: float
    temperature: float
    pressure: float
    humidity: float


@dataclass(frozen=True)
class UnknownPacket:
    """Whole packet of an unknown type or command, to be counted and dropped."""

    type: int
    body: bytes


@dataclass(frozen=True)
class ConnectionClosed:
    """Close of the connection by the peer between two packets."""


Event = (
    Request | Reply | ErrorReport | StatusChange | Measurement | UnknownPacket | ConnectionClosed
)


def encode(event: Event) -> bytes:
    """Packet of an event.

    A failed reply is filled with zeros to the size of a successful one, because clients unpack the
    whole layout before they check the status. Raises ValueError if the values do not fit the
    layout, or the event is no packet.
    """
    try:
        type_, body = _type_and_body(event)
        return _HEADER.pack(_HEADER.size + len(body), type_) + body
    except struct.error as error:
        raise ValueError(f'{event} does not fit its packet: {error}') from error


def _type_and_body(event: Event) -> tuple[int, bytes]:
    """Type and body of an event's packet; ValueError for an event that has no packet."""
    match event:
        case Request(command, values):
            return DataType.COMMAND, _CODE.pack(command) + command.request.pack(*values)
        case Reply(command, status, values):
            head = _COMMAND_AND_STATUS.pack(command, status)
            if status and not values:
                return DataType.COMMAND, head + bytes(command.reply.size)
            return DataType.COMMAND, head + command.reply.pack(*values)
        case ErrorReport(code, status):
            return DataType.ERROR, _COMMAND_AND_STATUS.pack(code, status)
        case StatusChange(change):
            return DataType.STATUS_CHANGE, _CODE.pack(change)
        case Measurement():
            return DataType.SINGLE_RESULT, _RESULT.pack(*_flat(event))
        case UnknownPacket(type_, body):
            return type_, body
    raise ValueError(f'{event} is no packet')


class PacketReader:
    """Reader that cuts a stream of bytes into events.

    Feed bytes with `receive_data` and call `next_event` until it returns `NEED_DATA`; memory is
    then bounded by one packet and one read. ``side``: ``client`` reads packets of an instrument,
    ``server`` packets of a client.
    """

    def __init__(self, side: Literal['client', 'server']) -> None:
        self._decode_command = _decode_reply if side == 'client' else _decode_request
        self._buffer = bytearray()
        self._at_end = False
        # True once the boundaries of packets are lost: the connection cannot be used further.
        self.broken = False

    @property
    def trailing_data(self) -> bytes:
        """Bytes received and not yet returned as an event."""
        return bytes(self._buffer)

    def receive_data(self, data: bytes) -> None:
        """Add bytes from the peer; empty bytes mean that it closed the connection."""
        if data:
            self._buffer += data
        else:
            self._at_end = True

    def next_event(self) -> Event | NeedData:
        """Next event, or `NEED_DATA` while it is incomplete; ConnectionClosed at the end.

        Raises ProtocolError if the packet does not fit its layout; it is dropped, and the next
        call continues after it. If the size of a packet is impossible, or the peer closed within a
        packet, `broken` is set and every further call raises.
        """
        buffer = self._buffer
        if len(buffer) < _HEADER.size:
            return self._incomplete(_HEADER.size)
        size, type_ = _HEADER.unpack_from(buffer)
        if not MIN_PACKET_SIZE <= size <= MAX_PACKET_SIZE:
            self.broken = True
            raise ProtocolError(
                f'packet size {size} is not within {MIN_PACKET_SIZE} to {MAX_PACKET_SIZE} bytes'
            )
        if len(buffer) < size:
            return self._incomplete(size)
        body = bytes(buffer[_HEADER.size : size])
        del buffer[:size]
        if type_ == DataType.COMMAND:
            return self._decode_command(body)
        if type_ == DataType.ERROR:
            return ErrorReport(*_unpack(_COMMAND_AND_STATUS, body, 'error'))
        if type_ == DataType.STATUS_CHANGE:
            return StatusChange(*_unpack(_CODE, body, 'status change'))
        if type_ == DataType.SINGLE_RESULT:
            return _decode_result(body)
        return UnknownPacket(type_, body)

    def _incomplete(self, size: int) -> Event | NeedData:
        """`NEED_DATA` while a packet of at least `size` bytes is incomplete.

        At the end of the stream: ConnectionClosed, or ProtocolError, with `broken` set, within a
        packet.
        """
        if not self._at_end:
            return NEED_DATA
        if not self._buffer:
            return ConnectionClosed()
        self.broken = True
        raise ProtocolError(
            f'connection closed after {len(self._buffer)} of at least {size} bytes of a packet'
        )


def _unpack(layout: Struct, body: bytes, what: str) -> tuple:
    """Values of a packet's body; ProtocolError for another length. `what`: name of the packet."""
    if len(body) != layout.size:
        raise ProtocolError(f'{what} packet with {len(body)} bytes of body, not {layout.size}')
    return layout.unpack(body)


def _decode_request(body: bytes) -> Event:
    """Request of a packet's body; UnknownPacket for an unknown command.

    Raises ProtocolError if its values do not fit the command.
    """
    (code,) = _CODE.unpack_from(body)
    try:
        command = Command(code)
    except ValueError:
        return UnknownPacket(DataType.COMMAND, body)
    return Request(command, _unpack(command.request, body[_CODE.size :], command.name))


def _decode_reply(body: bytes) -> Event:
    """Reply of a packet's body, without values if it failed; UnknownPacket for an unknown command.

    Raises ProtocolError if the body is too short, or if its values do not fit the command.
    """
    if len(body) < _COMMAND_AND_STATUS.size:
        raise ProtocolError(f'reply with {len(body)} bytes of body, not at least 8')
    code, status = _COMMAND_AND_STATUS.unpack_from(body)
    try:
        command = Command(code)
    except ValueError:
        return UnknownPacket(DataType.COMMAND, body)
    payload = body[_COMMAND_AND_STATUS.size :]
    if status and not payload:
        # Instruments may leave out the values of a failed reply, or send zeros.
        return Reply(command, status)
    values = _unpack(command.reply, payload, f'{command.name} reply')
    return Reply(command, status, () if status else values)


def _decode_result(body: bytes) -> Measurement:
    """Measurement of a packet's body; ProtocolError for another length."""
    numbers: Iterator[Any] = iter(_unpack(_RESULT, body, 'measurement'))
    values: Iterator[Any] = (
        tuple(islice(numbers, 3)) if field.name in _TRIPLES else next(numbers)
        for field in fields(Measurement)
    )
    return Measurement(*values)


def _flat(result: Measurement) -> Iterator[float]:
    """Numbers of a measurement in the order of its packet, the inverse of `_decode_result`.

    Three for a field with one number per coordinate, one for others.
    """
    for field in fields(result):
        value = getattr(result, field.name)
        yield from value if field.name in _TRIPLES else (value,)
