# SPDX-License-Identifier: Apache-2.0
"""A topic of another package's node as a sensor, through real DDS: its publishers are fakes."""

import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from remaster_ros.collection.events import SensorReport
from remaster_ros.collection.message_fields import seconds
from remaster_ros.errors import InputError
from remaster_ros.nodes.messages import stamp_of
from remaster_ros.sensors.registry import GENERIC
from remaster_ros.session.cells.workcell import config_path

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]

PLACE = np.array([0.5, -0.25, 2.0])
SOURCE = '/vrpn_mocap/tool/pose'


def cell_of(folder, message_type):
    """Return the demo cell with a bar that another package's node reads."""
    text = config_path('cells/demo.yaml').read_text(encoding='utf-8')
    text = text.replace('../robots', str(config_path('robots'))).replace(
        'topic: optitrack/marker', f'topic: {SOURCE}\n    message_type: {message_type}'
    )
    path = folder / 'cell.yaml'
    path.write_text(text, encoding='utf-8')
    return path


def fake_message(kind, stamp_s, position):
    """What a tracker's own driver (PointStamped), or a mocap driver or tag detector, publishes."""
    message = kind()
    message.header.stamp, message.header.frame_id = stamp_of(stamp_s), 'world'
    place = message.point if kind is PointStamped else message.pose.position
    place.x, place.y, place.z = map(float, position)
    return message


@pytest.fixture
def rig(start_sensor, tmp_path):
    """Return a function that starts the sensor's node, and a peer that publishes and listens."""

    def start(message_type, name='topic_markers_mocap'):
        r = start_sensor(name, GENERIC, cell=cell_of(tmp_path, message_type), sensor='mocap')
        r.points = []
        r.peer.create_subscription(PointStamped, 'mocap/marker', r.points.append, 100)
        return r

    return start


@pytest.mark.parametrize(
    ('kind', 'reliability', 'durability'),
    [
        (PointStamped, ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE),
        (PoseStamped, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
    ],
)
def test_readings_and_state_come_of_a_stream_without_heartbeat(rig, kind, reliability, durability):
    r = rig(f'geometry_msgs/msg/{kind.__name__}')
    r.wait(lambda: 'no node publishes' in r.summary().message, 'a source that is not there')
    assert not r.summary().state.ready
    qos = QoSProfile(depth=10, reliability=reliability, durability=durability)
    source = r.peer.create_publisher(kind, SOURCE, qos)
    rng = np.random.default_rng(1)
    sent = []

    def publish():
        sent.append(time.time())
        position = PLACE + 1e-4 * rng.standard_normal(3)
        source.publish(fake_message(kind, sent[-1], position))

    r.wait(lambda: len(r.points) > 15, 'readings', publish)
    first = r.points[0]
    assert first.header.frame_id == 'mocap'
    assert np.min(np.abs(np.array(sent) - seconds(first.header.stamp))) < 1e-6
    assert np.allclose([first.point.x, first.point.y, first.point.z], PLACE, atol=1e-3)
    summary = r.summary()
    assert summary.state == SensorReport(sensor='mocap', ready=True, message='ok')
    assert float(summary.values['rate_hz']) > 5.0
    assert 0.03 < float(summary.values['std_mm']) < 0.3
    # It sends nothing more, and is still there: the marker may be out of its sight.
    r.wait(lambda: r.summary().state.hidden, 'silence')
    assert r.summary().state.ready
    r.peer.destroy_publisher(source)
    r.wait(lambda: not r.summary().state.ready, 'the end of the source')


def test_what_cannot_be_read_ends_the_node_with_one_line(rig):
    with pytest.raises(InputError, match='mocap4r2_msgs is not installed here; install'):
        rig('mocap4r2_msgs/msg/Markers')
    rclpy.try_shutdown()
    with pytest.raises(InputError, match='has a message_type; its node is a topic_markers'):
        rig('geometry_msgs/msg/PointStamped', name='optitrack_markers')
