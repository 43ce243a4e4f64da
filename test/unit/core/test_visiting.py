"""The rules of the bridge: who must be heard, one configuration at a time, stop and go on."""

import numpy as np
import pytest

from remaster_ros.core import visiting
from remaster_ros.core.motion import STANDSTILL_RAD_S, STANDSTILL_S, MotionLimits
from remaster_ros.core.settling import SettleRules
from remaster_ros.core.visiting import Drive, Failed, Halted, Settled, Stop, Visitor, VisitRules
from remaster_ros.fakes import motion as servo

LIMITS = MotionLimits(
    ('a', 'b'), np.array([-1.0, -2.0]), np.array([1.0, 2.0]), np.array([0.5, 1.0])
)
RULES = VisitRules(settle=SettleRules(settle_s=1.0), arrive_timeout_s=5.0, answer_timeout_s=20.0)
HOME = np.array([0.1, 0.2])
HALF = RULES.heartbeat_s / 2


class Rig:
    """The visitor with an arm that lags and overshoots, and everybody heard, at 50 Hz.

    `alter` changes what the arm reports, `obey` what becomes of a trajectory.
    """

    def __init__(self, rules=RULES, wall_s=1000.0, begun=True):
        self.visitor = Visitor(LIMITS, rules)
        self.t, self.wall = 50.0, wall_s
        self.arm = servo.Motion(self.t, HOME)
        self.rng = np.random.default_rng(2)
        self.talking = {'planner', 'recorder', 'robot'}
        self.state, self.waiting_for = 'running', ''
        self.actions = []
        self.obey = lambda waypoints: waypoints
        self.alter = lambda t, q: q
        self.stamp_shift = 0.0
        self.rate = 1.0
        self.spoken = -np.inf
        if not begun:
            return
        # The first move is the probe; then the arm settles where it stands.
        self.plan(HOME)
        self.run(10.0, lambda: self.said(Settled))
        self.answer(0)
        self.actions.clear()

    def do(self, actions):
        for action in actions:
            self.actions.append((self.t, action))
            points = action.waypoints if isinstance(action, Drive) else ()
            points = (action.waypoint,) if isinstance(action, Stop) else points
            points = self.obey(points)
            if points:
                self.arm.follow(
                    self.t, [servo.Waypoint(p.time_s, p.q, p.velocity) for p in points]
                )

    def step(self, dt=0.02):
        self.t, self.wall = self.t + dt, self.wall + dt / self.rate
        if self.wall - self.spoken >= 0.5:
            self.spoken = self.wall
            if 'planner' in self.talking:
                self.do(self.visitor.planner_says(self.state, self.wall))
            if 'recorder' in self.talking:
                self.do(self.visitor.recorder_says(self.waiting_for, self.wall))
        if 'robot' in self.talking:
            # No encoder says the same twice.
            q = self.arm.at(self.t)[0] + self.rng.normal(0.0, 1e-6, 2)
            q = self.alter(self.t, q)
            self.do(self.visitor.report(self.t + self.stamp_shift, q, self.wall))
        self.do(self.visitor.tick(self.wall))

    def run(self, seconds, until=None):
        end = self.t + seconds
        while self.t < end:
            self.step()
            if until is not None and until():
                return
        assert until is None, f'waited {seconds} s in vain'

    def plan(self, *solutions):
        self.do(self.visitor.plan(np.reshape(np.array(solutions, float), (-1, 2)), self.wall))

    def said(self, *kinds):
        return [action for _, action in self.actions if isinstance(action, kinds)]

    def last(self, kind):
        return self.said(kind)[-1]

    def speed(self, t=None):
        return np.max(np.abs(self.arm.at(self.t if t is None else t)[1]))

    def go(self, target, seconds=0.8):
        """Send the arm off and let it get into motion."""
        self.plan(target)
        self.run(seconds)
        assert self.said(Drive)
        assert self.speed() > 0.1

    def answer(self, solution):
        self.do(self.visitor.answered(solution, self.wall))


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
        assert settled.stamp_s == rig.t
        np.testing.assert_allclose(settled.q, target, atol=1e-4)
        np.testing.assert_allclose(rig.arm.at(rig.t)[0], target, atol=1e-4)
        move = LIMITS.move(HOME if not solution else targets[solution - 1], target)
        assert move.duration_s - 0.1 < settled.motion_s < move.duration_s + 1.0
        assert 1.0 <= settled.settle_s < 1.05
        assert rig.visitor.busy
        rig.run(3.0)
        assert len(rig.said(Drive)) == solution + 1, 'it went on without the recorder'
        rig.answer(solution)
    assert [drive.solution for drive in rig.said(Drive)] == [0, 1, 2]
    rig.run(5.0)
    assert not rig.visitor.busy
    assert not rig.said(Stop, Failed, Halted)
    assert len(rig.said(Drive)) == len(rig.said(Settled)) == 3


def test_the_arm_moves_within_the_speed_and_along_the_waypoints(rig):
    rig.plan([0.9, -1.5])
    drive = rig.said(Drive)[0]
    np.testing.assert_allclose(drive.waypoints[-1].q, [0.9, -1.5])
    times = [0.0, *(p.time_s for p in drive.waypoints)]
    for a, b in zip(drive.waypoints, drive.waypoints[1:]):
        assert np.all(np.abs(b.q - a.q) / (b.time_s - a.time_s) <= LIMITS.velocity + 1e-9)
    assert np.all(np.diff(times) > 0)
    start = rig.t
    rig.run(20.0, lambda: rig.said(Settled))
    speeds = [np.abs(rig.arm.at(t)[1]) for t in np.arange(start, rig.t, 0.01)]
    assert np.all(np.max(speeds, axis=0) <= 1.1 * LIMITS.velocity)


