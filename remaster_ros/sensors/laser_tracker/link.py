"""The TCP connection to a laser tracker: one command at a time, a thread that reads."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from remaster_ros.errors import DeviceError
from remaster_ros.sensors.laser_tracker.protocol.codes import Command, Status, describe_status
from remaster_ros.sensors.laser_tracker.protocol.packets import (
    NEED_DATA,
    ConnectionClosed,
    ErrorReport,
    Event,
    Measurement,
    PacketReader,
    ProtocolError,
    Reply,
    Request,
    StatusChange,
    UnknownPacket,
    Value,
    encode,
)

_LEAST_WALL_S = 2.0
"""Simulated time may run many times as fast as the wall clock; networks do not."""
_POLL_S = 0.02
_HANG_UP_S = 1.0


class LaserTrackerError(DeviceError):
    """A laser tracker failed; the text names it, the command, the code in words, a remedy.

    Attributes
    ----------
    status
        Result status of the instrument (a `Status` or a number unknown to us); None where it
        did not answer or the connection is at fault.
    """

    def __init__(self, text: str, status: int | None = None) -> None:
        super().__init__(text)
        self.status = status


@dataclass(frozen=True)
class _Exchange:
    """A command and the wait for its answer."""

    command: Command
    what: str
    timeout_s: float
    is_late: Callable[[], bool]


class TrackerLink:
    """Sends commands over TCP and waits for what belongs to them.

    The protocol has no sequence numbers: a reply that comes too late cannot be distinguished
    from that to the next command. The connection is therefore closed where a reply is missing.

    Parameters
    ----------
    host, port
        Address of the instrument.
    on_change
        Called by the reading thread with the number of each status change.
    now
        Clock of the time-outs, s; may run faster than the wall clock.

    Attributes
    ----------
    counts
        How often each thing happened: ``connections``, ``bad_packets``, ``unknown_packets``,
        ``unexpected_packets`` (no command was waiting for them).
    """

    def __init__(
        self,
        host: str,
        port: int,
        on_change: Callable[[int], None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = f'laser tracker {host}:{port}'
        self.counts: Counter[str] = Counter()
        self._address = (host, port)
        self._on_change = on_change
        self._now = now
        self._socket: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._one_at_a_time = threading.Lock()
        self._news = threading.Condition()
        # Guarded by _news:
        self._asking = ''
        self._inbox: deque[Reply | ErrorReport | Measurement] = deque(maxlen=100)
        self._lost = 'not connected'
        # Of the reading thread alone:
        self._last_report: int = Status.ALL_OK

    @property
    def connected(self) -> bool:
        """Whether the connection stands, as far as this end can determine."""
        return not self._lost

    def count(self, what: str, times: int = 1) -> None:
        """Add to `counts`, from any thread."""
        with self._news:
            self.counts[what] += times

    def open(self, timeout_s: float) -> None:
        """Connect, within `timeout_s` of wall time; nothing happens where already connected.

        Raises
        ------
        LaserTrackerError
            If the instrument cannot be reached.
        """
        if self.connected:
            return
        self.close()
        host, port = self._address
        try:
            connection = socket.create_connection(self._address, timeout_s)
        except ConnectionRefusedError as error:
            raise LaserTrackerError(
                f'{self.name}: connection refused: nothing listens on port {port}; '
                'check the address and that the controller is switched on'
            ) from error
        except TimeoutError as error:
            raise LaserTrackerError(
                f'{self.name}: no answer within {timeout_s:g} s; '
                'check the cable, the address and the power of the controller'
            ) from error
        except OSError as error:
            raise LaserTrackerError(
                f'{self.name}: cannot connect ({error}); check the address {host!r}'
            ) from error
        connection.settimeout(None)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket, self._lost = connection, ''
        self.count('connections')
        self._thread = threading.Thread(
            target=self._read, args=(connection,), name=self.name, daemon=True
        )
        self._thread.start()

    def close(self, reason: str = 'closed by this program') -> None:
        """Close the connection; a command that waits for its reply fails with the reason."""
        self._lose(reason)
        with self._news:
            connection, self._socket = self._socket, None
            thread, self._thread = self._thread, None
        if connection is not None and thread is not None:
            # Shutting down wakes the reading thread, closing alone does not.
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            thread.join()
            connection.close()

    def ask(
        self, command: Command, *values: Value, timeout_s: float, what: str = ''
    ) -> tuple[Value, ...]:
        """Send a command and return the values of its reply.

        Parameters
        ----------
        timeout_s
            On the injected clock, s, but never less than 2 s of wall time.
        what
            The command in words, for messages.

        Raises
        ------
        LaserTrackerError
            If the instrument refuses, is busy, does not answer or is not connected.
        """
        what = what or command.name.replace('_', ' ').lower()
        with self._exchange_of(command, what, timeout_s) as exchange:
            return self._reply(exchange, values)

    def measure(self, timeout_s: float) -> tuple[Measurement, float]:
        """Measure once; return the result and the time in the middle of the integration, s.

        Raises
        ------
        LaserTrackerError
            As `ask` does.
        """
        with self._exchange_of(Command.START_MEASUREMENT, 'measurement', timeout_s) as exchange:
            self._reply(exchange, ())
            started = self._now()
            while True:
                event = self._next(exchange)
                if isinstance(event, Measurement):
                    self._check(event.status, exchange.what)
                    return event, 0.5 * (started + self._now())
                self._set_aside(event, exchange)

    @contextlib.contextmanager
    def _exchange_of(self, command: Command, what: str, timeout_s: float) -> Iterator[_Exchange]:
        """Hold the instrument for one command and what it sends in answer."""
        if not self._one_at_a_time.acquire(blocking=False):
            raise LaserTrackerError(
                f'{self.name}: busy with the {self._asking or "last command"} when asked for '
                f'the {what}; wait until that is done',
                Status.SERVER_BUSY,
            )
        try:
            with self._news:
                self._asking = what
            yield _Exchange(command, what, timeout_s, self._deadline(timeout_s))
        finally:
            with self._news:
                self._asking = ''
                self.count('unexpected_packets', len(self._inbox))
                self._inbox.clear()
            self._one_at_a_time.release()

    def _reply(self, exchange: _Exchange, values: tuple[Value, ...]) -> tuple[Value, ...]:
        connection = self._socket
        if connection is None or self._lost:
            raise self._lost_error(exchange.what)
        try:
            connection.sendall(encode(Request(exchange.command, values)))
        except OSError as error:
            # The reading thread may have what the instrument reported before it closed.
            if (thread := self._thread) is not None:
                thread.join(_HANG_UP_S)
            self._lose(f'connection lost ({error})')
            raise self._lost_error(exchange.what) from error
        while True:
            event = self._next(exchange)
            if isinstance(event, Reply) and event.command is exchange.command:
                self._check(event.status, exchange.what)
                return event.values
            self._set_aside(event, exchange)

    def _next(self, exchange: _Exchange) -> Reply | ErrorReport | Measurement:
        """Wait for the next packet that may belong to the exchange."""
        with self._news:
            while not self._inbox:
                if self._lost:
                    raise self._lost_error(exchange.what)
                if exchange.is_late():
                    break
                self._news.wait(_POLL_S)
            else:
                return self._inbox.popleft()
        raise self._late_error(exchange)

    def _set_aside(self, event: Reply | ErrorReport | Measurement, exchange: _Exchange) -> None:
        """Drop and count a packet that the exchange has no use for; raise if it is its error."""
        if isinstance(event, ErrorReport) and event.command in (exchange.command, Command.UNKNOWN):
            self._check(event.status or Status.NO_STATIONARY_RESULT, exchange.what)
        self.count('unexpected_packets')
        # An instrument that sends without end would otherwise block this thread for ever.
        if exchange.is_late():
            raise self._late_error(exchange)

    def _late_error(self, exchange: _Exchange) -> LaserTrackerError:
        self.close(f'no answer to the {exchange.what}')
        return LaserTrackerError(
            f'{self.name}: no answer to the {exchange.what} within {exchange.timeout_s:g} s, '
            'connection closed; check the cable and the controller, then connect again'
        )

    def _deadline(self, timeout_s: float) -> Callable[[], bool]:
        end, wall_end = self._now() + timeout_s, time.monotonic() + min(timeout_s, _LEAST_WALL_S)
        return lambda: self._now() >= end and time.monotonic() >= wall_end

    def _check(self, status: int, what: str) -> None:
        if status != Status.ALL_OK:
            raise LaserTrackerError(
                f'{self.name}: {what} failed: {describe_status(status)}', status
            )

    def _lost_error(self, what: str) -> LaserTrackerError:
        return LaserTrackerError(f'{self.name}: {what} impossible: {self._lost}; connect again')

    def _lose(self, reason: str) -> None:
        with self._news:
            self._lost = self._lost or reason
            self._news.notify_all()

    def _read(self, connection: socket.socket) -> None:
        """Read until the connection ends; the body of the thread."""
        reader = PacketReader('client')
        self._last_report = Status.ALL_OK
        reason = ''
        while not reason:
            try:
                reader.receive_data(connection.recv(4096))
                reason = self._drain(reader)
            except OSError as error:
                reason = f'connection lost ({error})'
        if self._last_report != Status.ALL_OK:
            reason += f' after it reported {describe_status(self._last_report)}'
        self._lose(reason)

    def _drain(self, reader: PacketReader) -> str:
        """Handle every complete packet; return why the connection ended, or ''."""
        while True:
            try:
                event = reader.next_event()
            except ProtocolError as error:
                self.count('bad_packets')
                if reader.broken:
                    return f'it sent what is not emScon ({error})'
                continue
            if event is NEED_DATA:
                return ''
            if isinstance(event, ConnectionClosed):
                return 'the instrument closed the connection'
            self._deliver(event)

    def _deliver(self, event: Event) -> None:
        if isinstance(event, StatusChange):
            self._on_change(event.change)
        elif isinstance(event, UnknownPacket):
            self.count('unknown_packets')
        elif isinstance(event, Reply | ErrorReport | Measurement):
            if isinstance(event, ErrorReport) and event.command == Command.UNKNOWN:
                self._last_report = event.status
            with self._news:
                if self._asking:
                    self._inbox.append(event)
                    self._news.notify_all()
                else:
                    self.count('unexpected_packets')
