# SPDX-License-Identifier: Apache-2.0
"""NatNet, OptiTrack's streaming protocol: datagrams to events and back; no sockets.

A client decodes with `decode_message` and encodes with the ``encode_…_request`` functions; a
server decodes with `decode_request` and encodes with `encode_message` and related functions.
Invalid bytes raise one exception, `ProtocolError`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from struct import Struct

from remaster_ros.sensors.optitrack.natnet_bytes import (
    NEWEST_VERSION,
    ProtocolError,
    Reader,
    Version,
)
from remaster_ros.sensors.optitrack.natnet_codecs import F32, I32, TEXT, Row, number
from remaster_ros.sensors.optitrack.natnet_frame import Frame, decode_frame, encode_frame
from remaster_ros.sensors.optitrack.natnet_model import (
    ModelDefinition,
    decode_model_definition,
    encode_model_definition,
)

DEFAULT_COMMAND_PORT = 1510
DEFAULT_DATA_PORT = 1511
DEFAULT_MULTICAST_GROUP = '239.255.42.99'
MAX_PAYLOAD_BYTES = 65503
_HEADER = Struct('<2H')
_SENDER = Struct('<256s4B4B')
_CONNECTION = Struct('<QHB4B')
_OPTIONS = Struct('<B4B')
_CLOCK = number('Q')
_TWO_CLOCKS = Row('2Q')


class MessageId(IntEnum):
    """Kind of a message: the first two bytes of a datagram."""

    CONNECT = 0
    SERVERINFO = 1
    REQUEST = 2
    RESPONSE = 3
    REQUEST_MODELDEF = 4
    MODELDEF = 5
    REQUEST_FRAMEOFDATA = 6
    FRAMEOFDATA = 7
    MESSAGESTRING = 8
    DISCONNECT = 9
    KEEPALIVE = 10
    DISCONNECT_BY_TIMEOUT = 11
    ECHOREQUEST = 12
    ECHORESPONSE = 13
    DISCOVERY = 14
    UNRECOGNIZED_REQUEST = 100


@dataclass(frozen=True)
class Connection:
    """Connection settings of a server of NatNet 3.0 or newer."""

    clock_frequency: int  # Ticks per second of the three stamps of a frame
    data_port: int
    is_multicast: bool
    multicast_group: str


@dataclass(frozen=True)
class ServerInfo:
    """Answer to CONNECT."""

    name: str
    app_version: tuple[int, int, int, int]
    natnet_version: Version  # Bitstream version that determines the decoding
    connection: Connection | None = None  # None before NatNet 3.0


@dataclass(frozen=True)
class Response:
    """Answer to a REQUEST; its meaning depends on the request."""

    payload: bytes

    @property
    def code(self) -> int | None:
        """Answer as an integer, 0 for success; None if it is a text."""
        return I32.read(Reader(self.payload)) if len(self.payload) == 4 else None

    @property
    def value(self) -> float | None:
        """Answer as a number, such as the frame rate; None if it is a text."""
        return F32.read(Reader(self.payload)) if len(self.payload) == 4 else None

    @property
    def text(self) -> str:
        """Answer as a text, such as ``Bitstream,4.1``."""
        return _text(self.payload)


@dataclass(frozen=True)
class MessageString:
    """Line of text from the server."""

    text: str


@dataclass(frozen=True)
class EchoResponse:
    """Client's clock as sent, and the server's ticks at its arrival."""

    client_clock: int
    server_clock: int


@dataclass(frozen=True)
class Notice:
    """Message without content: UNRECOGNIZED_REQUEST, or a disconnection by the server."""

    id: MessageId


Message = ServerInfo | Response | ModelDefinition | Frame | MessageString | EchoResponse | Notice


@dataclass(frozen=True)
class ClientRequest:
    """Request of a client."""

    id: int  # A `MessageId`, or an unknown number
    text: str = ''  # Command of a REQUEST
    # Bitstream that a CONNECT requests; None for the server's own
    wanted_version: Version | None = None
    clock: int = 0  # Client's clock in an ECHOREQUEST


def split_datagram(datagram: bytes) -> tuple[int, bytes]:
    """Message id and payload of a datagram; bytes after the payload are ignored.

    Raises ProtocolError if the datagram is shorter than its header states.
    """
    if len(datagram) < _HEADER.size:
        raise ProtocolError(f'a datagram of {len(datagram)} bytes has no header')
    message_id, size = _HEADER.unpack_from(datagram)
    if len(datagram) < _HEADER.size + size:
        raise ProtocolError(
            f'a datagram of {len(datagram)} bytes that should have {_HEADER.size + size}'
        )
    return message_id, datagram[_HEADER.size : _HEADER.size + size]


def join_datagram(message_id: int, payload: bytes = b'') -> bytes:
    """Datagram of a header and a payload.

    ``message_id``: one of `MessageId`, in 16 bits. The header is message_id and the payload's
    length.

    Raises ValueError if the payload is longer than a datagram can be.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f'a payload of {len(payload)} bytes is over {MAX_PAYLOAD_BYTES}')
    return _HEADER.pack(message_id, len(payload)) + payload


