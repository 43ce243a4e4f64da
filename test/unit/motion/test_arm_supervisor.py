"""One configuration after the other: who must be heard, what is asked, what is announced."""

import numpy as np
import pytest
from supervisor_rig import HOME, LIMITS, RULES, SPEED, Rig

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
from remaster_ros.motion.arm_supervisor import ArmSupervisor
from remaster_ros.motion.following import STANDING_S
from remaster_ros.motion.joint_reports import JointReport, JointReports
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import MotionGate
from remaster_ros.motion.move_queue import PROBE
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.settling import SettleRules
from remaster_ros.motion.trajectory import Line
from remaster_ros.motion.visit import PROBE_WAIT_S


def supervisor(rules=RULES, limits=LIMITS):
    """Return one that is fed by hand."""
    reports = JointReports(limits.lower, limits.upper, 3 * SPEED)
    return ArmSupervisor(MotionGate(limits), reports, rules)


def report(t, q, wall):
    return JointReport(t, np.asarray(q, float), t, wall)


@pytest.fixture
def rig():
    return Rig()


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
        assert rig.supervisor.busy
        assert not rig.supervisor._motion.is_moving
        rig.run(3.0)
        assert len(rig.said(Drive)) == solution + 1, 'it went on without the recorder'
        rig.answer(solution)
        assert rig.supervisor._motion.is_moving == (solution < 2)
    assert [drive.solution for drive in rig.said(Drive)] == [0, 1, 2]
    rig.run(5.0)
    assert not rig.supervisor.busy
    assert not rig.said(Stop, Failed, Halted)
    assert len(rig.said(Drive)) == len(rig.said(Settled)) == 3


def test_only_the_answer_on_this_configuration_counts(rig):
    rig.plan([0.3, 0.0], [0.4, 0.0])
    rig.answer(0)
    rig.run(0.5)
    assert len(rig.said(Drive)) == 1, 'an answer before it has settled'
    rig.run(20.0, lambda: rig.said(Settled))
    rig.answer(1)
    assert len(rig.said(Drive)) == 1, 'an answer on another configuration'
    rig.answer(0)
    assert len(rig.said(Drive)) == 2
    rig.answer(0)
    assert rig.supervisor.busy


def test_without_a_configuration_an_answer_of_the_recorder_means_nothing(rig):
    rig.answer(0)
    assert not rig.actions
    assert not rig.supervisor.busy


def test_what_lies_outside_is_refused_and_the_rest_visited(rig):
    rig.plan([1.001, 0.0], [0.3, 0.0], [np.nan, 0.0], [0.0, -2.5], [0.2, 0.0])
    assert [f.solution for f in rig.said(Failed)] == [0]
    assert rig.last(Failed).reason.startswith('a at 57.35 deg')
    rig.run(20.0, lambda: rig.said(Settled))
    rig.answer(1)
    rig.run(20.0, lambda: len(rig.said(Settled)) == 2)
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
    # Where it stands is free; then the probe is asked for.
    (check,) = arm.path_found(
        look.number, PathAnswer(FreePath(np.array([look.start, look.target]))), 5.32
    )
    np.testing.assert_array_equal(check.start, HOME)
    assert check.waypoints.shape == (0, 2)
    assert 0.0 < np.max(np.abs(check.target - HOME)) < 1e-5
    assert not arm.busy
    (drive,) = arm.path_found(
        check.number, PathAnswer(FreePath(np.array([check.start, check.target]))), 5.35
    )
    assert drive.solution == PROBE


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
            assert arm.path_found(said[0].number, PathAnswer(None, 'unknown'), i * 0.05) == []
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
    rig.run(20.0, lambda: rig.said(Settled))
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
    rig.run(20.0, lambda: rig.said(Settled))
    # Once, the same one, and to its end.
    assert [drive.solution for drive in rig.said(Drive)] == [0, 0]
    np.testing.assert_allclose(rig.last(Settled).q, [0.9, -1.9], atol=1e-4)


def test_everybody_who_is_silent_is_named(rig):
    rig.alive -= {'planner', 'recorder'}
    rig.run(5.0)
    assert rig.supervisor.blocked(rig.wall) == 'no sign of planner, recorder for 3 s'


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
    rig.run(20.0, lambda: rig.said(Settled))
    assert [drive.solution for drive in rig.said(Drive)] == [0, 0]


