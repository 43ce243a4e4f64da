# SPDX-License-Identifier: Apache-2.0
"""Instrument of the fake laser tracker: packets in, packets out, world time as an argument.

A search winds a spiral about the place the tracker points to. The ADM averages over the
integration time and refuses a target that moves meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from remaster_ros.sensors.laser_tracker.codes import Change, Command, Readiness, Status
from remaster_ros.sensors.laser_tracker.packets import (
    ErrorReport,
    Event,
    Measurement,
    Reply,
    Request,
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
from remaster_ros.simulation.laser_tracker_behaviour import (
    LENGTH_UNITS_M,
    REFLECTORS,
    SETTINGS,
    TrackerBehaviour,
    refusal,
)
from remaster_ros.simulation.world import World
from remaster_ros.types import FloatArray

_LONGEST_CATCH_UP_S = 5.0
Operation = Iterator[None]
"""Command that takes time, advanced once a step until its end."""
_TAKES_TIME = (
    Command.INITIALIZE,
    Command.START_MEASUREMENT,
    Command.FIND_REFLECTOR,
    Command.GO_POSITION,
)


class TrackerInstrument:
    """Fake laser tracker's instrument: commands to answers, without sockets, threads and clocks.

    ``world``: the hidden world; ``sensor``: the tracker's name in it; ``switched_on_s``: world
    time of switching on, s; ``aim``: first aim in the tracker's frame, m, (3,), or None for
    the reflector, as after set-up by a person; ``further``: further reflectors of the tool, as
    in `Beam`.
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
        """Whether the beam is locked on a reflector."""
        return self._beam.locked

    @property
    def readiness(self) -> Readiness:
        """Busy during an operation, else ready if the beam is locked, else not ready."""
        if self._operation is not None:
            return Readiness.BUSY
        return Readiness.READY if self.locked else Readiness.NOT_READY

    def greeting(self) -> list[Event]:
        """First packets for a client that connects: the present readiness."""
        return [self._readiness_change()]

    def handle(self, request: Request) -> list[Event]:
        """Handle a client's command at the time of the last step; return the packets to send now.

        An unknown command is answered by NOT_IMPLEMENTED. A command that takes time ends in
        `step`.
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
        """Advance to world time t, s, in steps of 0.1 s; return the packets sent meanwhile.

        If t is more than 5 s ahead, only the last 5 s are simulated.
        """
        self._time = max(self._time, t - _LONGEST_CATCH_UP_S)
        while t - self._time >= STEP_S:
            self._time += STEP_S
            if self.locked and not self._beam.follow(self._time):
                self._lose()
            self._advance()
        return self._sent()

    def abort(self) -> None:
        """End the present command without an answer, as when the client disconnects.

        Nothing if there is none.
        """
        if self._operation is not None:
            self._operation = None
            self._out.append(self._readiness_change())

    def break_beam(self) -> list[Event]:
        """Unlock the beam, as when a person walks through it; return the packets to send."""
        self._lose()
        return self._sent()

    def _sent(self) -> list[Event]:
        """Return the packets that wait to be sent, in order, and empty their list."""
        out, self._out = self._out, []
        return out

    def _reply(self, command: Command, status: int = 0, values: tuple[Value, ...] = ()) -> None:
        """Append a reply to a command to the packets that wait to be sent."""
        self._out.append(Reply(command, status, values))

    def _readiness_change(self) -> StatusChange:
        """Packet that reports the present readiness; it is returned only, not sent."""
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
        """Convert the search radius in the settings to a new unit, an index of `LENGTH_UNITS_M`.

        To be called before the new unit is set.
        """
        radius, timeout = self._settings[Command.GET_SEARCH]
        scale = self._unit_m / LENGTH_UNITS_M[unit]
        self._settings[Command.GET_SEARCH] = (float(radius) * scale, timeout)

    def _answers(self, command: Command) -> list[tuple[Value, ...]]:
        """Values of each reply to a query (a reading command); [] if the command is no query."""
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
        """Begin a command that takes time, with a first step; if refused, reply with why."""
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
        """Generator of a command that takes time (measurement, initialisation or search).

        Each step of 0.1 s advances it once. A search begins at the present aim
        (FIND_REFLECTOR, with a distance) or at a position (GO_POSITION); ``values``: these, in
        the client's unit of length.
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
        """Operation that unlocks the beam, waits, replies, and reports the initialisation."""
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
        """Operation that turns to a target and searches in a spiral about it, then replies.

        It locks on a reflector that is found. A spiral of pitch p at speed v reaches the
        radius r after π r² / (p v). The search ends at the radius or time of the settings;
        some fail at random. ``target``: m, (3,); ``distance``: of the reflector, m.
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
        """Operation that measures the reflector, and puts a result or an error among the packets.

        An error if the beam breaks, or the reflector leaves 50 µm (``stability_limit_m``)
        about its first position.
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
        """Packet of a measurement of a true point, m, (3,), with random noise and its std.

        With the temperature, pressure and humidity of the air.
        """
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
