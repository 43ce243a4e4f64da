# SPDX-License-Identifier: Apache-2.0
"""One configuration after the other: who must be heard, what is asked, what is announced."""

import numpy as np
import pytest
from supervisor_rig import HOME, LIMITS, RULES, Rig, report, supervisor

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
from remaster_ros.motion.following import STANDING_S
from remaster_ros.motion.move_queue import PROBE
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.states import Arm
from remaster_ros.motion.trajectory import Line

# One after the other


def test_every_solution_is_visited_once_and_in_order(rig):
    targets = np.array([[0.5, -0.5], [-0.4, 0.3], [0.2, 0.1]])
    rig.plan(*targets)
    for solution, target in enumerate(targets):
        rig.run(20.0, lambda n=solution: len(rig.said(Settled)) == n + 1)
        settled = rig.last(Settled)
        assert settled.solution == solution
        assert settled.stamp_s == pytest.approx(rig.t)
        np.testing.assert_allclose(settled.q, target, atol=1e-4)
        np.testing.assert_allclose(rig.arm.at(rig.t)[0], target, atol=1e-4)
        line = Line.within(LIMITS, HOME if not solution else targets[solution - 1], target)
        assert line.duration_s - 0.1 < settled.motion_s < line.duration_s + 1.0
        assert 1.0 <= settled.settle_s < 1.05
        assert rig.supervisor.state is Arm.MEASURES
        rig.run(3.0)
        assert len(rig.said(Drive)) == solution + 1, 'it went on without the recorder'
        rig.answer(solution)
        assert rig.supervisor.state is (Arm.MOVES if solution < 2 else Arm.STANDS)
    assert [drive.solution for drive in rig.said(Drive)] == [0, 1, 2]
    rig.run(5.0)
    assert not rig.supervisor.busy
    assert not rig.said(Stop, Failed, Halted)
    assert len(rig.said(Drive)) == len(rig.said(Settled)) == 3


def test_only_the_answer_on_this_configuration_counts(rig):
    rig.answer(0)
    assert not rig.actions, 'an answer without a configuration'
    rig.plan([0.3, 0.0], [0.4, 0.0])
    rig.answer(0)
    rig.run(0.5)
    assert len(rig.said(Drive)) == 1, 'an answer before it has settled'
    rig.settles()
    rig.answer(1)
    assert len(rig.said(Drive)) == 1, 'an answer on another configuration'
    rig.answer(0)
    assert len(rig.said(Drive)) == 2
    rig.answer(0)
    assert rig.supervisor.busy


def test_what_lies_outside_is_refused_and_the_rest_visited(rig):
    rig.plan([1.001, 0.0], [0.3, 0.0], [np.nan, 0.0], [0.0, -2.5], [0.2, 0.0])
    assert [f.solution for f in rig.said(Failed)] == [0]
    assert rig.last(Failed).reason.startswith('a at 57.35 deg')
    rig.settles()
    rig.answer(1)
    rig.settles(2)
    assert [f.solution for f in rig.said(Failed)] == [0, 2, 3]
    assert [d.solution for d in rig.said(Drive)] == [1, 4]
    # Outside is the planner's fault and not the robot's.
    assert not rig.said(Halted)


def test_an_arm_that_moves_is_not_sent_anywhere(rig):
    """Somebody jogs it: only once it has stood for a moment is it commanded."""
    rig.alter = lambda t, q: np.add(q, [0.05 * np.sin(3 * t), 0.0])
    rig.run(1.0)
    rig.plan([0.3, 0.0])
    rig.run(2.0)
    assert not rig.said(Drive)
    rig.alter = lambda t, q: q
    stopped = rig.t
    rig.run(2.0, lambda: rig.said(Drive))
    assert STANDING_S - 0.05 <= rig.t - stopped <= STANDING_S + 0.1


