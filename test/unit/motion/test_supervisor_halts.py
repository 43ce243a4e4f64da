"""What halts an arm, in which words, that nothing is commanded then, and what lets it go on."""

import dataclasses

import numpy as np
import pytest
from supervisor_rig import HOME, LIMITS, RULES, Rig

from remaster_ros.motion.actions import (
    CheckPath,
    Drive,
    Failed,
    Halted,
    PathAnswer,
    Settled,
    Stop,
    SupervisorRules,
)
from remaster_ros.motion.move_queue import PROBE, WAY_OUT
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.trajectory import Line
from remaster_ros.simulation import arm_motion as servo

STOPPED = 'the robot stopped on its way: an emergency or protective stop?'
NOT_TAKEN = 'the robot does not take commands: see its controller, and its driver'


@pytest.fixture
def rig():
    return Rig()


def halted(rig, reason, within_s=5.0):
    """Wait for the halt; nothing is commanded with it or after it, whatever happens."""
    commands = len(rig.commands)
    rig.run(within_s, lambda: rig.said(Halted))
    assert rig.last(Halted).reason == rig.supervisor.halted == reason
    assert rig.supervisor.blocked(rig.wall) == reason
    stays_halted(rig, reason)
    assert len(rig.commands) == commands
    assert not rig.supervisor.busy


def stays_halted(rig, reason):
    """Neither plans nor a planner that pauses and runs again end a halt."""
    commands = len(rig.commands)
    rig.plan([0.2, 0.1], [0.3, 0.1])
    rig.state = 'paused'
    rig.run(2.0)
    rig.state = 'running'
    rig.run(2.0)
    rig.answer(0)
    assert rig.supervisor.halted == reason
    assert len(rig.said(Halted)) == 1
    assert len(rig.commands) == commands


def goes_on(rig):
    """Only a person's word and a collection that is begun again let it go on, by a probe."""
    commands = len(rig.commands)
    assert rig.supervisor.clear_halt() == ''
    assert rig.supervisor.halted == ''
    reason = 'the halt was cleared: /remaster/collect goes on'
    assert rig.supervisor.blocked(rig.wall) == reason
    rig.run(3.0)
    assert rig.supervisor.blocked(rig.wall) == reason
    assert len(rig.commands) == commands
    rig.state = 'paused'
    rig.run(1.0)
    assert rig.supervisor.blocked(rig.wall) == 'planner is paused'
    rig.state = 'running'
    rig.plan([0.2, 0.1])
    drives = len(rig.said(Drive))
    rig.run(30.0, lambda: rig.said(Drive)[drives:] and rig.said(Settled))
    assert rig.said(Drive)[drives].solution == PROBE
    rig.run(30.0, lambda: rig.supervisor.busy and not rig.supervisor._motion.is_moving)
    np.testing.assert_allclose(rig.last(Settled).q, [0.2, 0.1], atol=1e-4)


# Emergency stops


def test_a_robot_that_stops_on_its_way(rig):
    """An emergency stop: released, the arm must not go on by itself."""
    rig.go([0.9, -1.9], 1.0)
    # The safety circuit stops it where it is.
    rig.arm = servo.Motion(rig.t, rig.arm.at(rig.t)[0])
    pressed = rig.t
    halted(rig, STOPPED)
    (when,) = (t for t, action in rig.actions if isinstance(action, Halted))
    assert when - pressed < 1.0
    assert not rig.said(Stop, Failed)
    rig.actions = [a for a in rig.actions if not isinstance(a[1], Settled)]
    goes_on(rig)


@pytest.mark.parametrize('when', [0.3, 0.8, 1.6, 2.0])
@pytest.mark.parametrize('stop', ['paused', 'plan'])
def test_a_stop_after_an_emergency_stop_commands_nothing(rig, when, stop):
    """The arm stands somewhere on its path; where a stop would lead it is not."""
    rig.plan([0.9, -1.9])
    rig.run(when)
    rig.arm = servo.Motion(rig.t, rig.arm.at(rig.t)[0])
    rig.run(0.6)
    commands = len(rig.commands)
    if stop == 'plan':
        rig.plan([0.0, 0.0])
    else:
        rig.state = 'paused'
    rig.run(5.0)
    assert rig.supervisor.halted
    assert len(rig.commands) == commands


