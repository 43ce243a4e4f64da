# SPDX-License-Identifier: Apache-2.0
"""The devices at their wires x every kind of fault: what their drivers make of it.

Real drivers and real sockets, fake devices that do the wrong things. Whatever happens: no reading
from where the marker never was, and readings again once the fault is over. `make faults` writes
the tables of test/faults/observed.md; what the nodes make of faults is in
test/system/test_fault_rows.py.
"""

from __future__ import annotations

import re
import threading
import time

import numpy as np
import pytest
from faults import page
from worlds import optitrack_world, tracker_world

from remaster_ros.calibration.registration import register_ransac
from remaster_ros.errors import DeviceError, InsufficientDataError
from remaster_ros.sensors.laser_tracker.client import LaserTrackerClient
from remaster_ros.sensors.laser_tracker.link import LaserTrackerSettings
from remaster_ros.sensors.optitrack.client import NatNetClient
from remaster_ros.sensors.optitrack.frame_gate import MarkerChoice
from remaster_ros.sensors.optitrack.marker_follower import warning
from remaster_ros.sensors.optitrack.settings import NatNetSettings
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.laser_tracker import FakeLaserTracker
from remaster_ros.simulation.laser_tracker_behaviour import TrackerBehaviour
from remaster_ros.simulation.optitrack import FakeOptiTrackServer
from remaster_ros.simulation.setup import make_world

KINDS = ('off', 'stuck', 'wrong', 'slow', 'delayed', 'intermittent', 'garbage', 'restarted')
DEVICES = ('OptiTrack', 'laser tracker')


def observe(who: str, kind: str, text: str) -> None:
    """Compare what was seen with the page, or write it there; without what depends on the moment.

    Each test does so for its own cell: one that is tried once more by itself sees the fault anew.
    """
    text = re.sub(r' \([^)]*\)', '', text).replace('|', '/')
    text = re.sub(r'\d+\.\d+|\d+(?= mm| usable| readings)', '…', text)
    text = re.sub(r'(system status|status|search at a position) impossible', 'impossible', text)
    lost = 'impossible: (connection lost|the instrument closed the connection)'
    text = re.sub(lost, 'impossible: the connection is lost', text)
    if 'cut' in kind:
        # A reset may overtake the first bytes of a packet.
        text = text.replace('the connection is lost', 'it sent what is not emScon')
    text = re.sub(r'no answer to the [a-z ]+ within', 'no answer within', text)
    text = text[0].upper() + text[1:]
    if who in DEVICES:
        page.compare('matrix', ('', *KINDS), f'**{who}**', kind, text)
    else:
        assert kind in NAMED
        page.compare('named', ('fault', 'what happens'), kind, 'what happens', text)


# The devices at their wires


MOCAP = {
    'off': {'off': 1},
    'stuck': {'stopped': 1},
    'wrong': {'jumping': 1},
    'slow': {'slow': 4},
    'delayed': {'late': 1.0},
    'intermittent': {'occluded': 1},
    'garbage': {'garbage': 1},
    'restarted': {'renumbered': 1},
}
NAMED_MOCAP = {
    'marker occluded': {'occluded': 1},
    'marker model-filled': {'filled': 1},
    'marker frozen': {'frozen': 1},
    'marker jumping': {'jumping': 1},
    'stream stopped': {'stopped': 1},
    'stream restarted': {'renumbered': 1},
    'frames duplicated': {'duplicate': 1},
    'frames out of order': {'reordered': 1},
}


class FaultyMarkerWorld(optitrack_world.MarkerWorld):
    """A circling marker whose server has the faults that the test sets."""

    def __init__(self):
        super().__init__()
        self.numbers = {}

    def now(self):
        return time.monotonic()

    def sleep_until(self, t):
        time.sleep(max(t - self.now(), 0.0))

    def faults(self, device):
        return self.numbers

    def line_of_sight(self, sensor, t):
        return 'occluded' not in self.numbers


