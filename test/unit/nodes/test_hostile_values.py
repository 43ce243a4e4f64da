# SPDX-License-Identifier: Apache-2.0
"""Hostile values to every subscription, service and parameter of every node, in every state.

No message, request or parameter may end a node that leads an arm, nor lead to what nobody has
foreseen: a callback that raises is found here. The callbacks are those that rclpy would execute.
"""

import contextlib
import inspect
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

import compensator_rig
import rclpy
from bridge_places import AWAY, TARGET
from bridge_rig import CELL, CHAIN, HOME, MODEL, point, stamp
from builtin_interfaces.msg import Time
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.serialization import serialize_message
from rigs.hostile_values import spoilt, spoilt_parameters, spoilt_text
from rigs.ros_rig import OWN_DOMAIN, node_arguments
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import Bool, Header, String
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection.events import (
    BridgeState,
    ConfigurationEnded,
    EventRecord,
    PlannerState,
    RecorderState,
    SensorReport,
    SolutionSettled,
    encode,
)
from remaster_ros.motion.states import Arm
from remaster_ros.nodes.running import OneThread, spin_once

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]

NAMES = list(CHAIN.joint_names)
SAMPLE = 12
"""So many values of each message are tried at every run; all of them in the campaigns."""


def is_exhaustive(request):
    """Whether all values are to be tried."""
    return 'qualify' in {mark.name for mark in request.node.iter_markers()}


def joint_state(prefix=''):
    message = JointState(name=[prefix + name for name in NAMES], position=HOME.tolist())
    message.velocity = message.effort = [0.0] * len(NAMES)
    message.header.stamp = stamp(1000.0)
    return message


def trajectory():
    message = JointTrajectory(joint_names=NAMES, points=[point(HOME, 1), point(TARGET, 2)])
    for waypoint in message.points:
        waypoint.velocities = [0.0] * len(NAMES)
    message.header.stamp = stamp(1.0)
    return message


def records():
    """Return a record of each kind that the nodes act on."""
    bodies = [
        PlannerState(state='running', run='token'),
        RecorderState(waiting_for='', run='token', require='mocap', read_age_s={'mocap': 0.0}),
        BridgeState(halted='', joints_age_s=0.0),
        SensorReport(sensor='mocap', ready=True),
        ConfigurationEnded(stamp='1.000000000', solution=0, result='recorded'),
        SolutionSettled(stamp='1.000000000', solution=0, motion_s=1.0, settle_s=1.0),
    ]
    return [
        encode(EventRecord(node=f'/{body.sender or "mocap"}', body=body, model=MODEL))
        for body in bodies
    ]


VALID = {
    JointState: joint_state,
    JointTrajectory: trajectory,
    Bool: lambda: Bool(data=False),
    Temperature: lambda: Temperature(temperature=20.0),
    Header: lambda: Header(stamp=Time(sec=1), frame_id='12'),
}


def messages(subscription, most, rng):
    """Return hostile messages for a subscription."""
    kind = subscription.msg_type
    if kind is String:
        texts = [*records(), CELL.urdf_text] if most is None else [rng.choice(records())]
        return [message for text in texts for message in spoilt_text(text, most, rng)]
    return spoilt(VALID.get(kind, kind)(), most, rng)


def call(subscription, message):
    """Call a subscription's callback as the executor does."""
    deliver(subscription, serialize_message(message) if subscription.raw else message)


def deliver(subscription, given):
    try:
        inspect.signature(subscription.callback).bind(given)
    except TypeError:
        subscription.callback(given, {'publication_sequence_number': None})
    else:
        subscription.callback(given)


class Attack:
    """Hostile values to a node; what its callbacks do not catch is kept.

    Attributes
    ----------
    faults
        What was not foreseen, each with the message.
    sent
        How many values were sent.
    """

    def __init__(self, node, most, seed=1):
        print('seed', seed)
        self.node, self.most, self.rng = node, most, np.random.default_rng(seed)
        self.faults, self.sent = [], 0
        self._own = node.on_fault

    def note(self, what, error):
        self.faults.append(f'{what}: {type(error).__name__}: {error}'[:500])

    def on_topics(self, after=lambda: None):
        """Send to each subscription; call `after` behind each message."""
        for subscription in list(self.node.subscriptions):
            if subscription.topic_name.startswith(('/parameter_events', '/clock')):
                continue
            for message in messages(subscription, self.most, self.rng):
                self.sent += 1
                try:
                    call(subscription, message)
                    after()
                except Exception as error:
                    self.note(f'{subscription.topic_name} {str(message)[:200]}', error)
            if subscription.raw:
                for data in (b'', b'\x00', b'\x00\x01\x00\x00' + b'\xff' * 40):
                    self.sent += 1
                    try:
                        deliver(subscription, data)
                    except Exception as error:
                        self.note(f'{subscription.topic_name} {data!r}', error)

    def on_services(self, after=lambda: None):
        """Call each service; those of parameters with hostile values."""
        for service in list(self.node.services):
            for request in self._requests(service):
                self.sent += 1
                try:
                    response = service.callback(request, service.srv_type.Response())
                    if inspect.iscoroutine(response):
                        # One that waits for others is not waited for here.
                        with contextlib.suppress(StopIteration):
                            response.send(None)
                        response.close()
                    after()
                except Exception as error:
                    self.note(f'{service.srv_name} {str(request)[:200]}', error)

    def _requests(self, service):
        kind = service.srv_type
        if kind in (SetParameters, SetParametersAtomically):
            names = [*self.node._parameters, 'no_such_parameter']
            if self.most is not None:
                live = ('speed_share', 'cartesian_speed_limit_m_s')
                names = [*(name for name in live if name in names), *names[-2:]]
            return [kind.Request(parameters=[parameter]) for parameter in spoilt_parameters(names)]
        return spoilt(kind.Request(), self.most, self.rng)

    def check(self):
        print(f'{self.node.get_name()}: {self.sent} values')
        found = [
            *self.faults,
            *(fault for fault in self.node._faults if fault.startswith('a fault')),
        ]
        assert not found, f'{len(found)}: ' + '\n'.join(found[:20])
        assert self.node.failure is None


