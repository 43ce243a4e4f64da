# SPDX-License-Identifier: Apache-2.0
"""The supervisor with an arm in stepped time: a servo that lags and overshoots behind cubics."""

import copy
import dataclasses
from functools import cache

import numpy as np

from remaster_ros.motion.actions import (
    CheckPath,
    Drive,
    Halted,
    PathAnswer,
    Renew,
    Settled,
    Stop,
    SupervisorRules,
)
from remaster_ros.motion.arm_supervisor import ArmSupervisor
from remaster_ros.motion.joint_reports import JointReport, JointReports
from remaster_ros.motion.joint_units import TURNING
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import Cubic, MotionGate
from remaster_ros.motion.move_queue import PROBE
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.settling import SettleRules
from remaster_ros.motion.spline import BEGINS_RAD, Spline
from remaster_ros.motion.states import Arm
from remaster_ros.motion.trajectory import Waypoint
from remaster_ros.simulation import arm_motion as servo

SPEED = np.array([0.5, 1.0])
LIMITS = MotionLimits(
    ('a', 'b'), np.array([-1.0, -2.0]), np.array([1.0, 2.0]), SPEED, np.array([5.0, 5.0])
)
RULES = SupervisorRules(
    settle=SettleRules(settle_s=1.0), arrive_timeout_s=5.0, answer_timeout_s=20.0
)
HOME = np.array([0.1, 0.2])
ASKED = 'the arm is not reported where the last command led: '
STOPPED = 'the robot stopped on its way: an emergency or protective stop?'
NOT_TAKEN = 'the robot does not take commands: see its controller, and its driver'