@pytest.fixture
def bar():
    """Return (world, client, samples) of a server and the driver that follows its marker."""
    world, samples = FaultyMarkerWorld(), []
    port = optitrack_world.free_port()
    with FakeOptiTrackServer(
        world,
        optitrack_world.SENSOR,
        np.random.default_rng(1),
        rate_hz=100.0,
        command_port=0,
        data_port=port,
    ) as server:
        settings = NatNetSettings(
            server='127.0.0.1',
            local_interface='127.0.0.1',
            command_port=server.command_port,
            data_port=port,
            marker=MarkerChoice(rigid_body='tool', max_speed_m_s=1.0),
            silence_s=0.4,
        )
        with NatNetClient(settings, samples.append, clock=world.now) as client:
            assert optitrack_world.eventually(lambda: len(samples) > 5)
            yield world, client, samples


def spoil_bar(bar, numbers: dict[str, float]) -> str:
    """Inject, let it tell what is wrong, end it; readings come again by themselves."""
    world, client, samples = bar
    before = dict(client.status().dropped)
    count = len(samples)
    world.numbers = numbers
    harmless = {'slow', 'late', 'renumbered', 'duplicate', 'reordered', 'jumping'} & set(numbers)
    if harmless:
        assert optitrack_world.eventually(lambda: len(samples) > count + 20)
    else:
        assert optitrack_world.eventually(lambda: client.diagnosis().fault != 'none')
        time.sleep(0.3)
    said = client.diagnosis().message
    now = client.status()
    reason = max(now.dropped, key=lambda r: now.dropped[r] - before[r])
    # How many frames are refused after a restart depends on how many there were before it.
    is_counted = now.dropped[reason] - before[reason] > 4 and 'renumbered' not in numbers
    world.numbers, count = {}, len(samples)
    assert optitrack_world.eventually(lambda: len(samples) > count + 5)
    assert optitrack_world.eventually(lambda: not client.diagnosis().message)
    # No reading from where the marker never was: it circles at 0.3 m.
    radii = [np.hypot(*sample.position[:2]) for sample in samples]
    assert np.max(np.abs(np.array(radii) - 0.3)) < 5e-3
    parts = [said] if said and not harmless else []
    parts += [f'counted and dropped as {reason.value.replace("_", " ")}'] if is_counted else []
    return '; '.join([*parts, 'readings go on by themselves'])


@pytest.mark.parametrize('kind', KINDS)
def test_optitrack(bar, kind):
    observe('OptiTrack', kind, spoil_bar(bar, MOCAP[kind]))


def test_another_version_after_a_restart():
    """The server comes back with another bitstream: asked again, and read."""
    world, samples = FaultyMarkerWorld(), []
    port, command_port = optitrack_world.free_port(), optitrack_world.free_port()
    settings = NatNetSettings(
        server='127.0.0.1', local_interface='127.0.0.1', command_port=command_port,
        data_port=port, marker=MarkerChoice(rigid_body='tool'), silence_s=0.4,
    )  # fmt: skip
    versions = []
    with NatNetClient(settings, samples.append, clock=world.now) as client:
        for version in ((3, 1), (4, 1), (2, 10)):
            count = len(samples)
            with FakeOptiTrackServer(
                world, optitrack_world.SENSOR, np.random.default_rng(1), version=version,
                command_port=command_port, data_port=port,
            ):  # fmt: skip
                assert optitrack_world.eventually(lambda c=count: len(samples) > c + 5)
                versions.append(client.status().version[:2])
    assert versions == [(3, 1), (4, 1), (2, 10)]
    observe('named', 'OptiTrack: version changed', 'asked again, and read as what it is')


def test_two_servers_on_one_group(bar):
    """Another bar streams to the same group: its frames are counted, and never a reading."""
    _world, client, samples = bar
    other = FaultyMarkerWorld()
    other.marker_in_sensor = lambda sensor, t: np.array([0.0, 0.0, 1.0])
    count = len(samples)
    settings = client._settings
    with FakeOptiTrackServer(
        other, optitrack_world.SENSOR, np.random.default_rng(2), host='127.0.0.2',
        command_port=0, data_port=settings.data_port,
    ):  # fmt: skip
        assert optitrack_world.eventually(lambda: len(samples) > count + 20)
        foreign = {reason.value: n for reason, n in client.status().dropped.items()}['foreign']
        assert client.status().foreign == ('127.0.0.2',)
    radii = [np.hypot(*sample.position[:2]) for sample in samples]
    assert np.max(np.abs(np.array(radii) - 0.3)) < 5e-3
    assert foreign > 0
    text = 'the other one is counted and dropped as foreign; readings go on'
    observe('named', 'OptiTrack: two servers on one group', text)