def test_only_the_word_on_this_configuration_counts(rig):
    rig.plan([0.3, 0.0], [0.4, 0.0])
    rig.answer(0)
    rig.run(0.5)
    assert len(rig.said(Drive)) == 1, 'a word before it has settled'
    rig.run(20.0, lambda: rig.said(Settled))
    rig.answer(1)
    assert len(rig.said(Drive)) == 1, 'a word on another configuration'
    rig.answer(0)
    assert len(rig.said(Drive)) == 2
    rig.answer(0)
    assert rig.visitor.busy


def test_without_a_configuration_a_word_of_the_recorder_means_nothing(rig):
    rig.answer(0)
    assert not rig.actions
    assert not rig.visitor.busy


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
    assert visiting.STANDING_S - 0.05 <= rig.t - stopped <= visiting.STANDING_S + 0.1


def test_nothing_is_commanded_before_the_first_report():
    visitor = Visitor(LIMITS, RULES)
    assert visitor.blocked(5.0) == 'no sign of planner, recorder, robot for 3 s'
    assert visitor.planner_says('running', 5.0) == []
    assert visitor.recorder_says('', 5.0) == []
    assert visitor.plan(np.array([[0.1, 0.1]]), 5.0) == []
    assert visitor.blocked(5.0) == 'no sign of robot for 3 s'
    assert visitor.unreadable('joints have other names', 5.0) == []
    assert visitor.blocked(5.0) == 'joints have other names'
    # One report is no standstill.
    assert visitor.report(0.1, HOME, 5.0) == []
    assert visitor.blocked(5.0) == ''
    assert visitor.report(0.2, HOME, 5.1) == []
    assert visitor.report(0.34, HOME, 5.2) == []
    (drive,) = visitor.report(0.36, HOME, 5.3)
    assert drive.solution == visiting.PROBE


def test_before_the_planner_has_spoken_nothing_moves():
    visitor = Visitor(LIMITS, RULES)
    assert visitor.halted == visitor.trouble == ''
    visitor.recorder_says('', 5.0)
    visitor.report(1.0, HOME, 5.0)
    assert visitor.blocked(5.0) == 'no sign of planner for 3 s'
    assert visitor.halted == visitor.trouble == ''


def test_a_new_pose_stops_the_arm_first(rig):
    rig.go([0.9, -1.0])
    rig.plan([-0.5, 0.5])
    assert rig.last(Stop).reason == 'another pose'
    stopped = rig.t
    rig.run(5.0, lambda: len(rig.said(Drive)) == 2)
    assert rig.t - stopped > visiting.STANDING_S
    assert rig.speed() < 0.02
    rig.run(20.0, lambda: rig.said(Settled))
    np.testing.assert_allclose(rig.last(Settled).q, [-0.5, 0.5], atol=1e-4)


def test_no_solutions_at_all_stop_the_arm(rig):
    rig.go([0.9, -1.0])
    rig.plan()
    assert rig.last(Stop).reason == 'stopped'
    rig.run(5.0)
    assert len(rig.said(Drive)) == 1
    assert not rig.visitor.busy


# Silence, pause, stop


@pytest.mark.parametrize('name', ['planner', 'recorder', 'robot'])
def test_silence_stops_and_speech_lets_go_on(rig, name):
    rig.go([0.9, -1.9], 0.4)
    rig.talking.discard(name)
    silent = rig.t
    rig.run(6.0, lambda: rig.said(Stop))
    reason = f'no sign of {name} for 3 s'
    assert rig.last(Stop).reason == rig.visitor.blocked(rig.wall) == reason
    # Half a second passes between two words.
    assert RULES.heartbeat_s - 0.55 < rig.t - silent < RULES.heartbeat_s + 0.1
    rig.run(4.0)
    assert rig.speed() < STANDSTILL_RAD_S
    assert len(rig.said(Drive)) == len(rig.said(Stop)) == 1
    rig.talking.add(name)
    rig.run(1.0)
    assert rig.visitor.blocked(rig.wall) == ''
    rig.run(20.0, lambda: rig.said(Settled))
    # Once, the same one, and to its end.
    assert [drive.solution for drive in rig.said(Drive)] == [0, 0]
    np.testing.assert_allclose(rig.last(Settled).q, [0.9, -1.9], atol=1e-4)


def test_the_heartbeat_is_wall_time(rig):
    """A robot whose clock runs ten times as fast does not make anybody silent."""
    rig.rate = 20.0
    rig.plan([0.9, -1.9])
    rig.run(9.0)
    assert not rig.said(Stop)
    assert rig.visitor.blocked(rig.wall + RULES.heartbeat_s - 0.5) == ''


def test_exactly_a_heartbeat_is_not_silence(rig):
    visitor = rig.visitor
    rig.do(visitor.planner_says('running', rig.wall))
    rig.do(visitor.recorder_says('', rig.wall))
    rig.step(0.0)
    assert visitor.blocked(rig.wall + RULES.heartbeat_s) == ''
    assert visitor.blocked(rig.wall + RULES.heartbeat_s + 1e-3) != ''