class Rig:
    """The supervisor with everybody alive, at 50 Hz.

    `alter` changes what the arm reports, `obey` what becomes of a trajectory, `answer_path` what
    is found out about a path, `delay_s` how long a report takes, `stop_s` a stop to the arm.

    With `units` of joints that slide the supervisor has metres for the radians that the rig and
    its arm count in, a quarter of them; all of the rig is in radians.
    """

    def __init__(
        self, rules=RULES, wall_s=1000.0, begun=True, halted='', rate=1.0, end=HOME, units=TURNING
    ):
        self.unit = unit = units.per_radian
        ways = {
            name: getattr(LIMITS, name) * unit
            for name in ('lower', 'upper', 'velocity', 'acceleration')
        }
        limits = dataclasses.replace(LIMITS, units=units, **ways)
        rules = dataclasses.replace(rules, settle=dataclasses.replace(rules.settle, units=units))
        # The robot itself may be three times as fast.
        reports = JointReports(limits.lower, limits.upper, 3 * SPEED * unit, units)
        # By default it is known from before where the last command led.
        end = None if end is None else end * unit
        self.supervisor = ArmSupervisor(MotionGate(limits), reports, rules, halted, end)
        self.t, self.wall = 50.0, wall_s
        self.arm = servo.Motion(self.t, HOME)
        self.rng = np.random.default_rng(2)
        self.alive = {'planner', 'recorder', 'robot', 'bridge'}
        self.state, self.waiting_for = 'running', ''
        self.actions, self.commands = [], []
        self.obey = lambda waypoints: waypoints
        self.alter = lambda t, q: q
        self.answer_path = self._free
        self.delay_s = self.stamp_shift = self.stop_s = 0.0
        self.on_its_way = None
        self.rate = rate
        self.told_wall = -np.inf
        self.told_state, self.runs = '', 0
        self.under_way = []
        if not begun:
            return
        # The first move is the probe; then the arm settles where it stands.
        self.plan(HOME)
        self.settles()
        self.answer(0)
        self.actions.clear()
        self.commands.clear()

    @staticmethod
    def _free(request):
        if len(request.shares):
            return PathAnswer(curved(request))
        points = np.vstack([request.start, request.waypoints, request.target])
        return PathAnswer(FreePath(points))

    def do(self, actions):
        for action in actions:
            self.actions.append((self.t, action))
            if isinstance(action, CheckPath):
                answer = self._answered(action)
                if answer is not None:
                    self.do(self.supervisor.path_found(action.number, answer, self.wall))
            elif isinstance(action, Drive | Renew | Stop):
                points = self.obey(
                    tuple(
                        dataclasses.replace(p, q=p.q / self.unit, velocity=p.velocity / self.unit)
                        for p in action.admitted.waypoints
                    )
                )
                if isinstance(action, Stop) and self.stop_s:
                    self.on_its_way = self.t + self.stop_s, points
                else:
                    self._command(points, getattr(action, 'begins_s', 0.0) or None)

    def _answered(self, request):
        """Ask for a path in radians, and give it in the units of the supervisor."""
        ways = {
            name: getattr(request, name) / self.unit for name in ('start', 'target', 'waypoints')
        }
        answer = self.answer_path(dataclasses.replace(request, **ways))
        if answer is None:
            return None
        paths = {
            name: dataclasses.replace(path, points=path.points * self.unit)
            for name in ('path', 'way_out')
            if (path := getattr(answer, name)) is not None
        }
        return dataclasses.replace(answer, **paths)

    def _command(self, points, begins_s=None):
        if not points:
            return
        q, velocity = self.arm.at(self.t)
        self.commands.append((self.t, q, velocity, points))
        servo_points = [servo.ServoPoint(p.time_s, p.q, p.velocity) for p in points]
        self.arm.follow(self.t, *servo.from_now(self.t, begins_s, servo_points))

    def cubics(self):
        """What the controller makes of each command, from where the arm really is."""
        for _, q, velocity, points in self.commands:
            before = Waypoint(0.0, q, velocity)
            for point in points:
                yield Cubic.between(before, point)
                before = point

    def step(self, dt=0.02):
        self.t, self.wall = self.t + dt, self.wall + dt / self.rate
        if self.on_its_way is not None and self.t >= self.on_its_way[0]:
            (_, points), self.on_its_way = self.on_its_way, None
            self._command(points)
        self.under_way.append((self.t, self.alter(self.t, self.noisy())))
        if 'bridge' not in self.alive:
            return
        if self.wall - self.told_wall >= 0.5:
            self.told_wall = self.wall
            if 'planner' in self.alive:
                self.do(self.supervisor.planner_is(self.state, self.wall, self.token()))
            if 'recorder' in self.alive:
                self.do(self.supervisor.recorder_waits(self.waiting_for, self.wall))
        while self.under_way and self.under_way[0][0] <= self.t - self.delay_s + 1e-9:
            stamp, q = self.under_way.pop(0)
            if 'robot' in self.alive and q is not None:
                q = np.asarray(q) * self.unit
                self.do(
                    self.supervisor.report(
                        JointReport(stamp + self.stamp_shift, q, self.t, self.wall)
                    )
                )
        self.do(self.supervisor.tick(self.wall))

    def token(self):
        """As the planner's: another one for each /remaster/collect, none while it does not run."""
        if self.state == 'running' and self.told_state != 'running':
            self.runs += 1
        self.told_state = self.state
        return f'run {self.runs}' if self.state == 'running' else ''

    def noisy(self):
        # No encoder reads the same twice.
        return self.arm.at(self.t)[0] + self.rng.normal(0.0, 1e-6, 2)

    def run(self, seconds, until=None):
        end = self.t + seconds
        while self.t < end:
            self.step()
            if until is not None and until():
                return
        assert until is None, f'waited {seconds} s in vain'

    def settles(self, count=1):
        """Wait until it has settled so often."""
        self.run(60.0, lambda: len(self.said(Settled)) >= count)

    def visit(self, *solutions, **how):
        """Send the arm to solutions of a pose, and let it settle at the first."""
        self.plan(*solutions, **how)
        self.settles()

    def collects_nothing(self):
        self.state = 'idle'
        self.run(1.0)

    def halts(self, within_s=20.0):
        """Wait for the halt; return its reason."""
        self.run(within_s, lambda: self.said(Halted))
        return self.last(Halted).reason

    def pause(self):
        """Have the planner tell at once that it is paused."""
        self.state = 'paused'
        self.do(self.supervisor.planner_is('paused', self.wall))

    def plan(self, *solutions, waypoints=None, shares=None):
        targets = np.reshape(np.array(solutions, float), (-1, 2)) * self.unit
        between = {number: way * self.unit for number, way in (waypoints or {}).items()}
        self.do(self.supervisor.plan(targets, self.wall, between, shares=shares or {}))

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

    def freeze(self):
        """The safety circuit stops the arm where it is."""
        self.arm = servo.Motion(self.t, self.arm.at(self.t)[0])

    def answer(self, solution):
        self.do(self.supervisor.answered(solution, self.wall))

    def clear(self):
        """Clear the halt as a person does who has compared the robot's display, where asked."""
        asked = self.supervisor.clear_halt()
        assert not asked or ASKED in asked
        if asked:
            assert self.supervisor.halted
            assert self.supervisor.clear_halt() == ''
        assert self.supervisor.halted == ''

    def collect(self):
        """What a person does after a halt."""
        self.clear()
        self.state = 'paused'
        self.run(1.0)
        self.state = 'running'
        self.run(1.0)


