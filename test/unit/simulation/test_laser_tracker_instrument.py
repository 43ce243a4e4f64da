# SPDX-License-Identifier: Apache-2.0
"""The fake tracker's behaviour, step by step, without sockets, threads or clocks."""

from __future__ import annotations

import numpy as np
import pytest
from worlds.tracker_world import MARKER, ReflectorWorld, across_and_along

from remaster_ros.sensors.laser_tracker.codes import Change, Command, Readiness, Status
from remaster_ros.sensors.laser_tracker.packets import (
    ErrorReport,
    Event,
    Measurement,
    Reply,
    Request,
    StatusChange,
)
from remaster_ros.simulation.laser_tracker_behaviour import TrackerBehaviour
from remaster_ros.simulation.laser_tracker_instrument import TrackerInstrument

SURE = TrackerBehaviour(search_failure_share=0.0)
METRES = Request(Command.SET_UNITS, (0, 0, 0, 0, 0))


class Bench:
    """An instrument in a world, and a time that only the test moves."""

    def __init__(self, world=None, behaviour=SURE, seed=1, aim=None):
        self.world = world or ReflectorWorld()
        self.t = 0.0
        rng = np.random.default_rng(seed)
        self.instrument = TrackerInstrument(self.world, 'tracker', rng, 0.0, behaviour, aim)

    def send(self, command: Command, *values) -> list[Event]:
        return self.instrument.handle(Request(command, values))

    def run(self, seconds: float) -> list[Event]:
        self.t += seconds
        return self.instrument.step(self.t)

    def run_until_idle(self, at_most: float = 30.0) -> tuple[list[Event], float]:
        events, start = [], self.t
        while self.instrument.readiness is Readiness.BUSY:
            assert self.t - start < at_most, 'the operation does not end'
            events += self.run(0.1)
        return events, self.t - start

    def initialised(self) -> Bench:
        self.run(SURE.warm_up_s + 0.2)
        self.send(Command.INITIALIZE)
        self.run_until_idle()
        self.instrument.handle(METRES)
        return self

    def locked(self) -> Bench:
        self.initialised().send(Command.GO_POSITION, *self.world.path(self.t), 1)
        self.run_until_idle()
        assert self.instrument.locked
        return self


def test_from_off_to_locked():
    bench = Bench()
    assert bench.instrument.greeting() == [StatusChange(Change.NOT_READY)]
    assert bench.send(Command.INITIALIZE) == [Reply(Command.INITIALIZE, Status.ADM_START_UP_BUSY)]
    bench.run(SURE.warm_up_s + 0.2)
    refused = [Reply(Command.START_MEASUREMENT, Status.TRACKER_NOT_INITIALIZED)]
    assert bench.send(Command.START_MEASUREMENT) == refused

    assert bench.send(Command.INITIALIZE) == [StatusChange(Change.BUSY)]
    events, took = bench.run_until_idle()
    assert took == pytest.approx(SURE.initialise_s, abs=0.11)
    assert events == [
        Reply(Command.INITIALIZE),
        StatusChange(Change.INITIALIZATION),
        StatusChange(Change.NOT_READY),
    ]
    refused = [Reply(Command.START_MEASUREMENT, Status.MEASUREMENT_STATUS_NOT_READY)]
    assert bench.send(Command.START_MEASUREMENT) == refused

    bench.instrument.handle(METRES)
    bench.send(Command.FIND_REFLECTOR, 2.0)
    events, _ = bench.run_until_idle()
    assert events == [Reply(Command.FIND_REFLECTOR), StatusChange(Change.READY)]
    assert bench.instrument.locked


def test_errors_are_those_of_the_data_sheet():
    """Sample spreads against the stated ones; each comparison fails 1 run in about 10^4."""
    seed, n = 20240, 400
    bench = Bench(seed=seed).locked()
    distance = np.linalg.norm(MARKER)
    range_std = 0.5 * (10e-6 + 0.3e-6 * distance)
    across_std = 0.5 * (15e-6 + 6e-6 * distance)
    across, along, results = [], [], []
    for _ in range(n):
        bench.send(Command.START_MEASUREMENT)
        events, _ = bench.run_until_idle()
        (result,) = (e for e in events if isinstance(e, Measurement))
        results.append(result)
        a, b = across_and_along(np.array(result.values) - MARKER, MARKER)
        across.append(a)
        along.append(b)
    # A variance of n samples has a relative standard deviation of sqrt(2/n); 4 of them here.
    assert np.mean(np.square(along)) / range_std**2 == pytest.approx(1, abs=4 * np.sqrt(2 / n)), (
        f'seed {seed}'
    )
    assert np.mean(np.square(across)) / (2 * across_std**2) == pytest.approx(
        1, abs=4 * np.sqrt(1 / n)
    ), f'seed {seed}'
    total = np.sqrt(range_std**2 + 2 * across_std**2)
    assert results[0].std_total == pytest.approx(total)
    assert np.linalg.norm(results[0].std) == pytest.approx(total)


