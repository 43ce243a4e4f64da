# SPDX-License-Identifier: Apache-2.0
"""The recorder by itself: a test publishes in place of the robot, the planner and the sensors.

What it writes down of them is then known to the last digit.
"""

import itertools
import signal
import time

import numpy as np
import pytest
from rigs.ros_rig import ROOT, found, node_arguments, wait_until

from remaster_ros.collection.events import (
    ArmStopped,
    ConfigurationEnded,
    EventRecord,
    PoseAnnounced,
    encode,
)
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import (
    apply,
    inverse,
    rotation_vector_to_matrix,
    transform,
)
from remaster_ros.session.records.reader import read_session

pytestmark = [pytest.mark.ros, pytest.mark.timeout(900)]

URDF = ROOT / 'config' / 'robots' / 'lwr4plus.urdf'
CHAIN = SerialChain.from_urdf(URDF.read_text(encoding='utf-8'), 'base_link', 'tool')
T_R_N = transform(rotation_vector_to_matrix(np.array([0.3, -0.2, 2.5])), (1.9, 0.0, 1.3))
MARKERS = {'sir': np.array([0.1, 0.0, 0.0]), 'smr': np.array([-0.1, 0.0, 0.0])}
CELL = """robot: {{urdf: {urdf}, base_link: base_link, tip_link: tool}}
held_joint: joint_3
held_values_deg: [0.0]
markers: {{sir: [0.1, 0.0, 0.0], smr: [-0.1, 0.0, 0.0]}}
sensors:
  {sensors}
aim_at: {aim}
"""
SENSORS = {
    'mocap': '{marker: sir, topic: /optitrack/marker, rough_position_m: [1.9, 0, 1.3]}',
    'tracker': '{marker: smr, topic: /laser_tracker/marker, rough_position_m: [1.9, 0, 1.1], '
    'single_shot: true, measure_service: /laser_tracker/measure}',
}
TOPICS = {'mocap': '/optitrack/marker', 'tracker': '/laser_tracker/marker'}
Q = np.radians([5.0, 7.0, 0.0, 112.0, 10.0, 35.0, -20.0])
# Within what a settled arm may move during a reading, 5e-4 rad.
SWAY = 2e-4
DWELL = 25


