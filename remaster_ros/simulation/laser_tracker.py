"""A fake laser tracker: the emScon protocol on a TCP port, with the world behind it."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from remaster_ros.errors import DeviceError
from remaster_ros.sensors.laser_tracker.protocol.packets import (
    NEED_DATA,
    Command,
    ConnectionClosed,
    ErrorReport,
    Event,
    PacketReader,
    ProtocolError,
    Request,
    Status,
    encode,
)
from remaster_ros.simulation.faults import Numbers
from remaster_ros.simulation.laser_tracker_instrument import TrackerInstrument
from remaster_ros.simulation.laser_tracker_settings import TrackerBehaviour
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from remaster_ros.simulation.world import World

_POLL_WALL_S = 0.005
"""How often the instrument goes on in time; this sets its latency, not its results."""


class FakeLaserTracker:
    """A laser tracker that listens on a TCP port and runs in world time.

    As with the real one, a single client at a time; a second one is refused with an error report.
    The instrument is switched on when it is made; a client that leaves ends what it had begun.

    Parameters
    ----------
    world
        The hidden world.
    sensor
        The tracker's name in the world.
    rng
        Source of all randomness.
    host, port
        Address to listen on; port 0 takes a free one, see `address`.
    behaviour
        See `TrackerBehaviour`.
    aim
        Where it points at first, in its own frame, m, (3,); None: at the reflector.
    further
        Further reflectors of the tool by name, with their numbers.
    """

    def __init__(
        self,
        world: World,
        sensor: str,
        rng: np.random.Generator,
        *,
        host: str = '127.0.0.1',
        port: int = 0,
        behaviour: TrackerBehaviour | None = None,
        aim: FloatArray | None = None,
        further: Mapping[str, int] | None = None,
    ) -> None:
        self._world, self._further = world, further
        self._sensor, self._rng = sensor, rng
        self._behaviour, self._restarted, self._lost_s = behaviour, False, 0.0
        self._looked_at = world.now()
        self._instrument = TrackerInstrument(
            world, sensor, rng, self._looked_at, behaviour, aim, further
        )
        self._wanted = (host, port)
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._reader = PacketReader('server')
        self._cut_after: int | None = None

    def __enter__(self) -> FakeLaserTracker:
        """Start."""
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Close."""
        self.close()

    @property
    def address(self) -> tuple[str, int]:
        """Host and port it listens on."""
        if self._listener is None:
            raise RuntimeError('the fake laser tracker has not been started')
        return self._listener.getsockname()[:2]

    @property
    def locked(self) -> bool:
        """Whether the beam is on the reflector."""
        return self._instrument.locked

    def start(self) -> None:
        """Listen, and serve in a thread of its own.

        Raises
        ------
        DeviceError
            If the port cannot be used.
        """
        host, port = self._wanted
        try:
            self._listener = socket.create_server((host, port), backlog=4)
        except OSError as error:
            raise DeviceError(
                f'fake laser tracker: cannot listen on {host}:{port} ({error.strerror}); '
                'choose another port'
            ) from error
        self._listener.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._serve, name='fake laser tracker', daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Switch off: stop the thread, close every socket."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._listener is not None:
            self._selector.close()
            self._listener.close()
            self._listener = None

    def break_beam(self) -> None:
        """Interrupt the beam, as a person who walks through it does."""
        with self._lock:
            self._send(self._instrument.break_beam())

    def cut_next_packet(self, after_bytes: int) -> None:
        """Send only the first bytes of the next packet, then close the connection."""
        with self._lock:
            self._cut_after = after_bytes

    def _serve(self) -> None:
        while not self._closing.is_set():
            ready = [key.fileobj for key, _ in self._selector.select(_POLL_WALL_S)]
            began_s = self._world.now()
            with self._lock:
                faults = self._world.faults(self._sensor)
                self._apply(faults)
                if 'stuck' not in faults:
                    self._send(self._instrument.step(self._instrument_time(faults)))
                # The client first: one that has left makes room for a new one.
                if self._client in ready and 'stuck' not in faults:
                    self._receive()
                if self._listener in ready:
                    self._accept()
            self._world.kept_up(self._sensor, began_s)
        self._drop_client()

    def _instrument_time(self, faults: Numbers) -> float:
        """World time, which passes slowly for an instrument that is slow."""
        now = self._world.now()
        passed, self._looked_at = now - self._looked_at, now
        self._lost_s += passed * (1.0 - 1.0 / faults.get('slow', 1.0))
        return now - self._lost_s

    def _apply(self, faults: Numbers) -> None:
        """Apply the injected faults that concern the connection and the power."""
        if 'off' in faults:
            self._drop_client()
        if 'renumbered' in faults and not self._restarted:
            self._drop_client()
            time_s = self._world.now() - self._lost_s
            self._instrument = TrackerInstrument(
                self._world,
                self._sensor,
                self._rng,
                time_s,
                self._behaviour,
                further=self._further,
            )
        self._restarted = 'renumbered' in faults
        if 'cut' in faults:
            self._cut_after = int(faults['cut'])
        if 'garbage' in faults and self._client is not None:
            with contextlib.suppress(OSError):
                self._client.sendall(self._rng.bytes(64))

    def _accept(self) -> None:
        assert self._listener is not None
        try:
            client, _ = self._listener.accept()
        except OSError:
            # The client has already closed the connection.
            return
        if 'off' in self._world.faults(self._sensor):
            client.close()
            return
        if self._client is not None:
            refusal = ErrorReport(Command.UNKNOWN, Status.MULTI_CONNECTIONS_NOT_ALLOWED)
            with client, contextlib.suppress(OSError):
                client.sendall(encode(refusal))
            return
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # A client that does not read may not stop the instrument.
        client.settimeout(1.0)
        self._client, self._reader = client, PacketReader('server')
        self._selector.register(client, selectors.EVENT_READ)
        self._send(self._instrument.greeting())

    def _receive(self) -> None:
        assert self._client is not None
        try:
            self._reader.receive_data(self._client.recv(4096))
        except OSError:
            self._drop_client()
            return
        while self._client is not None:
            try:
                event = self._reader.next_event()
            except ProtocolError:
                self._send([ErrorReport(Command.UNKNOWN, Status.INVALID_INPUT_DATA)])
                if self._reader.broken:
                    self._drop_client()
                continue
            if event is NEED_DATA:
                return
            if isinstance(event, Request):
                self._send(self._instrument.handle(event))
            elif isinstance(event, ConnectionClosed):
                self._drop_client()
            else:
                self._send([ErrorReport(Command.UNKNOWN, Status.NOT_IMPLEMENTED)])

    def _send(self, events: Iterable[Event]) -> None:
        for event in events:
            if self._client is None:
                return
            packet = encode(event)
            cut, self._cut_after = self._cut_after, None
            try:
                self._client.sendall(packet if cut is None else packet[:cut])
            except OSError:
                self._drop_client()
            if cut is not None:
                self._drop_client()

    def _drop_client(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            self._selector.unregister(client)
            client.close()
            self._instrument.abort()