@pytest.mark.parametrize('state', ['paused', 'stopped', 'idle', 'failed', 'complete'])
def test_a_planner_that_does_not_run_stops_the_arm_at_once(rig, state):
    rig.go([0.9, -1.0])
    rig.state = state
    rig.do(rig.visitor.planner_says(state, rig.wall))
    assert rig.last(Stop).reason == f'planner is {state}'
    rig.run(5.0)
    assert len(rig.said(Stop)) == len(rig.said(Drive)) == 1
    rig.state = 'running'
    rig.run(20.0, lambda: rig.said(Settled))
    assert [drive.solution for drive in rig.said(Drive)] == [0, 0]


def test_a_required_sensor_that_is_gone_stops_the_arm(rig):
    rig.go([0.9, -1.0])
    rig.waiting_for = 'mocap'
    rig.do(rig.visitor.recorder_says('mocap', rig.wall))
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
    assert rig.visitor.busy
    rig.answer(0)
    rig.run(2.0)
    assert len(rig.said(Drive)) == 1
    rig.state = 'running'
    rig.run(1.0, lambda: len(rig.said(Drive)) == 2)
    assert rig.last(Drive).solution == 1


def test_after_a_stop_every_joint_stands_still_in_time():
    """At random moments of random moves, with a servo that lags and overshoots."""
    rng = np.random.default_rng(11)
    speeds = []
    for _ in range(60):
        rig = Rig()
        rig.plan(rng.uniform([-1, -2], [1, 2]))
        rig.run(rng.uniform(0.2, 3.0))
        rig.state = 'paused'
        before = rig.speed()
        rig.do(rig.visitor.planner_says('paused', rig.wall))
        stops = rig.said(Stop)
        moving = rig.visitor.busy is False and len(stops) == 1
        later = [rig.speed(rig.t + STANDSTILL_S + dt) for dt in np.arange(0, 5, 0.01)]
        assert max(later) < STANDSTILL_RAD_S
        if moving and before > 0.2:
            speeds.append(before)
            # Not back the way it came: no joint turns round while it brakes.
            v = rig.arm.at(rig.t)[1]
            braking = np.array([rig.arm.at(rig.t + dt)[1] for dt in np.arange(0, 0.2, 0.01)])
            assert np.all(braking * np.sign(v) > -0.05 * np.abs(v))
    assert len(speeds) > 20


def test_an_arm_nobody_sees_is_stopped_ahead_and_not_behind():
    """After a silence the arm has gone on along its trajectory; there it is stopped."""
    rig = Rig(VisitRules(settle=RULES.settle, heartbeat_s=1.0))
    rig.go([0.9, -1.9], 0.9)
    seen = rig.arm.at(rig.t)[0]
    rig.talking.discard('robot')
    rig.run(6.0, lambda: rig.said(Stop))
    here, velocity = rig.arm.at(rig.t)
    stop = rig.last(Stop).waypoint
    assert np.max(np.abs(here - seen)) > 0.5
    assert np.max(np.abs(stop.q - here)) < 0.3
    assert np.max(np.abs(velocity)) > 0.1
    assert np.all((stop.q - here) * velocity >= -1e-3)


def test_an_arm_that_did_not_follow_is_stopped_where_it_was_seen():
    rig = Rig(VisitRules(settle=RULES.settle, stall_s=50.0))
    rig.obey = lambda waypoints: ()
    rig.plan([0.9, -1.9])
    rig.run(1.5)
    rig.talking.discard('robot')
    rig.run(6.0, lambda: rig.said(Stop))
    np.testing.assert_allclose(rig.last(Stop).waypoint.q, HOME, rtol=0, atol=1e-4)


def test_a_stop_brakes_at_the_speed_that_the_reports_show(rig):
    rig.go([0.9, -1.9], 1.2)
    q = rig.arm.at(rig.t)[0]
    before = rig.arm.at(rig.t - 0.02)[0]
    rig.state = 'paused'
    rig.do(rig.visitor.planner_says('paused', rig.wall))
    expected = LIMITS.stop(q, (q - before) / 0.02)
    np.testing.assert_allclose(rig.last(Stop).waypoint.q, expected.q, rtol=0, atol=1e-4)
    assert rig.last(Stop).waypoint.time_s == expected.time_s


# What a robot may do wrong


def test_a_command_that_is_dropped_is_given_once_more(rig):
    dropped = []
    rig.obey = lambda waypoints: waypoints if dropped else dropped.append(1) or ()
    rig.plan([0.5, 0.5], [0.1, 0.1])
    rig.run(20.0, lambda: rig.said(Settled))
    assert [drive.solution for drive in rig.said(Drive)] == [0, 0]
    first, second = (t for t, action in rig.actions if isinstance(action, Drive))
    assert RULES.stall_s <= second - first < RULES.stall_s + 0.2
    assert not rig.said(Failed, Halted)
    # The next configuration has as many attempts as the first.
    dropped.clear()
    rig.answer(0)
    rig.run(20.0, lambda: len(rig.said(Settled)) == 2)
    assert [drive.solution for drive in rig.said(Drive)] == [0, 0, 1, 1]
    assert not rig.said(Halted)


