# SPDX-License-Identifier: Apache-2.0
"""Stops, late and lost messages, pauses of this process, clocks that differ or run fast."""

import re

import numpy as np
import pytest
from supervisor_rig import LIMITS, RULES, SPEED, Rig, begun

from remaster_ros.motion.actions import Drive, Failed, Halted, Stop, SupervisorRules
from remaster_ros.motion.joint_reports import JointReport


def check_last_command(rig, line):
    """The controller begins the stop where the arm is; judged along the line of its move."""
    *_, (point,) = rig.commands[-1]
    cubic = list(rig.cubics())[-1]
    t = np.linspace(0.0, cubic.duration_s, 101)
    way = line.way / np.sqrt(line.way @ line.way)
    cruise = line.rate * np.sqrt(line.way @ line.way)
    places = (cubic.at(t) - line.start) @ way
    speeds = cubic.velocity(t) @ way
    assert np.max(cubic.largest_acceleration() / LIMITS.acceleration) <= 1.0
    assert np.max(cubic.largest_speed() / SPEED) <= 1.001
    # A servo overshoots by a few thousandths of the way, and so does its speed.
    assert max(line.project(place)[1] for place in cubic.at(t)) < 4e-3
    assert line.project(point.q)[1] < 1e-9
    return speeds.min() / cruise, places.max() - np.sqrt(line.way @ line.way)


def test_a_stop_at_random_moments_of_random_moves():
    """From where the arm really is: it lags, and a stop does not send it back."""
    rng = np.random.default_rng(11)
    stops = moving = 0
    for _ in range(40):
        rig = begun()
        rig.plan(rng.uniform(LIMITS.lower, LIMITS.upper))
        move = rig.last(Drive).admitted.trajectory
        rig.run(rng.uniform(0.0, move.duration_s))
        before = rig.speed()
        rig.pause()
        if rig.said(Stop):
            stops += 1
            remaining = move.duration_s - (rig.t - rig.commands[0][0])
            back, beyond = check_last_command(rig, move.lines[0])
            assert back >= (-1e-3 if remaining > 0.85 else -0.26)
            assert beyond <= 1e-3
        moving += before > 0.2
        rig.run(1.6)
        assert rig.speed() < 1e-2
        assert not rig.said(Halted)
    assert stops > 33
    assert moving > 13


@pytest.mark.parametrize('delay', [0.05, 0.1, 0.15, 0.2, 0.24])
def test_a_stop_by_reports_that_are_late_since_a_moment(delay):
    """So late they are believed; where the arm is now they do not tell, and that counts."""
    rng = np.random.default_rng(12)
    for _ in range(6):
        rig = begun()
        rig.plan([0.9, -1.9])
        line = rig.last(Drive).admitted.trajectory.lines[0]
        rig.run(rng.uniform(0.1, 1.2))
        rig.delay_s = delay
        rig.run(delay + rng.uniform(0.1, 0.5))
        rig.pause()
        assert rig.said(Stop)
        back, beyond = check_last_command(rig, line)
        assert back >= -1e-3
        assert beyond <= 1e-3


def test_a_stop_on_a_path_of_several_lines():
    rng = np.random.default_rng(13)
    corners = np.array([[0.5, 1.0], [-0.5, 1.0], [-0.5, -1.0]])
    stops = 0
    for _ in range(20):
        rig = begun()
        rig.plan([0.5, -1.0], waypoints={0: corners})
        move = rig.last(Drive).admitted.trajectory
        assert len(move.lines) == 4
        sent = rig.t
        rig.run(rng.uniform(0.0, move.duration_s))
        rig.pause()
        if not rig.said(Stop):
            continue
        stops += 1
        index, since_s = move.line_at(rig.t - sent + 0.02)
        line = move.lines[index]
        remaining = line.duration_s - since_s
        back, beyond = check_last_command(rig, line)
        assert back >= (-1e-3 if remaining > 0.85 or since_s < 0.4 else -0.26)
        assert beyond <= 1e-3
        rig.run(1.6)
        assert rig.speed() < 1e-2
        assert not rig.said(Halted), rig.supervisor.halted
    assert stops > 16


# Messages


@pytest.mark.parametrize('what', ['doubled', 'reordered', 'lost', 'late', 'slow'])
def test_messages_that_are_doubled_reordered_lost_or_late(what):
    """Some of them, all along: counted, and without any consequence."""
    rig = begun()
    rng = np.random.default_rng(14)
    honest = rig.supervisor.report
    kept = []

    def deliver(report):
        actions = []
        if what == 'lost' and rng.random() < 0.3:
            return []
        if what == 'slow' and rng.random() < 0.8:
            return []
        if what == 'reordered' and rng.random() < 0.2 and not kept:
            kept.append(report)
            return []
        if what == 'late' and rng.random() < 0.2:
            report = type(report)(report.stamp_s - 0.015, report.q, report.clock_s, report.wall_s)
        actions = honest(report)
        if what == 'doubled':
            actions = actions + honest(report)
        if kept:
            old = kept.pop()
            again = type(old)(old.stamp_s, old.q, report.clock_s, report.wall_s)
            actions = actions + honest(again)
        return actions

    rig.supervisor.report = deliver
    rig.visit([0.9, -1.9], [-0.5, 1.0])
    rig.answer(0)
    rig.settles(2)
    assert not rig.said(Stop, Failed, Halted), rig.supervisor.halted
    assert (rig.supervisor.reports.refused['stamp'] > 10) == (what in ('doubled', 'reordered'))


# Clocks


