# SPDX-License-Identifier: Apache-2.0
"""What becomes of other planners' trajectories, against what a controller draws of them."""

import time

import numpy as np
import pytest
from test_compensator import configurations, erring
from worlds.compensation_files import save
from worlds.drawn_moves import drawn, line
from worlds.hidden_tours import robot

from remaster_ros.compensation.foreign_motion import (
    ArmReports,
    SentTrajectory,
    Trajectory,
    TrueAngles,
    corrected_for_controller,
)
from remaster_ros.compensation.in_use import CorrectionInUse
from remaster_ros.errors import InputError
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import Admitted, ForeignGate

TOLERANCE_M = 2e-5
ACCELERATION = 5.0


def correction_of(folder, name, seed):
    return CorrectionInUse(save(folder, erring(name, seed), robot(name)), most_deg=5.0)


def gate_of(correction, acceleration=ACCELERATION):
    chain = correction.compensator.model.chain
    return ForeignGate(MotionLimits.of(chain, 1.0, correction.shifts, acceleration))


def standing(q):
    arm = ArmReports()
    for i in range(20):
        arm.take(0.02 * i, q, 0.02 * i)
    return arm


def points(passed: SentTrajectory):
    found = passed.admitted.waypoints
    return [np.array(values) for values in zip(*((w.time_s, w.q, w.velocity) for w in found))]


@pytest.mark.parametrize('name', ['six', 'lwr4plus'])
@pytest.mark.parametrize('seed', [1, pytest.param(2, marks=pytest.mark.qualify)])
def test_paths_through_singularities_keep_the_limits_and_the_tool_its_path(tmp_path, name, seed):
    """Along lines whose middle is singular, planned up to the limits, each from the one before."""
    print('seed', seed)
    correction = correction_of(tmp_path, name, seed)
    compensator = correction.compensator
    chain = compensator.model.chain
    gate = gate_of(correction)
    rng = np.random.default_rng(100 + seed)
    crossed, slowest, cpu_s, sent_points, distances = 0, 1.0, 0.0, 0, []
    for _ in range(16):
        middle = configurations(compensator.model, 1, int(rng.integers(1 << 30)))[0]
        middle[4 if name == 'six' else 3] = 0.0
        way = 0.5 * rng.uniform(-1.0, 1.0, len(chain))
        start, end = middle - way, middle + way
        inside = (np.minimum(start, end) > chain.lower + 0.1) & (
            np.maximum(start, end) < chain.upper - 0.1
        )
        if not inside.all():
            continue
        frames = chain.frames(middle[None])
        tip = (frames[:, -1] @ chain.T_fixed[-1])[:, None, :3, 3]
        axes = chain.axes_in_base(frames)
        jacobian = np.concatenate((np.cross(axes, tip - frames[..., :3, 3]), axes), axis=2)[0]
        assert np.linalg.svd(jacobian, compute_uv=False).min() < 0.02
        crossed += 1
        wanted = line(start, end, ACCELERATION, chain, share=1.0)
        at = compensator.command(start)
        began_s = time.process_time()
        passed = corrected_for_controller(
            wanted, standing(at), gate, correction, TOLERANCE_M, believed_q=start
        )
        cpu_s += time.process_time() - began_s
        assert isinstance(passed.admitted, Admitted)
        t, q, v = points(passed)
        dense = np.linspace(0.0, t[-1], 4001)
        sent = drawn(t, q, v, dense)
        h = dense[1]
        assert np.all(
            np.abs(np.diff(sent, axis=0)).max(axis=0) / h < chain.velocity_limits * 1.001
        )
        # Of a cubic the acceleration is largest at its ends.
        T = np.diff(t)[:, None]
        slope = np.diff(q, axis=0) / T
        ends = [(6 * slope - 4 * v[:-1] - 2 * v[1:]) / T, (2 * v[:-1] + 4 * v[1:] - 6 * slope) / T]
        assert np.max(np.abs(ends)) < ACCELERATION * 1.001
        # Time may be stretched, the path of the tool is that of the wanted one.
        faster = dense * wanted.times_s[-1] / t[-1]
        path = drawn(*_parts(wanted), faster)
        nominal = chain.forward(path)[:, :3, 3]
        off, before = (
            np.linalg.norm(compensator.tool(angles)[:, :3, 3] - nominal, axis=1)
            for angles in (sent, path)
        )
        distances.append(off)
        assert off.max() < before.max()
        slowest, sent_points = max(slowest, t[-1] / wanted.times_s[-1]), sent_points + len(t)
    assert crossed > 3
    # A correction of fractions of a degree does not make an arm much slower.
    assert 1.0 < slowest < 1.1
    # Where the accelerations are the planner's to the last, as much as they leave.
    assert np.median(np.concatenate(distances)) < 0.1e-3
    print(
        f'{name}: {crossed} paths, {slowest:.3f} times as long at most; '
        f'{1e3 * cpu_s / crossed:.1f} ms for {sent_points / crossed:.0f} points'
    )


def _parts(wanted):
    return wanted.times_s, wanted.positions, wanted.velocities


