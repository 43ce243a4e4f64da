# SPDX-License-Identifier: Apache-2.0
"""The planner's node announces no pose of a plan that was not confirmed, whatever led there."""

import time

import numpy as np
import pytest
from rigs.ros_rig import OWN_DOMAIN

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

import rclpy
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from worlds.simple_cells import write_cell

from remaster_ros.collection.events import BridgeState, Decided, EventRecord, RecorderState
from remaster_ros.nodes.pose_planner import PosePlanner

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]

START = np.deg2rad([5.0, 7.0, 0.0, 112.0, 10.0, 35.0, -20.0])


class Planner:
    """The node in this process; `step` is what its timer does. The test is bridge and recorder."""

    def __init__(self, folder, cell):
        parameters = {
            'cell': cell,
            'session': folder / 'session',
            'optimization_candidates': 4,
            'validation_candidates': 1,
            'registration_candidates': 6,
            'reference_every': 0,
        }
        args = ['--ros-args', '--log-level', 'fatal']
        for name, value in parameters.items():
            args += ['-p', f'{name}:={value}']
        rclpy.init(args=args, domain_id=OWN_DOMAIN)
        self.node = node = PosePlanner()
        node._q = START
        state = RecorderState(waiting_for='', run='')
        node._peers.take(EventRecord(node='/recorder', body=state), time.monotonic())
        node._hindrance = lambda now: ''
        self.announced, self.repeated = [], 0
        node._poses.announce, node._poses.repeat = self._announce, self._repeat

    def _announce(self, stop, plan, status, *, last):
        self.announced.append(stop)
        return f'stamp {len(self.announced)}'

    def _repeat(self, status):
        self.repeated += 1

    def peer(self, body, after_s=0.0, started='first'):
        """Have a record of bridge or recorder, which comes in so much time."""
        record = EventRecord(node=f'/{body.sender}', body=body, started=started)
        self.node._peers.take(record, time.monotonic() + after_s)

    def call(self, what):
        response = getattr(self.node, f'_on_{what}')(Trigger.Request(), Trigger.Response())
        return response.success, response.message

    def step_until(self, condition, what):
        until = time.monotonic() + 30.0
        while not condition():
            assert time.monotonic() < until, what
            # As the executor does: what was planned is taken, and the timer is due.
            for thread in (self.node.progress._planning, self.node._preview._thread):
                thread._background._deliver()
            self.node._step()
            time.sleep(0.005)

    def confirm(self):
        self.step_until(lambda: self.node._preview.shown, 'the page')
        assert self.call('confirm')[0]
        assert self.call('collect') == (True, 'collecting')

    def collect(self):
        """Begin a run without a plan to confirm, and go on until its first pose is announced."""
        self.peer(RecorderState(waiting_for='', run=''))
        self.peer(BridgeState(halted=''))
        assert self.call('collect')[0]
        self.step_until(lambda: self.announced, 'the first pose')

    def services(self):
        """Return the names of the services that confirm a plan."""
        names = {service.service_name for service in self.node.services}
        return {name for name in names if '/remaster/confirm' in name}

    def done(self):
        """Have every solution of the open pose recorded."""
        stop = self.announced[-1]
        self.node.progress.decided = Decided(stop.pose, stop.ids)

    def kill(self):
        """End it without a word; what is written stays as it is."""
        self.node.journal.close()
        self.node.destroy_node()
        rclpy.shutdown()