class Rig:
    """A recorder of one sensor, and everybody it listens to."""

    def __init__(self, start, client, folder, sensor):
        from geometry_msgs.msg import PointStamped
        from sensor_msgs.msg import JointState
        from std_msgs.msg import String
        from trajectory_msgs.msg import JointTrajectory

        from remaster_ros.nodes.status import RELIABLE, listen

        self.client, self.sensor, self.session = client, sensor, folder / 'session'
        cell = folder / 'cell.yaml'
        cell.write_text(
            CELL.format(urdf=URDF, sensors=f'{sensor}: {SENSORS[sensor]}', aim=sensor),
            encoding='utf-8',
        )
        self.node = start(
            'remaster_ros.nodes.recorder',
            *node_arguments(cell=cell, session=self.session, call_measure=False, bag=False),
        )
        self.events, self.summaries, self.summary, self.message = [], [], {}, ''
        listen(client, self._record, self._summary)
        self.joints = client.create_publisher(JointState, '/joint_states', 100)
        self.settled = client.create_publisher(JointState, '/remaster/settled', RELIABLE)
        self.solutions = client.create_publisher(
            JointTrajectory, '/remaster/joint_solutions', RELIABLE
        )
        self.points = client.create_publisher(PointStamped, TOPICS[sensor], 100)
        self.says = client.create_publisher(String, '/remaster/events', RELIABLE)
        self.t = 1000.0
        self.pose = itertools.count()
        publishers = (self.joints, self.settled, self.solutions, self.points)
        wait_until(
            lambda: client.spin_some() or all(p.get_subscription_count() for p in publishers),
            30,
            'the recorder to subscribe',
        )
        wait_until(lambda: client.spin_some() or self.summary, 30, 'its status')

    def _record(self, record):
        if isinstance(record.body, ConfigurationEnded):
            self.events.append(record.body)

    def _summary(self, node, message, values):
        if node == 'recorder':
            self.summary, self.message = values, message
            self.summaries.append(message)

    def header(self, message, t):
        from remaster_ros.nodes.messages import stamp_of

        message.header.stamp = stamp_of(t)
        return message

    def report(self, q):
        from sensor_msgs.msg import JointState

        message = JointState(name=list(CHAIN.joint_names), position=[float(x) for x in q])
        self.joints.publish(self.header(message, self.t))

    def another_publisher_of_joints(self):
        """One of a gripper's joints does no harm; one of the arm's is named."""
        from sensor_msgs.msg import JointState

        other = self.client.create_publisher(JointState, '/joint_states', 100)
        wait_until(lambda: self.client.spin_some() or other.get_subscription_count(), 20, 'it')

        def shown(names, said):
            def look():
                self.t += 0.02
                self.report(Q)
                other.publish(JointState(name=names, position=[0.01] * len(names)))
                self.spin()
                return said(self.message)

            wait_until(look, 20, f'what is said of {names}')

        number = len(self.summaries)
        shown(['finger'], lambda message: len(self.summaries) > number + 2)
        assert {message for message in self.summaries[number:]} == {'waiting'}
        several = "the arm's joints come on /joint_states from more than one publisher"
        shown(list(CHAIN.joint_names), lambda message: message.startswith(several))

    def read(self, q, shift=(0.0, 0.0, 0.0)):
        """Publish where the sensor has the marker with the arm at q, moved by `shift`, m."""
        from geometry_msgs.msg import PointStamped

        marker = MARKERS['sir' if self.sensor == 'mocap' else 'smr']
        message = self.header(PointStamped(), self.t)
        seen = apply(inverse(T_R_N), CHAIN.positions(q, marker)) + np.asarray(shift)
        message.point.x, message.point.y, message.point.z = map(float, seen)
        self.points.publish(message)

    def event(self, body):
        from std_msgs.msg import String

        record = EventRecord(node=f'/{body.sender}', body=body)
        self.says.publish(String(data=encode(record)))

    def announce(self, *solutions):
        """Announce the next pose with these joint solutions; return its number."""
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        from remaster_ros.collection.message_fields import stamp_key

        number = next(self.pose)
        message = self.header(JointTrajectory(joint_names=list(CHAIN.joint_names)), self.t)
        message.points = [JointTrajectoryPoint(positions=q.tolist()) for q in solutions]
        self.event(
            PoseAnnounced(
                stamp=stamp_key(message.header.stamp), pose=number, split='optimization', plan='a',
                ids=tuple(range(len(solutions))),
            )
        )  # fmt: skip
        self.solutions.publish(message)
        key = stamp_key(message.header.stamp)
        wait_until(
            lambda: self.client.spin_some() or self.summary.get('pose') == key, 20, 'the pose'
        )
        return number

    def stand(self, q, feed=True):
        """Stand still at q for a dwell: joints sway a little, the sensor reads; return reports."""
        from sensor_msgs.msg import JointState

        self.report(q)
        self.spin()
        message = JointState(name=list(CHAIN.joint_names), position=q.tolist())
        self.settled.publish(self.header(message, self.t))
        self.spin()
        reports = []
        for i in range(DWELL + 5):
            self.t += 0.02
            # Most of the time on one side: the mean is neither middle, first nor last.
            here = q + SWAY * (1.0 if i % 5 else -1.0)
            if feed:
                self.read(q, (1e-6 * i, 0.0, 0.0))
            self.report(here)
            reports.append(here)
            self.spin()
        return np.array(reports)

    def spin(self):
        for _ in range(3):
            self.client.spin_some()

    def decided(self, count):
        wait_until(
            lambda: self.client.spin_some() or len(self.events) >= count,
            20,
            f'{count} configurations',
        )
        return self.events[count - 1]

    def rows(self):
        self.node.send_signal(signal.SIGINT)
        assert self.node.wait(900) == 0
        return read_session(self.session).measurements


@pytest.fixture
def rig(start, client, tmp_path):
    return lambda sensor: Rig(start, client, tmp_path, sensor)


