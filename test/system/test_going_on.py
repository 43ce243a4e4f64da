# SPDX-License-Identifier: Apache-2.0
"""Nodes without the demo around them: which sensor the arm waits for, and a disk that fills up."""

import resource
from contextlib import contextmanager

import numpy as np
import pytest
from rigs.collection_rig import SEED, Cell
from rigs.ros_rig import call, node_arguments, wait_until

from remaster_ros.collection.events import (
    ConfigurationEnded,
    EventRecord,
    PoseAnnounced,
    encode,
)
from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.faults import inject

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]


@contextmanager
def no_room(process):
    """Nothing that this process writes can become longer, as on a full disk."""
    before = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (1, before[1]))
    try:
        yield
    finally:
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, before)


def test_one_required_sensor_is_enough_and_a_full_disk_is_waited_for(start, client, tmp_path):
    """The tracker is not there at all; then recorder and planner have no room to write."""
    # The planner writes at each pose: another one follows the first.
    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'], candidates=5)
    cell.until(lambda: cell.results.count('recorded') > 4, 'the first configurations')

    with no_room(cell.nodes['recorder']):
        cell.until(lambda: 'room on the disk' in cell.recorder('waiting_for'), 'the reason')
        assert 'journal.jsonl: cannot be written' in cell.recorder('waiting_for')
        acknowledged = len(cell.results)
        message = f'waiting for {cell.recorder("waiting_for")}'
        cell.until(lambda: cell.messages['robot_bridge'] == message, 'the bridge')
        recorded = len(read_session(cell.session).measurements)
        assert recorded == int(cell.recorder('observations'))
        assert len(cell.results) == acknowledged
    cell.until(lambda: len(cell.results) > acknowledged, 'the next configuration')
    with no_room(cell.nodes['pose_planner']):
        cell.until(lambda: 'room on the disk' in cell.messages['pose_planner'], 'the reason')
        cell.until(lambda: cell.messages['robot_bridge'] == 'planner is held', 'the bridge')

    session = cell.complete()
    cell.check(session)
    assert cell.recorder('waiting_for') == ''
    assert session.sensor_names == ('mocap', 'tracker')
    assert set(session.measurements.sensor.tolist()) == {0}
    assert cell.recorder('bag_dropped') == '0'
    # Also what came while there was no room.
    settled = [m for m in BagReader(cell.session / 'bag') if m.topic == '/remaster/settled']
    assert len(settled) >= len(cell.results)


@pytest.mark.qualify
def test_any_sensor_is_enough(start, client, tmp_path):
    """The bar stops for good in the middle: the collection goes on with the tracker, at once."""
    cell = Cell(start, client, tmp_path, 'any', ['mocap', 'tracker'])
    cell.until(lambda: int(cell.recorder('observations') or 0) > 1, 'the first configurations')
    inject(tmp_path / 'world', {'mocap': {'off': 1}})
    session = cell.complete()
    cell.check(session)
    assert set(session.measurements.sensor.tolist()) == {0, 1}
    assert session.measurements.sensor[-1] == 1


@pytest.mark.qualify
def test_a_collection_goes_on_where_the_tracker_does_not_see_its_marker(start, client, tmp_path):
    """Planner and recorder die before the registration is complete, and the beam is broken.

    Only the next pose can show the marker again: a preflight that waits for it waits for ever.
    """
    cell = Cell(start, client, tmp_path, 'all', ['mocap', 'tracker'])
    cell.until(lambda: cell.results.count('recorded') == 1, 'the first registration pose')
    inject(tmp_path / 'world', {'tracker': {'occluded': 1}})
    cell.kill_and_start('recorder')
    cell.said.pop('pose_planner', None)
    cell.kill_and_start('pose_planner')
    # With both gone nobody is left who took part in the run: a person has to begin it again.
    cell.until(
        lambda: cell.said.get('pose_planner', {}).get('resuming') == 'no', 'the decision to wait'
    )
    assert cell.said['pose_planner']['state'] == 'idle'
    assert call(client, '/remaster/collect').success
    cell.until(lambda: 'partial' in cell.results, 'the next pose')
    inject(tmp_path / 'world', {})
    cell.check(cell.complete())


def test_a_settled_arm_is_measured_though_its_pose_arrives_later(start, client, tmp_path):
    """Topics overtake each other: /remaster/settled comes before what the planner announced."""
    from geometry_msgs.msg import PointStamped
    from sensor_msgs.msg import JointState
    from std_msgs.msg import String
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    from remaster_ros.collection.message_fields import stamp_key
    from remaster_ros.nodes.status import RELIABLE, listen

    cell = read_cell('demo')
    names, rng = cell.chain().joint_names, np.random.default_rng(SEED)
    print('seed', SEED)
    q = np.array([0.0, 0.3, 0.0, 1.0, 0.0, 0.5, 0.0])
    heard, counts = [], {}
    listen(
        client,
        lambda record: heard.append(record.body),
        lambda node, message, values: counts.update(values),
    )
    publishers = {
        topic: client.create_publisher(kind, topic, RELIABLE)
        for topic, kind in (
            ('/joint_states', JointState),
            ('/remaster/settled', JointState),
            ('/remaster/joint_solutions', JointTrajectory),
            (cell.sensors['mocap'].topic, PointStamped),
        )
    }
    start(
        'remaster_ros.nodes.recorder',
        *node_arguments(session=tmp_path / 'session', require='mocap', call_measure=False),
    )

    def joints():
        message = JointState(name=list(names), position=(q + rng.normal(0, 1e-6, 7)).tolist())
        message.header.stamp = client.get_clock().now().to_msg()
        return message

    def live():
        publishers['/joint_states'].publish(joints())
        point = PointStamped()
        point.header.stamp = client.get_clock().now().to_msg()
        point.point.x, point.point.y, point.point.z = rng.normal(2.0, 1e-5, 3)
        publishers[cell.sensors['mocap'].topic].publish(point)
        client.spin_some()

    def until(condition, what):
        wait_until(lambda: live() or condition(), 60, what)

    until(lambda: counts.get('read_age_s_mocap', 'inf') == '0.0', 'the recorder')
    publishers['/remaster/settled'].publish(joints())
    until(lambda: counts.get('settled_unknown') == '1', 'a pose that nobody knows')
    solutions = JointTrajectory(joint_names=list(names))
    solutions.header.stamp = client.get_clock().now().to_msg()
    solutions.points = [JointTrajectoryPoint(positions=q.tolist())]
    publishers['/remaster/joint_solutions'].publish(solutions)
    records = client.create_publisher(String, '/remaster/events', RELIABLE)
    until(lambda: records.get_subscription_count() > 1, 'the recorder and this test')
    stamp = stamp_key(solutions.header.stamp)
    pose = PoseAnnounced(stamp=stamp, pose=0, split='optimization', ids=(0,), plan='p')
    records.publish(String(data=encode(EventRecord(node='/pose_planner', body=pose))))
    ends = lambda: [body for body in heard if isinstance(body, ConfigurationEnded)]  # noqa: E731
    until(ends, 'its end')
    (end,) = ends()
    assert (end.stamp, end.result) == (stamp, 'recorded'), end
