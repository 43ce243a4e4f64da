# SPDX-License-Identifier: Apache-2.0
"""The supervisor and reports that are wrong, unreadable, frozen, late or of a clock that jumps."""

import numpy as np
import pytest
from supervisor_rig import LIMITS, NOT_TAKEN, Rig, goes_on, halted, restless, stays_halted

from remaster_ros.motion.actions import Drive, Failed, Halted, Settled, Stop
from remaster_ros.motion.move_queue import PROBE


def test_reports_that_are_not_finite(rig):
    rig.go([0.9, -1.0])
    rig.alter = lambda t, q: q * np.nan
    bad = rig.t
    halted(rig, 'joint_states are not finite')
    (when,) = (t for t, action in rig.actions if isinstance(action, Halted))
    assert 0.5 < when - bad < 0.6
    assert not rig.said(Stop)
    assert rig.supervisor.reports.refused['not_finite'] > 20
    rig.alter = lambda t, q: q
    rig.run(1.0)
    goes_on(rig)


@pytest.mark.parametrize(
    ('alter', 'kind'),
    [
        (lambda t, q: q * np.nan, 'not_finite'),
        (lambda t, q: np.add(q, [2 * np.pi, 0.0]), 'outside_limits'),
        (lambda t, q: np.add(q, [0.0, -2 * np.pi]), 'outside_limits'),
        (lambda t, q: np.add(q, [0.4, 0.4]), 'too_fast'),
    ],
)
def test_one_wrong_report_is_counted_and_disturbs_nothing(rig, alter, kind):
    rig.go([0.5, -1.0])
    rig.alter = alter
    rig.step()
    rig.alter = lambda t, q: q
    rig.settles()
    assert rig.supervisor.reports.refused == {kind: 1}
    assert not rig.said(Stop, Failed, Halted)
    np.testing.assert_allclose(rig.last(Settled).q, [0.5, -1.0], atol=1e-4)


@pytest.mark.parametrize('when', ['moving', 'settled', 'idle'])
def test_a_jump_by_a_whole_turn_for_good(rig, when):
    """Also where nothing is collected: an arm that is elsewhere is no arm that was moved."""
    rig.plan([0.5, -1.9])
    if when == 'moving':
        rig.run(0.8)
    else:
        rig.settles()
    if when == 'idle':
        rig.answer(0)
        rig.collects_nothing()
    rig.alter = lambda t, q: np.add(q, [2 * np.pi, 0.0])
    commands = len(rig.commands)
    rig.halts(2.0)
    assert 'outside its limits' in rig.last(Halted).reason
    stays_halted(rig, rig.last(Halted).reason)
    assert len(rig.commands) == commands


def test_a_jump_faster_than_any_arm_halts_though_nothing_is_collected(rig):
    rig.visit([-0.9, 0.2])
    rig.answer(0)
    rig.collects_nothing()
    rig.alter = lambda t, q: np.add(q, [1.8, 0.0])
    rig.halts(0.7)
    assert 'joint 1 is reported 103.1 deg away after 0.5' in rig.supervisor.halted


def test_an_arm_that_was_never_seen_inside_its_limits_is_waited_for():
    rig = Rig(begun=False)
    rig.state = 'idle'
    rig.alter = lambda t, q: np.add(q, [2 * np.pi, 0.0])
    rig.run(2.0)
    assert not rig.said(Halted)
    assert 'outside its limits' in rig.supervisor.trouble


def test_after_how_long_doubts_halt(rig):
    """At half a second they do not yet."""
    rig.collects_nothing()
    rig.alive.discard('robot')
    wall = np.ceil(rig.wall)
    for passed in (0.0, 0.25, 0.5):
        rig.do(rig.supervisor.doubt('joint_states lacks a', wall + passed))
        assert rig.supervisor.trouble == ''
    rig.do(rig.supervisor.doubt('joint_states lacks a', wall + 0.5 + 2.0**-20))
    assert rig.supervisor.trouble == 'joint_states lacks a'


def test_an_alternating_robot_never_gets_commands_from_the_wrong_place(rig):
    """Two publishers, one of them elsewhere: each is judged by the last that was believed."""
    rig.plan([0.5, -1.0])
    state = {'n': 0}

    def alternate(t, q):
        state['n'] += 1
        return np.add(q, [0.0, 1.5]) if state['n'] % 2 else q

    rig.run(0.5)
    rig.alter = alternate
    rig.run(10.0)
    assert rig.supervisor.reports.refused['too_fast'] > 10
    for cubic in rig.cubics():
        assert np.all(cubic.largest_speed() <= LIMITS.velocity * 1.001)


def test_reports_that_cannot_be_read(rig):
    rig.go([0.9, -1.0])
    rig.alive.discard('robot')
    rig.alter = lambda t, q: q
    for _ in range(20):
        rig.step()
        rig.do(rig.supervisor.doubt('joint_states lacks a', rig.wall))
    assert not rig.said(Halted)
    for _ in range(20):
        rig.step()
        rig.do(rig.supervisor.doubt('joint_states lacks a', rig.wall))
    (stop,) = rig.said(Halted)
    assert stop.reason == rig.supervisor.trouble == 'joint_states lacks a'
    assert not rig.said(Stop)
    # A person has seen to it: nothing is held against the robot before it reports again.
    assert rig.supervisor.clear_halt() == ''
    assert rig.supervisor.trouble == ''


def test_reports_that_cannot_be_read_while_idle_only_hold(rig):
    rig.collects_nothing()
    rig.alive.discard('robot')
    for _ in range(50):
        rig.step()
        rig.do(rig.supervisor.doubt('joint_states lacks a', rig.wall))
    assert not rig.said(Halted)
    assert rig.supervisor.trouble == 'joint_states lacks a'
    rig.state = 'running'
    rig.alive.add('robot')
    rig.run(1.0)
    assert rig.supervisor.trouble == ''
    rig.visit([0.3, 0.0])


