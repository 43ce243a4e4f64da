# SPDX-License-Identifier: Apache-2.0
"""Independent clients must understand the fake server: `natnetclient` 2.10, `natnet` 3.1 and 4.1.

Both run in processes of their own (one never ends its thread) and print what they read; the
values are compared with the world's truth, which does not move here.
"""

from __future__ import annotations

import dataclasses
import json
import re
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
from worlds.optitrack_world import SENSOR, MarkerWorld, eventually, free_port, nothing_left

from remaster_ros.errors import DeviceError, InputError
from remaster_ros.sensors.driver import SensorClock
from remaster_ros.sensors.optitrack import natnet as our_natnet
from remaster_ros.sensors.optitrack import natnetclient_backend
from remaster_ros.sensors.optitrack.driver import OptiTrackDriver, Parameters
from remaster_ros.sensors.optitrack.frame_gate import Dropped, MarkerChoice
from remaster_ros.sensors.optitrack.natnet_frame import LabeledMarker
from remaster_ros.sensors.optitrack.natnetclient_backend import NatNetClientBackend
from remaster_ros.sensors.optitrack.settings import NatNetSettings
from remaster_ros.simulation.optitrack import FakeOptiTrackServer
from remaster_ros.simulation.optitrack_scene import OptiTrackBehaviour

MARKER = np.array([0.3, -0.1, 2.0])
TOOL = OptiTrackBehaviour()
TOLERANCE_M = 6 * TOOL.noise_along_m
TIMEOUT_S = 60.0


class StillWorld(MarkerWorld):
    """The marker stands still, so that truth and reading need no common clock."""

    def marker_in_sensor(self, sensor, t):
        return MARKER


@contextmanager
def fake_server(**options):
    server = FakeOptiTrackServer(
        StillWorld(),
        SENSOR,
        np.random.default_rng(3),
        **({'command_port': 0, 'data_port': free_port()} | options),
    )
    with server:
        yield server