def test_what_is_recorded_and_never_twice_and_from_where(rig):
    rig = rig('mocap')
    elsewhere = Q + 0.1
    third = Q - 0.1
    number = rig.announce(Q, elsewhere, third)
    reports = rig.stand(Q)
    assert rig.decided(1).result == 'recorded'

    # Told again that it has settled there, as after a planner was started anew: nothing new.
    rig.stand(Q)
    again = rig.decided(2)
    assert (again.result, again.reason) == ('recorded', 'recorded before')
    rig.spin()
    assert rig.summary['observations'] == '1'

    rig.stand(elsewhere)
    assert rig.decided(3).reason == ''
    # Stopped on its way: where it comes from next, nobody knows.
    rig.event(ArmStopped(stamp='', reason='another pose'))
    for _ in range(10):
        rig.spin()
    rig.stand(third)
    assert rig.decided(4).result == 'recorded'
    rig.another_publisher_of_joints()

    rows = rig.rows()
    assert rows.pose.tolist() == [number] * 3
    assert rows.configuration.tolist() == [0, 1, 2]
    # The mean of the reports of the dwell: not the settled one, nor the last, nor all of them.
    expected = reports[:DWELL].mean(axis=0)
    np.testing.assert_allclose(rows.q[0], expected, atol=1e-9)
    assert np.abs(reports[DWELL - 1] - expected).max() > 1e-5
    assert np.abs(Q - expected).max() > 1e-5
    assert np.isnan(rows.from_q[0]).all()
    np.testing.assert_allclose(rows.from_q[1], Q, atol=1e-9)
    assert np.isnan(rows.from_q[2]).all()


def test_the_first_of_two_shots_counts(rig):
    """The second may be of an arm that moves again, or of the next configuration."""
    rig = rig('tracker')
    rig.announce(Q)
    rig.stand(Q, feed=False)
    rig.t += 0.02
    rig.read(Q)
    rig.t += 0.02
    rig.read(Q, (3e-3, 0.0, 0.0))
    for _ in range(10):
        rig.spin()
    rig.t += 0.02
    rig.report(Q)
    assert rig.decided(1).result == 'recorded'
    rows = rig.rows()
    assert len(rows) == 1
    expected = apply(inverse(T_R_N), CHAIN.positions(Q, MARKERS['smr']))
    np.testing.assert_allclose(rows.position[0], expected, atol=1e-9)


def register(rig, q, shift):
    """Call /remaster/register while the arm stands at q; return the answer."""
    from std_srvs.srv import Trigger

    caller = rig.client.create_client(Trigger, '/remaster/register')
    found(caller)
    rig.t += 1.0
    rig.report(q)
    for _ in range(10):
        rig.spin()
    future = caller.call_async(Trigger.Request())
    deadline = time.monotonic() + 20.0
    for i in itertools.count():
        assert time.monotonic() < deadline, f'no answer: {rig.message} {rig.summary}'
        time.sleep(0.005)
        rig.t += 0.02
        rig.read(q, np.add(shift, (1e-6 * (i % 7), 0.0, 0.0)))
        rig.report(q)
        rig.spin()
        if future.done():
            return future.result()


@pytest.mark.qualify
def test_three_points_that_do_not_agree_register_nothing(rig):
    """Off by 0.15 m: not the marker, and far from what an arm to be calibrated is off by."""
    rig = rig('mocap')
    turned = [[0.5, 0, 0, 0, 0, 0, 0], [0.25, 0.4, 0, 0, 0, 0, 0]]
    places = [Q, *np.add(Q, turned), Q - 0.3]
    for q, shift in zip(places[:2], ((0.0, 0.0, 0.0), (0.0, 0.0, 0.15)), strict=True):
        assert register(rig, q, shift).success
    answer = register(rig, places[2], (0.0, 0.0, 0.0))
    assert 'too few agree' in answer.message
    assert 'allowed 25 mm' in answer.message
    # The fourth says which of them was wrong.
    answer = register(rig, places[3], (0.0, 0.0, 0.0))
    assert answer.success
    assert 'too few agree' not in answer.message
