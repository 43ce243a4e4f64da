# SPDX-License-Identifier: Apache-2.0
"""The robot bridge's shell: who else commands, the emergency stop, and halts that are kept."""

import json
import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from bridge_places import AWAY
from bridge_rig import HOME, stamp
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection.events import HaltCleared, PlannerState, RecorderState
from remaster_ros.motion.actions import Drive, Renew, Stop
from remaster_ros.nodes import robot_bridge
from remaster_ros.nodes.status import LEASED

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]

COMMANDS = 'joint_trajectory_controller/joint_trajectory'
TOPICS = [
    ('remaster/joint_solutions', JointTrajectory, 'peer'),
    ('remaster/joint_waypoints', JointTrajectory, 'peer'),
    (COMMANDS, JointTrajectory, 'robot_bridge'),
]


@pytest.fixture
def intruder(own_nodes):
    """Return a node in a process of its own, as far as DDS can tell."""
    return own_nodes.make('intruder', is_spun=False)


def listed(bridge, topic, count):
    return lambda: (
        bridge.count_publishers(topic) == count
        and 'UNKNOWN' not in str([i.node_name for i in bridge.get_publishers_info_by_topic(topic)])
    )


# Rivals


@pytest.mark.parametrize(('topic', 'kind', 'first'), TOPICS)
def test_a_second_publisher_halts_a_collection(rig, intruder, topic, kind, first):
    r = rig()
    r.go(AWAY, speed=0.2)
    sent = r.bridge.published
    r.quiet()
    intruder.create_publisher(kind, topic, 10)
    r.wait(listed(r.bridge, topic, 2), 'the intruder')
    r.bridge._watch()
    both = ', '.join(sorted(['/intruder', f'/{first}']))
    assert r.halted() == (
        f'2 publishers on /{topic}, where one may be: {both}; '
        'end the others (those of a killed process are listed for some 20 s)'
    )
    # It follows its path: it is stopped there.
    r.wait(lambda: len(r.commands) == sent + 1, 'the stop')
    assert np.all(r.commands[-1].v[-1] == 0.0)
    assert r.reason('rivals') == r.halted()


def test_a_second_publisher_of_the_arms_joints_halts_a_collection(rig, intruder):
    """Noticed by the numbers of the messages, as others may publish other joints there."""
    r = rig()
    states = intruder.create_publisher(JointState, 'joint_states', 200)
    r.wait(listed(r.bridge, 'joint_states', 2), 'the intruder')
    r.wait(states.get_subscription_count, 'the match')
    r.go(AWAY, speed=0.2)
    sent = r.bridge.published
    message = JointState(name=r.names, position=r.arm.q.tolist())
    message.header.stamp = stamp(r.wall + 0.001)
    r.taken(states, message, 'states')
    assert r.halted() == (
        "the arm's joints come on /joint_states from more than one publisher, or from one that "
        'was started again; on it are /intruder, /peer: end all others that publish the '
        "arm's joints"
    )
    # It follows its path: it is stopped there.
    r.wait(lambda: len(r.commands) == sent + 1, 'the stop')
    assert np.all(r.commands[-1].v[-1] == 0.0)
    r.bridge._watch()
    assert r.reason('rivals') == r.halted()
    # Gone for as long as the robot may be silent: then a person may go on.
    r.run(0.9)
    assert r.reason('rivals')
    r.run(0.3)
    assert r.reason('rivals') == ''


def test_a_gripper_may_publish_its_own_joints(rig, intruder):
    r = rig()
    gripper = intruder.create_publisher(JointState, 'joint_states', 200)
    r.wait(listed(r.bridge, 'joint_states', 2), 'the gripper')
    r.wait(gripper.get_subscription_count, 'the match')

    def publish_gripper(message):
        # Its clock and its numbers are its own.
        r.taken(gripper, JointState(name=['finger'], position=[0.01]), 'states')
        return message

    r.alter = publish_gripper
    r.settle(AWAY)
    assert not r.halted()
    assert not r.bridge.supervisor.reports.refused
    assert r.summary()[2]['joints_trouble'] == ''