def test_what_is_planned_from_the_angles_it_was_told_begins_where_the_arm_is(tmp_path):
    correction = correction_of(tmp_path, 'six', 5)
    compensator = correction.compensator
    chain, gate = compensator.model.chain, gate_of(correction)
    at, target = configurations(compensator.model, 2, 6) * 0.5
    arm = standing(at)
    start = TrueAngles(compensator).at(at, None, 0.0)
    np.testing.assert_allclose(compensator.command(start), at, atol=1e-9)
    wanted = line(start, target, ACCELERATION, chain)
    t, q, v = points(corrected_for_controller(wanted, arm, gate, correction, TOLERANCE_M))
    assert t[0] == 0.0
    np.testing.assert_allclose(q[[0, -1]], [at, compensator.command(target)], atol=1e-9)
    # Without its start, as many programs send: the same path, begun by the controller itself.
    later = Trajectory(*(part[1:] for part in _parts(wanted)))
    t, q, v = points(corrected_for_controller(later, arm, gate, correction, TOLERANCE_M))
    assert t[0] > 0.0
    np.testing.assert_allclose(q[-1], compensator.command(target), atol=1e-9)
    # A planner that reads the arm's own joint_states.
    wrong = line(at, target, ACCELERATION, chain)
    with pytest.raises(InputError, match=r"begins .* must read this node's joint_states") as error:
        corrected_for_controller(wrong, arm, gate, correction, TOLERANCE_M)
    assert '\n' not in str(error.value)
    # Not in use: as it comes.
    off = correction.off()
    t, q, v = points(corrected_for_controller(wrong, arm, gate_of(off), off, TOLERANCE_M))
    np.testing.assert_allclose(t, wrong.times_s, rtol=1e-3)
    np.testing.assert_allclose(q, wrong.positions, atol=1e-12)
    np.testing.assert_allclose(v, wrong.velocities, rtol=1e-3, atol=1e-9)
    assert np.any(correction.shifts)
    assert not np.any(off.shifts)


def test_lines_and_single_points_and_a_hold(tmp_path):
    """What people send by hand: positions alone."""
    correction = correction_of(tmp_path, 'six', 7)
    compensator = correction.compensator
    gate = gate_of(correction)
    at, target = configurations(compensator.model, 2, 8) * 0.5
    arm = standing(at)
    passed = corrected_for_controller(
        Trajectory(np.array([8.0]), target[None], None), arm, gate, correction, TOLERANCE_M
    )
    assert passed.admitted.is_straight
    t, q, _ = points(passed)
    assert t[-1] == 8.0
    np.testing.assert_allclose(q[-1], compensator.command(target), atol=1e-9)
    # The tool is on the line of the nominal arm all the way.
    dense = np.linspace(0.0, 8.0, 500)
    start = compensator.true(at)
    nominal = compensator.model.chain.forward(start + dense[:, None] / 8.0 * (target - start))
    reached = compensator.tool(drawn(np.r_[0.0, t], np.vstack((at, q)), None, dense))
    off = np.linalg.norm(reached[:, :3, 3] - nominal[:, :3, 3], axis=1)
    assert np.median(off) < TOLERANCE_M
    assert off.max() < 0.2e-3
    none = Trajectory(np.zeros(0), np.zeros((0, 6)), None)
    assert (
        corrected_for_controller(none, arm, gate, correction, TOLERANCE_M).admitted.waypoints == ()
    )


def test_while_the_arm_moves_its_points_are_corrected(tmp_path):
    """A program that sends where to go ten times a second; a stop among them."""
    correction = correction_of(tmp_path, 'six', 9)
    compensator = correction.compensator
    gate = gate_of(correction)
    at = configurations(compensator.model, 1, 10)[0] * 0.5
    arm, speed = ArmReports(), np.full(6, 0.1)
    for i in range(20):
        arm.take(0.02 * i, at + 0.02 * i * speed, 0.02 * i)
    assert not arm.stands
    np.testing.assert_allclose(arm.velocity, speed)
    there = compensator.true(arm.q)
    to = there + 0.1 * speed
    wanted = Trajectory(np.array([0.1]), to[None], np.zeros((1, 6)))
    _, q, v = points(corrected_for_controller(wanted, arm, gate, correction, TOLERANCE_M))
    # A tenth of a second on: the change goes there as far as the accelerations of so short a
    # way allow.
    assert np.abs(q - to - (arm.q - there)).max() < 0.5 * ACCELERATION * 0.1**2 / 4
    assert np.all(v == 0.0)
    wanted = Trajectory(np.array([0.1, 0.4]), np.array([to, to]), None)
    assert corrected_for_controller(
        wanted, arm, gate, correction, TOLERANCE_M
    ).admitted.is_straight
    # The controller would jump there; an arm that is coming to rest it follows.
    wanted = Trajectory(np.array([0.0, 0.4]), np.array([there, to]), np.zeros((2, 6)))
    slow = ArmReports()
    for i in range(20):
        slow.take(0.02 * i, arm.q + 0.01 * (0.02 * i - 0.38), 0.02 * i)
    assert not slow.stands
    assert (
        len(points(corrected_for_controller(wanted, slow, gate, correction, TOLERANCE_M))[0]) >= 2
    )
    with pytest.raises(InputError, match='begins at once while the arm moves'):
        corrected_for_controller(wanted, arm, gate, correction, TOLERANCE_M)
    # From its speed to rest in no time.
    wanted = Trajectory(np.array([0.01]), to[None], np.zeros((1, 6)))
    with pytest.raises(InputError, match=r'would have a (speed|acceleration)'):
        corrected_for_controller(wanted, arm, gate, correction, TOLERANCE_M)


