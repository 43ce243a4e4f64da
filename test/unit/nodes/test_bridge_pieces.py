# SPDX-License-Identifier: Apache-2.0
"""Moves in pieces between the real bridge and a controller, by its topic and by its action."""

import copy
import threading
import time
from collections import deque

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from bridge_places import AWAY
from bridge_rig import HOME
from std_msgs.msg import String
from test_bridge_action import ActionRig

from remaster_ros.collection.events import ArmStopped, SolutionFailed
from remaster_ros.motion.joint_units import TURNING
from remaster_ros.motion.motion_gate import NO_STAMPS
from remaster_ros.motion.spline import Spline
from remaster_ros.nodes import controller_link
from remaster_ros.session.bridge_files import LastCommandFile

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]

PIECES = {'horizon_s': 1.6, 'speed_share': 0.1}
STANDS_RAD_S = 1e-3


@pytest.fixture(params=['topic', 'action'])
def pieces(request, rig, monkeypatch, tmp_path):
    """Return a function that makes a rig, of a controller by its topic or by its action."""
    made = []

    def make(**options):
        if request.param == 'topic':
            return rig(**PIECES, **options)
        made.append(ActionRig(monkeypatch, tmp_path, **PIECES, **options))
        return made[-1].ready()

    yield make
    for made_rig in made:
        made_rig.close()


def on_one_clock(r):
    """Let the bridge learn that the stamps of joint_states are of its own clock."""
    r.bridge.now_s = lambda: r.wall
    r.bridge.supervisor.reports.forget()
    r.run(2.0)


@pytest.mark.parametrize('stamps', ['kept', 'ignored'])
def test_a_long_move_comes_in_pieces_and_ends_where_it_was_to(pieces, stamps):
    r = pieces(trajectory_stamps=stamps)
    r.arm.keeps_stamps = stamps == 'kept'
    on_one_clock(r)
    r.plan(AWAY)
    r.run(30.0, lambda: r.settled)
    np.testing.assert_allclose(r.settled[0].position, AWAY, atol=1e-4)
    assert not r.halted()
    assert r.bridge.counts['commanded'] == 1
    assert r.bridge.counts['stopped'] == 0
    sent = [command for command in r.commands if np.max(np.abs(command.q - HOME)) > 1e-4]
    assert len(sent) > (4 if stamps == 'kept' else 2)
    assert all((command.begins_s is not None) == (stamps == 'kept') for command in sent)
    for command in sent:
        assert command.end_s - command.arrival_s <= 1.6 + 0.15
        assert np.all(command.v[-1] == 0.0)
    if isinstance(r, ActionRig):
        assert r.controller.cancelled == 0
    off = np.array([q for _, q, _ in r.arm.history])[:, 1:] - HOME[1:]
    assert np.max(np.abs(off)) <= 1e-4, 'the arm left its line'


def motion_left_s(arm, now_s):
    """Return how long the arm goes on by what its controller has, s."""
    arm_copy = copy.copy(arm)
    arm_copy.history, arm_copy.lock = deque(arm.history), threading.RLock()
    last_s = now_s
    for t in np.arange(now_s, now_s + 5.0, 0.01):
        arm_copy.advance(t)
        last_s = t if arm_copy.speed() > STANDS_RAD_S else last_s
    return last_s - now_s


@pytest.mark.parametrize('stamps', ['kept', 'ignored'])
def test_a_bridge_that_ends_at_any_moment_leaves_two_seconds_of_motion(pieces, stamps):
    """At twenty moments: nothing comes any more, and nothing is cancelled."""
    r = pieces(trajectory_stamps=stamps)
    r.arm.keeps_stamps = stamps == 'kept'
    on_one_clock(r)
    r.plan(AWAY)
    r.run(20.0, lambda: r.arm.speed() > STANDS_RAD_S)
    left_s = []
    while len(left_s) < 20:
        left_s.append(motion_left_s(r.arm, r.wall))
        r.run(0.2)
    print(f'{stamps}: {np.round(left_s, 2).tolist()} s')
    assert 1.0 < max(left_s) <= 2.0
    r.run(30.0, lambda: r.settled)
    assert r.bridge.counts['commanded'] == 1


