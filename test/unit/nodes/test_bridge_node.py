"""The robot bridge's shell: what it makes of each message, and each message that it sends."""

import json
import runpy
import sys

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from bridge_rig import CHAIN, HOME, PATIENCE_S, Rig, stamp
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from simple_cells import write_cell
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection.events import (
    Alive,
    ArmHalted,
    ArmStopped,
    PlannerState,
    RecorderState,
    SolutionCommanded,
    SolutionFailed,
    SolutionSettled,
)
from remaster_ros.errors import InputError
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.path_check import PointSpeeds
from remaster_ros.nodes import robot_bridge, running
from remaster_ros.session.workcell import read_cell

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]

TARGET = HOME + np.array([0.1, 0.05, -0.1, 0.02, 0.15, -0.05, 0.3])
AWAY = HOME + np.array([0.6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
LOW = np.array([0.0, 0.9, 0.0, 1.2, 0.0, 0.3, 0.0])
POST = {'center_m': [*CHAIN.forward(LOW)[:2, 3].tolist(), 0.35], 'size_m': [0.06, 0.06, 0.7]}
TOOL = CHAIN.forward(HOME)[:3, 3]


def turned(q1):
    return np.array([q1, *LOW[1:]])


@pytest.fixture
def rig(monkeypatch, tmp_path):
    """Return a function that makes a rig with these parameters."""
    made = []

    def make(ready=True, **options):
        made.append(Rig(monkeypatch, tmp_path, **options))
        return made[-1].ready() if ready else made[-1]

    yield make
    for one in made:
        one.close()


# Parameters


def test_parameters_reach_the_limits_and_the_rules(rig, tmp_path):
    acceleration = [2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0]
    cell = write_cell(tmp_path / 'cell.yaml', acceleration_limit_rad_s2=acceleration)
    r = rig(
        ready=False,
        cell=cell,
        speed_share=0.4,
        cartesian_speed_limit_m_s=0.15,
        limit_margin_deg=2.0,
        settle_s=0.7,
        heartbeat_s=4.0,
    )
    bridge = r.bridge
    limits = bridge.supervisor.gate.limits
    wanted = MotionLimits.of(
        CHAIN, 0.4, None, np.array(acceleration), 0.15, float(np.deg2rad(2.0))
    )
    for name in ('lower', 'upper', 'velocity', 'acceleration', 'tool_speed', 'margin'):
        np.testing.assert_array_equal(getattr(limits, name), getattr(wanted, name), name)
    assert limits.names == CHAIN.joint_names
    assert bridge.supervisor.rules == bridge.p.rules()
    assert bridge.supervisor.rules.settle.settle_s == 0.7
    assert bridge._emergency._silence_s == 4.0
    assert bridge._emergency.topic == ''
    assert not r.logged()


def test_without_a_cartesian_limit_it_says_so(rig):
    r = rig(ready=False, cartesian_speed_limit_m_s=0.0)
    assert r.bridge.supervisor.gate.limits.tool_speed == np.inf
    assert r.logged() == [
        (
            'warning',
            'no Cartesian speed limit (cartesian_speed_limit_m_s is 0): the joints alone '
            'limit the speed of the arm',
        )
    ]


def test_without_a_cell_file_it_does_not_start(rig):
    with pytest.raises(InputError) as error:
        rig(ready=False, cell='')
    assert str(error.value) == (
        'robot_bridge: parameter cell is empty; give the cell file of this arm (demo, the '
        'shipped one, is for the fakes)'
    )


def test_bodies_that_are_never_looked_at_are_named(rig):
    bridge = rig(ready=False).bridge
    left_out = bridge._search._model.left_out
    assert left_out
    assert bridge.logged == [('info', f'collisions: {pair}') for pair in left_out]


def test_other_speeds_are_taken_while_it_runs(rig):
    r = rig()
    r.go(AWAY, speed=0.2)
    values = {'speed_share': 0.25, 'cartesian_speed_limit_m_s': 0.125}
    answers = r.bridge.set_parameters([Parameter(name, value=v) for name, v in values.items()])
    assert all(answer.successful for answer in answers)
    r.flush()
    limits = r.bridge.supervisor.gate.limits
    np.testing.assert_allclose(limits.velocity, 0.25 * CHAIN.velocity_limits)
    assert limits.tool_speed == 0.125
    assert (r.bridge.p.speed_share, r.bridge.p.cartesian_speed_limit_m_s) == (0.25, 0.125)
    assert [stop.reason for stop in r.named(ArmStopped)] == ['other limits']
    text = 'speed_share is 0.25, cartesian_speed_limit_m_s 0.125'
    assert ('info', text) in r.logged()
    r.run(30.0, lambda: r.settled)
    _, v, _ = r.commands[-1].spline().sample()
    assert np.all(np.abs(v) <= 0.25 * CHAIN.velocity_limits * 1.001)


def test_the_fastest_point_keeps_the_cartesian_limit(rig):
    r = rig(cartesian_speed_limit_m_s=0.1)
    r.settle(HOME + np.array([0.0, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0]))
    (move,) = r.moves()
    q, v, _ = move.spline().sample(20)
    model = read_cell('demo').collision_model(CHAIN)
    fastest = np.max(PointSpeeds(CHAIN, model.extent_points).fastest(q, v))
    assert 0.09 < fastest < 0.1002


def fit_with(folder, offsets_deg, std_deg=0.01, unknown=()):
    joints = [
        {
            'joint': name,
            'mean_deg': offsets_deg.get(name, 0.0),
            'std_deg': std_deg,
            'interval95_deg': [-0.02, 0.02],
            'identifiable': name not in unknown,
            'why': '',
        }
        for name in CHAIN.joint_names
    ]
    empty = {'gauge': [], 'registration': {}, 'markers': {}, 'noise': {}, 'left_out': []}
    sampler = {'name': 'x', 'chains': 1, 'draws': 1}
    sampler |= dict.fromkeys(('r_hat_max', 'ess_min', 'seconds'))
    fit = {'format': 'remaster-fit/1', 'joint_offsets': joints, 'sampler': sampler, **empty}
    fit['accuracy'] = {'optimization': None, 'validation': None}
    path = folder / 'fit.json'
    path.write_text(json.dumps(fit))
    return path


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_offsets_in_use_shift_the_limits(rig, tmp_path, sign):
    """True angle = reported + offset: with +2 degrees the upper stop comes 2 degrees earlier."""
    fit = fit_with(tmp_path, {'joint_2': 2.0 * sign})
    limits = rig(ready=False, offsets=fit, limit_margin_deg=0.0).bridge.supervisor.gate.limits
    lower, upper = CHAIN.lower.copy(), CHAIN.upper.copy()
    if sign > 0:
        upper[1] -= np.deg2rad(2.0)
    else:
        lower[1] += np.deg2rad(2.0)
    np.testing.assert_allclose(limits.lower, lower)
    np.testing.assert_allclose(limits.upper, upper)


@pytest.mark.parametrize(('sign', 'free'), [(1.0, False), (-1.0, True)])
def test_paths_are_checked_where_the_arm_is_with_its_offsets(rig, tmp_path, sign, free):
    """A post on the left: an arm that is further to the left than it reports reaches it."""
    fit = fit_with(tmp_path, {'joint_1': 3.0 * sign})
    cell = write_cell(tmp_path / 'cell.yaml', obstacles={'post': POST})
    nominal = read_cell(cell).collision_model(CHAIN, np.deg2rad(0.1))
    turns = np.linspace(-0.8, 0.0, 161)
    touching = next(turn for turn in turns if nominal.trouble(turned(turn)))
    q = turned(touching - np.deg2rad(1.5))
    assert not nominal.trouble(q)
    bridge = rig(ready=False, cell=cell, offsets=fit).bridge
    assert bool(bridge._search._model.trouble(q)) != free
    # So are the speeds of its points.
    v, offsets = np.ones(7), np.deg2rad([3.0 * sign, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    at = PointSpeeds(CHAIN, nominal.extent_points).fastest(q[None] + offsets, v[None])
    np.testing.assert_allclose(bridge._search._speeds.fastest(q[None], v[None]), at)
    np.testing.assert_allclose(bridge.supervisor.gate._speeds.fastest(q[None], v[None]), at)


@pytest.mark.parametrize(
    ('options', 'unknown_deg'),
    [
        ({}, 0.1),
        ({'std_deg': 0.2}, 0.6),
        # One that a fit could not tell is as unknown as before: the cell file's clearance.
        ({'unknown': ['joint_1']}, 1.0),
    ],
)
def test_the_clearance_covers_what_is_still_unknown(rig, tmp_path, options, unknown_deg):
    fit = fit_with(tmp_path, {'joint_1': 5.0}, **options)
    bridge = rig(ready=False, offsets=fit).bridge
    assert bridge._search._model.unknown_offset == pytest.approx(np.deg2rad(unknown_deg))
    shifted = bridge.supervisor.gate.limits.upper[0] < CHAIN.upper[0] - 0.01
    assert shifted == ('unknown' not in options)


def test_without_offsets_the_clearance_is_the_cell_files(rig):
    bridge = rig(ready=False).bridge
    assert bridge._search._model.unknown_offset == np.deg2rad(1.0)
    assert bridge._search._model.chain is bridge.chain
    np.testing.assert_array_equal(bridge.supervisor.gate.limits.upper, CHAIN.upper)


def test_reports_are_judged_by_the_limits_of_the_robot(rig):
    """By its own, not by the share of them that is used."""
    reports = rig(ready=False, speed_share=0.1).bridge.supervisor.reports
    np.testing.assert_allclose(reports._lower, CHAIN.lower - 0.05)
    np.testing.assert_allclose(reports._upper, CHAIN.upper + 0.05)
    np.testing.assert_allclose(reports._speed, 1.5 * CHAIN.velocity_limits)


# What it commands


def test_a_configuration_is_commanded_settles_and_is_announced(rig):
    """Every value of every event; the joints of both messages in their own orders."""
    r = rig()
    r.names = r.names[::-1]
    r.order = 6 - r.order
    before = r.wall
    named = r.plan(TARGET[::-1], names=r.names)
    r.names = r.names[::-1]
    r.order = 6 - r.order
    r.run(20.0, lambda: r.settled)
    probe, move = r.commands
    assert np.max(np.abs(probe.q - probe.start_q)) < 1e-4
    np.testing.assert_allclose(move.q[-1], TARGET, atol=1e-12)
    np.testing.assert_array_equal(move.v[-1], np.zeros(7))
    assert np.max(np.abs(move.v[0])) > 0.1
    assert np.all(np.diff(move.times_s) > 0.0)
    _, v, _ = move.spline().sample()
    assert np.all(np.abs(v) <= CHAIN.velocity_limits * 1.001)

    (message,) = r.settled
    assert list(message.name) == r.names
    np.testing.assert_allclose(message.position, TARGET, atol=1e-4)
    assert message.header.stamp == stamp(r.wall)

    commanded, settled = r.events
    assert isinstance(commanded, SolutionCommanded)
    assert commanded.since_settled_wall_s == pytest.approx(move.arrival_s - 1000.0, abs=1e-6)
    assert (commanded.stamp, commanded.solution) == (named, 0)
    assert isinstance(settled, SolutionSettled)
    assert (settled.stamp, settled.solution) == (named, 0)
    motion, still = settled.motion_s, settled.settle_s
    assert motion + still == pytest.approx(r.wall - move.arrival_s, abs=0.03)
    assert 0.3 <= still < 0.35
    # From there on the time is counted until the next command.
    settled_at = r.wall
    r.answer(named, 0)
    named = r.settle(HOME)
    commanded = r.named(SolutionCommanded)[1]
    since_s = r.commands[-1].arrival_s - settled_at
    assert commanded.since_settled_wall_s == pytest.approx(since_s, abs=1e-6)
    assert commanded.stamp == named
    assert before < settled_at


def test_what_cannot_be_reached_is_named_and_the_next_one_is_commanded(rig):
    r = rig()
    outside = HOME.copy()
    outside[1] = CHAIN.upper[1] + np.deg2rad(0.1)
    named = r.settle(outside, TARGET)
    (failed,) = r.named(SolutionFailed)
    assert (failed.stamp, failed.solution) == (named, 0)
    assert failed.reason.startswith('joint_2 at ')
    np.testing.assert_allclose(r.moves()[0].q[-1], TARGET, atol=1e-12)
    level, text, values = r.summary()
    assert (level, text) == ('ok', 'moving or measuring')
    counts = [values[key] for key in ('commanded', 'settled', 'failed', 'stopped')]
    assert counts == ['1', '1', '1', '0']


ANSWER = {'kind': 'configuration', 'solution': 0, 'result': 'recorded'}


@pytest.mark.parametrize(
    ('node', 'change'),
    [
        ('recorder', {'stamp': '77.000000000'}),
        ('recorder', {'solution': 1}),
        ('recorder', {'solution': -1}),
        ('recorder', {'solution': '0'}),
        ('recorder', {'solution': None}),
        ('recorder', {'kind': 'reading'}),
        ('recorder', {'result': 'lost'}),
        ('optimizer', {}),
    ],
)
def test_only_the_recorders_answer_for_this_pose_and_solution_counts(rig, node, change):
    r = rig()
    named = r.settle(TARGET, HOME)
    for left_out in ('', 'stamp', 'solution', 'result'):
        body = {'stamp': named, **ANSWER, **change}
        body.pop(left_out, None)
        r.said.publish(String(data=json.dumps({'version': 1, 'node': f'/{node}', 'body': body})))
    r.run(1.0, dt=0.1)
    assert len(r.moves()) == 1, 'it went on'
    r.answer(named, 0)
    r.run(20.0, lambda: len(r.settled) == 2)
    np.testing.assert_allclose(r.settled[1].position, HOME, atol=1e-4)


def test_another_pose_stops_the_arm_and_is_gone_to(rig):
    r = rig()
    named = r.go(AWAY, speed=0.2)
    later = r.plan(HOME)
    assert r.named(ArmStopped) == [ArmStopped(stamp=later, reason='another pose')]
    assert later != named
    assert ('info', 'stopping the arm: another pose') in r.bridge.logged
    assert r.bridge.counts['stopped'] == 1
    r.run(20.0, lambda: r.settled)
    np.testing.assert_allclose(r.settled[0].position, HOME, atol=1e-4)


@pytest.mark.parametrize('names', [None, []])
def test_no_solutions_are_a_stop_whatever_joints_they_name(rig, names):
    r = rig()
    r.go(AWAY, speed=0.2)
    r.plan(names=names)
    assert [stop.reason for stop in r.named(ArmStopped)] == ['stopped']
    r.run(3.0)
    assert r.arm.speed() < 1e-6
    assert r.arm.q[0] < 0.55
    assert not r.settled
    assert r.summary()[:2] == ('ok', 'waiting for a pose')


@pytest.mark.parametrize(
    ('spoil', 'reason'),
    [
        (
            lambda m: m.joint_names.__setitem__(0, 'elbow'),
            f'they are for elbow, {", ".join(CHAIN.joint_names[1:])}, '
            f'the cell has {", ".join(CHAIN.joint_names)}',
        ),
        (
            lambda m: setattr(m.points[1], 'positions', [0.0] * 6),
            'a point has not as many positions as joints, 7',
        ),
        (
            lambda m: setattr(m.points[0], 'positions', [0.0] * 8),
            'a point has not as many positions as joints, 7',
        ),
    ],
)
def test_solutions_that_cannot_be_read_are_dropped(rig, spoil, reason):
    r = rig()
    message = JointTrajectory(joint_names=list(r.names))
    message.header.stamp = stamp(5)
    message.points = [robot_bridge.JointTrajectoryPoint(positions=HOME.tolist()) for _ in 'ab']
    spoil(message)
    r.taken(r.solutions, message, 'solutions')
    assert r.logged() == [('error', f'joint_solutions dropped: {reason}')]
    r.run(0.5)
    assert not r.commands
    assert r.summary()[2]['pose'] == ''


def test_joints_of_other_arms_in_the_solutions_do_no_harm(rig):
    r = rig()
    target = np.array([9.0, *TARGET, -9.0])
    r.settle(target, names=['gripper', *r.names, 'rail'])
    np.testing.assert_allclose(r.moves()[0].q[-1], TARGET, atol=1e-12)


WAY = HOME + np.array([0.2, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0])


def test_waypoints_of_the_pose_are_gone_through(rig):
    r = rig()
    r.settle(TARGET, ways=[(0, [WAY])])
    (move,) = r.moves()
    assert np.min(np.max(np.abs(move.q - WAY), axis=1)) < 1e-12


@pytest.mark.parametrize('options', [{'ways': [(1, [WAY])]}, {'ways_stamp': 99}])
def test_waypoints_of_another_pose_or_solution_are_not(rig, options):
    r = rig()
    r.settle(TARGET, **{'ways': [(0, [WAY])], **options})
    (move,) = r.moves()
    assert np.min(np.max(np.abs(move.q - WAY), axis=1)) > 0.05


def test_waypoints_that_cannot_be_read_drop_the_pose(rig):
    r = rig()
    r.plan(TARGET, ways=[(0, [WAY[:6]])])
    ((level, text),) = r.logged()
    assert level == 'error'
    assert text.startswith('joint_solutions dropped: joint_waypoints: a point ')
    r.run(1.0)
    assert not r.commands


# Paths


def test_a_path_that_is_not_free_is_gone_around(rig, tmp_path):
    cell = write_cell(tmp_path / 'cell.yaml', obstacles={'post': POST})
    r = rig(cell=cell, cartesian_speed_limit_m_s=0.0, home=turned(-0.8))
    target = turned(0.8)
    model = read_cell(cell).collision_model(CHAIN)
    assert 'post' in model.path_trouble(np.array([turned(-0.8), target]))
    r.settle(target)
    (move,) = r.moves()
    q, _, _ = move.spline().sample(30)
    assert not any(model.trouble(row) for row in q)
    np.testing.assert_allclose(r.settled[0].position, target, atol=1e-4)


def test_a_target_that_is_not_free_is_given_up(rig, tmp_path):
    box = {'center_m': CHAIN.forward(LOW)[:3, 3].tolist(), 'size_m': [0.02, 0.02, 0.02]}
    r = rig(cell=write_cell(tmp_path / 'cell.yaml', obstacles={'box': box}))
    r.plan(LOW, HOME + 0.01)
    r.run(20.0, lambda: r.settled)
    (failed,) = r.named(SolutionFailed)
    assert failed.solution == 0
    assert failed.reason.startswith('no free path: ')
    assert 'box' in failed.reason
    assert [commanded.solution for commanded in r.named(SolutionCommanded)] == [1]


def test_a_path_that_cannot_be_checked_is_not_gone(rig, monkeypatch):
    r = rig()
    r.settle(TARGET)

    def fails(request):
        raise ValueError('boom')

    monkeypatch.setattr(r.bridge._search, 'find', fails)
    r.plan(HOME)
    r.run(1.0)
    (failed,) = r.named(SolutionFailed)
    assert failed.reason == 'no free path: it could not be checked (boom)'
    assert ('error', "the path could not be checked: ValueError('boom')") in r.bridge.logged
    assert len(r.moves()) == 1


def test_an_arm_in_a_margin_is_halted_and_leaves_slowly_when_a_person_says_so(rig, tmp_path):
    box = {'center_m': (TOOL - [0.0, 0.0, 0.3]).tolist(), 'size_m': [0.2, 0.2, 0.1]}
    r = rig(cell=write_cell(tmp_path / 'cell.yaml', obstacles={'box': box}))
    r.run(1.0)
    assert r.halted().startswith('the arm stands where it must not: ')
    assert not r.commands
    assert r.call_clear().success
    r.run(0.5)
    assert not r.commands
    r.say_planner('paused')
    r.run(0.5)
    r.say_planner('running')
    r.run(30.0, lambda: r.commands)
    _, v, _ = r.commands[0].spline().sample()
    assert np.all(np.abs(v) <= 0.1 * CHAIN.velocity_limits * 1.001)
    # It is no solution of a pose: no event names it.
    assert not r.named(SolutionCommanded)
    assert r.bridge.counts['commanded'] == 0


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
        'joints_age_s': '0.1',
        'joints_trouble': '',
        'moves_refused': '0',
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


def test_a_planner_that_pauses_stops_the_arm(rig):
    r = rig()
    r.go(AWAY, speed=0.2)
    r.say_planner('paused')
    r.run(1.5)
    assert [stop.reason for stop in r.named(ArmStopped)] == ['planner is paused']
    assert r.arm.speed() < 1e-6
    r.say_planner('running')
    r.run(20.0, lambda: r.settled)
    np.testing.assert_allclose(r.settled[0].position, AWAY, atol=1e-4)


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


@pytest.mark.parametrize(
    'reliability', [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT]
)
def test_joint_states_of_either_reliability_are_heard(rig, reliability):
    r = rig(ready=False)
    first = r.states
    qos = QoSProfile(depth=200, reliability=reliability)
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
    r.wait(r.bridge._controller.get_subscription_count, 'the controller')
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
    r.wait(lambda: not r.bridge._controller.get_subscription_count(), 'the end of the match')
    sent = r.bridge.published
    r.bridge._watch()
    assert r.halted() == 'no controller listens to /joint_trajectory_controller/joint_trajectory'
    # Whether anybody hears it or not.
    assert r.bridge.published == sent + 1


@pytest.mark.parametrize(
    'name',
    ['recorder', 'laser_tracker_markers', 'laser_tracker_markers_left', 'robot_bridge'],
)
def test_a_recorder_that_listens_is_no_controller(rig, name):
    """Nodes of ours listen to the commands, too: no arm moves by it."""
    r = rig(ready=False, controller=False)
    node = robot_bridge.RemasterNode.__mro__[1](name, context=r.context)
    node.create_subscription(JointTrajectory, robot_bridge.COMMANDS, print, 10)
    r.alone()
    r.wait(r.bridge._controller.get_subscription_count, 'the match')
    r.plan(TARGET)
    r.run(1.5)
    assert r.summary()[1].startswith('no controller listens to ')
    assert not r.bridge.published
    node.destroy_node()


@pytest.mark.parametrize(
    'reliability', [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT]
)
def test_controllers_of_either_reliability_hear_it(rig, reliability):
    r = rig(ready=False, controller=False)
    r.open_controller(reliability=reliability, durability=DurabilityPolicy.VOLATILE)
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
