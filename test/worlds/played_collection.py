# SPDX-License-Identifier: Apache-2.0
"""A collection of events alone, for the live page: no ROS, no devices."""

import time

import numpy as np

from remaster_ros.collection import events
from remaster_ros.kinematics.transforms import apply, inverse, matrix_from_rpy, transform
from remaster_ros.reports.live_view import FitFacts, LiveView
from remaster_ros.session.cells.workcell import read_cell

CELL = read_cell('demo')
CHAIN = CELL.chain()
MARKERS = {
    name: {marker: np.array(CELL.markers[marker]) for marker in sensor.markers}
    for name, sensor in CELL.sensors.items()
}
T_R_N = transform(matrix_from_rpy(np.array([0.0, 0.1, 2.5])), np.array([1.9, 0.0, 1.2]))
PER_POSE = 4


class PlayedCollection:
    """What the nodes would publish, into a view; `command` is what their services do."""

    def __init__(self, of=40, seed=0):
        print('seed', seed)
        self.view = LiveView(CHAIN, MARKERS)
        self.rng, self.of, self.done = np.random.default_rng(seed), of, 0
        self.state, self.halted, self.why, self.changed = 'idle', '', '', ''
        # A plan that waits for a person, and the one that was confirmed.
        self.plan, self.confirmed = '', ''
        self.commands = []
        self.q = np.zeros(len(CHAIN))

    def command(self, name, done):
        """Answer as the services do."""
        self.commands.append(name)
        if name == 'collect' and self.halted:
            done(False, f'the arm is halted: {self.halted}')
            return
        if name.startswith('confirm/'):
            self.confirmed = name.removeprefix('confirm/')
        self.state = {'collect': 'running', 'pause': 'paused', 'stop': 'stopped'}.get(
            name, self.state
        )
        if name == 'fit':
            self.view.take_offsets(
                {n: 0.001 * i for i, n in enumerate(CHAIN.joint_names)},
                dict.fromkeys(CHAIN.joint_names, 1e-5),
            )
            shown = {'mean error, held-out poses': '1.234 mm → 0.123 mm'}
            self.view.take_fit(FitFacts(shown, frozenset({'joint_1'})))
        done(True, f'{name} done')

    def beat(self, now=None, phase='collection'):
        """Let every node report its state."""
        now = time.monotonic() if now is None else now
        for name in ('robot_bridge', 'recorder', 'optimizer'):
            self.view.take_summary(name, 'ok', 'waiting', {}, now)
        values = {
            'phase': phase,
            'configurations_done': str(self.done),
            'configurations': str(self.of),
            'poses_done': str(self.done // PER_POSE),
            'poses': str(self.of // PER_POSE),
        }
        if self.plan:
            values |= {'plan_page': '/elsewhere/s.plan.html', 'plan_shown': self.plan}
            values['confirmed'] = 'yes' if self.plan == self.confirmed else 'no'
        self.view.take(events.PlannerState(state=self.state, run='r'), now)
        self.view.take_summary('pose_planner', 'ok', self.why or self.state, values, now)
        self.view.take(events.BridgeState(halted=self.halted), now)
        self.view.take(
            events.RecorderState(
                waiting_for='',
                observations=self.done,
                changed=self.changed,
                read_age_s={'mocap': 0.1, 'tracker': None},
            ),
            now,
        )
        self.view.take(events.SensorReport(sensor='mocap', ready=True), now)
        report = events.SensorReport(sensor='tracker', ready=False, trouble='the beam is broken')
        self.view.take(report, now)

    def step(self, now=None, result='recorded', phase='collection'):
        """Visit one configuration, where the collection runs; then the nodes report."""
        now = time.monotonic() if now is None else now
        self.beat(now, phase)
        if self.state == 'running' and self.done < self.of:
            index = self.done % PER_POSE
            self.stamp = f'{self.done - index}.0'
            before, self.q = self.q, self.rng.uniform(-1.5, 1.5, len(CHAIN))
            self.view.take_target(CHAIN.forward(self.q))
            self.view.take_way(np.array([before, self.q]))
            self.view.take_joints(self.q)
            self.view.take_registration('mocap', T_R_N)
            self.view.take(events.SolutionSettled(stamp=self.stamp, solution=index), now)
            read = apply(inverse(T_R_N), CHAIN.positions(self.q, MARKERS['mocap']['sir']))
            self.view.residuals.reading('mocap', 'sir', read + self.rng.normal(0.0, 1e-4, 3))
            ended = events.ConfigurationEnded(stamp=self.stamp, solution=index, result=result)
            self.view.take(ended, now)
            self.done += 1
            if self.done == self.of:
                self.state = 'complete'
        self.beat(now, phase)