def test_a_required_sensor_that_is_gone_stops_the_arm(rig):
    rig.go([0.9, -1.0])
    rig.waiting_for = 'mocap'
    rig.do(rig.supervisor.recorder_waits('mocap', rig.wall))
    assert rig.last(Stop).reason == 'waiting for mocap'
    rig.run(60.0)
    assert len(rig.said(Drive)) == 1
    rig.waiting_for = ''
    rig.run(20.0, lambda: rig.said(Settled))
    assert len(rig.said(Drive)) == 2


def test_a_reading_goes_on_while_paused_and_no_command_follows_it(rig):
    rig.plan([0.3, 0.0], [0.4, 0.0])
    rig.run(20.0, lambda: rig.said(Settled))
    rig.state = 'paused'
    rig.run(2.0)
    assert not rig.said(Stop)
    assert rig.supervisor.busy
    rig.answer(0)
    rig.run(2.0)
    assert len(rig.said(Drive)) == 1
    rig.state = 'running'
    rig.run(1.0, lambda: len(rig.said(Drive)) == 2)
    assert rig.last(Drive).solution == 1


# Paths


def test_the_way_is_asked_for_and_a_slow_answer_waited_for(rig):
    rig.answer_path = lambda request: None
    rig.plan([0.3, 0.0], waypoints={0: np.array([[0.1, 0.5]])})
    (check,) = rig.said(CheckPath)
    np.testing.assert_allclose(check.start, HOME, atol=1e-4)
    np.testing.assert_array_equal(check.target, [0.3, 0.0])
    np.testing.assert_array_equal(check.waypoints, [[0.1, 0.5]])
    rig.run(2.0)
    assert len(rig.said(CheckPath)) == 1
    assert not rig.supervisor.busy
    answer = Rig._free(check)
    rig.do(rig.supervisor.path_found(check.number, answer, rig.wall))
    np.testing.assert_array_equal(rig.last(Drive).admitted.trajectory.points, answer.path.points)
    # The same answer once more counts nothing.
    assert rig.supervisor.path_found(check.number, answer, rig.wall) == []
    rig.run(20.0, lambda: rig.said(Settled))


def test_an_answer_to_another_pose_counts_nothing(rig):
    rig.answer_path = lambda request: None
    rig.plan([0.3, 0.0])
    (first,) = rig.said(CheckPath)
    rig.plan([-0.3, 0.0])
    second = rig.last(CheckPath)
    assert second.number != first.number
    assert rig.supervisor.path_found(first.number, Rig._free(first), rig.wall) == []
    assert not rig.supervisor.busy
    rig.do(rig.supervisor.path_found(second.number, Rig._free(second), rig.wall))
    assert rig.supervisor._motion.is_moving


def test_the_way_to_the_next_solution_goes_through_its_own_waypoints(rig):
    rig.plan([0.3, 0.0], [0.4, 0.0], waypoints={1: np.array([[0.2, 0.4], [0.3, 0.4]])})
    rig.run(20.0, lambda: rig.said(Settled))
    rig.answer(0)
    first, second = rig.said(CheckPath)
    assert first.waypoints.shape == (0, 2)
    np.testing.assert_array_equal(second.waypoints, [[0.2, 0.4], [0.3, 0.4]])
    rig.run(20.0, lambda: len(rig.said(Settled)) == 2)
    assert len(rig.said(Drive)[1].admitted.trajectory.lines) == 3
    # Another pose does not inherit them.
    rig.plan([0.3, 0.0], [0.4, 0.0])
    assert rig.last(CheckPath).waypoints.shape == (0, 2)


def test_a_target_without_a_free_way_is_given_up_and_the_next_asked_for(rig):
    rig.answer_path = lambda request: (
        PathAnswer(None, 'the floor') if request.target[0] > 0.5 else Rig._free(request)
    )
    rig.plan([0.8, 0.0], [0.7, 0.0], [0.6, 0.0], [0.3, 0.0])
    assert [f.solution for f in rig.said(Failed)] == [0, 1, 2]
    assert {f.reason for f in rig.said(Failed)} == {'no free path: the floor'}
    assert rig.last(Drive).solution == 3
    assert not rig.said(Halted), 'that is no failure of the robot'