def test_a_robot_that_takes_no_command_is_left_alone(rig):
    rig.obey = lambda waypoints: ()
    rig.plan([0.5, 0.5])
    rig.run(20.0, lambda: rig.said(Halted))
    reason = 'the robot does not take commands: see its controller'
    assert rig.last(Halted).reason == rig.last(Stop).reason == rig.visitor.halted == reason
    assert len(rig.said(Drive)) == RULES.attempts
    rig.run(20.0)
    assert len(rig.said(Drive)) == RULES.attempts
    assert rig.visitor.blocked(rig.wall) == reason
    # Somebody looks at it, and starts the collection again.
    rig.obey = lambda waypoints: waypoints
    rig.state = 'paused'
    rig.run(1.0)
    assert rig.visitor.halted
    rig.state = 'running'
    rig.run(20.0, lambda: rig.said(Settled))
    assert rig.last(Settled).solution == 0
    assert not rig.said(Failed)


def test_a_robot_that_stops_on_its_way_is_stopped_for_good(rig):
    """An emergency stop: released, the arm must not go on by itself."""
    rig.go([0.9, -1.9], 1.0)
    stop_q = rig.arm.at(rig.t)[0]
    rig.alter = lambda t, q: stop_q
    stopped = rig.t
    rig.run(5.0, lambda: rig.said(Halted))
    assert RULES.stall_s <= rig.t - stopped < RULES.stall_s + 0.2
    reason = 'the robot stopped on its way: an emergency or protective stop?'
    assert rig.last(Halted).reason == reason
    np.testing.assert_allclose(rig.last(Stop).waypoint.q, stop_q)
    rig.run(10.0)
    assert len(rig.said(Drive)) == 1
    assert not rig.said(Failed)


def test_the_robots_own_word_on_an_emergency_stop(rig):
    rig.go([0.9, -1.9])
    rig.do(rig.visitor.emergency(False, rig.wall))
    assert not rig.said(Stop)
    rig.do(rig.visitor.emergency(True, rig.wall))
    reason = 'the robot says emergency stop'
    assert rig.last(Stop).reason == rig.last(Halted).reason == reason
    # Starting while it lasts halts it again; after it, it goes on.
    rig.state = 'paused'
    rig.run(1.0)
    rig.state = 'running'
    rig.run(2.0)
    assert len(rig.said(Halted)) == 2
    assert len(rig.said(Drive)) == 1
    rig.do(rig.visitor.emergency(False, rig.wall))
    rig.run(2.0)
    assert len(rig.said(Drive)) == 1, 'the end of the emergency is nobody starting it'
    rig.state = 'paused'
    rig.run(1.0)
    rig.state = 'running'
    rig.run(20.0, lambda: rig.said(Settled))
    assert len(rig.said(Halted)) == 2


@pytest.mark.parametrize('beside', [[0.02, 0.0], [0.0, -0.3]])
def test_an_arm_that_arrives_elsewhere_gives_up_this_configuration(rig, beside):
    rig.alter = lambda t, q: q + np.array(beside) * np.clip((t - rig.sent) / 2, 0, 1)
    rig.sent = rig.t
    rig.plan([0.5, 0.5], [0.2, 0.2])
    rig.run(20.0, lambda: rig.said(Failed))
    failed = rig.last(Failed)
    assert failed.solution == 0
    assert failed.reason == f'arrived elsewhere: {np.max(np.abs(beside)):.4f} rad off'
    assert rig.last(Stop).reason == failed.reason
    rig.alter = lambda t, q: q
    rig.run(20.0, lambda: rig.said(Settled))
    assert rig.last(Settled).solution == 1
    assert not rig.said(Halted)


def test_the_first_failures_of_all_are_counted_from_none():
    rig = Rig(begun=False)
    rig.alter = lambda t, q: np.add(q, [0.02, 0.0]) if rig.visitor.busy else q
    rig.plan([0.5, 0.5], [0.2, 0.2], [0.4, 0.4], [0.1, 0.1])
    rig.run(40.0, lambda: rig.said(Halted))
    assert [f.solution for f in rig.said(Failed)] == [0, 1]


def test_three_failures_in_a_row_halt_and_the_third_is_not_lost(rig):
    rig.alter = lambda t, q: np.add(q, [0.02, 0.0]) if rig.visitor.busy else q
    rig.plan([0.5, 0.5], [0.2, 0.2], [0.4, 0.4], [0.1, 0.1])
    rig.run(40.0, lambda: rig.said(Halted))
    assert [f.solution for f in rig.said(Failed)] == [0, 1]
    reason = '3 configurations not reached: arrived elsewhere: 0.0200 rad off'
    assert rig.last(Halted).reason == reason
    rig.alter = lambda t, q: q
    rig.state = 'paused'
    rig.run(1.0)
    rig.state = 'running'
    for solution in (2, 3):
        rig.run(20.0, lambda: rig.said(Settled) and rig.visitor.busy)
        rig.run(20.0, lambda s=solution: rig.last(Settled).solution == s)
        rig.answer(solution)
    assert len(rig.said(Halted)) == 1


def test_a_configuration_that_is_reached_ends_the_row_of_failures(rig):
    fail = {0, 1, 3, 4}
    rig.alter = lambda t, q: (
        np.add(q, [0.02, 0.0]) if rig.visitor.busy and rig.last(Drive).solution in fail else q
    )
    rig.plan(*([0.1 * i, 0.3] for i in range(6)))
    rig.run(40.0, lambda: rig.said(Settled))
    rig.answer(2)
    rig.run(40.0, lambda: len(rig.said(Settled)) == 2)
    assert [f.solution for f in rig.said(Failed)] == [0, 1, 3, 4]
    assert not rig.said(Halted)


