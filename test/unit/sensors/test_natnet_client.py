# SPDX-License-Identifier: Apache-2.0
"""The OptiTrack client on real sockets, against the fake server."""

import socket
import struct
from dataclasses import replace

import numpy as np
import pytest
from rigs.natnet_rig import LOCAL, NOISELESS, client_of, fake_server, followed
from worlds.optitrack_world import RATE, MarkerWorld, eventually, free_port, nothing_left

from remaster_ros.errors import DeviceError, InputError
from remaster_ros.sensors.optitrack import natnet
from remaster_ros.sensors.optitrack.client import NatNetClient
from remaster_ros.sensors.optitrack.frame_gate import Dropped, MarkerChoice
from remaster_ros.sensors.optitrack.settings import NatNetSettings
from remaster_ros.simulation.optitrack_scene import OptiTrackBehaviour


@pytest.fixture
def data_port():
    return free_port()


@pytest.mark.parametrize('transport', ['unicast', 'multicast'])
@pytest.mark.parametrize('version', [(2, 6), (2, 10), (3, 1), (4, 1), (4, 3)])
def test_readings_are_where_the_marker_was(version, transport):
    samples = []
    world = MarkerWorld()
    start = world.now()
    options = {'version': version, 'transport': transport, 'behaviour': NOISELESS, 'world': world}
    how = {'transport': transport, 'clock': world.now}
    with followed(samples.append, options, **how) as (_, client):
        assert eventually(lambda: len(samples) >= 20)
        assert client.diagnosis().fault == 'none', client.diagnosis()
        status = client.status()
    assert (status.version, status.marker_id) == (version, 65537)
    # The scene began between `start` and the first frame: find its zero from the first reading.
    times = np.array([sample.timestamp_s for sample in samples])
    positions = np.array([sample.position for sample in samples])
    # A busy machine may leave more than a whole turn between two readings.
    turned = np.diff(np.arctan2(positions[:, 1], positions[:, 0])) - np.diff(times)
    np.testing.assert_allclose(np.exp(1j * turned), 1.0, atol=1e-4)
    np.testing.assert_allclose(np.hypot(positions[:, 0], positions[:, 1]), 0.3, atol=1e-6)
    np.testing.assert_allclose(positions[:, 2], 2.0, atol=1e-6)
    assert (np.diff([sample.frame_number for sample in samples]) >= 1).all()
    received = np.array([sample.received_s for sample in samples])
    assert (received >= start + times).all(), 'no reading arrives before it was taken'


def test_hidden_markers_never_become_readings():
    """Model-filled positions are 0.5 m off here: a single one that passed would show."""
    seen = []
    hides = OptiTrackBehaviour(occlusions_per_s=2.0, occlusion_s=0.3, guess_error_m=0.5)
    with followed(seen.append, {'behaviour': hides, 'rate_hz': 100.0}) as (_, client):
        hidden = (Dropped.OCCLUDED, Dropped.MODEL_FILLED)
        assert eventually(lambda: all(client.status().dropped[r] > 10 for r in hidden))
        assert eventually(lambda: len(seen) > 100)
    radii = [np.hypot(*sample.position[:2]) for sample in seen]
    np.testing.assert_allclose(radii, 0.3, atol=6 * 25e-6)


def test_a_blocked_line_of_sight_is_named():
    world = MarkerWorld()
    with followed(server={'world': world}) as (_, client):
        assert eventually(lambda: client.diagnosis().fault == 'none')
        world.visible = False
        assert eventually(lambda: client.diagnosis().fault == 'marker')
        assert 'hidden' in client.diagnosis().message
        world.visible = True
        assert eventually(lambda: client.diagnosis().fault == 'none')


@pytest.mark.parametrize(
    ('version', 'wanted', 'agreed'),
    [
        ((4, 1), '3.1', (3, 1)),
        ((4, 1), '4.1', (4, 1)),
        ((4, 1), '4.3', (4, 1)),
        ((4, 1), '2.10', (4, 1)),
        # A server that does not negotiate is read in its own version.
        ((3, 1), '4.1', (3, 1)),
    ],
)
def test_the_wanted_bitstream_is_negotiated(version, wanted, agreed):
    samples, server = [], {'version': version, 'transport': 'unicast'}
    how = {'transport': 'unicast', 'bitstream': wanted}
    with followed(samples.append, server, **how) as (_, client):
        assert eventually(lambda: samples)
        assert client.status().version == agreed


