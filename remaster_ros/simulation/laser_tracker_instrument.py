"""How the fake laser tracker behaves: packets in, packets out, world time as an argument.

The beam is described in `laser_tracker_beam`. A search winds a spiral about the place the tracker
points to. The ADM averages over the integration time and refuses a target that moves meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from remaster_ros.sensors.laser_tracker.protocol.packets import (
    Change,
    Command,
    ErrorReport,
    Event,
    Measurement,
    Readiness,
    Reply,
    Request,
    Status,
    StatusChange,
    Value,
)
from remaster_ros.simulation.laser_tracker_beam import (
    STEP_S,
    Beam,
    adm_result,
    angle_between,
    covariance,
)
from remaster_ros.simulation.laser_tracker_settings import (
    LENGTH_UNITS_M,
    REFLECTORS,
    SETTINGS,
    TrackerBehaviour,
    refusal,
)
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from remaster_ros.simulation.world import World

_LONGEST_CATCH_UP_S = 5.0

Operation = Iterator[None]
"""A command that takes time: advanced once a step until it ends."""


class TrackerInstrument:
    """The instrument without sockets, threads and clocks.

    Parameters
    ----------
    world
        Where the reflector truly is.
    sensor
        The tracker's name in the world.
    rng
        Source of all randomness.
    switched_on_s
        World time at which it was switched on, s.
    behaviour
        See `TrackerBehaviour`.
    aim
        Where it points at first, in its own frame, m, (3,); None: where the reflector is, as
        a person who sets up the instrument leaves it.
    further
        Further reflectors of the tool, as of `Beam`.
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
        self._command = Command.UNKNOWN
        self._last_measured: FloatArray | None = None
        self._out: list[Event] = []
        self._settings = {setting.get: setting.initial for setting in SETTINGS.values()}

    # What a client sees

    @property
    def locked(self) -> bool:
        """Whether the beam is on the reflector."""
        return self._beam.locked

    @property
    def readiness(self) -> Readiness:
        """Not ready, busy or ready, as the instrument reports it."""
        if self._operation is not None:
            return Readiness.BUSY
        return Readiness.READY if self.locked else Readiness.NOT_READY

    def greeting(self) -> list[Event]:
        """Return the first packets for a client that connects."""
        return [self._readiness_change()]

    def handle(self, request: Request) -> list[Event]:
        """Take a command at the time of the last step; return what is sent at once."""
        command = request.command
        if command in SETTINGS:
            self._set(command, request.values)
        elif command in _TAKES_TIME:
            self._begin(command, request.values)
        elif command is Command.STOP_MEASUREMENT:
            self._reply(command)
            if self._operation and self._command is Command.START_MEASUREMENT:
                self.abort()
        elif answers := self._answers(command):
            for values in answers:
                self._reply(command, 0, values)
        else:
            self._reply(command, Status.NOT_IMPLEMENTED)
        return self._sent()

    def step(self, t: float) -> list[Event]:
        """Go on to world time t; return what is sent meanwhile."""
        self._time = max(self._time, t - _LONGEST_CATCH_UP_S)
        while t - self._time >= STEP_S:
            self._time += STEP_S
            if self.locked and not self._beam.follow(self._time):
                self._lose()
            self._advance()
        return self._sent()

    def abort(self) -> None:
        """End what is under way, as when the client goes away."""
        if self._operation is not None:
            self._operation = None
            self._out.append(self._readiness_change())

    def break_beam(self) -> list[Event]:
        """Lose the reflector, as when a person walks through the beam."""
        self._lose()
        return self._sent()

    def _sent(self) -> list[Event]:
        out, self._out = self._out, []
        return out

    def _reply(self, command: Command, status: int = 0, values: tuple[Value, ...] = ()) -> None:
        self._out.append(Reply(command, status, values))

    def _readiness_change(self) -> StatusChange:
        # The three changes have the order of the three states.
        return StatusChange(Change.NOT_READY + self.readiness)

    # Settings and queries

    @property
    def _unit_m(self) -> float:
        return LENGTH_UNITS_M[int(self._settings[Command.GET_UNITS][0])]

    def _set(self, command: Command, values: tuple[Value, ...]) -> None:
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
        """Keep the search radius what it is when its unit changes."""
        radius, timeout = self._settings[Command.GET_SEARCH]
        scale = self._unit_m / LENGTH_UNITS_M[unit]
        self._settings[Command.GET_SEARCH] = (float(radius) * scale, timeout)

    def _answers(self, command: Command) -> list[tuple[Value, ...]]:
        """Return the values of each reply to a query; none where it is no query."""
        if command in self._settings:
            return [self._settings[command]]
        if command is Command.GET_TRACKER_STATUS:
            return [(self.readiness,)]
        if command is Command.GET_SYSTEM_STATUS:
            processor = 5 if self._initialized else 3
            laser, adm = (3, 2) if self._time >= self._warm_at else (0, 1)
            return [(Status.ALL_OK, processor, laser, adm, 3, 8, 500, 0, 0, 390001)]
        if command is Command.GET_MEASUREMENT_STATUS_INFO:
            # Tracker, its compensation, ADM, its compensation, reflector, face 1, initialised.
            flags = 1 | 2 | 4 | 8 | self.locked * 2048 | 4096 | self._initialized * 65536
            return [(Status.ALL_OK, flags)]
        if command is Command.GET_REFLECTORS:
            return [
                (len(REFLECTORS), number, kind, offset / self._unit_m, name.encode('utf-16le'))
                for number, (kind, offset, name) in REFLECTORS.items()
            ]
        return []

    # Commands that take time

    def _begin(self, command: Command, values: tuple[Value, ...]) -> None:
        status = self._why_not(command, values)
        if status != Status.ALL_OK:
            self._reply(command, status)
            return
        if command is Command.START_MEASUREMENT:
            # Its result follows later.
            self._reply(command)
        self._command, self._operation = command, self._start(command, values)
        self._out.append(self._readiness_change())
        self._advance()

    def _start(self, command: Command, values: tuple[Value, ...]) -> Operation:
        if command is Command.START_MEASUREMENT:
            return self._measure()
        if command is Command.INITIALIZE:
            return self._initialize()
        if command is Command.FIND_REFLECTOR:
            return self._search(command, self._beam.aim, float(values[0]) * self._unit_m)
        if command in (Command.GO_POSITION, Command.POINT_LASER):
            target = np.array(values[:3], float) * self._unit_m
        elif command is Command.GO_LAST_MEASURED_POINT and self._last_measured is not None:
            target = self._last_measured
        elif command is Command.CHANGE_FACE:
            target = self._beam.aim
        else:
            target = self._beam.home
        if command in _ONLY_TURNS:
            return self._point(command, target)
        return self._search(command, target, float(np.linalg.norm(target)))

    def _why_not(self, command: Command, values: tuple[Value, ...]) -> Status:
        """Why a command cannot begin now."""
        if self._operation is not None:
            return Status.SERVER_BUSY
        if self._time < self._warm_at:
            return Status.ADM_START_UP_BUSY
        if command is not Command.INITIALIZE and not self._initialized:
            return Status.TRACKER_NOT_INITIALIZED
        if command is Command.START_MEASUREMENT and not self.locked:
            return Status.MEASUREMENT_STATUS_NOT_READY
        if command is Command.GO_LAST_MEASURED_POINT and self._last_measured is None:
            return Status.NO_LAST_MEASURED_POINT
        if not np.all(np.isfinite(np.array(values, float))):
            return Status.INVALID_INPUT_DATA
        if command is Command.FIND_REFLECTOR and not float(values[0]) > 0:
            return Status.WRONG_PARAMETER_1
        if command in (Command.GO_POSITION, Command.POINT_LASER) and not any(values[:3]):
            return Status.WRONG_PARAMETER
        return Status.ALL_OK

    def _advance(self) -> None:
        if self._operation is None:
            return
        try:
            next(self._operation)
        except StopIteration:
            self._operation = None
            self._out.append(self._readiness_change())

    def _initialize(self) -> Operation:
        self._beam.locked = False
        yield from self._wait(self.behaviour.initialise_s)
        self._initialized = True
        self._reply(Command.INITIALIZE)
        self._out.append(StatusChange(Change.INITIALIZATION))

    def _wait(self, seconds: float) -> Operation:
        end = self._time + seconds
        while self._time < end:
            yield

    def _turn(self, target: FloatArray) -> Operation:
        self._beam.locked = False
        b = self.behaviour
        yield from self._wait(
            b.slew_settle_s + angle_between(self._beam.aim, target) / b.slew_rad_s
        )
        self._beam.aim = target

    def _point(self, command: Command, target: FloatArray) -> Operation:
        yield from self._turn(target)
        self._reply(command)

    def _search(self, command: Command, target: FloatArray, distance: float) -> Operation:
        """Turn to the target and wind a spiral about it.

        A spiral of pitch p, run through at speed v, reaches the radius r after π r² / (p v).
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
        cov = covariance(truth, self.behaviour)
        self._last_measured = self._rng.multivariate_normal(truth, cov)
        temperature, pressure, humidity = map(float, self._settings[Command.GET_ENVIRONMENT])
        # The weather station measures the warming on top of the temperature that was set.
        temperature += self._world.warming_k(self._time)
        return adm_result(
            self._last_measured,
            np.sqrt(np.diag(cov)),
            self._unit_m,
            (temperature, pressure, humidity),
        )

    def _lose(self) -> None:
        self._beam.locked = False
        if self._operation is None:
            self._out.append(self._readiness_change())


_ONLY_TURNS = (Command.POINT_LASER, Command.GO_BIRD_BATH, Command.GO_BIRD_BATH_2)
_TAKES_TIME = (
    *_ONLY_TURNS,
    Command.INITIALIZE,
    Command.START_MEASUREMENT,
    Command.FIND_REFLECTOR,
    Command.GO_POSITION,
    Command.GO_LAST_MEASURED_POINT,
    Command.CHANGE_FACE,
)