def test_somebodys_word_to_go_on_ends_the_row_of_failures_too(rig):
    rig.alter = lambda t, q: np.add(q, [0.02, 0.0]) if rig.visitor.busy else q
    rig.plan(*([0.1 * i, 0.3] for i in range(6)))
    rig.run(40.0, lambda: len(rig.said(Failed)) == 2)
    rig.state = 'paused'
    rig.run(1.0)
    rig.state = 'running'
    rig.run(40.0, lambda: len(rig.said(Failed)) == 4)
    assert not rig.said(Halted)


def test_an_arm_that_drifts_never_settles(rig):
    """2 mrad within the tolerance of arrival, at a speed below every velocity threshold."""
    rig.plan([0.5, 0.5])
    rig.alter = lambda t, q: np.add(q, [1e-3 * np.arcsin(np.sin(t)), 0.0])
    sent = rig.t
    rig.run(30.0, lambda: rig.said(Failed))
    reason = 'did not come to rest at its target in time'
    assert rig.last(Failed).reason == rig.last(Stop).reason == reason
    expected = LIMITS.move(HOME, np.array([0.5, 0.5])).duration_s
    expected += RULES.settle.settle_s + RULES.arrive_timeout_s
    assert expected < rig.t - sent < expected + 0.1
    assert not rig.said(Settled)


def test_a_slow_robot_is_waited_for(rig):
    """Half as fast as it was told, without a stop: it arrives before the time-out."""
    rig.obey = lambda waypoints: [
        servo.Waypoint(2 * p.time_s, p.q, p.velocity / 2) for p in waypoints
    ]
    rig.plan([0.9, -1.0])
    rig.run(20.0, lambda: rig.said(Settled))
    assert not rig.said(Stop, Failed, Halted)


def test_reports_that_are_not_finite_stop_the_arm_and_are_no_position(rig):
    rig.go([0.9, -1.0])
    good = rig.alter
    rig.alter = lambda t, q: q * np.nan
    rig.step()
    assert rig.last(Stop).reason == 'joint_states are not finite'
    assert np.all(np.isfinite(rig.last(Stop).waypoint.q))
    rig.run(3.0)
    assert len(rig.said(Drive)) == 1
    rig.alter = good
    rig.run(20.0, lambda: rig.said(Settled))


def test_reports_that_cannot_be_read_stop_the_arm(rig):
    rig.go([0.9, -1.0])
    rig.do(rig.visitor.unreadable('joint_states lacks a', rig.wall))
    assert rig.last(Stop).reason == 'joint_states lacks a'
    assert rig.visitor.blocked(rig.wall) == 'joint_states lacks a'
    rig.run(20.0, lambda: rig.said(Settled))


def test_a_recorder_that_says_nothing_loses_the_configuration_and_not_the_run(rig):
    rig.plan([0.5, 0.5], [0.2, 0.2])
    rig.run(20.0, lambda: rig.said(Settled))
    settled = rig.t
    rig.run(40.0, lambda: rig.said(Failed))
    assert rig.last(Failed).solution == 0
    assert rig.last(Failed).reason == 'the recorder did not say what became of it'
    assert RULES.answer_timeout_s < rig.t - settled < RULES.answer_timeout_s + 0.1
    rig.run(20.0, lambda: len(rig.said(Settled)) == 2)
    assert not rig.said(Halted, Stop)


# Commanded as measured


def copying(low=(-1.0, -2.0), high=(1.0, 2.0), home=HOME):
    """Return a visitor in front of a robot that reports what it was commanded, and its answer."""
    limits = MotionLimits(('a', 'b'), np.array(low), np.array(high), LIMITS.velocity)
    visitor = Visitor(limits, RULES)
    visitor.planner_says('running', 0.0)
    visitor.recorder_says('', 0.0)
    visitor.plan(np.array([[0.5, 0.5]]), 0.0)
    actions, q, t = [], home, 0.0
    while t < 3.0 and not any(isinstance(action, Halted) for action in actions):
        t += 0.1
        for action in visitor.report(t, q, t):
            actions.append(action)
            if isinstance(action, Drive):
                q = action.waypoints[-1].q
        visitor.planner_says('running', t)
        visitor.recorder_says('', t)
    return actions


def test_a_robot_that_repeats_commands_is_found_before_it_is_sent_anywhere():
    probe, stop, halted = copying()
    assert probe.solution == visiting.PROBE
    assert probe.waypoints[-1].time_s == 1.0
    np.testing.assert_allclose(probe.waypoints[-1].q, HOME, rtol=0, atol=1.01e-6)
    assert np.all(probe.waypoints[-1].q != HOME)
    reason = (
        'joint_states repeat what was commanded to the last bit: no measurement; '
        'switch the driver to measured positions'
    )
    assert halted.reason == stop.reason == reason


@pytest.mark.parametrize('bounds', [((0.1, 0.2), (9.0, 9.0)), ((-9.0, -9.0), (0.1, 0.2))])
def test_the_probe_goes_inward(bounds):
    probe = copying(*bounds)[0]
    end = probe.waypoints[-1].q
    assert np.all((end > bounds[0]) & (end < bounds[1]))
    np.testing.assert_allclose(np.abs(end - HOME), 1e-6, rtol=1e-6)


