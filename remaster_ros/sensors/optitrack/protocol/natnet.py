"""NatNet, OptiTrack's streaming protocol: datagrams to events and back; no sockets.

A client decodes with `decode_message` and encodes with the ``encode_…_request`` functions; a
server decodes with `decode_request` and encodes with `encode_message` and its kin. The layout of
frames is in `frames`, that of model definitions in `models`. One exception comes out of bad bytes:
`ProtocolError`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from struct import Struct

from remaster_ros.sensors.optitrack.protocol.codec import F32, I32, TEXT, Row, number
from remaster_ros.sensors.optitrack.protocol.frames import Frame, decode_frame, encode_frame
from remaster_ros.sensors.optitrack.protocol.models import (
    ModelDefinition,
    decode_model_definition,
    encode_model_definition,
)
from remaster_ros.sensors.optitrack.protocol.wire import (
    NEWEST_VERSION,
    ProtocolError,
    Reader,
    Version,
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
    """How a server of NatNet 3.0 or newer streams.

    Attributes
    ----------
    clock_frequency
        Ticks per second of the three stamps of a frame.
    """

    clock_frequency: int
    data_port: int
    is_multicast: bool
    multicast_group: str


@dataclass(frozen=True)
class ServerInfo:
    """The answer to CONNECT.

    Attributes
    ----------
    natnet_version
        The bitstream version that governs decoding.
    connection
        None before NatNet 3.0.
    """

    name: str
    app_version: tuple[int, int, int, int]
    natnet_version: Version
    connection: Connection | None = None


@dataclass(frozen=True)
class Response:
    """The answer to a REQUEST; its meaning depends on the request."""

    payload: bytes

    @property
    def code(self) -> int | None:
        """The answer as an integer, 0 for success; None if it is a text."""
        return I32.read(Reader(self.payload)) if len(self.payload) == 4 else None

    @property
    def value(self) -> float | None:
        """The answer as a number, such as the frame rate; None if it is a text."""
        return F32.read(Reader(self.payload)) if len(self.payload) == 4 else None

    @property
    def text(self) -> str:
        """The answer as a text, such as ``Bitstream,4.1``."""
        return _text(self.payload)


@dataclass(frozen=True)
class MessageString:
    """A line of text from the server."""

    text: str


@dataclass(frozen=True)
class EchoResponse:
    """The client's clock as it was sent, and the server's ticks when it arrived."""

    client_clock: int
    server_clock: int


@dataclass(frozen=True)
class Notice:
    """A message without content: UNRECOGNIZED_REQUEST, or a disconnection by the server."""

    id: MessageId


Message = ServerInfo | Response | ModelDefinition | Frame | MessageString | EchoResponse | Notice


@dataclass(frozen=True)
class ClientRequest:
    """What a client sent.

    Attributes
    ----------
    id
        A `MessageId`, or the number of one that is unknown here.
    text
        The command of a REQUEST.
    wanted_version
        The bitstream that a CONNECT requests; None for the server's own.
    clock
        The client's clock of an ECHOREQUEST.
    """

    id: int
    text: str = ''
    wanted_version: Version | None = None
    clock: int = 0


def split_datagram(datagram: bytes) -> tuple[int, bytes]:
    """Return the message id and the payload; bytes behind the payload are ignored.

    Raises
    ------
    ProtocolError
        If the datagram is shorter than its header states.
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
    """Put the header in front of a payload.

    Raises
    ------
    ValueError
        If the payload is longer than a datagram can carry.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f'a payload of {len(payload)} bytes is over {MAX_PAYLOAD_BYTES}')
    return _HEADER.pack(message_id, len(payload)) + payload


def decode_message(
    datagram: bytes, version: Version | None, *, markers_only: bool = False
) -> Message:
    """Decode what a server sent.

    Parameters
    ----------
    datagram
        As received.
    version
        The server's bitstream version; None while it is unknown, when frames and model
        definitions cannot be read.
    markers_only
        As for `decode_frame`.

    Raises
    ------
    ProtocolError
        For anything that is not a whole, valid message from a server.
    """
    message_id, payload = split_datagram(datagram)
    match message_id:
        case MessageId.FRAMEOFDATA:
            return decode_frame(payload, _known(version), markers_only=markers_only)
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
    """Encode what a server sends, header included.

    Raises
    ------
    ProtocolError
        If a frame or model definition is to be encoded for an unknown version.
    ValueError, struct.error
        If a value does not fit its field.
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
    """Decode what a client sent; the length in its header is ignored, as clients get it wrong.

    Raises
    ------
    ProtocolError
        If there is no header, or an ECHOREQUEST without a clock.
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
    """Encode CONNECT in its full form, which servers of every version accept.

    Parameters
    ----------
    name
        Of this program.
    wanted_version
        The bitstream to be streamed to this client (unicast, servers from 4.0); None for the
        server's own.
    """
    major, minor = wanted_version or (0, 0)
    sender = _SENDER.pack(name.encode()[:255], 1, 0, 0, 0, *NEWEST_VERSION, 0, 0)
    # Two bytes of padding, as OptiTrack's own client sends them.
    return join_datagram(
        MessageId.CONNECT, sender + _OPTIONS.pack(0, major, minor, 0, 0) + b'\0\0'
    )


def encode_command_request(command: str) -> bytes:
    """Encode REQUEST with a command such as ``FrameRate`` or ``Bitstream,4.1``."""
    return join_datagram(MessageId.REQUEST, TEXT.write(command))


def encode_echo_request(clock: int) -> bytes:
    """Encode ECHOREQUEST with the client's clock, any unsigned 64-bit number."""
    return join_datagram(MessageId.ECHOREQUEST, _CLOCK.write(clock))


def parse_version(text: str) -> Version:
    """Read ``4.1`` (or ``4.1.0.0``).

    Raises
    ------
    ValueError
        If it is not two or more whole numbers with dots between.
    """
    parts = text.split('.')
    if len(parts) < 2 or not all(part.isdecimal() and part.isascii() for part in parts):
        raise ValueError(f'{text!r} is no NatNet version such as 4.1')
    return int(parts[0]), int(parts[1])


def format_version(version: Version) -> str:
    """Write a version as ``4.1``."""
    return f'{version[0]}.{version[1]}'


def _known(version: Version | None) -> Version:
    if version is None:
        raise ProtocolError('the bitstream version is not known yet')
    return version


def _text(payload: bytes) -> str:
    return payload.partition(b'\0')[0].decode('utf-8', 'replace')


def _wanted_version(payload: bytes) -> Version | None:
    """Find the wanted bitstream in the full form of CONNECT; shorter forms name none."""
    if len(payload) < _SENDER.size + _OPTIONS.size:
        return None
    _subscribed, major, minor, _build, _revision = _OPTIONS.unpack_from(payload, _SENDER.size)
    return (major, minor) if major else None


def _decode_server_info(payload: bytes) -> ServerInfo:
    reader = Reader(payload)
    name, *versions = reader.unpack(_SENDER)
    app_version, natnet_version = tuple(versions[:4]), (versions[4], versions[5])
    connection = None
    if natnet_version >= (3, 0):
        frequency, data_port, multicast, *group = reader.unpack(_CONNECTION)
        connection = Connection(frequency, data_port, bool(multicast), '.'.join(map(str, group)))
    return ServerInfo(_text(name), app_version, natnet_version, connection)  # type: ignore[arg-type]


def _encode_server_info(info: ServerInfo) -> bytes:
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
