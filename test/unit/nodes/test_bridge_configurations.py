# SPDX-License-Identifier: Apache-2.0
"""Configurations and ways that the robot bridge commands, and what it makes of bad ones."""

import hashlib
import json

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from bridge_places import AWAY, POST, TARGET, TOOL, correction, turned
from bridge_rig import CHAIN, HOME, stamp
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory
from worlds.simple_cells import write_cell

from remaster_ros.collection.events import (
    ArmStopped,
    SolutionCommanded,
    SolutionFailed,
    SolutionSettled,
)
from remaster_ros.compensation.arm_model import Function, JointTerm
from remaster_ros.nodes import robot_bridge
from remaster_ros.session.cells.workcell import read_cell

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]


OFFSETS_DEG = [0.5, -0.7, 0.4, 0.9, -1.2, 0.3, 0.6]

# What it commands


def test_what_is_commanded_is_corrected_before_it_is_checked(rig, tmp_path):
    """Limits are those of the true arm: what is wanted within them may be commanded beyond."""
    file, corrected = correction(tmp_path, OFFSETS_DEG)
    r = rig(compensation=file)
    command = corrected(TARGET)
    assert np.max(np.abs(command - TARGET)) > 0.01
    way = 0.5 * (HOME + TARGET) + 0.02
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    # What becomes of the file is of no effect.
    file.write_text('')
    limit = np.array(TARGET)
    # Wanted beyond what the true arm can; then within it, commanded outside of what is left.
    limit[1] = r.bridge.supervisor.gate.limits.upper[1]
    named = r.plan(limit, TARGET, ways=[(1, [way])])
    r.run(30.0, lambda: r.settled)
    (refused,) = r.named(SolutionFailed)
    assert (refused.stamp, refused.solution) == (named, 0)
    assert 'joint_2 at' in refused.reason
    (move,) = r.moves()
    np.testing.assert_allclose(move.q[-1], command, atol=1e-9)
    # On the way the true joint angles are the planned ones: no tool has to be anywhere.
    q, _, _ = move.spline().sample(200)
    off = np.max(np.abs(q + np.radians(OFFSETS_DEG) - way), axis=1)
    assert off.min() < 2e-3
    (message,) = r.settled
    assert list(message.name) == [*r.names, *(f'wanted/{name}' for name in r.names)]
    np.testing.assert_allclose(message.position[:7], command, atol=1e-4)
    change = np.array(message.position[:7]) - message.position[7:]
    np.testing.assert_allclose(change, command - TARGET, atol=1e-12)
    assert r.bridge.summarised.state.correction == sha256


def asked(rig, prefix):
    return [f'{prefix}{name}' for name in rig.names]


def test_a_pose_has_the_correction_on_or_off_and_a_move_is_stopped_before_it_is_switched(
    rig, tmp_path
):
    file, corrected = correction(tmp_path, OFFSETS_DEG)
    r = rig(compensation=file)
    command = corrected(TARGET)
    r.settle(TARGET, names=asked(r, 'uncorrected/'))
    np.testing.assert_allclose(r.moves()[-1].q[-1], TARGET, atol=1e-12)
    assert list(r.settled[-1].name) == r.names
    r.settle(TARGET, names=asked(r, 'corrected/'))
    np.testing.assert_allclose(r.moves()[-1].q[-1], command, atol=1e-9)
    assert list(r.settled[-1].name) == [*r.names, *(f'wanted/{name}' for name in r.names)]

    r.go(HOME, names=asked(r, 'uncorrected/'))
    before = len(r.moves())
    r.settle(TARGET, names=asked(r, 'corrected/'))
    stop, *_, last = r.moves()[before:]
    assert len(r.named(ArmStopped)) == 1
    # It ends on the way home; what follows begins where the arm stands.
    np.testing.assert_allclose(stop.q[-1], last.start_q, atol=1e-3)
    np.testing.assert_allclose(last.q[-1], command, atol=1e-9)
    assert not r.halted()