def test_another_robots_joints_are_named(rig):
    r = rig()
    r.settle(AWAY)
    r.alter = lambda m: setattr(m, 'name', [f'other_{name}' for name in m.name]) or m
    r.run(0.9)
    assert not r.halted()
    r.run(0.3)
    found = ', '.join(f'other_{r.names[i]}' for i in r.order)
    trouble = (
        f"joint_states has {found}, none of the cell's joints: does the cell file name the robot "
        'that is running?'
    )
    assert r.halted() == f'no sign of robot for 1 s; {trouble}'
    assert r.summary()[2]['joints_trouble'] == trouble


def test_without_numbers_the_graph_tells_who_publishes(rig, intruder):
    """As with a middleware that gives messages none."""
    r = rig()
    r.quiet()
    intruder.create_publisher(JointState, 'joint_states', 10)
    r.wait(listed(r.bridge, 'joint_states', 2), 'the intruder')
    states, message = r.bridge._states, JointState(name=r.names)
    assert states.rival() == ''
    assert states.note(message, {'publication_sequence_number': None})
    assert states.rival().startswith('2 publishers on /joint_states, where one may be: ')


def test_another_bridge_with_a_lease_halts_a_collection(rig, intruder):
    """Another one's commands have a lease as ours: it counts as soon as a killed one would not."""
    r = rig()
    r.go(AWAY, speed=0.2)
    intruder.create_publisher(JointTrajectory, COMMANDS, LEASED)
    r.wait(listed(r.bridge, COMMANDS, 2), 'the intruder')
    r.bridge._watch()
    assert not r.halted()
    only = r.bridge._only[2]
    r.wait(lambda: only._alive == 1, 'its lease')
    r.run(3.2, r.halted, dt=0.05)
    assert r.halted().startswith(f'2 publishers on /{COMMANDS}, where one may be: ')


def test_the_graph_and_silence_are_watched_by_themselves(rig):
    """With a timer on a clock that always runs, 20 times a second."""
    r = rig()
    watched = []
    r.bridge.supervisor.observe = lambda *args: watched.append((time.monotonic(), *args)) or []
    began = time.monotonic()
    while time.monotonic() - began < 0.5:
        r.executor.spin_once(timeout_sec=0.05)
    names = [name for _, name, _, _ in watched]
    assert names[:5] == ['rivals', 'model', 'controller', 'clock', 'safety_link']
    assert 4 <= len(names) / 5 <= 11
    assert {(trouble, wall) for _, _, trouble, wall in watched} == {('', r.wall)}


# Emergency stop

EMERGENCY = 'robot/emergency_stop'
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def show(r, publisher, state):
    publisher.publish(Bool(data=state))
    wanted = 'the robot reports an emergency stop' if state else ''
    r.wait(lambda: r.reason('safety') == wanted, 'the emergency stop')


def test_an_emergency_stop_halts_and_is_cleared_only_after_its_end(rig):
    r = rig(ready=False, emergency_stop_topic=EMERGENCY)
    assert r.bridge._emergency.topic == f'/{EMERGENCY}'
    publisher = r.peer.create_publisher(Bool, EMERGENCY, LATCHED)
    r.alone()
    silent = f'/{EMERGENCY} (emergency_stop_topic) is silent: nothing moves without it'
    assert r.reason('safety_link') == silent
    show(r, publisher, False)
    r.ready()
    r.go(AWAY, speed=0.2)
    sent = r.bridge.published
    show(r, publisher, True)
    assert r.halted() == 'the robot reports an emergency stop'
    r.run(0.5)
    # Nothing is commanded to an arm that its brakes have stopped.
    assert r.bridge.published == sent
    answer = r.call_clear()
    assert (answer.success, answer.message) == (False, 'the robot reports an emergency stop')
    assert not r.named(HaltCleared)
    assert r.halted()
    show(r, publisher, False)
    assert r.halted(), 'its end alone ends no halt'
    # It was led to AWAY, and stands where the stop came.
    asked = r.call_clear()
    assert not asked.success
    assert asked.message.startswith('the arm is not reported where the last command led: joint_')
    assert r.call_clear().success


def paused_in(r, monkeypatch, name, pause_s=1.88):
    """Pause the process (SIGSTOP) while the gate makes its next command."""
    gate = r.bridge.supervisor.gate
    make = getattr(gate, name)

    def pause(*args, **options):
        admitted = make(*args, **options)
        monkeypatch.setattr(gate, name, make)
        r.wall += pause_s
        return admitted

    monkeypatch.setattr(gate, name, pause)


