# SPDX-License-Identifier: Apache-2.0
"""Fake OptiTrack server: NatNet over real UDP sockets, with the hidden world.

The command channel answers at once in wall time, and clients are dropped by wall time, as both
concern the network; frames come at `rate_hz` in world time.
"""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.sensors.optitrack import natnet
from remaster_ros.sensors.optitrack.natnet import (
    HAS_MODEL,
    MEASURED,
    MODEL_FILLED,
    OCCLUDED,
    TRACKING_VALID,
    UNLABELED,
    ClientRequest,
    Frame,
    LabeledMarker,
    MarkerSetDescription,
    Message,
    MessageId,
    ModelDefinition,
    ProtocolError,
    RigidBody,
    RigidBodyDescription,
    Vec3,
    Version,
    require_supported,
)
from remaster_ros.sensors.optitrack.settings import open_socket, require_group
from remaster_ros.simulation.faults import Numbers
from remaster_ros.simulation.world import World
from remaster_ros.types import FloatArray

JUMP_M = 0.5
_GARBAGE_BYTES = 300


class FrameFaults:
    """Faults of the frames that are sent."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._frozen: tuple[LabeledMarker, ...] | None = None
        self._late: deque[Frame] = deque()
        self._previous: Frame | None = None
        self._begins_at: Frame | None = None

    def spoil(self, frame: Frame, faults: Numbers) -> Iterator[Frame | bytes]:
        """Yield the frames or raw bytes that are sent in place of a frame, which may be none.

        ``faults``: as in `faults.OF_OPTITRACK`. Frames are kept for later calls by 'late',
        'reordered', 'frozen' and 'renumbered'.
        """
        if 'frozen' not in faults:
            self._frozen = None
        elif self._frozen is None:
            self._frozen = frame.labeled_markers
        else:
            frame = replace(frame, labeled_markers=self._frozen)
        if 'renumbered' not in faults:
            self._begins_at = None
        else:
            first = self._begins_at = self._begins_at or frame
            frame = replace(
                frame,
                number=frame.number - first.number,
                timestamp=frame.timestamp - first.timestamp,
            )
        if 'jumping' in faults and frame.number % 4 == 0:
            markers = tuple(
                LabeledMarker(m.id, (x + JUMP_M, y, z), m.size, m.params, m.residual)
                for m in frame.labeled_markers
                for x, y, z in [m.position]
            )
            frame = replace(frame, labeled_markers=markers)
        if 'stopped' in faults or 'off' in faults or frame.number % faults.get('slow', 1):
            return
        if 'garbage' in faults:
            yield self._rng.bytes(_GARBAGE_BYTES)
        elif 'late' in faults:
            self._late.append(frame)
            while self._late and frame.timestamp - self._late[0].timestamp >= faults['late']:
                yield self._late.popleft()
        elif 'reordered' in faults:
            if self._previous is None:
                self._previous = frame
            else:
                yield frame
                yield self._previous
                self._previous = None
        else:
            yield frame
            if 'duplicate' in faults:
                yield frame


CLOCK_HZ = 10_000_000
"""Ticks per second of the server's fine clock, as on usual Windows hosts."""

_MARKER_SIZE_M = 0.0127
_RESIDUAL_M = 2e-4
_FIRST_STRAY_ID = 50_001
_FLAGS_BEFORE_3 = OCCLUDED | MEASURED | MODEL_FILLED
_HIDDEN = (
    OCCLUDED | HAS_MODEL,
    OCCLUDED | MODEL_FILLED | HAS_MODEL,
    MODEL_FILLED | HAS_MODEL,
)
"""Flags of a marker that no camera sees: at the last position, or at the model's guess."""


@dataclass(frozen=True)
class OptiTrackBehaviour:
    """Settings of the fake camera bar; the defaults are an OptiTrack Trio."""

    # Rigid body of the tool. Its member 1 is the calibration marker.
    rigid_body: str = 'tool'
    body_id: int = 1
    # Further markers of the world's sensor, by name, with their numbers in the body
    further: Mapping[str, int] = field(default_factory=dict)
    # Members 2, 3, … if there are no further markers: offsets from the calibration marker along
    # the sensor's axes, m. These members move with the marker and do not turn with the tool: no
    # program here uses the body's rotation.
    companions: tuple[Vec3, ...] = ((0.06, 0.0, 0.0), (0.0, 0.05, 0.0), (0.04, 0.03, 0.02))
    # Reflections at fixed places in the sensor frame, m
    strays: tuple[Vec3, ...] = ((0.8, -0.5, 2.4), (-0.7, 0.4, 2.9))
    # Standard deviation of a position across the line of sight (sensor x, y) and along it (z)
    noise_across_m: float = 25e-6
    noise_along_m: float = 100e-6
    # Rate at which one of the followed markers is hidden, and mean duration (exponential
    # distributions), in world time
    occlusions_per_s: float = 0.0
    occlusion_s: float = 0.3
    # Standard deviation per axis of the model's guess at a hidden marker
    guess_error_m: float = 2e-3


