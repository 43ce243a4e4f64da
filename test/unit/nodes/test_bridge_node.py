# SPDX-License-Identifier: Apache-2.0
"""The robot bridge's shell: what it makes of each message, and each message that it sends."""

import runpy
import sys

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from bridge_places import AWAY, TARGET
from bridge_rig import PATIENCE_S, stamp
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection.events import Alive, ArmHalted, PlannerState, RecorderState
from remaster_ros.nodes import robot_bridge, running

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]


# What it shows


def test_the_summary(rig):
    r = rig()
    named = r.plan(TARGET)
    r.wall += 0.06
    level, text, values = r.summary()
    assert (level, text) == ('ok', 'waiting for a pose')
    for key in ('node', 'started', 'uptime_s'):
        values.pop(key)
    assert values == {
        'commanded': '0',
        'settled': '0',
        'failed': '0',
        'stopped': '0',
        'halted': '',
        'asks_for_collect': '',
        'joints_age_s': '0.1',
        'joints_trouble': '',
        'correction': '',
        'moves_refused': '0',
        'moves_cut_short': '0',
        'pose': named,
        'run': 'token',
        'qos_trouble': '',
    }
    r.report(position=[float('nan')] * 7)
    assert r.summary()[2]['joints_refused_not_finite'] == '1'
    r.wall += 0.3
    r.report(position=[float('nan')] * 7)
    assert r.summary()[2]['joints_refused_not_finite'] == '2'
    assert r.summary()[2]['joints_age_s'] == '0.4'
    r.waiting_for = 'mocap'
    r.say(RecorderState(waiting_for='mocap'))
    level, text, _ = r.summary()
    assert (level, text) == ('warn', 'waiting for mocap')


def test_the_token_of_a_run_is_the_running_planners(rig):
    r = rig()
    r.say(PlannerState(state='running', run='first'))
    assert r.summary()[2]['run'] == 'first'
    r.say(PlannerState(state='idle', run='second'))
    assert r.summary()[2]['run'] == 'first'
    r.say(PlannerState(state='running', run=''))
    assert r.summary()[2]['run'] == ''


def test_others_summaries_are_no_sign_of_planner_or_recorder(rig):
    r = rig()
    r.alive = {'robot'}
    for _ in range(12):
        r.run(0.1, dt=0.1)
        r.say(Alive())
    assert r.summary()[:2] == ('warn', 'no sign of planner, recorder for 1 s')
    r.say(PlannerState(state='unknown', run=''))
    assert r.summary()[1] == 'no sign of recorder for 1 s'
    r.say(RecorderState(waiting_for=''))
    assert r.summary()[1] == 'planner is unknown'
    r.say(PlannerState(state='running', run=''))
    assert r.summary()[:2] == ('ok', 'waiting for a pose')


# Reports of the joints


def test_reports_without_a_joint_halt_a_collection(rig):
    r = rig()
    r.settle(TARGET)
    names = [r.names[i] for i in r.order]
    r.alter = lambda m: JointState(
        header=m.header, name=['elbow', *names[1:]], position=m.position
    )
    r.run(0.45)
    assert not r.halted()
    r.run(0.3)
    wanted = (
        f'joint_states lacks {names[0]}; it has elbow, {", ".join(names[1:])}: '
        'does the cell file name the robot that is running?'
    )
    assert r.halted() == wanted
    assert r.named(ArmHalted) == [ArmHalted(stamp='1.000000000', reason=wanted)]
    assert ('error', f'halted: {wanted}') in r.bridge.logged


def test_reports_that_name_each_joint_twice_halt_a_collection_and_are_counted(rig):
    """Two arms merged without prefix: whose joints the first ones are is not known."""
    r = rig()
    r.settle(TARGET)
    sent = r.bridge.published
    r.alter = lambda m: JointState(
        header=m.header, name=[*m.name, *m.name], position=[*m.position, *([0.3] * 7)]
    )
    r.run(0.45)
    assert not r.halted()
    r.run(0.3)
    assert r.halted() == (
        f'joint_states has {", ".join(r.names)} more than once: are two arms merged in it? Give '
        'the joints of each a prefix, or each arm a namespace'
    )
    assert int(r.summary()[2]['joints_refused_joints']) > 10
    assert r.bridge.published == sent


