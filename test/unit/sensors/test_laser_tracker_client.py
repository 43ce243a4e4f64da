# SPDX-License-Identifier: Apache-2.0
"""The driver against the fake tracker over real sockets."""

import contextlib
import dataclasses
import socket
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from worlds.optitrack_world import nothing_left
from worlds.tracker_world import MARKER, ReflectorWorld, across_and_along, wait_for

from remaster_ros.errors import DeviceError, InputError
from remaster_ros.sensors.laser_tracker.client import LaserTrackerClient
from remaster_ros.sensors.laser_tracker.codes import Status
from remaster_ros.sensors.laser_tracker.link import (
    LaserTrackerError,
    LaserTrackerSettings,
    TrackerStatus,
)
from remaster_ros.simulation.laser_tracker import FakeLaserTracker
from remaster_ros.simulation.laser_tracker_behaviour import TrackerBehaviour

QUICK = TrackerBehaviour(warm_up_s=0.5, initialise_s=0.5, search_failure_share=0.0)


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
    with bench(settings=LaserTrackerSettings(integration_s=0.5)) as (world, _fake, client):
        assert client.status is TrackerStatus.NOT_READY
        client.find_reflector()
        assert client.request_status() is TrackerStatus.READY
        before = world.now()
        reading = client.measure()
        after = world.now()
    across, along = across_and_along(reading.position - MARKER, MARKER)
    assert across < 6 * 14e-6 * np.sqrt(2)
    assert abs(along) < 6 * 6e-6
    assert before < reading.stamp_s < after
    assert reading.temperature_c == 20.0


def test_an_initialised_instrument_keeps_its_lock_for_the_next_client():
    with bench() as (world, fake, client):
        client.go_position(MARKER)
        client.close()
        assert client.status is TrackerStatus.DISCONNECTED
        with client_of(fake.address, world) as second:
            assert second.status is TrackerStatus.READY
            second.measure()


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
    with bench() as (world, _fake, client):
        client.ensure_locked()
        replies = client.counts['measurements']
        world.faulty = {'cut': after_bytes}
        with pytest.raises(LaserTrackerError, match='connect again') as caught:
            client.measure()
        assert caught.value.status is None
        assert client.status is TrackerStatus.DISCONNECTED
        world.faulty = {}
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
    with nothing_left(), bench() as (_world, _fake, client):
        for _ in range(5):
            client.close()
            client.connect()


@pytest.mark.parametrize('position', [(1, 2), (np.nan, 0, 0), 'here'])
def test_positions_that_are_none_are_refused_before_they_are_sent(position):
    client = LaserTrackerClient('127.0.0.1')
    with pytest.raises(InputError, match='three finite numbers'):
        client.go_position(position)


@pytest.mark.parametrize('name', ['integration_s', 'search_radius_m', 'reply_timeout_s'])
def test_settings_out_of_range_name_themselves(name):
    with pytest.raises(InputError, match=name):
        LaserTrackerSettings(**{name: 0.0})
