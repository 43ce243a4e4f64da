# SPDX-License-Identifier: Apache-2.0
"""The node of any sensor, around drivers without a device: what is published, retried, refused."""

import os
import sys
import time
from dataclasses import dataclass

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from geometry_msgs.msg import PointStamped, PoseStamped, TransformStamped
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from remaster_ros.collection.message_fields import seconds
from remaster_ros.errors import DeviceError, InputError
from remaster_ros.kinematics.transforms import transform
from remaster_ros.nodes.messages import transform_message
from remaster_ros.nodes.simulated_clock import TAKEN
from remaster_ros.nodes.status import LATCHED, pairs
from remaster_ros.parameters import parameter
from remaster_ros.sensors import registry
from remaster_ros.sensors.driver import SensorParameters, StreamDriver, TriggeredDriver
from remaster_ros.session.cells.workcell import config_path, read_cell
from remaster_ros.types import MarkerReading

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]

PLACE = np.array([0.5, -0.25, 2.0])


@dataclass(frozen=True)
class GaugeParameters(SensorParameters):
    """Parameters of a gauge."""

    scale: float = parameter(1.0, 'a number', low=0.5, high=2.0)


class Device:
    """What both drivers have in common: a device that fails as the test sets it."""

    parameters_type = GaugeParameters
    device = 'gauge'
    refusals = 0
    fault = None

    def __init__(self, parameters, clock):
        self.p, self.clock, self.opened, self.closed = parameters, clock, 0, 0

    def open(self):
        if type(self).refusals > self.opened:
            self.opened += 1
            raise DeviceError('gauge: the cable is out')
        self.opened += 1

    def close(self):
        self.closed += 1


class Stream(Device, StreamDriver):
    """Gives what the test has put in."""

    def __init__(self, parameters, clock):
        super().__init__(parameters, clock)
        self.readings = []

    def read(self):
        time.sleep(0.01)
        if self.fault is not None:
            fault, self.fault = self.fault, None
            raise fault
        return self.readings.pop(0) if self.readings else None


class Probe(Device, TriggeredDriver):
    """Measures where the marker is expected."""

    expected = None
    prepared = 0

    def measure(self, expected):
        self.expected = expected
        if self.fault is not None:
            raise self.fault
        return MarkerReading(12.5, PLACE, temperature_c=21.5)


class Turret(Probe):
    """The same, of several markers, one after another; one of them may be out of its sight."""

    several_markers = True
    hidden = 'none'

    def __init__(self, parameters, clock):
        super().__init__(parameters, clock)
        self.turns = []
        self.time_s = 20.0

    def turn_to(self, marker, expected):
        self.turns.append((marker, expected))
        if marker == self.hidden:
            raise DeviceError('gauge: it is not there')

    def measure(self, expected):
        super().measure(expected)
        self.time_s += 1.0
        return MarkerReading(self.time_s, PLACE if expected is None else expected)


class LookingProbe(Probe):
    """The same, which looks for a lost marker when the arm has arrived."""

    def prepare(self, expected):
        self.prepared += 1


def shown(summary):
    """Return what people are shown of a node."""
    return {**pairs(summary.state), **summary.values}


@pytest.fixture
def rig(start_sensor, monkeypatch):
    """Return a function that starts the node of a driver, and a peer that listens."""

    def start(driver, name='gauge', own_name=registry.GENERIC, **parameters):
        monkeypatch.setitem(registry.DRIVERS, 'gauge', f'{__name__}:{driver.__name__}')
        monkeypatch.setitem(sys.modules, f'remaster_ros.sensors.{__name__}', sys.modules[__name__])
        triggered = issubclass(driver, TriggeredDriver)
        place = 'laser_tracker' if triggered else 'optitrack'
        sensor = 'tracker' if triggered else 'mocap'
        r = start_sensor(name, own_name, **{'sensor': sensor, **parameters})
        r.points, r.temperatures, r.driver = [], [], r.node.driver
        r.peer.create_subscription(PointStamped, f'{place}/marker', r.points.append, 10)
        r.peer.create_subscription(Temperature, f'{place}/temperature', r.temperatures.append, 10)

        def measure():
            client = r.peer.create_client(Trigger, 'laser_tracker/measure')
            r.wait(client.service_is_ready, 'the service')
            future = client.call_async(Trigger.Request())
            r.wait(future.done, 'the answer')
            return future.result()

        r.measure, r.values = measure, lambda: shown(r.summary())
        r.wait(lambda: r.peer.count_publishers(f'{place}/marker'), 'the match')
        return r

    return start


