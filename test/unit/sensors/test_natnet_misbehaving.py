# SPDX-License-Identifier: Apache-2.0
"""The OptiTrack client against a server that sends exactly what a test wants sent."""

import socket
import time

import numpy as np
import pytest
from hostile.fuzz_messages import full_frame
from hostile.fuzzing import DatagramSource
from rigs.natnet_rig import LOCAL, client_of
from worlds.optitrack_world import eventually

from remaster_ros.sensors.optitrack import client as natnet_client
from remaster_ros.sensors.optitrack import natnet
from remaster_ros.sensors.optitrack.client import NatNetClient, _is_of_others
from remaster_ros.sensors.optitrack.frame_gate import Dropped, MarkerChoice
from remaster_ros.sensors.optitrack.natnet_frame import (
    BITSTREAM_CHANGED,
    MODEL_LIST_CHANGED,
    Frame,
    LabeledMarker,
)
from remaster_ros.sensors.optitrack.natnet_model import ModelDefinition, RigidBodyDescription
from remaster_ros.sensors.optitrack.settings import NatNetSettings


class Peer:
    """A hand-made server: sends exactly what a test wants sent."""

    version = (3, 1)
    connection = natnet.Connection(10_000_000, 1511, False, '0.0.0.0')

    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((LOCAL, 0))
        self.socket.settimeout(20.0)
        self.port = self.socket.getsockname()[1]
        self.number = 0

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.socket.close()

    def wait_for(self, message_id):
        while True:
            datagram, self.client = self.socket.recvfrom(65536)
            if natnet.decode_request(datagram).id == message_id:
                return

    def welcome(self):
        """Answer CONNECT and MODELDEF."""
        self.wait_for(natnet.MessageId.CONNECT)
        self.send(natnet.ServerInfo('peer', (3, 0, 0, 0), self.version, self.connection))
        self.wait_for(natnet.MessageId.REQUEST_MODELDEF)
        self.name_body('tool', 1)

    def name_body(self, name, body_id):
        self.send(ModelDefinition((RigidBodyDescription(name, body_id),)))

    def send(self, message):
        self.send_bytes(natnet.encode_message(message, self.version))

    def send_bytes(self, datagram, sender=None):
        (sender or self.socket).sendto(datagram, self.client)

    def frame(self, **fields):
        self.number += 1
        position = (0.5 + 1e-6 * self.number, 0.25, 2.0)
        marker = LabeledMarker(1 << 16 | 1, position, 0.01, 0x0A, 1e-4)
        return Frame(self.number, self.number / 100, (marker,), **fields)


@pytest.fixture
def peer_and_client():
    """A hand-made server with a client that knows its marker."""
    samples = []
    with (
        Peer() as peer,
        client_of(peer.port, 1511, samples.append, wait_s=0, transport='unicast') as client,
    ):
        peer.welcome()
        client.samples = samples
        send_until_believed(peer, samples)
        del samples[:]
        yield peer, client


def send_until_believed(peer, samples):
    """Send frames until the peer has been the only source for long enough."""

    def believed():
        peer.send(peer.frame())
        return samples

    assert eventually(believed)
    # What is still on its way comes before the test begins.
    assert eventually(lambda: samples[-1].frame_number == peer.number)


def test_no_datagram_ends_the_thread(peer_and_client):
    peer, client = peer_and_client
    rng = np.random.default_rng(5)
    good = natnet.encode_message(peer.frame(), peer.version)
    for length in range(len(good)):
        peer.send_bytes(good[:length])
    for _ in range(300):
        bad = bytearray(good[: rng.integers(4, len(good))])
        bad[rng.integers(len(bad))] ^= 1 << int(rng.integers(8))
        peer.send_bytes(bytes(bad))
        peer.send_bytes(rng.bytes(int(rng.integers(0, 200))))
    for message_id in (1, 3, 5, 8, 13, 100, 200):
        peer.send_bytes(natnet.join_datagram(message_id, rng.bytes(50)))
    assert eventually(lambda: client.status().dropped[Dropped.MALFORMED] > len(good))

    def takes_good_ones():
        peer.send(peer.frame())
        return len(client.samples) > 20

    assert eventually(takes_good_ones)
    for sample in client.samples:
        np.testing.assert_allclose(sample.position, [0.5, 0.25, 2.0], atol=0.01)


