# SPDX-License-Identifier: Apache-2.0
"""The compensator: what it passes on, what it refuses, and how it is switched."""

import threading
import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from compensator_rig import (
    CHAIN,
    CONTROLLER,
    HOME,
    NAMES,
    PATIENCE_S,
    TARGET,
    URDF,
    erring,
    message_of,
)
from rclpy.action import ActionClient
from rigs.action_controller import ActionController, follow_joint_trajectory
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory
from worlds.compensation_files import save
from worlds.drawn_moves import line

from remaster_ros.compensation.compensator import Compensator
from remaster_ros.compensation.controller_forms import exported, form_content
from remaster_ros.compensation.file import read_compensation
from remaster_ros.errors import InputError
from remaster_ros.nodes.messages import stamp_of

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]


@pytest.fixture
def rig(compensator):
    """Return a function that makes a rig of an arm and parameters."""
    return compensator


def test_a_planner_of_the_nominal_arm_moves_the_true_one(rig):
    """From the angles it is told, by the topic; the joints of each message in their own order."""
    r = rig().ready()
    np.testing.assert_allclose(r.told[-1], r.compensator.true(HOME), atol=1e-7)
    assert np.abs(r.told[-1] - HOME).max() > 1e-3
    message = r.plan(r.told[-1], TARGET)
    message.joint_names.reverse()
    for point in message.points:
        point.positions.reverse()
        point.velocities.reverse()
    # Stamped when it was sent.
    message.header.stamp = r.peer.get_clock().now().to_msg()
    r.planned.publish(message)
    assert r.run(20.0, lambda: r.came and time.monotonic() > r.drive[0] + r.drive[1][-1] + 0.5)
    (sent,) = r.came
    assert sent.header.stamp.sec == 0
    np.testing.assert_allclose(r.q, r.compensator.command(TARGET), atol=1e-8)
    np.testing.assert_allclose(sent.points[0].positions, HOME, atol=1e-7)
    # What the planner is told: it is where it was to go.
    assert r.run(5.0, lambda: np.abs(r.told[-1] - TARGET).max() < 1e-7)
    # A gripper's joints are passed on as they come.
    other = []
    r.peer.create_subscription(JointState, 'compensator/joint_states', other.append, 10)
    r.joint_states.publish(JointState(name=['finger'], position=[0.01]))
    assert r.run(5.0, lambda: any(list(joint_state.name) == ['finger'] for joint_state in other))
    assert r.states[-1] == {'correction': 'on', 'sha256': r.node._correction.sha256, 'why': ''}


def test_what_is_refused_has_its_reason(rig):
    r = rig().ready()
    angles = r.told[-1]
    assert "must read this node's joint_states" in r.refused(r.plan(HOME, TARGET))
    assert 'its joints are' in r.refused(r.plan(angles, TARGET, names=['x', *NAMES[1:]]))
    broken = r.plan(angles, TARGET)
    broken.points[3].velocities = []
    assert 'give all or none' in r.refused(broken)
    broken.points[3].positions = broken.points[3].positions[:3]
    assert 'not a position' in r.refused(broken)
    later = r.plan(angles, TARGET)
    later.header.stamp = stamp_of(time.time() + 5.0)
    assert 'from now: give none' in r.refused(later)
    # Somebody who sends past it.
    rival = r.peer.create_publisher(JointTrajectory, f'{CONTROLLER}/joint_trajectory', 10)
    assert r.run(PATIENCE_S, lambda: '2 publishers' in r.node._trouble())
    assert '2 publishers' in r.refused(r.plan(angles, TARGET))
    r.peer.destroy_publisher(rival)
    assert r.run(PATIENCE_S, lambda: not r.node._trouble())
    # A description that has the correction in it, another arm's, and then the nominal one again.
    content = form_content(read_compensation(r.file), 'urdf', np.random.default_rng(1))
    urdf = exported(read_compensation(r.file), 'urdf', content)['robot_calibrated.urdf']
    for text, words in (
        (urdf, 'holds this correction already'),
        (URDF.replace('xyz="0 0 0.2085"', 'xyz="0 0 0.25"'), 'is of another URDF than'),
    ):
        r.description.publish(String(data=text))
        assert r.run(PATIENCE_S, lambda words=words: words in r.node._trouble()), r.node._trouble()
        assert words in r.refused(r.plan(angles, TARGET))
    assert r.run(5.0, lambda: 'another URDF' in r.states[-1]['why'])
    r.description.publish(String(data=URDF))
    assert r.run(PATIENCE_S, lambda: not r.node._trouble())
    # Joints that nobody reports any more.
    r.due = np.inf
    r.run(0.4)
    assert 'joint_states does not come' in r.refused(r.plan(angles, TARGET))