STATES = ('standing', 'moving', 'braking', 'measuring', 'halted')


def bring(r, state):
    """Bring the bridge of a rig into a state."""
    if state == 'measuring':
        r.settle(TARGET)
    elif state == 'halted':
        r.alter = lambda m: setattr(m, 'position', [float('nan')] * 7) or m
        r.run(2.0, r.halted)
        r.alter = lambda m: m
    elif state != 'standing':
        r.go(AWAY, speed=0.2)
        if state == 'braking':
            r.say_planner('paused')
    wanted = {
        'standing': {Arm.STANDS, Arm.ASKS, Arm.PROBES},
        'moving': {Arm.MOVES},
        'braking': {Arm.BRAKES},
        'measuring': {Arm.MEASURES},
        'halted': {Arm.HALTED},
    }
    assert r.bridge.supervisor.state in wanted[state]


def attack_bridge(r, state, most):
    bring(r, state)
    attack = Attack(r.bridge, most)

    def after():
        r.wall += 1e-3
        r.bridge._watch()

    attack.on_topics(after)
    attack.on_services(after)
    r.bridge.status.publish()
    # What was taken may be used later only.
    r.run(1.0)
    attack.check()
    assert 'a fault of this program' not in r.bridge.supervisor.halted


@pytest.mark.parametrize('state', STATES)
def test_no_value_is_unforeseen_by_the_bridge(rig, state):
    attack_bridge(rig(), state, SAMPLE)


@pytest.mark.qualify
@pytest.mark.parametrize('state', STATES)
def test_no_value_at_all_is_unforeseen_by_the_bridge(rig, state):
    attack_bridge(rig(), state, None)


def test_an_empty_first_message_is_not_the_arms(rig):
    """It names none of the arm's joints, as a gripper's does not."""
    r = rig(ready=False)
    r.taken(r.states, JointState(), 'states')
    r.ready()
    r.settle(TARGET)
    assert not r.halted()


# The compensator


def attack_compensator(r, state, most):
    r.ready()
    if state == 'moving':
        r.planned.publish(r.plan(r.told[-1], compensator_rig.TARGET))
        assert r.run(60.0, lambda: r.node._moves())
    attack = Attack(r.node, most)
    attack.on_topics(r.step)
    attack.on_services(r.step)
    r.run(0.5)
    attack.check()
    assert not r.node._halted


@pytest.mark.parametrize('state', ['standing', 'moving'])
def test_no_value_is_unforeseen_by_the_compensator(compensator, state):
    attack_compensator(compensator(), state, SAMPLE)


@pytest.mark.qualify
@pytest.mark.parametrize('state', ['standing', 'moving'])
def test_no_value_at_all_is_unforeseen_by_the_compensator(compensator, state):
    attack_compensator(compensator(), state, None)


def test_a_fault_of_the_compensator_stops_the_arm_until_a_person_enables_it(compensator):
    r = compensator().ready()
    r.planned.publish(r.plan(r.told[-1], compensator_rig.TARGET))
    assert r.run(60.0, lambda: r.came and not r.node._present.stands)
    sent = len(r.came)

    def broken(*args):
        raise KeyError('unforeseen')

    original, r.node._states.take = r.node._states.take, broken
    # What the test's executor would raise goes to the node, as in its process.
    spin = r.own.spin_once
    r.own.spin_once = lambda timeout_sec: spin_once_of(spin, r.node, timeout_sec)
    assert r.run(60.0, lambda: r.node._halted)
    r.node._states.take = original
    assert r.run(20.0, lambda: len(r.came) > sent)
    (stop,) = r.came[-1].points
    assert not any(stop.velocities)
    assert r.run(20.0, lambda: r.node._present.stands)
    np.testing.assert_allclose(r.q, stop.positions, atol=1e-6)
    assert np.abs(r.q - r.compensator.command(compensator_rig.TARGET)).max() > 1e-2
    assert r.run(20.0, lambda: "KeyError: 'unforeseen'" in r.states[-1]['why'])
    assert "KeyError: 'unforeseen'" in r.refused(r.plan(r.told[-1], compensator_rig.TARGET))
    assert r.call('enable').success
    assert not r.node._halted


