# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics against a closed-form S-R-S solver, and on two 6R arms."""

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import poisson
from srs_solver import SrsArm
from worlds.random_arm import random_arm_urdf
from worlds.robot_descriptions import Description, iiwa14, irb120, panda, ur5e, xarm6

from remaster_ros.errors import InputError
from remaster_ros.kinematics.inverse_kinematics import InverseKinematics, MissedSolutions
from remaster_ros.kinematics.pose_solver import distinct as distinct_rows
from remaster_ros.kinematics.pose_solver import reach_from, screws_and_tool, twists_to
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse, matrix_to_rotation_vector, transform


def usable(ik: InverseKinematics, T: np.ndarray) -> np.ndarray:
    """Return the joint solutions of a pose (4, 4) within the limits."""
    return ik.usable(ik.solutions_of_each(T[None])[0])


ROOT = Path(__file__).parents[3]
DATA = ROOT.parent / 'shared' / 'data'
ARMS = {
    'lwr4plus': SrsArm(0.3105, 0.4, 0.39, 0.078 + 0.05, (-1, 1, -1)),
    'iiwa14': SrsArm(0.36, 0.42, 0.4, 0.126 + 0.05, (1, -1, 1)),
}
# Joint angles are compared within this; near singular poses they are worth less than the pose.
SAME_RAD = 1e-5


def read_robot(name):
    text = (ROOT / 'config' / 'robots' / f'{name}.urdf').read_text(encoding='utf-8')
    return SerialChain.from_urdf(text)


def read_6r(folder):
    path = DATA / folder / 'robot.urdf'
    if not path.exists():
        pytest.skip(f'the real sessions, shared/data/{folder}, are not beside this checkout')
    return path.read_text(encoding='utf-8')


def wrapped(angles):
    return np.remainder(angles + np.pi, 2 * np.pi) - np.pi


def distance(q, solutions):
    """Return the largest joint difference of q (..., k) to each of solutions, modulo turns."""
    return np.max(np.abs(wrapped(q[..., None, :] - solutions)), axis=-1)


def distinct(q):
    q = q[np.all(np.isfinite(q), axis=1)]
    kept = []
    for row in q:
        if not kept or np.min(distance(row, np.array(kept))) > 1e-4:
            kept.append(row)
    return np.array(kept).reshape(-1, q.shape[1])


def assert_certified(chain, solutions, T):
    error = inverse(T) @ chain.forward(solutions)
    assert np.all(np.linalg.norm(error[:, :3, 3], axis=1) < 1e-8)
    turns = matrix_to_rotation_vector(error[:, :3, :3])
    assert np.all(np.linalg.norm(turns, axis=1) < 2e-8)


def poses_of(arm, q):
    return transform(*arm.forward(q))


@pytest.mark.parametrize(
    ('robot', 'poses', 'held_angle'),
    [
        ('lwr4plus', 1000, 0.0),
        ('iiwa14', 500, 0.8),
        pytest.param('lwr4plus', 7000, 0.0, marks=pytest.mark.qualify),
        pytest.param('iiwa14', 3000, 0.8, marks=pytest.mark.qualify),
    ],
)
def test_the_judge_finds_the_same_solutions_of_random_poses(robot, poses, held_angle):
    seed = 20
    print('seed', seed)
    chain, arm = read_robot(robot), ARMS[robot]
    ik = InverseKinematics(chain, {2: [held_angle]})
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (poses, 7))
    q[:, 2] = held_angle
    T = poses_of(arm, q)
    judged = arm.inverse(T[:, :3, :3], T[:, :3, 3], held_angle)
    found = ik.solutions_of_each(T)
    for i, solutions in enumerate(found):
        expected = distinct(judged[i])
        assert len(solutions) == len(expected), f'seed {seed}, pose {i}'
        assert np.max(np.min(distance(expected, solutions), axis=1)) < SAME_RAD
        assert np.min(distance(q[i], solutions)) < SAME_RAD
        # Those within the limits are usable, and no others.
        inside, kept = expected[chain.within_limits(wrapped(expected))], ik.usable(solutions)
        assert len(kept) == len(inside)
        assert np.all(chain.within_limits(kept, 1e-9))
        assert not len(kept) or np.max(np.min(distance(inside, kept), axis=1)) < SAME_RAD
    residual = chain.forward(np.concatenate(found)) - np.repeat(
        T, [len(solutions) for solutions in found], axis=0
    )
    assert np.max(np.abs(residual)) < 1e-8