def test_the_robots_own_signal_of_an_emergency_stop(rig):
    rig.go([0.9, -1.9])
    rig.do(rig.supervisor.emergency(False, rig.wall))
    assert not rig.said(Halted)
    commands = len(rig.commands)
    rig.do(rig.supervisor.emergency(True, rig.wall))
    reason = 'the robot reports an emergency stop'
    assert rig.last(Halted).reason == reason
    assert not rig.said(Stop), 'where the arm is led by its safety circuit nothing is commanded'
    rig.run(2.0)
    stays_halted(rig, reason)
    # While it lasts nobody clears it.
    assert rig.supervisor.clear_halt() == reason
    assert rig.supervisor.halted == reason
    rig.do(rig.supervisor.emergency(False, rig.wall))
    rig.run(2.0)
    assert rig.supervisor.halted == reason
    assert len(rig.commands) == commands
    goes_on(rig)


@pytest.mark.parametrize('state', ['idle', 'running'])
def test_an_emergency_stop_while_the_arm_stands_halts_too(rig, state):
    """In a measurement, or between two of them, or before the first."""
    rig.plan([0.3, 0.0])
    rig.run(20.0, lambda: rig.said(Settled))
    rig.state = state
    rig.run(1.0)
    rig.do(rig.supervisor.emergency(True, rig.wall))
    rig.do(rig.supervisor.emergency(False, rig.wall))
    assert rig.supervisor.halted == 'the robot reports an emergency stop'
    rig.answer(0)
    stays_halted(rig, 'the robot reports an emergency stop')


def test_what_is_not_halted_is_not_cleared(rig):
    assert rig.supervisor.clear_halt() == 'the arm is not halted'
    rig.run(1.0)
    assert rig.supervisor.blocked(rig.wall) == ''


def test_a_halt_that_was_there_before_this_process_is_kept():
    rig = Rig(begun=False, halted='an emergency stop')
    assert rig.supervisor.halted == 'an emergency stop'
    rig.plan([0.3, 0.0])
    rig.state = 'paused'
    rig.run(1.0)
    rig.state = 'running'
    rig.run(5.0)
    assert not rig.commands
    assert rig.supervisor.blocked(rig.wall) == 'an emergency stop'
    goes_on(rig)


# Silence, and reports that are not believed


@pytest.mark.parametrize('when', ['moving', 'settled', 'waiting'])
def test_a_silent_robot(rig, when):
    rig.plan([0.9, -1.9])
    if when == 'moving':
        rig.run(0.8)
    elif when == 'settled':
        rig.run(20.0, lambda: rig.said(Settled))
    else:
        rig.run(20.0, lambda: rig.said(Settled))
        rig.answer(0)
        rig.run(1.0)
    rig.alive.discard('robot')
    silent = rig.t
    halted(rig, 'no sign of robot for 3 s')
    (when,) = (t for t, action in rig.actions if isinstance(action, Halted))
    assert RULES.heartbeat_s < when - silent < RULES.heartbeat_s + 0.1
    assert not rig.said(Stop)


def test_a_robot_that_is_silent_while_nothing_is_collected_is_waited_for(rig):
    rig.state = 'idle'
    rig.run(1.0)
    rig.alive.discard('robot')
    rig.run(20.0)
    assert not rig.said(Halted)
    assert rig.supervisor.blocked(rig.wall) == 'no sign of robot for 3 s'
    rig.alive.add('robot')
    rig.state = 'running'
    rig.run(1.0)
    rig.plan([0.3, 0.0])
    rig.run(20.0, lambda: rig.said(Settled))


