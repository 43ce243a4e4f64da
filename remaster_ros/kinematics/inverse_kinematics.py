# SPDX-License-Identifier: Apache-2.0
"""All inverse-kinematics solutions of a pose, certified by forward kinematics.

EAIK [1]_ decomposes arms of six free joints into closed-form subproblems. It needs exact geometry
(axes that meet or are parallel to 1e-13), and at singular or unreachable poses it returns
least-squares angles, some of them wrong, or zero for an angle that is not determined. So it gets
the nearest arm that is exact; its results are corrected on the true model by Newton's method and
kept only where forward kinematics confirms them.

A real arm differs a little from the exact one (by the maker's calibration of each arm), and near
poses at which two solutions of the exact arm merge it has other solutions. They are found from the
solutions of the exact arm at a few poses around the requested one.

If no exact arm is near, Newton's method starts from angles spread over whole turns. Its
steps are damped (Levenberg [2]_) and limited, so that starts far from any solution still converge:
of a six-joint arm's spread starts nearly all converge if the pose can be reached, to each of
its solutions about equally often. How many solutions the starts may have missed follows from how
often each solution was found [3]_ [4]_.

An arm with fewer than six joints reaches few of all poses: one with five axes reaches any position
and direction of one tool axis, but not any direction of the axis of its last joint; a SCARA's tool
stays upright. So its poses are drawn among those that it reaches (`planning.candidates`), and its
solutions reach them in position and orientation, as those of other arms do.

References
----------
.. [1] D. Ostermeier, J. Külz, M. Althoff, "Automatic Geometric Decomposition for Analytical
   Inverse Kinematics", IEEE Robotics and Automation Letters, 2025.
.. [2] K. Levenberg, "A method for the solution of certain non-linear problems in least squares",
   Quarterly of Applied Mathematics 2, 1944; for arms: T. Sugihara, "Solvability-unconcerned
   inverse kinematics by the Levenberg-Marquardt method", IEEE Transactions on Robotics 27, 2011.
.. [3] I. J. Good, "The population frequencies of species and the estimation of population
   parameters", Biometrika 40, 1953: the chance that a further draw is of a kind not seen is near
   the share of draws whose kind was seen once.
.. [4] A. Chao, "Nonparametric estimation of the number of classes in a population",
   Scandinavian Journal of Statistics 11, 1984; bias-corrected as in R. K. Colwell et al.,
   Journal of Plant Ecology 5, 2012, equation 4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np
from eaik.IK_HP import HPRobot
from scipy.special import gammaincinv

from remaster_ros.errors import InputError
from remaster_ros.kinematics.pose_solver import (
    CERTIFIED,
    distinct,
    reach_from,
    screws_and_tool,
    spread,
    spread_angles,
    wrapped,
)
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import rotation_vector_to_matrix, transform
from remaster_ros.types import FloatArray

FREE_JOINTS = 6
FEWEST_JOINTS = 3
"""Fewest joints: with two the tool moves on a surface, on which most zero-offsets look alike."""

OWN_CONFIGURATIONS = (
    'poses cannot be planned for it; measure configurations of your own choice, and make a '
    'session of their table: remaster import TABLE --urdf FILE --out SESSION'
)
"""Remedy, as the end of a message, for an arm whose inverse kinematics is not supported."""

# Largest angle (rad) and distance (m) between the axes of an arm and those of the nearest arm with
# a closed form. Manufacture and wear cause a tenth of it. With three times as much, 3 of 1,000
# solutions would be missed (see `_ExactArm.perturbations`).
NEAR_RAD = 0.02
NEAR_M = 0.01
# Difference at the tool, m and rad, below which two arms are the same, written with other digits.
EXACT = 1e-9
# Distance of the perturbed poses from the requested one, as a multiple of the largest difference
# between the arms at the tool. The true arm's solutions are those of the exact one at some pose
# that is one such difference away.
PERTURBATION = 2.0
# Solutions of the exact arm nearer to one another than this, rad, give one Newton start.
ONE_START_RAD = 0.05
# Starts of Newton's method for a pose if no exact arm is near.
STARTS = 160
# Poses of the trial that estimates how many solutions these starts miss.
TRIAL_POSES = 20
# Smallest singular value of the Jacobian (m, rad) below which the free joints do not move the tool
# independently. Errors of axes of some mrad give an arm with a held elbow no more.
IMMOBILE = 5e-3


@dataclass(frozen=True)
class MissedSolutions:
    """Estimates of how many solutions were missed when poses were solved from many starts."""

    found: int  # Distinct solutions of all poses
    converged: int  # Starts that converged to a solution
    once: int  # Solutions that one start found
    twice: int  # Solutions that two starts found

    @property
    def chance_of_new(self) -> float:
        """Upper bound on the probability that one more convergent start finds a new solution.

        At 95 % confidence. Good's estimate is once / converged; here the count is replaced by the
        upper limit of the mean of a Poisson variable with that count, which is 3.0 at 0.
        """
        return float(gammaincinv(self.once + 1.0, 0.95)) / max(self.converged, 1)

    @property
    def missed(self) -> float:
        """Chao's estimate of the number of missed solutions; a lower bound in expectation."""
        return self.once * (self.once - 1) / (2.0 * (self.twice + 1))