def decode_message(datagram: bytes, version: Version | None) -> Message:
    """Message of a server; a frame as by `decode_frame`.

    ``datagram``: as received; ``version``: the server's bitstream version, or None while it is
    unknown, when frames and model definitions cannot be read. Raises ProtocolError if the datagram
    is not a whole, valid message of a server.
    """
    message_id, payload = split_datagram(datagram)
    match message_id:
        case MessageId.FRAMEOFDATA:
            return decode_frame(payload, _known(version))
        case MessageId.SERVERINFO:
            return _decode_server_info(payload)
        case MessageId.MODELDEF:
            return decode_model_definition(payload, _known(version))
        case MessageId.RESPONSE:
            return Response(payload)
        case MessageId.MESSAGESTRING:
            return MessageString(_text(payload))
        case MessageId.ECHORESPONSE:
            return EchoResponse(*_TWO_CLOCKS.read(Reader(payload)))
        case (
            MessageId.UNRECOGNIZED_REQUEST | MessageId.DISCONNECT | MessageId.DISCONNECT_BY_TIMEOUT
        ):
            return Notice(MessageId(message_id))
    raise ProtocolError(f'message {message_id} is none that a server sends')


def encode_message(message: Message, version: Version) -> bytes:
    """Datagram of a server's message, with header.

    Raises ProtocolError if the version of a frame or model definition is unknown; ValueError,
    struct.error if a value does not fit its field.
    """
    if isinstance(message, Frame):
        return join_datagram(MessageId.FRAMEOFDATA, encode_frame(message, version))
    if isinstance(message, ServerInfo):
        return join_datagram(MessageId.SERVERINFO, _encode_server_info(message))
    if isinstance(message, ModelDefinition):
        return join_datagram(MessageId.MODELDEF, encode_model_definition(message, version))
    if isinstance(message, Response):
        return join_datagram(MessageId.RESPONSE, message.payload)
    if isinstance(message, MessageString):
        return join_datagram(MessageId.MESSAGESTRING, message.text.encode() + b'\0')
    if isinstance(message, EchoResponse):
        clocks = _TWO_CLOCKS.write((message.client_clock, message.server_clock))
        return join_datagram(MessageId.ECHORESPONSE, clocks)
    return join_datagram(message.id)


def decode_request(datagram: bytes) -> ClientRequest:
    """Request in a client's datagram, by its message id, which may be unknown.

    A CONNECT has the wanted version, a REQUEST its text, an ECHOREQUEST its clock. The length
    in the header is ignored, as clients get it wrong.

    Raises ProtocolError if there is no header, or an ECHOREQUEST has no clock.
    """
    if len(datagram) < _HEADER.size:
        raise ProtocolError(f'a datagram of {len(datagram)} bytes has no header')
    (message_id, _size), payload = _HEADER.unpack_from(datagram), datagram[_HEADER.size :]
    if message_id == MessageId.CONNECT:
        return ClientRequest(message_id, wanted_version=_wanted_version(payload))
    if message_id == MessageId.REQUEST:
        return ClientRequest(message_id, text=_text(payload))
    if message_id == MessageId.ECHOREQUEST:
        return ClientRequest(message_id, clock=_CLOCK.read(Reader(payload)))
    return ClientRequest(message_id)


