# SPDX-License-Identifier: Apache-2.0
"""The driver against scripted peers over real sockets: what no instrument should do."""

import contextlib
import dataclasses
import socket
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from worlds.tracker_world import wait_for

from remaster_ros.errors import DeviceError
from remaster_ros.sensors.laser_tracker.client import LaserTrackerClient
from remaster_ros.sensors.laser_tracker.codes import Change, Command
from remaster_ros.sensors.laser_tracker.link import LaserTrackerError, LaserTrackerSettings
from remaster_ros.sensors.laser_tracker.packets import (
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