def elbow_straight(q, arm):
    q[:, 3] = 0


def elbow_nearly_straight(q, arm):
    q[:, 3] = 2e-3


def wrist_straight(q, arm):
    q[:, 5] = 0


def wrist_over_shoulder(q, arm):
    # The wrist on the first axis: l_upper sin(lean) + l_lower sin(lean + bend) = 0.
    bend = arm.signs[1] * q[:, 3]
    lean = -np.arctan2(arm.l_lower * np.sin(bend), arm.l_upper + arm.l_lower * np.cos(bend))
    q[:, 1] = arm.signs[0] * lean


def wrist_straight_over_shoulder(q, arm):
    wrist_over_shoulder(q, arm)
    wrist_straight(q, arm)


def candle(q, arm):
    q[:] = 0


# What of a solution the pose determines: the angles, or their sums, outside the free curve.
def all_of_it(q):
    return q


def without_wrist_roll(q):
    # Where the wrist is straight (in some branches only), joints 5 and 7 turn about one axis.
    q = q.copy()
    straight = np.abs(np.sin(q[..., 5])) < 1e-4
    total = q[..., 4] + np.sign(np.cos(q[..., 5])) * q[..., 6]
    q[..., 4] = np.where(straight, total, q[..., 4])
    q[..., 6] = np.where(straight, 0.0, q[..., 6])
    return q


def elbow_and_lean(q):
    return q[..., [1, 3]]


@pytest.mark.parametrize(
    ('make', 'determined'),
    [
        (elbow_straight, all_of_it),
        (elbow_nearly_straight, all_of_it),
        (wrist_straight, without_wrist_roll),
        (wrist_over_shoulder, elbow_and_lean),
        (wrist_straight_over_shoulder, elbow_and_lean),
        (candle, elbow_and_lean),
    ],
)
@pytest.mark.parametrize('robot', ARMS)
def test_singular_poses_keep_every_branch_and_no_junk(robot, make, determined):
    chain, arm = read_robot(robot), ARMS[robot]
    ik = InverseKinematics(chain)
    q = np.random.default_rng(5).uniform(-2.5, 2.5, (100, 7))
    q[:, 2] = 0
    make(q, arm)
    T = poses_of(arm, q)
    judged = arm.inverse(T[:, :3, :3], T[:, :3, 3], 0.0)
    for i, solutions in enumerate(ik.solutions_of_each(T)):
        assert 1 <= len(solutions) <= 8
        assert_certified(chain, solutions, T[i])
        ours, expected = determined(solutions), determined(distinct(judged[i]))
        # A double root is known to the square root of rounding.
        assert np.max(np.min(distance(expected, ours), axis=1)) < 1e-6
        assert np.max(np.min(distance(ours, expected), axis=1)) < 1e-6
        assert np.min(distance(determined(q[i]), ours)) < 1e-6


def test_poses_out_of_reach_have_no_solution():
    chain, arm = read_robot('lwr4plus'), ARMS['lwr4plus']
    ik = InverseKinematics(chain)
    rng = np.random.default_rng(6)
    q = rng.uniform(-2, 2, (40, 7))
    q[:, 2:4] = 0
    T = poses_of(arm, q)
    beyond = T[:, :3, 3] - [0, 0, arm.d_base] - arm.d_tool * T[:, :3, 2]
    beyond /= np.linalg.norm(beyond, axis=1)[:, None]
    for gap in (1e-6, 1e-3, 0.1, 3.0):
        far = T.copy()
        far[:, :3, 3] += gap * beyond
        assert sum(map(len, ik.solutions_of_each(far))) == 0


