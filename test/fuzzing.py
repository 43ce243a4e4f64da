"""Hostile bytes: valid messages of every version, spoilt, and what they are thrown at.

A target takes bytes and raises whatever must not happen; `run` feeds it, and bounds the processor
time of every single input. Nothing here opens a socket.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import random
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from remaster_ros.sensors.laser_tracker.client import LaserTrackerClient
from remaster_ros.sensors.laser_tracker.link import LaserTrackerError
from remaster_ros.sensors.laser_tracker.protocol import codes
from remaster_ros.sensors.laser_tracker.protocol import packets as emscon
from remaster_ros.sensors.laser_tracker.settings import LaserTrackerSettings
from remaster_ros.sensors.optitrack import marker_follower
from remaster_ros.sensors.optitrack.client import NatNetClient
from remaster_ros.sensors.optitrack.frame_gate import Dropped, MarkerChoice, MarkerSample
from remaster_ros.sensors.optitrack.protocol import natnet
from remaster_ros.sensors.optitrack.protocol.frames import (
    TRACKING_VALID,
    AnalogDevice,
    Asset,
    BodyMarker,
    Frame,
    LabeledMarker,
    MarkerSet,
    RigidBody,
    Skeleton,
)
from remaster_ros.sensors.optitrack.protocol.models import (
    MarkerSetDescription,
    ModelDefinition,
    RigidBodyDescription,
    SkeletonDescription,
)
from remaster_ros.sensors.optitrack.settings import NatNetSettings
from remaster_ros.types import FARTHEST_M

VERSIONS: tuple[natnet.Version, ...] = (
    (2, 6), (2, 7), (2, 9), (2, 10), (2, 11), (3, 0), (3, 1), (4, 0), (4, 1), (4, 2), (4, 3),
)  # fmt: skip
TIME_LIMIT_S = 0.25
"""Processor time that one input may take: fifty times what the longest valid datagram does."""

_INTEGERS = (0, 1, -1, 2, 255, 65535, 70_000, 10**6, 2**31 - 1, -(2**31), 2**30, 4711)
_REALS = (math.nan, math.inf, -math.inf, 0.0, 0.3, 1e-45, 3e38, -3e38)
_LONGEST = 65_507
"""Bytes that one UDP datagram carries."""

Target = Callable[[bytes], None]


class FuzzError(AssertionError):
    """A target did what it must not; the text holds the input."""


# Valid messages


def full_frame(
    version: natnet.Version, number: int = 7, markers: int = 4, stray: bool = True
) -> Frame:
    """Return a frame with something in every section that the version has."""
    residual = 2e-4 if version >= (3, 0) else None
    # No two frames are the same to the last bit: such a marker counts as frozen.
    y = 0.2 + 1e-6 * (number % 1000)
    positions = tuple((0.1 * i, y, 2.0) for i in range(1, markers + 1))
    labeled = tuple(
        LabeledMarker(1 << 16 | i, position, 0.014, 0x0A, residual)
        for i, position in enumerate(positions, start=1)
    )
    inner = tuple(BodyMarker(p, i, 0.014) for i, p in enumerate(positions, start=1))
    body = RigidBody(
        1, positions[0], (0.0, 0.0, 0.0, 1.0), 1e-4, TRACKING_VALID,
        inner if version < (3, 0) else (),
    )  # fmt: skip
    analog = (AnalogDevice(5, ((1.0, 2.0), (3.0,))),)
    return Frame(
        number=number,
        timestamp=number / 120,
        labeled_markers=(
            *labeled,
            *([LabeledMarker(4711, (1.0,) * 3, 0.01, 0x12, residual)] if stray else []),
        ),
        rigid_bodies=(body,),
        marker_sets=(MarkerSet('tool', positions), MarkerSet('all', positions)),
        other_markers=((1.0, 1.0, 1.0),),
        skeletons=(Skeleton(2, (body,)),),
        assets=(Asset(3, (body,), labeled[:1]),) if version >= (4, 1) else (),
        force_plates=analog if version >= (2, 9) else (),
        devices=analog if version >= (2, 11) else (),
        mid_exposure=10**6 + number * 80_000,
        transmitted=10**6 + number * 80_000 + 5000,
    )


def server_info(version: natnet.Version) -> natnet.ServerInfo:
    """Return a server's answer to CONNECT."""
    connection = natnet.Connection(10_000_000, 1511, True, '239.255.42.99')
    return natnet.ServerInfo(
        'Motive', (3, 1, 0, 0), version, connection if version >= (3, 0) else None
    )


