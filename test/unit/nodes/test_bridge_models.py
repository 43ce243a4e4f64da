# SPDX-License-Identifier: Apache-2.0
"""A bridge does not move an arm that planner, recorder or the robot itself know otherwise."""

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

import msgspec
from bridge_places import AWAY
from bridge_rig import CELL, MODEL
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from remaster_ros.nodes.robot_bridge import WATCH_WALL_S
from remaster_ros.session.cells.workcell import config_path

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]

IIWA = msgspec.structs.replace(MODEL, urdf='c' * 64, urdf_file='/other/iiwa7.urdf')
IIWA_URDF = config_path('robots/iiwa7.urdf').read_text(encoding='utf-8')
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def stays(r):
    """Nothing is commanded, and the reason is shown."""
    r.plan(AWAY)
    r.run(4.0)
    assert not r.commands
    return r.bridge._summary().message


@pytest.mark.parametrize('node', ['/pose_planner', '/recorder'])
def test_nothing_moves_by_a_node_of_another_arm(rig, node):
    r = rig(ready=False, first=True)
    r.models[node] = IIWA
    r.alone()
    r.run(2.0)
    said = stays(r)
    assert f'robot_bridge has the URDF {MODEL.urdf_file} (checksum {MODEL.urdf[:8]})' in said
    assert f'{node[1:]} has /other/iiwa7.urdf (cccccccc)' in said
    # Started again with the right cell. Found in a run that a person has begun, it was a halt.
    r.models.clear()
    if r.halted():
        r.run(1.0)
        assert r.call_clear().success
        r.say_planner('paused')
        r.say_planner('running')
    r.run(8.0, lambda: r.commands)


def test_nothing_moves_by_a_planner_that_does_not_name_its_arm(rig):
    r = rig(ready=False)
    r.models['/pose_planner'] = None
    r.alone()
    r.run(2.0)
    assert 'the records of /pose_planner do not tell which arm it plans for' in stays(r)


def test_a_planner_of_another_arm_in_a_collection_halts_it(rig):
    r = rig()
    r.go(AWAY, speed=0.2)
    r.models['/pose_planner'] = IIWA
    r.run(1.0, r.halted)
    assert '/other/iiwa7.urdf' in r.halted()


def test_nothing_moves_by_the_description_of_another_arm(rig):
    r = rig(ready=False)
    publisher = r.peer.create_publisher(String, 'robot_description', LATCHED)
    publisher.publish(String(data=IIWA_URDF))
    r.wait(lambda: r.bridge._described, 'the description')
    r.alone()
    r.run(2.0)
    said = stays(r)
    assert (
        f'/robot_description is not the URDF of the cell, {MODEL.urdf_file}: the axis of' in said
    )


def test_the_description_of_the_arm_with_a_gripper_is_welcome(rig):
    r = rig(ready=False)
    gripper = (
        '<link name="hand"/><joint name="hand_joint" type="fixed"><parent link="tool"/>'
        '<child link="hand"/></joint></robot>'
    )
    taken = []
    r.bridge._on_description, original = (
        lambda m: taken.append(original(m)),
        r.bridge._on_description,
    )
    publisher = r.peer.create_publisher(String, 'robot_description', LATCHED)
    publisher.publish(String(data=CELL.urdf_text.replace('</robot>', gripper)))
    r.alone()
    r.run(WATCH_WALL_S)
    assert not r.bridge._described
    r.run(2.5)
    r.plan(AWAY)
    r.run(4.0, lambda: r.commands)
