# SPDX-License-Identifier: Apache-2.0
"""A planner never moves the arm before /remaster/collect, unless its run still lives."""

import os
import time

import pytest
from rigs.collection_rig import Cell
from rigs.ros_rig import PATIENCE, call, node_arguments

from remaster_ros.collection.events import BridgeState

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.fixture
def cell(start, client, tmp_path):
    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'])
    cell.until(lambda: cell.results.count('recorded') > 1, 'the first configurations')
    return cell


def planner(cell, key):
    return cell.said.get('pose_planner', {}).get(key, '')


def restart(cell, *names):
    """Kill the planner and others and start them again; wait for the new planner's decision."""
    restarted = (*names, 'pose_planner')
    before = {name: cell.said[name]['started'] for name in restarted}
    for name in restarted:
        cell.nodes[name].kill()
        cell.nodes[name].wait()
    for name in restarted:
        cell.nodes[name] = cell._begin(name)
    # What the killed ones had sent is on its way still, and must not pass for the new ones.
    cell.until(
        lambda: (
            all(cell.said[name]['started'] != before[name] for name in restarted)
            and (planner(cell, 'state') == 'running' or planner(cell, 'resuming') == 'no')
        ),
        'the decision',
    )


def stands(cell, seconds=2.0):
    """Check that nothing is commanded for some seconds and that the planner does not run."""
    cell.told_to_stand()
    commanded = cell.said['robot_bridge']['commanded']
    until = time.monotonic() + seconds
    cell.until(lambda: time.monotonic() > until, 'time')
    assert cell.said['robot_bridge']['commanded'] == commanded
    assert planner(cell, 'state') != 'running'


@pytest.mark.qualify
def test_a_killed_planner_goes_on_in_its_run(cell):
    token = planner(cell, 'run')
    cell.until(lambda: cell.recorder('run') == token, 'the recorder')
    restart(cell)
    assert planner(cell, 'state') == 'running'
    assert planner(cell, 'run') == token
    cell.check(cell.complete())


@pytest.mark.qualify
@pytest.mark.parametrize('other', ['recorder', 'robot_bridge'])
def test_it_waits_where_another_node_was_started_again(cell, other):
    restart(cell, other)
    assert planner(cell, 'state') == 'idle'
    words = f'/remaster/collect goes on ({other} did not take part in its run)'
    assert cell.messages['pose_planner'].endswith(words)
    stands(cell)
    assert call(cell.client, '/remaster/collect').success
    cell.check(cell.complete())


@pytest.mark.qualify
def test_it_waits_after_a_pause_and_whatever_the_files_are_dated(cell):
    """Paused and killed at once; then a plan file that is dated in the future."""
    assert call(cell.client, '/remaster/pause').success
    restart(cell)
    assert planner(cell, 'state') == 'idle'
    cell.nodes['pose_planner'].kill()
    cell.nodes['pose_planner'].wait()
    future = time.time() + 1e6
    os.utime(cell.session / 'plan.jsonl', (future, future))
    restart(cell)
    stands(cell)


@pytest.mark.qualify
def test_a_session_of_another_day_waits(start, cell, tmp_path):
    """All nodes were killed, so that none holds the run token; the plan file is dated now."""
    for process in cell.nodes.values():
        process.kill()
        process.wait()
    os.utime(cell.session / 'plan.jsonl')
    cell.said.clear()
    for name in cell.nodes:
        cell.nodes[name] = cell._begin(name)
    cell.until(lambda: planner(cell, 'resuming') == 'no', 'the decision')
    cell.until(lambda: 'robot_bridge' in cell.said, 'the bridge')
    stands(cell)


def test_a_halted_arm_is_not_collected_with(start, client, tmp_path):
    """The planner alone, with a bridge of the test that reports a halt."""
    import rclpy
    from sensor_msgs.msg import JointState

    from remaster_ros.nodes.status import RELIABLE, NodeStatus, Summary, listen
    from remaster_ros.session.cells.workcell import read_cell

    halted = 'the robot does not follow'
    bridge = rclpy.create_node('robot_bridge', context=client.context)
    status = NodeStatus(bridge, lambda: Summary('ok', '', {}, BridgeState(halted=halted)))
    said = {}
    listen(
        client, lambda event: None, lambda node, text, values: said.update({node: (text, values)})
    )
    joints = client.create_publisher(JointState, 'joint_states', RELIABLE)
    start('remaster_ros.nodes.pose_planner', *node_arguments(session=tmp_path / 'session'))
    names = list(read_cell('demo').chain().joint_names)

    def until(condition, what, timeout_s=60):
        deadline = time.monotonic() + PATIENCE * timeout_s
        while not condition():
            assert time.monotonic() < deadline, what
            joints.publish(JointState(name=names, position=[0.1] * 7))
            status.publish()
            for _ in range(5):
                client.spin_some()

    until(lambda: said.get('pose_planner', ('', {}))[1].get('robot') == 'heard', 'the planner')
    refused = call(client, '/remaster/collect')
    assert not refused.success
    assert refused.message == (
        'the arm is halted: the robot does not follow; /remaster/clear_halt, then collect'
    )
    halted = ''
    status.publish()
    response = call(client, '/remaster/collect')
    until(lambda: said['pose_planner'][1]['state'] == 'running' or not response.success, 'running')
    assert response.success, response.message
    halted = 'emergency stop'
    until(lambda: said['pose_planner'][1]['state'] == 'paused', 'the pause')
    assert said['pose_planner'][0] == 'emergency stop'
    halted = ''
    until_later = time.monotonic() + 1.5
    until(lambda: time.monotonic() > until_later, 'time')
    assert said['pose_planner'][1]['state'] == 'paused', 'no status message ends a halt'
    bridge.destroy_node()