@pytest.mark.parametrize('stop', ['paused', 'plan'])
def test_a_stop_that_comes_while_the_robot_is_silent_commands_nothing(rig, stop):
    rig.go([0.9, -1.9])
    rig.alive.discard('robot')
    rig.run(0.6)
    commands = len(rig.commands)
    rig.state = 'paused'
    if stop == 'plan':
        rig.plan([0.0, 0.0])
        reason = 'another pose'
    else:
        rig.do(rig.supervisor.planner_is('paused', rig.wall))
        reason = 'planner is paused'
    assert rig.supervisor.halted == (
        f'{reason}; the last report of the joints is 0.6 s old: nothing is commanded'
    )
    assert len(rig.commands) == commands


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
    rig.run(20.0, lambda: rig.said(Settled))
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
        rig.run(20.0, lambda: rig.said(Settled))
    if when == 'idle':
        rig.answer(0)
        rig.state = 'idle'
        rig.run(1.0)
    rig.alter = lambda t, q: np.add(q, [2 * np.pi, 0.0])
    commands = len(rig.commands)
    rig.run(2.0, lambda: rig.said(Halted))
    assert 'outside its limits' in rig.last(Halted).reason
    stays_halted(rig, rig.last(Halted).reason)
    assert len(rig.commands) == commands


def test_a_jump_faster_than_any_arm_halts_though_nothing_is_collected(rig):
    rig.plan([-0.9, 0.2])
    rig.run(30.0, lambda: rig.said(Settled))
    rig.answer(0)
    rig.state = 'idle'
    rig.run(1.0)
    rig.alter = lambda t, q: np.add(q, [1.8, 0.0])
    rig.run(0.7, lambda: rig.said(Halted))
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
    rig.state = 'idle'
    rig.run(1.0)
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
    rig.state = 'idle'
    rig.run(1.0)
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
    rig.plan([0.3, 0.0])
    rig.run(20.0, lambda: rig.said(Settled))


def test_a_frozen_driver_is_an_arm_that_stopped(rig):
    """It sends the same position for ever with new stamps."""
    rig.go([0.9, -1.9], 1.0)
    here = rig.arm.at(rig.t)[0]
    rig.alter = lambda t, q: here
    halted(rig, STOPPED)


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
    rig.run(3.0, lambda: rig.said(Halted))
    assert reason in rig.last(Halted).reason
    assert not rig.said(Stop)
    # Seen to by a person, the new time is learned while the arm stands.
    rig.collect()
    rig.run(30.0, lambda: rig.said(Settled))
    assert rig.last(Settled).settle_s >= 1.0
    np.testing.assert_allclose(rig.last(Settled).q, [0.9, -1.9], atol=1e-4)


def test_while_nothing_is_collected_a_clock_may_be_set(rig):
    rig.state = 'idle'
    rig.run(1.0)
    rig.stamp_shift = -3600.0
    rig.run(3.0)
    assert not rig.said(Halted)
    rig.state = 'running'
    rig.run(1.0)
    rig.plan([0.3, 0.0])
    rig.run(20.0, lambda: rig.said(Settled))


def test_a_recorder_that_answers_nothing_is_no_failure_of_the_arm(rig):
    """The arm was there each time: it is not halted, however often that happens in a row."""
    rig.plan([0.3, 0.0], [0.2, 0.1], [0.1, 0.2], [0.0, 0.3])
    rig.run(150.0, lambda: len(rig.said(Failed)) == 4)
    assert len(rig.said(Settled)) == 4 > RULES.failures_in_a_row
    assert not rig.said(Halted)


def test_a_recorder_that_answers_nothing_does_not_count_with_failures_of_the_arm(rig):
    rig.alter = restless(rig, (1, 2))
    rig.plan([0.3, 0.0], [0.2, 0.1], [0.1, 0.2], [0.0, 0.3])
    rig.run(150.0, lambda: len(rig.said(Settled)) == 2)
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
    rig.plan([0.3, 0.0])
    rig.run(20.0, lambda: rig.said(Settled))


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