def test_a_servers_own_messages_are_not_malformed(peer_and_client):
    """Keep-alives, notes and requests to others are sound, and a client does without them."""
    peer, client = peer_and_client
    before = client.status().dropped[Dropped.MALFORMED]
    for message_id in ('KEEPALIVE', 'DISCOVERY', 'ECHOREQUEST', 'MESSAGESTRING'):
        for _ in range(5):
            peer.send_bytes(natnet.join_datagram(natnet.MessageId[message_id], b'hello\0'))
    send_until_believed(peer, client.samples)
    assert client.status().dropped[Dropped.MALFORMED] == before
    peer.send_bytes(natnet.join_datagram(77, b'hello'))
    assert eventually(lambda: client.status().dropped[Dropped.MALFORMED] == before + 1)


@pytest.mark.parametrize('message_id', list(natnet.MessageId))
def test_on_the_data_port_only_frames_and_strangers_matter(message_id):
    is_frame = message_id == natnet.MessageId.FRAMEOFDATA
    assert _is_of_others(int(message_id), from_data_socket=True) is not is_frame
    assert not _is_of_others(77, from_data_socket=True)


def test_another_address_is_counted_and_never_believed(peer_and_client):
    peer, client = peer_and_client
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(('127.0.0.2', 0))
        for _ in range(5):
            peer.send_bytes(natnet.encode_message(peer.frame(), (3, 1)), stranger)
        assert eventually(lambda: client.status().dropped[Dropped.FOREIGN] == 5)
    assert client.status().foreign == ('127.0.0.2',)
    assert not client.samples
    assert eventually(lambda: client.diagnosis().fault == 'address')
    assert '127.0.0.2' in client.diagnosis().message


def received(frames, on_sample):
    """Return a client without sockets that has received frames and digested none."""
    client = NatNetClient(NatNetSettings(marker=MarkerChoice(marker_id=1 << 16 | 1)), on_sample)
    client._status.server_ip, client._status.version = LOCAL, (3, 1)
    client._lock.source = (LOCAL, 1511)
    client._data = source = DatagramSource()
    for number in range(1, frames + 1):
        datagram = natnet.encode_message(full_frame((3, 1), number), (3, 1))
        source.waiting.append((datagram, (LOCAL, 1511)))
    while source.waiting:
        client._receive(source)
    return client


def test_a_slow_listener_keeps_no_datagram_in_the_socket():
    """The socket is emptied between any two hand-overs that take long; nothing is lost."""
    numbers = []

    def listen(sample):
        numbers.append(sample.frame_number)
        time.sleep(0.006)

    client = received(2000, listen)
    client._digest_backlog()
    assert numbers == [1], 'one turn takes no longer than its time'
    client._on_sample = lambda sample: numbers.append(sample.frame_number)
    while client._backlog:
        client._digest_backlog()
    assert numbers == list(range(1, 2001))
    assert client.status().lost == 0


def test_what_waits_is_bounded_and_the_rest_counted(monkeypatch):
    size = len(natnet.encode_message(full_frame((3, 1)), (3, 1)))
    monkeypatch.setattr(natnet_client, 'MAX_BACKLOG_BYTES', 100 * size)
    client = received(130, print)
    assert len(client._backlog) == 100
    assert client.status().dropped[Dropped.OVERRUN] == 30


def test_a_changed_model_list_is_asked_for(peer_and_client):
    peer, client = peer_and_client
    peer.send(peer.frame(params=MODEL_LIST_CHANGED))
    peer.wait_for(natnet.MessageId.REQUEST_MODELDEF)
    peer.name_body('tool', 2)
    assert eventually(lambda: client.status().marker_id == 2 << 16 | 1)


def test_a_changed_bitstream_is_asked_for(peer_and_client):
    peer, client = peer_and_client
    peer.send(peer.frame(params=BITSTREAM_CHANGED))
    peer.version = (4, 1)
    peer.welcome()
    assert eventually(lambda: client.status().version == (4, 1))


def test_an_unknown_version_is_named():
    with (
        Peer() as peer,
        client_of(peer.port, 1511, wait_s=0, transport='unicast') as client,
    ):
        peer.wait_for(natnet.MessageId.CONNECT)
        peer.send(natnet.ServerInfo('new', (9, 0, 0, 0), (5, 0), peer.connection))
        assert eventually(lambda: client.diagnosis().fault == 'version')


def test_a_listener_that_fails_is_logged_and_called_again(peer_and_client, caplog):
    peer, client = peer_and_client
    accepted = client.status().accepted
    client._on_sample = lambda sample: 1 / 0
    for _ in range(2):
        peer.send(peer.frame())
    assert eventually(lambda: len(caplog.records) == 2)
    assert client.status().accepted == accepted + 2