def test_what_the_gate_refuses_is_given_up(rig):
    rig.answer_path = lambda request: PathAnswer(
        FreePath(np.vstack([request.start, [[0.0, -2.2]], request.target]))
        if request.target[0] > 0.5
        else Rig._free(request).path
    )
    rig.plan([0.8, 0.0], [0.3, 0.0])
    (failed,) = rig.said(Failed)
    assert failed.solution == 0
    assert failed.reason.startswith('b would go to -1')
    assert rig.last(Drive).solution == 1
    assert rig.supervisor.gate.refused == 1


def test_an_arm_that_moved_since_it_was_asked_is_asked_again(rig):
    rig.answer_path = lambda request: None
    rig.plan([0.3, 0.0])
    (check,) = rig.said(CheckPath)
    rig.alter = lambda t, q: np.add(q, [0.015, 0.0])
    rig.run(1.0)
    assert rig.supervisor.path_found(check.number, Rig._free(check), rig.wall) == []
    rig.answer_path = Rig._free
    rig.run(0.1)
    assert len(rig.said(CheckPath)) == 2
    np.testing.assert_allclose(rig.last(CheckPath).start, np.add(HOME, [0.015, 0.0]), atol=1e-4)
    assert rig.last(Drive).solution == 0
    assert not rig.said(Failed, Halted)


@pytest.mark.parametrize('what', ['paused', 'moving'])
def test_an_answer_to_an_arm_that_must_not_move_counts_nothing(rig, what):
    rig.answer_path = lambda request: None
    rig.plan([0.3, 0.0])
    (check,) = rig.said(CheckPath)
    if what == 'paused':
        rig.state = 'paused'
    else:
        rig.alter = lambda t, q: np.add(q, [1e-3 * np.sin(9 * t), 0.0])
    rig.run(1.0)
    assert rig.supervisor.path_found(check.number, Rig._free(check), rig.wall) == []
    assert not rig.said(Drive)
    rig.state, rig.alter, rig.answer_path = 'running', lambda t, q: q, Rig._free
    rig.run(2.0)
    assert [d.solution for d in rig.said(Drive)] == [0]


# The recorder


def test_a_recorder_that_does_not_answer_loses_the_configuration_and_not_the_run(rig):
    rig.plan([0.5, 0.5], [0.2, 0.2])
    rig.run(20.0, lambda: rig.said(Settled))
    settled = rig.t
    rig.run(40.0, lambda: rig.said(Failed))
    assert rig.last(Failed).solution == 0
    assert rig.last(Failed).reason == 'the recorder did not answer in time'
    assert RULES.answer_timeout_s < rig.t - settled < RULES.answer_timeout_s + 0.1
    rig.run(20.0, lambda: len(rig.said(Settled)) == 2)
    assert not rig.said(Halted, Stop)


def test_the_wait_for_the_recorder_does_not_run_while_it_waits_for_a_sensor(rig):
    rig.plan([0.5, 0.5])
    rig.run(20.0, lambda: rig.said(Settled))
    rig.waiting_for = 'mocap'
    rig.run(3 * RULES.answer_timeout_s)
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


# The probe: commanded as measured?


def copying(low=(-1.0, -2.0), high=(1.0, 2.0), home=HOME):
    """Return what is done with a robot that reports what it was commanded."""
    limits = MotionLimits(('a', 'b'), np.array(low), np.array(high), SPEED, LIMITS.acceleration)
    arm = supervisor(limits=limits)
    arm.planner_is('running', 0.0)
    arm.recorder_waits('', 0.0)
    arm.plan(np.array([[0.5, 0.5]]), 0.0)
    actions, q, t = [], home, 0.0
    while t < 4.0 and not any(isinstance(action, Halted) for action in actions):
        t += 0.1
        todo = arm.report(report(t, q, t))
        while todo:
            action = todo.pop(0)
            if isinstance(action, CheckPath):
                todo += arm.path_found(action.number, Rig._free(action), t)
                continue
            actions.append(action)
            if isinstance(action, Drive):
                q = action.admitted.waypoints[-1].q
        arm.planner_is('running', t)
        arm.recorder_waits('', t)
    return actions