def test_a_pause_while_the_arm_settles_commands_nothing(rig):
    """Its move is over: there is nothing to be stopped, and it is commanded again afterwards."""
    rig.plan([0.3, 0.0])
    rig.run(10.0, lambda: rig.said(Drive) and rig.t > rig.commands[0][0] + 2.0)
    rig.run(5.0, lambda: rig.speed() < 1e-5)
    assert not rig.said(Settled)
    before = len(rig.commands)
    rig.do(rig.supervisor.planner_is('paused', rig.wall))
    rig.state = 'paused'
    rig.run(1.5)
    assert not rig.said(Stop)
    assert not rig.said(Halted)
    assert not rig.said(Settled)
    assert len(rig.commands) == before
    rig.state = 'running'
    rig.run(20.0, lambda: rig.said(Settled))


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
    rig.run(3.0, lambda: rig.said(Halted))
    assert rig.last(Halted).reason == 'joint_states come 0.44 s late'
    assert len(rig.commands) == before
    rig.delay_s = 0.0
    rig.collect()
    rig.run(30.0, lambda: rig.said(Settled))


def test_reports_that_come_much_too_late_from_a_moment_on(rig):
    rig.go([0.9, -1.9])
    rig.delay_s = 1.0
    late = rig.t
    rig.run(5.0, lambda: rig.said(Halted))
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
    rig.run(20.0, lambda: rig.said(Halted))
    assert rig.last(Halted).reason == NOT_TAKEN or 'come late?' in rig.last(Halted).reason
    assert not rig.said(Settled)
    assert [d.solution for d in rig.said(Drive)] == [PROBE, 0]


# Commands that are not obeyed


def test_a_robot_that_takes_no_command(rig):
    rig.obey = lambda waypoints: ()
    rig.plan([0.5, 0.5])
    halted(rig, NOT_TAKEN, 20.0)
    assert len(rig.said(Drive)) == 1
    rig.obey = lambda waypoints: waypoints
    goes_on(rig)


def test_a_robot_that_is_slower_than_it_was_told(rig):
    rig.obey = lambda waypoints: [
        dataclasses.replace(p, time_s=2 * p.time_s, velocity=p.velocity / 2) for p in waypoints
    ]
    rig.plan([0.9, -1.0])
    rig.run(20.0, lambda: rig.said(Halted))
    reason = rig.last(Halted).reason
    assert reason.startswith('the robot does not follow its path: 0.')
    assert reason.endswith(
        's behind it; is its speed override below 100 %, or do joint_states come late?'
    )
    assert not rig.said(Stop)


@pytest.mark.parametrize('lag', [0.05, 0.15, 0.25])
def test_a_robot_that_lags_is_waited_for(rig, lag):
    """The command comes later to the robot than it was sent."""
    rig.obey = lambda waypoints: [
        dataclasses.replace(
            waypoints[0], time_s=lag, q=rig.arm.at(rig.t)[0], velocity=np.zeros(2)
        ),
        *(dataclasses.replace(p, time_s=lag + p.time_s) for p in waypoints),
    ]
    rig.plan([0.9, -1.0], [-0.9, 1.0])
    rig.run(20.0, lambda: rig.said(Settled))
    rig.answer(0)
    rig.run(20.0, lambda: len(rig.said(Settled)) == 2)
    assert not rig.said(Stop, Failed, Halted)


def test_a_robot_that_leaves_its_path(rig):
    rig.obey = lambda waypoints: [
        dataclasses.replace(p, q=np.add(p.q, [0.0, 0.2 * (i == 0)]))
        for i, p in enumerate(waypoints)
    ]
    rig.plan([0.9, -0.5])
    rig.run(20.0, lambda: rig.said(Halted))
    assert rig.last(Halted).reason.startswith('the robot does not follow its path: ')
    assert rig.last(Halted).reason.endswith(' deg beside it')
    assert not rig.said(Stop)


def test_a_stop_that_is_not_obeyed(rig):
    """The controller goes on along the old trajectory."""
    rig.go([0.9, -1.9])
    rig.obey = lambda waypoints: ()
    rig.state = 'paused'
    rig.run(5.0, lambda: rig.said(Halted))
    assert len(rig.said(Stop)) == 1
    assert rig.last(Halted).reason in (
        'the arm goes on after a stop',
        'the arm stands, but not where its stop led',
    )
    stays_halted(rig, rig.last(Halted).reason)


