# SPDX-License-Identifier: Apache-2.0
"""The supervisor and failures in a row, and conditions that end or hold a collection."""

import numpy as np
import pytest
from supervisor_rig import HOME, LIMITS, RULES, STOPPED, Rig, restless, stays_halted

from remaster_ros.motion.actions import Drive, Failed, Halted, PathAnswer, Settled, Stop
from remaster_ros.motion.trajectory import Line


def test_three_failures_in_a_row_halt_and_the_third_is_not_lost(rig):
    rig.alter = restless(rig)
    rig.plan([0.5, 0.5], [0.2, 0.2], [0.4, 0.4], [0.1, 0.1])
    rig.halts(60.0)
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
    rig.halts(60.0)


@pytest.mark.parametrize('bad', [[9.0, 9.0], [np.nan, 0.0]])
def test_a_planner_whose_configurations_are_all_refused_is_not_followed_to_its_end(rig, bad):
    """A collection of which nothing is commanded would be complete in seconds."""
    rig.visit(*[bad] * 11, [0.3, 0.1], *[bad] * 13)
    assert [f.solution for f in rig.said(Failed)] == list(range(11))
    rig.answer(11)
    rig.halts(1.0)
    assert rig.supervisor.halted.startswith('12 configurations refused in a row: a at ')
    assert [f.solution for f in rig.said(Failed)][11:] == list(range(12, 24))
    # The one that is left is not refused before a person has looked.
    rig.run(1.0)
    assert len(rig.said(Failed)) == 23


def test_ways_that_are_not_free_count_among_the_refused(rig):
    rig.answer_path = lambda request: PathAnswer(None, 'the table')
    rig.plan(*([0.01 * i, 0.3] for i in range(20)))
    rig.halts(5.0)
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
    rig.run(3.0)
    assert len(rig.said(Failed)) == 22
    assert not rig.said(Halted)


def test_the_first_configurations_of_all_may_fail_as_often_as_others():
    """A bridge that is started while the planner runs has not heard of a beginning."""
    rig = Rig(begun=False)
    rig.alter = restless(rig)
    rig.plan([0.5, 0.5], [0.2, 0.2], [0.4, 0.4], [0.1, 0.1])
    rig.halts(90.0)
    assert [f.solution for f in rig.said(Failed)] == [0, 1]


def test_a_configuration_that_is_reached_ends_the_row_of_failures(rig):
    rig.alter = restless(rig, {0, 1, 3, 4})
    rig.visit(*([0.1 * i, 0.3] for i in range(6)))
    rig.answer(2)
    rig.settles(2)
    assert [f.solution for f in rig.said(Failed)] == [0, 1, 3, 4]
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
    rig.settles()


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
    rig.settles()


def test_a_rival_always_halts_a_collection_and_otherwise_holds_it(rig):
    rig.collects_nothing()
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
    rig.freeze()
    rig.run(0.5)
    rig.do(rig.supervisor.observe('rivals', 'another publisher', rig.wall))
    assert not rig.said(Stop)
    assert rig.last(Halted).reason in ('another publisher', STOPPED)