def test_a_stream_is_published_under_its_time_of_capture(rig):
    r = rig(Stream, scale=1.5)
    assert r.driver.p.scale == 1.5
    r.wait(lambda: r.node._readings[''].get_subscription_count(), 'the match')
    r.driver.readings.append(MarkerReading(7.25, PLACE))
    r.wait(lambda: r.points, 'the point')
    (point,) = r.points
    assert (seconds(point.header.stamp), point.header.frame_id) == (7.25, 'mocap')
    assert (point.point.x, point.point.y, point.point.z) == tuple(PLACE)
    assert {'sensor': 'mocap', 'ready': 'yes', 'published': 1}.items() <= r.values().items()


@pytest.mark.parametrize('simulated', [True, False])
def test_a_simulated_world_learns_until_when_a_stream_has_been_taken(rig, simulated):
    r = rig(Stream, use_sim_time=str(simulated).lower())
    taken = []
    r.peer.create_subscription(Header, TAKEN, taken.append, 10)
    r.wait(lambda: r.node._readings[''].get_subscription_count(), 'the match')
    assert r.node.count_publishers(TAKEN) == simulated
    r.wait(lambda: r.peer.count_publishers(TAKEN) == simulated, 'the match')
    r.driver.received_s = 7.5
    r.driver.readings.append(MarkerReading(7.25, PLACE))
    r.wait(lambda: r.points, 'the point')
    if simulated:
        r.wait(lambda: 7.5 in [seconds(message.stamp) for message in taken], 'that it was taken')
        assert {message.frame_id for message in taken} == {str(os.getpid())}


class Body(Stream):
    """The same, of several markers."""

    several_markers = True


def test_markers_of_a_frame_have_topics_of_their_own_and_one_stamp(rig):
    r = rig(Body, cell='quick')
    assert dict(r.driver.p.further_markers) == {'sir_2': 2, 'sir_3': 3}
    further = []
    r.peer.create_subscription(PointStamped, 'optitrack/marker/sir_3', further.append, 10)
    r.wait(
        lambda: all(r.node._readings[name].get_subscription_count() for name in ('', 'sir_3')),
        'the match',
    )
    r.driver.readings += [
        MarkerReading(7.25, PLACE),
        MarkerReading(7.25, PLACE + 0.05, marker='sir_3'),
    ]
    r.wait(lambda: r.points and further, 'both points')
    assert r.points[0].header == further[0].header
    assert further[0].point.x == PLACE[0] + 0.05
    assert len(r.points) == len(further) == 1