def test_an_arm_that_never_stands_after_a_stop(rig):
    rig.go([0.9, -1.9])
    rig.state = 'paused'
    rig.run(0.5)
    rig.alter = lambda t, q: np.add(q, [0.01 * np.sin(8 * t), 0.0])
    rig.run(5.0, lambda: rig.said(Halted))
    assert rig.last(Halted).reason == 'the arm goes on after a stop'
    assert len(rig.said(Stop)) == 1


def test_an_arm_that_is_moved_by_somebody_else_while_it_is_measured(rig):
    rig.plan([0.3, 0.0])
    rig.run(20.0, lambda: rig.said(Settled))
    begun = rig.t
    rig.alter = lambda t, q: np.add(q, [min(0.05 * (t - begun), 0.1), 0.0])
    rig.run(5.0, lambda: rig.said(Halted))
    assert rig.last(Halted).reason == 'the arm was moved by 1.2 deg, and not by a command'
    assert not rig.said(Stop)


def test_an_arm_that_is_touched_while_it_is_measured_is_not_halted(rig):
    rig.plan([0.3, 0.0])
    rig.run(20.0, lambda: rig.said(Settled))
    rig.alter = lambda t, q: np.add(q, [0.015, 0.0])
    rig.run(5.0)
    assert not rig.said(Halted)


@pytest.mark.parametrize('beside', [[0.0025, 0.0], [0.0, -0.018]])
def test_an_arm_that_stands_beside_its_target_is_halted(rig, beside):
    """An emergency stop in the last moment of a move looks like this."""
    sent = rig.t
    rig.alter = lambda t, q: q + np.array(beside) * np.clip((t - sent) / 2, 0, 1)
    rig.plan([0.5, 0.5], [0.2, 0.2])
    rig.run(20.0, lambda: rig.said(Halted))
    off = f'{np.max(np.abs(beside)):.4f} rad from its target'
    assert rig.last(Halted).reason.startswith(f'the robot stands {off}')
    assert not rig.said(Stop, Failed, Settled)
    assert len(rig.said(Drive)) == 1


def restless(rig, which=range(99)):
    """Report the arm trembling by a milliradian where it is sent to one of these."""

    def alter(t, q):
        last = rig.said(Drive)
        busy = rig.supervisor.busy and last and last[-1].solution in which
        return np.add(q, [1e-3 * np.sin(20 * t) * bool(busy), 0.0])

    return alter


def test_three_failures_in_a_row_halt_and_the_third_is_not_lost(rig):
    rig.alter = restless(rig)
    rig.plan([0.5, 0.5], [0.2, 0.2], [0.4, 0.4], [0.1, 0.1])
    rig.run(60.0, lambda: rig.said(Halted))
    assert [f.solution for f in rig.said(Failed)] == [0, 1]
    reason = '3 configurations not reached: did not come to rest at its target in time'
    assert rig.last(Halted).reason == reason
    rig.alter = lambda t, q: q
    rig.run(1.0)
    rig.collect()
    for solution in (2, 3):
        rig.run(30.0, lambda s=solution: rig.said(Settled) and rig.last(Settled).solution == s)
        rig.answer(solution)
    assert len(rig.said(Halted)) == 1


@pytest.mark.parametrize('pauses', [True, False])
def test_failures_are_counted_anew_in_another_run(rig, pauses):
    rig.alter = restless(rig)
    rig.plan([0.5, 0.5], [0.2, 0.2], [0.4, 0.4], [0.1, 0.1], [0.3, 0.3])
    rig.run(60.0, lambda: len(rig.said(Failed)) == 2)
    if pauses:
        rig.do(rig.supervisor.planner_is('paused', rig.wall))
    rig.told_state = ''
    rig.run(60.0, lambda: len(rig.said(Failed)) == 4)
    assert not rig.said(Halted)
    rig.run(60.0, lambda: rig.said(Halted))