@pytest.mark.parametrize('offset', [-3600.0, -0.7, 0.7, 1e9])
def test_a_constant_difference_of_the_clocks_does_not_disturb(offset):
    rig = Rig(begun=False)
    rig.stamp_shift = offset
    rig.visit([0.9, -1.9], [-0.5, 1.0])
    rig.answer(0)
    rig.run(1.0)
    rig.pause()
    assert rig.said(Stop)
    rig.state = 'running'
    rig.settles(2)
    assert not rig.said(Failed, Halted)


@pytest.mark.parametrize('rate', [10.0, 20.0])
def test_a_fast_simulated_clock(rate):
    """Nobody is silent, nothing late; a stop keeps to the line; the reaction is wall time."""
    rig = Rig(begun=False, rate=rate)
    rig.run(20.0)
    rig.visit([0.9, -1.9], [-0.5, 1.0])
    rig.answer(0)
    line = rig.last(Drive).admitted.trajectory.lines[0]
    rig.run(1.0)
    rig.pause()
    assert rig.said(Stop)
    _, beyond = check_last_command(rig, line)
    assert beyond <= 1e-3
    rig.state = 'running'
    rig.settles(2)
    assert not rig.said(Failed, Halted), rig.supervisor.halted
    assert not rig.supervisor.reports.refused


def test_a_heartbeat_is_wall_time():
    rig = Rig(rate=20.0)
    rig.alive.discard('planner')
    rig.run(0.8 * RULES.heartbeat_s * 20.0)
    assert rig.supervisor.blocked(rig.wall) == ''
    rig.run(0.3 * RULES.heartbeat_s * 20.0)
    assert rig.supervisor.blocked(rig.wall) == 'no sign of planner for 3 s'


def test_with_a_fast_clock_a_command_has_its_time_to_be_seen():
    rig = Rig(SupervisorRules(settle=RULES.settle, arrive_timeout_s=50.0), rate=20.0)
    rig.run(20.0)
    rig.obey = lambda waypoints: ()
    rig.plan([0.5, 0.5])
    rig.run(0.9 * 20.0 * (RULES.reaction_s + 0.3))
    assert not rig.said(Halted)
    rig.run(0.3 * 20.0, lambda: rig.said(Halted))
    assert 'does not take commands' in rig.last(Halted).reason


def test_how_long_an_arm_may_be_unobserved_is_wall_time_too():
    """One second of it, and ten of the clock's: shorter than a heartbeat."""
    rig = Rig(rate=10.0)
    rig.visit([0.3, 0.1])
    rig.alive.discard('robot')
    rig.run(10.0)
    rig.alive.add('robot')
    rig.under_way.clear()
    rig.run(5.0)
    assert not rig.said(Halted)
    assert rig.supervisor.busy


# Pauses of this process


def paused_for(rig, seconds):
    """The process stands still; the world goes on, and its messages wait."""
    rig.alive.discard('bridge')
    rig.run(seconds)
    rig.alive.add('bridge')


@pytest.mark.parametrize('seconds', [0.6, 1.0, 2.0])
def test_a_pause_of_this_process_is_nobodys_silence(rig, seconds):
    rig.plan([0.9, -1.9], [-0.9, 1.9])
    rig.run(0.5)
    paused_for(rig, seconds)
    rig.settles()
    assert not rig.said(Stop, Failed, Halted), rig.supervisor.halted


@pytest.mark.parametrize('where', ['moving', 'settled'])
def test_after_a_pause_longer_than_a_heartbeat_nobody_has_seen_the_arm(rig, where):
    rig.plan([0.9, -1.9], [-0.9, 1.9])
    if where == 'settled':
        rig.settles()
    else:
        rig.run(0.5)
    paused_for(rig, 4.0)
    assert rig.halts(1.0) == 'the robot was not observed for 3.8 s'
    assert not rig.said(Stop)


def test_a_gap_is_given_in_wall_time_where_the_clock_of_the_robot_runs_faster():
    rig = Rig(rate=2.0)
    rig.run(4.0)
    rig.plan([0.9, -1.9], [-0.9, 1.9])
    rig.run(1.0)
    paused_for(rig, 8.0)
    rig.halts(2.0)
    found = re.fullmatch(r'the robot was not observed for (\d\.\d) s', rig.last(Halted).reason)
    assert found is not None
    assert 3.5 < float(found[1]) < 4.2


@pytest.mark.parametrize('first', ['planner', 'recorder', 'robot'])
def test_who_is_heard_first_after_a_pause_is_not_heard_in_the_future(rig, first):
    """Its silence afterwards is noticed after a heartbeat, and not after that and the pause."""
    rig.state = 'paused'
    rig.run(1.0)
    arm, wall = rig.supervisor, rig.wall + 60.0
    if first == 'planner':
        arm.planner_is('paused', wall)
    elif first == 'recorder':
        arm.recorder_waits('', wall)
    else:
        arm.report(JointReport(rig.t + 60.0, rig.arm.at(rig.t)[0], rig.t + 60.0, wall))
    later = wall
    while later < wall + RULES.heartbeat_s + 0.3:
        later += 0.1
        arm.tick(later)
    silent = arm.blocked(later)
    assert silent.startswith('no sign of ')
    assert first in silent


def test_a_pause_shorter_than_half_a_second_is_none(rig):
    arm = rig.supervisor
    rig.state = 'paused'
    rig.run(1.0)
    heard = arm.report_age_s(rig.wall)
    arm.tick(rig.wall + 0.5)
    assert arm.report_age_s(rig.wall + 0.5) == pytest.approx(heard + 0.5)
    arm.tick(rig.wall + 1.25)
    assert arm.report_age_s(rig.wall + 1.25) == pytest.approx(heard + 0.5)