@pytest.mark.parametrize('transport', ['unicast', 'multicast'])
def test_a_restarted_server_of_another_version_is_followed(transport, data_port):
    samples = []
    port = free_port()
    with client_of(port, data_port, samples.append, wait_s=0, transport=transport) as client:
        for version in ((3, 1), (4, 1), (2, 10)):
            before = len(samples)
            with fake_server(data_port, port, version=version, transport=transport):
                assert eventually(lambda: len(samples) > before + 5), version  # noqa: B023
                assert client.status().version == version
        assert eventually(lambda: client.diagnosis().fault == 'silence')


def test_the_server_forgets_a_client_that_says_goodbye_or_nothing(data_port):
    with fake_server(data_port, transport='unicast', client_timeout_s=0.5) as server:
        with client_of(server.command_port, data_port, transport='unicast'):
            assert len(server.clients) == 1
        assert eventually(lambda: not server.clients), 'DISCONNECT'
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute:
            mute.settimeout(20.0)
            mute.sendto(struct.pack('<2H', 0, 0), (LOCAL, server.command_port))
            while natnet.split_datagram(mute.recv(65536))[0] != 11:
                pass
            assert not server.clients


@pytest.mark.parametrize('transport', ['unicast', 'multicast'])
def test_a_client_of_a_unicast_server_keeps_itself_alive(transport):
    """Also one that is set to multicast: the frames come to its command socket."""
    with followed(
        server={'transport': 'unicast', 'client_timeout_s': 1.5}, transport=transport
    ) as (server, client):
        frames = client.status().frames
        assert eventually(lambda: client.status().frames > frames + 4 * 30 * RATE / 2)
        assert client.status().restarts == 0
        assert server.clients


@pytest.mark.parametrize(
    ('settings', 'server_options', 'text'),
    [
        ({'transport': 'unicast'}, {}, 'set transport to multicast'),
        ({'multicast_group': '239.1.2.3'}, {}, 'set multicast_group'),
        ({'marker': MarkerChoice(rigid_body='tol')}, {}, 'the server streams: tool'),
        ({}, {'version': (2, 10), 'multicast_group': '239.4.5.6'}, 'local_interface the card'),
    ],
)
def test_a_wrong_setting_is_named_at_start(settings, server_options, text):
    with (
        pytest.raises(DeviceError, match=text),
        followed(server=server_options, wait_s=1.5, **settings),
    ):
        pass


def test_a_wrong_data_port_is_named(data_port):
    with (
        fake_server(data_port) as server,
        pytest.raises(DeviceError, match=f'streams to UDP port {data_port}'),
        client_of(server.command_port, free_port(), wait_s=1.5),
    ):
        pass


def test_a_server_that_never_answers_is_named_in_time():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.bind((LOCAL, 0))
        port = deaf.getsockname()[1]
        with (
            nothing_left(),
            pytest.raises(DeviceError, match=f'no answer from 127.0.0.1:{port}'),
            client_of(port, free_port(), wait_s=1.0),
        ):
            pass
    with (
        pytest.raises(DeviceError, match=f'nothing listens on UDP port {port}'),
        client_of(port, free_port(), wait_s=1.0),
    ):
        pass


@pytest.mark.parametrize(
    ('settings', 'text'),
    [
        ({'server': 'no-such-host.invalid'}, 'server: .* is not known'),
        ({'local_interface': '192.0.2.123'}, 'no address of this machine'),
    ],
)
def test_an_address_that_cannot_be_used_is_named(settings, text, data_port):
    with pytest.raises(DeviceError, match=text):
        NatNetClient(NatNetSettings(data_port=data_port, **settings), print).start()