def run_client(code, *arguments):
    """Run a third-party client and return the JSON that it prints last."""
    done = subprocess.run(
        [sys.executable, '-W', 'ignore', '-c', code, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout.splitlines()[-1])


NATNETCLIENT = """
import json, os, sys, time
from natnetclient import NatClient
# It waits 28 ms for an answer and no longer: a busy machine may need another try.
for attempt in range(20):
    try:
        client = NatClient('127.0.0.1', int(sys.argv[1]), int(sys.argv[2]))
        break
    except BlockingIOError:
        time.sleep(0.1)
frame = client.iFrame
stamp = client.timestamp
while client.iFrame < frame + 20:
    time.sleep(0.01)
body = client.rigid_bodies['tool']
print(json.dumps({
    'version': client.natnet_version,
    'labeled': {m.id: [list(m.position), m.occluded, m.pc_solved, m.model_solved, m.size]
                for m in list(client.labeled_markers.values())},
    'strays': [list(m.position) for m in client.unidentified_markers],
    'body': [body.id, list(body.position), list(body.quaternion), body.seen],
    'sets': {name: [list(m.position) for m in s.markers]
             for name, s in client.marker_sets.items()},
    'elapsed': client.timestamp - stamp,
    'frames': client.iFrame - frame,
}), flush=True)
os._exit(0)
"""


def test_natnetclient_reads_2_10():
    data_port = free_port()
    with fake_server(version=(2, 10), transport='unicast', unicast_port=data_port) as server:
        read = run_client(NATNETCLIENT, data_port, server.command_port)
    assert read['version'][:2] == [2, 10]
    offsets = np.array([(0.0, 0.0, 0.0), *TOOL.companions])
    for member, offset in enumerate(offsets, 1):
        position, occluded, measured, filled, _size = read['labeled'][str(1 << 16 | member)]
        np.testing.assert_allclose(position, MARKER + offset, atol=TOLERANCE_M)
        assert (occluded, measured, filled) == (False, True, False)
    assert len(read['labeled']) == 4 + len(TOOL.strays)
    np.testing.assert_allclose(read['strays'], TOOL.strays, atol=TOLERANCE_M)
    body_id, position, quaternion, seen = read['body']
    assert (body_id, quaternion, seen) == (1, [0, 0, 0, 1], True)
    np.testing.assert_allclose(position, MARKER + offsets.mean(axis=0), atol=TOLERANCE_M)
    for name in ('tool', 'all'):
        np.testing.assert_allclose(read['sets'][name], MARKER + offsets, atol=TOLERANCE_M)
    assert 0.5 < read['elapsed'] / (read['frames'] / 30) < 2.0, 'the suffix is where it belongs'


NATNET = """
import json, sys, time
from natnet import NatNetClient, Version
command_port, data_port, multicast, wanted = (json.loads(a) for a in sys.argv[1:])
frames, models = [], []
class Patient(NatNetClient):
    # A frame that comes before the server's first answer ends its connect: it is tried again.
    def connect(self, timeout=5.0):
        for attempt in range(20):
            try:
                return super().connect(timeout)
            except TypeError:
                self.shutdown()
        raise SystemExit('no answer came before a frame')
client = Patient('127.0.0.1', '127.0.0.1', command_port=command_port, data_port=data_port,
                 use_multicast=multicast)
client.on_data_frame_received_event.handlers.append(frames.append)
client.on_data_description_received_event.handlers.append(models.append)
with client:
    if wanted:
        client.protocol_version = Version(*wanted)
        deadline = time.time() + 20
        # Frames on their way in the old version do not decode; throw them away.
        while time.time() < deadline:
            try:
                client.update_sync()
                break
            except Exception:
                continue
        frames.clear()
    deadline = time.time() + 20
    while (len(frames) < 20 or not models) and time.time() < deadline:
        client.request_modeldef()
        client.update_sync()
        time.sleep(0.02)
frame, before = frames[-1], frames[-20]
model = models[-1]
print(json.dumps({
    'version': list(client.protocol_version.components),
    'labeled': {m.id_num: [list(m.pos), m.param, m.residual] for m in frame.labeled_markers},
    'strays': [list(p) for p in frame.unlabeled_marker_pos],
    'body': [[b.id_num, list(b.pos), list(b.rot), b.tracking_valid] for b in frame.rigid_bodies],
    'sets': {s.model_name: [list(p) for p in s.marker_pos_list] for s in frame.marker_sets},
    'numbers': [frame.prefix.frame_number, before.prefix.frame_number],
    'stamps': [frame.suffix.timestamp, before.suffix.timestamp],
    'ticks': [frame.suffix.stamp_camera_mid_exposure, frame.suffix.stamp_data_received,
              frame.suffix.stamp_transmit],
    'bodies': [[b.name, b.id_num, len(b.markers), [m.name for m in b.markers]]
               for b in model.rigid_bodies],
    'set_names': [[s.name, list(s.marker_names)] for s in model.marker_sets],
}), flush=True)
"""


@pytest.mark.parametrize('transport', ['unicast', 'multicast'])
@pytest.mark.parametrize('version', [(3, 1), (4, 1)])
def test_natnet_reads_3_1_and_4_1(version, transport):
    data_port = free_port()
    with fake_server(version=version, transport=transport, data_port=data_port) as server:
        multicast = json.dumps(transport == 'multicast')
        read = run_client(NATNET, server.command_port, data_port, multicast, 'null')
    check_natnet(read, version)
    names = [f'tool_{i}' for i in (1, 2, 3, 4)]
    assert read['bodies'] == [['tool', 1, 4, names if version >= (4, 0) else [None] * 4]]
    assert read['set_names'] == [['tool', names], ['all', names]]


def test_natnet_negotiates_3_1_with_a_4_1_server():
    with fake_server(version=(4, 1), transport='unicast') as server:
        read = run_client(NATNET, server.command_port, 1511, 'false', '[3, 1]')
    check_natnet(read, (3, 1))


def check_natnet(read, version):
    assert tuple(read['version'][:2]) == version
    offsets = np.array([(0.0, 0.0, 0.0), *TOOL.companions])
    for member, offset in enumerate(offsets, 1):
        position, params, residual = read['labeled'][str(1 << 16 | member)]
        np.testing.assert_allclose(position, MARKER + offset, atol=TOLERANCE_M)
        assert params == 0x0A
        assert residual == pytest.approx(2e-4)
    assert len(read['labeled']) == 4 + len(TOOL.strays)
    np.testing.assert_allclose(read['strays'], TOOL.strays, atol=TOLERANCE_M)
    ((body_id, position, rotation, valid),) = read['body']
    assert (body_id, rotation, valid) == (1, [0, 0, 0, 1], True)
    np.testing.assert_allclose(position, MARKER + offsets.mean(axis=0), atol=TOLERANCE_M)
    for name in ('tool', 'all'):
        np.testing.assert_allclose(read['sets'][name], MARKER + offsets, atol=TOLERANCE_M)
    (newest, oldest), (end, begin) = read['numbers'], read['stamps']
    assert newest >= oldest + 19
    assert 0.5 < (end - begin) / ((newest - oldest) / 30) < 2.0
    mid_exposure, received, sent = read['ticks']
    assert mid_exposure == 0
    assert 0 < received <= sent


def backend_settings(server, data_port, **more):
    return NatNetSettings(
        transport='unicast', command_port=server.command_port, data_port=data_port,
        silence_s=0.4, **more,
    )  # fmt: skip


def test_the_natnetclient_backend_gives_readings_and_drops_hidden_ones():
    samples = []
    data_port = free_port()
    hides = OptiTrackBehaviour(occlusions_per_s=2.0, occlusion_s=0.3, guess_error_m=0.5)
    with (
        nothing_left(),
        fake_server(
            version=(2, 10), transport='unicast', unicast_port=data_port, behaviour=hides
        ) as server,
    ):
        client = NatNetClientBackend(backend_settings(server, data_port), samples.append)
        client.start()
        assert eventually(lambda: len(samples) > 100)
        assert eventually(lambda: client.status().dropped[Dropped.OCCLUDED] > 10)
        status = client.status()
        client.stop()
    positions = [sample.position for sample in samples]
    np.testing.assert_allclose(positions, np.tile(MARKER, (len(positions), 1)), atol=TOLERANCE_M)
    assert status.dropped[Dropped.DISAGREEMENT] == 0
    assert status.dropped[Dropped.MALFORMED] == 0


def test_the_natnetclient_backend_survives_damage_and_a_restarted_server():
    samples = []
    data_port, command_port = free_port(), free_port()
    settings = NatNetSettings(
        transport='unicast', command_port=command_port, data_port=data_port, silence_s=0.4,
        marker=MarkerChoice(rigid_body='tool'),
    )  # fmt: skip
    client = NatNetClientBackend(settings, samples.append)
    client.start()
    assert eventually(lambda: client.diagnosis().fault == 'port'), 'no server yet'
    options = {'version': (2, 10), 'transport': 'unicast', 'unicast_port': data_port}
    for _ in range(2):
        with fake_server(command_port=command_port, **options) as server:
            before = len(samples)
            assert eventually(lambda: len(samples) > before + 10)  # noqa: B023
            for junk in (b'', b'\x07\x00\x10\x00abc', bytes(300), our_natnet.join_datagram(7)):
                server._command.sendto(junk, ('127.0.0.1', data_port))
            before = len(samples)
            assert eventually(lambda: len(samples) > before + 10)  # noqa: B023
    assert client.status().dropped[Dropped.MALFORMED] >= 6
    client.stop()
    positions = [sample.position for sample in samples]
    np.testing.assert_allclose(positions, np.tile(MARKER, (len(positions), 1)), atol=TOLERANCE_M)


def test_the_natnetclient_backend_believes_one_source():
    samples = []
    data_port = free_port()
    with (
        fake_server(version=(2, 10), transport='unicast', unicast_port=data_port) as server,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as forger,
    ):
        client = NatNetClientBackend(backend_settings(server, data_port), samples.append)
        client.start()
        assert eventually(lambda: client.status().source)
        for _ in range(30):
            frame = server._latest
            forged = dataclasses.replace(
                frame,
                number=frame.number + 1,
                timestamp=frame.timestamp + 0.01,
                labeled_markers=tuple(
                    marker._replace(position=tuple(np.add(marker.position, (0.0, 0.0, 0.004))))
                    for marker in frame.labeled_markers
                ),
            )
            forger.sendto(our_natnet.encode_message(forged, (2, 10)), ('127.0.0.1', data_port))
            time.sleep(0.01)
        assert eventually(lambda: client.status().dropped[Dropped.FOREIGN] == 30)
        client.stop()
    heights = [sample.position[2] for sample in samples]
    assert np.max(np.abs(np.array(heights) - MARKER[2])) < 0.002


@pytest.mark.parametrize('fault', ['another position', 'hidden', 'nothing', 'an exception'])
def test_a_fault_of_natnetclient_never_becomes_a_reading(monkeypatch, fault):
    ours = LabeledMarker(1 << 16 | 1, tuple(MARKER), 0.01, 0)

    def faulty(client, datagram):
        if fault == 'an exception':
            client.natnet_version = None
            return read(client, datagram)
        wrong = ours._replace(position=(9.0, 9.0, 9.0))
        hidden = tuple(m._replace(params=1) for m in read(client, datagram) or ())
        return {'another position': (wrong,), 'hidden': hidden, 'nothing': ()}[fault]

    read = natnetclient_backend._read
    monkeypatch.setattr(natnetclient_backend, '_read', faulty)
    samples = []
    data_port = free_port()
    with fake_server(version=(2, 10), transport='unicast', unicast_port=data_port) as server:
        client = NatNetClientBackend(backend_settings(server, data_port), samples.append)
        client.start()
        assert eventually(lambda: client.status().dropped[Dropped.DISAGREEMENT] > 10)
        client.stop()
    assert not samples
    assert client.status().accepted == 0


def test_the_natnetclient_backend_reports_a_missing_package(monkeypatch):
    monkeypatch.setitem(sys.modules, 'natnetclient', None)
    with pytest.raises(InputError, match='pip install natnetclient'):
        NatNetClientBackend(NatNetSettings(transport='unicast'), print)


def test_the_natnetclient_backend_refuses_what_it_cannot_do():
    data_port = free_port()
    with fake_server(version=(3, 1), transport='unicast', unicast_port=data_port) as server:
        client = NatNetClientBackend(backend_settings(server, data_port), print)
        client.start()
        assert eventually(lambda: client.diagnosis().fault == 'version')
        assert 'streams 3.1: set client to builtin' in client.diagnosis().message
        client.stop()
    far = NatNetSettings(transport='unicast', server='192.0.2.77', data_port=data_port)
    with pytest.raises(DeviceError, match='on this computer'):
        NatNetClientBackend(far, print).start()


@pytest.mark.parametrize(
    ('given', 'named'),
    [
        ({'transport': 'multicast'}, 'transport is multicast'),
        ({'bitstream': '4.1'}, r'bitstream is 4\.1'),
        ({'further_markers': {'b': 2}}, 'further_markers'),
    ],
)
def test_what_natnetclient_does_not_read_is_refused_by_name_with_the_remedy(given, named):
    with pytest.raises(InputError) as refused:
        NatNetClientBackend(NatNetSettings(**{'transport': 'unicast', **given}), print)
    for text in (r'NatNet 2\.6 to 2\.10 in unicast only', named, 'set client to builtin'):
        assert re.search(text, str(refused.value)), refused.value


@pytest.mark.parametrize(
    ('client', 'shown'),
    [
        ('builtin', 'builtin'),
        (
            'natnetclient',
            'natnetclient (NatNet 2.6 to 2.10 in unicast only, one marker, from a server on this '
            'computer)',
        ),
    ],
)
def test_the_state_shows_which_client_reads_and_what_it_is_limited_to(client, shown):
    driver = OptiTrackDriver(
        Parameters(server='127.0.0.1', transport='unicast', client=client, data_port=free_port()),
        SensorClock(),
    )
    try:
        assert driver.state().values['client'] == shown
    finally:
        driver.close()