def test_screws_and_tool_are_those_of_the_chain():
    chain = SerialChain.from_urdf(random_arm_urdf(np.random.default_rng(2), 7), tip_link='tool')
    q = np.random.default_rng(3).uniform(-3, 3, (50, 7))
    screws, rotation, position = screws_and_tool(chain, q)
    frames = chain.frames(q)
    axes = chain.axes_in_base(frames)
    np.testing.assert_allclose(screws[:, 3:], np.swapaxes(axes, 1, 2), atol=1e-12)
    moments = np.cross(frames[..., :3, 3], axes)
    np.testing.assert_allclose(screws[:, :3], np.swapaxes(moments, 1, 2), atol=1e-12)
    np.testing.assert_allclose(chain.forward(q), transform(rotation, position), atol=1e-12)


@pytest.mark.parametrize('angle', [0.0, 1e-10, 1e-5, 3e-4, 0.3, 2.0, 3.1, np.pi - 1e-6])
def test_twists_undo_the_matrix_exponential(angle):
    rng = np.random.default_rng(6)
    axis = rng.normal(size=(20, 3))
    axis *= angle / np.linalg.norm(axis, axis=1)[:, None]
    expected = np.concatenate((rng.normal(size=(20, 3)), axis), axis=1)
    generators = np.zeros((20, 4, 4))
    generators[:, :3, 3] = expected[:, :3]
    generators[:, :3, :3] = np.swapaxes(np.cross(axis[:, None], np.eye(3)), -1, -2)
    T = np.array([expm(generator) for generator in generators])
    identity = np.broadcast_to(np.eye(3), (20, 3, 3))
    twists = twists_to(T, identity, np.zeros((20, 3)))
    np.testing.assert_allclose(twists, expected, atol=1e-6 if angle > 3.1 else 1e-9)


def test_half_a_turn_is_undone_about_some_axis():
    half = transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))[None]
    twist = twists_to(half, np.eye(3)[None], np.zeros((1, 3)))
    assert np.linalg.norm(twist[0, 3:]) == pytest.approx(np.pi)


def test_two_held_values_give_both_sets():
    chain = read_robot('lwr4plus')
    T = chain.forward([0.3, 0.8, 0.5, 1.4, 0.5, 1.0, -0.4])
    (both,) = InverseKinematics(chain, {2: (-0.5, 0.5)}).solutions_of_each(T[None])
    single = [
        InverseKinematics(chain, {2: (value,)}).solutions_of_each(T[None])[0]
        for value in (-0.5, 0.5)
    ]
    np.testing.assert_array_equal(both, np.concatenate(single))
    assert set(both[:, 2]) == {-0.5, 0.5}


@pytest.mark.parametrize('joint', [0, 1, 2, 4, 5, 6])
def test_any_joint_but_the_elbow_can_be_held(joint):
    chain = read_robot('iiwa7')
    ik = InverseKinematics(chain, {joint: (0.4,)})
    q = np.random.default_rng(8).uniform(chain.lower, chain.upper, (50, 7))
    q[:, joint] = 0.4
    T = chain.forward(q)
    for row, pose, found in zip(q, T, ik.solutions_of_each(T), strict=True):
        solutions = ik.usable(found)
        assert_certified(chain, solutions, pose)
        assert np.min(distance(row, solutions)) < SAME_RAD


