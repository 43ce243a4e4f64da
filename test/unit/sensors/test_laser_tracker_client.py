"""The driver against the fake tracker, and against scripted peers, over real sockets."""

from __future__ import annotations

import contextlib
import dataclasses
import socket
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from tracker_world import MARKER, ReflectorWorld, across_and_along

from remaster_ros.errors import DeviceError, InputError
from remaster_ros.sensors.laser_tracker.client import LaserTrackerClient
from remaster_ros.sensors.laser_tracker.link import LaserTrackerError
from remaster_ros.sensors.laser_tracker.protocol.codes import Change, Command, Status
from remaster_ros.sensors.laser_tracker.protocol.packets import (
    NEED_DATA,
    ErrorReport,
    Event,
    Measurement,
    PacketReader,
    Reply,
    Request,
    StatusChange,
    UnknownPacket,
    encode,
)
from remaster_ros.sensors.laser_tracker.settings import (
    Environment,
    LaserTrackerSettings,
    TrackerStatus,
)
from remaster_ros.simulation.laser_tracker import FakeLaserTracker
from remaster_ros.simulation.laser_tracker_settings import TrackerBehaviour

QUICK = TrackerBehaviour(warm_up_s=0.5, initialise_s=0.5, search_failure_share=0.0)


def wait_for(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, 'waited in vain'
        time.sleep(0.005)


@contextlib.contextmanager
def bench(
    world: ReflectorWorld | None = None,
    behaviour: TrackerBehaviour = QUICK,
    settings: LaserTrackerSettings | None = None,
) -> Iterator[tuple[ReflectorWorld, FakeLaserTracker, LaserTrackerClient]]:
    """Run a fake and a connected, initialised client."""
    world = world or ReflectorWorld()
    with FakeLaserTracker(world, 'tracker', np.random.default_rng(3), behaviour=behaviour) as fake:
        with client_of(fake.address, world, settings) as client:
            yield world, fake, client


def client_of(address, world, settings=None) -> LaserTrackerClient:
    return LaserTrackerClient(*address, settings=settings, now=world.now, sleep=world.sleep)


def test_warm_up_search_and_measurement():
    """Errors within 6 standard deviations: fails less than once in 10^7 runs."""
    settings = LaserTrackerSettings(
        reflector_id=2, environment=Environment(22.0, 1000.0, 40.0), integration_s=0.5
    )
    with bench(settings=settings) as (world, _fake, client):
        assert client.status is TrackerStatus.NOT_READY
        client.find_reflector(2.1)
        assert client.request_status() is TrackerStatus.READY
        before = world.now()
        reading = client.measure()
        after = world.now()
    across, along = across_and_along(reading.position - MARKER, MARKER)
    assert across < 6 * 14e-6 * np.sqrt(2)
    assert abs(along) < 6 * 6e-6
    assert before < reading.stamp_s < after
    assert 0 < np.linalg.norm(reading.std) < 50e-6
    air = (reading.temperature_c, reading.pressure_hpa, reading.humidity_percent)
    assert air == (22.0, 1000.0, 40.0)


def test_an_initialised_instrument_keeps_its_lock_for_the_next_client():
    with bench() as (world, fake, client):
        client.go_position(MARKER)
        client.close()
        assert client.status is TrackerStatus.DISCONNECTED
        with client_of(fake.address, world) as second:
            assert second.status is TrackerStatus.READY
            second.measure()
            second.initialise(force=True)
            assert second.status is TrackerStatus.NOT_READY


def test_beam_break_then_go_position_then_measure():
    with bench() as (world, fake, client):
        assert client.ensure_locked(MARKER + 0.005) == 1
        client.measure()
        fake.break_beam()
        wait_for(lambda: client.status is TrackerStatus.NOT_READY)
        with pytest.raises(LaserTrackerError, match=r'\(10004\).*line of sight') as caught:
            client.measure()
        assert caught.value.status == Status.MEASUREMENT_STATUS_NOT_READY
        world.path = lambda t: MARKER + np.array([0.0, 0.4, 0.1])
        client.go_position(world.path(0))
        np.testing.assert_allclose(client.measure().position, world.path(0), atol=200e-6)
        counts = client.counts
    assert counts['beam_breaks'] == 1
    assert counts['measurements'] == 2
    assert counts['measurements_failed'] == 1


def test_ensure_locked_counts_its_searches_and_gives_up_in_one_line():
    with bench() as (world, _fake, client):
        assert client.ensure_locked() == 1
        assert client.ensure_locked() == 0
        world.visible = False
        wait_for(lambda: client.status is TrackerStatus.NOT_READY)
        with pytest.raises(DeviceError, match='no reflector locked in 2 searches') as caught:
            client.ensure_locked(MARKER, attempts=2)
        assert '\n' not in str(caught.value)
        assert client.counts['searches_failed'] == 2
        world.visible = True
        assert client.ensure_locked(MARKER) == 1


def test_a_moving_target_is_refused():
    with bench() as (world, _fake, client):
        client.ensure_locked()
        start = world.now()
        world.path = lambda t: MARKER + np.array([0, 0, 1e-3 * (t - start)])
        with pytest.raises(LaserTrackerError, match=r'\(10013\).*settled') as caught:
            client.measure()
        assert caught.value.status == Status.SENSOR_NOT_STABLE
        world.path = lambda t: MARKER
        client.measure()


def test_a_second_command_of_the_same_client_is_refused_as_busy():
    slow = LaserTrackerSettings(integration_s=8.0)
    with bench(settings=slow) as (_world, _fake, client):
        client.ensure_locked()
        readings = []
        thread = threading.Thread(target=lambda: readings.append(client.measure()))
        thread.start()
        wait_for(lambda: client.status is TrackerStatus.BUSY)
        with pytest.raises(LaserTrackerError, match='busy with the measurement') as caught:
            client.measure()
        assert caught.value.status == Status.SERVER_BUSY
        thread.join()
        assert len(readings) == 1


def test_a_second_program_is_sent_away():
    with bench() as (world, fake, client):
        second = client_of(fake.address, world)
        with pytest.raises(LaserTrackerError, match=r'\(10011\).*close that program'):
            second.connect()
        assert not second.connected
        client.ensure_locked()


def test_measurement_before_the_search_and_before_initialisation():
    world = ReflectorWorld()
    with FakeLaserTracker(world, 'tracker', np.random.default_rng(1), behaviour=QUICK) as fake:
        client = client_of(fake.address, world)
        client.connect()
        with pytest.raises(LaserTrackerError, match=r'not initialised|warming up'):
            client.measure()
        client.initialise()
        with pytest.raises(LaserTrackerError, match=r'\(10004\)'):
            client.measure()
        client.close()


def test_warm_up_that_lasts_too_long():
    settings = LaserTrackerSettings(initialise_timeout_s=4.0)
    world = ReflectorWorld()
    cold = dataclasses.replace(QUICK, warm_up_s=1e4)
    with FakeLaserTracker(world, 'tracker', np.random.default_rng(1), behaviour=cold) as fake:
        client = client_of(fake.address, world, settings)
        client.connect()
        with pytest.raises(LaserTrackerError, match=r'\(10005\).*two hours'):
            client.initialise()
        client.close()


@pytest.mark.parametrize('after_bytes', [1, 7, 40, 155])
def test_connection_cut_in_mid_packet_then_reconnect(after_bytes):
    with bench() as (_world, fake, client):
        client.ensure_locked()
        replies = client.counts['measurements']
        fake.cut_next_packet(after_bytes)
        with pytest.raises(LaserTrackerError, match='connect again') as caught:
            client.measure()
        assert caught.value.status is None
        assert client.status is TrackerStatus.DISCONNECTED
        with pytest.raises(LaserTrackerError, match='connect again'):
            client.ensure_locked(MARKER)
        client.connect()
        client.initialise()
        client.ensure_locked(MARKER)
        client.measure()
        assert client.counts['connections'] == 2
        assert client.counts['measurements'] == replies + 1


def test_connection_refused():
    with socket.create_server(('127.0.0.1', 0)) as listener:
        address = listener.getsockname()
    with pytest.raises(DeviceError, match=f'127.0.0.1:{address[1]}: connection refused'):
        LaserTrackerClient(*address).connect()


def test_host_without_an_address():
    with pytest.raises(DeviceError, match='check the address'):
        LaserTrackerClient('tracker.invalid').connect()


def test_port_in_use():
    world = ReflectorWorld()
    with socket.create_server(('127.0.0.1', 0)) as listener:
        port = listener.getsockname()[1]
        fake = FakeLaserTracker(world, 'tracker', np.random.default_rng(1), port=port)
        with pytest.raises(DeviceError, match=f'cannot listen on 127.0.0.1:{port}'):
            fake.start()
        fake.close()


def test_no_thread_or_socket_stays_behind():
    before = threading.active_count()
    with bench() as (_world, _fake, client):
        for _ in range(5):
            client.close()
            client.connect()
    assert threading.active_count() == before


@pytest.mark.parametrize('position', [(1, 2), (np.nan, 0, 0), 'here'])
def test_positions_that_are_none_are_refused_before_they_are_sent(position):
    client = LaserTrackerClient('127.0.0.1')
    with pytest.raises(InputError, match='three finite numbers'):
        client.go_position(position)


@pytest.mark.parametrize('distance', [0.0, -1.0, np.inf])
def test_distances_that_are_none_are_refused_before_they_are_sent(distance):
    with pytest.raises(InputError, match='above 0'):
        LaserTrackerClient('127.0.0.1').find_reflector(distance)


@pytest.mark.parametrize('name', ['integration_s', 'search_radius_m', 'reply_timeout_s'])
def test_settings_out_of_range_name_themselves(name):
    with pytest.raises(InputError, match=name):
        LaserTrackerSettings(**{name: 0.0})


# Scripted peers: what no instrument should do

RESULT = Measurement(
    *(0, 0, 0, (2.0, 0.5, -0.3), (1e-5,) * 3, 2e-5, (0.0,) * 3, (1e-5,) * 3),
    *(2e-5, 20.0, 1013.0, 50.0),
)
READ_BACK: dict[Command, tuple] = {
    Command.GET_TRACKER_STATUS: (2,),
    Command.GET_SYSTEM_STATUS: (0, 5, 3, 2, 3, 8, 500, 0, 0, 1),
    Command.GET_UNITS: (0, 0, 0, 0, 0),
    Command.GET_COORDINATE_SYSTEM_TYPE: (0,),
    Command.GET_MEASUREMENT_MODE: (0,),
}
Script = Callable[[Request], list[Event | bytes]]


def obedient(request: Request) -> list[Event | bytes]:
    answers: list[Event | bytes] = [Reply(request.command, 0, READ_BACK.get(request.command, ()))]
    return answers + ([RESULT] if request.command is Command.START_MEASUREMENT else [])


@contextlib.contextmanager
def scripted(
    script: Script, now: Callable[[], float] = time.monotonic
) -> Iterator[LaserTrackerClient]:
    """Run a peer that answers by a script, and a connected client with short time-outs."""
    listener = socket.create_server(('127.0.0.1', 0))

    def serve() -> None:
        connection, _ = listener.accept()
        reader = PacketReader('server')
        with connection, contextlib.suppress(OSError):
            while data := connection.recv(4096):
                reader.receive_data(data)
                while isinstance(request := reader.next_event(), Request):
                    for answer in script(request):
                        connection.sendall(answer if isinstance(answer, bytes) else encode(answer))
                assert request is NEED_DATA

    thread = threading.Thread(target=serve)
    thread.start()
    settings = LaserTrackerSettings(reply_timeout_s=0.3, integration_s=0.1)
    client = LaserTrackerClient(*listener.getsockname(), settings=settings, now=now)
    try:
        client.connect()
        client.initialise()
        yield client
    finally:
        client.close()
        thread.join()
        listener.close()


def instead(command: Command, *answers: Event | bytes) -> Script:
    """Answer one command in another way."""
    return lambda request: list(answers) if request.command is command else obedient(request)


def test_the_scripted_peer_is_obedient_by_default():
    with scripted(obedient) as client:
        assert client.measure().position == pytest.approx([2.0, 0.5, -0.3])


def test_a_server_that_never_answers():
    listener = socket.create_server(('127.0.0.1', 0))
    settings = LaserTrackerSettings(reply_timeout_s=0.2)
    client = LaserTrackerClient(*listener.getsockname(), settings=settings)
    with listener, pytest.raises(DeviceError, match=r'no answer to the status within 0\.2 s'):
        client.connect()
    assert not client.connected


def test_time_outs_need_wall_time_where_the_clock_runs_fast():
    """At a thousand times the speed an answer after 0.1 s of wall time is no time-out."""

    def slow(request: Request) -> list[Event | bytes]:
        time.sleep(0.1)
        return obedient(request)

    with scripted(slow, now=lambda: 1000 * time.monotonic()) as client:
        client.measure()


def test_a_result_that_stays_away_closes_the_connection():
    """A late result must never be taken for that of the next measurement."""
    with scripted(instead(Command.START_MEASUREMENT, Reply(Command.START_MEASUREMENT))) as client:
        with pytest.raises(LaserTrackerError, match='no answer to the measurement'):
            client.measure(timeout_s=0.2)
        assert not client.connected


def test_a_result_nobody_asked_for_is_not_that_of_the_next_measurement():
    other = dataclasses.replace(RESULT, values=(9.0, 9.0, 9.0))
    script = instead(
        Command.START_MEASUREMENT, other, Reply(Command.START_MEASUREMENT), RESULT, other
    )
    with scripted(script) as client:
        assert client.measure().position == pytest.approx(RESULT.values)
        wait_for(lambda: client.counts['unexpected_packets'] >= 2)


@pytest.mark.parametrize(
    ('answers', 'words'),
    [
        ([dataclasses.replace(RESULT, values=(np.nan, 0.0, 0.0))], 'no place within 200 m'),
        ([dataclasses.replace(RESULT, values=(2000.0, 0.0, 0.0))], 'no place within 200 m'),
        ([dataclasses.replace(RESULT, std=(0.0, np.inf, 0.0))], 'no place within 200 m'),
        ([dataclasses.replace(RESULT, status=10009)], r'\(10009\)'),
        ([ErrorReport(Command.START_MEASUREMENT, 10013)], r'\(10013\)'),
        ([ErrorReport(Command.UNKNOWN, 98)], r'\(98\)'),
        ([ErrorReport(Command.START_MEASUREMENT, 4711)], 'result status 4711'),
    ],
)
def test_results_that_are_none(answers, words):
    script = instead(Command.START_MEASUREMENT, Reply(Command.START_MEASUREMENT), *answers)
    with scripted(script) as client:
        with pytest.raises(LaserTrackerError, match=words):
            client.measure()
        assert client.connected


def test_strange_packets_are_counted_and_change_nothing():
    noise = [
        UnknownPacket(7, bytes(28)),
        StatusChange(123456),
        b'\x10\0\0\0\x08\0\0\0' + bytes(8),  # a status change of the wrong size
        ErrorReport(Command.FIND_REFLECTOR, 10004),  # about a command that is not under way
        Reply(Command.GET_FACE, 0, (1,)),
    ]
    script = instead(
        Command.START_MEASUREMENT, *noise, Reply(Command.START_MEASUREMENT), *noise, RESULT
    )
    with scripted(script) as client:
        client.measure()
        counts = client.counts
    assert counts['bad_packets'] == 2
    assert counts['unknown_packets'] == 2
    assert counts['unexpected_packets'] == 4


def test_bytes_that_are_no_packets_end_the_connection():
    with scripted(instead(Command.START_MEASUREMENT, b'HTTP/1.1 200 OK\r\n')) as client:
        with pytest.raises(LaserTrackerError, match=r'not emScon.*connect again'):
            client.measure()
        assert client.counts['bad_packets'] == 1
        assert not client.connected


def test_an_instrument_that_never_stops_talking_holds_nobody():
    chatter = [Reply(Command.GET_FACE, 0, (1,))] * 50

    def babble(request: Request) -> list[Event | bytes]:
        if request.command is not Command.START_MEASUREMENT:
            return obedient(request)
        time.sleep(0.02)
        return chatter * 100

    with scripted(babble) as client:
        with pytest.raises(LaserTrackerError, match='no answer'):
            client.measure(timeout_s=0.3)


def test_units_changed_by_another_program_are_noticed():
    changed = False

    def script(request: Request) -> list[Event | bytes]:
        nonlocal changed
        if request.command is Command.START_MEASUREMENT:
            changed = True
            return [Reply(request.command), StatusChange(Change.UNITS), RESULT]
        if request.command is Command.GET_UNITS and changed:
            return [Reply(request.command, 0, (1, 0, 0, 0, 0))]
        return obedient(request)

    with scripted(script) as client:
        with pytest.raises(LaserTrackerError, match=r'units .* changed by another program'):
            client.measure()


def test_a_busy_instrument_is_waited_for():
    readiness = iter([2, 2, 1, 1, 1])

    def script(request: Request) -> list[Event | bytes]:
        if request.command is Command.GET_TRACKER_STATUS:
            return [Reply(request.command, 0, (next(readiness, 2),))]
        return obedient(request)

    with scripted(script) as client:
        assert client.ensure_locked() == 0


def test_close_wakes_who_waits():
    script = instead(Command.START_MEASUREMENT, Reply(Command.START_MEASUREMENT))
    with scripted(script) as client:
        caught: list[BaseException] = []

        def measure() -> None:
            try:
                client.measure(timeout_s=60.0)
            except LaserTrackerError as error:
                caught.append(error)

        thread = threading.Thread(target=measure)
        thread.start()
        time.sleep(0.1)
        client.close()
        thread.join(5.0)
        assert not thread.is_alive()
        assert 'closed by this program' in str(caught[0])
