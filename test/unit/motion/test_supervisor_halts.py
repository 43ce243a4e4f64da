# SPDX-License-Identifier: Apache-2.0
"""What halts an arm, in which words, that nothing is commanded then, and what lets it go on."""

import pytest
from supervisor_rig import RULES, STOPPED, Rig, goes_on, halted, stays_halted

from remaster_ros.motion.actions import Failed, Halted, Settled, Stop

# Emergency stops


def test_a_robot_that_stops_on_its_way(rig):
    """An emergency stop: released, the arm must not go on by itself."""
    rig.go([0.9, -1.9], 1.0)
    rig.freeze()
    pressed = rig.t
    halted(rig, STOPPED)
    (when,) = (t for t, action in rig.actions if isinstance(action, Halted))
    assert when - pressed < 1.0
    assert not rig.said(Stop, Failed)
    rig.actions = [a for a in rig.actions if not isinstance(a[1], Settled)]
    goes_on(rig)


@pytest.mark.parametrize(
    ('when', 'later_s', 'stop'),
    [
        *(
            (when, 0.6, stop)
            for when in (0.3, 0.8, 1.6, 2.0)
            for stop in ('planner is paused', '')
        ),
        # Its lag alone would not tell yet; 4 of 45 emergency stops of a campaign ended so.
        *((1.2, later_s, 'planner is paused') for later_s in (0.16, 0.3, 0.42)),
    ],
)
def test_a_stop_after_an_emergency_stop_commands_nothing(rig, when, later_s, stop):
    """The arm stands somewhere on its path; where a stop would lead it is not."""
    rig.plan([0.9, -1.9])
    rig.run(when)
    rig.freeze()
    rig.run(later_s)
    if stop:
        rig.pause()
    else:
        rig.plan([0.0, 0.0])
        stop = 'another pose'
    rig.run(5.0)
    assert rig.supervisor.halted.startswith((f'{stop}; the robot stopped on its way', 'the robot'))
    assert len(rig.commands) == 1


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
    rig.visit([0.3, 0.0])
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
        rig.settles()
    else:
        rig.settles()
        rig.answer(0)
        rig.run(1.0)
    rig.alive.discard('robot')
    silent = rig.t
    halted(rig, 'no sign of robot for 3 s')
    (when,) = (t for t, action in rig.actions if isinstance(action, Halted))
    assert RULES.heartbeat_s < when - silent < RULES.heartbeat_s + 0.1
    assert not rig.said(Stop)


def test_a_robot_that_is_silent_while_nothing_is_collected_is_waited_for(rig):
    rig.collects_nothing()
    rig.alive.discard('robot')
    rig.run(20.0)
    assert not rig.said(Halted)
    assert rig.supervisor.blocked(rig.wall) == 'no sign of robot for 3 s'
    rig.alive.add('robot')
    rig.state = 'running'
    rig.run(1.0)
    rig.visit([0.3, 0.0])


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