@pytest.mark.parametrize(('place', 'way'), [(0.4, 1), (0.5, 1), (0.6, -1)])
def test_the_probe_goes_towards_the_middle(place, way):
    home = np.full(2, place)
    probe = copying((0.0, 0.0), (1.0, 1.0), home)[0]
    np.testing.assert_allclose(probe.waypoints[-1].q, home + way * 1e-6, rtol=0, atol=1e-12)


@pytest.mark.parametrize('side', [1.0, -1.0])
def test_the_probe_of_a_joint_without_limits_goes_towards_zero(side):
    probe = copying((-np.inf, -np.inf), (np.inf, np.inf), side * HOME)[0]
    np.testing.assert_allclose(probe.waypoints[-1].q, side * (HOME - 1e-6), rtol=0, atol=1e-12)


def test_a_robot_that_measures_is_probed_once_and_for_a_moment():
    rig = Rig()
    rig.visitor, rig.spoken = Visitor(LIMITS, RULES), -np.inf
    rig.plan([0.5, 0.5], [0.3, 0.3])
    began = rig.t
    rig.run(10.0, lambda: rig.said(Settled))
    rig.answer(0)
    rig.run(10.0, lambda: len(rig.said(Settled)) == 2)
    assert [d.solution for d in rig.said(Drive)] == [visiting.PROBE, 0, 1]
    sent = [t for t, action in rig.actions if isinstance(action, Drive)]
    assert sent[0] - began < 0.5
    assert 1.0 + visiting.PROBE_WAIT_S < sent[1] - sent[0] < 1.0 + visiting.PROBE_WAIT_S + 0.1


def test_the_probe_that_was_stopped_is_made_again():
    rig = Rig()
    rig.visitor, rig.spoken = Visitor(LIMITS, RULES), -np.inf
    rig.plan([0.5, 0.5])
    rig.run(1.0, lambda: rig.said(Drive))
    rig.state = 'paused'
    rig.run(3.0)
    assert len(rig.said(Stop)) == 1
    rig.state = 'running'
    rig.run(20.0, lambda: rig.said(Settled))
    assert [d.solution for d in rig.said(Drive)] == [visiting.PROBE, visiting.PROBE, 0]


@pytest.mark.parametrize('settle_s', [0.2, 1.0, 3.0])
def test_a_driver_that_begins_to_repeat_commands_later_is_found(settle_s):
    """Switched to open loop in the middle: no such configuration is ever announced as settled."""
    rig = Rig(VisitRules(settle=SettleRules(settle_s=settle_s)))
    rig.plan([0.5, 0.5])
    arrival = rig.t + LIMITS.move(HOME, np.array([0.5, 0.5])).duration_s
    rig.alter = lambda t, q: np.array([0.5, 0.5]) if t > arrival else q
    rig.run(10.0, lambda: rig.said(Halted))
    assert rig.last(Halted).reason.startswith('joint_states repeat what was commanded')
    assert not rig.said(Settled)


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
    visitor = Visitor(LIMITS, RULES)
    assert visitor.report_age_s(5.0) == np.inf
    visitor.report(0.0, HOME, 7.0)
    assert visitor.report_age_s(9.5) == 2.5


# Clocks that jump


@pytest.mark.parametrize('jump', [-3600.0, 3600.0, 5.0, -5.0])
@pytest.mark.parametrize('after', [0.9, 3.6])
def test_a_clock_that_jumps_costs_time_and_nothing_else(rig, jump, after):
    """In the middle of a move, and in the middle of the settling."""
    rig.plan([0.9, -1.9])
    rig.run(after)
    assert not rig.said(Settled)
    rig.stamp_shift = jump
    rig.run(20.0, lambda: rig.said(Settled))
    assert not rig.said(Stop, Failed, Halted)
    assert rig.last(Settled).settle_s >= 1.0
    np.testing.assert_allclose(rig.last(Settled).q, [0.9, -1.9], atol=1e-4)


def test_a_clock_that_jumps_ahead_does_not_use_up_the_wait_for_the_recorder(rig):
    rig.plan([0.5, 0.5])
    rig.run(20.0, lambda: rig.said(Settled))
    rig.stamp_shift = 3600.0
    rig.run(RULES.answer_timeout_s - 2.0)
    assert not rig.said(Failed)
    rig.run(4.0, lambda: rig.said(Failed))


def test_a_clock_that_stands_still_proves_no_standstill(rig):
    rig.plan([0.5, 0.5])
    rig.run(20.0, lambda: rig.said(Settled))
    frozen = rig.t
    rig.answer(0)
    rig.plan([0.1, 0.1])
    assert len(rig.said(Drive)) == 2
    rig.run(5.0, lambda: (setattr(rig, 'stamp_shift', frozen - rig.t), rig.t > frozen + 3)[1])
    assert not rig.said(Settled)[1:]


def test_the_stall_needs_wall_time_too():
    """With a clock twenty times as fast, 1 s of robot time is 50 ms: no time to react."""
    rig = Rig(VisitRules(settle=RULES.settle, arrive_timeout_s=50.0))
    rig.rate = 20.0
    late = []
    rig.obey = lambda waypoints: late.append(waypoints) or ()
    rig.plan([0.5, 0.5])
    rig.run(0.8 * rig.rate * RULES.reaction_s)
    assert not rig.said(Halted)
    assert len(rig.said(Drive)) == 1
    rig.run(0.3 * rig.rate * RULES.reaction_s, lambda: len(rig.said(Drive)) == 2)