def test_result_comes_in_the_unit_set_and_with_the_air():
    bench = Bench().locked()
    bench.send(Command.SET_UNITS, 1, 0, 0, 0, 0)
    bench.send(Command.SET_ENVIRONMENT, 23.5, 990.0, 30.0)
    bench.send(Command.START_MEASUREMENT)
    events, took = bench.run_until_idle()
    (result,) = (e for e in events if isinstance(e, Measurement))
    assert took == pytest.approx(1.0, abs=0.11)
    np.testing.assert_allclose(result.values, MARKER * 1e3, atol=0.1)
    assert result.std_total < 0.05
    assert (result.temperature, result.pressure, result.humidity) == (23.5, 990.0, 30.0)


def test_a_second_command_while_busy_is_refused():
    bench = Bench().locked()
    bench.send(Command.START_MEASUREMENT)
    for command, values in [
        (Command.START_MEASUREMENT, ()),
        (Command.FIND_REFLECTOR, (2.0,)),
        (Command.SET_UNITS, (0, 0, 0, 0, 0)),
    ]:
        assert bench.send(command, *values) == [Reply(command, Status.SERVER_BUSY)]
    assert bench.send(Command.GET_TRACKER_STATUS) == [Reply(Command.GET_TRACKER_STATUS, 0, (1,))]
    events, _ = bench.run_until_idle()
    assert sum(isinstance(e, Measurement) for e in events) == 1


def test_a_moving_target_is_refused_and_the_beam_follows_it():
    world = ReflectorWorld()
    bench = Bench(world).locked()
    start = bench.t
    world.path = lambda t: MARKER + np.array([0, 0, 1e-3 * (t - start)])
    bench.send(Command.START_MEASUREMENT)
    events, _ = bench.run_until_idle()
    assert events == [
        ErrorReport(Command.START_MEASUREMENT, Status.SENSOR_NOT_STABLE),
        StatusChange(Change.READY),
    ]
    bench.run(200.0)  # far more than a search radius away
    assert bench.instrument.locked


def test_a_hidden_reflector_breaks_the_beam_for_good():
    world = ReflectorWorld()
    bench = Bench(world).locked()
    world.visible = False
    assert bench.run(1.0) == [StatusChange(Change.NOT_READY)]
    world.visible = True
    assert bench.run(5.0) == []
    assert not bench.instrument.locked


def test_beam_broken_while_measuring_gives_no_result():
    bench = Bench().locked()
    bench.send(Command.START_MEASUREMENT)
    bench.run(0.3)
    assert bench.instrument.break_beam() == []
    events, _ = bench.run_until_idle()
    assert events == [
        ErrorReport(Command.START_MEASUREMENT, Status.MEASUREMENT_STATUS_NOT_READY),
        StatusChange(Change.NOT_READY),
    ]


@pytest.mark.parametrize(('speed', 'locked'), [(3.5, True), (4.5, False)])
def test_a_reflector_faster_than_the_beam_is_lost(speed, locked):
    world = ReflectorWorld()
    bench = Bench(world).locked()
    across = np.cross(MARKER, [0, 0, 1.0])
    across *= speed / np.linalg.norm(across)
    start = bench.t
    world.path = lambda t: MARKER + across * (t - start)
    bench.run(0.2)
    assert bench.instrument.locked is locked


@pytest.mark.parametrize(
    ('joint_travel', 'share', 'locked'), [(1.4, 1.0, True), (1.8, 1.0, False), (1.8, 0.0, True)]
)
def test_large_reconfigurations_break_the_beam(joint_travel, share, locked):
    world = ReflectorWorld()
    behaviour = TrackerBehaviour(search_failure_share=0.0, large_move_break_share=share)
    bench = Bench(world, behaviour).locked()
    for _ in range(3):
        end = bench.t + joint_travel
        world.speed = lambda t, end=end: 1.0 if t <= end else 0.0
        bench.run(joint_travel + 1.0)
    assert bench.instrument.locked is locked


