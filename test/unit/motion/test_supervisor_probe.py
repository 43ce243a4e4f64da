# SPDX-License-Identifier: Apache-2.0
"""The probe: is an arm commanded as measured, or does its driver repeat commands?"""

import numpy as np
import pytest
from supervisor_rig import HOME, LIMITS, SPEED, Rig, report, supervisor

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
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_under_way import PROBE_WAIT_S
from remaster_ros.motion.move_queue import PROBE
from remaster_ros.motion.settling import SettleRules
from remaster_ros.motion.trajectory import Line


def copying(low=(-1.0, -2.0), high=(1.0, 2.0), home=HOME):
    """Return what is done with a robot that reports what it was commanded."""
    limits = MotionLimits(('a', 'b'), np.array(low), np.array(high), SPEED, LIMITS.acceleration)
    arm = supervisor(limits=limits, end=home)
    arm.planner_is('running', 0.0)
    arm.recorder_waits('', 0.0)
    arm.plan(np.array([[0.5, 0.5]]), 0.0)
    actions, q, t = [], home, 0.0
    while t < 40.0 and not any(isinstance(action, Halted) for action in actions):
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
    (end,) = probe.admitted.waypoints
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
    rig.settles()
    rig.answer(0)
    rig.settles(2)
    assert [d.solution for d in rig.said(Drive)] == [PROBE, 0, 1]
    sent = [t for t, action in rig.actions if isinstance(action, Drive)]
    assert sent[0] - start < 0.6
    assert 1.0 + PROBE_WAIT_S < sent[1] - sent[0] < 1.0 + PROBE_WAIT_S + 0.1


def test_the_probe_that_was_stopped_is_made_again():
    rig = begun()
    rig.run(1.0, lambda: rig.said(Drive))
    rig.state = 'paused'
    rig.run(3.0)
    # It needs no stop: that would be fast for an arm that is not where it is reported.
    assert not rig.said(Stop)
    rig.state = 'running'
    rig.settles()
    assert [d.solution for d in rig.said(Drive)] == [PROBE, PROBE, 0]


@pytest.mark.parametrize('settle_s', [0.2, 1.0, 3.0])
def test_a_driver_that_begins_to_repeat_commands_later_is_found(settle_s):
    """Switched to open loop in the middle: no such configuration is ever announced as settled."""
    rig = Rig(SupervisorRules(settle=SettleRules(settle_s=settle_s)))
    rig.plan([0.5, 0.5])
    arrival = rig.t + Line.within(LIMITS, HOME, np.array([0.5, 0.5])).duration_s
    rig.alter = lambda t, q: np.array([0.5, 0.5]) if t > arrival else q
    assert rig.halts(10.0).startswith('joint_states repeat what was commanded')
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
