"""The Leica emScon subset that is used here: bytes to events and back, both directions, no I/O.

Every packet is ``int32 size`` (of the whole packet), ``uint32 type`` and a body, little-endian and
packed. Commands and replies share type 0, so a reader is made for one side.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, fields
from enum import Enum
from itertools import islice
from struct import Struct
from typing import Any, Literal

from remaster_ros.sensors.laser_tracker.protocol.codes import Command, DataType

MIN_PACKET_SIZE = 12
MAX_PACKET_SIZE = 4096
"""Bytes; the largest packet known has 672. A larger size is damage, not data."""

_HEADER = Struct('<iI')
_CODE = Struct('<I')
_COMMAND_AND_STATUS = Struct('<II')
_RESULT = Struct('<IIi17d')
_TRIPLES = ('values', 'std', 'pointing_error', 'a_priori_std')

Value = int | float | bytes
Triple = tuple[float, float, float]


class ProtocolError(Exception):
    """The peer sent bytes that are not emScon; the text states what is wrong."""


class NeedData(Enum):
    """What `PacketReader.next_event` returns while the next packet is not complete."""

    NEED_DATA = 'need data'


NEED_DATA = NeedData.NEED_DATA


@dataclass(frozen=True)
class Request:
    """A command to the instrument with the values of its layout."""

    command: Command
    values: tuple[Value, ...] = ()


@dataclass(frozen=True)
class Reply:
    """The answer to a command; one that failed (`status` not 0) carries no values."""

    command: Command
    status: int = 0
    values: tuple[Value, ...] = ()


@dataclass(frozen=True)
class ErrorReport:
    """An error that comes later than the reply, or without a command."""

    command: int
    status: int


@dataclass(frozen=True)
class StatusChange:
    """The instrument reports that something changed: a `Change`, or an unknown number."""

    change: int


@dataclass(frozen=True)
class Measurement:
    """Result of one stationary measurement, in the units and coordinates set (156 bytes).

    Attributes
    ----------
    values, std, pointing_error, a_priori_std
        One number per coordinate each.
    std_total, a_priori_std_total
        Their root sums of squares.
    """

    status: int
    mode: int
    is_try: int
    values: Triple
    std: Triple
    std_total: float
    pointing_error: Triple
    a_priori_std: Triple
    a_priori_std_total: float
    temperature: float
    pressure: float
    humidity: float


@dataclass(frozen=True)
class UnknownPacket:
    """A whole packet of an unknown type or command; to be counted and dropped."""

    type: int
    body: bytes


@dataclass(frozen=True)
class ConnectionClosed:
    """The peer closed the connection between two packets."""


Event = (
    Request | Reply | ErrorReport | StatusChange | Measurement | UnknownPacket | ConnectionClosed
)


def encode(event: Event) -> bytes:
    """Return the packet of an event.

    A failed reply is filled with zeros to the size of one that succeeded, because clients unpack
    the whole layout before they look at the status.

    Raises
    ------
    ValueError
        If the values do not fit the layout, or the event is no packet.
    """
    try:
        type_, body = _type_and_body(event)
        return _HEADER.pack(_HEADER.size + len(body), type_) + body
    except struct.error as error:
        raise ValueError(f'{event} does not fit its packet: {error}') from error


def _type_and_body(event: Event) -> tuple[int, bytes]:
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
    """Cuts a stream of bytes into events.

    Feed it with `receive_data` and call `next_event` until it returns `NEED_DATA`; memory is then
    bounded by one packet and one read.

    Parameters
    ----------
    side
        ``client`` reads what an instrument sends, ``server`` what a client sends.

    Attributes
    ----------
    broken
        True once the boundaries of packets are lost; the connection is of no further use.
    """

    def __init__(self, side: Literal['client', 'server']) -> None:
        self._decode_command = _decode_reply if side == 'client' else _decode_request
        self._buffer = bytearray()
        self._at_end = False
        self.broken = False

    @property
    def trailing_data(self) -> bytes:
        """Bytes received and not yet returned as an event."""
        return bytes(self._buffer)

    def receive_data(self, data: bytes) -> None:
        """Take bytes from the peer; empty ones mean that it closed the connection."""
        if data:
            self._buffer += data
        else:
            self._at_end = True

    def next_event(self) -> Event | NeedData:
        """Return the next event, or `NEED_DATA`.

        Raises
        ------
        ProtocolError
            If the packet does not fit its layout; it is dropped, and the next call goes on after
            it. If the size of a packet is impossible, or the peer closed in the middle of one,
            `broken` is set and every further call raises.
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
        if not self._at_end:
            return NEED_DATA
        if not self._buffer:
            return ConnectionClosed()
        self.broken = True
        raise ProtocolError(
            f'connection closed after {len(self._buffer)} of at least {size} bytes of a packet'
        )


def _unpack(layout: Struct, body: bytes, what: str) -> tuple:
    if len(body) != layout.size:
        raise ProtocolError(f'{what} packet with {len(body)} bytes of body, not {layout.size}')
    return layout.unpack(body)


def _decode_request(body: bytes) -> Event:
    (code,) = _CODE.unpack_from(body)
    try:
        command = Command(code)
    except ValueError:
        return UnknownPacket(DataType.COMMAND, body)
    return Request(command, _unpack(command.request, body[_CODE.size :], command.name))


def _decode_reply(body: bytes) -> Event:
    if len(body) < _COMMAND_AND_STATUS.size:
        raise ProtocolError(f'reply with {len(body)} bytes of body, not at least 8')
    code, status = _COMMAND_AND_STATUS.unpack_from(body)
    try:
        command = Command(code)
    except ValueError:
        return UnknownPacket(DataType.COMMAND, body)
    rest = body[_COMMAND_AND_STATUS.size :]
    if status and not rest:
        # Instruments may leave out the values of a failed reply, or send zeros.
        return Reply(command, status)
    values = _unpack(command.reply, rest, f'{command.name} reply')
    return Reply(command, status, () if status else values)


def _decode_result(body: bytes) -> Measurement:
    numbers: Iterator[Any] = iter(_unpack(_RESULT, body, 'measurement'))
    values: Iterator[Any] = (
        tuple(islice(numbers, 3)) if field.name in _TRIPLES else next(numbers)
        for field in fields(Measurement)
    )
    return Measurement(*values)


def _flat(result: Measurement) -> Iterator[float]:
    """Undo `_decode_result`: three numbers for what has one per coordinate."""
    for field in fields(result):
        value = getattr(result, field.name)
        yield from value if field.name in _TRIPLES else (value,)