def encode_connect_request(name: str, wanted_version: Version | None = None) -> bytes:
    """CONNECT in its full form, which servers of every version accept.

    ``name``: name of this program; ``wanted_version``: bitstream for this client (unicast, servers
    from 4.0); None for the server's own.
    """
    major, minor = wanted_version or (0, 0)
    sender = _SENDER.pack(name.encode()[:255], 1, 0, 0, 0, *NEWEST_VERSION, 0, 0)
    # Two bytes of padding, as OptiTrack's own client sends them.
    return join_datagram(
        MessageId.CONNECT, sender + _OPTIONS.pack(0, major, minor, 0, 0) + b'\0\0'
    )


def encode_command_request(command: str) -> bytes:
    """REQUEST with a command such as ``FrameRate`` or ``Bitstream,4.1``.

    Raises ValueError if it has a NUL or over 255 bytes.
    """
    return join_datagram(MessageId.REQUEST, TEXT.write(command))


def encode_echo_request(clock: int) -> bytes:
    """ECHOREQUEST with the client's clock, an unsigned 64-bit number; struct.error for another."""
    return join_datagram(MessageId.ECHOREQUEST, _CLOCK.write(clock))


def parse_version(text: str) -> Version:
    """Version in a text such as ``4.1`` (or ``4.1.0.0``).

    Raises ValueError if the text is not two or more whole numbers with dots between.
    """
    parts = text.split('.')
    if len(parts) < 2 or not all(part.isdecimal() and part.isascii() for part in parts):
        raise ValueError(f'{text!r} is no NatNet version such as 4.1')
    return int(parts[0]), int(parts[1])


def format_version(version: Version) -> str:
    """Version as text, such as ``4.1``."""
    return f'{version[0]}.{version[1]}'


def _known(version: Version | None) -> Version:
    """Return the bitstream version; ProtocolError if it is None."""
    if version is None:
        raise ProtocolError('the bitstream version is not known yet')
    return version


def _text(payload: bytes) -> str:
    """UTF-8 text up to the first NUL, or to the end; invalid bytes become U+FFFD."""
    return payload.partition(b'\0')[0].decode('utf-8', 'replace')


def _wanted_version(payload: bytes) -> Version | None:
    """Wanted bitstream in the full form of CONNECT; None in shorter forms, or for 0.0."""
    if len(payload) < _SENDER.size + _OPTIONS.size:
        return None
    _subscribed, major, minor, _build, _revision = _OPTIONS.unpack_from(payload, _SENDER.size)
    return (major, minor) if major else None


def _decode_server_info(payload: bytes) -> ServerInfo:
    """Decode the answer to CONNECT; its connection is None before NatNet 3.0.

    Raises ProtocolError if the payload is too short; further bytes are ignored.
    """
    reader = Reader(payload)
    name, *versions = reader.unpack(_SENDER)
    app_version, natnet_version = tuple(versions[:4]), (versions[4], versions[5])
    connection = None
    if natnet_version >= (3, 0):
        frequency, data_port, multicast, *group = reader.unpack(_CONNECTION)
        connection = Connection(frequency, data_port, bool(multicast), '.'.join(map(str, group)))
    return ServerInfo(_text(name), app_version, natnet_version, connection)  # type: ignore[arg-type]


def _encode_server_info(info: ServerInfo) -> bytes:
    """Encode an answer to CONNECT; ValueError if one of 3.0 or later lacks its connection."""
    name = info.name.encode()[:255]
    payload = _SENDER.pack(name, *info.app_version, *info.natnet_version, 0, 0)
    if info.natnet_version < (3, 0):
        return payload
    if info.connection is None:
        raise ValueError('a server of NatNet 3.0 or newer tells how it streams')
    group = (int(part) for part in info.connection.multicast_group.split('.'))
    return payload + _CONNECTION.pack(
        info.connection.clock_frequency,
        info.connection.data_port,
        info.connection.is_multicast,
        *group,
    )