@pytest.mark.parametrize('bad', [[9.0, 9.0], [np.nan, 0.0]])
def test_a_planner_whose_configurations_are_all_refused_is_not_followed_to_its_end(rig, bad):
    """A collection of which nothing is commanded would be complete in seconds."""
    rig.plan(*[bad] * 11, [0.3, 0.1], *[bad] * 13)
    rig.run(20.0, lambda: rig.said(Settled))
    assert [f.solution for f in rig.said(Failed)] == list(range(11))
    rig.answer(11)
    rig.run(1.0, lambda: rig.said(Halted))
    assert rig.supervisor.halted.startswith('12 configurations refused in a row: a at ')
    assert [f.solution for f in rig.said(Failed)][11:] == list(range(12, 24))
    # The one that is left is not refused before a person has looked.
    rig.run(1.0)
    assert len(rig.said(Failed)) == 23


def test_ways_that_are_not_free_count_among_the_refused(rig):
    rig.answer_path = lambda request: PathAnswer(None, 'the table')
    rig.plan(*([0.01 * i, 0.3] for i in range(20)))
    rig.run(5.0, lambda: rig.said(Halted))
    reason = '12 configurations refused in a row: no free path: the table'
    assert rig.supervisor.halted == reason
    assert len(rig.said(Failed)) == 12


def test_a_collection_that_is_begun_again_counts_refusals_anew(rig):
    rig.plan(*[[9.0, 9.0]] * 11)
    rig.run(1.0)
    assert len(rig.said(Failed)) == 11
    rig.state = 'paused'
    rig.run(1.0)
    rig.state = 'running'
    rig.plan(*[[9.0, 9.0]] * 11)
    rig.run(1.0)
    assert len(rig.said(Failed)) == 22
    assert not rig.said(Halted)


def test_the_first_configurations_of_all_may_fail_as_often_as_others():
    """A bridge that is started while the planner runs has not heard of a beginning."""
    rig = Rig(begun=False)
    rig.alter = restless(rig)
    rig.plan([0.5, 0.5], [0.2, 0.2], [0.4, 0.4], [0.1, 0.1])
    rig.run(90.0, lambda: rig.said(Halted))
    assert [f.solution for f in rig.said(Failed)] == [0, 1]


def test_a_recorder_that_does_not_answer_is_no_failure_of_the_robot(rig):
    """However often: each configuration was reached."""
    rig.plan(*([0.1 * i, 0.3] for i in range(5)))
    rig.run(150.0, lambda: len(rig.said(Failed)) == 4)
    assert {f.reason for f in rig.said(Failed)} == {'the recorder did not answer in time'}
    assert [f.solution for f in rig.said(Failed)] == [0, 1, 2, 3]
    assert not rig.said(Halted)


def test_a_configuration_that_is_reached_ends_the_row_of_failures(rig):
    rig.alter = restless(rig, {0, 1, 3, 4})
    rig.plan(*([0.1 * i, 0.3] for i in range(6)))
    rig.run(60.0, lambda: rig.said(Settled))
    rig.answer(2)
    rig.run(60.0, lambda: len(rig.said(Settled)) == 2)
    assert [f.solution for f in rig.said(Failed)] == [0, 1, 3, 4]
    assert not rig.said(Halted)


def test_a_planner_that_is_begun_again_ends_the_row_of_failures_too(rig):
    rig.alter = restless(rig)
    rig.plan(*([0.1 * i, 0.3] for i in range(6)))
    rig.run(60.0, lambda: len(rig.said(Failed)) == 2)
    rig.state = 'paused'
    rig.run(1.0)
    rig.state = 'running'
    rig.run(60.0, lambda: len(rig.said(Failed)) == 4)
    assert not rig.said(Halted)


def test_an_arm_that_drifts_never_settles(rig):
    """2 mrad within the tolerance of arrival, at a speed below every velocity threshold."""
    rig.plan([0.5, 0.5])
    rig.alter = lambda t, q: np.add(q, [1e-3 * np.arcsin(np.sin(t)), 0.0])
    sent = rig.t
    rig.run(30.0, lambda: rig.said(Failed))
    assert rig.last(Failed).reason == 'did not come to rest at its target in time'
    expected = Line.within(LIMITS, HOME, np.array([0.5, 0.5])).duration_s
    expected += RULES.settle.settle_s + RULES.arrive_timeout_s
    assert expected - 0.05 < rig.t - sent < expected + 0.1
    assert not rig.said(Settled, Stop)


