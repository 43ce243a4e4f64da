# SPDX-License-Identifier: Apache-2.0
"""A pause or stop leaves the planner while it plans, and while the disk keeps it waiting."""

import sys
import time

import pytest
from rigs.ros_rig import node_arguments

from remaster_ros.collection.events import BridgeState, RecorderState, SensorReport
from remaster_ros.session.cells.workcell import read_cell

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(200)]

# The node as it is, except that the disk takes its time, and that it tells when it plans.
SLOW = """
import os, sys, time
seconds, sys.argv = float(sys.argv[1]), sys.argv[1:]
from remaster_ros.nodes import pose_planner
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.session.records import journal
append = journal.Journal.append
def slow_append(self, record):
    print('writing', flush=True)
    time.sleep(seconds)
    append(self, record)
    print('written', flush=True)
journal.Journal.append = slow_append
registration = TourPlanner.registration
def plan(self):
    print('planning', flush=True)
    tour = registration(self)
    print('planned', flush=True)
    return tour
TourPlanner.registration = plan
sys.exit(pose_planner.main(sys.argv))
"""


class Around:
    """Stands in for robot, bridge and recorder: whatever the planner waits for is there."""

    def __init__(self, client, said):
        import rclpy
        from sensor_msgs.msg import JointState
        from trajectory_msgs.msg import JointTrajectory

        from remaster_ros.nodes.status import RELIABLE, NodeStatus, Summary, listen

        self.client, self.said = client, said
        self.names = list(read_cell('demo').chain().joint_names)
        self.joints = client.create_publisher(JointState, 'joint_states', RELIABLE)
        self.solutions = []
        facts = {
            'robot_bridge': BridgeState(halted='', joints_age_s=0.0),
            'recorder': RecorderState(waiting_for='', require='mocap', read_age_s={'mocap': 0.0}),
            'bar': SensorReport(sensor='mocap', ready=True),
        }
        self.nodes = [rclpy.create_node(name, context=client.context) for name in facts]
        # The planner waits until these two listen; what it says is heard here.
        for node in (client, *self.nodes[:2]):
            node.create_subscription(
                JointTrajectory, 'remaster/joint_solutions', self.solutions.append, RELIABLE
            )
        self.statuses = [
            NodeStatus(node, lambda state=state: Summary('ok', '', {}, state))
            for node, state in zip(self.nodes, facts.values())
        ]
        listen(client, lambda event: None, self._summary)
        self._spoken = 0.0

    def _summary(self, node, message, values):
        if node == 'pose_planner':
            self.said.append((time.monotonic(), values['state'], message))

    def live(self):
        from sensor_msgs.msg import JointState

        if time.monotonic() - self._spoken > 0.2:
            self._spoken = time.monotonic()
            self.joints.publish(JointState(name=self.names, position=[0.1] * 7))
            for status in self.statuses:
                status.publish()
        self.client.spin_some()

    def until(self, condition, what, timeout_s=180):
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, (what, self.said[-1:])
            self.live()

    def close(self):
        for node in self.nodes:
            node.destroy_node()


class Planner:
    """The planner's process, and what it printed when."""

    def __init__(self, ros_environment, write_s, *args):
        import subprocess
        import threading

        self.process = subprocess.Popen(
            [sys.executable, '-c', SLOW, str(write_s), *map(str, args)],
            env=ros_environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.printed = []

        def read():
            for line in self.process.stdout:
                self.printed.append((time.monotonic(), line.strip()))

        self._reader = threading.Thread(target=read)
        self._reader.start()

    def end(self):
        """Kill the process, whatever it does."""
        self.process.kill()
        self.process.wait(20)
        self._reader.join()
        self.process.stdout.close()

    def when(self, word):
        """Return when it printed a word last; None if it has not."""
        return next((at for at, line in reversed(self.printed) if line == word), None)


@pytest.fixture
def around(client):
    around = Around(client, [])
    yield around
    around.close()


@pytest.fixture
def planner(ros_environment, tmp_path):
    running = []

    def begin(write_s, **parameters):
        args = node_arguments(session=tmp_path / 'session', **parameters)
        running.append(Planner(ros_environment, write_s, *args))
        return running[-1]

    yield begin
    for process in running:
        process.end()


def clients(around):
    from std_srvs.srv import Trigger

    made = {
        name: around.client.create_client(Trigger, f'/remaster/{name}')
        for name in ('collect', 'pause', 'stop')
    }
    around.until(lambda: all(c.service_is_ready() for c in made.values()), 'the services')

    def ask(name):
        return made[name].call_async(Trigger.Request())

    return ask


@pytest.mark.parametrize('name', ['pause', 'stop'])
@pytest.mark.parametrize('busy', ['planning', 'writing'])
def test_it_leaves_before_the_work_is_done(around, planner, name, busy):
    """The state is out and the service has answered while the work still goes on."""
    # Planning of so many poses takes seconds; so does the slow disk.
    size = 300 if busy == 'planning' else 6
    node = planner(3.0 if busy == 'writing' else 0.0, registration_candidates=size)
    around.until(lambda: around.said, 'the planner')
    ask = clients(around)
    around.until(lambda: 'robot is' not in around.said[-1][2], 'the robot')
    ask('collect')
    around.until(lambda: node.when(busy) is not None, busy)
    time.sleep(0.3)
    asked = time.monotonic()
    future = ask(name)
    state = {'pause': 'paused', 'stop': 'stopped'}[name]
    around.until(lambda: around.said[-1][1] == state, state)
    said_s = around.said[-1][0]
    done = {'planning': 'planned', 'writing': 'written'}[busy]
    assert node.when(done) is None or node.when(done) > asked, 'too little work for this test'
    assert node.when(done) is None or node.when(done) > said_s, 'it waited for the work'
    around.until(future.done, 'the answer')
    answered = time.monotonic()
    assert future.result().success, future.result().message
    print(f'{name} while {busy}: said after {1e3 * (said_s - asked):.0f} ms')
    around.until(lambda: node.when(done) is not None and node.when(done) > asked, done)
    assert answered < node.when(done)
    later = time.monotonic() + 1.5
    around.until(lambda: time.monotonic() > later, 'time')
    # The empty one of a stop is no pose.
    assert not [message for message in around.solutions if message.points]
    assert {state for at, state, _ in around.said if at > said_s} == {state}