def test_nothing_is_commanded_before_the_first_report():
    arm = supervisor()
    assert arm.blocked(5.0) == 'no sign of planner, recorder, robot for 3 s'
    assert arm.planner_is('running', 5.0) == []
    assert arm.recorder_waits('', 5.0) == []
    assert arm.plan(np.array([[0.1, 0.1]]), 5.0) == []
    assert arm.blocked(5.0) == 'no sign of robot for 3 s'
    # One report is no standstill.
    assert arm.report(report(0.1, HOME, 5.0)) == []
    assert arm.blocked(5.0) == ''
    assert arm.report(report(0.2, HOME, 5.1)) == []
    assert arm.report(report(0.34, HOME, 5.2)) == []
    (look,) = arm.report(report(0.36, HOME, 5.3))
    assert isinstance(look, CheckPath)
    np.testing.assert_array_equal(look.start, HOME)
    np.testing.assert_array_equal(look.target, HOME)
    assert not arm.busy
    # Where it stands is free; then the probe is made.
    (drive,) = arm.path_found(
        look.number, PathAnswer(FreePath(np.array([look.start, look.target]))), 5.32
    )
    assert drive.solution == PROBE
    (end,) = drive.admitted.waypoints
    assert 0.0 < np.max(np.abs(end.q - HOME)) < 1e-5


def test_before_the_planner_is_heard_nothing_moves():
    arm = supervisor()
    assert arm.halted == arm.trouble == ''
    arm.recorder_waits('', 5.0)
    arm.report(report(1.0, HOME, 5.0))
    assert arm.blocked(5.0) == 'no sign of planner for 3 s'
    assert arm.halted == arm.trouble == ''


def test_without_a_plan_nothing_is_commanded():
    """Where the arm stands is looked at, once."""
    arm = supervisor()
    arm.planner_is('running', 0.0)
    arm.recorder_waits('', 0.0)
    said = []
    for i in range(40):
        said += arm.report(report(8.0 + i * 0.05, HOME, i * 0.05))
        if said and i < 20:
            answer = PathAnswer(FreePath(np.array([HOME, HOME])))
            assert arm.path_found(said[0].number, answer, i * 0.05) == []
    (look,) = said
    np.testing.assert_array_equal(look.start, look.target)
    assert arm.blocked(2.0) == ''
    assert not arm.busy


def test_a_new_pose_stops_the_arm_first(rig):
    rig.go([0.9, -1.0])
    rig.plan([-0.5, 0.5])
    assert rig.last(Stop).reason == 'another pose'
    stopped = rig.t
    rig.run(5.0, lambda: len(rig.said(Drive)) == 2)
    assert rig.t - stopped > STANDING_S
    assert rig.speed() < 0.02
    rig.settles()
    np.testing.assert_allclose(rig.last(Settled).q, [-0.5, 0.5], atol=1e-4)


def test_no_solutions_at_all_stop_the_arm(rig):
    rig.go([0.9, -1.0])
    rig.plan()
    assert rig.last(Stop).reason == 'stopped'
    rig.run(5.0)
    assert len(rig.said(Drive)) == 1
    assert not rig.supervisor.busy


# Silence, pause, stop


@pytest.mark.parametrize('name', ['planner', 'recorder'])
def test_silence_of_a_node_stops_and_its_sign_lets_go_on(name):
    rig = Rig(SupervisorRules(settle=RULES.settle, heartbeat_s=1.5))
    rig.go([0.9, -1.9], 0.4)
    rig.alive.discard(name)
    silent = rig.t
    rig.run(6.0, lambda: rig.said(Stop))
    reason = f'no sign of {name} for 1.5 s'
    assert rig.last(Stop).reason == rig.supervisor.blocked(rig.wall) == reason
    # Half a second passes between two signs.
    assert 0.95 < rig.t - silent < 1.6
    rig.run(4.0)
    assert rig.speed() < 1e-3
    assert len(rig.said(Drive)) == len(rig.said(Stop)) == 1
    rig.alive.add(name)
    rig.run(1.0)
    assert rig.supervisor.blocked(rig.wall) == ''
    rig.settles()
    # Once, the same one, and to its end.
    assert [drive.solution for drive in rig.said(Drive)] == [0, 0]
    np.testing.assert_allclose(rig.last(Settled).q, [0.9, -1.9], atol=1e-4)


