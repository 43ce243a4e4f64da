# SPDX-License-Identifier: Apache-2.0
"""Ways to the solutions: asked for, answered late, to another pose, or not at all."""

import numpy as np
import pytest
from supervisor_rig import HOME, Rig

from remaster_ros.motion.actions import CheckPath, Drive, Failed, Halted, PathAnswer
from remaster_ros.motion.move_queue import PROBE
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.states import Arm


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
    rig.settles()


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
    assert rig.supervisor.state is Arm.MOVES


def test_the_way_to_the_next_solution_goes_through_its_own_waypoints(rig):
    rig.visit([0.3, 0.0], [0.4, 0.0], waypoints={1: np.array([[0.2, 0.4], [0.3, 0.4]])})
    rig.answer(0)
    first, second = rig.said(CheckPath)
    assert first.waypoints.shape == (0, 2)
    np.testing.assert_array_equal(second.waypoints, [[0.2, 0.4], [0.3, 0.4]])
    rig.settles(2)
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
    rig.alter = lambda t, q: np.add(q, [-1.5e-3, 0.0])
    rig.run(1.0)
    rig.plan([0.3, 0.0])
    (check,) = rig.said(CheckPath)
    rig.alter = lambda t, q: np.add(q, [1.5e-3, 0.0])
    rig.run(1.0)
    assert rig.supervisor.path_found(check.number, Rig._free(check), rig.wall) == []
    rig.answer_path = Rig._free
    rig.run(0.1)
    assert len(rig.said(CheckPath)) == 2
    np.testing.assert_allclose(rig.last(CheckPath).start, np.add(HOME, [1.5e-3, 0.0]), atol=1e-4)
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
    rig.run(3.0)
    assert [d.solution for d in rig.said(Drive) if d.solution != PROBE] == [0]


def test_a_place_that_the_arm_has_left_since_is_looked_at_again():
    rig = Rig(begun=False)
    rig.answer_path = lambda request: None
    rig.alter = lambda t, q: np.add(q, [-1.5e-3, 0.0])
    rig.plan([0.3, 0.0])
    rig.run(2.0, lambda: rig.said(CheckPath))
    (look,) = rig.said(CheckPath)
    rig.alter = lambda t, q: np.add(q, [1.5e-3, 0.0])
    rig.run(1.0)
    assert rig.supervisor.path_found(look.number, Rig._free(look), rig.wall) == []
    rig.run(0.1)
    again = rig.last(CheckPath)
    assert again.number != look.number
    np.testing.assert_array_equal(again.start, again.target)
    assert not rig.said(Drive)