class OptiTrackScene:
    """Frames of data of a fake camera bar.

    ``sensor``: the bar's name in the world.
    """

    def __init__(
        self,
        world: World,
        sensor: str,
        rng: np.random.Generator,
        behaviour: OptiTrackBehaviour,
    ) -> None:
        self._world = world
        self._sensor = sensor
        self._rng = rng
        self._behaviour = behaviour
        self._start_s = world.now()
        self._further = behaviour.further
        first = world.marker_in_sensor(sensor, self._start_s)
        further = [
            world.marker_in_sensor(sensor, self._start_s, name) - first for name in self._further
        ]
        self._offsets = np.array([(0.0, 0.0, 0.0), *(further or behaviour.companions)])
        self._strays = np.reshape(np.array(behaviour.strays, dtype=float), (-1, 3))
        members = [1, *(self._further.values() or range(2, len(self._offsets) + 1))]
        stray_labels = range(_FIRST_STRAY_ID, _FIRST_STRAY_ID + len(self._strays))
        self._labels = (*(behaviour.body_id << 16 | m for m in members), *stray_labels)
        across, along = behaviour.noise_across_m, behaviour.noise_along_m
        self._noise = np.array([across, across, along])
        self._occlusion = (self._start_s, self._start_s)
        self._plan_occlusion(self._start_s)
        self._hidden_params: int | None = None
        # Index of the followed marker that is hidden, if not all are.
        self._hidden_place = 0
        self._guess_error = np.zeros(3)
        self._last_seen = np.zeros_like(self._offsets)

    @property
    def model(self) -> ModelDefinition:
        """Rigid body, with marker positions about their mean, m, and its marker sets."""
        behaviour = self._behaviour
        names = tuple(f'{behaviour.rigid_body}_{i + 1}' for i in range(len(self._offsets)))
        body = RigidBodyDescription(
            name=behaviour.rigid_body,
            id=behaviour.body_id,
            marker_positions=_tuples(self._offsets - self._offsets.mean(axis=0)),
            marker_labels=(0,) * len(self._offsets),
            marker_names=names,
        )
        return ModelDefinition(
            (
                MarkerSetDescription(behaviour.rigid_body, names),
                MarkerSetDescription('all', names),
                body,
            )
        )

    def frame(self, number: int, version: Version, t: float | None = None) -> Frame:
        """Frame of the world now, or sent at time t, s.

        ``number``: of the frame; ``version``: bitstream of the server: NatNet 2 has fewer flags
        and no residual. With a camera's timing it shows the world before it is sent.
        """
        behaviour, size = self._behaviour, len(self._offsets)
        sent_s = self._world.now() if t is None else t
        timing = self._world.camera(self._sensor)
        t = sent_s if timing is None else sent_s - timing.late_s
        tracked = self._world.line_of_sight(self._sensor, t)
        hidden_params = self._hidden(t, tracked)
        points = self._rng.standard_normal((len(self._labels), 3))
        points *= self._noise
        points[size:] += self._strays
        seen = points[:size]
        truth = self._offsets + self._world.marker_in_sensor(self._sensor, t)
        for place, name in enumerate(self._further, 1):
            truth[place] = self._world.marker_in_sensor(self._sensor, t, name)
        seen += truth
        params = [MEASURED | HAS_MODEL] * size + [MEASURED | UNLABELED] * len(self._strays)
        if hidden_params is not None:
            hidden = [self._hidden_place] if tracked else list(range(size))
            guessed = bool(hidden_params & MODEL_FILLED)
            seen[hidden] = (truth + self._guess_error if guessed else self._last_seen)[hidden]
            for place in hidden:
                params[place] = hidden_params
        faults = self._world.faults(self._sensor)
        if 'hidden' in faults:
            place = self._label_index(faults['hidden'])
            seen[place], params[place] = self._last_seen[place], OCCLUDED | HAS_MODEL
        if 'exchanged' in faults:
            pair = [0, self._label_index(faults['exchanged'])]
            seen[pair] = seen[pair[::-1]]
        self._last_seen = seen

        old = version < (3, 0)
        if old:
            params = [flags & _FLAGS_BEFORE_3 for flags in params]
        residual = None if old else _RESIDUAL_M
        positions = _tuples(points)
        tool, strays = positions[:size], positions[size:]
        labeled = tuple(
            LabeledMarker(label, position, _MARKER_SIZE_M, flags, residual)
            for label, position, flags in zip(self._labels, positions, params, strict=True)
        )
        body = RigidBody(
            behaviour.body_id,
            tuple((seen.sum(axis=0) / size).tolist()),  # type: ignore[arg-type]
            (0.0, 0.0, 0.0, 1.0),
            _RESIDUAL_M,
            TRACKING_VALID if tracked else 0,
            tuple((p, i, _MARKER_SIZE_M) for i, p in enumerate(tool, 1)) if old else (),
        )
        stamped_s = sent_s if timing is None else sent_s - timing.latency_s
        ticks = self.ticks(stamped_s)
        return Frame(
            number=number,
            timestamp=self._by_its_clock(stamped_s),
            labeled_markers=labeled,
            rigid_bodies=(body,),
            marker_sets=((behaviour.rigid_body, tool), ('all', tool)),
            other_markers=strays,
            data_received=ticks,
            transmitted=self.ticks(self._world.now()),
        )

    def ticks(self, t: float) -> int:
        """Server's fine clock at world time t, s; it began 1000 s earlier, as on a real host."""
        return round((self._by_its_clock(t) + 1000.0) * CLOCK_HZ)

    def _by_its_clock(self, t: float) -> float:
        """Time since the start by the server's clock, s, at world time t."""
        timing = self._world.camera(self._sensor)
        return (t - self._start_s) * (1.0 if timing is None else 1.0 + timing.drift)

    def _hidden(self, t: float, tracked: bool) -> int | None:
        """Flags of the hidden marker at world time t, s; None while all are visible.

        ``tracked``: whether the line of sight is free. Occlusions are planned here, and their
        flags and guessed errors drawn.
        """
        start, end = self._occlusion
        if t >= end:
            self._plan_occlusion(end)
            start, end = self._occlusion
        faults = self._world.faults(self._sensor)
        if 'filled' in faults:
            self._hidden_params = MODEL_FILLED | HAS_MODEL
        elif 'occluded' in faults:
            self._hidden_params = OCCLUDED | HAS_MODEL
        elif tracked and not start <= t < end:
            self._hidden_params = None
        elif self._hidden_params is None:
            self._hidden_params = int(self._rng.choice(_HIDDEN))
            if self._further:
                self._hidden_place = int(self._rng.integers(len(self._offsets)))
            self._guess_error = self._rng.normal(0.0, self._behaviour.guess_error_m, 3)
        return self._hidden_params

    def _label_index(self, number: float) -> int:
        """Index among the labels of the marker with this number in the body.

        Raises ValueError if there is none.
        """
        return self._labels.index(self._behaviour.body_id << 16 | int(number))

    def _plan_occlusion(self, after_s: float) -> None:
        """Draw start and end of the next occlusion after a time, s; never if the rate is 0."""
        rate = self._behaviour.occlusions_per_s
        if rate <= 0:
            self._occlusion = (math.inf, math.inf)
            return
        start = after_s + self._rng.exponential(1.0 / rate)
        self._occlusion = (start, start + self._rng.exponential(self._behaviour.occlusion_s))


