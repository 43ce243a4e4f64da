# SPDX-License-Identifier: Apache-2.0
"""What the fake cameras see, statistically, and how the fake server answers."""

import contextlib
import socket
import struct

import numpy as np
import pytest
from worlds.optitrack_world import SENSOR, MarkerWorld, SteppedWorld, free_port

from remaster_ros.errors import InputError
from remaster_ros.sensors.optitrack import natnet, natnet_bytes, natnet_model
from remaster_ros.sensors.optitrack.natnet import MessageId
from remaster_ros.sensors.optitrack.natnet_frame import TRACKING_VALID, Frame
from remaster_ros.simulation.optitrack import MAX_CLIENTS, FakeOptiTrackServer
from remaster_ros.simulation.optitrack_scene import OptiTrackBehaviour, OptiTrackScene

SEED = 20
CALIBRATION_ID = 1 << 16 | 1


def look(world, frames=1, version=(3, 1), step_s=0.01, **behaviour):
    scene = OptiTrackScene(
        world, SENSOR, np.random.default_rng(SEED), OptiTrackBehaviour(**behaviour)
    )
    seen = []
    for number in range(frames):
        seen.append((world.time, scene.frame(number, version)))
        world.time += step_s
    return seen


def test_noise_is_that_of_a_trio():
    """Sample standard deviations of n = 2000 lie within 6 of their own std errors (1 in 1e8)."""
    world = SteppedWorld()
    errors = np.array(
        [
            np.subtract(frame.labeled_markers[0].position, world.marker_in_sensor(SENSOR, t))
            for t, frame in look(world, 2000, version=(4, 1))
        ]
    )
    expected = np.array([25e-6, 25e-6, 100e-6])
    n = len(errors)
    print(f'seed {SEED}: std {errors.std(axis=0)}')
    assert (abs(errors.std(axis=0) / expected - 1) < 6 / np.sqrt(2 * n)).all()
    assert (abs(errors.mean(axis=0)) < 6 * expected / np.sqrt(n)).all()


def test_flags_of_tool_and_strays():
    ((_t, frame),) = look(SteppedWorld())
    params = [marker.params for marker in frame.labeled_markers]
    assert params == [0x0A] * 4 + [0x12] * 2
    assert [m.id for m in frame.labeled_markers[:4]] == [1 << 16 | i for i in (1, 2, 3, 4)]
    assert len(frame.other_markers) == 2, 'a stray appears twice'
    assert frame.rigid_bodies[0].params & TRACKING_VALID
    assert frame.mid_exposure == 0, 'USB cameras have no such clock'
    ((_t, old),) = look(SteppedWorld(), version=(2, 10))
    assert {marker.params for marker in old.labeled_markers} == {0x02}, 'three flags before 3.0'


def test_the_time_of_a_frame_is_world_time_since_the_start():
    frames = [frame for _t, frame in look(SteppedWorld(), 5, step_s=0.25)]
    assert [frame.timestamp for frame in frames] == [0.0, 0.25, 0.5, 0.75, 1.0]


def test_occlusions_come_as_often_and_last_as_long_as_told():
    """Hidden share is rate·mean/(1 + rate·mean) = 1/3; within 6 std errors (1 in 1e8)."""
    world = SteppedWorld()
    rate, mean, duration, step = 0.5, 1.0, 1000.0, 0.1
    seen = look(world, int(duration / step), step_s=step, occlusions_per_s=rate, occlusion_s=mean)
    hidden = np.array([bool(frame.labeled_markers[0].params & 0b101) for _t, frame in seen])
    # Renewal process: variance of the share of a cycle (mean 3 s) over the cycles seen.
    cycles = duration / (mean + 1 / rate)
    std_error = np.sqrt(2.0) * (1 / 3) * (2 / 3) / np.sqrt(cycles)
    print(f'seed {SEED}: hidden {hidden.mean():.3f}, std error {std_error:.4f}')
    assert abs(hidden.mean() - 1 / 3) < 6 * std_error
    kinds = {frame.labeled_markers[0].params for _t, frame in seen}
    assert kinds == {0x0A, 0x09, 0x0D, 0x0C}
    companions = {m.params for _t, frame in seen for m in frame.labeled_markers[1:4]}
    assert companions == {0x0A}, 'an episode hides one marker'


def test_a_hidden_marker_is_stale_or_guessed():
    world = SteppedWorld()
    last = None
    stale = guessed = 0
    for t, frame in look(world, 2000, occlusions_per_s=1.0, occlusion_s=0.5, guess_error_m=0.01):
        marker = frame.labeled_markers[0]
        if marker.params == 0x09:
            stale += 1
            assert last is None or marker.position == last
        elif marker.params != 0x0A:
            guessed += 1
            error = np.subtract(marker.position, world.marker_in_sensor(SENSOR, t))
            assert np.linalg.norm(error) > 1e-3
        last = marker.position
    assert stale
    assert guessed