def test_a_robot_that_repeats_commands_is_found_before_it_is_sent_anywhere():
    probe, halted = copying()
    assert probe.solution == PROBE
    (end,) = probe.admitted.waypoints[1:]
    assert end.time_s == 1.0
    np.testing.assert_allclose(end.q, HOME, rtol=0, atol=1.01e-6)
    assert np.all(end.q != HOME)
    assert halted.reason == (
        'joint_states repeat what was commanded to the last bit: no measurement; '
        'switch the driver to measured positions'
    )


@pytest.mark.parametrize('bounds', [((0.1, 0.2), (9.0, 9.0)), ((-9.0, -9.0), (0.1, 0.2))])
def test_the_probe_goes_inward(bounds):
    end = copying(*bounds)[0].admitted.waypoints[-1].q
    assert np.all((end > bounds[0]) & (end < bounds[1]))
    np.testing.assert_allclose(np.abs(end - HOME), 1e-6, rtol=1e-6)


@pytest.mark.parametrize(('place', 'way'), [(0.4, 1), (0.5, 1), (0.6, -1)])
def test_the_probe_goes_towards_the_middle(place, way):
    home = np.full(2, place)
    end = copying((0.0, 0.0), (1.0, 1.0), home)[0].admitted.waypoints[-1].q
    np.testing.assert_allclose(end, home + way * 1e-6, rtol=0, atol=1e-12)


@pytest.mark.parametrize('side', [1.0, -1.0])
def test_the_probe_of_a_joint_without_limits_goes_towards_zero(side):
    probe = copying((-np.inf, -np.inf), (np.inf, np.inf), side * HOME)[0]
    end = probe.admitted.waypoints[-1].q
    np.testing.assert_allclose(end, side * (HOME - 1e-6), rtol=0, atol=1e-12)


def begun(**kwargs):
    """Return a rig that has not been probed yet."""
    rig = Rig(begun=False, **kwargs)
    rig.plan([0.5, 0.5], [0.3, 0.3])
    return rig


def test_a_robot_that_measures_is_probed_once_and_for_a_moment():
    rig = begun()
    start = rig.t
    rig.run(10.0, lambda: rig.said(Settled))
    rig.answer(0)
    rig.run(10.0, lambda: len(rig.said(Settled)) == 2)
    assert [d.solution for d in rig.said(Drive)] == [PROBE, 0, 1]
    sent = [t for t, action in rig.actions if isinstance(action, Drive)]
    assert sent[0] - start < 0.6
    assert 1.0 + PROBE_WAIT_S < sent[1] - sent[0] < 1.0 + PROBE_WAIT_S + 0.1


def test_the_probe_that_was_stopped_is_made_again():
    rig = begun()
    rig.run(1.0, lambda: rig.said(Drive))
    rig.state = 'paused'
    rig.run(3.0)
    assert len(rig.said(Stop)) == 1
    rig.state = 'running'
    rig.run(20.0, lambda: rig.said(Settled))
    assert [d.solution for d in rig.said(Drive)] == [PROBE, PROBE, 0]


@pytest.mark.parametrize(('settle_s', 'wait'), [(0.2, True), (1.0, False), (3.0, False)])
def test_a_driver_that_begins_to_repeat_commands_later_is_found(settle_s, wait):
    """Switched to open loop in the middle: no such configuration is ever announced as settled."""
    rig = Rig(SupervisorRules(settle=SettleRules(settle_s=settle_s)))
    rig.plan([0.5, 0.5])
    arrival = rig.t + Line.within(LIMITS, HOME, np.array([0.5, 0.5])).duration_s
    rig.alter = lambda t, q: np.array([0.5, 0.5]) if t > arrival else q
    rig.run(10.0, lambda: rig.said(Halted))
    assert rig.last(Halted).reason.startswith('joint_states repeat what was commanded')
    assert not rig.said(Settled)
    assert rig.t - arrival < (PROBE_WAIT_S + 0.1)


def test_a_probe_that_must_not_be_made_halts():
    """Where the arm stands no way is free, and nothing tells a way out."""
    rig = Rig(begun=False)
    rig.answer_path = lambda request: PathAnswer(None, 'the floor')
    rig.plan([0.5, 0.5])
    rig.run(1.0)
    assert rig.last(Halted).reason == 'no free path: the floor'
    assert not rig.said(Drive, Failed)
