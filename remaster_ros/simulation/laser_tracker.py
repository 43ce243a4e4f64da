# SPDX-License-Identifier: Apache-2.0
"""Fake laser tracker: the emScon protocol on a TCP port, with the hidden world."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from remaster_ros.errors import DeviceError
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
    Value,
    encode,
)
from remaster_ros.simulation.faults import Numbers
from remaster_ros.simulation.world import World
from remaster_ros.types import FloatArray

LENGTH_UNITS_M = (1.0, 1e-3, 1e-6, 0.3048, 0.9144, 0.0254)
"""Metre, millimetre, micron, foot, yard, inch."""

REFLECTORS = {1: (1, 0.01905, 'CCR 1.5in'), 2: (1, 0.00635, 'CCR 0.5in')}
"""Number -> target type (corner cube), surface offset (m), name."""


class Setting(NamedTuple):
    """Command that reads a setting, event of its change, and initial values."""

    get: Command
    change: Change
    initial: tuple[Value, ...]


SETTINGS = {
    Command.SET_UNITS: Setting(Command.GET_UNITS, Change.UNITS, (1, 0, 0, 0, 0)),
    Command.SET_ENVIRONMENT: Setting(
        Command.GET_ENVIRONMENT, Change.ENVIRONMENT, (20.0, 1013.25, 50.0)
    ),
    Command.SET_MEASUREMENT_MODE: Setting(
        Command.GET_MEASUREMENT_MODE, Change.MEASUREMENT_MODE, (0,)
    ),
    Command.SET_COORDINATE_SYSTEM_TYPE: Setting(
        Command.GET_COORDINATE_SYSTEM_TYPE, Change.COORDINATE_SYSTEM_TYPE, (0,)
    ),
    Command.SET_STATIONARY_MODE: Setting(
        Command.GET_STATIONARY_MODE, Change.STATIONARY_MODE, (1000, 1)
    ),
    Command.SET_REFLECTOR: Setting(Command.GET_REFLECTOR, Change.REFLECTOR, (1,)),
    Command.SET_SEARCH: Setting(Command.GET_SEARCH, Change.SEARCH, (50.0, 10_000)),
    Command.SET_STATISTIC_MODE: Setting(Command.GET_STATISTIC_MODE, Change.STATISTIC_MODE, (0, 0)),
}
"""The environment is temperature (°C), pressure (mbar) and relative humidity (%) of the air."""


@dataclass(frozen=True)
class TrackerBehaviour:
    """Settings of the fake tracker; world time in s, lengths in m."""

    # Time from switching on until it can be initialised (two hours on a real one)
    warm_up_s: float = 5.0
    initialise_s: float = 2.0  # Duration of the initialisation
    # Speed of turning to a position, and additional time of each turn
    slew_rad_s: float = 1.0
    slew_settle_s: float = 0.3
    # Pitch and speed of the search's spiral, at the reflector
    spiral_pitch_m: float = 0.02
    spiral_speed_m_s: float = 3.0
    # Time from the first return of light to a lock with a valid absolute distance
    acquire_s: float = 1.0
    search_failure_share: float = 0.02  # Share of searches that find nothing for no visible reason
    tracking_speed_m_s: float = 4.0  # Speed across the beam above which it loses the reflector
    # Angle of a large move of a joint, and share of large moves that break the beam (gimbal and
    # reflector shake); the line of sight breaks others
    large_move_rad: float = 1.5
    large_move_break_share: float = 0.25
    # The ADM refuses a reflector that leaves a sphere of this radius while it integrates
    stability_limit_m: float = 50e-6
    # Accuracy limits (two standard deviations): a constant, and parts per million of distance
    range_limit_m: float = 10e-6
    range_limit_ppm: float = 0.3
    across_limit_m: float = 15e-6
    across_limit_ppm: float = 6.0


def refusal(command: Command, values: tuple[Value, ...]) -> Status:
    """Status with the reason why a setting is refused, or `Status.ALL_OK`.

    Refused are values that are not finite, other units than those of `LENGTH_UNITS_M` with 0 for
    angles, temperature and humidity, modes other than 0, unknown reflectors, and air or search
    values out of range.
    """
    numbers = np.array(values, float)
    if not np.all(np.isfinite(numbers)):
        return Status.INVALID_INPUT_DATA
    if command is Command.SET_UNITS:
        length, angle, temperature, pressure, humidity = numbers
        known = length < len(LENGTH_UNITS_M) and angle == temperature == humidity == 0
        # The second pressure unit, hPa, is the first one, mbar.
        return Status.ALL_OK if known and pressure < 2 else Status.NOT_IMPLEMENTED
    if command in (
        Command.SET_MEASUREMENT_MODE,
        Command.SET_COORDINATE_SYSTEM_TYPE,
        Command.SET_STATISTIC_MODE,
    ):
        return Status.NOT_IMPLEMENTED if np.any(numbers) else Status.ALL_OK
    if command is Command.SET_REFLECTOR:
        return Status.ALL_OK if values[0] in REFLECTORS else Status.WRONG_PARAMETER_1
    if command is Command.SET_ENVIRONMENT:
        temperature, pressure, humidity = numbers
        inside = -20 <= temperature <= 60 and 500 <= pressure <= 1200 and 0 <= humidity <= 100
        return Status.ALL_OK if inside else Status.METEO_DATA_OUT_OF_RANGE
    # The remaining settings are the search and the stationary mode: radius and time, time and
    # flag.
    return Status.ALL_OK if numbers[0] > 0 and numbers[1] >= 0 else Status.WRONG_PARAMETER


# The beam of the fake laser tracker: it follows a reflector, or loses it; its errors.
#
# The beam follows while nothing is in its way, the reflector faces it and does not outrun it.
# Large moves of the arm lose it now and then even so. Errors are those of a data sheet, in range
# and angles: limits of 10 µm + 0.3 µm/m along the beam and 15 µm + 6 µm/m across it, at two
# standard deviations.


STEP_S = 0.1
"""World time between two steps of the instrument, s."""
_SIGHT_EVERY_S = 0.5


class Beam:
    """Direction of the instrument, and whether it is locked on the reflector.

    ``world, sensor``: the hidden world, and the tracker's name in it; ``t``: world time, s;
    ``aim``: first aim in the tracker's frame, m, (3,), or None for the reflector; ``further``:
    further reflectors of the tool by name, with their numbers for the fault ``hidden``; the first
    has the name '' and the number 1.
    """

    def __init__(
        self,
        world: World,
        sensor: str,
        rng: np.random.Generator,
        behaviour: TrackerBehaviour,
        t: float,
        aim: FloatArray | None,
        further: Mapping[str, int] | None = None,
    ) -> None:
        self._world, self._sensor, self._rng = world, sensor, rng
        self._behaviour = behaviour
        self._numbers = {'': 1, **(further or {})}
        # Name of the reflector that the beam is locked on.
        self._on = ''
        self.locked = False
        self.aim = self.reflector(t) if aim is None else np.asarray(aim, float)
        self._sight_at = -np.inf
        self._swept_rad = 0.0
        self._move_judged = False

    def reflector(self, t: float) -> FloatArray:
        """True position of the present reflector at time t, s, m in the tracker's frame, (3,)."""
        return self._world.marker_in_sensor(self._sensor, t, self._on)

    def sees(self, t: float) -> bool:
        """Whether the line of sight to the present reflector is free at time t, s.

        False also with the fault ``hidden`` of this reflector's number.
        """
        if self._world.faults(self._sensor).get('hidden') == self._numbers[self._on]:
            return False
        return self._world.line_of_sight(self._sensor, t, self._on)

    def find(self, target: FloatArray, largest_rad: float, t: float) -> bool:
        """Select the visible reflector nearest to a direction; False if none is near enough.

        ``target``: in the tracker's frame, of any length but 0, (3,); ``largest_rad``: largest
        angle from it. The beam is not locked; without a reflector the former one stays selected.
        """
        before, angles = self._on, {}
        for name in self._numbers:
            self._on = name
            angle = angle_between(target, self.reflector(t))
            if angle <= largest_rad and self.sees(t):
                angles[name] = angle
        self._on = min(angles, key=angles.__getitem__, default=before)
        return bool(angles)

    def lock(self, t: float) -> None:
        """Lock on the selected reflector and aim at it, at time t, s."""
        self.locked, self.aim, self._sight_at = True, self.reflector(t), t
        self._swept_rad, self._move_judged = 0.0, False

    def follow(self, t: float) -> bool:
        """Follow the reflector for a step that ends at time t, s; False if the beam loses it.

        It does if the reflector is hidden (looked up at every step while the arm moves, else every
        0.5 s), outruns it, or a large move shakes it. The aim stays where it was lost. Meant for a
        locked beam.
        """
        reflector, moving = self.reflector(t), self._world.is_moving(t)
        across_speed = angle_between(self.aim, reflector) * np.linalg.norm(reflector) / STEP_S
        # The line of sight takes long to compute, and changes little while the arm stands still.
        hidden = False
        if moving or t - self._sight_at > _SIGHT_EVERY_S:
            hidden, self._sight_at = not self.sees(t), t
        outrun = across_speed > self._behaviour.tracking_speed_m_s
        if self._shaken(t, moving) or hidden or outrun:
            self.locked = False
        else:
            self.aim = reflector
        return self.locked

    def _shaken(self, t: float, moving: bool) -> bool:
        """Whether a large move breaks the beam now; a random decision, once for each move.

        A move is large once its fastest joint has swept ``large_move_rad``. `t`: end of the step,
        s; ``moving``: whether the arm moves then.
        """
        if not moving:
            self._swept_rad, self._move_judged = 0.0, False
            return False
        self._swept_rad += self._world.joint_speed(t) * STEP_S
        if self._move_judged or self._swept_rad <= self._behaviour.large_move_rad:
            return False
        self._move_judged = True
        return self._rng.random() < self._behaviour.large_move_break_share


