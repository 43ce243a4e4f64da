# SPDX-License-Identifier: Apache-2.0
"""Leica emScon subset of this package: bytes to events and back, both directions, without I/O.

Every packet is ``int32 size`` (of the whole packet), ``uint32 type`` and a body, little-endian and
packed. Commands and replies have type 0, so a reader is made for one side.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, fields
from enum import Enum
from itertools import islice
from struct import Struct
from typing import Any, Literal

from remaster_ros.sensors.laser_tracker.codes import Command, DataType

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
    """Type of `NEED_DATA`, which `PacketReader.next_event` returns for incomplete packets."""

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
    """Numbers of a packet's body by its layout; ProtocolError for a body of another length.

    ``what``: name of the packet, for the error.
    """
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
