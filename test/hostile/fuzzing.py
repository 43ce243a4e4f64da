# SPDX-License-Identifier: Apache-2.0
"""Targets of hostile bytes: the decoders, and the clients as they stand behind a socket.

A target takes bytes and raises an error if something happens that must not. `run` feeds it, and
limits the processor time of every single input. Nothing here opens a socket. The bytes are from
`fuzz_messages`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import random
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from hostile.fuzz_messages import MODEL, VERSIONS, full_frame, server_info

from remaster_ros.sensors.laser_tracker import codes
from remaster_ros.sensors.laser_tracker import packets as emscon
from remaster_ros.sensors.laser_tracker.client import LaserTrackerClient
from remaster_ros.sensors.laser_tracker.link import LaserTrackerError, LaserTrackerSettings
from remaster_ros.sensors.optitrack import marker_follower, natnet, natnet_bytes
from remaster_ros.sensors.optitrack.client import NatNetClient
from remaster_ros.sensors.optitrack.frame_gate import Dropped, MarkerChoice, MarkerSample
from remaster_ros.sensors.optitrack.settings import NatNetSettings
from remaster_ros.types import FARTHEST_M

TIME_LIMIT_S = 0.25
"""Processor time that one input may take: fifty times what the longest valid datagram does."""

Target = Callable[[bytes], None]


class FuzzError(AssertionError):
    """A target did what it must not; the text holds the input."""


def decode_as_any_version(rng: random.Random) -> Target:
    """Return the bare decoders, for a server's and a client's messages."""

    def target(data: bytes) -> None:
        with contextlib.suppress(natnet_bytes.ProtocolError):
            natnet.decode_message(data, rng.choice(VERSIONS))
        with contextlib.suppress(natnet_bytes.ProtocolError):
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
    datagram is accounted for, and status and diagnosis can always be given.
    """

    SERVER, STRANGER = '127.0.0.1', '127.0.0.9'

    def __init__(self, rng: random.Random, version: natnet_bytes.Version) -> None:
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
            for message in (server_info(self._version), MODEL):
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
        if not np.all(np.abs(reading.position) <= FARTHEST_M):
            raise FuzzError(f'not a reading: {reading}')


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