def test_the_halt_is_shown_at_once_and_with_its_level(rig):
    r = rig()
    r.quiet()
    r.spin(5)
    count = len(r.summaries)
    r.alter = lambda m: setattr(m, 'position', [float('nan')] * 7) or m
    r.run(1.0, r.halted)
    shown = lambda: [s for s in r.summaries[count:] if s[2]['halted']]  # noqa: E731
    r.wait(shown, 'a summary of the halt')
    level, text, values = shown()[0]
    assert (level, text) == ('error', 'joint_states are not finite')
    assert values['halted'] == values['joints_trouble'] == text
    for _ in range(3):
        r.step()
    assert r.summary()[2]['joints_refused_not_finite'] == str(
        r.bridge.supervisor.reports.refused['not_finite']
    )


def test_joint_states_of_best_effort_are_heard(rig):
    r = rig(ready=False)
    first = r.states
    qos = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
    r.states = r.peer.create_publisher(JointState, 'joint_states', qos)
    r.wait(lambda: r.bridge.count_publishers('joint_states') == 2, 'the second publisher')
    r.wait(r.states.get_subscription_count, 'the match')
    r.peer.destroy_publisher(first)
    r.wait(lambda: r.bridge.count_publishers('joint_states') == 1, 'the end of the first one')
    r.ready()
    assert r.summary()[:2] == ('ok', 'waiting for a pose')


def test_lateness_is_told_by_the_nodes_clock_and_the_stamps(rig):
    """The clocks of the two hosts are half a minute apart: no matter. A late report does."""
    r = rig(ready=False)
    r.alter = lambda m: setattr(m.header, 'stamp', stamp(r.wall - 30.0)) or m
    r.ready()
    r.settle(TARGET)
    r.alter = lambda m: setattr(m.header, 'stamp', stamp(r.wall - 31.0)) or m
    r.run(2.0, r.halted)
    assert 'do not advance' in r.halted() or 'late' in r.halted()


# The clock


def test_without_the_simulated_clock_nothing_is_believed(rig):
    r = rig(ready=False, use_sim_time=True)
    wanted = 'no message of the simulated clock has come: which node publishes /clock?'
    assert r.bridge.clock_trouble == wanted
    seen, observe = [], r.bridge.supervisor.observe
    r.quiet()
    r.bridge.supervisor.observe = lambda *args: seen.append(args) or observe(*args)
    r.report()
    assert seen == [('clock', wanted, r.wall)]
    r.bridge.supervisor.observe = observe
    assert r.reason('clock') == wanted
    assert r.bridge.supervisor.report_age_s(r.wall) == np.inf
    assert r.reason('robot') == ''
    # It is looked at without a report, too, on a clock that always runs.
    r.bridge.supervisor.observe('clock', '', r.wall)
    assert r.reason('clock') == ''
    for timer in r.bridge.timers:
        timer.reset()
    r.wait(lambda: r.reason('clock') == wanted, 'the watch')


# The controller


def test_nothing_is_commanded_before_a_controller_listens(rig):
    r = rig(ready=False, controller=False)
    r.bridge._watch()
    assert r.reason('controller') == ('looking for another robot_bridge of this name')
    assert r.bridge._controller is None
    r.alone()
    r.plan(TARGET)
    r.run(2.0)
    wanted = 'no controller listens to /joint_trajectory_controller/joint_trajectory'
    assert r.summary()[:2] == ('warn', wanted)
    assert not r.bridge.published
    r.open_controller()
    r.wait(r.bridge._controller.matched, 'the controller')
    # A time to which half a second can be added exactly.
    r.wall = np.ceil(r.wall * 1024.0) / 1024.0
    r.bridge._watch()
    matched = r.wall
    assert r.bridge._controller_trouble(matched + 0.4999) == wanted
    assert r.bridge._controller_trouble(matched + 0.5) == ''
    r.run(0.45)
    assert r.summary()[1] == wanted, 'the controller may not be matched yet'
    r.run(10.0, lambda: r.commands)
    assert 0.5 <= r.commands[0].arrival_s - matched < 1.2
    r.run(10.0, lambda: r.settled)


