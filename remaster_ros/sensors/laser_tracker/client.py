# SPDX-License-Identifier: Apache-2.0
"""Client of a laser tracker by emScon: lock the reflector, measure it at standstill.

A tracker follows the reflector with its beam. When the beam breaks the tracker has to find the
reflector again, by a spiral search about its present direction
(`LaserTrackerClient.find_reflector`) or about given coordinates
(`LaserTrackerClient.go_position`). Its absolute distance meter (ADM) refuses a target that moves.
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
from remaster_ros.sensors.laser_tracker import codes
from remaster_ros.sensors.laser_tracker.codes import (
    Change,
    Command,
    Readiness,
    Status,
)
from remaster_ros.sensors.laser_tracker.link import (
    LaserTrackerError,
    LaserTrackerSettings,
    TrackerLink,
    TrackerStatus,
)
from remaster_ros.sensors.laser_tracker.packets import (
    Value,
)
from remaster_ros.types import FARTHEST_M, FloatArray, MarkerReading

_UNITS = (
    codes.METRE,
    codes.RADIAN,
    codes.CELSIUS,
    codes.MILLIBAR,
    codes.RELATIVE_HUMIDITY,
)
SET_FOR_READINGS: tuple[tuple[Command, Command, tuple[Value, ...], str], ...] = (
    (Command.SET_UNITS, Command.GET_UNITS, _UNITS, 'units (metre, radian, °C, mbar)'),
    (
        Command.SET_COORDINATE_SYSTEM_TYPE,
        Command.GET_COORDINATE_SYSTEM_TYPE,
        (codes.RIGHT_HANDED_CARTESIAN,),
        'coordinate system (right-handed Cartesian)',
    ),
    (
        Command.SET_MEASUREMENT_MODE,
        Command.GET_MEASUREMENT_MODE,
        (codes.STATIONARY,),
        'measurement mode (stationary)',
    ),
)
"""Settings that a reading depends on: command to set each, command to read it back, values, and
their name in words."""
CHANGES_OF_READINGS = (Change.UNITS, Change.COORDINATE_SYSTEM_TYPE, Change.MEASUREMENT_MODE)
"""Status changes after which these settings are read back."""
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
        """Status that the instrument reported last; DISCONNECTED while there is no connection.

        NOT_READY before the first report. It asks nothing; `request_status` does.
        """
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
        """Close the connection; may be repeated. A command that another thread waits for fails."""
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
        if processor != codes.TRACKER_INITIALIZED:
            self._initialise()
        s = self.settings
        for command, _, values, _ in SET_FOR_READINGS:
            self._ask(command, *values)
        self._ask(Command.SET_STATIONARY_MODE, round(s.integration_s * 1e3), True)
        self._ask(Command.SET_STATISTIC_MODE, codes.STANDARD_STATISTICS, codes.STANDARD_STATISTICS)
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
        """Search for a reflector in the present direction, and lock it.

        At the last measured or given distance, or 3 m, within `search_radius_m`. Raises
        LaserTrackerError if none is found; that counts as a failed search.
        """
        distance = self._distance_m or 3.0
        self._search(Command.FIND_REFLECTOR, distance, what='search for the reflector')

    def go_position(self, position: ArrayLike) -> None:
        """Turn to a position in the tracker's frame (m, (3,)), search there and lock.

        Raises LaserTrackerError if no reflector is found there, InputError if the position is
        not three finite numbers.
        """
        target = self._point(position)
        self._distance_m = float(np.linalg.norm(target))
        self._search(Command.GO_POSITION, *target.tolist(), True, what='search at a position')

    def ensure_locked(
        self, expected_position: ArrayLike | None = None, *, attempts: int = 3
    ) -> int:
        """Lock the reflector if the beam is broken; return the number of searches made.

        0 if it was locked. A busy instrument is waited for. Each attempt goes to the expected
        position, or, without one, searches in the present direction. The locked reflector may
        be any within the search radius: compare the reading with the expectation.
        ``expected_position``: in the tracker's frame, m, (3,); ``attempts``: largest number of
        searches. Raises LaserTrackerError if the last search failed too (with its status), or
        the connection is lost (at once; without a status).
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

    def measure(self, timeout_s: float | None = None) -> MarkerReading:
        """Measure the locked reflector once; its stamp is the time midway of the measurement.

        ``timeout_s``: None for the integration time and two reply time-outs. Raises
        LaserTrackerError: `Status.MEASUREMENT_STATUS_NOT_READY` without a lock,
        `Status.SENSOR_NOT_STABLE` for a moving target, `Status.SERVER_BUSY`; or the result is
        not finite or beyond `FARTHEST_M`, or the settings were changed by another program.
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
        """Send a command that searches for the reflector; count the search, and its failure.

        ``command, values``: as of `TrackerLink.ask`; ``what``: the command in words. It may
        take `_SLEW_S` + ``search_timeout_s`` + ``reply_timeout_s``.

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
        """Search once; return None if a reflector was found, or else the instrument's refusal.

        At `expected`, m, (3,), or in the present direction for None. Waits `_RETRY_S` after a
        refusal. Raises LaserTrackerError, without a status, if the connection is lost.
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
        """Wait until the instrument is no longer busy, and return its status.

        Raises LaserTrackerError if it is busy for longer than a turn, a search and a
        measurement take.
        """
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
        """Process a status change, by its number; called in the reading thread.

        A change of a setting has the settings checked again; unknown changes are ignored.
        """
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