@dataclass(frozen=True)
class _ExactArm:
    """Arm with closed-form inverse kinematics that is nearest to the true one.

    One for each combination of values of the held joints.
    """

    chain: SerialChain  # Its six free joints
    robot: HPRobot  # EAIK's model of the chain, whose tool is not rotated at zero angles
    # Largest difference of the tool poses of this arm and the true one at the same angles
    difference_m: float
    difference_rad: float

    @property
    def is_true_arm(self) -> bool:
        """Whether the true arm itself has a closed form."""
        return max(self.difference_m, self.difference_rad) < EXACT

    @cached_property
    def perturbations(self) -> tuple[FloatArray, FloatArray]:
        """Perturbations of a pose, the first zero: rotations (n, 3, 3), translations, m, (n, 3).

        Only the zero one for a true arm with a closed form. Else also six orthogonal directions
        and their opposites, so that one of them leads to a pose at which the exact arm has the
        solutions that the true arm has at the pose itself.
        """
        if self.is_true_arm:
            return np.eye(3)[None], np.zeros((1, 3))
        directions = np.linalg.qr(np.sin(np.arange(1.0, 37.0)).reshape(6, 6))[0]
        twists = PERTURBATION * np.vstack((np.zeros(6), directions, -directions))
        rotations = rotation_vector_to_matrix(self.difference_rad * np.sqrt(2.0) * twists[:, 3:])
        return rotations, self.difference_m * np.sqrt(2.0) * twists[:, :3]

    def starts(self, T: FloatArray) -> FloatArray:
        """Return start angles for Newton's method at a pose T (4, 4), rad, (m, 6).

        Some are near each solution of the true arm; others may converge to none.
        """
        rotations, shifts = self.perturbations
        poses = np.broadcast_to(np.eye(4), (len(rotations), 4, 4)).copy()
        poses[:, :3, :3] = rotations @ T[:3, :3] @ self.chain.T_fixed[-1, :3, :3].T
        poses[:, :3, 3] = T[:3, 3] + shifts
        solved = [np.reshape(self.robot.IK(pose).Q, (-1, FREE_JOINTS)) for pose in poses]
        q = np.concatenate(solved)
        q = q[np.all(np.isfinite(q), axis=1)]
        if self.is_true_arm or not len(q):
            return q
        # Least-squares angles, which reach another pose, are dropped.
        _, rotation, position = screws_and_tool(self.chain, q)
        off_m = np.linalg.norm(position - T[:3, 3], axis=1)
        # The Frobenius norm of a difference of rotations is 2 sqrt(2) sin(angle / 2).
        off_rad = np.linalg.norm(rotation - T[:3, :3], axis=(1, 2)) / np.sqrt(2.0)
        factor = 2.0 * PERTURBATION
        q = q[
            (off_m <= factor * self.difference_m + EXACT)
            & (off_rad <= factor * self.difference_rad + EXACT)
        ]
        gaps = np.max(np.abs(wrapped(q[:, None] - q[None])), axis=-1)
        return q[~np.any(np.tril(gaps < ONE_START_RAD, -1), axis=1)]