def test_exactly_a_heartbeat_is_not_silence(rig):
    arm = rig.supervisor
    rig.do(arm.planner_is('running', rig.wall))
    rig.do(arm.recorder_waits('', rig.wall))
    rig.step()
    assert arm.blocked(rig.wall - 0.02 + RULES.heartbeat_s) == ''
    assert arm.blocked(rig.wall - 0.02 + RULES.heartbeat_s + 1e-3) != ''


@pytest.mark.parametrize('state', ['paused', 'stopped', 'idle', 'failed', 'complete'])
def test_a_planner_that_does_not_run_stops_the_arm_at_once(rig, state):
    rig.go([0.9, -1.0])
    rig.state = state
    rig.do(rig.supervisor.planner_is(state, rig.wall))
    assert rig.last(Stop).reason == f'planner is {state}'
    assert rig.supervisor.blocked(rig.wall) == f'planner is {state}'
    rig.run(5.0)
    assert len(rig.said(Stop)) == len(rig.said(Drive)) == 1
    rig.state = 'running'
    rig.settles()
    # A person may have moved it meanwhile: where it is, is looked at as at the start.
    assert [drive.solution for drive in rig.said(Drive)] == [0, PROBE, 0]


# The recorder


def test_a_recorder_that_does_not_answer_loses_the_configuration_and_not_the_run(rig):
    rig.visit([0.5, 0.5], [0.2, 0.2])
    settled = rig.t
    rig.run(40.0, lambda: rig.said(Failed))
    assert rig.last(Failed).solution == 0
    assert rig.last(Failed).reason == 'the recorder did not answer in time'
    assert RULES.answer_timeout_s < rig.t - settled < RULES.answer_timeout_s + 0.1
    rig.settles(2)
    assert not rig.said(Halted, Stop)


def test_the_wait_for_the_recorder_does_not_run_while_it_waits_for_a_sensor(rig):
    rig.visit([0.5, 0.5])
    rig.waiting_for = 'mocap'
    rig.run(RULES.answer_timeout_s + 1.0)
    assert not rig.said(Failed)
    rig.waiting_for = ''
    rig.run(RULES.answer_timeout_s - 1.0)
    assert not rig.said(Failed)
    rig.run(3.0, lambda: rig.said(Failed))


def test_how_old_the_last_report_is():
    arm = supervisor()
    assert arm.report_age_s(5.0) == np.inf
    arm.report(report(0.0, HOME, 7.0))
    assert arm.report_age_s(9.5) == 2.5


def test_raised_limits_ask_for_another_run(rig):
    assert rig.supervisor.under_way
    rig.state = 'paused'
    rig.run(1.0)
    assert not rig.supervisor.under_way
    rig.do(rig.supervisor.use_limits(LIMITS, rig.wall, raised=True))
    waits = 'a limit was raised: /remaster/collect goes on'
    assert rig.supervisor.asks_for_collect == waits
    rig.plan([0.3, 0.0])
    blocked = rig.supervisor.blocked(rig.wall)
    # The run that was paused is reported late: it begins nothing.
    rig.do(rig.supervisor.planner_is('running', rig.wall, f'run {rig.runs}'))
    assert blocked == 'planner is paused'
    assert rig.supervisor.blocked(rig.wall) == waits
    rig.run(1.0)
    assert not rig.said(Drive)
    rig.state = 'running'
    rig.run(1.0)
    assert rig.said(Drive)
    assert rig.supervisor.asks_for_collect == ''


def test_the_settled_position_is_the_mean_and_not_the_last_report(rig):
    target, seen = HOME + np.array([0.2, -0.1]), []

    def sway(t, q):
        """By less than counts as still, mostly to one side: the mean is not the middle."""
        q = q + 5e-5 * (1.0 if len(seen) % 4 else -1.0)
        seen.append((t, q))
        return q

    rig.alter = sway
    rig.visit(target)
    said = rig.last(Settled)
    since = said.stamp_s - said.settle_s
    still = np.array([q for t, q in seen if since - 1e-9 <= t <= said.stamp_s + 1e-9])
    assert len(still) > 40
    np.testing.assert_allclose(said.q, still.mean(axis=0), atol=1e-12)
    for wrong in (still[-1], still[0], (still.min(axis=0) + still.max(axis=0)) / 2, target):
        assert np.abs(said.q - wrong).min() > 1e-5