def test_what_is_refused_is_one_line(tmp_path):
    correction = correction_of(tmp_path, 'six', 11)
    compensator = correction.compensator
    chain, gate = compensator.model.chain, gate_of(correction)
    at, target = configurations(compensator.model, 2, 12) * 0.5
    arm, start = standing(at), compensator.true(at)

    def refused(words, wanted, on=correction, by=gate):
        with pytest.raises(InputError, match=words) as caught:
            corrected_for_controller(wanted, arm, by, on, TOLERANCE_M)
        assert '\n' not in str(caught.value)

    good = line(start, target, ACCELERATION, chain)
    t, q, v = _parts(good)
    for what in range(3):
        broken = [part.copy() for part in _parts(good)]
        broken[what].flat[-1] = np.nan
        refused('not finite', Trajectory(*broken))
    refused('do not ascend', Trajectory(t[::-1], q, v))
    refused('do not ascend', Trajectory(t - 0.1, q, v))
    ends = v.copy()
    ends[-1] = 1e-3
    refused('not end at rest', Trajectory(t, q, ends))
    refused('single point', Trajectory(t[:1], q[:1], None))
    share = float(np.max(np.abs(v).max(axis=0) / chain.velocity_limits)) / 1.2
    refused('is to turn at .* its limit', Trajectory(t * share, q, v / share))
    # Beyond the speeds of the arm between its points alone.
    way = np.array([start, start + 0.99 * 0.1 * chain.velocity_limits])
    refused('is to turn at', Trajectory(np.array([0.0, 0.1]), way, np.zeros((2, 6))))
    beyond = chain.upper - 0.001
    refused('would go to', line(start, beyond + 0.05, ACCELERATION, chain))
    # What is planned faster than the limit of acceleration is slowed down.
    fast = line(start, target, 4 * ACCELERATION, chain)
    slowed = corrected_for_controller(fast, arm, gate, correction, TOLERANCE_M)
    assert 'slowed down to' in slowed.notes[0]
    assert slowed.end_s > 1.5 * fast.times_s[-1]
    far = CorrectionInUse(
        save(tmp_path, compensator.model, robot('six')),
        most_deg=float(np.degrees(np.abs(compensator.command(target) - target).max())) + 2.0,
    )
    far._most_deg = 0.01
    refused('the correction would change', good, far)


def test_true_angles_are_exact_where_the_arm_stands(tmp_path):
    correction = correction_of(tmp_path, 'lwr4plus', 13)
    compensator = correction.compensator
    a, b = configurations(compensator.model, 2, 14) * 0.5
    true = TrueAngles(compensator)
    now, worst = 0.0, 0.0
    for u in np.linspace(0.0, 1.0, 60):
        q = a + u * (b - a)
        worst = max(worst, np.abs(true.at(q, None, now) - compensator.true(q)).max())
        now += 0.01
    # On its way: the way in 20 ms times the slope of the correction, some hundredths.
    assert worst < 0.1 * 3 * np.abs(b - a).max() / 60
    for _ in range(10):
        last = true.at(b, None, now)
        now += 0.01
    np.testing.assert_allclose(last, compensator.true(b), atol=1e-8)
    # Then nothing is computed any more.
    true._compensator = None
    np.testing.assert_allclose(true.at(b + 1e-6, None, now), last + 1e-6, atol=1e-12)


def test_an_arm_stands_that_was_reported_at_one_place_long_enough():
    arm = ArmReports()
    assert not arm.is_known
    assert not arm.stands
    for i in range(10):
        arm.take(0.02 * i, np.array([1e-5 * (-1) ** i, 0.0]), 50.0 + 0.02 * i)
    assert not arm.stands
    for i in range(10, 15):
        arm.take(0.02 * i, np.array([1e-5, 0.0]), 50.0 + 0.02 * i)
    assert arm.stands
    assert not np.any(arm.velocity)
    assert arm.is_fresh(50.5)
    assert not arm.is_fresh(51.0)
    arm.take(0.30, np.array([5e-4, 0.0]), 50.3)
    assert not arm.stands
    # Slow, but on its way.
    arm = ArmReports()
    for i in range(100):
        arm.take(0.02 * i, np.array([0.0, 1e-3 * 0.02 * i]), 0.02 * i)
        assert not arm.stands
    # A clock that was set back begins anew.
    arm.take(0.5, np.zeros(2), 2.0)
    assert not arm.is_known
