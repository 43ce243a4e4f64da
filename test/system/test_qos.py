# SPDX-License-Identifier: Apache-2.0
"""Best-effort joint states are received; a mismatch of the quality of service is reported."""

import pytest
from rigs.ros_rig import node_arguments, wait_until

from remaster_ros.session.cells.workcell import read_cell

pytestmark = [pytest.mark.ros, pytest.mark.timeout(900)]

NAMES = list(read_cell('demo').chain().joint_names)


@pytest.fixture
def said(client):
    from remaster_ros.nodes.status import listen

    summaries = {}

    def summary(node, message, values):
        summaries[node] = {'message': message, **values}

    listen(client, lambda event: None, summary)
    return summaries


@pytest.mark.parametrize('reliable', [True, False])
def test_joint_states_of_any_driver_are_taken(start, client, said, tmp_path, reliable):
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import JointState

    policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    publisher = client.create_publisher(
        JointState, 'joint_states', QoSProfile(depth=5, reliability=policy)
    )
    start('remaster_ros.nodes.pose_planner', *node_arguments(session=tmp_path / 'session'))

    def heard():
        publisher.publish(JointState(name=NAMES, position=[0.1] * 7))
        client.spin_some()
        return said.get('pose_planner', {}).get('robot') == 'heard'

    wait_until(heard, 60, 'the joint states')


def test_a_mismatch_is_reported_until_it_ends(start, client, said, tmp_path):
    from geometry_msgs.msg import PointStamped
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = client.create_publisher(PointStamped, 'optitrack/marker', best_effort)
    start('remaster_ros.nodes.recorder', *node_arguments(session=tmp_path / 'session'))
    words = (
        'nothing of /optitrack/marker comes from /test_client: it publishes best-effort, wanted '
        'is reliable'
    )

    def says(text):
        client.spin_some()
        return said.get('recorder', {}).get('qos_trouble') == text

    wait_until(lambda: says(words), 60, words)
    client.destroy_publisher(publisher)
    wait_until(lambda: says(''), 30, 'its end')
