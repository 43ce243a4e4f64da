# SPDX-License-Identifier: Apache-2.0
"""Fake OptiTrack server: NatNet over real UDP sockets, with the hidden world.

The command channel answers at once in wall time, and clients are dropped by wall time, as both
concern the network; frames come at `rate_hz` in world time.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.sensors.optitrack import natnet
from remaster_ros.sensors.optitrack.natnet import ClientRequest, Message, MessageId
from remaster_ros.sensors.optitrack.natnet_bytes import (
    ProtocolError,
    Version,
    require_supported,
)
from remaster_ros.sensors.optitrack.natnet_frame import (
    Frame,
)
from remaster_ros.sensors.optitrack.settings import open_socket, require_group
from remaster_ros.simulation.optitrack_scene import (
    CLOCK_HZ,
    FrameFaults,
    OptiTrackBehaviour,
    OptiTrackScene,
)
from remaster_ros.simulation.world import World

MAX_CLIENTS = 16
PAUSED_S = 2.0
"""Delay from which a bar was paused, s: the World is ahead of a busy bar by less."""
_POLL_WALL_S = 0.1
_REFUSED = natnet.Response(b'\x01\0\0\0')
_UNRECOGNIZED = natnet.Notice(MessageId.UNRECOGNIZED_REQUEST)
_APP_VERSIONS = {2: (1, 10, 0, 0), 3: (2, 2, 0, 0), 4: (3, 1, 0, 0)}
"""The Motive that streams each major version of NatNet."""
Address = tuple[str, int]


@dataclass
class _Client:
    """Unicast client: wall time of its last datagram, and its bitstream."""

    last_seen_s: float
    version: Version


class FakeOptiTrackServer:
    """OptiTrack server that streams the calibration marker of a world.

    ``sensor``: the bar's name in the world; ``version``: bitstream, such as ``(2, 10)`` or ``(4,
    1)``; ``multicast`` streams to the group, ``unicast`` to every client that sends CONNECT;
    ``rate_hz``: in world time; ``host``: address of the served interface; `command_port`: 0 for a
    free one; ``unicast_port``: port of a client for unicast frames instead of the client's sending
    port; such a client is never dropped: old clients such as ``natnetclient`` listen there and
    send nothing more. Any other client that is silent for ``client_timeout_s`` (wall time) is
    dropped.
    """

    def __init__(
        self,
        world: World,
        sensor: str,
        rng: np.random.Generator,
        *,
        version: Version = (3, 1),
        transport: Literal['multicast', 'unicast'] = 'multicast',
        rate_hz: float = 30.0,
        host: str = '127.0.0.1',
        command_port: int = natnet.DEFAULT_COMMAND_PORT,
        multicast_group: str = natnet.DEFAULT_MULTICAST_GROUP,
        data_port: int = natnet.DEFAULT_DATA_PORT,
        unicast_port: int | None = None,
        client_timeout_s: float = 5.0,
        behaviour: OptiTrackBehaviour | None = None,
    ) -> None:
        try:
            require_supported(version)
        except ProtocolError as error:
            raise InputError(f'version: {error}') from error
        if transport not in ('multicast', 'unicast'):
            raise InputError(f'transport: {transport!r} is neither multicast nor unicast')
        if not rate_hz > 0:
            raise InputError(f'rate_hz: {rate_hz} is not above 0')
        require_group(multicast_group)
        self._world = world
        self._version = version
        self._transport = transport
        self._rate_hz = rate_hz
        self._host = host
        self._wanted_port = command_port
        self._group = (multicast_group, data_port)
        self._unicast_port = unicast_port
        self._client_timeout_s = client_timeout_s
        self._sensor, self._spoiler = sensor, FrameFaults(rng)
        self._scene = OptiTrackScene(world, sensor, rng, behaviour or OptiTrackBehaviour())
        self._command: socket.socket | None = None
        self._data: socket.socket | None = None
        self._clients: dict[Address, _Client] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []
        self._latest: Frame | None = None

    @property
    def command_port(self) -> int:
        """Port that answers CONNECT, once started (AssertionError before)."""
        assert self._command is not None, 'not started'
        return self._command.getsockname()[1]

    @property
    def clients(self) -> tuple[Address, ...]:
        """Addresses of the unicast clients; () in multicast."""
        with self._lock:
            return tuple(self._clients)

    def start(self) -> None:
        """Open the sockets and begin to stream.

        Raises DeviceError if the command port is in use or the host is no address of this machine.
        """
        self._command = open_socket(
            self._host,
            self._wanted_port,
            purpose='command port of the fake OptiTrack server',
            remedy='set command_port to a free one',
        )
        self._command.settimeout(_POLL_WALL_S)
        if self._transport == 'multicast':
            self._data = open_socket(
                self._host, 0, purpose='fake OptiTrack data', remedy='correct host'
            )
            interface = socket.inet_aton(self._host)
            self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, interface)
            self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        self._closing.clear()
        for work in (self._serve, self._stream):
            thread = threading.Thread(target=work, name=f'optitrack{work.__name__}', daemon=True)
            thread.start()
            self._threads.append(thread)

    def stop(self) -> None:
        """End the threads and close the sockets; may be repeated."""
        self._closing.set()
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        for opened in (self._command, self._data):
            if opened is not None:
                opened.close()
        self._command = self._data = None
        self._clients.clear()

    def __enter__(self) -> FakeOptiTrackServer:
        """Start."""
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop."""
        self.stop()

    def _stream(self) -> None:
        """Send frames at the rate in world time until stopped, each of the world at its time.

        After a pause of over 2 s (`PAUSED_S`) the missed frames are not sent.
        """
        start_s = self._world.now()
        number = 0
        while not self._closing.is_set():
            # The World waits for this bar; after a pause the bar does not send the missed frames.
            latest = int((self._world.now() - start_s - PAUSED_S) * self._rate_hz)
            number = max(number + 1, latest)
            due_s = start_s + number / self._rate_hz
            # Before the wait: time that stood until this frame is sent would never get there.
            self._world.kept_up(self._sensor, due_s)
            self._world.sleep_until(due_s)
            self._latest = frame = self._scene.frame(number, self._version, due_s)
            for message in self._spoiler.spoil(frame, self._world.faults(self._sensor)):
                self._distribute(message)

    def _distribute(self, frame: Frame | bytes) -> None:
        """Send a frame or raw bytes to the multicast group, or to each unicast client.

        To each client in its own bitstream version.
        """
        if self._data is not None:
            self._send(frame, self._group, self._version, self._data)
            return
        with self._lock:
            receivers = [(address, c.version) for address, c in self._clients.items()]
        for (host, port), version in receivers:
            self._send(frame, (host, self._unicast_port or port), version)

    def _serve(self) -> None:
        """Answer requests on the command port, and forget silent clients, until stopped.

        Datagrams that are no requests are ignored; with the fault 'off' all are.
        """
        assert self._command is not None
        while not self._closing.is_set():
            self._forget_silent_clients()
            try:
                datagram, address = self._command.recvfrom(1 << 16)
                request = natnet.decode_request(datagram)
            except (OSError, ProtocolError):
                continue
            if 'off' in self._world.faults(self._sensor):
                continue
            with self._lock:
                if address in self._clients:
                    self._clients[address].last_seen_s = time.monotonic()
            for answer in self._answers(request, address):
                self._send(answer, address, self._version_of(address))

    def _answers(self, request: ClientRequest, address: Address) -> list[Message]:
        """Carry out a client's request and return its answers: one of most, none of some.

        An unknown request is answered by UNRECOGNIZED_REQUEST.
        """
        if request.id == MessageId.CONNECT:
            self._welcome(address, request.wanted_version)
            return [self._server_info()]
        if request.id == MessageId.REQUEST:
            return [self._obey(request.text, address)]
        if request.id == MessageId.REQUEST_MODELDEF:
            return [self._scene.model]
        if request.id == MessageId.REQUEST_FRAMEOFDATA:
            return [self._latest] if self._latest is not None else [_UNRECOGNIZED]
        if request.id == MessageId.ECHOREQUEST:
            ticks = self._scene.ticks(self._world.now())
            return [natnet.EchoResponse(request.clock, ticks)]
        if request.id == MessageId.DISCONNECT:
            with self._lock:
                self._clients.pop(address, None)
            return []
        return [] if request.id == MessageId.KEEPALIVE else [_UNRECOGNIZED]

    def _welcome(self, address: Address, wanted: Version | None) -> None:
        """Register a unicast client, with the wanted bitstream version if it can be streamed.

        Else with the server's own. Beyond `MAX_CLIENTS`, the client that was silent longest is
        removed. Nothing in multicast.
        """
        if self._transport != 'unicast':
            return
        version = wanted if wanted and self._can_stream(wanted) else self._version
        with self._lock:
            self._clients[address] = _Client(time.monotonic(), version)
            while len(self._clients) > MAX_CLIENTS:
                self._clients.pop(min(self._clients, key=lambda a: self._clients[a].last_seen_s))

    def _server_info(self) -> natnet.ServerInfo:
        """Answer to CONNECT: versions of this server, and from 3.0 on its clock and data port."""
        group, data_port = self._group
        connection = natnet.Connection(CLOCK_HZ, data_port, self._data is not None, group)
        return natnet.ServerInfo(
            'Fake OptiTrack of remaster_ros',
            _APP_VERSIONS[self._version[0]],
            self._version,
            connection if self._version >= (3, 0) else None,
        )

    def _obey(self, command: str, address: Address) -> Message:
        """Answer to the text of a REQUEST: 'FrameRate', or 'Bitstream' with or without argument.

        'Bitstream,VERSION' sets the client's version first. It is refused if the client is
        unknown or cannot have that version. Any other text is unrecognized.
        """
        name, _, argument = command.partition(',')
        if name == 'FrameRate':
            return natnet.Response(np.float32(self._rate_hz).tobytes())
        if name != 'Bitstream':
            return _UNRECOGNIZED
        if argument:
            with contextlib.suppress(ValueError), self._lock:
                wanted = natnet.parse_version(argument)
                if address in self._clients and self._can_stream(wanted):
                    self._clients[address].version = wanted
                    argument = ''
            if argument:
                return _REFUSED
        version = natnet.format_version(self._version_of(address))
        return natnet.Response(f'Bitstream,{version}\0'.encode())

    def _can_stream(self, wanted: Version) -> bool:
        """Whether a client gets this bitstream version if it asks for it.

        Servers from 4.0 on stream any from 3.0 to their own; older ones refuse every request.
        """
        return self._version >= (4, 0) and (3, 0) <= wanted <= self._version

    def _version_of(self, address: Address) -> Version:
        """Bitstream version of a client; the server's own if the client is unknown."""
        with self._lock:
            client = self._clients.get(address)
        return client.version if client is not None else self._version

    def _forget_silent_clients(self) -> None:
        """Remove clients that were silent for over `client_timeout_s`, wall time, and notify each.

        With a `unicast_port` none is removed.
        """
        if self._unicast_port is not None:
            return
        oldest = time.monotonic() - self._client_timeout_s
        with self._lock:
            silent = [address for address, c in self._clients.items() if c.last_seen_s < oldest]
            for address in silent:
                del self._clients[address]
        for address in silent:
            notice = natnet.Notice(MessageId.DISCONNECT_BY_TIMEOUT)
            self._send(notice, address, self._version)

    def _send(
        self,
        message: Message | bytes,
        address: Address,
        version: Version,
        through: socket.socket | None = None,
    ) -> None:
        """Send a message in a bitstream version, or raw bytes; network failures are ignored.

        ``through``: socket; None for that of the command port.
        """
        # A network that is down loses datagrams, as everywhere; the server goes on.
        sender = through or self._command
        assert sender is not None
        raw = message if isinstance(message, bytes) else natnet.encode_message(message, version)
        with contextlib.suppress(OSError):
            sender.sendto(raw, address)