@pytest.mark.parametrize('folder', ['ur10_two_solutions', 'irb120_three_points'])
@pytest.mark.parametrize(
    'right_angle',
    [
        '1.57079632679',
        pytest.param('1.570796', marks=pytest.mark.qualify),
        pytest.param('1.5708', marks=pytest.mark.qualify),
        '1.5702',
    ],
)
def test_every_seed_of_6r_arms_is_recovered_also_with_rounded_angles(folder, right_angle):
    chain = SerialChain.from_urdf(read_6r(folder).replace('1.57079632679', right_angle))
    ik = InverseKinematics(chain)
    rng = np.random.default_rng(9)
    lost = 0
    q = rng.uniform(np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi), (300, 6))
    T = chain.forward(q)
    for row, pose, found in zip(q, T, ik.solutions_of_each(T), strict=True):
        solutions = ik.usable(found)
        assert np.all(chain.within_limits(solutions, 1e-9))
        assert_certified(chain, solutions, pose)
        lost += not len(solutions) or np.min(distance(row, solutions)) > SAME_RAD
    # Rounding moves the folds of the workspace: there alone (about 3 poses in 1000 of the UR10)
    # the closed form of the unrounded arm has no answer to start from.
    allowed = 0 if right_angle == '1.57079632679' else 3
    assert lost <= allowed


def test_joints_with_room_for_whole_turns_stay_near_the_middle():
    chain = SerialChain.from_urdf(read_6r('ur10_two_solutions'))
    ik = InverseKinematics(chain)
    T = chain.forward([0.5, -1.2, 1.5, -0.8, 1.1, 0.3])
    assert np.all(np.abs(usable(ik, T)) <= np.pi)
    shifted = SerialChain.from_urdf(
        read_6r('ur10_two_solutions').replace('lower="-6.3" upper="6.3"', 'lower="1" upper="7.4"')
    )
    solutions = usable(InverseKinematics(shifted), T)
    assert len(solutions) == len(usable(ik, T))
    assert np.all((solutions >= 1) & (solutions <= 7.4))


@pytest.mark.parametrize(
    ('held_values', 'message'),
    [
        ({}, '7 joints with 0 held leave 7 free'),
        ({2: (0.0,), 3: (0.0,)}, 'leave 5 free'),
        ({7: (0.0,)}, 'held joint index 7 is not in 0 to 6'),
        ({2: ()}, 'no value given to hold joint_3 at'),
        ({2: (3.5,)}, 'joint_3 cannot be held at 3.5 rad'),
        ({2: (np.nan,)}, 'joint_3 cannot be held at nan'),
        ({3: (0.5,)}, "joint_4 held, robot 'lwr4plus' is singular everywhere"),
    ],
)
def test_wrong_held_joints_are_refused(held_values, message):
    with pytest.raises(InputError, match=message):
        InverseKinematics(read_robot('lwr4plus'), held_values)


# Errors of lengths (m) and tilts (rad) per axis, as calibrations of delivered arms have them and
# as this program finds them.
OF_A_MAKER, FOUND = (2e-4, 1.5e-3), (1e-4, 5e-4)


def ur10():
    return Description(read_6r('ur10_two_solutions'), 'base_link', 'tool')