def test_it_is_switched_while_the_arm_stands_alone(rig, tmp_path):
    r = rig().ready()
    first = r.node._correction.sha256
    # A file that changes is of no effect before it is enabled again.
    again = save(tmp_path, erring(2), URDF)
    assert again == r.file
    r.run(0.3)
    np.testing.assert_allclose(r.told[-1], r.compensator.true(HOME), atol=1e-7)
    r.planned.publish(r.plan(r.told[-1], TARGET))
    assert r.run(PATIENCE_S, lambda: r.drive and time.monotonic() > r.drive[0] + 0.3)
    for name in ('enable', 'disable'):
        answer = r.call(name)
        assert not answer.success
        assert 'the arm moves' in answer.message or 'is under way' in answer.message
    assert r.run(20.0, lambda: not r.node._moves())
    assert r.node._correction.sha256 == first
    answer = r.call('enable')
    assert answer.success, answer.message
    second = r.node._correction.sha256
    assert second != first
    assert second[:8] in answer.message
    seen = len(r.told)
    assert r.run(5.0, lambda: len(r.told) > seen + 3)
    np.testing.assert_allclose(r.told[-1], Compensator(erring(2)).true(r.q), atol=1e-7)
    # One that cannot be read leaves what is.
    again.write_text('')
    answer = r.call('enable')
    assert not answer.success
    assert 'compensation.json' in answer.message
    assert r.node._correction.sha256 == second
    assert r.call('disable').success
    seen = len(r.told)
    assert r.run(5.0, lambda: len(r.told) > seen + 3)
    np.testing.assert_allclose(r.told[-1], r.q, atol=1e-12)
    back = r.plan(r.q, HOME)
    before = len(r.came)
    r.planned.publish(back)
    assert r.run(PATIENCE_S, lambda: len(r.came) > before)
    np.testing.assert_allclose(
        r.came[-1].points[5].positions, back.points[5].positions, atol=1e-12
    )
    assert r.run(5.0, lambda: r.states[-1]['correction'] == 'off')


def test_nothing_moves_before_all_that_it_must_know_has_come(rig):
    r = rig(description='', temperature_topic='/arm_temperature')
    assert r.run(PATIENCE_S, lambda: '/arm_temperature has not come' in r.node._trouble())
    heat = r.peer.create_publisher(Temperature, '/arm_temperature', 10)
    assert r.run(PATIENCE_S, heat.get_subscription_count)
    heat.publish(Temperature(temperature=30.0))
    assert r.run(PATIENCE_S, lambda: 'nobody publishes /robot_description' in r.node._trouble())
    r.run(0.5)
    assert r.node._on is None
    assert not r.told
    assert 'nobody publishes' in r.refused(r.plan(HOME, TARGET))
    r.description.publish(String(data=URDF))
    assert r.run(PATIENCE_S, lambda: r.node._on)


@pytest.mark.parametrize(
    ('parameters', 'words'),
    [
        ({'max_change_deg': 0.1}, 'and 0.1 are the most'),
        ({'compensation': "''"}, 'parameter compensation is empty'),
    ],
)
def test_what_it_cannot_begin_with_is_one_line(rig, parameters, words):
    with pytest.raises(InputError, match=words):
        # rclpy keeps a node that could not be made for a while.
        rig(name=f'not_{len(words)}', **parameters)


# The action


def test_joint_states_that_freeze_in_a_move_are_not_led_on_from(rig):
    """The planner begins where the arm is reported, and the arm is elsewhere by then."""
    r = rig().ready()
    slow = line(r.told[-1], TARGET, 0.3, CHAIN)
    r.planned.publish(message_of(slow.times_s, slow.positions, slow.velocities))
    assert r.run(PATIENCE_S, lambda: r.drive and time.monotonic() > r.drive[0] + 1.0)
    frozen = r.frozen = r.q
    end_s = r.drive[0] + r.drive[1][-1]
    assert r.run(PATIENCE_S, lambda: time.monotonic() > end_s + 1.5)
    assert np.abs(r.q - frozen).max() > 0.02
    # It is on its way still, or has come to its end: both is said.
    refused = r.refused(r.plan(r.told[-1], HOME))
    assert 'the arm is not reported where the last command led: ' in refused
    assert '/compensator/enable confirms' in refused
    # A person who has compared both calls twice: once it is said what to compare.
    first = r.call('enable')
    assert not first.success
    assert first.message in refused
    r.frozen = None
    assert r.run(PATIENCE_S, lambda: np.abs(r.told[-1] - TARGET).max() < 1e-6)
    assert r.run(PATIENCE_S, lambda: not (r.node._trouble() or r.node._moves()))
    r.planned.publish(r.plan(r.told[-1], HOME))
    before = len(r.came)
    assert r.run(PATIENCE_S, lambda: len(r.came) > before)