def test_another_program_on_the_computer_of_the_server(bar):
    """Its frames have the server's address and another port; none becomes a reading."""
    _world, client, samples = bar
    other = FaultyMarkerWorld()
    other.marker_in_sensor = lambda sensor, t: np.array([0.0, 0.0, 1.0])
    count = len(samples)
    with FakeOptiTrackServer(
        other, optitrack_world.SENSOR, np.random.default_rng(2), rate_hz=100.0,
        command_port=0, data_port=client._settings.data_port,
    ):  # fmt: skip
        assert optitrack_world.eventually(lambda: len(samples) > count + 100)
        status = client.status()
    radii = [np.hypot(*sample.position[:2]) for sample in samples]
    assert np.max(np.abs(np.array(radii) - 0.3)) < 5e-3
    assert status.dropped['foreign'] > 20
    assert len(status.rivals) == 1
    said = re.sub(r'127\.0\.0\.1:\d+', '…', warning(status))
    observe(
        'named', "OptiTrack: another program on the server's computer", f'{said}; readings go on'
    )


def test_a_second_measurement_while_busy():
    """Refused by name; the first one is not disturbed."""
    world = FaultyReflectorWorld()
    behaviour = TrackerBehaviour(warm_up_s=0.0, search_failure_share=0.0)
    settings = LaserTrackerSettings(integration_s=10.0)
    with FakeLaserTracker(world, 'tracker', np.random.default_rng(1), behaviour=behaviour) as fake:
        client = LaserTrackerClient(
            *fake.address, settings=settings, now=world.now, sleep=world.sleep
        )
        with client:
            client.ensure_locked(tracker_world.MARKER)
            first = []
            thread = threading.Thread(target=lambda: first.append(client.measure()))
            thread.start()
            time.sleep(0.3)
            with pytest.raises(DeviceError) as refusal:
                client.measure()
            thread.join(30)
    assert np.linalg.norm(first[0].position - tracker_world.MARKER) < 1e-3
    why = str(refusal.value).split(': ', 1)[1]
    text = f'{why}; the first one is not disturbed'
    observe('named', 'laser tracker: a second measurement while busy', text)


@pytest.mark.parametrize('fault', NAMED_MOCAP)
def test_named_faults_of_the_bar(bar, fault):
    observe('named', f'OptiTrack: {fault}', spoil_bar(bar, NAMED_MOCAP[fault]))


TRACKER = {
    'off': {'off': 1},
    'stuck': {'stuck': 1},
    'slow': {'slow': 3.0},
    'delayed': {'slow': 1.5},
    'intermittent': {'occluded': 1},
    'garbage': {'garbage': 1},
    'restarted': {'renumbered': 1},
    'wrong': {'swapped': 0.2},
    'TCP cut in the middle of a packet': {'cut': 7},
    'search fails': {'occluded': 1},
    'instrument warm-up': {'renumbered': 1},
}
NAMED = {
    'OptiTrack: version changed',
    'OptiTrack: two servers on one group',
    "OptiTrack: another program on the server's computer",
    'OptiTrack: marker swapped with a stray at the registration',
    *(f'OptiTrack: {fault}' for fault in NAMED_MOCAP),
    'laser tracker: a second measurement while busy',
    *(f'laser tracker: {fault}' for fault in TRACKER.keys() - set(KINDS)),
}


class FaultyReflectorWorld(tracker_world.ReflectorWorld):
    """A standing reflector whose tracker has the faults that the test sets."""

    def __init__(self):
        super().__init__()
        self.numbers = {}
        self.asked = 0

    def faults(self, device):
        self.asked += 1
        return self.numbers

    def line_of_sight(self, sensor, t, name=''):
        return 'occluded' not in self.numbers

    def marker_in_sensor(self, sensor, t, marker=''):
        shift = np.array([self.numbers.get('swapped', 0.0), 0.0, 0.0])
        return super().marker_in_sensor(sensor, t, marker) + shift