def spin_once_of(spin, node, timeout_s):
    executor = SimpleNamespace(spin_once=spin)
    spin_once(executor, node, timeout_s)


# The other nodes


def other_node(name, folder):
    """Make a node as its process would; the executables beside the bridge."""
    from remaster_ros.nodes import optimizer, pose_planner, recorder, watch
    from remaster_ros.nodes.fake_robot import FakeRobotNode
    from remaster_ros.nodes.sensor_markers import SensorNode

    session = {'session': folder / 'session'}
    made = {
        'pose_planner': (pose_planner.PosePlanner, {**session, 'registration_candidates': 6}),
        'recorder': (recorder.Recorder, session),
        'optimizer': (optimizer.Optimizer, {**session, 'cell': 'demo', 'out': folder / 'fit'}),
        'watch': (watch.Watch, {}),
        'fake_robot': (FakeRobotNode, {}),
        'optitrack_markers': (lambda: SensorNode('optitrack_markers'), {'sensor': 'mocap'}),
        'laser_tracker_markers': (
            lambda: SensorNode('laser_tracker_markers'),
            {'sensor': 'tracker', 'host': '127.0.0.1', 'port': 1},
        ),
    }
    make, parameters = made[name]
    rclpy.init(args=[*node_arguments(**parameters), '--log-level', 'fatal'], domain_id=OWN_DOMAIN)
    return make()


OTHERS = (
    'pose_planner', 'recorder', 'optimizer', 'watch', 'fake_robot', 'optitrack_markers',
    'laser_tracker_markers',
)  # fmt: skip


def attack_other(name, folder, monkeypatch, most):
    monkeypatch.setenv('ROS_HOME', str(folder))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    node = None
    try:
        node = other_node(name, folder)
        executor = OneThread()
        executor.add_node(node)
        attack = Attack(node, most)
        for _ in range(2):
            # Once more with what the first values have left behind.
            attack.on_topics()
            attack.on_services()
            for _ in range(20):
                spin_once(executor, node, 0.01)
        attack.check()
    finally:
        if node is not None:
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()


@pytest.mark.parametrize('name', OTHERS)
def test_no_value_is_unforeseen_by_the_other_nodes(name, tmp_path, monkeypatch):
    attack_other(name, tmp_path, monkeypatch, 4)


@pytest.mark.qualify
@pytest.mark.parametrize('name', OTHERS)
def test_no_value_at_all_is_unforeseen_by_the_other_nodes(name, tmp_path, monkeypatch):
    attack_other(name, tmp_path, monkeypatch, None)


# A fault of this program


def test_a_fault_while_the_arm_moves_stops_and_halts_it_with_its_place(rig):
    r = rig()
    r.go(AWAY, speed=0.2)
    sent = r.bridge.published

    def broken(*args):
        raise KeyError('unforeseen')

    r.bridge._states.take = broken
    executor = OneThread()
    r.executor.remove_node(r.bridge)
    executor.add_node(r.bridge)
    r.wall += 0.02
    r.states.publish(joint_state())
    r.wait(lambda: spin_once(executor, r.bridge, 0.01) or r.halted(), 'the halt')
    why = r.halted()
    assert why.startswith("a fault of this program, please report it: KeyError: 'unforeseen' (")
    # The innermost frame of this package.
    assert 'robot_bridge.py, line' in why
    assert '_take_report' in why
    assert r.bridge.published == sent + 1, 'the arm was not stopped along its line'
    assert r.bridge.failure is None
    r.arm.advance(r.wall + 3.0)
    # It lives on, and says so.
    assert r.bridge._summary().level == 'error'
    executor.remove_node(r.bridge)
    r.executor.add_node(r.bridge)


def test_a_command_that_cannot_be_published_is_none(rig):
    """The arm stands where it was, and is halted."""
    r = rig()
    before = len(r.commands)

    def full(*how):
        raise OverflowError('it does not fit')

    r.bridge._publish, original = full, r.bridge._publish

    def go():
        r.plan(TARGET)
        r.run(2.0)

    with pytest.raises(OverflowError):
        go()
    r.bridge._publish = original
    assert r.bridge.supervisor.state in (Arm.STANDS, Arm.ASKS)
    r.bridge.on_fault(OverflowError('it does not fit'))
    assert 'OverflowError: it does not fit' in r.halted()
    assert len(r.commands) == before


def test_a_message_that_cannot_be_read_is_left_out(rig):
    """Bytes that are no message: rclpy never takes from that topic again by itself."""
    r = rig()
    executor = OneThread()
    r.executor.remove_node(r.bridge)
    executor.add_node(r.bridge)
    r.states.publish(b'\x00\x01\x00\x00' + b'\xff' * 64)
    for _ in range(20):
        spin_once(executor, r.bridge, 0.005)
    executor.remove_node(r.bridge)
    r.executor.add_node(r.bridge)
    r.settle(TARGET)
    assert not r.halted()
