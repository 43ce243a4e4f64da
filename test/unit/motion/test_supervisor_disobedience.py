"""The supervisor and an arm that does not do what it is told, or is moved by somebody else."""

import dataclasses

import numpy as np
import pytest
from supervisor_rig import (
    NOT_TAKEN,
    goes_on,
    halted,
    stays_halted,
)

from remaster_ros.motion.actions import (
    Drive,
    Failed,
    Halted,
    Settled,
    Stop,
)

# Commands that are not obeyed


def test_a_robot_that_takes_no_command(rig):
    rig.obey = lambda waypoints: ()
    rig.plan([0.5, 0.5])
    halted(rig, NOT_TAKEN, 20.0)
    assert len(rig.said(Drive)) == 1
    rig.obey = lambda waypoints: waypoints
    goes_on(rig)


def test_a_robot_that_is_slower_than_it_was_told(rig):
    rig.obey = lambda waypoints: [
        dataclasses.replace(p, time_s=2 * p.time_s, velocity=p.velocity / 2) for p in waypoints
    ]
    rig.plan([0.9, -1.0])
    rig.run(20.0, lambda: rig.said(Halted))
    reason = rig.last(Halted).reason
    assert reason.startswith('the robot does not follow its path: 0.')
    assert reason.endswith(
        's behind it; is its speed override below 100 %, or do joint_states come late?'
    )
    assert not rig.said(Stop)


@pytest.mark.parametrize('lag', [0.05, 0.15, 0.25])
def test_a_robot_that_lags_is_waited_for(rig, lag):
    """The command comes later to the robot than it was sent."""
    rig.obey = lambda waypoints: [
        dataclasses.replace(
            waypoints[0], time_s=lag, q=rig.arm.at(rig.t)[0], velocity=np.zeros(2)
        ),
        *(dataclasses.replace(p, time_s=lag + p.time_s) for p in waypoints),
    ]
    rig.plan([0.9, -1.0], [-0.9, 1.0])
    rig.run(20.0, lambda: rig.said(Settled))
    rig.answer(0)
    rig.run(20.0, lambda: len(rig.said(Settled)) == 2)
    assert not rig.said(Stop, Failed, Halted)


def test_a_robot_that_leaves_its_path(rig):
    rig.obey = lambda waypoints: [
        dataclasses.replace(p, q=np.add(p.q, [0.0, 0.2 * (i == 0)]))
        for i, p in enumerate(waypoints)
    ]
    rig.plan([0.9, -0.5])
    rig.run(20.0, lambda: rig.said(Halted))
    assert rig.last(Halted).reason.startswith('the robot does not follow its path: ')
    assert rig.last(Halted).reason.endswith(' deg beside it')
    assert not rig.said(Stop)


def test_a_stop_that_is_not_obeyed(rig):
    """The controller goes on along the old trajectory."""
    rig.go([0.9, -1.9])
    rig.obey = lambda waypoints: ()
    rig.state = 'paused'
    rig.run(5.0, lambda: rig.said(Halted))
    assert len(rig.said(Stop)) == 1
    reason = rig.last(Halted).reason
    assert 'rad from where its stop led' in reason or reason == 'the arm goes on after a stop'
    stays_halted(rig, rig.last(Halted).reason)


def test_an_arm_that_never_stands_after_a_stop(rig):
    rig.go([0.9, -1.9])
    rig.state = 'paused'
    rig.run(0.5)
    rig.alter = lambda t, q: np.add(q, [0.01 * np.sin(8 * t), 0.0])
    rig.run(5.0, lambda: rig.said(Halted))
    assert rig.last(Halted).reason == 'the arm goes on after a stop'
    assert len(rig.said(Stop)) == 1


def test_an_arm_that_is_moved_by_somebody_else_while_it_is_measured(rig):
    rig.plan([0.3, 0.0])
    rig.run(20.0, lambda: rig.said(Settled))
    begun = rig.t
    rig.alter = lambda t, q: np.add(q, [min(0.05 * (t - begun), 0.1), 0.0])
    rig.run(5.0, lambda: rig.said(Halted))
    # 0.02 rad are 1.146 deg; it moves by 0.06 deg between two reports.
    assert rig.last(Halted).reason in (
        'the arm was moved by 1.1 deg, and not by a command',
        'the arm was moved by 1.2 deg, and not by a command',
    )
    assert not rig.said(Stop)


def test_an_arm_that_is_touched_while_it_is_measured_is_not_halted(rig):
    rig.plan([0.3, 0.0])
    rig.run(20.0, lambda: rig.said(Settled))
    rig.alter = lambda t, q: np.add(q, [0.015, 0.0])
    rig.run(5.0)
    assert not rig.said(Halted)


@pytest.mark.parametrize('beside', [[0.0025, 0.0], [0.0, -0.018]])
def test_an_arm_that_stands_beside_its_target_is_halted(rig, beside):
    """An emergency stop in the last moment of a move looks like this."""
    sent = rig.t
    rig.alter = lambda t, q: q + np.array(beside) * np.clip((t - sent) / 2, 0, 1)
    rig.plan([0.5, 0.5], [0.2, 0.2])
    rig.run(20.0, lambda: rig.said(Halted))
    off = f'{np.max(np.abs(beside)):.4f} rad from its target'
    assert rig.last(Halted).reason.startswith(f'the robot stands {off}')
    assert not rig.said(Stop, Failed, Settled)
    assert len(rig.said(Drive)) == 1