def test_markers_are_measured_one_after_another_once_the_sensor_is_registered(rig, tmp_path):
    text = config_path('cells/demo.yaml').read_text(encoding='utf-8')
    text = text.replace('../robots', str(config_path('robots')))
    text = text.replace('  smr: [-0.1', '  smr_2: [0.0, 0.1, 0.0]\n  smr: [-0.1')
    path = tmp_path / 'cell.yaml'
    path.write_text(text.replace('marker: smr', 'marker: smr\n    further_markers: {smr_2: 2}'))
    r = rig(Turret, cell=path)
    second, chain = [], read_cell(path).chain()
    r.peer.create_subscription(PointStamped, 'laser_tracker/marker/smr_2', second.append, 10)
    registration = r.peer.create_publisher(TransformStamped, 'remaster/registration', LATCHED)
    joints = r.peer.create_publisher(JointState, 'joint_states', 10)
    r.wait(
        lambda: (
            r.node._readings['smr_2'].get_subscription_count() and joints.get_subscription_count()
        ),
        'the match',
    )
    assert r.measure().success
    r.wait(lambda: r.points and second, 'both points')
    # Where the other is, nobody knows yet.
    assert (r.driver.turns, np.isnan(second[0].point.x)) == ([], True)

    T_R_N = transform(np.eye(3), [1.0, 2.0, 3.0])
    registration.publish(transform_message('base_link', 'tracker', T_R_N))
    q = np.linspace(0.1, 0.7, len(chain))
    message = JointState(name=list(chain.joint_names), position=q.tolist())

    def expects():
        joints.publish(message)
        return r.node._step.__self__._expected() is not None

    r.wait(expects, 'registration and joints')
    places = {
        name: chain.positions(q, np.array(at)) - T_R_N[:3, 3]
        for name, at in (('', [-0.1, 0.0, 0.0]), ('smr_2', [0.0, 0.1, 0.0]))
    }
    assert r.measure().success
    assert r.measure().success
    # The second time the last one first: the beam is on it.
    assert [marker for marker, _ in r.driver.turns] == ['', 'smr_2', 'smr_2', '']
    for marker, expected in r.driver.turns:
        np.testing.assert_allclose(expected, places[marker], atol=1e-9)
    r.wait(lambda: len(r.points) == len(second) == 3, 'all points')
    stamps = [seconds(point.header.stamp) for point in (*r.points, *second)]
    assert stamps == [21.0, 22.0, 25.0, 21.0, 23.0, 24.0]

    r.driver.hidden = ''
    answer = r.measure()
    assert (answer.success, answer.message) == (True, 'gauge: it is not there')
    r.wait(lambda: len(r.points) == len(second) == 4, 'a message of each')
    assert np.isnan(r.points[3].point.x)
    assert r.node._summary()[:2] == ('warn', 'gauge: it is not there')


def test_a_stream_that_is_lost_is_opened_again(rig):
    r = rig(Stream)
    r.driver.readings.append(MarkerReading(1.0, PLACE))
    r.wait(lambda: r.node.published == 1, 'the first reading')
    r.driver.fault = DeviceError('gauge: the line is dead')
    r.wait(lambda: r.values()['ready'] == 'no', 'the loss')
    assert r.node._summary()[:2] == ('error', 'gauge: the line is dead')
    r.wait(lambda: r.driver.opened == 2, 'the second opening')
    r.driver.readings.append(MarkerReading(2.0, PLACE))
    r.wait(lambda: r.node.published == 2, 'the next reading')
    assert (r.values()['ready'], r.driver.closed) == ('yes', 1)
    assert r.node.failure is None


def test_a_stream_that_never_gives_a_reading_ends_the_node(rig):
    r = rig(Stream, start_timeout_s=0.2)
    r.wait(lambda: r.node.failure, 'the end')
    assert str(r.node.failure) == 'gauge: no reading of the marker'


def test_a_device_that_never_answers_ends_the_node(rig, monkeypatch):
    monkeypatch.setattr(Device, 'refusals', 1000)
    r = rig(Probe, start_timeout_s=0.2)
    r.wait(lambda: r.node.failure, 'the end')
    assert str(r.node.failure) == 'gauge: the cable is out'


def test_a_fault_of_the_driver_ends_the_node(rig):
    r = rig(Stream)
    r.driver.fault = ZeroDivisionError('no thought')
    r.wait(lambda: r.node.failure, 'the end')
    assert 'a fault of this program' in str(r.node.failure)