@pytest.mark.parametrize(
    ('make', 'errors', 'held_angles', 'way'),
    [
        (ur5e, OF_A_MAKER, {}, 'near closed form'),
        pytest.param(ur10, OF_A_MAKER, {}, 'near closed form', marks=pytest.mark.qualify),
        (irb120, FOUND, {}, 'near closed form'),
        (panda, FOUND, {4: 0.3}, 'near closed form'),
        pytest.param(iiwa14, FOUND, {2: 0.4}, 'near closed form', marks=pytest.mark.qualify),
        (xarm6, FOUND, {}, 'many starts'),
    ],
)
@pytest.mark.parametrize('poses', [12, pytest.param(1000, marks=pytest.mark.qualify)])
def test_arms_without_a_closed_form_keep_all_solutions(make, errors, held_angles, way, poses):
    """Against pinocchio from random starts; of each pose the angles it was made from, too."""
    pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')
    from judges.inverse_kinematics import InverseJudge, apart, with_errors

    seed = 11
    rng = np.random.default_rng(seed)
    description = make()
    urdf = with_errors(description.urdf, *errors, rng)
    chain = SerialChain.from_urdf(urdf, description.base_link, description.tip_link)
    ik = InverseKinematics(chain, {joint: (value,) for joint, value in held_angles.items()})
    assert ik.method == way
    judge = InverseJudge(urdf, chain.base_link, chain.tip_link, chain.joint_names, held_angles)
    free = [joint for joint in range(len(chain)) if joint not in held_angles]
    q = rng.uniform(-np.pi, np.pi, (poses, len(chain)))
    q[:, list(held_angles)] = list(held_angles.values())
    T = np.array([judge.tool(row[free]).homogeneous for row in q])
    missed, judge_missed, doubled, total, worst = 0, 0, 0, 0, (0.0, 0.0)
    for row, pose, solutions in zip(q[:, free], T, ik.solutions_of_each(T), strict=True):
        ours = solutions[:, free]
        doubled += sum(np.min(apart(ours[i], ours[:i])) < 1e-4 for i in range(1, len(ours)))
        tool_errors = [judge.left(angles, pose) for angles in ours]
        worst = tuple(np.maximum(worst, np.max(tool_errors, axis=0)))
        # A solution is found with a chance of about an eighth a start: 80 miss 1 in 40,000.
        judged = judge.solutions(pose, 80, rng)
        for angles in np.vstack((row, judged)):
            is_found = np.min(apart(angles, ours), initial=np.inf) < 1e-3
            missed += not is_found
            ours = ours if is_found else np.vstack((ours, angles))
        total += len(ours)
        judge_missed += sum(np.min(apart(a, judged), initial=np.inf) > 1e-3 for a in ours)
    print(
        f'seed {seed}: {make.__name__}, {ik.method}, off {ik.difference}; of {total} solutions '
        f'of {poses} poses {missed} missed (by the judge {judge_missed}), {doubled} twice, '
        f'worst residual {worst[0]:.1e} m {worst[1]:.1e} rad'
    )
    assert doubled == 0
    assert max(worst) < 2e-8
    # Where two solutions are about to meet, one in 10,000 may be lost. Many starts miss those to
    # which few of them lead: of solutions with a chance of 1 in 30 a start, 0.4 %. With such a
    # share this fails by chance once in a hundred.
    assert missed <= poisson.ppf(0.99, (1e-3 if way == 'many starts' else 1e-4) * total)


@pytest.mark.parametrize('slides', [(), (0,), (1,), (0, 2)], ids=str)
@pytest.mark.parametrize('joints', [3, 4, 5, 6])
@pytest.mark.parametrize('poses', [3, pytest.param(150, marks=pytest.mark.qualify)])
def test_arms_with_few_or_sliding_joints_keep_all_solutions(joints, slides, poses):
    """Against pinocchio from random starts; of each pose the positions it was made from, too."""
    pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')
    from judges.inverse_kinematics import InverseJudge

    seed = 12
    print('seed', seed)
    rng = np.random.default_rng(seed)
    urdf = random_arm_urdf(rng, joints, slides)
    chain = SerialChain.from_urdf(urdf, tip_link='tool')
    ik = InverseKinematics(chain)
    judge = InverseJudge(urdf, chain.base_link, chain.tip_link, chain.joint_names, {})

    def largest_gaps(q, rows):
        gaps = rows - q
        return np.max(np.abs(np.where(chain.slides, gaps, wrapped(gaps))), axis=-1)

    q = rng.uniform(-3, 3, (poses, joints))
    T = np.array([judge.tool(row).homogeneous for row in q])
    np.testing.assert_allclose(T, chain.forward(q), atol=1e-12)
    missed, total = 0, 0
    for row, pose, ours in zip(q, T, ik.solutions_of_each(T), strict=True):
        assert all(np.min(largest_gaps(ours[i], ours[:i])) > 1e-5 for i in range(1, len(ours)))
        assert np.max([judge.left(found, pose) for found in ours]) < 2e-8
        assert np.min(largest_gaps(row, ours)) < 1e-5
        for found in judge.solutions(pose, 60, rng):
            missed += np.min(largest_gaps(found, ours)) > 1e-3
        total += len(ours)
    print(f'of {total} solutions {missed} missed')
    assert missed <= 1e-3 * total