def curved(request):
    """Return the path of a request with shares, as the bridge's path search makes it."""
    if np.max(np.abs(request.start - request.waypoints[0])) > BEGINS_RAD:
        return FreePath(np.array([request.start, request.target]))
    points = np.vstack([request.start, request.waypoints[1:], request.target])
    return along(Spline.through(points, np.append(request.shares, 1.0)))


def along(spline):
    """Return a spline as a path that was found free."""
    return FreePath(spline.samples[1], curve=spline)


@cache
def _begun():
    return Rig()


def begun():
    """Return a rig that is ready, and the test's own."""
    return copy.deepcopy(_begun())


def supervisor(rules=RULES, limits=LIMITS, end=None):
    """Return one that is fed by hand."""
    reports = JointReports(limits.lower, limits.upper, 3 * SPEED)
    return ArmSupervisor(MotionGate(limits), reports, rules, end=end)


def report(t, q, wall):
    return JointReport(t, np.asarray(q, float), t, wall)


def halted(rig, reason, within_s=5.0):
    """Wait for the halt; nothing is commanded with it or after it, whatever happens."""
    commands = len(rig.commands)
    assert rig.halts(within_s) == rig.supervisor.halted == reason
    assert rig.supervisor.blocked(rig.wall) == reason
    stays_halted(rig, reason)
    assert len(rig.commands) == commands
    assert not rig.supervisor.busy


def stays_halted(rig, reason, times=1):
    """Neither plans nor a planner that pauses and runs again end a halt that was told so often."""
    commands = len(rig.commands)
    rig.plan([0.2, 0.1], [0.3, 0.1])
    rig.state = 'paused'
    rig.run(2.0)
    rig.state = 'running'
    rig.run(2.0)
    rig.answer(0)
    assert rig.supervisor.halted == reason
    assert len(rig.said(Halted)) == times
    assert len(rig.commands) == commands


def goes_on(rig):
    """Only a person's word and a collection that is begun again let it go on, by a probe."""
    commands = len(rig.commands)
    rig.clear()
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
    rig.run(30.0, lambda: rig.supervisor.state is Arm.MEASURES)
    np.testing.assert_allclose(rig.last(Settled).q, [0.2, 0.1], atol=1e-4)


def restless(rig, which=range(99)):
    """Report the arm trembling by a milliradian where it is sent to one of these."""

    def alter(t, q):
        last = rig.said(Drive)
        busy = rig.supervisor.busy and last and last[-1].solution in which
        return np.add(q, [1e-3 * np.sin(20 * t) * bool(busy), 0.0])

    return alter
