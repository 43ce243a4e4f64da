# SPDX-License-Identifier: Apache-2.0
"""Ends of motions that are neither arrivals nor plain stops; limits that change on the way."""

import dataclasses

import numpy as np
import pytest
from supervisor_rig import LIMITS

from remaster_ros.motion.actions import Drive, Halted, Stop


def test_other_limits_stop_the_arm_and_it_goes_on_with_them(rig):
    rig.go([0.9, -1.9])
    slow = dataclasses.replace(LIMITS, velocity=LIMITS.velocity / 4)
    rig.do(rig.supervisor.use_limits(slow, rig.wall))
    assert rig.last(Stop).reason == 'other limits'
    assert rig.supervisor.gate.limits is slow
    rig.settles()
    first, second = rig.said(Drive)
    assert first.solution == second.solution == 0
    fastest = max(np.max(np.abs(p.velocity) / slow.velocity) for p in second.admitted.waypoints)
    assert fastest <= 1.0
    # An arm that stands is not stopped.
    rig.do(rig.supervisor.use_limits(LIMITS, rig.wall))
    assert len(rig.said(Stop)) == 1


def test_an_arm_that_was_not_seen_for_a_while_has_as_much_longer_to_arrive(rig):
    """A gap of two seconds in the settling adds two seconds to its deadline."""
    rig.alter = lambda t, q: np.add(q, [1e-3 * np.arcsin(np.sin(t)), 0.0])
    rig.plan([0.5, 0.5])
    rig.run(4.0)
    deadline = rig.supervisor._motion.visit.deadline
    rig.alive.discard('robot')
    rig.run(0.4)
    rig.alive.add('robot')
    rig.run(0.2)
    assert rig.supervisor._motion.visit.deadline == deadline, 'a short one adds nothing'
    rig.alive.discard('robot')
    rig.run(2.0)
    rig.alive.add('robot')
    rig.run(0.1)
    assert rig.supervisor._motion.visit.deadline == pytest.approx(deadline + 2.0, abs=0.05)


def test_the_reasons_are_given_in_an_order(rig):
    """Silence first, then the planner, the recorder, the robot, and what is observed."""
    arm = rig.supervisor
    rig.do(arm.observe('controller', 'no controller', rig.wall))
    assert arm.blocked(rig.wall) == 'no controller'
    rig.do(arm.observe('safety_link', 'no link', rig.wall))
    assert arm.blocked(rig.wall) == 'no link'
    rig.do(arm.recorder_waits('mocap', rig.wall))
    assert arm.blocked(rig.wall) == 'waiting for mocap'
    rig.do(arm.planner_is('paused', rig.wall))
    assert arm.blocked(rig.wall) == 'planner is paused'
    assert arm.blocked(rig.wall + 3.5) == 'no sign of planner, recorder, robot for 3 s'


@pytest.mark.parametrize('paused', [True, False])
def test_a_collection_that_is_begun_at_once_after_the_halt_was_cleared_goes_on(rig, paused):
    """By a planner that did not run when it was cleared, or by another run."""

    def planner(state, run):
        rig.do(rig.supervisor.planner_is(state, rig.wall, run))

    rig.alive.discard('planner')
    planner('running', 'first')
    rig.plan([0.9, -1.9])
    rig.run(5.0, lambda: rig.speed() > 0.3)
    rig.freeze()
    rig.halts(2.0)
    rig.run(0.5)
    if paused:
        planner('paused', '')
    rig.clear()
    count = len(rig.said(Drive))
    if not paused:
        planner('running', 'first')
        rig.run(1.0)
        assert len(rig.said(Drive)) == count, 'the run that was halted goes on'
    # Another run: somebody has begun it.
    planner('running', 'second')
    rig.run(1.0)
    assert len(rig.said(Drive)) > count


def test_a_stop_that_was_not_sent_halts_and_nothing_follows(rig):
    """The process was paused between the decision and its publication (1 of 1,000 injections)."""
    rig.go([0.9, -1.9])
    rig.obey = lambda waypoints: ()
    rig.pause()
    stop = rig.last(Stop)
    assert stop.wall_s == rig.wall
    rig.do(rig.supervisor.not_sent(stop, rig.wall + 1.88))
    assert 'paused for 1.88 s just then: nothing is commanded' in rig.supervisor.halted
    count = len(rig.actions)
    rig.run(3.0)
    assert len(rig.actions) == count


def test_a_move_that_was_not_sent_is_asked_for_again(rig):
    rig.obey = lambda waypoints: ()
    rig.plan([0.9, -1.9])
    rig.run(1.0, lambda: rig.said(Drive))
    first = rig.last(Drive)
    assert 0.0 <= rig.wall - first.wall_s <= 0.03
    count = len(rig.actions)
    assert rig.supervisor.not_sent(first, rig.wall + 1.88) == []
    assert not rig.supervisor.busy
    assert not rig.supervisor.halted
    rig.run(1.0, lambda: len(rig.actions) > count)
    assert rig.last(Drive) is not first
    assert rig.last(Drive).solution == first.solution


@pytest.mark.parametrize('delay_s', [0.0, 0.1])
@pytest.mark.parametrize('moved_s', [0.04, 0.1, 0.2])
def test_a_stop_of_an_arm_that_has_hardly_begun_to_move(rig, moved_s, delay_s):
    """The last reports show it where the move began: it is not yet where the stop leads."""
    rig.delay_s = delay_s
    rig.plan([0.9, -1.9])
    rig.run(5.0, lambda: rig.said(Drive))
    rig.run(moved_s)
    rig.pause()
    rig.run(0.1)
    # Whoever wants to go on at once waits until the arm is there.
    rig.state = 'running'
    rig.run(5.0, lambda: len(rig.said(Drive)) == 2)
    (stop,) = rig.said(Stop)
    (end,) = stop.admitted.waypoints
    _, q, velocity, _ = rig.commands[-1]
    np.testing.assert_allclose(q, end.q, atol=1e-4)
    assert np.max(np.abs(velocity)) < 1e-3
    assert not rig.said(Halted)
