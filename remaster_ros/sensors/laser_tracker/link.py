# SPDX-License-Identifier: Apache-2.0
"""Connection with a laser tracker by emScon: commands with their replies, and status changes."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np

from remaster_ros.errors import DeviceError, InputError
from remaster_ros.parameters import check_all, parameter
from remaster_ros.sensors.laser_tracker.codes import (
    Command,
    Status,
    describe_status,
)
from remaster_ros.sensors.laser_tracker.packets import (
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
"""Shortest time-out in wall time, s: simulated time may be much faster, networks are not."""
_POLL_S = 0.02
_HANG_UP_S = 1.0


class TrackerStatus(Enum):
    """Last reported status of the instrument."""

    DISCONNECTED = 'disconnected'
    NOT_READY = 'not ready'
    """The instrument warms up, is not initialised, or has no reflector locked."""
    BUSY = 'busy'
    READY = 'ready'
    """A reflector is locked; it can be measured."""


@dataclass(frozen=True)
class LaserTrackerSettings:
    """Settings of the instrument, and time-outs of the client.

    Settings made with `parameter` are parameters of the node as well.
    """

    search_radius_m: float = parameter(
        0.05,
        'how far about the expected place it searches, at the distance of the reflector',
        unit='m',
        low=1e-3,
        high=5.0,
    )
    search_timeout_s: float = parameter(20.0, 'longest search', unit='s', low=0.1, high=600.0)
    integration_s: float = parameter(
        1.0, 'averaging time of one measurement', unit='s', low=0.05, high=60.0
    )
    connect_timeout_s: float = 5.0  # TCP connection, in wall time
    reply_timeout_s: float = 5.0  # Command that only sets or reads something
    initialise_timeout_s: float = 300.0  # Initialisation with the wait for the warm-up

    def __post_init__(self) -> None:
        """Raises InputError, with the name of the setting, for a value out of range."""
        check_all('laser tracker', self)
        for name, value in vars(self).items():
            if name.endswith(('_s', '_m')) and not 0 < value < np.inf:
                raise InputError(f'laser tracker: {name} is {value}; it must be above 0')


class LaserTrackerError(DeviceError):
    """Failure of a laser tracker.

    The text has the instrument, the command, the code in words, a remedy.

    Attributes: ``status``: result status of the instrument (a `Status` or an unknown number); None
    if it did not answer or the connection failed.
    """

    def __init__(self, text: str, status: int | None = None) -> None:
        super().__init__(text)
        self.status = status


@dataclass(frozen=True)
class _Exchange:
    """Command under way, and the time-out of its answer."""

    command: Command
    what: str
    timeout_s: float
    is_late: Callable[[], bool]


class TrackerLink:
    """TCP connection to the instrument: sends commands and waits for their answers.

    The protocol has no sequence numbers: a late reply cannot be distinguished from that to the
    next command. The connection is therefore closed if a reply is missing.

    ``host, port``: address of the instrument; ``on_change``: called by the reading thread with the
    number of each status change; ``now``: clock of the time-outs, s; may run faster than the wall
    clock.

    Attributes: ``counts``: number of ``connections``, ``bad_packets``, ``unknown_packets``, and
    ``unexpected_packets`` (for which no command was waiting).
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
        # Fields guarded by _news:
        self._asking = ''
        self._inbox: deque[Reply | ErrorReport | Measurement] = deque(maxlen=100)
        self._lost = 'not connected'
        # Fields of the reading thread only:
        self._last_report: int = Status.ALL_OK

    @property
    def connected(self) -> bool:
        """Whether the connection is open, as far as this end can determine."""
        return not self._lost

    def count(self, what: str, times: int = 1) -> None:
        """Add to a number in `counts`, from any thread.

        ``what``: its name; a new one begins at 0.
        """
        with self._news:
            self.counts[what] += times

    def open(self, timeout_s: float) -> None:
        """Connect within `timeout_s` of wall time, unless connected, and start the reading thread.

        Raises LaserTrackerError, without a status, if the instrument cannot be reached.
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
        """Close the connection, and wait for the reading thread; again does nothing.

        A command that waits for its reply fails with the reason.
        """
        self._lose(reason)
        with self._news:
            connection, self._socket = self._socket, None
            thread, self._thread = self._thread, None
        if connection is not None and thread is not None:
            # Shutting the socket down wakes the reading thread; closing it does not.
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            thread.join()
            connection.close()

    def ask(
        self, command: Command, *values: Value, timeout_s: float, what: str = ''
    ) -> tuple[Value, ...]:
        """Send a command; return the values of its reply, in the order of its layout.

        ``timeout_s``: by the injected clock, s, but at least 2 s of wall time (or itself, if
        shorter); ``what``: the command in words, for messages. Raises LaserTrackerError if the
        instrument refuses, is busy, does not answer (the connection is closed then) or is not
        connected.
        """
        what = what or command.name.replace('_', ' ').lower()
        with self._exchange_of(command, what, timeout_s) as exchange:
            return self._reply(exchange, values)

    def measure(self, timeout_s: float) -> tuple[Measurement, float]:
        """Measure once; return the result, and the time midway from start to result, s.

        The time is this computer's, by the link's clock. ``timeout_s``: until the result, s of
        the link's clock.

        Raises LaserTrackerError as `ask`, also if the result has an error as its status.
        """
        with self._exchange_of(Command.START_MEASUREMENT, 'measurement', timeout_s) as exchange:
            self._reply(exchange, ())
            started = self._now()
            while True:
                event = self._next(exchange)
                if isinstance(event, Measurement):
                    self._check(event.status, exchange.what)
                    return event, 0.5 * (started + self._now())
                self._count_unexpected(event, exchange)

    @contextlib.contextmanager
    def _exchange_of(self, command: Command, what: str, timeout_s: float) -> Iterator[_Exchange]:
        """Context of one command and its answers, with the instrument reserved.

        ``what``: the command in words, for errors; ``timeout_s``: until its last answer, s of the
        link's clock.

        Raises LaserTrackerError (`Status.SERVER_BUSY`) if another command is under way. Packets
        that are left at the end are counted as unexpected.
        """
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
        """Send a command and return the values of its reply; other packets are counted.

        Raises LaserTrackerError if the instrument refuses, does not answer or is not connected.
        """
        connection = self._socket
        if connection is None or self._lost:
            raise self._lost_error(exchange.what)
        try:
            connection.sendall(encode(Request(exchange.command, values)))
        except OSError as error:
            # The reading thread may have received the reason before the instrument closed.
            if (thread := self._thread) is not None:
                thread.join(_HANG_UP_S)
            self._lose(f'connection lost ({error})')
            raise self._lost_error(exchange.what) from error
        while True:
            event = self._next(exchange)
            if isinstance(event, Reply) and event.command is exchange.command:
                self._check(event.status, exchange.what)
                return event.values
            self._count_unexpected(event, exchange)

    def _next(self, exchange: _Exchange) -> Reply | ErrorReport | Measurement:
        """Wait for the next packet that may belong to an exchange, and return it.

        Raises LaserTrackerError if the connection is lost, or the exchange's time is over
        without one (the connection is closed then).
        """
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

    def _count_unexpected(
        self, event: Reply | ErrorReport | Measurement, exchange: _Exchange
    ) -> None:
        """Count and drop a packet that is not the awaited answer of an exchange.

        Raises LaserTrackerError if it reports an error of the exchange's command or of an
        unknown one, or if the exchange's time-out is over (the connection is closed then).
        """
        if isinstance(event, ErrorReport) and event.command in (exchange.command, Command.UNKNOWN):
            self._check(event.status or Status.NO_STATIONARY_RESULT, exchange.what)
        self.count('unexpected_packets')
        # An instrument that never stops sending would otherwise block this thread for ever.
        if exchange.is_late():
            raise self._late_error(exchange)

    def _late_error(self, exchange: _Exchange) -> LaserTrackerError:
        """Close the connection, and return the error of a command without an answer."""
        self.close(f'no answer to the {exchange.what}')
        return LaserTrackerError(
            f'{self.name}: no answer to the {exchange.what} within {exchange.timeout_s:g} s, '
            'connection closed; check the cable and the controller, then connect again'
        )

    def _deadline(self, timeout_s: float) -> Callable[[], bool]:
        """Function that returns whether a time-out is over, by the link's clock and in wall time.

        ``timeout_s``: s from now by the link's (injected) clock. In wall time as much must
        have passed too, but no more than `_LEAST_WALL_S`.
        """
        end, wall_end = self._now() + timeout_s, time.monotonic() + min(timeout_s, _LEAST_WALL_S)
        return lambda: self._now() >= end and time.monotonic() >= wall_end

    def _check(self, status: int, what: str) -> None:
        """Raise LaserTrackerError with the status in words unless it is ALL_OK.

        ``what``: the command in words.
        """
        if status != Status.ALL_OK:
            raise LaserTrackerError(
                f'{self.name}: {what} failed: {describe_status(status)}', status
            )

    def _lost_error(self, what: str) -> LaserTrackerError:
        """Error of a command that a lost connection makes impossible, with the reason."""
        return LaserTrackerError(f'{self.name}: {what} impossible: {self._lost}; connect again')

    def _lose(self, reason: str) -> None:
        """Mark the connection as lost, and wake the waiting command; the first reason is kept."""
        with self._news:
            self._lost = self._lost or reason
            self._news.notify_all()

    def _read(self, connection: socket.socket) -> None:
        """Thread: read packets until the connection ends; mark it as lost, with the reason."""
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
        """Handle every complete packet; reason why the connection ended, or ''.

        It ends at the close by the instrument, or if the boundaries of packets are lost; other
        damaged packets are counted.
        """
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
        """Pass on a status change, or an answer to the waiting command; count other packets.

        An error report without a command is kept as the possible reason of a lost connection.
        """
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
