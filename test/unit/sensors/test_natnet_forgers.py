# SPDX-License-Identifier: Apache-2.0
"""Frames are believed from one address and port: forgers on the server's computer.

A forger copies each genuine frame, moves its marker by 3 mm (less than what counts as a jump) and
sends it under the *next* frame number, so that the genuine frame that follows looks like a
duplicate. It has the server's address and a port of its own.
"""

import contextlib
import dataclasses
import logging
import socket
import threading
import time

import numpy as np
import pytest
from worlds.optitrack_world import SENSOR, MarkerWorld, eventually, free_port

from remaster_ros.sensors.optitrack import natnet
from remaster_ros.sensors.optitrack.client import NatNetClient
from remaster_ros.sensors.optitrack.frame_gate import Dropped
from remaster_ros.sensors.optitrack.marker_follower import warning
from remaster_ros.sensors.optitrack.settings import NatNetSettings
from remaster_ros.simulation.optitrack import FakeOptiTrackServer
from remaster_ros.simulation.optitrack_scene import OptiTrackBehaviour

LOCAL = '127.0.0.1'
HERE, FORGED = 2.0, 2.003
"""Height of the marker, m: genuine and forged."""
SILENCE_S = 0.5


class StillWorld(MarkerWorld):
    """A marker that stands still, and frames in real time."""

    def now(self):
        return time.monotonic()

    def sleep_until(self, t):
        time.sleep(max(t - self.now(), 0.0))

    def marker_in_sensor(self, sensor, t):
        return np.array([0.3, 0.0, HERE])


class Server(FakeOptiTrackServer):
    """The genuine server; a forger may look at what it sends."""

    def __init__(self, data_port, transport, command_port=0):
        quiet = OptiTrackBehaviour(noise_across_m=1e-6, noise_along_m=1e-6)
        super().__init__(
            StillWorld(), SENSOR, np.random.default_rng(1), rate_hz=100.0, behaviour=quiet,
            command_port=command_port, data_port=data_port, transport=transport,
        )  # fmt: skip

    def target(self, data_port):
        """Where the client listens for frames."""
        if self._transport == 'unicast':
            return self.clients[0] if self.clients else None
        return (natnet.DEFAULT_MULTICAST_GROUP, data_port)