@pytest.mark.parametrize(('degrees', 'refused'), [(1.9, True), (-1.9, False)])
def test_with_the_correction_off_the_limits_are_still_those_of_the_true_arm(
    rig, tmp_path, degrees, refused
):
    file, _ = correction(tmp_path, {'joint_2': degrees})
    r = rig(compensation=file, limit_margin_deg=0.0)
    target = HOME.copy()
    target[1] = CHAIN.upper[1] - np.deg2rad(1.0)
    r.plan(target, names=asked(r, 'uncorrected/'))
    r.run(30.0, lambda: r.named(SolutionFailed) or r.moves())
    assert ['joint_2 at' in failed.reason for failed in r.named(SolutionFailed)] == [
        True
    ] * refused
    assert bool(r.moves()) != refused


def test_a_correction_that_a_bridge_does_not_have_is_refused_by_name(rig):
    r = rig()
    r.plan(TARGET, names=asked(r, 'corrected/'))
    r.run(5.0, lambda: r.named(SolutionFailed))
    (failed,) = r.named(SolutionFailed)
    assert 'robot_bridge has none: see its compensation' in failed.reason
    half = [*asked(r, 'corrected/')[:3], *asked(r, 'uncorrected/')[3:]]
    r.plan(TARGET, names=half)
    r.run(2.0)
    assert 'joint_solutions dropped: they are for corrected/joint_1' in r.logged()[-1][1]
    assert not r.moves()
    # Off is what it does anyway.
    r.settle(TARGET, names=asked(r, 'uncorrected/'))
    np.testing.assert_allclose(r.moves()[-1].q[-1], TARGET, atol=1e-12)


def test_a_configuration_that_the_correction_changes_too_much_is_given_up(
    rig, tmp_path, monkeypatch
):
    file, _ = correction(tmp_path, [0.5] * 7)
    r = rig(compensation=file)
    monkeypatch.setattr(r.bridge._correction, '_most_deg', 0.1)
    r.plan(TARGET)
    r.run(2.0, lambda: r.named(SolutionFailed))
    (failed,) = r.named(SolutionFailed)
    assert 'the correction would change joint_' in failed.reason
    assert not r.moves()


def test_a_waypoint_that_the_correction_changes_too_much_is_not_gone_through(
    rig, tmp_path, monkeypatch
):
    """A soft arm, changed more where it is stretched out."""
    soft = Function('gravity_torque', 'linear', 1, 0)
    terms = (JointTerm(1, 'x', soft, np.array([1e-4])),)
    file, corrected = correction(tmp_path, joint_terms=terms)
    r = rig(compensation=file)
    ways = HOME + np.linspace(-0.4, 0.4, 9)[:, None] * np.eye(7)[1]
    change = np.degrees(np.abs(corrected(ways) - ways).max(axis=1))
    at_target = np.degrees(np.abs(corrected(TARGET) - TARGET).max())
    assert change.max() > at_target + 1e-3
    most = 0.5 * (change.max() + at_target)
    monkeypatch.setattr(r.bridge._correction, '_most_deg', most)
    r.plan(TARGET, ways=[(0, [ways[np.argmax(change)]])])
    r.run(2.0, lambda: r.named(SolutionFailed))
    (failed,) = r.named(SolutionFailed)
    assert 'on its way the correction would change joint_' in failed.reason
    assert not r.moves()


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


def test_the_same_pose_never_stops_the_arm(rig):
    """A planner repeats an announcement for a node that lags; the bridge has it already."""
    r = rig()
    r.go(AWAY, speed=0.2)
    for _ in range(5):
        r.pose -= 1
        r.plan(AWAY)
        r.run(0.2)
    assert r.named(ArmStopped) == []
    assert len(r.moves()) == 1
    r.run(20.0, lambda: r.settled)
    r.pose -= 1
    # Also where it stands and is measured.
    named = r.plan(AWAY)
    r.run(5.0)
    assert len(r.settled) == 1
    r.answer(named, 0)
    # The same stamp with other joints is no repetition.
    r.pose -= 1
    r.plan(HOME)
    r.run(20.0, lambda: len(r.settled) == 2)
    np.testing.assert_allclose(r.settled[1].position, HOME, atol=1e-4)


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
