"""Client of a laser tracker by emScon: lock the reflector, measure it standing still.

A tracker follows the reflector with its beam. When the beam breaks it has to find the reflector
again, by searching a spiral about the place it points to (`LaserTrackerClient.find_reflector`) or
about given coordinates (`LaserTrackerClient.go_position`). Its absolute distance meter (ADM)
refuses a target that moves.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.errors import InputError
from remaster_ros.sensors.laser_tracker.link import LaserTrackerError, TrackerLink
from remaster_ros.sensors.laser_tracker.protocol import codes
from remaster_ros.sensors.laser_tracker.protocol.codes import Change, Command, Readiness, Status
from remaster_ros.sensors.laser_tracker.protocol.packets import Value
from remaster_ros.sensors.laser_tracker.settings import (
    CHANGES_OF_READINGS,
    SET_FOR_READINGS,
    LaserTrackerSettings,
    TrackerReading,
    TrackerStatus,
)
from remaster_ros.types import FARTHEST_M, FloatArray

_SLEW_S = 15.0
"""Time-out of turning to a position, s: half a turn of a slow head."""
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
    """A laser tracker behind emScon over TCP.

    Every method raises `LaserTrackerError` (a `DeviceError`) when the instrument refuses, is busy,
    cannot be reached or does not answer; its `status` distinguishes a refusal from a lost
    connection. One command is under way at a time: a second one, from another thread, is refused
    as busy. After a lost connection `connect` and `initialise` begin anew.

    Parameters
    ----------
    host, port
        Address of the instrument; emScon listens on 700.
    settings
        See `LaserTrackerSettings`.
    now, sleep
        Clock and waiting, s; give simulated ones where time runs faster. A time-out also needs two
        seconds of wall time (or its own length, if shorter) to pass.
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
        """The instrument as messages call it."""
        return self._link.name

    @property
    def connected(self) -> bool:
        """Whether the connection stands, as far as this end can determine."""
        return self._link.connected

    @property
    def status(self) -> TrackerStatus:
        """What the instrument last reported; `request_status` brings it up to date."""
        return self._status if self.connected else TrackerStatus.DISCONNECTED

    @property
    def counts(self) -> Counter[str]:
        """How often each thing happened, a copy.

        ``connections``, ``measurements``, ``measurements_failed``, ``searches``,
        ``searches_failed``, ``beam_breaks`` (it lost a locked reflector), ``bad_packets``,
        ``unknown_packets``, ``unexpected_packets``.
        """
        return self._link.counts.copy()

    def connect(self) -> None:
        """Open the connection; nothing happens where it is open."""
        self._settings_checked = False
        self._link.open(self.settings.connect_timeout_s)
        try:
            self.request_status()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the connection; a command under way in another thread fails."""
        self._link.close()

    def request_status(self) -> TrackerStatus:
        """Request the status of the instrument."""
        (readiness,) = self._ask(Command.GET_TRACKER_STATUS, what='status')
        # A number that is no `Readiness` must not permit a measurement.
        self._status = _STATUS_OF_READINESS.get(readiness, TrackerStatus.NOT_READY)
        return self._status

    def initialise(self, *, force: bool = False) -> None:
        """Initialise the instrument unless it is, and set everything a reading depends on.

        Waits for the end of the warm-up. An instrument that is initialised already keeps its lock;
        `force` initialises it again.
        """
        processor = self._ask(Command.GET_SYSTEM_STATUS, what='system status')[1]
        if force or processor != codes.TRACKER_INITIALIZED:
            self._initialise()
        s = self.settings
        for command, _, values, _ in SET_FOR_READINGS:
            self._ask(command, *values)
        self._ask(Command.SET_STATIONARY_MODE, round(s.integration_s * 1e3), True)
        self._ask(Command.SET_STATISTIC_MODE, codes.STANDARD_STATISTICS, codes.STANDARD_STATISTICS)
        self._set_search()
        if s.reflector_id is not None:
            self._ask(Command.SET_REFLECTOR, s.reflector_id)
        if s.environment is not None:
            e = s.environment
            self._ask(Command.SET_ENVIRONMENT, e.temperature_c, e.pressure_hpa, e.humidity_percent)
        self._check_settings()
        self.request_status()

    def set_search_radius(self, radius_m: float) -> None:
        """Set how far (m) about the given place, or where it points, the instrument searches."""
        self.settings = replace(self.settings, search_radius_m=radius_m)
        self._set_search()

    def _set_search(self) -> None:
        s = self.settings
        self._ask(Command.SET_SEARCH, s.search_radius_m, round(s.search_timeout_s * 1e3))

    def find_reflector(self, distance_m: float | None = None) -> None:
        """Search a spiral about the place the tracker points to, and lock the reflector.

        Parameters
        ----------
        distance_m
            Approximate distance of the reflector; None takes that of the last reading or position,
            or 3 m.
        """
        distance = (self._distance_m or 3.0) if distance_m is None else distance_m
        if not 0 < distance < np.inf:
            raise InputError(f'{self.name}: reflector distance {distance} m; it must be above 0')
        self._search(Command.FIND_REFLECTOR, distance, what='search for the reflector')

    def go_position(self, position: ArrayLike) -> None:
        """Turn to a position in the tracker's frame (m, (3,)), search there and lock."""
        target = self._point(position)
        self._distance_m = float(np.linalg.norm(target))
        self._search(Command.GO_POSITION, *target.tolist(), True, what='search at a position')

    def ensure_locked(
        self, expected_position: ArrayLike | None = None, *, attempts: int = 3
    ) -> int:
        """Lock the reflector if the beam is broken.

        A busy instrument is waited for. Each attempt goes to the expected position, or, without
        one, searches about the place the tracker points to. The lock may hold any reflector within
        the search radius: compare the reading with what is expected.

        Parameters
        ----------
        expected_position
            Where the reflector should be, in the tracker's frame, m, (3,).
        attempts
            How many searches may be made.

        Returns
        -------
        int
            Searches made; 0 where the reflector was locked.

        Raises
        ------
        LaserTrackerError
            If the last attempt found nothing either (its status is that of the search), or the
            connection is lost (at once; no status).
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
            f'{codes.describe_status(status)}',
            status,
        ) from failure

    def measure(self, timeout_s: float | None = None) -> TrackerReading:
        """Measure the locked reflector once.

        Parameters
        ----------
        timeout_s
            None: the integration time and two reply time-outs.

        Raises
        ------
        LaserTrackerError
            `Status.MEASUREMENT_STATUS_NOT_READY` without a lock, `Status.SENSOR_NOT_STABLE` for a
            moving target, `Status.SERVER_BUSY`; or the result is not usable.
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
            # A change of the units or the frame meanwhile has changed the numbers.
            if not self._settings_checked:
                self._check_settings()
        except LaserTrackerError:
            self._link.count('measurements_failed')
            raise
        self._link.count('measurements')
        self._distance_m = float(np.linalg.norm(position))
        return TrackerReading(
            stamp_s=stamp_s,
            position=position,
            std=std,
            temperature_c=result.temperature,
            pressure_hpa=result.pressure,
            humidity_percent=result.humidity,
        )

    def _ask(
        self, command: Command, *values: Value, what: str = '', timeout_s: float | None = None
    ) -> tuple[Value, ...]:
        timeout_s = self.settings.reply_timeout_s if timeout_s is None else timeout_s
        return self._link.ask(command, *values, timeout_s=timeout_s, what=what)

    def _initialise(self) -> None:
        end = self._now() + self.settings.initialise_timeout_s
        while True:
            left = end - self._now()
            try:
                self._ask(Command.INITIALIZE, what='initialisation', timeout_s=left)
                return
            except LaserTrackerError as error:
                if error.status != Status.ADM_START_UP_BUSY or left < _WARM_UP_RETRY_S:
                    raise
            self._sleep(_WARM_UP_RETRY_S)

    def _search(self, command: Command, *values: Value, what: str) -> None:
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
        """Search once; return the instrument's refusal, raise where the connection is lost."""
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
        s = self.settings
        end = self._now() + _SLEW_S + s.search_timeout_s + s.integration_s
        while (status := self.request_status()) is TrackerStatus.BUSY:
            if self._now() > end:
                raise LaserTrackerError(
                    f'{self.name}: still {codes.describe_status(Status.SERVER_BUSY)}',
                    Status.SERVER_BUSY,
                )
            self._sleep(_RETRY_S)
        return status

    def _check_settings(self) -> None:
        """Read back what a reading depends on.

        Raises
        ------
        LaserTrackerError
            If it is not as we set it.
        """
        # Set first: a change that is reported during the check makes it count for nothing.
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
        """Take note of a status change; runs in the reading thread."""
        if change in CHANGES_OF_READINGS:
            self._settings_checked = False
        status = _STATUS_OF_CHANGE.get(change)
        if status is None:
            return
        if self._status is TrackerStatus.READY and status is TrackerStatus.NOT_READY:
            self._link.count('beam_breaks')
        self._status = status

    def _point(self, position: ArrayLike) -> FloatArray:
        try:
            point = np.asarray(position, float)
        except (TypeError, ValueError):
            point = np.empty(0)
        if point.shape != (3,) or not np.all(np.isfinite(point)):
            raise InputError(
                f'{self.name}: {position!r} is not a position of three finite numbers'
            )
        return point