def measured(client: LaserTrackerClient) -> tuple[str, np.ndarray | None]:
    """Measure as the node does, connecting again where the connection is lost."""
    try:
        if not client.connected:
            client.connect()
            client.initialise()
        client.ensure_locked(tracker_world.MARKER, attempts=1)
        return '', client.measure().position
    except DeviceError as error:
        return str(error), None


@pytest.mark.parametrize('kind', TRACKER)
def test_laser_tracker(kind):
    world = FaultyReflectorWorld()
    behaviour = TrackerBehaviour(warm_up_s=3.0, search_failure_share=0.0)
    settings = LaserTrackerSettings(
        search_timeout_s=3.0, integration_s=0.5, reply_timeout_s=2.0, connect_timeout_s=2.0
    )
    with FakeLaserTracker(world, 'tracker', np.random.default_rng(1), behaviour=behaviour) as fake:
        client = LaserTrackerClient(
            *fake.address, settings=settings, now=world.now, sleep=world.sleep
        )
        deadline = time.monotonic() + 30
        while measured(client)[1] is None:
            assert time.monotonic() < deadline
        world.numbers = TRACKER[kind]
        if kind in ('intermittent', 'wrong', 'search fails'):
            fake.break_beam()
        # It has acted upon its faults once it asks for them again.
        asked = world.asked
        assert optitrack_world.eventually(lambda: world.asked > asked + 5)
        if 'renumbered' in world.numbers:
            assert optitrack_world.eventually(lambda: not client.connected)
        why, position = measured(client)
        world.numbers = {}
        parts = [re.sub(r'laser tracker 127.0.0.1:\d+', 'laser tracker', why)] if why else []
        if position is not None:
            off = np.linalg.norm(position - tracker_world.MARKER)
            assert (off > 0.1) == (kind == 'wrong')
            parts.append(
                'the reading is another reflector: refused by its place'
                if off > 0.1
                else 'waited for; the reading is good'
            )
        attempts = 0
        while True:
            attempts += 1
            again, position = measured(client)
            if position is not None and np.linalg.norm(position - tracker_world.MARKER) < 1e-3:
                break
            if position is not None:
                fake.break_beam()
            assert time.monotonic() < deadline + 30, again
            time.sleep(0.1)
        client.close()
    row = 'laser tracker' if kind in KINDS else 'named'
    name = kind if kind in KINDS else f'laser tracker: {kind}'
    observe(row, name, '; '.join([*parts, 'measures again by itself']))


def test_a_stray_during_the_registration(tmp_path):
    """At the second of three points a stray is taken for the marker; a fourth point decides."""
    cell = read_cell('demo')
    world, chain = make_world(tmp_path, cell, 1, 1.0), cell.chain()
    rng, truth = np.random.default_rng(4), world.truth
    sensor = truth.sensors['mocap']
    turns = np.array([[0.0] * 7, [0.5, 0.2] + [0.0] * 5, [-0.3, 0.4] + [0.0] * 5, [0.2] * 7])
    q = world.start_q + turns
    model_R = chain.positions(q, np.array(cell.markers['sir']))
    seen = truth.without_noise(chain, 'mocap', q)
    seen = seen + rng.normal(0, 3e-5, seen.shape)
    seen[1] = seen[0] + [0.1, 0.0, 0.0]
    with pytest.raises(InsufficientDataError) as refusal:
        register_ransac(model_R[:3], seen[:3], 0.025)
    T_R_N, agree = register_ransac(model_R, seen, 0.025)
    assert agree.tolist() == [True, False, True, True]
    assert np.linalg.norm(T_R_N[:3, 3] - sensor.T_R_N[:3, 3]) < 0.05
    text = f'{refusal.value}; the next point decides, and the stray is left out'
    observe('named', 'OptiTrack: marker swapped with a stray at the registration', text)


# The tables


def test_the_page_has_no_other_faults():
    """What is tried is compared where it is tried; a row of something else would stay."""
    matrix = page.cells('matrix')
    assert list(matrix) == [f'**{who}**' for who in DEVICES]
    assert all(tuple(row) == KINDS for row in matrix.values())
    assert set(page.cells('named')) == NAMED