def test_stamps_that_stand_still(rig):
    rig.go([0.9, -1.9])
    frozen = rig.t
    rig.run(3.0, lambda: (setattr(rig, 'stamp_shift', frozen - rig.t), rig.said(Halted))[1])
    assert rig.last(Halted).reason == 'the stamps of joint_states do not advance'
    assert not rig.said(Stop)


@pytest.mark.parametrize('jump', [-3600.0, 3600.0, 5.0, -5.0])
@pytest.mark.parametrize('after', [0.9, 3.6])
def test_stamps_that_jump(rig, jump, after):
    """In the middle of a move, and in the middle of the settling: nobody guesses what is true."""
    rig.plan([0.9, -1.9])
    rig.run(after)
    assert not rig.said(Settled)
    rig.stamp_shift = jump
    reason = 'do not advance' if jump < 0 else 's ahead of their time'
    rig.halts(3.0)
    assert reason in rig.last(Halted).reason
    assert not rig.said(Stop)
    # Seen to by a person, the new time is learned while the arm stands.
    rig.collect()
    rig.settles()
    assert rig.last(Settled).settle_s >= 1.0
    np.testing.assert_allclose(rig.last(Settled).q, [0.9, -1.9], atol=1e-4)


def test_while_nothing_is_collected_a_clock_may_be_set(rig):
    rig.collects_nothing()
    rig.stamp_shift = -3600.0
    rig.run(3.0)
    assert not rig.said(Halted)
    rig.state = 'running'
    rig.run(1.0)
    rig.visit([0.3, 0.0])


def test_a_recorder_that_answers_nothing_does_not_count_with_failures_of_the_arm(rig):
    rig.alter = restless(rig, (1, 2))
    rig.plan([0.3, 0.0], [0.2, 0.1], [0.1, 0.2], [0.0, 0.3])
    rig.settles(2)
    assert [f.solution for f in rig.said(Failed)] == [0, 1, 2]
    assert not rig.said(Halted)


def test_before_a_planner_is_there_a_clock_may_be_set():
    rig = Rig(begun=False)
    rig.alive.discard('planner')
    rig.run(2.0)
    rig.stamp_shift = -3600.0
    rig.run(3.0)
    assert rig.supervisor.trouble == ''
    rig.alive.add('planner')
    rig.visit([0.3, 0.0])


def test_a_halt_that_was_cleared_before_the_planner_came_waits_for_a_person():
    """A planner that runs on, under a run that this bridge has not met, begins nothing."""
    rig = Rig(begun=False, halted='an emergency stop')
    rig.alive.discard('planner')
    rig.run(2.0)
    assert rig.supervisor.clear_halt() == ''
    waits = 'the halt was cleared: /remaster/collect goes on'
    # Summaries that were under way come all at once, a pause and what followed it among them.
    for state, run in (('running', 'a'), ('paused', ''), ('running', 'b'), ('running', 'b')):
        rig.do(rig.supervisor.planner_is(state, rig.wall, run))
    assert rig.supervisor.blocked(rig.wall) == waits
    for _ in range(60):
        rig.step()
        rig.do(rig.supervisor.planner_is('running', rig.wall, 'b'))
    assert rig.supervisor.blocked(rig.wall) == waits
    rig.do(rig.supervisor.planner_is('paused', rig.wall))
    rig.do(rig.supervisor.planner_is('running', rig.wall, 'b'))
    assert rig.supervisor.blocked(rig.wall) == waits
    rig.do(rig.supervisor.planner_is('running', rig.wall, 'c'))
    assert rig.supervisor.blocked(rig.wall) == ''


def test_reports_that_come_late_in_a_pause_do_not_become_the_usual_ones(rig):
    rig.go([0.9, -1.9])
    rig.state = 'paused'
    rig.run(3.0)
    (stop,) = rig.said(Stop)
    assert stop.reason == 'planner is paused'
    rig.delay_s = 0.44
    rig.run(5.0)
    assert rig.supervisor.trouble == 'joint_states come 0.44 s late'
    assert not rig.said(Halted)
    # In time again they are believed, and the collection could go on.
    rig.delay_s = 0.0
    rig.run(0.6)
    assert rig.supervisor.trouble == ''
    rig.delay_s = 0.44
    rig.run(2.0)
    before = len(rig.commands)
    rig.state = 'running'
    assert rig.halts(3.0) == 'joint_states come 0.44 s late'
    assert len(rig.commands) == before
    rig.delay_s = 0.0
    rig.collect()
    rig.settles()


def test_reports_that_come_much_too_late_from_a_moment_on(rig):
    rig.go([0.9, -1.9])
    rig.delay_s = 1.0
    late = rig.t
    rig.halts(5.0)
    assert 'joint_states come 1.00 s late' in rig.last(Halted).reason
    assert 1.5 < rig.t - late < 1.6
    assert not rig.said(Stop)
    assert len(rig.commands) == 1


@pytest.mark.parametrize('delay', [0.5, 1.0, 2.0])
def test_reports_that_come_much_too_late_from_the_start(delay):
    """A constant delay and two clocks apart look alike; a move tells them apart."""
    rig = Rig(begun=False)
    rig.delay_s = delay
    rig.plan([0.9, -1.9])
    assert rig.halts(20.0) == NOT_TAKEN or 'come late?' in rig.last(Halted).reason
    assert not rig.said(Settled)
    assert [d.solution for d in rig.said(Drive)] == [PROBE, 0]