def _tuples(points: FloatArray) -> tuple[Vec3, ...]:
    """Points (n, 3) as plain tuples."""
    return tuple(map(tuple, points.tolist()))


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
        """Send a frame or raw bytes to the group, or to each client in the client's version."""
        if self._data is not None:
            self._send(frame, self._group, self._version, self._data)
            return
        with self._lock:
            receivers = [(address, c.version) for address, c in self._clients.items()]
        for (host, port), version in receivers:
            self._send(frame, (host, self._unicast_port or port), version)

    def _serve(self) -> None:
        """Answer the command channel until stopped; datagrams that are no requests are ignored."""
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
        """Execute a request; most have one answer, some have none.

        Unknown ones are answered by UNRECOGNIZED_REQUEST.
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
        """Register a unicast client with the wanted bitstream or else the server's own.

        Beyond `MAX_CLIENTS`, the client seen longest ago is removed. Nothing in multicast.
        """
        if self._transport != 'unicast':
            return
        version = wanted if wanted and self._can_stream(wanted) else self._version
        with self._lock:
            self._clients[address] = _Client(time.monotonic(), version)
            while len(self._clients) > MAX_CLIENTS:
                self._clients.pop(min(self._clients, key=lambda a: self._clients[a].last_seen_s))

    def _server_info(self) -> natnet.ServerInfo:
        """Answer to CONNECT with the versions of this server, and its connection from 3.0 on."""
        group, data_port = self._group
        connection = natnet.Connection(CLOCK_HZ, data_port, self._data is not None, group)
        return natnet.ServerInfo(
            'Fake OptiTrack of remaster_ros',
            _APP_VERSIONS[self._version[0]],
            self._version,
            connection if self._version >= (3, 0) else None,
        )

    def _obey(self, command: str, address: Address) -> Message:
        """Answer to a REQUEST: the frame rate, or the bitstream, which an argument sets.

        Refused if the client is unknown or cannot have that version; unrecognized for other
        commands.
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
        """Whether a client gets this bitstream on request.

        Servers from 4.0 on stream any from 3.0 to their own.
        """
        return self._version >= (4, 0) and (3, 0) <= wanted <= self._version

    def _version_of(self, address: Address) -> Version:
        """Bitstream version of a client; the server's own if the client is unknown."""
        with self._lock:
            client = self._clients.get(address)
        return client.version if client is not None else self._version

    def _forget_silent_clients(self) -> None:
        """Remove clients silent for `client_timeout_s`, and notify each.

        None is removed with a `unicast_port`.
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
        """Send a message in a bitstream version, or raw bytes; network failures are ignored."""
        # A network that is down loses datagrams, as everywhere; the server goes on.
        sender = through or self._command
        assert sender is not None
        raw = message if isinstance(message, bytes) else natnet.encode_message(message, version)
        with contextlib.suppress(OSError):
            sender.sendto(raw, address)