@pytest.mark.parametrize('pause_s', [1.88, 0.11])
def test_a_stop_is_not_published_after_a_pause_of_the_process(rig, monkeypatch, pause_s):
    """It is for a place that the arm has left: 5.2 times the speed limit, once in a campaign."""
    r = rig()
    r.go(AWAY, speed=0.2)
    sent = r.bridge.published
    paused_in(r, monkeypatch, 'stop', pause_s)
    r.say_planner('paused')
    r.flush()
    assert r.halted() == (
        f'planner is paused; this process was paused for {pause_s:.2f} s just then: '
        'nothing is commanded'
    )
    r.run(2.0)
    assert r.bridge.published == sent
    assert r.bridge.counts['stopped'] == 0


@pytest.mark.parametrize(('limit_s', 'pause_s'), [(0.1, 0.09), (0.125, 0.125)])
def test_a_stop_that_is_hardly_late_is_published(rig, monkeypatch, limit_s, pause_s):
    assert {Stop: 0.1, Renew: 0.1, Drive: 0.5} == robot_bridge.LATE_WALL_S
    monkeypatch.setitem(robot_bridge.LATE_WALL_S, Stop, limit_s)
    r = rig()
    r.go(AWAY, speed=0.2)
    # A time to which 0.125 s can be added exactly.
    r.wall = np.ceil(r.wall * 1024.0) / 1024.0
    sent = r.bridge.published
    paused_in(r, monkeypatch, 'stop', pause_s)
    r.say_planner('paused')
    r.flush()
    assert r.bridge.published == sent + 1
    assert not r.halted()


def test_a_move_is_not_published_after_a_pause_of_the_process(rig, monkeypatch):
    """Whatever came in meanwhile counts first; then it is asked for again."""
    r = rig()
    r.go(AWAY, speed=0.2)
    r.run(20.0, lambda: r.settled)
    sent, commanded = r.bridge.published, r.bridge.counts['commanded']
    paused_in(r, monkeypatch, 'admit')
    r.plan(HOME)
    assert r.bridge.published == sent
    assert r.bridge.counts['commanded'] == commanded
    r.say_planner('paused')
    r.run(1.0)
    assert r.bridge.published == sent, 'what came in meanwhile was not looked at'
    assert not r.halted()
    r.say_planner('running')
    # In another run the probe comes first.
    r.run(4.0, lambda: r.bridge.published == sent + 2)
    r.flush()
    assert np.allclose(r.commands[-1].q[-1], HOME, atol=1e-9)


# Halts that are kept


def halt(r):
    """Halt by reports that are not believed."""
    alter, r.alter = r.alter, lambda m: setattr(m, 'position', [float('nan')] * 7) or m
    r.run(1.0, r.halted)
    r.alter = alter
    return r.halted()


def files(folder):
    return sorted((folder / 'remaster_ros').glob('halt*'))


def test_a_halt_is_kept_shown_and_cleared_by_a_person(rig, tmp_path):
    r = rig()
    named = r.plan()
    reason = halt(r)
    assert reason == 'joint_states are not finite'
    path = tmp_path / 'remaster_ros' / 'halt_0_robot_bridge.json'
    r.wait(path.exists, 'the file')
    assert json.loads(path.read_text())['halted'] == reason
    level, text, values = r.summary()
    assert (level, text, values['halted']) == ('error', reason, reason)
    r.quiet()
    r.spin(20)
    count = len(r.summaries)
    answer = r.call_clear()
    assert (answer.success, answer.message) == (True, 'cleared; /remaster/collect goes on')
    r.wait(lambda: not path.exists(), 'the end of the file')
    r.flush()
    assert r.named(HaltCleared) == [HaltCleared(stamp=named)]
    # It is shown at once.
    r.wait(lambda: any(not s[2]['halted'] for s in r.summaries[count:]), 'a summary')
    # And nothing moves before the collection goes on.
    r.run(0.5)
    level, text, _ = r.summary()
    assert (level, text) == ('warn', 'the halt was cleared: /remaster/collect goes on')
    again = r.call_clear()
    assert (again.success, again.message) == (False, 'the arm is not halted')
    r.flush()
    assert len(r.named(HaltCleared)) == 1
    assert not r.commands
    assert not any(level == 'error' and 'halt is not' in text for level, text in r.bridge.logged)