def test_what_many_starts_miss_is_estimated_by_how_often_each_was_found():
    """Against the truth: ten starts of a thousand that are known."""
    description = xarm6()
    chain = SerialChain.from_urdf(description.urdf, description.base_link, description.tip_link)
    rng = np.random.default_rng(4)
    print('seed 4')
    free, estimated, chances, missed, new, total = list(range(6)), [], [], 0, [], 0
    for q in rng.uniform(-np.pi, np.pi, (60, 6)):
        T = np.broadcast_to(chain.forward(q), (300, 4, 4))
        found, errors = reach_from(chain, free, rng.uniform(-np.pi, np.pi, (300, 6)), T)
        found = found[errors < 1e-8]
        every, _ = distinct_rows(chain, found)
        few, counts = distinct_rows(chain, found[:12])
        once, twice = int(np.sum(counts == 1)), int(np.sum(counts == 2))
        trial = MissedSolutions(len(few), 12, once, twice)
        estimated.append(trial.missed)
        chances.append(trial.once / trial.converged)
        new.append(np.mean([np.min(distance(row, few)) > 1e-4 for row in found[12:]]))
        missed, total = missed + len(every) - len(few), total + len(every)
    print(missed, np.sum(estimated), np.mean(chances), np.mean(new), 'of', total)
    # Good's estimate has no bias; 60 poses of 12 starts give it a standard deviation of 0.016.
    assert abs(np.mean(chances) - np.mean(new)) < 4 * 0.016
    # Chao's is a lower bound in expectation, and near where solutions are found alike often.
    assert 0.6 * missed < np.sum(estimated) < 1.4 * missed


def test_an_arm_with_no_closed_form_near_is_solved_and_said_so(capfd):
    urdf = random_arm_urdf(np.random.default_rng(1))
    chain = SerialChain.from_urdf(urdf, tip_link='tool')
    ik = InverseKinematics(chain)
    assert ik.method == 'many starts'
    assert ik.difference is None
    text = ik.in_words()
    assert text.startswith('No arm with a closed form is near this one')
    assert '160 starts a pose' in text
    q = np.random.default_rng(2).uniform(-np.pi, np.pi, (20, 6))
    T = chain.forward(q)
    for row, pose, solutions in zip(q, T, ik.solutions_of_each(T), strict=True):
        assert_certified(chain, solutions, pose)
        assert np.min(distance(row, solutions)) < SAME_RAD
    far = transform(np.eye(3), np.array([0.0, 0.0, 20.0]))
    assert usable(ik, far).shape == (0, 6)
    assert capfd.readouterr() == ('', '')


def test_the_difference_to_the_nearest_closed_form_is_that_at_the_tool():
    """A tilt of the elbow by 2 mrad moves the tool by 2 mrad times its distance at most."""
    urdf = ur5e().urdf
    straight = '<origin rpy="0 0 0" xyz="-0.425 0 0"/>'
    assert urdf.count(straight) == 1
    chain = SerialChain.from_urdf(
        urdf.replace(straight, straight.replace('rpy="0 ', 'rpy="0.002 ')), 'base_link', 'tool0'
    )
    ik = InverseKinematics(chain)
    off_m, off_rad = ik.difference
    print(off_m, off_rad)
    # Three axes share it: by 4/3, 2/3 and 2/3 mrad, and turn by up to pi about each.
    assert 1e-3 < off_rad < 2 * (4 + 2 + 2) / 3 * 1e-3
    assert 1e-4 < off_m < 0.9 * off_rad
    assert f'up to {1e3 * off_m:.2g} mm and' in ik.in_words()
    exact = InverseKinematics(SerialChain.from_urdf(urdf, 'base_link', 'tool0'))
    assert exact.method == 'closed form'
    assert max(exact.difference) < 1e-9