def test_a_measurement_is_published_before_its_answer(rig, monkeypatch):
    # Until it was asked: on a busy machine a service is found late.
    monkeypatch.setattr(Device, 'refusals', 1000)
    r = rig(Probe)
    refused = r.measure()
    assert not refused.success
    assert refused.message == 'the gauge is connecting: gauge: the cable is out'
    monkeypatch.setattr(Device, 'refusals', 0)
    r.wait(lambda: r.values()['ready'] == 'yes', 'the connection')
    assert r.driver.closed == r.driver.opened - 1 > 0
    answer = r.measure()
    assert (answer.success, answer.message) == (True, 'measured')
    r.wait(lambda: r.points and r.temperatures, 'the point')
    assert seconds(r.points[0].header.stamp) == 12.5
    assert r.temperatures[0].temperature == 21.5
    assert r.temperatures[0].header == r.points[0].header
    assert r.driver.expected is None

    r.driver.fault = DeviceError('gauge: nothing in view')
    assert r.measure().message == 'gauge: nothing in view'
    assert r.node._summary()[:2] == ('warn', 'gauge: nothing in view')
    assert r.values()['ready'] == 'yes'
    assert len(r.points) == 1


def test_the_driver_is_given_the_expected_place(rig):
    """Marker smr lies -0.1 m along x of the tool; the sensor stands 2 m along x, not turned."""
    r = rig(Probe)
    r.wait(lambda: r.values()['ready'] == 'yes', 'the connection')
    registration = TransformStamped(child_frame_id='tracker')
    registration.transform.translation.x = 2.0
    registration.transform.rotation.w = 1.0
    pose = PoseStamped()
    pose.pose.position.z = 0.5
    pose.pose.orientation.w = 1.0
    r.peer.create_publisher(TransformStamped, 'remaster/registration', LATCHED).publish(
        registration
    )
    publisher = r.peer.create_publisher(PoseStamped, 'remaster/target_pose', 10)
    r.wait(publisher.get_subscription_count, 'the match')
    publisher.publish(pose)

    def expected():
        r.measure()
        return r.driver.expected is not None

    r.wait(expected, 'the place')
    np.testing.assert_allclose(r.driver.expected, [-2.1, 0.0, 0.5], atol=1e-12)


def test_the_name_of_the_node_chooses_the_driver(rig, monkeypatch):
    with pytest.raises(InputError, match='leica: the name of the node chooses its driver'):
        rig(Probe, name='leica')
    assert registry.kind_of('laser_tracker_markers_left') == 'laser_tracker_markers'
    monkeypatch.setitem(registry.DRIVERS, 'laser', 'laser.driver:Laser')
    assert registry.kind_of('laser_tracker_markers') == 'laser_tracker_markers'
    assert registry.kind_of('laser_2') == 'laser'
    monkeypatch.delitem(registry.DRIVERS, 'laser')
    for kind in registry.DRIVERS:
        if kind != 'gauge':
            assert issubclass(registry.load_driver(kind), StreamDriver | TriggeredDriver)


def test_a_node_that_hears_commands_is_named_so_that_the_bridge_can_tell(rig):
    with pytest.raises(InputError, match='takes a node of this name for a controller'):
        rig(LookingProbe, name='faro', own_name='gauge')


@pytest.mark.parametrize(
    ('driver', 'sensor', 'words'),
    [
        (Stream, 'sonar', r"sensor is 'sonar'; the cell has mocap, tracker"),
        (Stream, 'tracker', 'tracker of demo has single_shot true, but a gauge streams'),
        (Probe, 'mocap', 'mocap of demo has single_shot false, but a gauge measures on request'),
    ],
)
def test_a_sensor_that_is_not_so_in_the_cell_is_refused(rig, driver, sensor, words):
    with pytest.raises(InputError, match=words):
        rig(driver, name=f'gauge_{driver.__name__}_{sensor}', sensor=sensor)


def test_a_device_of_one_marker_refuses_a_cell_with_several(rig):
    with pytest.raises(InputError, match='has further_markers, but a gauge measures one marker'):
        rig(Stream, name='gauge_of_one', cell='quick')