def test_a_controller_that_goes_halts_the_arm(rig):
    r = rig()
    r.go(AWAY, speed=0.2)
    r.close_controller()
    r.controller = None
    r.wait(lambda: not r.bridge._controller.matched(), 'the end of the match')
    sent = r.bridge.published
    r.bridge._watch()
    assert r.halted() == 'no controller listens to /joint_trajectory_controller/joint_trajectory'
    # Whether anybody hears it or not.
    assert r.bridge.published == sent + 1


@pytest.mark.parametrize(
    'name', ['recorder', 'laser_tracker_markers', 'laser_tracker_markers_left', 'robot_bridge']
)
def test_a_recorder_that_listens_is_no_controller(rig, name):
    """Nodes of ours listen to the commands, too: no arm moves by it."""
    r = rig(ready=False, controller=False)
    node = robot_bridge.RemasterNode.__mro__[1](name, context=r.context)
    node.create_subscription(JointTrajectory, robot_bridge.COMMANDS, print, 10)
    r.alone()
    r.wait(r.bridge._controller.matched, 'the match')

    def listed():
        # A node's name is known later than its subscription.
        found = r.bridge.get_subscriptions_info_by_topic(f'/{robot_bridge.COMMANDS}')
        return name in [info.node_name for info in found]

    r.wait(listed, 'the node')
    r.plan(TARGET)
    r.run(1.5)
    assert r.summary()[1].startswith('no controller listens to ')
    assert not r.bridge.published
    node.destroy_node()


def test_controllers_of_best_effort_hear_it(rig):
    r = rig(ready=False, controller=False)
    r.open_controller(
        reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE
    )
    r.ready()
    r.plan(TARGET)
    r.run(5.0, lambda: r.moves())


# The end


def test_the_end_of_the_bridge_stops_an_arm_on_its_way(rig):
    r = rig()
    r.go(AWAY, speed=0.2)
    bridge, sent, events = r.bridge, r.bridge.published, len(r.events)
    bridge.close()
    assert bridge.published == sent + 1
    r.wait(lambda: len(r.commands) == sent + 1 and len(r.events) > events, 'the stop')
    assert r.events[-1].reason == 'planner is gone: the bridge stops'
    stop = r.commands[-1]
    assert np.all(stop.v[-1] == 0.0)
    r.arm.advance(r.wall + 3.0)
    assert r.arm.speed() < 1e-6
    assert 0.05 < r.arm.q[0] < 0.55
    for background in (bridge._paths, bridge._disk):
        background._thread.join(PATIENCE_S)
        assert not background._thread.is_alive()


def test_the_end_of_the_bridge_does_not_wait_for_a_path_but_for_a_halt_on_disk(rig, monkeypatch):
    r = rig()
    waits = []
    monkeypatch.setattr(r.bridge._paths, 'close', lambda *a: waits.append(a))
    monkeypatch.setattr(r.bridge._disk, 'close', lambda *a: waits.append(a))
    r.bridge.close()
    assert waits == [(0.5,), ()]
    monkeypatch.undo()


def test_main_runs_the_bridge_with_short_turns_of_the_interpreter(monkeypatch):
    made, turns = [], []
    monkeypatch.setattr(robot_bridge, 'run', lambda *args: made.append(args) or 7)
    monkeypatch.setattr(robot_bridge.sys, 'setswitchinterval', turns.append)
    assert robot_bridge.main(['x']) == 7
    assert made == [(robot_bridge.RobotBridge, ['x'])]
    assert turns == [1e-3]
    # The installed command gives no arguments: those of the process hold.
    assert robot_bridge.main() == 7
    assert made[1:] == [(robot_bridge.RobotBridge, None)]


def test_the_module_runs_as_a_program_with_its_exit_status(monkeypatch):
    monkeypatch.setattr(running, 'run', lambda make, args: 7)
    monkeypatch.setattr(robot_bridge.sys, 'setswitchinterval', lambda seconds: None)
    monkeypatch.delitem(sys.modules, robot_bridge.__name__)
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(robot_bridge.__name__, run_name='__main__')
    assert ended.value.code == 7