class InverseKinematics:
    """All joint solutions of tool poses of one arm.

    A regular pose has up to eight solutions (sixteen for some arms) per value of the held joint.
    At a singular pose, where two joint axes line up or the shoulder's axis meets the wrist, a
    whole curve of joint angles reaches the pose: each branch contributes one point of it.
    Branches that meet (elbow straight) are one solution. All solutions satisfy forward kinematics
    within 1e-8 m and 1e-8 rad.

    Parameters
    ----------
    chain
        The arm: at most six joints, or more with all but six held.
    held
        Held joints: joint index (0 is the base's) -> values at which to hold it, rad or m. None
        holds nothing on up to six joints and the third joint at 0 on seven, as the counts of
        poses and solutions in Van Wyk et al. suggest they did.

    Raises
    ------
    InputError
        If the arm has not six free joints (or all of three to five), a held value lies outside
        the joint's limits, or the arm is singular at every configuration.
    """

    def __init__(
        self, chain: SerialChain, held: Mapping[int, Sequence[float]] | None = None
    ) -> None:
        if held is None:
            held = {2: (0.0,)} if len(chain) == FREE_JOINTS + 1 else {}
        _check_held(chain, held)
        self.chain = chain
        self.held = {joint: tuple(map(float, held[joint])) for joint in sorted(held)}
        self._free = [i for i in range(len(chain)) if i not in held]
        self._require_mobility()
        self._parts: list[tuple[tuple[float, ...], _ExactArm | None]] = [
            (values, self._nearest_exact(values)) for values in product(*self.held.values())
        ]

    @property
    def method(self) -> Literal['closed form', 'near closed form', 'many starts']:
        """Method by which solutions are found.

        The least direct one if it differs between the values at which joints are held.
        """
        exact = [part for _, part in self._parts]
        if None in exact:
            return 'many starts'
        alike = all(part is not None and part.is_true_arm for part in exact)
        return 'closed form' if alike else 'near closed form'

    @property
    def difference(self) -> tuple[float, float] | None:
        """Largest difference at the tool to the nearest arm with a closed form, m and rad.

        The largest over all combinations of held values. None if there is no such arm for some
        of them.
        """
        found = [part for _, part in self._parts if part is not None]
        if len(found) < len(self._parts):
            return None
        return max(p.difference_m for p in found), max(p.difference_rad for p in found)

    def in_words(self) -> str:
        """Return sentences on how solutions are found, and how complete they are.

        If no arm with a closed form is near this one, computing the sentences takes a trial of
        many starts, some seconds (`missed_solutions`).
        """
        within = 'each is kept where forward kinematics reaches the pose to 1e-8 m and 1e-8 rad'
        if self.difference is not None:
            off_m, off_rad = self.difference
            if self.method == 'closed form':
                return f'All joint solutions of a pose are computed in closed form; {within}.'
            return (
                "All joint solutions of a pose are found by Newton's method from those of the "
                'nearest arm that has a closed form, whose tool is up to '
                f'{1e3 * off_m:.2g} mm and {np.degrees(off_rad):.2g} degrees elsewhere; {within}.'
            )
        trial = self.missed_solutions()
        share = trial.missed / max(trial.found + trial.missed, 1.0)
        why = (
            'No arm with a closed form is near this one, so'
            if len(self._free) == FREE_JOINTS
            else f'An arm with {len(self._free)} joints takes few of all poses, and is given such '
            'as it takes. Their'
        )
        return (
            f'{why} joint solutions are sought by '
            f"Newton's method from {STARTS} starts a pose; {within}. Of {TRIAL_POSES} poses "
            f'{trial.converged} starts arrived at {trial.found} solutions, {trial.once} of which '
            f'were found once: {100.0 * share:.1f} % are missed (by Chao), and the chance that '
            f'one more start finds a further one is below {100.0 * trial.chance_of_new:.1g} % '
            '(by Good, at 95 % confidence).'
        )

    def missed_solutions(self) -> MissedSolutions:
        """Counts of solutions that many starts found at evenly spread poses, and how often.

        `TRIAL_POSES` poses, `STARTS` starts each, with the first of the held values. Takes
        seconds.
        """
        seeds = spread(self.chain, range(len(self.chain)), TRIAL_POSES)
        counts = []
        for q in seeds:
            values, _ = self._parts[0]
            q[list(self.held)] = values
            pose = self.chain.forward(q)
            starts = self._with_held(spread(self.chain, self._free, STARTS), values)
            found, residuals = reach_from(
                self.chain, self._free, starts, np.broadcast_to(pose, (STARTS, 4, 4))
            )
            counts.append(distinct(self.chain, found[residuals < CERTIFIED])[1])
        times = np.concatenate(counts)
        return MissedSolutions(
            len(times), int(times.sum()), int(np.sum(times == 1)), int(np.sum(times == 2))
        )

    def solutions_of_each(self, T: FloatArray) -> list[FloatArray]:
        """Return the joint solutions of each tool pose (n, 4, 4): n arrays (m_i, k), rad or m.

        Revolute joints are in [-pi, pi]; limits are not checked. m_i is 0 for an unreachable pose.
        Much faster than pose by pose.
        """
        starts = [
            np.concatenate([self._starts(values, exact, pose) for values, exact in self._parts])
            for pose in T
        ]
        pose_index = np.repeat(np.arange(len(T)), [len(q) for q in starts])
        q, residuals = reach_from(
            self.chain,
            self._free,
            np.concatenate([np.empty((0, len(self.chain))), *starts]),
            T[pose_index],
        )
        reached = residuals < CERTIFIED
        ends = np.cumsum(np.bincount(pose_index[reached], minlength=len(T)))[:-1]
        return [distinct(self.chain, of_pose)[0] for of_pose in np.split(q[reached], ends)]

    def usable(self, q: FloatArray) -> FloatArray:
        """Return the solutions of q (m, k) that lie within the joint limits, (n, k), in order.

        Each joint is first moved by whole turns as near as possible to the middle of its range;
        the limits have a tolerance of 1e-9.
        """
        q = self._towards_middle(q)
        return q[self.chain.within_limits(q, tolerance=1e-9)]

    def _starts(
        self, values: tuple[float, ...], exact: _ExactArm | None, T: FloatArray
    ) -> FloatArray:
        """Return start configurations of Newton's method for a tool pose T (4, 4), (m, k).

        Solutions of ``exact``, the nearest arm with a closed form; m is 0 if it has none. If
        ``exact`` is None, `STARTS` positions spread evenly over the free joints. ``values``: of
        the held joints, in order.
        """
        free = spread(self.chain, self._free, STARTS) if exact is None else exact.starts(T)
        return self._with_held(free, values)

    def _with_held(self, free: FloatArray, values: tuple[float, ...]) -> FloatArray:
        """Return configurations (m, k) from free joints (m, n) and the held values."""
        q = np.empty((len(free), len(self.chain)))
        q[:, self._free] = free
        q[:, list(self.held)] = values
        return q

    def _require_mobility(self) -> None:
        """Raise InputError if the arm is singular at all configurations.

        With the elbow of an S-R-S arm held it is: the wrist keeps its distance to the
        shoulder, and the arm still swings about the line between them.
        """
        chain = self.chain
        if _is_mobile(chain, {joint: values[0] for joint, values in self.held.items()}):
            return
        names = ', '.join(chain.joint_names[joint] for joint in self.held)
        other_joints = [
            f'{name} (at {chain.shown_offset(joint, value, 0)}, say)'
            for joint, name in enumerate(chain.joint_names)
            for value in (_middle(chain, joint),)
            if len(self.held) == 1 and _is_mobile(chain, {joint: value})
        ]
        remedy = (
            f'held_joint in the cell file may be {" or ".join(other_joints)}'
            if other_joints
            else OWN_CONFIGURATIONS
        )
        raise InputError(
            f"inverse kinematics: with {names or 'no joint'} held, robot '{chain.name}' is "
            f'singular everywhere; {remedy}'
        )

    def _nearest_exact(self, values: tuple[float, ...]) -> _ExactArm | None:
        """Return the nearest arm with a closed form; None if there is none within tolerance.

        ``values``: of the held joints, in order. None also with fewer than six free joints, or a
        slide. The tolerance of axes is `NEAR_RAD` and `NEAR_M`.
        """
        chain, free = self.chain, self._free
        if len(free) < FREE_JOINTS or chain.slides[free].any():
            return None
        q = np.zeros(len(chain))
        q[list(self.held)] = values
        frames, tip = chain.frames(q), chain.forward(q)
        axes, points = _nearest_lines(chain.axes_in_base(frames)[free], frames[free, :3, 3])
        if not _may_have_closed_form(axes, points):
            return None
        steps = np.diff(np.vstack((np.zeros(3), points, tip[:3, 3])), axis=0)
        robot = HPRobot(axes, steps)
        if not robot.hasKnownDecomposition():
            return None
        T_fixed = transform(np.eye(3), steps)
        T_fixed[-1, :3, :3] = tip[:3, :3]
        exact = replace(
            chain,
            joint_names=tuple(chain.joint_names[i] for i in free),
            T_fixed=T_fixed,
            axes=axes,
            **{
                name: getattr(chain, name)[free]
                for name in (
                    *('lower', 'upper', 'velocity_limits', 'masses', 'centers_of_mass'),
                    'slides',
                )
            },
        )
        turned = spread_angles(200, FREE_JOINTS)
        ours = chain.forward(self._with_held(turned, values))
        off = exact.forward(turned) - ours
        # The norm is 2 sqrt(2) sin(angle / 2); see `_ExactArm.starts`.
        return _ExactArm(
            exact,
            robot,
            float(np.max(np.linalg.norm(off[:, :3, 3], axis=1))),
            float(np.max(np.linalg.norm(off[:, :3, :3], axis=(1, 2))) / np.sqrt(2.0)),
        )

    def _towards_middle(self, q: FloatArray) -> FloatArray:
        """Return q (m, k) with whole turns taken off towards the middle of the ranges.

        Towards 0 for a joint without limits; a prismatic joint is unchanged.
        """
        bounded = np.isfinite(self.chain.lower) & np.isfinite(self.chain.upper)
        middle = np.zeros(len(self.chain))
        middle[bounded] = (self.chain.lower[bounded] + self.chain.upper[bounded]) / 2
        turns = np.where(self.chain.slides, 0.0, np.round((middle - q) / (2 * np.pi)))
        return q + 2 * np.pi * turns