def find_from(offset_m: float, radius_m: float, timeout_s: float = 20.0) -> tuple[bool, float]:
    """Search for a reflector that is off the aim by so much; return whether found, and when."""
    across = np.cross(MARKER, [0, 0, 1.0])
    distance = np.linalg.norm(MARKER)
    turn = np.tan(offset_m / distance) * distance
    world = ReflectorWorld(lambda t: MARKER + turn * across / np.linalg.norm(across))
    bench = Bench(world, aim=MARKER).initialised()
    bench.send(Command.SET_SEARCH, radius_m, round(1e3 * timeout_s))
    bench.send(Command.FIND_REFLECTOR, float(distance))
    events, took = bench.run_until_idle()
    status = Status.ALL_OK if bench.instrument.locked else Status.MEASUREMENT_STATUS_NOT_READY
    assert events[0] == Reply(Command.FIND_REFLECTOR, status)
    return bench.instrument.locked, took


def test_search_takes_longer_the_further_away():
    near_result, middle, far = (find_from(offset, 0.6) for offset in (0.05, 0.2, 0.5))
    assert [found for found, _ in (near_result, middle, far)] == [True] * 3
    assert 1.0 < near_result[1] < middle[1] < far[1] < 20.0


def test_search_ends_at_its_radius_and_at_its_time_out():
    assert find_from(0.19, 0.2)[0]
    assert not find_from(0.21, 0.2)[0]
    found, took = find_from(0.5, 0.6, timeout_s=3.0)
    assert not found
    assert took < 3.6


def test_go_position_finds_what_the_present_aim_is_far_from():
    bench = Bench(aim=np.array([0.0, -2.0, 0.0])).initialised()
    bench.send(Command.FIND_REFLECTOR, 2.0)
    bench.run_until_idle()
    assert not bench.instrument.locked
    bench.send(Command.GO_POSITION, *(MARKER + np.array([0.0, 0.01, 0.02])), 1)
    bench.run_until_idle()
    assert bench.instrument.locked


def test_search_fails_now_and_then():
    """Share 0.5 of 40: outside 8 to 32 once in 10^4 seeds."""
    behaviour = TrackerBehaviour(search_failure_share=0.5)
    seed = 7
    bench = Bench(behaviour=behaviour, seed=seed).initialised()
    found = 0
    for _ in range(40):
        bench.send(Command.FIND_REFLECTOR, 2.0)
        bench.run_until_idle()
        found += bench.instrument.locked
    assert 8 <= found <= 32, f'seed {seed}'


@pytest.mark.parametrize(
    ('command', 'values', 'status'),
    [
        (Command.SET_UNITS, (9, 0, 0, 0, 0), Status.NOT_IMPLEMENTED),
        (Command.SET_COORDINATE_SYSTEM_TYPE, (7,), Status.NOT_IMPLEMENTED),
        (Command.SET_MEASUREMENT_MODE, (1,), Status.NOT_IMPLEMENTED),
        (Command.SET_REFLECTOR, (17,), Status.WRONG_PARAMETER_1),
        (Command.SET_SEARCH, (-1.0, 1000), Status.WRONG_PARAMETER),
        (Command.SET_STATIONARY_MODE, (0, 1), Status.WRONG_PARAMETER),
        (Command.SET_ENVIRONMENT, (20.0, 10.0, 50.0), Status.METEO_DATA_OUT_OF_RANGE),
        (Command.SET_ENVIRONMENT, (np.nan, 1000.0, 50.0), Status.INVALID_INPUT_DATA),
        (Command.GO_POSITION, (np.inf, 0.0, 0.0, 1), Status.INVALID_INPUT_DATA),
        (Command.GO_POSITION, (0.0, 0.0, 0.0, 1), Status.WRONG_PARAMETER),
        (Command.FIND_REFLECTOR, (-1.0,), Status.WRONG_PARAMETER_1),
        (Command.GET_DIRECTION, (), Status.NOT_IMPLEMENTED),
    ],
)
def test_what_it_cannot_do_is_refused(command, values, status):
    assert Bench().locked().send(command, *values) == [Reply(command, status)]


def test_search_radius_keeps_its_length_when_the_unit_changes():
    bench = Bench().locked()
    bench.send(Command.SET_SEARCH, 0.04, 8000)
    bench.send(Command.SET_UNITS, 1, 0, 0, 0, 0)
    ((radius, timeout_ms),) = (e.values for e in bench.send(Command.GET_SEARCH))
    assert radius == pytest.approx(40.0)
    assert timeout_ms == 8000


def test_a_long_sleep_of_the_process_is_caught_up_in_bounded_work():
    world = ReflectorWorld()
    bench = Bench(world).locked()
    looks = []
    world.path = lambda t: looks.append(t) or MARKER
    bench.run(1e6)
    assert len(looks) < 200
    assert bench.instrument.locked
