# SPDX-License-Identifier: Apache-2.0
"""The judge of commanded motion finds each thing that it is there to find."""

import numpy as np
import pytest

pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

from hostile.arm import Command, HostileArm
from hostile.judge import Judge, Rules, along
from numpy.testing import assert_allclose

HOME = np.array([0.0, 0.3, 0.0, 1.0, 0.0, 0.5, 0.0])
STILL = np.zeros(7)


@pytest.fixture(scope='module')
def body():
    pytest.importorskip('pinocchio')
    from hostile.scene import demo_body

    return demo_body()


def move(way, duration_s, at_s=0.0, start=HOME, velocity=STILL, **options):
    """Return a command with one point at rest."""
    end = np.array([start + way])
    return Command(at_s, np.array([duration_s]), end, np.zeros((1, 7)), None, start, velocity,
                   **options)  # fmt: skip


def joint_change(joint, angle):
    return angle * (np.arange(7) == joint)


def test_the_cubic_from_rest_to_rest_is_half_as_fast_again_as_its_mean(body):
    judged = Judge(body, Rules(0.3)).judge(move(joint_change(0, 0.6), 2.0))
    assert judged.kind == 'move'
    assert judged.urdf_share == pytest.approx(1.5 * 0.3 / body.velocity[0], rel=1e-3)
    assert judged.speed_ratio == pytest.approx(judged.urdf_share / 0.3)
    assert judged.acceleration == pytest.approx(6 * 0.6 / 2.0**2, rel=1e-6)
    assert not judged.wrong(Rules(0.3))
    fast = Judge(body, Rules(0.3)).judge(move(joint_change(0, 0.6), 1.0))
    assert any('joint speed' in text for text in fast.wrong(Rules(0.3)))


def test_linear_without_velocities_and_quintic_with_accelerations():
    linear = Command(0.0, np.array([2.0]), np.array([HOME + 1.0]), None, None, HOME, STILL)
    _, v, a = linear.spline().sample()
    assert_allclose(v, 0.5)
    assert_allclose(a, 0.0)
    zeros = np.zeros((1, 7))
    quintic = Command(0.0, np.array([2.0]), np.array([HOME + 1.0]), zeros, zeros, HOME, STILL)
    q, v, a = quintic.spline().sample(201)
    assert_allclose(q[-1], HOME + 1.0)
    assert_allclose(np.max(v), 15 / 8 * 0.5, rtol=1e-4)
    assert_allclose(a[[0, -1]], 0.0, atol=1e-12)


def test_cartesian_speed_is_that_of_the_fastest_point(body):
    """About joint 1 it is the distance from its axis times the angular speed."""
    points = body.points(HOME)
    radius = np.max(np.hypot(points[:, 0], points[:, 1]))
    fastest, surface = body.speeds(HOME, joint_change(0, 0.5))
    assert fastest == pytest.approx(0.5 * radius, rel=1e-9)
    assert fastest <= surface <= 0.5 * (radius + 0.075)
    judged = Judge(body, Rules(1.0, cartesian_m_s=0.1)).judge(move(joint_change(0, 0.6), 1.0))
    assert any('m/s' in text for text in judged.wrong(Rules(1.0, cartesian_m_s=0.1)))


def test_outside_is_found_on_the_way_too_and_not_held_against_a_start_outside(body):
    rules = Rules(1.0)
    there = HOME + joint_change(1, body.upper[1] - HOME[1] - 0.01)
    overshooting = move(joint_change(1, 0.005), 1.0, start=there, velocity=joint_change(1, 0.5))
    assert 'outside' in ' '.join(Judge(body, rules).judge(overshooting).wrong(rules))
    outside = HOME + joint_change(1, body.upper[1] - HOME[1] + 0.05)
    assert (
        not Judge(body, rules).judge(move(joint_change(1, -0.2), 2.0, start=outside)).wrong(rules)
    )
    nothing = move(np.full(7, np.nan), 2.0)
    assert Judge(body, rules).judge(nothing).wrong(rules)