def _is_mobile(chain: SerialChain, held_values: Mapping[int, float]) -> bool:
    """Whether the Jacobian of the free joints has full rank at one of 8 fixed configurations.

    Full: its smallest singular value is `IMMOBILE` or more. ``held_values``: index from 0 -> rad
    or m.
    """
    spread = np.sin(np.arange(8.0 * len(chain))).reshape(8, -1)
    spread[:, list(held_values)] = list(held_values.values())
    free = [i for i in range(len(chain)) if i not in held_values]
    screws = screws_and_tool(chain, spread)[0][..., free]
    return bool(np.max(np.linalg.svd(screws, compute_uv=False)[:, -1]) >= IMMOBILE)


def _check_held(chain: SerialChain, held_values: Mapping[int, Sequence[float]]) -> None:
    """Raise InputError if the number of free joints or a held value is not supported.

    Free are six, or all of three to five joints; values have to be within the limits.
    """
    free = len(chain) - len(held_values)
    if free != min(len(chain), FREE_JOINTS) or free < FEWEST_JOINTS:
        raise InputError(
            f'inverse kinematics: {len(chain)} joints with {len(held_values)} held leave {free} '
            f'free; poses need {FREE_JOINTS} free joints, or all of {FEWEST_JOINTS} to '
            f'{FREE_JOINTS - 1}: hold none of six or fewer, one of seven'
        )
    for joint, values in held_values.items():
        if not 0 <= joint < len(chain):
            raise InputError(
                f'inverse kinematics: held joint index {joint} is not in 0 to {len(chain) - 1}'
            )
        if len(values) == 0:
            raise InputError(
                f'inverse kinematics: no value given to hold {chain.joint_names[joint]} at'
            )
        for value in values:
            if not chain.lower[joint] <= value <= chain.upper[joint]:
                raise InputError(
                    f'inverse kinematics: {chain.joint_names[joint]} cannot be held at {value} '
                    f'{chain.units[joint]}; its limits are {chain.lower[joint]:.4f} to '
                    f'{chain.upper[joint]:.4f}'
                )


