# SPDX-License-Identifier: Apache-2.0
"""Client of a laser tracker by emScon: lock the reflector, measure it at standstill.

A tracker follows the reflector with its beam. When the beam breaks the tracker has to find the
reflector again, by a spiral search about its present direction
(`LaserTrackerClient.find_reflector`) or about given coordinates
(`LaserTrackerClient.go_position`). Its absolute distance meter (ADM) refuses a target that moves.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.errors import DeviceError, InputError
from remaster_ros.parameters import check_all, parameter
from remaster_ros.sensors.laser_tracker import packets
from remaster_ros.sensors.laser_tracker.packets import (
    NEED_DATA,
    Change,
    Command,
    ConnectionClosed,
    ErrorReport,
    Event,
    Measurement,
    PacketReader,
    ProtocolError,
    Readiness,
    Reply,
    Request,
    Status,
    StatusChange,
    UnknownPacket,
    Value,
    describe_status,
    encode,
)
from remaster_ros.types import FARTHEST_M, FloatArray, MarkerReading

_UNITS = (
    packets.METRE,
    packets.RADIAN,
    packets.CELSIUS,
    packets.MILLIBAR,
    packets.RELATIVE_HUMIDITY,
)
SET_FOR_READINGS: tuple[tuple[Command, Command, tuple[Value, ...], str], ...] = (
    (Command.SET_UNITS, Command.GET_UNITS, _UNITS, 'units (metre, radian, °C, mbar)'),
    (
        Command.SET_COORDINATE_SYSTEM_TYPE,
        Command.GET_COORDINATE_SYSTEM_TYPE,
        (packets.RIGHT_HANDED_CARTESIAN,),
        'coordinate system (right-handed Cartesian)',
    ),
    (
        Command.SET_MEASUREMENT_MODE,
        Command.GET_MEASUREMENT_MODE,
        (packets.STATIONARY,),
        'measurement mode (stationary)',
    ),
)
"""Settings that a reading depends on: command to set each, command to read it back, values, and
their name in words."""
CHANGES_OF_READINGS = (Change.UNITS, Change.COORDINATE_SYSTEM_TYPE, Change.MEASUREMENT_MODE)
"""Status changes after which these settings are read back."""


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


_LEAST_WALL_S = 2.0
"""Shortest time-out in wall time, s: simulated time may be much faster, networks are not."""
_POLL_S = 0.02
_HANG_UP_S = 1.0


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
    """Command and the wait for its answer."""

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
        """Send a command; the values of its reply are returned, in the order of its layout.

        ``timeout_s``: by the injected clock, s, but at least 2 s of wall time (or itself, if
        shorter); ``what``: the command in words, for messages. Raises LaserTrackerError if the
        instrument refuses, is busy, does not answer (the connection is closed then) or is not
        connected.
        """
        what = what or command.name.replace('_', ' ').lower()
        with self._exchange_of(command, what, timeout_s) as exchange:
            return self._reply(exchange, values)

    def measure(self, timeout_s: float) -> tuple[Measurement, float]:
        """Measure once: result, and this computer's time midway between start and result, s.

        ``timeout_s``: until the result, s of the link's clock.

        Raises LaserTrackerError as `ask`.
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
        """Next packet that may belong to the exchange, waited for.

        Raises LaserTrackerError if the connection is lost, or the exchange late (it is closed
        then).
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
        """Count and drop a packet that does not belong to the exchange.

        Raises LaserTrackerError if it is the exchange's error report, or the exchange is late.
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
        """Function that is true once a time-out is over, by the injected clock and in wall time.

        ``timeout_s``: s from now; of wall time at most `_LEAST_WALL_S` of it are required.
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


_SLEW_S = 15.0
"""Time-out of a turn to a position, s: half a turn of a slow head."""
_RETRY_S = 0.5
_WARM_UP_RETRY_S = 2.0

_STATUS_OF_CHANGE: dict[int, TrackerStatus] = {
    Change.NOT_READY: TrackerStatus.NOT_READY,
    Change.BUSY: TrackerStatus.BUSY,
    Change.READY: TrackerStatus.READY,
}
_STATUS_OF_READINESS: dict[Value, TrackerStatus] = {
    Readiness.NOT_READY: TrackerStatus.NOT_READY,
    Readiness.BUSY: TrackerStatus.BUSY,
    Readiness.READY: TrackerStatus.READY,
}


class LaserTrackerClient:
    """Client of a laser tracker with emScon over TCP.

    Every method raises `LaserTrackerError` (a `DeviceError`) if the instrument refuses, is busy,
    cannot be reached or does not answer; its `status` distinguishes a refusal from a lost
    connection. One command is executed at a time: a second one, from another thread, is refused as
    busy. After a lost connection `connect` and `initialise` begin again.

    ``host, port``: address of the instrument; emScon listens on 700; ``now, sleep``: clock and
    waiting, s; simulated ones if time runs faster. A time-out also needs two seconds of wall time
    (or its own length, if shorter) to pass.
    """

    def __init__(
        self,
        host: str,
        port: int = 700,
        *,
        settings: LaserTrackerSettings | None = None,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.settings = settings or LaserTrackerSettings()
        self._now, self._sleep = now, sleep
        self._link = TrackerLink(host, port, self._changed, now)
        self._status = TrackerStatus.NOT_READY
        self._settings_checked = False
        self._distance_m: float | None = None

    def __enter__(self) -> LaserTrackerClient:
        """Connect and initialise."""
        self.connect()
        try:
            self.initialise()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the connection."""
        self.close()

    @property
    def name(self) -> str:
        """Name of the instrument in messages."""
        return self._link.name

    @property
    def connected(self) -> bool:
        """Whether the connection is open, as far as this end can determine."""
        return self._link.connected

    @property
    def status(self) -> TrackerStatus:
        """Last reported status of the instrument; `request_status` updates it."""
        return self._status if self.connected else TrackerStatus.DISCONNECTED

    @property
    def counts(self) -> Counter[str]:
        """Numbers of events, a copy.

        ``connections``, ``measurements``, ``measurements_failed``, ``searches``,
        ``searches_failed``, ``beam_breaks`` (losses of a locked reflector), ``bad_packets``,
        ``unknown_packets``, ``unexpected_packets``.
        """
        return self._link.counts.copy()

    def connect(self) -> None:
        """Open the connection, unless it is open, and request the status."""
        self._settings_checked = False
        self._link.open(self.settings.connect_timeout_s)
        try:
            self.request_status()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the connection; a command of another thread fails; again does nothing."""
        self._link.close()

    def request_status(self) -> TrackerStatus:
        """Status of the instrument, requested now; an unknown number counts as not ready."""
        (readiness,) = self._ask(Command.GET_TRACKER_STATUS, what='status')
        # A number that is no `Readiness` must not permit a measurement.
        self._status = _STATUS_OF_READINESS.get(readiness, TrackerStatus.NOT_READY)
        return self._status

    def initialise(self) -> None:
        """Initialise the instrument unless it is, and set everything that a reading depends on.

        Waits for the end of the warm-up. An instrument that is initialised already keeps its lock.
        """
        processor = self._ask(Command.GET_SYSTEM_STATUS, what='system status')[1]
        if processor != packets.TRACKER_INITIALIZED:
            self._initialise()
        s = self.settings
        for command, _, values, _ in SET_FOR_READINGS:
            self._ask(command, *values)
        self._ask(Command.SET_STATIONARY_MODE, round(s.integration_s * 1e3), True)
        self._ask(
            Command.SET_STATISTIC_MODE, packets.STANDARD_STATISTICS, packets.STANDARD_STATISTICS
        )
        self._set_search()
        self._check_settings()
        self.request_status()

    def set_search_radius(self, radius_m: float) -> None:
        """Set the radius of a search (m) about the given position or the present direction."""
        self.settings = replace(self.settings, search_radius_m=radius_m)
        self._set_search()

    def _set_search(self) -> None:
        """Send radius and time-out of a search to the instrument."""
        s = self.settings
        self._ask(Command.SET_SEARCH, s.search_radius_m, round(s.search_timeout_s * 1e3))

    def find_reflector(self) -> None:
        """Search in the present direction, at the last measured distance or 3 m, and lock.

        The radius is `search_radius_m`. It counts as a failed search if none is found.
        """
        distance = self._distance_m or 3.0
        self._search(Command.FIND_REFLECTOR, distance, what='search for the reflector')

    def go_position(self, position: ArrayLike) -> None:
        """Turn to a position in the tracker's frame (m, (3,)), search there and lock.

        Raises InputError too, if it is not three finite numbers.
        """
        target = self._point(position)
        self._distance_m = float(np.linalg.norm(target))
        self._search(Command.GO_POSITION, *target.tolist(), True, what='search at a position')

    def ensure_locked(
        self, expected_position: ArrayLike | None = None, *, attempts: int = 3
    ) -> int:
        """Lock the reflector if the beam is broken.

        The number of searches is returned, 0 if it was locked.

        A busy instrument is waited for. Each attempt goes to the expected position, or, without
        one, searches in the present direction. The locked reflector may be any within the search
        radius: compare the reading with the expectation. ``expected_position``: in the tracker's
        frame, m, (3,); ``attempts``: largest number of searches. Raises LaserTrackerError if the
        last search failed too (with its status), or the connection is lost (at once; without a
        status).
        """
        expected = None if expected_position is None else self._point(expected_position)
        failure: LaserTrackerError | None = None
        for attempt in range(attempts + 1):
            if self._wait_until_idle() is TrackerStatus.READY:
                return attempt
            if attempt < attempts:
                failure = self._try_search(expected)
        status = failure.status if failure else None
        status = Status.MEASUREMENT_STATUS_NOT_READY if status is None else status
        raise LaserTrackerError(
            f'{self.name}: no reflector locked in {attempts} searches: '
            f'{packets.describe_status(status)}',
            status,
        ) from failure

    def measure(self, timeout_s: float | None = None) -> MarkerReading:
        """Measure the locked reflector once; reading with the stamp midway of the measurement.

        ``timeout_s``: None for the integration time and two reply time-outs. Raises
        LaserTrackerError: `Status.MEASUREMENT_STATUS_NOT_READY` without a lock,
        `Status.SENSOR_NOT_STABLE` for a moving target, `Status.SERVER_BUSY`; or the result is not
        finite or beyond `FARTHEST_M`, or the settings were changed by another program.
        """
        if timeout_s is None:
            timeout_s = self.settings.integration_s + 2 * self.settings.reply_timeout_s
        try:
            result, stamp_s = self._link.measure(timeout_s)
            position, std = np.array(result.values), np.array(result.std)
            # Comparisons with NaN are false.
            if not (np.all(np.abs(position) <= FARTHEST_M) and np.all(np.abs(std) <= FARTHEST_M)):
                raise LaserTrackerError(
                    f'{self.name}: the result {result.values} ± {result.std} m is no place within '
                    f'{FARTHEST_M:g} m; measure again',
                    Status.NO_STATIONARY_RESULT,
                )
            # A change of units or frame during the measurement makes the numbers invalid.
            if not self._settings_checked:
                self._check_settings()
        except LaserTrackerError:
            self._link.count('measurements_failed')
            raise
        self._link.count('measurements')
        self._distance_m = float(np.linalg.norm(position))
        return MarkerReading(stamp_s, position, result.temperature)

    def _ask(
        self, command: Command, *values: Value, what: str = '', timeout_s: float | None = None
    ) -> tuple[Value, ...]:
        """Send a command as `TrackerLink.ask`; by default with `reply_timeout_s`."""
        timeout_s = self.settings.reply_timeout_s if timeout_s is None else timeout_s
        return self._link.ask(command, *values, timeout_s=timeout_s, what=what)

    def _initialise(self) -> None:
        """Initialise the instrument, again and again while its distance meter warms up.

        Raises LaserTrackerError after `initialise_timeout_s`, or at once for another reason.
        """
        end = self._now() + self.settings.initialise_timeout_s
        while True:
            remaining = end - self._now()
            try:
                self._ask(Command.INITIALIZE, what='initialisation', timeout_s=remaining)
                return
            except LaserTrackerError as error:
                if error.status != Status.ADM_START_UP_BUSY or remaining < _WARM_UP_RETRY_S:
                    raise
            self._sleep(_WARM_UP_RETRY_S)

    def _search(self, command: Command, *values: Value, what: str) -> None:
        """Send a command that searches for the reflector, and count it; counted again if it fails.

        ``what``: the command in words. In time: `_SLEW_S` + ``search_timeout_s`` +
        ``reply_timeout_s``.

        Raises LaserTrackerError if the instrument finds none in time.
        """
        s = self.settings
        self._link.count('searches')
        try:
            self._ask(
                command,
                *values,
                what=what,
                timeout_s=_SLEW_S + s.search_timeout_s + s.reply_timeout_s,
            )
        except LaserTrackerError:
            self._link.count('searches_failed')
            raise

    def _try_search(self, expected: FloatArray | None) -> LaserTrackerError | None:
        """Search once; the instrument's refusal is returned, a lost connection raised.

        At `expected`, m, (3,), or in the present direction for None; None if it found one. Waits
        `_RETRY_S` after a refusal.
        """
        try:
            if expected is None:
                self.find_reflector()
            else:
                self.go_position(expected)
        except LaserTrackerError as error:
            if error.status is None:
                raise
            self._sleep(_RETRY_S)
            return error
        return None

    def _wait_until_idle(self) -> TrackerStatus:
        """Status of the instrument once it is no longer busy.

        Raises LaserTrackerError if it is busy for longer than a turn, a search and a measurement
        take.
        """
        s = self.settings
        end = self._now() + _SLEW_S + s.search_timeout_s + s.integration_s
        while (status := self.request_status()) is TrackerStatus.BUSY:
            if self._now() > end:
                raise LaserTrackerError(
                    f'{self.name}: still {packets.describe_status(Status.SERVER_BUSY)}',
                    Status.SERVER_BUSY,
                )
            self._sleep(_RETRY_S)
        return status

    def _check_settings(self) -> None:
        """Read back the settings that a reading depends on.

        Raises LaserTrackerError if they differ.
        """
        # Set before the check: a change reported during the check makes it invalid.
        self._settings_checked = True
        for _, command, expected, words in SET_FOR_READINGS:
            if self._ask(command) != expected:
                self._settings_checked = False
                raise LaserTrackerError(
                    f'{self.name}: the {words} have been changed by another program; '
                    'close that program and initialise again',
                    Status.WRONG_PARAMETER,
                )

    def _changed(self, change: int) -> None:
        """Record a status change; called in the reading thread. Unknown changes are ignored."""
        if change in CHANGES_OF_READINGS:
            self._settings_checked = False
        status = _STATUS_OF_CHANGE.get(change)
        if status is None:
            return
        if self._status is TrackerStatus.READY and status is TrackerStatus.NOT_READY:
            self._link.count('beam_breaks')
        self._status = status

    def _point(self, position: ArrayLike) -> FloatArray:
        """Position as an array (3,); InputError if it is not three finite numbers."""
        try:
            point = np.asarray(position, float)
        except (TypeError, ValueError):
            point = np.empty(0)
        if point.shape != (3,) or not np.all(np.isfinite(point)):
            raise InputError(
                f'{self.name}: {position!r} is not a position of three finite numbers'
            )
        return point