@pytest.fixture
def begin(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    running = []

    def make(confirm=True):
        cell = write_cell(tmp_path / 'cell.yaml', confirm=confirm)
        running.append(Planner(tmp_path, cell))
        return running[-1]

    yield make
    if rclpy.ok():
        running[-1].kill()


def test_a_pose_that_a_busy_recorder_has_not_taken_is_repeated_and_not_announced_anew(begin):
    planner = begin(confirm=False)
    planner.collect()
    node = planner.node
    stamp = node._announcements.stamp
    planner.peer(BridgeState(halted='', pose=stamp))
    for minute in range(1, 20):
        # What the recorder says is from before the pose, for ever longer.
        planner.peer(RecorderState(waiting_for='', run=''), 60.0 * minute)
        node._step()
    assert len(planner.announced) == 1
    assert node._announcements.stamp == stamp
    assert 1 <= planner.repeated <= 19
    # One that was started anew has nothing of it: what is left is announced anew.
    planner.peer(RecorderState(waiting_for='', run=''), started='second')
    planner.step_until(lambda: len(planner.announced) == 2, 'the pose again')
    assert planner.announced[1].pose == planner.announced[0].pose


def test_a_reported_position_that_is_no_number_does_not_keep_the_planner_from_planning(begin):
    planner = begin(confirm=False)
    planner.collect()
    node = planner.node
    for wrong in (np.nan, np.inf):
        settled = JointState(name=list(node._order.names), position=[wrong, *START[1:]])
        node._on_settled(settled)
        assert 'is no finite number' in node.run.why
        planner.done()
        count = len(planner.announced)
        planner.step_until(lambda count=count: len(planner.announced) > count, 'the next pose')


def test_a_pose_is_announced_only_where_its_own_plan_was_confirmed(begin, tmp_path):
    planner = begin()
    node = planner.node
    done, why = planner.call('collect')
    assert not done
    assert str(tmp_path / 'session.plan.html') in why
    planner.step_until(lambda: node._preview.shown, 'the page')
    done, why = planner.call('collect')
    assert not done
    assert why.endswith('then call /remaster/confirm and /remaster/collect')
    # Even where a run has begun in some other way.
    node.run.collect('token')
    planner.step_until(lambda: node.run.state != 'running', 'the end of that run')
    assert node.run.state == 'paused'
    assert planner.announced == []
    planner.confirm()
    planner.step_until(lambda: planner.announced, 'the first pose')
    assert [stop.split for stop in planner.announced] == ['registration']
    registration, confirming = node._preview.shown, planner.services()
    assert f'/remaster/confirm/plan_{registration}' in confirming
    # The registration leads to another plan, which nobody has seen.
    planner.done()
    node.progress.T_R_N.update(node._tours.rough_places)
    planner.step_until(lambda: node.run.state == 'paused', 'the pause')
    assert 'is not confirmed' in node.run.why
    planner.step_until(lambda: node._preview.shown, 'the page')
    assert node.run.why == planner.call('collect')[1]
    assert len(planner.announced) == 1
    # A request for the plan before, however late, confirms nothing; its service refuses it.
    assert len(planner.services()) == len(confirming) + 1
    response = node._on_confirm(Trigger.Request(), Trigger.Response(), plan=registration)
    assert not response.success
    assert f'plan {registration} is not the one that is next' in response.message
    assert not planner.call('collect')[0]
    planner.confirm()
    planner.step_until(lambda: len(planner.announced) > 1, 'the first pose to fit')
    assert planner.announced[1].split in ('optimization', 'validation')
    # Paused, the plan is the same.
    assert planner.call('pause')[0]
    assert planner.call('collect') == (True, 'collecting')
    planner.node._step()
    assert planner.node.journal.state == 'running'
    planner.kill()

    # Killed and started again while it ran: it neither goes on nor takes the old confirmation.
    again = begin()
    assert again.node.run.left == ''
    for _ in range(3):
        again.node._step()
    assert again.node.run.state != 'running'
    assert not again.call('collect')[0]
    again.node.run.collect('token')
    again.step_until(lambda: again.node.run.state == 'paused', 'the end of that run')
    assert again.announced == []
    again.confirm()
    again.step_until(lambda: again.announced, 'what is left of the pose')
    assert again.announced[0].pose == planner.announced[1].pose


def test_without_the_key_it_collects_as_before(begin, tmp_path):
    planner = begin(confirm=False)
    assert planner.call('collect') == (True, 'collecting')
    planner.step_until(lambda: planner.announced, 'the first pose')
    done, why = planner.call('confirm')
    assert not done
    assert 'confirm: true' in why
    assert not (tmp_path / 'session.plan.html').exists()