def model_definition() -> ModelDefinition:
    """Return the names of what `full_frame` holds."""
    body = RigidBodyDescription(
        'tool', 1, marker_positions=((0.0,) * 3,) * 3, marker_labels=(0, 0, 0),
        marker_names=('a', 'b', 'c'),
    )  # fmt: skip
    return ModelDefinition(
        (
            MarkerSetDescription('tool', ('a', 'b', 'c')),
            body,
            SkeletonDescription('hand', 2, (body._replace(name='bone'),)),
        )
    )


def natnet_seeds(version: natnet.Version | None = None) -> list[bytes]:
    """Return valid datagrams of every kind and of one version, or of all."""
    seeds = []
    for spoken in [version] if version else VERSIONS:
        messages: list[natnet.Message] = [
            full_frame(spoken),
            full_frame(spoken, 8, markers=1),
            Frame(9, 0.1, params=8),
            server_info(spoken),
            model_definition(),
        ]
        seeds += [natnet.encode_message(message, spoken) for message in messages]
    others: list[natnet.Message] = [
        natnet.Response(b'Bitstream,4.1\0'),
        natnet.Response(bytes(4)),
        natnet.MessageString('hello'),
        natnet.EchoResponse(1, 2),
        natnet.Notice(natnet.MessageId.UNRECOGNIZED_REQUEST),
        natnet.Notice(natnet.MessageId.DISCONNECT_BY_TIMEOUT),
    ]
    seeds += [natnet.encode_message(message, (4, 3)) for message in others]
    seeds.append(natnet.encode_connect_request('remaster_ros', (4, 1)))
    seeds.append(natnet.encode_command_request('Bitstream,4.1'))
    return seeds


def measurement() -> emscon.Measurement:
    """Return a result as an instrument sends it."""
    three = (1e-5, 2e-5, 3e-5)
    return emscon.Measurement(
        0, codes.STATIONARY, 0, (2.0, 0.5, -0.3), three, 4e-5, three, three, 4e-5, 20.0, 1013.0, 50
    )


def emscon_seeds() -> list[bytes]:
    """Return valid packets of every kind, in both directions."""
    values = {'s': b'text', 'd': 1.5, 'i': 1, 'I': 2}
    seeds = [
        emscon.encode(event)
        for event in (
            measurement(),
            emscon.ErrorReport(49, 10004),
            emscon.StatusChange(25),
            emscon.StatusChange(27),
            emscon.UnknownPacket(77, b'12345678'),
        )
    ]
    for command in codes.Command:
        for kind, layout in (('request', command.request), ('reply', command.reply)):
            zeros = layout.unpack(bytes(layout.size))
            filled = tuple(
                values['s']
                if isinstance(v, bytes)
                else values['d' if isinstance(v, float) else 'i']
                for v in zeros
            )
            event: emscon.Event = (
                emscon.Request(command, filled)
                if kind == 'request'
                else emscon.Reply(command, 0, filled)
            )
            seeds.append(emscon.encode(event))
        seeds.append(emscon.encode(emscon.Reply(command, 10004)))
    return seeds


# Spoiling them