# What else is observed


@pytest.mark.parametrize('name', ['safety_link', 'controller', 'clock', 'rivals'])
def test_what_was_right_and_is_wrong_halts_a_collection(rig, name):
    """The arm follows its path: it is stopped on it first."""
    rig.do(rig.supervisor.observe(name, '', rig.wall))
    rig.go([0.9, -1.9])
    rig.do(rig.supervisor.observe(name, 'this is wrong', rig.wall))
    assert rig.last(Stop).reason == rig.last(Halted).reason == 'this is wrong'
    rig.run(3.0)
    assert rig.speed() < 1e-3
    assert rig.supervisor.halted == 'this is wrong'
    stays_halted(rig, 'this is wrong')
    # Cleared while it is still wrong, nothing moves.
    commands = len(rig.commands)
    rig.collect()
    rig.run(1.0)
    assert rig.supervisor.blocked(rig.wall) == 'this is wrong'
    rig.run(2.0)
    assert len(rig.commands) == commands
    rig.do(rig.supervisor.observe(name, '', rig.wall))
    rig.run(30.0, lambda: rig.said(Settled))


@pytest.mark.parametrize('name', ['safety_link', 'controller', 'clock'])
def test_what_was_never_right_holds_a_collection(rig, name):
    """They take a while at the start."""
    rig.do(rig.supervisor.observe(name, 'not yet', rig.wall))
    rig.plan([0.3, 0.0])
    rig.do(rig.supervisor.observe(name, 'not yet', rig.wall))
    rig.run(2.0)
    assert not rig.said(Halted, Drive)
    assert rig.supervisor.blocked(rig.wall) == 'not yet'
    rig.do(rig.supervisor.observe(name, '', rig.wall))
    rig.run(20.0, lambda: rig.said(Settled))


def test_a_rival_always_halts_a_collection_and_otherwise_holds_it(rig):
    rig.state = 'idle'
    rig.run(1.0)
    rig.do(rig.supervisor.observe('rivals', 'another publisher', rig.wall))
    assert not rig.said(Halted)
    assert rig.supervisor.blocked(rig.wall) == 'planner is idle'
    rig.state = 'running'
    rig.run(1.0)
    rig.do(rig.supervisor.observe('rivals', 'another publisher', rig.wall))
    assert rig.last(Halted).reason == 'another publisher'
    rig.do(rig.supervisor.observe('rivals', 'another publisher', rig.wall))
    assert len(rig.said(Halted)) == 1


def test_a_rival_while_the_arm_does_not_follow_gets_no_answer(rig):
    rig.go([0.9, -1.9])
    rig.arm = servo.Motion(rig.t, rig.arm.at(rig.t)[0])
    rig.run(0.5)
    rig.do(rig.supervisor.observe('rivals', 'another publisher', rig.wall))
    assert not rig.said(Stop)
    assert rig.last(Halted).reason in ('another publisher', STOPPED)


# Ways out


def in_contact(rig, way_out=True):
    """The arm stands in a margin around its place; a way out leads 0.3 rad away."""

    def answer(request):
        if np.max(np.abs(request.start - HOME)) < 0.1:
            corner = np.add(request.start, [0.1, -0.05])
            points = np.array([request.start, corner, np.add(corner, [0.3, -0.01])])
            path = FreePath(points, way_out=True) if way_out else None
            return PathAnswer(None, 'the tool is in the floor', at_start=True, way_out=path)
        return Rig._free(request)

    rig.answer_path = answer


