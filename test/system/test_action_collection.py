# SPDX-License-Identifier: Apache-2.0
"""A collection whose arm is commanded by FollowJointTrajectory.

The action is control_msgs' own where that is installed, else made from its definition; the server
stands for joint_trajectory_controller in front of the fake arm (test/rigs/action_controller.py).
"""

import os

import numpy as np
import pytest
from rigs import control_messages
from rigs.collection_rig import Cell
from rigs.ros_rig import call

from remaster_ros.nodes.controller_link import COPIES
from remaster_ros.session.bags.bag import BagReader

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.fixture
def with_control_messages(ros_environment):
    try:
        folder = control_messages.control_messages()
    except LookupError as error:
        pytest.skip(str(error))
    if folder is not None:
        ros_environment['PYTHONPATH'] += f'{os.pathsep}{folder}'


@pytest.mark.qualify
def test_a_collection_by_the_action_with_a_pause_and_a_bridge_that_is_killed(
    with_control_messages, start, client, tmp_path
):
    from sensor_msgs.msg import JointState

    # As a gripper's driver does, whose joints are none of the arm's.
    gripper = client.create_publisher(JointState, 'joint_states', 10)
    client.create_timer(
        0.02, lambda: gripper.publish(JointState(name=['finger'], position=[0.01]))
    )
    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'], by_action=True, candidates=3)

    def stops():
        return int(cell.said['robot_bridge'].get('stopped', 0))

    cell.until(lambda: 'recorded' in cell.results, 'the first configuration')
    # Most of the time the arm moves, but where it stands no stop is needed.
    for _ in range(10):
        call(client, '/remaster/pause')
        cell.until(lambda: cell.said['pose_planner']['state'] == 'paused', 'the pause')
        call(client, '/remaster/collect')
        if stops():
            break
    cell.said.pop('robot_bridge')
    cell.kill_and_start('robot_bridge')
    cell.until(lambda: 'robot_bridge' in cell.said, 'the bridge')
    cell.until(lambda: not cell.said['robot_bridge']['halted'], 'no halt')
    session = cell.complete()
    cell.check(session)
    print(cell.ended(session))

    from rclpy.serialization import deserialize_message
    from trajectory_msgs.msg import JointTrajectory

    commands = [
        deserialize_message(message.cdr, JointTrajectory)
        for message in BagReader(cell.session / 'bag')
        if message.topic == f'/{COPIES}'
    ]
    lengths = np.array([len(command.points) for command in commands])
    assert np.sum(lengths > 1) >= cell.planned()
    assert np.any(lengths == 1), 'no stop was commanded'