@pytest.mark.parametrize(
    ('end', 'words'),
    [
        (0.4, ''),
        (1.0, ''),
        (0.25, 'back'),
        (1.05, 'beyond'),
        (None, 'off path'),
    ],
)
def test_a_stop_ends_ahead_on_the_admitted_path(body, end, words):
    judge, rules = Judge(body, Rules(1.0)), Rules(1.0)
    way = joint_change(0, 1.0) + joint_change(4, 0.5)
    judge.judge(move(way, 4.0, at_s=10.0))
    goal = HOME + (0.4 * way + joint_change(2, 0.02) if end is None else end * way)
    here = HOME + 0.3 * way
    judged = judge.judge(move(goal - here, 1.0, at_s=11.0, start=here))
    assert judged.kind == 'stop'
    found = ' '.join(judged.wrong(rules))
    assert found.startswith(f'stop {words}') if words else not found


def test_what_follows_a_stop_is_a_move_once_the_stop_has_ended(body):
    judge = Judge(body, Rules(1.0))
    judge.judge(move(joint_change(0, 1.0), 4.0, at_s=10.0))
    judge.judge(move(joint_change(0, 0.1), 0.5, at_s=11.0, start=HOME + joint_change(0, 0.3)))
    here = HOME + joint_change(0, 0.4)
    assert judge.judge(move(joint_change(2, 0.5), 4.0, at_s=11.2, start=here)).kind == 'stop'
    judge.forget()
    judge.judge(move(joint_change(0, 1.0), 4.0, at_s=10.0))
    judge.judge(move(joint_change(0, 0.1), 0.5, at_s=11.0, start=HOME + joint_change(0, 0.3)))
    assert judge.judge(move(joint_change(2, 0.5), 4.0, at_s=11.6, start=here)).kind == 'move'
    assert (
        judge.judge(move(joint_change(2, 0.1), 0.5, at_s=17.0, start=here), running=False).kind
        == 'stop'
    )


def test_a_way_round_is_no_way_back(body):
    """A stop on the second leg of an admitted path with a corner."""
    corner, end = HOME + joint_change(0, 0.5), HOME + joint_change(0, 0.5) + joint_change(1, 0.3)
    path = Command(0.0, np.array([2.0, 4.0]), np.array([corner, end]), np.zeros((2, 7)), None,
                   HOME, STILL)  # fmt: skip
    here = corner + joint_change(1, 0.1) * np.linspace(0.0, 1.0, 9)[:, None]
    assert max(along(path, here).values()) < 1e-12
    cut = HOME + np.linspace(0.0, 1.0, 9)[:, None] * (end - HOME)
    assert along(path, cut)['off_path_rad'] > 0.1


@pytest.mark.parametrize('exact', [True, False])
def test_the_arm_follows_and_brakes(exact):
    arm = HostileArm(HOME, 0.0, exact=exact)
    arm.take(0.0, np.array([2.0]), np.array([HOME + joint_change(0, 0.6)]), np.zeros((1, 7)))
    arm.advance(1.0)
    assert arm.q[0] == pytest.approx(0.3, abs=1e-3 if exact else 0.04)
    assert arm.speed() == pytest.approx(0.45, rel=0.01)
    arm.stop_by_brakes(1.0)
    stopped = arm.take(1.01, np.array([1.0]), np.array([HOME]), np.zeros((1, 7)))
    assert stopped.emergency
    assert not stopped.obeyed
    before = arm.q[0]
    arm.advance(1.5)
    assert arm.q[0] - before == pytest.approx(0.5 * 0.15 * 0.45, abs=6e-3)
    assert arm.speed() == 0.0
    arm.release(2.0)
    arm.take(2.0, np.array([1.0]), np.array([HOME]), np.zeros((1, 7)))
    arm.advance(4.0)
    assert_allclose(arm.q, HOME, atol=1e-6)


def test_in_open_loop_a_command_begins_where_the_last_one_leads():
    arm = HostileArm(HOME, 0.0, open_loop=True)
    arm.take(0.0, np.array([2.0]), np.array([HOME + joint_change(0, 0.6)]), np.zeros((1, 7)))
    command = arm.take(1.0, np.array([1.0]), np.array([HOME]), np.zeros((1, 7)))
    assert command.start_q[0] == pytest.approx(0.3)
    assert arm.q[0] < 0.29