def _nearest_lines(axes: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return axes made exactly parallel, or exactly meeting, if they nearly are.

    ``axes, points``: direction and a point of each of six joint axes at zero angles, (6, 3).
    Returns directions and points of the exact arm, in the same shape.
    """
    axes, points = axes.copy(), points.copy()
    count = len(axes)
    # Axes are rotated about points near the arm: a joint's origin may be metres along its axis.
    previous = np.zeros(3)
    for i in range(count):
        previous = points[i] = points[i] + axes[i] * (axes[i] @ (previous - points[i]))
    first = 0
    for i in range(1, count + 1):
        if i < count and np.linalg.norm(np.cross(axes[i - 1], axes[i])) < NEAR_RAD:
            continue
        signs = np.sign(axes[first:i] @ axes[first])
        mean = signs @ axes[first:i]
        axes[first:i] = signs[:, None] * (mean / np.linalg.norm(mean))
        first = i
    parallel = np.linalg.norm(np.cross(axes[:-1], axes[1:]), axis=1) < EXACT
    meeting = np.zeros(count - 1, dtype=bool)
    for three in (slice(0, 3), slice(3, 6)):
        pairs = slice(three.start, three.stop - 1)
        point, gap = _meeting_point(axes[three], points[three])
        if gap < NEAR_M and not np.any(parallel[pairs]):
            points[three], meeting[pairs] = point, True
    for i in range(count - 1):
        if parallel[i] or meeting[i]:
            continue
        normal = np.cross(axes[i], axes[i + 1])
        normal /= np.linalg.norm(normal)
        gap = normal @ (points[i + 1] - points[i])
        if abs(gap) < NEAR_M:
            # All later axes are shifted along, so that those that meet still do.
            points[i + 1 :] -= gap * normal
    return axes, points


def _meeting_point(axes: FloatArray, points: FloatArray) -> tuple[FloatArray, float]:
    """Return the point nearest to three lines, m, (3,), and its largest distance from one, m.

    ``axes``: unit vectors; ``points``: one on each line, m; (3, 3) each, a line a row.
    """
    # Normal equations: the sum of (I - a a^T)(x - o) is zero.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    to_lines = np.einsum('nij,nj->ni', across, points)
    point = np.linalg.lstsq(across.sum(axis=0), to_lines.sum(axis=0), rcond=None)[0]
    return point, float(np.max(np.linalg.norm(across @ point - to_lines, axis=1)))


def _may_have_closed_form(axes: FloatArray, origins: FloatArray) -> bool:
    """Return whether three successive axes are parallel, or the first or last three meet.

    All of EAIK's decompositions need one of these; for other arms EAIK prints to the terminal.
    ``axes``: unit vectors, (6, 3); ``origins``: a point on each, m, (6, 3). They meet if within
    `EXACT`.
    """
    neighbours = np.linalg.norm(np.cross(axes[:-1], axes[1:]), axis=1) < 1e-9
    if np.any(neighbours[:-1] & neighbours[1:]):
        return True
    return any(
        _meeting_point(axes[three], origins[three])[1] < EXACT
        for three in (slice(0, 3), slice(3, 6))
    )


def _middle(chain: SerialChain, joint: int) -> float:
    """Return a central joint position, rad or m: zero, or mid-range if limits exclude zero."""
    low, high = chain.lower[joint], chain.upper[joint]
    if not chain.slides[joint]:
        low, high = max(low, -np.pi), min(high, np.pi)
    return 0.0 if low < 0.0 < high else float(low + high) / 2
