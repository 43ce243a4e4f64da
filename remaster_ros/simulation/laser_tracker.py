# SPDX-License-Identifier: Apache-2.0
"""Fake laser tracker: the emScon protocol on a TCP port, with the hidden world."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from collections.abc import Iterable, Mapping

import numpy as np

from remaster_ros.errors import DeviceError
from remaster_ros.sensors.laser_tracker.codes import Command, Status
from remaster_ros.sensors.laser_tracker.packets import (
    NEED_DATA,
    ConnectionClosed,
    ErrorReport,
    Event,
    PacketReader,
    ProtocolError,
    Request,
    encode,
)
from remaster_ros.simulation.faults import Numbers
from remaster_ros.simulation.laser_tracker_behaviour import TrackerBehaviour
from remaster_ros.simulation.laser_tracker_instrument import TrackerInstrument
from remaster_ros.simulation.world import World

_POLL_WALL_S = 0.005
"""Wall time between steps of the instrument, s; it determines the latency, not the results."""


class FakeLaserTracker:
    """Laser tracker that listens on a TCP port and runs in world time.

    As the real one, it serves a single client at a time and refuses a second one with an error
    report. The instrument is switched on when it is made; when a client disconnects its command
    ends. ``sensor``: name in the world; ``port``: 0 for a free one, see `address`; ``further``:
    further reflectors of the tool by name, with their numbers.
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
        further: Mapping[str, int] | None = None,
    ) -> None:
        self._world, self._further = world, further
        self._sensor, self._rng = sensor, rng
        self._behaviour, self._restarted, self._lost_s = behaviour, False, 0.0
        self._looked_at = world.now()
        self._instrument = TrackerInstrument(
            world, sensor, rng, self._looked_at, behaviour, further=further
        )
        self._wanted = (host, port)
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._reader = PacketReader('server')

    def __enter__(self) -> FakeLaserTracker:
        """Start."""
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Close."""
        self.close()

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the listening socket. Raises RuntimeError before `start`."""
        if self._listener is None:
            raise RuntimeError('the fake laser tracker has not been started')
        return self._listener.getsockname()[:2]

    @property
    def locked(self) -> bool:
        """Whether the beam is locked on a reflector."""
        return self._instrument.locked

    def start(self) -> None:
        """Listen, and serve in a thread; raises DeviceError if the port cannot be used."""
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
        """Switch off: stop the thread and close every socket; may be repeated."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._listener is not None:
            self._selector.close()
            self._listener.close()
            self._listener = None

    def break_beam(self) -> None:
        """Interrupt the beam, as a person who walks through it does, and tell the client."""
        with self._lock:
            self._send(self._instrument.break_beam())

    def _serve(self) -> None:
        """Serve one client at a time until `close`: faults, steps of the instrument, commands.

        With the fault 'stuck' the instrument stands still and commands wait.
        """
        while not self._closing.is_set():
            ready = [key.fileobj for key, _ in self._selector.select(_POLL_WALL_S)]
            began_s = self._world.now()
            with self._lock:
                faults = self._world.faults(self._sensor)
                self._apply(faults)
                if 'stuck' not in faults:
                    self._send(self._instrument.step(self._instrument_time(faults)))
                # The client is served first: a client that has disconnected makes room for a new
                # one.
                if self._client in ready and 'stuck' not in faults:
                    self._receive()
                if self._listener in ready:
                    self._accept()
            self._world.kept_up(self._sensor, began_s)
        self._drop_client()

    def _instrument_time(self, faults: Numbers) -> float:
        """World time of the instrument, s, which runs slower by the number of the fault ``slow``.

        What it lags behind the World remains after the fault has ended.
        """
        now = self._world.now()
        passed, self._looked_at = now - self._looked_at, now
        self._lost_s += passed * (1.0 - 1.0 / faults.get('slow', 1.0))
        return now - self._lost_s

    def _apply(self, faults: Numbers) -> None:
        """Apply the injected faults of the connection and the power.

        'off' drops the client, 'renumbered' drops it and switches the instrument off and on
        once, 'garbage' sends 64 random bytes.
        """
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
        if 'garbage' in faults and self._client is not None:
            with contextlib.suppress(OSError):
                self._client.sendall(self._rng.bytes(64))

    def _accept(self) -> None:
        """Accept a connection, and send the client the first packets of the instrument.

        A second client gets an error report and is closed; with the fault 'off' any is closed.
        """
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
        """Answer the client's received commands; drop the client if its stream is broken.

        A packet that cannot be read, or is no command, is answered by an error report.
        """
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
        """Send events to the client, if there is one.

        The client is dropped if sending fails, or after a packet shortened by the fault 'cut'.
        """
        for event in events:
            if self._client is None:
                return
            packet, cut = encode(event), self._world.faults(self._sensor).get('cut')
            try:
                self._client.sendall(packet if cut is None else packet[: int(cut)])
            except OSError:
                self._drop_client()
            if cut is not None:
                self._drop_client()

    def _drop_client(self) -> None:
        """Close the client's connection, if there is one, and abort the instrument's operation."""
        client, self._client = self._client, None
        if client is not None:
            self._selector.unregister(client)
            client.close()
            self._instrument.abort()
