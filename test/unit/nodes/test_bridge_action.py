# SPDX-License-Identifier: Apache-2.0
"""The bridge that commands by FollowJointTrajectory: goals on the real DDS, and their ends."""

import sys

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from bridge_places import AWAY, TARGET
from bridge_rig import CHAIN, HOME, Rig, point
from rclpy.action import ActionClient
from rigs.action_controller import ActionController, follow_joint_trajectory
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection.events import ArmStopped
from remaster_ros.errors import InputError
from remaster_ros.nodes import controller_link, robot_bridge

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]

ACTION = follow_joint_trajectory()
NAME = '/joint_trajectory_controller/follow_joint_trajectory'


class ActionRig(Rig):
    """The rig of the other tests, with the action in place of the topic."""

    def __init__(self, *args, **parameters):
        self.copies, self.foreign, self.clients = [], 0, []
        super().__init__(*args, **{'command_interface': 'action', **parameters})
        self.peer.create_subscription(
            JointTrajectory, controller_link.COPIES, self.copies.append, 200
        )

    def open_controller(self):
        self.controller = ActionController(
            self.peer, NAME, self._on_command, self._hold, lambda: self.wall
        )

    def close_controller(self):
        self.controller.close()
        self.controller = None

    def close(self):
        self.end_bridge()
        # What it was told last comes to an end.
        for _ in range(20):
            self._spinner.spin_once(timeout_sec=0.0)
        for client in self.clients:
            client.destroy()
        if self.controller is not None:
            self.close_controller()
        super().close()

    def send(self, q, seconds):
        """Send a goal as another client."""
        client = ActionClient(self.peer, ACTION, NAME)
        self.clients.append(client)
        self.wait(client.server_is_ready, 'the server')
        goal = ACTION.Goal(trajectory=JointTrajectory(joint_names=self.names))
        goal.trajectory.points = [obeyed_point(q, seconds)]
        client.send_goal_async(goal)
        self.foreign += 1

    def end_bridge(self):
        link = self.bridge and self.bridge._controller
        super().end_bridge()
        if isinstance(link, controller_link.ActionLink):
            # rclpy leaves it in the process, which ends elsewhere.
            link._client.destroy()

    def _hold(self):
        self.arm.stop_by_brakes(self.wall)
        self.arm.emergency = False

    def step(self, *args):
        if self.controller is not None:
            self.controller.look()
        super().step(*args)

    def _has_come(self):
        bridge, link = self.bridge, self.bridge._controller
        if self.controller is None or not isinstance(link, controller_link.ActionLink):
            return super()._has_come()
        return (
            len(self.controller.goals) - self.foreign == bridge.published
            and not link._awaited
            and len(self.events) == bridge.sent
            and len(self.settled) == bridge.counts['settled']
        )


@pytest.fixture
def rig(monkeypatch, tmp_path):
    """Return a function that makes a rig with these parameters."""
    made = []

    def make(ready=True, **options):
        made.append(ActionRig(monkeypatch, tmp_path, **options))
        return made[-1].ready() if ready else made[-1]

    yield make
    for made_rig in made:
        made_rig.close()


def obeyed_point(q, seconds):
    """Return where a goal of another client leads, velocities included."""
    made = point(q, seconds)
    made.velocities = [0.0] * len(q)
    return made


def is_stop(goal):
    """Whether it is a stop along a line: a single point, and not that of the probe at HOME."""
    points = goal.trajectory.points
    return len(points) == 1 and np.max(np.abs(np.array(points[0].positions) - HOME)) > 1e-4