def test_a_bridge_that_is_started_again_is_still_halted(rig, tmp_path):
    r = rig()
    halt(r)
    r.wait(lambda: files(tmp_path), 'the file')
    r.close()
    again = rig(ready=False)
    assert again.halted().startswith('joint_states are not finite (halted ')
    assert again.logged() == [('error', f'halted: {again.halted()}')]
    again.alone()
    again.plan(HOME + 0.1)
    again.run(1.0)
    assert not again.bridge.published
    assert again.summary()[:2] == ('error', again.halted())
    assert again.call_clear().success
    again.wait(lambda: not files(tmp_path), 'the end of the file')


def test_a_damaged_halt_file_is_a_halt(rig, tmp_path):
    path = tmp_path / 'remaster_ros' / 'halt_0_robot_bridge.json'
    path.parent.mkdir()
    path.write_text('garbage')
    r = rig(ready=False)
    assert r.halted().startswith(f'{path}: a halt that cannot be read (')
    assert r.call_clear().success
    r.wait(lambda: not path.exists(), 'the end of the file')


def test_a_halt_that_cannot_be_kept_is_said(rig, tmp_path):
    (tmp_path / 'remaster_ros').write_text('a file where the folder should be')
    r = rig(first=True)
    halt(r)
    r.wait(lambda: 'the halt is not kept' in str(r.bridge.logged), 'the error')
    (text,) = [text for level, text in r.bridge.logged if 'kept' in text and level == 'error']
    path = tmp_path / 'remaster_ros' / 'halt_0_robot_bridge.json'
    assert text.startswith(f'{path}: the halt is not kept (')
    assert text.endswith(')')
    # It is halted all the same.
    assert r.halted()


def test_the_disk_does_not_keep_a_halt_waiting(rig, monkeypatch):
    """A file system that hangs: the arm is halted, and the bridge goes on."""
    r = rig()
    monkeypatch.setattr(r.bridge._halt_file, 'write', lambda reason: time.sleep(0.5))
    r.wall += 0.1
    began = time.monotonic()
    r.bridge._do([robot_bridge.Halted('why')])
    assert time.monotonic() - began < 0.3
    assert r.bridge._paths is not r.bridge._disk


def test_a_halt_on_the_way_out_is_kept(rig, tmp_path):
    """The bridge ends while it does not know where the arm is: the next one must be halted."""
    r = rig()
    r.go(AWAY, speed=0.2)
    r.wall += 0.4
    r.bridge.close()
    (path,) = files(tmp_path)
    halted = json.loads(path.read_text())['halted']
    assert halted.startswith('planner is gone: the bridge stops; the last report of the joints is')


# Time


def test_every_rule_is_asked_at_the_time_it_is(rig):
    """Each call of the supervisor has the wall time at which its message was taken."""
    r = rig()
    seen = {}

    class Watched:
        def __init__(self, inner):
            self.inner = inner

        def __getattr__(self, name):
            value = getattr(self.inner, name)
            if not callable(value) or name.startswith('_'):
                return value

            def call(*args, **how):
                seen.setdefault(name, []).append(args)
                return value(*args, **how)

            return call

    r.bridge.supervisor = Watched(r.bridge.supervisor)
    r.wall += 0.125
    r.say(RecorderState(waiting_for='x'))
    r.say(PlannerState(state='running', run='its'))
    r.report()
    r.report(name=r.names[:1])
    r.report(name=['finger'])
    r.plan(HOME + 0.05)
    r.bridge._watch()
    r.answer('1.000000000', 3)
    r.bridge._on_emergency_stop(False)
    r.call_clear()
    wanted = {
        'recorder_waits': ('x', r.wall),
        'planner_is': ('running', r.wall, 'its'),
        'emergency': (False, r.wall),
        'answered': (3, r.wall),
        'clear_halt': (),
    }
    for name, args in wanted.items():
        assert seen[name][0] == args, name
    names = [args[0] for args in seen['observe']]
    begin = names.index('rivals')
    assert names[begin:][:5] == ['rivals', 'model', 'controller', 'clock', 'safety_link']
    assert {args[2] for args in seen['observe']} == {r.wall}
    assert seen['plan'][0][1:] == (r.wall, {}, {}, {})
    assert seen['doubt'][0][1] == r.wall
    assert seen['other_joints'][0][1] == r.wall
    (report,) = seen['report'][0]
    assert report.wall_s == r.wall
    assert report.clock_s == r.wall + 0.25
    assert report.stamp_s == pytest.approx(r.wall)