# To the bit: times and angles that binary numbers have exactly


EXACT = VisitRules(
    settle=SettleRules(settle_s=1.0, arrive_tolerance=2.0**-8, still_tolerance=2.0**-12),
    arrive_timeout_s=4.0,
    answer_timeout_s=8.0,
    stall_s=2.0,
)
AT = np.array([0.25, 0.5])


class Exact:
    """A visitor that is fed by hand, with a probe behind it and everybody heard."""

    def __init__(self, rules=EXACT):
        self.visitor = Visitor(LIMITS, rules)
        self.t, self.wall, self.said = 64.0, 512.0, []
        self.visitor.planner_says('running', self.wall)
        self.visitor.recorder_says('', self.wall)
        self.visitor.plan(np.array([[0.75, 0.5], [0.5, 0.5]]), self.wall)
        odd, self.drove = np.add(AT, [0.0, 2.0**-20]), []
        for i in range(40):
            if any(isinstance(a, Drive) for a in self.report(0.125, AT if i % 2 else odd)):
                self.drove.append(self.t)
            if [a.solution for a in self.said if isinstance(a, Drive)] == [visiting.PROBE, 0]:
                break
        self.sent = self.t
        self.said.clear()

    def report(self, dt, q, wall_dt=None):
        """Report after dt; everybody else speaks too."""
        self.t, self.wall = self.t + dt, self.wall + (dt if wall_dt is None else wall_dt)
        self.visitor._heard.update(planner=self.wall, recorder=self.wall)
        actions = self.visitor.report(self.t, np.asarray(q, float), self.wall)
        self.said += actions
        return actions


def test_the_first_move_after_the_probe_is_as_fast_as_it_may():
    """And comes with the first report after the second that the probe takes, and half a one."""
    exact = Exact()
    probe, first = exact.drove
    assert first - probe == 1.625
    move = exact.visitor._visit.move
    assert move.duration_s == 1.5
    np.testing.assert_array_equal(move.end, [0.75, 0.5])


@pytest.mark.parametrize(('stood', 'acts'), [(1.875, False), (2.0, True)])
def test_a_stall_lasts_exactly_so_long(stood, acts):
    """Moved to 0.5, and there it stands: at 2 s it is judged, not before."""
    exact = Exact()
    exact.report(0.5, [0.5, 0.5])
    for _ in range(int(stood / 0.125)):
        exact.report(0.125, [0.5, 0.5])
    assert bool(exact.said) == acts


@pytest.mark.parametrize(('wall', 'acts'), [(0.0, False), (2.0**-10, True)])
def test_the_time_to_react_is_more_than_half_a_second(wall, acts):
    exact = Exact()
    for i in range(16):
        exact.report(0.125, [0.5, 0.5] if i else AT, wall_dt=0.03125)
    assert not exact.said
    exact.report(0.25, [0.5, 0.5], wall_dt=wall)
    assert bool(exact.said) == acts


@pytest.mark.parametrize(('beside', 'reason'), [(2.0**-8, ''), (2.0**-7, 'arrived elsewhere')])
def test_at_the_tolerance_of_arrival_it_has_arrived(beside, reason):
    exact = Exact()
    for i in range(40):
        # It creeps a little, so that it never settles, and stands for the stall.
        q = [0.75 - beside, 0.5]
        exact.report(0.125, q if i > 11 else [0.3 + i * 0.02, 0.5])
        if exact.said:
            break
    (first, *_rest) = exact.said
    if reason:
        assert first.reason.startswith(reason)
    else:
        assert isinstance(first, Settled)


def test_an_arm_at_the_tolerance_of_arrival_is_not_stalled():
    rules = VisitRules(settle=SettleRules(4.0, 2.0**-8, 2.0**-12), stall_s=1.0)
    exact = Exact(rules)
    for i in range(60):
        exact.report(0.125, [0.75 - 2.0**-8 if i > 11 else 0.3 + i * 0.02, 0.5])
    assert isinstance(exact.said[0], Settled)


@pytest.mark.parametrize(('off', 'taken'), [(2.0**-8, False), (2.0**-7, True)])
def test_within_the_tolerance_of_its_start_it_has_not_moved(off, taken):
    exact = Exact()
    for _ in range(20):
        exact.report(0.125, np.add(AT, [off, 0.0]))
        if exact.said:
            break
    assert isinstance(exact.said[0], Stop if taken else Drive)


@pytest.mark.parametrize(('stands', 'kind'), [(1.25, Halted), (1.375, Failed)])
def test_from_when_on_standing_is_arriving_elsewhere(stands, kind):
    """The trajectory takes 1.5 s; an eighth of a second before its end is too early."""
    exact = Exact()
    moving = int(stands / 0.125)
    for i in range(1, moving + 20):
        exact.report(0.125, [0.25 + 0.03125 * min(i, moving), 0.5])
        if exact.said:
            break
    assert isinstance(exact.said[1], kind)


def test_a_dropped_command_has_exactly_its_attempts():
    exact = Exact(VisitRules(settle=EXACT.settle, stall_s=1.0, attempts=3))
    for i in range(80):
        exact.report(0.125, np.add(AT, [0.0, 2.0**-20 * (i % 2)]))
    drives = [action for action in exact.said if isinstance(action, Drive)]
    assert len(drives) == 2
    assert len([action for action in exact.said if isinstance(action, Halted)]) == 1