def angle_between(a: FloatArray, b: FloatArray) -> float:
    """Angle between two directions (3,), rad, 0 to π; exact for small ones too."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def covariance(position: FloatArray, behaviour: TrackerBehaviour) -> FloatArray:
    """Covariance of a measured position, m², (3, 3), with independent errors of range and angles.

    The limits of a data sheet are two standard deviations.
    """
    b = behaviour
    distance = np.linalg.norm(position)
    range_std = 0.5 * (b.range_limit_m + b.range_limit_ppm * 1e-6 * distance)
    across_std = 0.5 * (b.across_limit_m + b.across_limit_ppm * 1e-6 * distance)
    along = np.outer(position, position) / distance**2
    return range_std**2 * along + across_std**2 * (np.eye(3) - along)


def adm_result(
    position: FloatArray,
    std: FloatArray,
    unit_m: float,
    environment: tuple[float, float, float],
) -> Measurement:
    """Packet of a measured position and its standard deviation (m, (3,) each).

    ``unit_m``: the client's unit of length, m; ``environment``: temperature (°C), pressure (mbar),
    relative humidity (%).
    """
    x, y, z = (position / unit_m).tolist()
    std_x, std_y, std_z = (std / unit_m).tolist()
    total = float(np.linalg.norm(std)) / unit_m
    temperature, pressure, humidity = environment
    return Measurement(
        status=0,
        mode=0,
        is_try=0,
        values=(x, y, z),
        std=(std_x, std_y, std_z),
        std_total=total,
        pointing_error=(0.0, 0.0, 0.0),
        a_priori_std=(std_x, std_y, std_z),
        a_priori_std_total=total,
        temperature=temperature,
        pressure=pressure,
        humidity=humidity,
    )


# How the fake laser tracker behaves: packets in, packets out, world time as an argument.
#
# A search winds a spiral about the place the
# tracker points to. The ADM averages over the integration time and refuses a target that moves
# meanwhile.


_LONGEST_CATCH_UP_S = 5.0

Operation = Iterator[None]
"""Command that takes time, advanced once a step until its end."""


class TrackerInstrument:
    """Instrument without sockets, threads and clocks.

    ``world``: the hidden world; ``sensor``: the tracker's name in it; ``switched_on_s``: world
    time of switching on, s; ``aim``: first aim in the tracker's frame, m, (3,), or None for the
    reflector, as after set-up by a person; ``further``: further reflectors of the tool, as in
    `Beam`.
    """

    def __init__(
        self,
        world: World,
        sensor: str,
        rng: np.random.Generator,
        switched_on_s: float,
        behaviour: TrackerBehaviour | None = None,
        aim: FloatArray | None = None,
        further: Mapping[str, int] | None = None,
    ) -> None:
        self.behaviour = behaviour or TrackerBehaviour()
        self._world, self._rng = world, rng
        self._beam = Beam(world, sensor, rng, self.behaviour, switched_on_s, aim, further)
        self._warm_at = switched_on_s + self.behaviour.warm_up_s
        self._time = switched_on_s
        self._initialized = False
        self._operation: Operation | None = None
        self._out: list[Event] = []
        self._settings = {setting.get: setting.initial for setting in SETTINGS.values()}

    # What a client sees

    @property
    def locked(self) -> bool:
        """Whether the beam is on the reflector."""
        return self._beam.locked

    @property
    def readiness(self) -> Readiness:
        """Busy during an operation, else ready if the beam is locked, else not ready."""
        if self._operation is not None:
            return Readiness.BUSY
        return Readiness.READY if self.locked else Readiness.NOT_READY

    def greeting(self) -> list[Event]:
        """First packets for a client that connects."""
        return [self._readiness_change()]

    def handle(self, request: Request) -> list[Event]:
        """Handle a command at the time of the last step; the immediate answers are returned.

        An unknown command is answered by NOT_IMPLEMENTED.
        """
        command = request.command
        if command in SETTINGS:
            self._set(command, request.values)
        elif command in _TAKES_TIME:
            self._begin(command, request.values)
        elif answers := self._answers(command):
            for values in answers:
                self._reply(command, 0, values)
        else:
            self._reply(command, Status.NOT_IMPLEMENTED)
        return self._sent()

    def step(self, t: float) -> list[Event]:
        """Advance to world time t, s, in steps of 0.1 s; the packets sent meanwhile are returned.

        Of a delay only the last 5 s are made up for.
        """
        self._time = max(self._time, t - _LONGEST_CATCH_UP_S)
        while t - self._time >= STEP_S:
            self._time += STEP_S
            if self.locked and not self._beam.follow(self._time):
                self._lose()
            self._advance()
        return self._sent()

    def abort(self) -> None:
        """End the present command, as when the client disconnects; nothing without one."""
        if self._operation is not None:
            self._operation = None
            self._out.append(self._readiness_change())

    def break_beam(self) -> list[Event]:
        """Lose the reflector, as when a person walks through the beam; the packets to send."""
        self._lose()
        return self._sent()

    def _sent(self) -> list[Event]:
        """Packets that were to be sent, in order; they are forgotten here."""
        out, self._out = self._out, []
        return out

    def _reply(self, command: Command, status: int = 0, values: tuple[Value, ...] = ()) -> None:
        """Put a reply to a command among the packets to be sent."""
        self._out.append(Reply(command, status, values))

    def _readiness_change(self) -> StatusChange:
        """Status change that reports the present state of readiness."""
        # The three changes have the order of the three states.
        return StatusChange(Change.NOT_READY + self.readiness)

    # Settings and queries

    @property
    def _unit_m(self) -> float:
        """Unit of length that the client has set, m."""
        return LENGTH_UNITS_M[int(self._settings[Command.GET_UNITS][0])]

    def _set(self, command: Command, values: tuple[Value, ...]) -> None:
        """Apply a setting, reply, and report the change.

        It is refused during an operation, or if a value is wrong.
        """
        setting = SETTINGS[command]
        status = Status.SERVER_BUSY if self._operation else refusal(command, values)
        if status == Status.ALL_OK:
            if command is Command.SET_UNITS:
                self._convert_lengths(int(values[0]))
            self._settings[setting.get] = values
        self._reply(command, status)
        if status == Status.ALL_OK:
            self._out.append(StatusChange(setting.change))

    def _convert_lengths(self, unit: int) -> None:
        """Convert the search radius to a new unit, an index of `LENGTH_UNITS_M`."""
        radius, timeout = self._settings[Command.GET_SEARCH]
        scale = self._unit_m / LENGTH_UNITS_M[unit]
        self._settings[Command.GET_SEARCH] = (float(radius) * scale, timeout)

    def _answers(self, command: Command) -> list[tuple[Value, ...]]:
        """Values of each reply to a query; empty if the command is no query."""
        if command in self._settings:
            return [self._settings[command]]
        if command is Command.GET_TRACKER_STATUS:
            return [(self.readiness,)]
        if command is Command.GET_SYSTEM_STATUS:
            processor = 5 if self._initialized else 3
            laser, adm = (3, 2) if self._time >= self._warm_at else (0, 1)
            return [(Status.ALL_OK, processor, laser, adm, 3, 8, 500, 0, 0, 390001)]
        if command is Command.GET_REFLECTORS:
            return [
                (len(REFLECTORS), number, kind, offset / self._unit_m, name.encode('utf-16le'))
                for number, (kind, offset, name) in REFLECTORS.items()
            ]
        return []

    # Commands that take time

    def _begin(self, command: Command, values: tuple[Value, ...]) -> None:
        """Start a command's operation and advance it once; reply with the status if refused."""
        status = self._why_not(command, values)
        if status != Status.ALL_OK:
            self._reply(command, status)
            return
        if command is Command.START_MEASUREMENT:
            # The result of a measurement follows later.
            self._reply(command)
        self._operation = self._start(command, values)
        self._out.append(self._readiness_change())
        self._advance()

    def _start(self, command: Command, values: tuple[Value, ...]) -> Operation:
        """Operation of a command that takes time: measurement, initialisation or a search.

        A search begins at the present aim (FIND_REFLECTOR, with a distance) or at a position
        (GO_POSITION), in the client's unit of length.
        """
        if command is Command.START_MEASUREMENT:
            return self._measure()
        if command is Command.INITIALIZE:
            return self._initialize()
        if command is Command.FIND_REFLECTOR:
            return self._search(command, self._beam.aim, float(values[0]) * self._unit_m)
        target = np.array(values[:3], float) * self._unit_m
        return self._search(command, target, float(np.linalg.norm(target)))

    def _why_not(self, command: Command, values: tuple[Value, ...]) -> Status:
        """Status with the reason why a command cannot begin now, or `Status.ALL_OK`."""
        if self._operation is not None:
            return Status.SERVER_BUSY
        if self._time < self._warm_at:
            return Status.ADM_START_UP_BUSY
        if command is not Command.INITIALIZE and not self._initialized:
            return Status.TRACKER_NOT_INITIALIZED
        if command is Command.START_MEASUREMENT and not self.locked:
            return Status.MEASUREMENT_STATUS_NOT_READY
        if not np.all(np.isfinite(np.array(values, float))):
            return Status.INVALID_INPUT_DATA
        if command is Command.FIND_REFLECTOR and not float(values[0]) > 0:
            return Status.WRONG_PARAMETER_1
        if command is Command.GO_POSITION and not any(values[:3]):
            return Status.WRONG_PARAMETER
        return Status.ALL_OK

    def _advance(self) -> None:
        """Advance the present operation by a step, if any; report readiness after its end."""
        if self._operation is None:
            return
        try:
            next(self._operation)
        except StopIteration:
            self._operation = None
            self._out.append(self._readiness_change())

    def _initialize(self) -> Operation:
        """Operation that unlocks the beam, waits, and reports the instrument initialised."""
        self._beam.locked = False
        yield from self._wait(self.behaviour.initialise_s)
        self._initialized = True
        self._reply(Command.INITIALIZE)
        self._out.append(StatusChange(Change.INITIALIZATION))

    def _wait(self, seconds: float) -> Operation:
        """Operation without effect that lasts for some seconds of the instrument's time."""
        end = self._time + seconds
        while self._time < end:
            yield

    def _turn(self, target: FloatArray) -> Operation:
        """Operation that unlocks the beam and turns it to `target` (tracker's frame, m, (3,))."""
        self._beam.locked = False
        b = self.behaviour
        yield from self._wait(
            b.slew_settle_s + angle_between(self._beam.aim, target) / b.slew_rad_s
        )
        self._beam.aim = target

    def _search(self, command: Command, target: FloatArray, distance: float) -> Operation:
        """Turn to the target and search in a spiral about it; lock on what is found, and reply.

        A spiral of pitch p at speed v reaches the radius r after π r² / (p v). It ends at the
        radius or time of the settings. ``target``: m, (3,); ``distance``: of the reflector, m.
        """
        b = self.behaviour
        search_radius, timeout_ms = self._settings[Command.GET_SEARCH]
        radius = float(search_radius) * self._unit_m
        blind = self._rng.random() < b.search_failure_share
        yield from self._turn(target)
        start, reached, found = self._time, 0.0, False
        while not found and reached < radius and self._time - start < int(timeout_ms) * 1e-3:
            yield
            area = b.spiral_pitch_m * b.spiral_speed_m_s * (self._time - start)
            reached = np.sqrt(area / np.pi)
            within = min(reached, radius) / distance
            found = not blind and self._beam.find(target, within, self._time)
        if found:
            yield from self._wait(b.acquire_s)
            found = self._beam.sees(self._time)
        if found:
            self._beam.lock(self._time)
        self._reply(command, Status.ALL_OK if found else Status.MEASUREMENT_STATUS_NOT_READY)

    def _measure(self) -> Operation:
        """Measurement as an operation: a result, or an error if beam breaks or target moves.

        The target moves if it leaves 50 µm (``stability_limit_m``) about its first place.
        """
        integration_ms, _ = self._settings[Command.GET_STATIONARY_MODE]
        end = self._time + int(integration_ms) * 1e-3
        samples = [self._beam.reflector(self._time)]
        problem = Status.ALL_OK
        while self._time < end and problem == Status.ALL_OK:
            yield
            samples.append(self._beam.aim)
            if not self.locked:
                problem = Status.MEASUREMENT_STATUS_NOT_READY
            elif np.linalg.norm(samples[-1] - samples[0]) > self.behaviour.stability_limit_m:
                problem = Status.SENSOR_NOT_STABLE
        if problem == Status.ALL_OK:
            self._out.append(self._result(np.mean(samples, axis=0)))
        else:
            self._out.append(ErrorReport(Command.START_MEASUREMENT, problem))

    def _result(self, truth: FloatArray) -> Measurement:
        """Measurement of a point, m, (3,), with noise, its std and the weather station's data."""
        cov = covariance(truth, self.behaviour)
        position = self._rng.multivariate_normal(truth, cov)
        temperature, pressure, humidity = map(float, self._settings[Command.GET_ENVIRONMENT])
        # The weather station measures the warming on top of the temperature that was set.
        temperature += self._world.warming_k(self._time)
        return adm_result(
            position,
            np.sqrt(np.diag(cov)),
            self._unit_m,
            (temperature, pressure, humidity),
        )

    def _lose(self) -> None:
        """Unlock the beam; report the change of readiness unless an operation is in progress."""
        self._beam.locked = False
        if self._operation is None:
            self._out.append(self._readiness_change())


_TAKES_TIME = (
    Command.INITIALIZE,
    Command.START_MEASUREMENT,
    Command.FIND_REFLECTOR,
    Command.GO_POSITION,
)


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
        """Whether the beam is on the reflector."""
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
        """Serve one client until `_closing` is set: faults, steps of the instrument, commands."""
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
        """World time, s, slower for an instrument with the fault ``slow``: its loss remains."""
        now = self._world.now()
        passed, self._looked_at = now - self._looked_at, now
        self._lost_s += passed * (1.0 - 1.0 / faults.get('slow', 1.0))
        return now - self._lost_s

    def _apply(self, faults: Numbers) -> None:
        """Apply the injected faults of the connection and the power.

        'off' drops the client, 'renumbered' switches the instrument off and on once, 'garbage'
        sends 64 random bytes.
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
        """Accept a client and greet it.

        A second client is refused, and any client while the fault 'off' is set.
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