def test_a_blocked_line_of_sight_hides_the_whole_tool():
    world = SteppedWorld()
    world.visible = False
    ((_t, frame),) = look(world)
    assert all(marker.params & 0b101 for marker in frame.labeled_markers[:4])
    assert not frame.rigid_bodies[0].params & TRACKING_VALID
    assert [marker.params for marker in frame.labeled_markers[4:]] == [0x12] * 2


@pytest.fixture
def unicast_server():
    with FakeOptiTrackServer(
        MarkerWorld(), SENSOR, np.random.default_rng(SEED), version=(4, 1),
        transport='unicast', command_port=0, rate_hz=25.0,
    ) as server:  # fmt: skip
        yield server


class Asker:
    """A client that asks and reads the answer of one kind."""

    def __init__(self, port):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(20.0)
        self.socket.connect(('127.0.0.1', port))
        self.version = (4, 1)

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.socket.close()

    def ask(self, datagram, kind):
        self.socket.send(datagram)
        return self.wait_for(kind)

    def wait_for(self, kind):
        """Read on; frames of another bitstream may be on their way and do not decode."""
        while True:
            with contextlib.suppress(natnet_bytes.ProtocolError):
                message = natnet.decode_message(self.socket.recv(65536), self.version)
                if isinstance(message, kind):
                    return message


def test_the_command_channel_answers_what_clients_ask(unicast_server):
    with Asker(unicast_server.command_port) as asker:
        refused = asker.ask(natnet.encode_command_request('Bitstream,3.1'), natnet.Response)
        assert refused.code, 'not before CONNECT'
        for connect in (
            struct.pack('<2H', 0, 0),
            struct.pack('<2H', 0, 4),
            struct.pack('<2H', 0, 5) + b'Ping\0',
            natnet.encode_connect_request('test'),
        ):
            info = asker.ask(connect, natnet.ServerInfo)
            assert info.natnet_version == (4, 1)
            assert not info.connection.is_multicast
        rate = asker.ask(natnet.encode_command_request('FrameRate'), natnet.Response)
        assert rate.value == 25.0
        echo = asker.ask(natnet.encode_echo_request(77), natnet.EchoResponse)
        assert echo.client_clock == 77
        assert asker.ask(natnet.encode_echo_request(78), natnet.EchoResponse).server_clock > (
            echo.server_clock
        )
        model = asker.ask(struct.pack('<2H', 4, 0) + b'\0', natnet_model.ModelDefinition)
        assert model.labelled_assets == {'tool': 1}
        assert model.rigid_bodies[0].marker_names[0] == 'tool_1'
        assert asker.ask(natnet.join_datagram(MessageId.REQUEST_FRAMEOFDATA), Frame)
        for unknown in (struct.pack('<2H', 55, 0), natnet.encode_command_request('Fly')):
            notice = asker.ask(unknown, natnet.Notice)
            assert notice.id == MessageId.UNRECOGNIZED_REQUEST
        asker.socket.send(b'x')  # no header: ignored
        assert asker.ask(natnet.encode_command_request('FrameRate'), natnet.Response)


def test_the_bitstream_is_negotiated_as_from_4_0(unicast_server):
    with Asker(unicast_server.command_port) as asker:
        asker.ask(natnet.encode_connect_request('test'), natnet.ServerInfo)
        asked = asker.ask(natnet.encode_command_request('Bitstream'), natnet.Response)
        assert asked.text == 'Bitstream,4.1'
        for refused in ('4.2', '2.10', 'new'):
            answer = asker.ask(
                natnet.encode_command_request(f'Bitstream,{refused}'), natnet.Response
            )
            assert answer.code
        agreed = asker.ask(natnet.encode_command_request('Bitstream,3.1'), natnet.Response)
        assert agreed.text == 'Bitstream,3.1'
        asker.version = (3, 1)
        assert asker.wait_for(Frame).labeled_markers[0].id == CALIBRATION_ID
    with Asker(unicast_server.command_port) as asker:
        asker.ask(natnet.encode_connect_request('test', (3, 1)), natnet.ServerInfo)
        asked = asker.ask(natnet.encode_command_request('Bitstream'), natnet.Response)
        assert asked.text == 'Bitstream,3.1', 'the full form of CONNECT names it too'


def test_the_number_of_clients_is_bounded(unicast_server):
    askers = [Asker(unicast_server.command_port) for _ in range(MAX_CLIENTS + 3)]
    for asker in askers:
        asker.ask(natnet.encode_connect_request('test'), natnet.ServerInfo)
    assert len(unicast_server.clients) == MAX_CLIENTS
    for asker in askers:
        asker.socket.close()


@pytest.mark.parametrize(
    'bad',
    [
        {'version': (5, 0)},
        {'transport': 'broadcast'},
        {'rate_hz': 0.0},
        {'multicast_group': '10.0.0.1'},
    ],
)
def test_settings_that_cannot_work_are_refused(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        FakeOptiTrackServer(
            MarkerWorld(), SENSOR, np.random.default_rng(SEED), data_port=free_port(), **bad
        )