class Mutator:
    """Spoils valid messages: flips, cuts, counts, numbers that are none, splices, floods.

    Parameters
    ----------
    seeds
        Valid messages.
    rng
        Source of all randomness; inputs repeat with its seed.
    size_at
        Where the u16 (NatNet) or i32 (emScon) size of the message stands, as
        ``(struct format, offset, bytes it does not count)``: most spoilt messages get a size that
        fits, so that they come through to what lies behind it.
    """

    def __init__(
        self, seeds: Sequence[bytes], rng: random.Random, size_at: tuple[str, int, int]
    ) -> None:
        self._seeds, self._rng = seeds, rng
        self._format, self._offset, self._uncounted = size_at
        self._largest = 2 ** (8 * struct.calcsize(self._format)) // 2 - 1
        self._ways = (
            self._flip, self._flip, self._flip, self._integer, self._integer,
            self._real, self._real, self._cut, self._remove, self._insert, self._repeat,
            self._splice, self._noise,
        )  # fmt: skip

    def __call__(self) -> bytes:
        """Return the next spoilt message (now and then a valid one)."""
        rng = self._rng
        data = bytearray(rng.choice(self._seeds))
        chance = rng.random()
        if chance < 0.02:
            return bytes(data)
        if chance < 0.021:
            data *= rng.randrange(2, 2 + _LONGEST // max(len(data), 1))
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            data = rng.choice(self._ways)(data)
        del data[_LONGEST:]
        if rng.random() < 0.8:
            self._fit_size(data)
        return bytes(data)

    def _fit_size(self, data: bytearray) -> None:
        end = self._offset + struct.calcsize(self._format)
        if len(data) >= end:
            size = min(len(data) - self._uncounted, self._largest)
            if size >= 0:
                struct.pack_into(self._format, data, self._offset, size)

    def _at(self, data: bytearray, room: int = 0) -> int:
        return self._rng.randrange(max(len(data) - room, 0) + 1)

    def _flip(self, data: bytearray) -> bytearray:
        for _ in range(self._rng.choice((1, 1, 2, 8))):
            if data:
                data[self._rng.randrange(len(data))] ^= 1 << self._rng.randrange(8)
        return data

    def _integer(self, data: bytearray) -> bytearray:
        at = self._at(data, 4)
        if at + 4 <= len(data):
            struct.pack_into('<i', data, at, self._rng.choice(_INTEGERS))
        return data

    def _real(self, data: bytearray) -> bytearray:
        kind = self._rng.choice('ffd')
        size = struct.calcsize(kind)
        at = self._at(data, size)
        if at + size <= len(data):
            struct.pack_into(f'<{kind}', data, at, self._rng.choice(_REALS))
        return data

    def _cut(self, data: bytearray) -> bytearray:
        del data[self._at(data) :]
        return data

    def _remove(self, data: bytearray) -> bytearray:
        at = self._at(data)
        del data[at : at + self._rng.choice((1, 2, 4, 12, 26, 38))]
        return data

    def _insert(self, data: bytearray) -> bytearray:
        at = self._at(data)
        data[at:at] = self._rng.randbytes(self._rng.choice((1, 2, 4, 12, 26, 38)))
        return data

    def _repeat(self, data: bytearray) -> bytearray:
        at, to = sorted((self._at(data), self._at(data)))
        data[to:to] = data[at : min(to, at + 300)]
        return data

    def _splice(self, data: bytearray) -> bytearray:
        other = self._rng.choice(self._seeds)
        return data[: self._at(data)] + other[self._rng.randrange(len(other) + 1) :]

    def _noise(self, data: bytearray) -> bytearray:
        at = self._at(data)
        size = min(len(data) - at, self._rng.choice((4, 16, 64)))
        data[at : at + size] = self._rng.randbytes(size)
        return data


def natnet_mutator(
    rng: random.Random, version: natnet.Version, more: Iterable[bytes] = ()
) -> Mutator:
    """Return a source of spoilt datagrams, every second one of `version`.

    `more` joins the valid ones.
    """
    seeds = natnet_seeds()
    own = natnet_seeds(version)
    return Mutator([*seeds, *own * (len(seeds) // len(own)), *more], rng, ('<H', 2, 4))


def emscon_mutator(rng: random.Random, more: Iterable[bytes] = ()) -> Mutator:
    """Return a source of spoilt packets; `more` joins the valid ones."""
    seeds = emscon_seeds()
    # Every third is a result, which is what reaches a reading.
    results = [emscon.encode(measurement())] * (len(seeds) // 2)
    return Mutator([*seeds, *results, *more], rng, ('<i', 0, 0))


# What they are thrown at


def decode_as_any_version(rng: random.Random) -> Target:
    """Return the bare decoders, for a server's and a client's messages."""

    def target(data: bytes) -> None:
        with contextlib.suppress(natnet.ProtocolError):
            natnet.decode_message(data, rng.choice(VERSIONS), markers_only=rng.random() < 0.5)
        with contextlib.suppress(natnet.ProtocolError):
            natnet.decode_request(data)

    return target


class DatagramSource:
    """A socket that has received what the fuzzer made."""

    def __init__(self) -> None:
        self.waiting: deque[tuple[bytes, tuple[str, int]]] = deque()

    def recvfrom(self, size: int) -> tuple[bytes, tuple[str, int]]:
        if not self.waiting:
            raise BlockingIOError
        data, address = self.waiting.popleft()
        return data[:size], address


class NatNetClientTarget:
    """The client's thread without its sockets: receive, decode, order, find, hand on, report.

    What comes out is looked at: a reading is finite and of the marker that is followed, every
    datagram is accounted for, and status and diagnosis can always be told.
    """

    SERVER, STRANGER = '127.0.0.1', '127.0.0.9'

    def __init__(self, rng: random.Random, version: natnet.Version) -> None:
        self._rng, self._version = rng, version
        self._lone = rng.random() < 0.2
        self.client = NatNetClient(
            NatNetSettings(marker=MarkerChoice(lone_marker=self._lone)), self._look
        )
        self.client._status.server_ip = self.SERVER
        self.client._command = None
        self.client._lock.source = (self.SERVER, 1510)
        self.client._data = self._data = DatagramSource()  # type: ignore[assignment]
        self._answers = DatagramSource()
        self.samples = self.strangers = self._number = self._fed = 0
        self._wrong: object = None

    def _look(self, sample: MarkerSample) -> None:
        self.samples += 1
        if not (sample.position.shape == (3,) and np.all(np.abs(sample.position) <= FARTHEST_M)):
            self._wrong = sample

    def __call__(self, data: bytes) -> None:
        """Receive one datagram; every so often the server introduces itself again."""
        if self._fed % 100 == 0:
            for message in (server_info(self._version), model_definition()):
                self._receive(natnet.encode_message(message, self._version), self._answers)
        if self._fed % 10 == 0:
            self._number += 1
            frame = full_frame(
                self._version, self._number, 1 if self._lone else 4, stray=not self._lone
            )
            self._receive(natnet.encode_message(frame, self._version), self._data)
        self._fed += 1
        stranger = self._rng.random() < 0.01
        is_frame = data[:2] == b'\x07\0'
        source = self._data if is_frame != (self._rng.random() < 0.02) else self._answers
        self._receive(data, source, self.STRANGER if stranger else self.SERVER)
        self.strangers += stranger
        if self._fed % 100 == 0:
            self._check()

    def _receive(self, data: bytes, source: DatagramSource, address: str = SERVER) -> None:
        source.waiting.append((data, (address, 1510)))
        self.client._receive(source)  # type: ignore[arg-type]
        while self.client._backlog:
            self.client._digest_backlog()

    def _check(self) -> None:
        status = self.client.status()
        diagnosis = self.client.diagnosis()
        if self._wrong is not None:
            raise FuzzError(f'not a reading: {self._wrong}')
        if status.accepted != self.samples or status.frames < status.accepted:
            raise FuzzError(f'{status.accepted} accepted, {self.samples} handed on')
        if status.dropped[Dropped.FOREIGN] != self.strangers:
            raise FuzzError(f'{self.strangers} foreign datagrams, counted: {status.dropped}')
        if self.client._backlog_bytes:
            raise FuzzError(f'{self.client._backlog_bytes} bytes of an empty backlog')
        if len(diagnosis.message) > 5000:
            raise FuzzError(f'a diagnosis of {len(diagnosis.message)} characters')


@contextlib.contextmanager
def silent_natnet_client() -> Iterable[None]:  # type: ignore[misc]
    """Keep the client from asking the operating system whether a port is closed."""
    real, marker_follower.port_is_closed = marker_follower.port_is_closed, lambda *_: False
    try:
        yield
    finally:
        marker_follower.port_is_closed = real


def read_from_both_sides(rng: random.Random) -> Target:
    """Return the packet readers of both sides, fed in pieces."""

    def target(data: bytes) -> None:
        for side in ('client', 'server'):
            reader = emscon.PacketReader(side)  # type: ignore[arg-type]
            cut = rng.randrange(len(data) + 1)
            for piece in (data[:cut], data[cut:], b''):
                reader.receive_data(piece)
                _read_all(reader)
            if len(reader.trailing_data) > max(len(data), emscon.MAX_PACKET_SIZE):
                raise FuzzError('the reader keeps more than it was given')

    return target


def _read_all(reader: emscon.PacketReader) -> None:
    while not reader.broken:
        try:
            event = reader.next_event()
        except emscon.ProtocolError:
            continue
        if event is emscon.NEED_DATA or isinstance(event, emscon.ConnectionClosed):
            return


class _Instrument:
    """A socket to an instrument that answers a command with whatever the fuzzer made."""

    def __init__(self, deliver: Callable[[], None]) -> None:
        self._deliver = deliver

    def sendall(self, data: bytes) -> None:
        self._deliver()

    def shutdown(self, how: int) -> None:
        pass

    def close(self) -> None:
        pass


class TrackerClientTarget:
    """The tracker's client without its socket: a command, its hostile answer, what it makes of it.

    Every call ends in a finite reading or a `LaserTrackerError`, nothing else.
    """

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        # No waiting: what has not come with the command never comes.
        never = LaserTrackerSettings(reply_timeout_s=1e-9)
        self.client = LaserTrackerClient('127.0.0.1', 700, settings=never)
        self.readings = self.errors = 0

    def __call__(self, data: bytes) -> None:
        """Let one packet arrive, in two pieces, after a valid reply to the command."""
        rng, link = self._rng, self.client._link
        reader = emscon.PacketReader('client')
        command = rng.choice((self._measure, self._measure, self.client.request_status))
        expected = (
            emscon.Reply(codes.Command.START_MEASUREMENT)
            if command == self._measure
            else emscon.Reply(codes.Command.GET_TRACKER_STATUS, 0, (rng.randrange(4),))
        )
        first = emscon.encode(expected) if rng.random() < 0.7 else b''
        cut = rng.randrange(len(data) + 1)

        def deliver() -> None:
            for piece in (first + data[:cut], data[cut:]):
                reader.receive_data(piece)
                if reason := link._drain(reader):
                    link._lose(reason)
                    return

        link._socket, link._lost = _Instrument(deliver), ''  # type: ignore[assignment]
        self.client._settings_checked = True
        try:
            command()
        except LaserTrackerError as error:
            self.errors += 1
            if '\n' in str(error):
                raise FuzzError(f'more than one line: {error}') from error
        if len(link._inbox) > 100:
            raise FuzzError('the inbox grows')

    def _measure(self) -> None:
        reading = self.client.measure(timeout_s=0.0)
        self.readings += 1
        if not np.all(np.abs([*reading.position, *reading.std]) <= FARTHEST_M):
            raise FuzzError(f'not a reading: {reading}')


# Running


@dataclasses.dataclass
class Outcome:
    """What a run of a fuzzer found.

    Attributes
    ----------
    inputs, longest_s
        How many, and the processor time of the slowest.
    grown_mb
        Resident memory at the end less that after a tenth of the inputs.
    """

    inputs: int
    longest_s: float
    grown_mb: float


def resident_mb() -> float:
    """Return the resident memory of this process."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * 4096 / 1e6


def run(make: Callable[[], bytes], targets: Sequence[Target], inputs: int) -> Outcome:
    """Throw `inputs` spoilt messages at every target.

    Raises
    ------
    FuzzError
        One of them raised, or took longer than `TIME_LIMIT_S` of processor time; the text holds
        the input in hexadecimal digits.
    """
    longest, begun = 0.0, resident_mb()
    for number in range(inputs):
        data = make()
        before = time.thread_time()
        try:
            for target in targets:
                target(data)
        except Exception as error:
            raise FuzzError(f'{type(error).__name__}: {error}; input {data.hex()}') from error
        took = time.thread_time() - before
        if took > longest:
            longest = took
            if took > TIME_LIMIT_S:
                raise FuzzError(f'{took:.3f} s of processor time; input {data.hex()}')
        if number == inputs // 10:
            begun = resident_mb()
    return Outcome(inputs, longest, resident_mb() - begun)