def test_configurations_are_visited_by_goals_with_tolerances_and_copied_for_the_bag(rig):
    r = rig()
    named = r.plan(TARGET, AWAY)
    r.run(20.0, lambda: r.settled)
    r.answer(named, 0)
    r.run(20.0, lambda: len(r.settled) == 2)
    np.testing.assert_allclose(r.settled[0].position, TARGET, atol=1e-4)
    np.testing.assert_allclose(r.settled[1].position, AWAY, atol=1e-4)
    assert not r.halted()
    p = r.bridge.p
    for goal in r.controller.goals:
        names = [t.name for t in goal.path_tolerance], [t.name for t in goal.goal_tolerance]
        assert names == (list(CHAIN.joint_names), list(CHAIN.joint_names))
        # What the bridge itself lets pass: 20 mrad beside, lag_s and 0.1 s behind.
        speeds = np.max(np.abs([x.velocities for x in goal.trajectory.points]), axis=0)
        np.testing.assert_allclose(
            [t.position for t in goal.path_tolerance], 0.02 + (p.lag_s + 0.1) * speeds, rtol=1e-6
        )
        np.testing.assert_allclose([t.position for t in goal.goal_tolerance], p.arrive_tolerance)
        assert goal.goal_time_tolerance.sec == p.arrive_timeout_s
    r.wait(lambda: len(r.copies) == len(r.controller.goals), 'the copies')
    assert r.copies == [goal.trajectory for goal in r.controller.goals]
    assert not r.peer.get_publishers_info_by_topic('/joint_trajectory_controller/joint_trajectory')


def test_a_stop_is_a_goal_along_the_line_that_replaces_the_move(rig):
    r = rig()
    r.go(AWAY, speed=0.2)
    r.say_planner('paused')
    r.run(1.5)
    assert [stop.reason for stop in r.named(ArmStopped)] == ['planner is paused']
    assert is_stop(r.controller.goals[-1])
    assert r.controller.cancelled == 0
    assert r.arm.speed() < 1e-6
    assert not r.halted()
    r.say_planner('running')
    r.run(20.0, lambda: r.settled)
    np.testing.assert_allclose(r.settled[0].position, AWAY, atol=1e-4)


def test_without_a_server_nothing_is_commanded(rig):
    r = rig(ready=False, controller=False)
    r.alone()
    r.plan(TARGET)
    r.run(1.5)
    wanted = f'no controller has the action {NAME}'
    assert r.summary()[:2] == ('warn', wanted)
    assert not r.bridge.published
    r.open_controller()
    r.wait(r.bridge._controller.matched, 'the controller')
    r.run(20.0, lambda: r.settled)
    r.close_controller()
    r.wait(lambda: not r.bridge._controller.matched(), 'the end of the server')
    r.bridge._watch()
    assert r.halted() == wanted


def test_a_refused_move_halts(rig):
    r = rig()
    r.controller.refuses = lambda goal: True
    r.plan(TARGET)
    r.run(5.0, r.halted)
    assert r.halted() == f'{NAME}: the controller refuses a command; its log has why'


def test_a_controller_that_refuses_to_be_stopped_is_cancelled(rig):
    """Some take a goal only after the one before is over: what is left is to hold the arm."""
    r = rig()
    r.controller.refuses = is_stop
    r.go(AWAY, speed=0.2)
    r.say_planner('paused')
    r.run(1.5)
    assert r.controller.cancelled == 1
    assert r.halted() == f'{NAME}: the controller refuses a command; its log has why'
    assert r.arm.speed() < 1e-6
    assert r.arm.q[0] < 0.55, 'it went on to its end'


def test_a_controller_that_puts_the_stop_behind_the_move_is_cancelled(rig):
    """It accepts the stop, and the arm goes on."""
    r = rig(speed_share=0.1)
    r.controller.replaces = False
    r.go(AWAY)
    r.say_planner('paused')
    r.run(3.0, r.halted)
    r.run(0.5)
    assert r.controller.cancelled == 1
    assert r.arm.speed() < 1e-6
    assert r.arm.q[0] < 0.55, 'it went on to its end'


def test_a_controller_that_takes_neither_stop_nor_cancelling_is_named(rig):
    r = rig()
    r.controller.refuses, r.controller.cancels = is_stop, False
    r.go(AWAY, speed=0.2)
    r.say_planner('paused')
    r.run(0.5)
    assert any('use the emergency stop' in text for _, text in r.bridge.logged)


@pytest.mark.parametrize(
    ('code', 'text', 'why'),
    [
        ('PATH_TOLERANCE_VIOLATED', '', 'PATH_TOLERANCE_VIOLATED: the arm left its path'),
        (
            'GOAL_TOLERANCE_VIOLATED',
            'joint_2',
            'GOAL_TOLERANCE_VIOLATED: the arm did not reach its end in time; joint_2',
        ),
        ('SUCCESSFUL', '', 'without a reason'),
    ],
)
def test_a_command_that_the_controller_gives_up_halts(rig, code, text, why):
    r = rig()
    r.go(AWAY, speed=0.2)
    r._hold()
    r.controller.end(code, text)
    r.wait(r.halted, 'the result')
    assert r.halted() == f'{NAME}: the controller has given up a command ({why})'
    sent = r.bridge.published
    r.run(1.0)
    assert r.bridge.published == sent