def test_ports_in_use_are_named(data_port):
    group = natnet.DEFAULT_MULTICAST_GROUP
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as selfish:
        selfish.bind((group, data_port))
        in_use = pytest.raises(DeviceError, match=f'UDP port {data_port} .* is in use')
        with nothing_left(), in_use:
            NatNetClient(NatNetSettings(data_port=data_port), print).start()
    with (
        fake_server(data_port) as server,
        pytest.raises(DeviceError, match=f'UDP port {server.command_port} .* set command_port'),
        fake_server(data_port, server.command_port),
    ):
        pass


def test_stopping_leaves_nothing_behind():
    with nothing_left():
        for _ in range(3):
            with followed() as (_server, client):
                pass
            client.stop()  # a second time


class BodyWorld(MarkerWorld):
    """A body of three markers that keeps its orientation."""

    def __init__(self):
        super().__init__()
        self.places = {'': np.zeros(3), 'b': np.array([0.1, 0, 0]), 'c': np.array([0, 0.07, 0])}

    def marker_in_sensor(self, sensor, t, marker=''):
        return super().marker_in_sensor(sensor, t) + self.places[marker]


@pytest.mark.parametrize('version', [(2, 10), (3, 1), (4, 1)])
def test_all_markers_of_a_frame_are_read_and_a_hidden_one_hides_no_other(version):
    """Any of them may be hidden, also the one that is followed; the others are where they were."""
    samples, world = [], BodyWorld()
    # The numbers in the body leave one out.
    further = {'b': 2, 'c': 4}
    behaviour = replace(NOISELESS, further=further)
    options = {'version': version, 'world': world, 'behaviour': behaviour}
    how = {'clock': world.now, 'further_markers': further}

    def names_seen():
        count = len(samples)
        assert eventually(lambda: len(samples) > count + 12)
        seen = list(samples)
        # The last frame may be cut off; a busy machine may leave out the one before it.
        frame = max(s.frame_number for s in seen if s.frame_number < seen[-1].frame_number)
        return {
            s.marker for s in seen if s.frame_number == frame and np.all(s.position == s.position)
        }

    with followed(samples.append, options, **how) as (_, client):
        assert names_seen() == {'', 'b', 'c'}
        for number, names in ((1, {'b', 'c'}), (4, {'', 'b'})):
            world.faulty = {'hidden': number}
            assert names_seen() == names
            assert client.diagnosis().fault == 'none', client.diagnosis()
        counts = client.further_counts()
    assert counts['c'].dropped[Dropped.OCCLUDED] > 0
    assert not any(counts['b'].dropped.values())
    frames = {}
    for sample in samples:
        frame = frames.setdefault(sample.frame_number, {})
        assert sample.marker not in frame
        frame[sample.marker] = sample
    # The last frame may be cut off.
    frames.popitem()
    for frame in frames.values():
        assert frame.keys() == {'', 'b', 'c'}
        assert len({(s.timestamp_s, s.age_s, s.received_s) for s in frame.values()}) == 1
        for name, sample in frame.items():
            offset = sample.position - frame[''].position
            if np.all(np.isfinite(offset)):
                # The wire has 32-bit numbers.
                np.testing.assert_allclose(offset, world.places[name], atol=1e-6)


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        ({'further_markers': {'b': 1}}, 'has the number 1, which is that of its marker'),
        ({'further_markers': {'b': 2, 'c': 2}}, 'has the number 2, which is that of b'),
        (
            {'further_markers': {'b': 2}, 'marker': MarkerChoice(lone_marker=True)},
            'a lone marker belongs to no rigid body',
        ),
    ],
)
def test_markers_that_cannot_be_told_apart_are_refused(options, words):
    with pytest.raises(InputError, match=words):
        NatNetClient(NatNetSettings(**options), lambda sample: None)


def test_an_id_on_the_wire_gives_the_body_of_the_further_markers():
    choice = MarkerChoice(marker_id=7 << 16 | 3)
    choices = NatNetSettings(marker=choice, further_markers={'b': 5}).choices()
    assert [found.marker_id for found in choices.values()] == [7 << 16 | 3, 7 << 16 | 5]