def test_a_stop_gives_all_attempts_back():
    exact = Exact(VisitRules(settle=EXACT.settle, stall_s=1.0))
    exact.visitor.planner_says('paused', exact.wall)
    for _ in range(4):
        exact.visitor.report(exact.t, AT, exact.wall)
        exact.t += 0.125
    exact.visitor.planner_says('running', exact.wall)
    exact.said.clear()
    for i in range(80):
        exact.report(0.125, np.add(AT, [0.0, 2.0**-20 * (i % 2)]))
    assert len([action for action in exact.said if isinstance(action, Drive)]) == 1


@pytest.mark.parametrize(('after', 'fails'), [(0.0, False), (0.125, True)])
def test_the_time_out_of_arriving_is_exact(after, fails):
    """1.5 s of motion, 1 s of settling, 4 s beyond: creeping all the while."""
    exact = Exact()
    for i in range(int((6.5 + after) / 0.125)):
        exact.report(0.125, [0.25 + i * 2.0**-9, 0.5])
    assert any(isinstance(action, Failed) for action in exact.said) == fails


@pytest.mark.parametrize(('after', 'fails'), [(0.0, False), (0.125, True)])
def test_the_time_out_of_the_recorder_is_exact(after, fails):
    exact = Exact()
    target = [0.75, 0.5 - 2.0**-20]
    while not any(isinstance(action, Settled) for action in exact.said):
        exact.report(0.125, target)
    for _ in range(int((8.0 + after) / 0.125)):
        exact.report(0.125, target)
    assert any(isinstance(action, Failed) for action in exact.said) == fails


@pytest.mark.parametrize(('gap', 'stands'), [(0.5, True), (0.625, False)])
def test_half_a_second_between_reports_is_seen_all_along(gap, stands):
    visitor = Visitor(LIMITS, EXACT)
    for wall in (0.0, 0.5):
        visitor.planner_says('running', wall)
        visitor.recorder_says('', wall)
    visitor.plan(np.array([[0.5, 0.5]]), 0.5)
    visitor.report(8.0, AT, 0.5)
    assert bool(visitor.report(8.0 + gap, AT, 0.5)) == stands


@pytest.mark.parametrize(('moved', 'stands'), [(2.0**-12, True), (2.0**-11, False)])
def test_what_counts_as_standing(moved, stands):
    visitor = Visitor(LIMITS, EXACT)
    visitor.planner_says('running', 0.0)
    visitor.recorder_says('', 0.0)
    visitor.plan(np.array([[0.5, 0.5]]), 0.0)
    visitor.report(8.0, AT, 0.0)
    assert bool(visitor.report(8.25, np.add(AT, [moved, 0.0]), 0.0)) == stands


@pytest.mark.parametrize(('passed', 'stands'), [(0.125, False), (0.25, True)])
def test_how_long_an_arm_must_stand_before_it_is_sent(passed, stands):
    visitor = Visitor(LIMITS, EXACT)
    visitor.planner_says('running', 0.0)
    visitor.recorder_says('', 0.0)
    visitor.plan(np.array([[0.5, 0.5]]), 0.0)
    visitor.report(8.0, AT, 0.0)
    assert bool(visitor.report(8.0 + passed, AT, 0.0)) == stands


@pytest.mark.parametrize(('age', 'ahead'), [(0.25, False), (0.375, True)])
def test_from_when_on_a_report_is_old(age, ahead):
    exact = Exact()
    move = exact.visitor._visit.move
    q, _ = move.at(0.75)
    exact.report(0.25, AT)
    exact.report(0.5, q)
    (stop,) = exact.visitor.planner_says('paused', exact.wall + age)
    velocity = (q - AT) / 0.5
    here = LIMITS.stop(q, velocity).q
    there = LIMITS.stop(*move.at(0.75 + age)).q if ahead else here
    np.testing.assert_array_equal(stop.waypoint.q, there)


@pytest.mark.parametrize(('behind', 'follows'), [(0.125, True), (0.1875, False)])
def test_how_far_behind_an_arm_still_follows(behind, follows):
    """A quarter of a second at half a radian a second."""
    exact = Exact()
    move = exact.visitor._visit.move
    for dt in (0.5, 0.5, 0.5, 0.5):
        exact.report(dt, move.end - [behind, 0.0])
    (stop,) = exact.visitor.planner_says('paused', exact.wall + 1.0)
    place = move.end if follows else move.end - [behind, 0.0]
    np.testing.assert_array_equal(stop.waypoint.q, place)


def test_after_a_gap_an_arm_has_no_speed_that_is_known():
    exact = Exact()
    exact.report(0.25, np.add(AT, [0.1, 0.0]))
    exact.report(2.0, np.add(AT, [0.3, 0.0]))
    (stop,) = exact.visitor.planner_says('paused', exact.wall)
    np.testing.assert_array_equal(stop.waypoint.q, np.add(AT, [0.3, 0.0]))


def test_without_a_plan_nothing_is_commanded():
    visitor = Visitor(LIMITS, EXACT)
    visitor.planner_says('running', 0.0)
    visitor.recorder_says('', 0.0)
    for t in (8.0, 8.25, 8.5, 8.75):
        assert visitor.report(t, AT, 0.0) == []
    assert visitor.blocked(0.0) == ''