def test_an_arm_that_was_moved_by_hand_is_confirmed_by_a_person(rig):
    """Also by a compensator that was started again."""
    r = rig().ready()
    r.planned.publish(r.plan(r.told[-1], TARGET))
    assert r.run(PATIENCE_S, lambda: r.drive and not r.node._moves())
    assert r.run(PATIENCE_S, lambda: time.monotonic() > r.drive[0] + r.drive[1][-1] + 1.5)
    kept = r.node._command_file.read(time.time_ns())
    np.testing.assert_allclose(kept.end, r.compensator.command(TARGET), atol=1e-7)
    r.drive, r.q = None, r.q + 0.05
    assert r.run(PATIENCE_S, lambda: 'the last command led' in r.node._trouble())
    assert r.run(PATIENCE_S, lambda: not r.node._moves())
    assert r.run(5.0, lambda: 'the last command led' in r.states[-1]['why'])
    assert not r.call('enable').success
    r.run(0.5)
    assert r.call('enable').success
    assert not r.node._trouble()


def test_what_is_worked_out_keeps_nothing_waiting(rig, monkeypatch):
    """An empty trajectory holds the arm at once, and what is worked out is not passed on."""
    r = rig().ready()
    begun, go_on = threading.Event(), threading.Event()
    original = r.node._motion.corrected_for_controller

    def slow(wanted, *arguments):
        if len(wanted.times_s):
            begun.set()
            assert go_on.wait(PATIENCE_S)
        return original(wanted, *arguments)

    monkeypatch.setattr(r.node._motion, 'corrected_for_controller', slow)
    said = []
    r.node._say = said.append
    r.planned.publish(r.plan(r.told[-1], TARGET))
    assert r.run(PATIENCE_S, begun.is_set)
    r.planned.publish(JointTrajectory(joint_names=NAMES))
    assert r.run(PATIENCE_S, lambda: r.came)
    assert not r.came[0].points
    go_on.set()
    assert r.run(PATIENCE_S, lambda: said)
    assert said == ['trajectory refused: another trajectory has come since']
    assert len(r.came) == 1