@pytest.mark.parametrize('stamps', ['kept', 'ignored'])
def test_a_bridge_that_is_gone_leaves_an_arm_that_stands_soon_where_the_next_one_expects_it(
    rig, stamps
):
    r = rig(**PIECES, trajectory_stamps=stamps)
    r.arm.keeps_stamps = stamps == 'kept'
    on_one_clock(r)
    r.plan(AWAY)
    r.run(20.0, lambda: r.arm.q[0] > 0.1)
    r.arm.advance(r.wall + 2.0)
    assert r.arm.speed() < STANDS_RAD_S
    assert r.arm.q[0] < AWAY[0] - 0.05
    # It is written beside the callbacks.
    end = time.monotonic() + 20.0
    file = LastCommandFile('/robot_bridge', r.names)
    led = r.bridge.supervisor.end
    while not np.array_equal(file.read(r.time_ns()).end, led) and time.monotonic() < end:
        time.sleep(0.01)
    low, high = (place[0] for place in file.read(r.time_ns()).places)
    assert low - 2e-3 <= r.arm.q[0] <= high + 2e-3
    # Before the nodes end nothing is under way.
    r.wall += 2.0
    r.say_planner('paused')
    r.run(3.0)


def bent(seed=5):
    """Return configurations about HOME for a curve, (9, k), and their shares."""
    print(f'seed {seed}')
    points = HOME + 0.1 * np.random.default_rng(seed).normal(size=(9, 7))
    return np.vstack((HOME, points[1:])), np.linspace(0.0, 1.0, 9)


def off_curve(r, points, shares, since=0):
    """Largest distance of the arm from the curve, rad, from a row of its history on."""
    curve = Spline.through(points, shares)
    been = np.array([q for _, q, _ in r.arm.history])[since:]
    return np.max(np.abs(been - curve.at(curve.nearest(been, TURNING))))


def test_a_curve_is_gone_in_pieces_and_a_stop_stays_on_it(pieces):
    """By the topic and by the action; what is left of it is a line to its end."""
    points, shares = bent()
    r = pieces(trajectory_stamps='kept')
    on_one_clock(r)
    r.plan_curve(points, shares)
    r.run(60.0, lambda: r.settled)
    np.testing.assert_allclose(r.settled[0].position, points[-1], atol=1e-4)
    assert off_curve(r, points, shares) < 0.01
    count = len(r.commands)
    assert count > 10
    # Back, and stopped on its way.
    back = points[::-1]
    began = len(r.arm.history)
    r.plan_curve(back, shares)
    r.run(20.0, lambda: r.arm.speed() > 0.05)
    r.run(2.0)
    r.say_planner('paused')
    r.run(1.5)
    assert [stop.reason for stop in r.named(ArmStopped)] == ['planner is paused']
    assert r.arm.speed() < STANDS_RAD_S
    assert off_curve(r, back, shares, began) < 0.01
    assert np.max(np.abs(r.arm.q - back[-1])) > 0.05
    assert not r.halted()
    if isinstance(r, ActionRig):
        assert r.controller.cancelled == 0
    r.say_planner('running')
    r.run(60.0, lambda: len(r.settled) == 2)
    np.testing.assert_allclose(r.settled[1].position, back[-1], atol=1e-4)


def test_an_emergency_stop_on_a_curve_halts(pieces):
    points, shares = bent()
    r = pieces(trajectory_stamps='kept')
    on_one_clock(r)
    r.plan_curve(points, shares)
    r.run(20.0, lambda: r.arm.speed() > 0.05)
    r.arm.stop_by_brakes(r.wall)
    r.run(3.0, r.halted)
    sent = r.bridge.published
    r.run(2.0)
    assert r.bridge.published == sent
    if isinstance(r, ActionRig):
        assert r.controller.cancelled == 1


def test_a_controller_without_stamps_gets_no_curve(pieces):
    points, shares = bent()
    r = pieces(trajectory_stamps='ignored')
    on_one_clock(r)
    r.plan_curve(points, shares)
    r.run(3.0)
    assert not r.settled
    assert not r.moves()
    (failed,) = r.named(SolutionFailed)
    assert NO_STAMPS in failed.reason


def test_a_controller_is_known_by_its_state(rig, monkeypatch):
    monkeypatch.setattr(controller_link, 'STATE_TYPE', 'std_msgs/msg/String')
    r = rig(horizon_s=1.6)
    assert not r.bridge._keeps_stamps()
    r.peer.create_publisher(String, 'joint_trajectory_controller/controller_state', 10)
    r.wait(r.bridge._keeps_stamps, 'the publisher')


def test_whole_moves_are_sent_where_they_are_asked_for(rig):
    r = rig(horizon_s=0.0, speed_share=0.1)
    r.plan(AWAY)
    r.run(30.0, lambda: r.settled)
    (move,) = r.moves()
    assert move.end_s - move.arrival_s > 3.0


def test_stamps_of_another_clock_are_not_used(rig):
    """Of another host, or late from the start: which is not known."""
    r = rig(**PIECES, trajectory_stamps='kept')
    r.plan(AWAY)
    r.run(30.0, lambda: r.settled)
    assert all(command.begins_s is None for command in r.commands)
    assert len(r.commands) > 3