class Forger:
    """Sends forged frames in a thread of its own, beside the genuine ones, until it is left."""

    def __init__(self, server, data_port, target=None):
        self._server, self._data_port, self._target = server, data_port, target
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((LOCAL, 0))
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LOCAL))
        self.port = self._socket.getsockname()[1]
        self.sent = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._forge, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exception):
        self.pause()
        self._socket.close()

    def pause(self):
        """Send nothing any more by itself."""
        self._stop.set()
        self._thread.join()

    def _forge(self):
        last = None
        while not self._stop.wait(0.001):
            frame = self._server._latest
            target = self._target or self._server.target(self._data_port)
            if frame is None or frame is last or target is None:
                continue
            last = frame
            self.send(frame, target)

    def go_on(self, frame, seconds):
        """Send frames that follow this one, as a server would."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            frame = dataclasses.replace(
                frame, number=frame.number + 1, timestamp=frame.timestamp + 0.01
            )
            self.send(frame, (natnet.DEFAULT_MULTICAST_GROUP, self._data_port))
            time.sleep(0.01)

    def send(self, frame, target):
        moved = tuple(
            marker._replace(position=(*marker.position[:2], marker.position[2] + FORGED - HERE))
            for marker in frame.labeled_markers
        )
        forged = dataclasses.replace(
            frame, number=frame.number + 1, timestamp=frame.timestamp + 0.01, labeled_markers=moved
        )
        self._socket.sendto(natnet.encode_message(forged, (3, 1)), target)
        self.sent += 1


@contextlib.contextmanager
def following(command_port, data_port, transport):
    samples = []
    settings = NatNetSettings(
        server=LOCAL, local_interface=LOCAL, command_port=command_port, data_port=data_port,
        transport=transport, silence_s=SILENCE_S,
    )  # fmt: skip
    client = NatNetClient(settings, samples.append)
    client.start()
    try:
        yield client, samples
    finally:
        client.stop()


def forged_of(samples):
    heights = np.array([sample.position[2] for sample in samples])
    return int(np.sum(np.abs(heights - HERE) > 1e-3))


@pytest.mark.parametrize('transport', ['multicast', 'unicast'])
def test_a_forger_beside_the_server_is_never_believed(transport):
    """57 of 62 forged frames were believed, and the genuine ones dropped as duplicates."""
    data_port = free_port()
    with (
        Server(data_port, transport) as server,
        following(server.command_port, data_port, transport) as (client, samples),
    ):
        assert eventually(lambda: len(samples) > 20)
        before = client.status()
        with Forger(server, data_port) as forger:
            count = len(samples)
            assert eventually(lambda: forger.sent >= 62)
            assert eventually(lambda: len(samples) > count + 40), 'the genuine ones go on'
        assert eventually(lambda: client.status().dropped[Dropped.FOREIGN] == forger.sent)
        after = client.status()
        print(f'{forged_of(samples)} of {forger.sent} forged frames believed')
        assert forged_of(samples) == 0
        for reason in (Dropped.DUPLICATE, Dropped.OUT_OF_ORDER, Dropped.STALE, Dropped.JUMP):
            assert after.dropped[reason] == before.dropped[reason], reason
        assert after.rivals == (f'{LOCAL}:{forger.port}',)
        assert after.source == before.source
        assert client.diagnosis().fault == 'none'
        assert f'{LOCAL}:{forger.port} and are refused' in warning(after)


@pytest.mark.parametrize('transport', ['multicast', 'unicast'])
def test_of_two_that_send_from_the_beginning_none_is_believed(transport):
    """Nothing tells which is genuine; with the forger gone, readings begin."""
    data_port = free_port()
    with (
        Server(data_port, transport) as server,
        Forger(server, data_port) as forger,
        following(server.command_port, data_port, transport) as (client, samples),
    ):
        assert eventually(lambda: 'at the same time' in client.diagnosis().message)
        assert client.diagnosis().fault == 'address'
        assert f'{LOCAL}:{forger.port}' in client.diagnosis().message
        time.sleep(3 * SILENCE_S)
        assert not samples
        forger.pause()
        assert eventually(lambda: len(samples) > 20)
        assert forged_of(samples) == 0
        assert client.diagnosis().fault == 'none'


def test_a_server_from_another_port_is_taken_anew_and_reported(caplog):
    """It is started again while a forger goes on: the forger is no successor."""
    data_port, command_port = free_port(), free_port()
    with (
        following(command_port, data_port, 'multicast') as (client, samples),
        contextlib.ExitStack() as at_end,
    ):
        with Server(data_port, 'multicast', command_port) as server:
            assert eventually(lambda: len(samples) > 20)
            first = client.status().source
            forger = at_end.enter_context(Forger(server, data_port))
            assert eventually(lambda: client.status().rivals)
            assert eventually(lambda: forger.sent > 40)
            frame = server._latest
        # The forger goes on alone, with frames that advance.
        forger.pause()
        forger.go_on(frame, 4 * SILENCE_S)
        count = len(samples)
        forger.go_on(frame, SILENCE_S)
        assert len(samples) == count, 'the server is silent, and nobody else is believed'
        assert client.status().source == ''
        caplog.set_level(logging.INFO, 'remaster_ros')
        with Server(data_port, 'multicast', command_port):
            assert eventually(lambda: len(samples) > count + 20)
            second = client.status().source
        assert second not in (first, f'{LOCAL}:{forger.port}', '')
        assert client.status().sources_taken == 2
        assert f'frames of {second} are believed from now on, before it was {first}' in caplog.text
        assert forged_of(samples) == 0


def test_a_successor_needs_a_new_answer_of_the_command_channel():
    """The server is gone, command channel and all: a newcomer with its address is not believed."""
    data_port, command_port = free_port(), free_port()
    with following(command_port, data_port, 'multicast') as (client, samples):
        with Server(data_port, 'multicast', command_port) as server:
            assert eventually(lambda: len(samples) > 20)
            frame = server._latest
        assert eventually(lambda: client.status().source == '')
        count = len(samples)
        server._latest = None
        with Forger(server, data_port) as newcomer:
            newcomer.go_on(frame, 3 * SILENCE_S)
        assert len(samples) == count
        assert client.status().dropped[Dropped.PROBATION] > 50


def test_answers_are_believed_from_the_port_that_was_asked():
    """Whoever else sends on that computer names no other version and no other marker."""
    data_port = free_port()
    with (
        Server(data_port, 'unicast') as server,
        following(server.command_port, data_port, 'unicast') as (client, samples),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as forger,
    ):
        assert eventually(lambda: len(samples) > 20)
        forger.bind((LOCAL, 0))
        for answer in (
            natnet.ServerInfo('forged', (9, 0, 0, 0), (2, 6), None),
            natnet.Notice(natnet.MessageId.DISCONNECT),
        ):
            forger.sendto(natnet.encode_message(answer, (3, 1)), server.clients[0])
        assert eventually(lambda: client.status().dropped[Dropped.FOREIGN] == 2)
        count = len(samples)
        assert eventually(lambda: len(samples) > count + 20)
        assert client.status().version == (3, 1)
        assert client.status().server.name != 'forged'