@pytest.mark.parametrize(
    ('change', 'why'),
    [
        (lambda m: setattr(m.points[-1].time_from_start, 'sec', 2**31 - 1), 'are the most'),
        (
            lambda m: [setattr(waypoint, 'velocities', []) for waypoint in m.points],
            'step of its speed',
        ),
    ],
)
def test_times_without_end_and_steps_of_the_speed_are_refused(rig, change, why):
    r = rig().ready()
    # Quick, and by few points: what a controller draws through them has corners.
    wanted = line(r.told[-1], r.told[-1] + 0.5, 3.0, CHAIN)
    every = slice(None, None, max(len(wanted.times_s) // 4, 1))
    message = message_of(
        *(part[every] for part in (wanted.times_s, wanted.positions, wanted.velocities))
    )
    message.points[-1].velocities = [0.0] * 7
    change(message)
    assert why in r.refused(message)


class ByAction:
    """A rig whose controller has the action too, and a client of the compensator's."""

    def __init__(self, r):
        self.r, self.action = r, follow_joint_trajectory()
        self.controller = ActionController(
            r.peer, f'{CONTROLLER}/follow_joint_trajectory', r.obey, self.hold, time.monotonic
        )
        self.client = ActionClient(r.peer, self.action, 'compensator/follow_joint_trajectory')
        self.feedback = []

    def is_found(self):
        """Whether each side has found the other's server."""
        found = self.client.server_is_ready, self.r.node._client.server_is_ready
        return all(self.r.run(0.5 * PATIENCE_S, condition) for condition in found)

    def hold(self):
        self.r.drive = None

    def send(self, trajectory):
        goal = self.action.Goal(trajectory=trajectory)
        sent = self.client.send_goal_async(
            goal, lambda message: self.feedback.append(message.feedback)
        )
        assert self.r.run(PATIENCE_S, sent.done)
        self.handle = sent.result()
        assert self.handle.accepted
        self.result = self.handle.get_result_async()

    def ended(self):
        def look():
            self.controller.look()
            return self.result.done()

        assert self.r.run(20.0, look)
        return self.result.result()

    def close(self):
        self.client.destroy()
        self.controller.close()


@pytest.fixture
def by_action(rig):
    # Where it is not installed it is made now; the node looks for it when it starts.
    follow_joint_trajectory()
    for _ in range(3):
        # Within one process Fast DDS now and then never tells of a server. Users have several.
        r = ByAction(rig().ready())
        if r.is_found():
            yield r
            r.close()
            return
        r.close()
        r.r.close()
    pytest.fail('the action was not found by three rigs, one after the other')


def test_a_goal_is_corrected_and_its_feedback_and_result_translated_back(by_action):
    from action_msgs.msg import GoalStatus

    a, r = by_action, by_action.r
    a.send(r.plan(r.told[-1], TARGET))
    assert r.run(PATIENCE_S, lambda: a.controller.goals)
    assert r.run(PATIENCE_S, lambda: a.controller._active is not None)
    feedback = a.action.Feedback(joint_names=NAMES)
    actual = r.q
    feedback.desired.positions = (actual + 0.01).tolist()
    feedback.actual.positions = actual.tolist()
    feedback.error.positions = 7 * [0.01]
    a.controller._active.publish_feedback(feedback)
    assert r.run(PATIENCE_S, lambda: a.feedback)
    (back,) = a.feedback
    true = r.compensator.true(actual)
    assert np.abs(true - actual).max() > 2e-3
    # The arm has gone on meanwhile: the correction is that of where it was just then.
    np.testing.assert_allclose(back.actual.positions, true, atol=5e-4)
    np.testing.assert_allclose(back.desired.positions, true + 0.01, atol=5e-4)
    np.testing.assert_allclose(back.error.positions, 0.01)
    done = a.ended()
    assert done.status == GoalStatus.STATUS_SUCCEEDED
    assert done.result.error_code == 0
    np.testing.assert_allclose(r.q, r.compensator.command(TARGET), atol=1e-6)
    # One that is refused says why.
    a.send(r.plan(TARGET + 0.1, HOME))
    done = a.ended()
    assert done.status == GoalStatus.STATUS_ABORTED
    assert done.result.error_code == a.action.Result.INVALID_GOAL
    assert 'it begins' in done.result.error_string
    assert len(a.controller.goals) == 1
    # What the controller says of its end is passed on.
    assert r.run(
        PATIENCE_S, lambda: r.node._present.stands and np.abs(r.told[-1] - TARGET).max() < 1e-6
    )
    a.send(r.plan(r.told[-1], HOME))
    assert r.run(PATIENCE_S, lambda: a.controller._active is not None)
    a.controller.end('PATH_TOLERANCE_VIOLATED', 'too far')
    done = a.ended()
    assert done.status == GoalStatus.STATUS_ABORTED
    assert done.result.error_code == a.action.Result.PATH_TOLERANCE_VIOLATED
    assert done.result.error_string == 'too far'


def test_a_node_that_ends_lets_the_controller_hold_the_arm(by_action):
    """Nobody could cancel the goal any more."""
    a, r = by_action, by_action.r
    a.send(r.plan(r.told[-1], TARGET))
    assert r.run(PATIENCE_S, lambda: a.controller._active is not None)
    r.run(0.1)
    awaited = r.own.spin_once

    def both(**options):
        r.executor.spin_once(timeout_sec=0.005)
        awaited(**options)

    r.own.spin_once = both
    r.node.close()
    r.own.spin_once = awaited
    assert a.controller.cancelled == 1


def test_a_goal_is_cancelled_at_the_controller(by_action):
    from action_msgs.msg import GoalStatus

    a, r = by_action, by_action.r
    a.send(r.plan(r.told[-1], TARGET))
    assert r.run(PATIENCE_S, lambda: a.controller._active is not None)
    r.run(0.2)
    cancel = a.handle.cancel_goal_async()
    assert r.run(PATIENCE_S, cancel.done)
    assert a.ended().status == GoalStatus.STATUS_CANCELED
    assert a.controller.cancelled == 1
    assert np.abs(r.q - r.compensator.command(TARGET)).max() > 0.01
    # A controller that refuses, and one that is not there.
    assert r.run(PATIENCE_S, lambda: not r.node._moves())
    a.controller.refuses = lambda goal: True
    a.send(r.plan(r.told[-1], TARGET))
    done = a.ended()
    assert done.status == GoalStatus.STATUS_ABORTED
    assert 'the controller refuses it' in done.result.error_string