def test_a_halt_without_a_stop_cancels_the_move(rig):
    """Silent joint states: nothing is commanded, and the arm does not go on unobserved."""
    r = rig(speed_share=0.1)
    r.go(AWAY)
    r.alive.discard('robot')
    r.run(2.0, r.halted)
    r.run(1.0)
    assert r.controller.cancelled == 1
    assert r.arm.speed() < 1e-6
    assert r.arm.q[0] < 0.55
    assert not any(is_stop(goal) for goal in r.controller.goals)


def test_an_emergency_stop_cancels_the_move_so_that_nothing_goes_on_when_it_is_released(rig):
    r = rig()
    r.go(AWAY, speed=0.2)
    r.arm.stop_by_brakes(r.wall)
    r.run(3.0, r.halted)
    r.run(0.5)
    assert r.controller.cancelled == 1


def test_another_client_of_the_action_halts_and_is_named(rig):
    r = rig()
    r.settle(TARGET)
    node = robot_bridge.RemasterNode.__mro__[1]('move_group', context=r.context)
    r.clients.append(ActionClient(node, ACTION, NAME))
    r.wait(r.bridge._controller.rival, 'the other client')
    r.bridge._watch()
    assert r.halted().startswith(
        f'other clients of {NAME}, where the bridge may be the only one: /move_group'
    )
    r.clients.pop().destroy()
    node.destroy_node()


@pytest.mark.parametrize('interface', ['action', 'topic'])
def test_a_goal_of_another_client_halts(rig, interface):
    """Of a client that the graph does not show (yet); by the topic too."""
    r = rig(ready=False, command_interface=interface)
    if interface == 'topic':
        r.topic = r.peer.create_subscription(
            JointTrajectory, controller_link.COMMANDS, r._on_command, 200
        )
    r.ready()
    r.settle(TARGET)
    r.bridge._controller.rival = lambda: ''
    r.send(TARGET, 20)
    r.wait(r.bridge._foreign.trouble, 'the status')
    r.bridge._watch()
    assert r.halted() == f'another client has sent a goal to {NAME}: end that client'


def test_a_goal_that_a_former_bridge_has_left_is_no_rival(rig):
    r = rig(ready=False)
    r.send(r.arm.q, 1000)
    r.wait(lambda: r.bridge._foreign._active, 'the status')
    # As that of a bridge that was killed.
    r.clients.pop().destroy()
    r.ready()
    r.settle(TARGET)
    assert not r.halted()


def test_a_publisher_on_the_topic_of_the_controller_halts(rig):
    r = rig()
    r.settle(TARGET)
    r.peer.create_publisher(JointTrajectory, controller_link.COMMANDS, 10)

    def listed():
        # A node's name is known later than its publisher.
        found = r.bridge.get_publishers_info_by_topic(f'/{controller_link.COMMANDS}')
        return [info.node_name for info in found] == ['peer']

    r.wait(listed, 'the publisher and its node')
    r.bridge._watch()
    assert r.halted().startswith(
        f'1 publisher on /{controller_link.COMMANDS}, where none may be: /peer; '
    )


def test_the_end_of_the_bridge_stops_an_arm_on_its_way(rig):
    r = rig()
    r.controller.refuses = is_stop
    r.go(AWAY, speed=0.2)
    spin = r._spinner.spin_once
    # The peer is another process: it answers while the bridge ends.
    r.bridge.executor.spin_once = spun_with(r.bridge.executor.spin_once, spin)
    r.bridge.close()
    assert r.controller.cancelled == 1
    assert is_stop(r.controller.goals[-1])


def spun_with(original, other):
    def spin(**how):
        other(timeout_sec=0.0)
        original(**how)

    return spin


def test_without_control_msgs_the_bridge_says_what_to_install(rig, monkeypatch):
    for name in [name for name in sys.modules if name.startswith('control_msgs')]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, 'control_msgs', None)
    with pytest.raises(InputError, match='apt install ros-jazzy-control-msgs'):
        rig(ready=False, controller=False)