def test_a_way_out_is_offered_confirmed_and_gone_slowly(rig):
    in_contact(rig)
    rig.plan([0.9, 0.2])
    reason = (
        'the arm stands where it must not: the tool is in the floor; /remaster/clear_halt and '
        '/remaster/collect let it leave slowly (at most 0.05 m/s): a by 17.2 deg, b by 2.9 deg'
    )
    halted(rig, reason)
    rig.plan([0.9, 0.2])
    rig.collect()
    drives = rig.said(Drive)
    assert [d.solution for d in drives] == [WAY_OUT]
    fastest = max(np.max(np.abs(p.velocity)) for p in drives[0].admitted.waypoints)
    assert fastest <= 0.1 * LIMITS.velocity[0]
    rig.run(40.0, lambda: rig.said(Settled))
    # Outside it probes again, and then visits.
    assert [d.solution for d in rig.said(Drive)] == [WAY_OUT, PROBE, 0]
    assert len(rig.said(Halted)) == 1


def test_where_no_way_out_is_found_it_is_said(rig):
    in_contact(rig, way_out=False)
    rig.plan([0.9, 0.2])
    reason = (
        'the arm stands where it must not: the tool is in the floor; no way out is known: move '
        'it by hand, then /remaster/clear_halt'
    )
    halted(rig, reason)
    rig.collect()
    rig.run(1.0)
    assert not rig.said(Drive)
    assert len(rig.said(Halted)) == 2


def test_a_way_out_is_not_gone_twice_or_by_an_arm_that_was_moved(rig):
    in_contact(rig)
    rig.plan([0.9, 0.2])
    rig.run(1.0)
    assert rig.said(Halted)
    # Somebody moves it by hand, within the margin still.
    rig.alter = lambda t, q: np.add(q, [0.0, 0.05])
    rig.run(0.3)
    rig.collect()
    rig.run(2.0)
    assert not rig.said(Drive)
    assert len(rig.said(Halted)) == 2, 'it is asked again, and the person too'
    assert len(rig.said(CheckPath)) >= 2


def test_a_way_out_that_is_not_the_last_word_of_a_halt_is_not_gone(rig):
    """What a person clears is what the halt tells, not what one before it offered."""
    in_contact(rig)
    rig.plan([0.9, 0.2])
    rig.run(1.0)
    reason = rig.supervisor.halted
    rig.alive.discard('robot')
    rig.run(5.0)
    rig.alive.add('robot')
    rig.run(1.0)
    assert rig.supervisor.halted == reason
    assert len(rig.said(Halted)) == 1
    assert rig.supervisor.clear_halt() == ''
    rig.do(rig.supervisor.emergency(True, rig.wall))
    rig.do(rig.supervisor.emergency(False, rig.wall))
    rig.collect()
    rig.run(2.0)
    assert not rig.said(Drive)
    assert rig.supervisor.halted == reason


def test_an_emergency_stop_on_a_way_out_halts(rig):
    in_contact(rig)
    rig.plan([0.9, 0.2])
    rig.run(1.0)
    rig.collect()
    rig.run(2.0)
    assert rig.last(Drive).solution == WAY_OUT
    rig.arm = servo.Motion(rig.t, rig.arm.at(rig.t)[0])
    rig.run(3.0)
    assert rig.last(Halted).reason == STOPPED
    assert len(rig.said(Drive)) == 1


def test_a_way_out_that_the_gate_refuses_halts(rig):
    def answer(request):
        points = np.array([request.start, np.add(request.start, [3.0, 0.0])])
        return PathAnswer(None, 'the floor', at_start=True, way_out=FreePath(points, way_out=True))

    rig.answer_path = answer
    rig.plan([0.9, 0.2])
    rig.run(1.0)
    rig.collect()
    assert rig.last(Halted).reason.startswith('a would go to 1')
    assert not rig.said(Drive)


def test_rules_may_be_others():
    rules = SupervisorRules(settle=RULES.settle, failures_in_a_row=1)
    rig = Rig(rules)
    rig.alter = restless(rig)
    rig.plan([0.5, 0.5])
    rig.run(20.0, lambda: rig.said(Halted))
    assert rig.last(Halted).reason.startswith('1 configurations not reached')
    assert not rig.said(Failed)
