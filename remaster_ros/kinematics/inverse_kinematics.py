# SPDX-License-Identifier: Apache-2.0
"""All inverse-kinematics solutions of a pose, certified by forward kinematics.

EAIK [1]_ decomposes arms of six free joints into closed-form subproblems. It needs exact geometry
(axes that meet or are parallel to 1e-13), and at singular or unreachable poses it returns
least-squares angles, some of them wrong, or zero for an angle that is not determined. So it gets
the nearest arm that is exact; its results are corrected on the true model by Newton's method and
kept only where forward kinematics confirms them.

An arm of which that one is a little off (each delivered arm, by its own calibration) has other
solutions where those of the exact arm are about to meet. They are found from the solutions of the
exact arm at a few poses around the one that is asked for.

Where no exact arm is near, Newton's method starts from joint angles all over their turns. Its
steps are damped (Levenberg [2]_) and limited, so that also starts far from any solution arrive at
one: of a six-joint arm's starts spread evenly, nearly all do where the pose can be reached, and to
each of its solutions about as often. How many solutions such starts may have missed follows from
how often each was found [3]_ [4]_.

An arm with fewer than six joints takes few of all poses: one of five axes brings its tool to a
place and an axis of it into a direction, but not the tool's own axis into any, since the last
joint turns about that one in nearly all of them; a SCARA's tool stays upright. So its poses are
drawn among those that it takes (`planning.candidates`), and their solutions reach them in position
and orientation, as those of other arms do.

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
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import rotation_vector_to_matrix, transform
from remaster_ros.types import FloatArray, IntArray

# Newton's method from many starts at once: one row is one start for one pose.

CERTIFIED = 1e-8
"""What forward kinematics may leave of a solution: 10 nm and 10 nrad."""
DISTINCT = 1e-4
"""Solutions whose joints all agree within this, rad, are one."""

# Steps are taken until a hundredth of what is certified remains; where two solutions are about to
# meet they halve the rest, as from 0.1 rad to 1e-4 rad in ten steps.
_STEPS = 60
# Longer steps leave what the derivative at their start holds for: sin x is x to 4 % up to here. A
# joint that slides moves the tool in proportion: steps of it alone have any length.
_LONGEST_RAD = 0.5
# Rows computed at a time, which bounds the memory: some 2 kB each.
_ROWS = 20_000


def reach_from(
    chain: SerialChain, free: Sequence[int], starts: FloatArray, T: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Bring starts to the poses that they are for.

    ``free``: joints that may move, at most six; ``starts``: rad or m, (m, k); ``T``: T_R_T of
    each, (m, 4, 4).
    Returns q: Where they arrive, (m, k), in [-pi, pi] for free joints that turn; left: The larger
    of the translation, m, and rotation, rad, between tool and pose, (m,).
    """
    q, left = starts.copy(), np.empty(len(starts))
    for first in range(0, len(q), _ROWS):
        rows = slice(first, first + _ROWS)
        q[rows], left[rows] = _newton(chain, list(free), q[rows], T[rows])
    turning = [joint for joint in free if not chain.slides[joint]]
    q[:, turning] = wrapped(q[:, turning])
    return q, left


def _newton(
    chain: SerialChain, free: list[int], q: FloatArray, T: FloatArray
) -> tuple[FloatArray, FloatArray]:
    left = np.full(len(q), np.inf)
    going = np.arange(len(q))
    diagonal, turning = np.arange(len(free)), ~chain.slides[free]
    for step in range(_STEPS + 1):
        screws, rotation, position = screws_and_tool(chain, q[going])
        missing = twists_to(T[going], rotation, position)
        left[going] = np.sqrt(np.max(np.sum(missing.reshape(-1, 2, 3) ** 2, axis=-1), axis=-1))
        wrong = left[going] > 0.01 * CERTIFIED
        going = going[wrong]
        if step == _STEPS or not len(going):
            break
        jacobian, missing = screws[wrong][:, :, free], missing[wrong]
        transposed = np.swapaxes(jacobian, 1, 2)
        normal = transposed @ jacobian
        # Damped in proportion to the square of what is missing, so that the last steps are
        # Newton's; 1e-12 keeps them solvable where the arm is singular.
        squared = np.sum(missing**2, axis=1)
        normal[:, diagonal, diagonal] += (0.01 * np.minimum(squared, 1.0) + 1e-12)[:, None]
        moves = np.linalg.solve(normal, transposed @ missing[:, :, None])[:, :, 0]
        longest = np.max(np.abs(moves) * turning, axis=1, keepdims=True)
        q[going[:, None], free] += moves * (_LONGEST_RAD / np.maximum(longest, _LONGEST_RAD))
    return q, left


def screws_and_tool(
    chain: SerialChain, q: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the joints' screws in R and the tool in R at q (m, k).

    A screw is o × a and a; a and 0 of a joint that slides.

    The same as from `SerialChain.frames`, several times as fast: joint frames have their axis
    as Z, and a turn about it costs no product of matrices.

    Returns screws, rotation, position: (m, 6, k); (m, 3, 3); m, (m, 3).
    """
    m, k = q.shape
    fixed = chain.T_fixed_z[:, :3]
    screws = np.empty((m, 6, k))
    rotation = np.broadcast_to(fixed[0, :, :3], (m, 3, 3))
    position = np.broadcast_to(fixed[0, :, 3], (m, 3))
    sines, cosines = np.sin(q)[:, None, :], np.cos(q)[:, None, :]
    for i in range(k):
        axis = rotation[:, :, 2]
        if chain.slides[i]:
            screws[:, :3, i], screws[:, 3:, i] = axis, 0.0
            moved = (rotation.reshape(-1, 3) @ fixed[i + 1]).reshape(m, 3, 4)
            position = position + q[:, i, None] * axis + moved[:, :, 3]
            rotation = moved[:, :, :3]
            continue
        screws[:, :3, i], screws[:, 3:, i] = _cross(position, axis), axis
        s, c = sines[:, :, i], cosines[:, :, i]
        turned = np.stack(
            (
                c * rotation[:, :, 0] + s * rotation[:, :, 1],
                c * rotation[:, :, 1] - s * rotation[:, :, 0],
                axis,
            ),
            axis=-1,
        )
        moved = (turned.reshape(-1, 3) @ fixed[i + 1]).reshape(m, 3, 4)
        rotation, position = moved[:, :, :3], position + moved[:, :, 3]
    return screws, rotation, position


def twists_to(T: FloatArray, rotation: FloatArray, position: FloatArray) -> FloatArray:
    """Return the screw motions in R that bring tools to poses, (m, 6).

    Where two axes line up, a closed form leaves out a turn about them, of any size: a screw
    motion holds it exactly, and one step makes up for it: the logarithm of SE(3), without what
    SciPy's rotations cost.
    """
    turn = T[:, :3, :3] @ np.swapaxes(rotation, 1, 2)
    shift = T[:, :3, 3] - (turn @ position[:, :, None])[:, :, 0]
    across = turn - np.swapaxes(turn, 1, 2)
    axis = 0.5 * np.stack((across[:, 2, 1], across[:, 0, 2], across[:, 1, 0]), axis=-1)
    sine = np.sqrt(np.sum(axis**2, axis=1))
    angle = np.arctan2(sine, 0.5 * (np.trace(turn, axis1=1, axis2=2) - 1.0))
    # To first order at small angles, where the quotient is rounded.
    axis *= np.where(sine < 1e-9, 1.0, angle / np.maximum(sine, 1e-9))[:, None]
    # Half a turn has lost its axis: any will do, since the next step finds the right one.
    axis[(sine < 1e-9) & (angle > 1.0)] = (np.pi, 0.0, 0.0)
    half = 0.5 * np.maximum(angle, 1e-4)
    weight = np.where(angle < 1e-4, 1.0 / 12.0, (1.0 - half / np.tan(half)) / (4.0 * half**2))
    turned = _cross(axis, shift)
    linear = shift - 0.5 * turned + weight[:, None] * _cross(axis, turned)
    return np.concatenate((linear, axis), axis=1)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a × b of vectors (m, 3); NumPy's own takes several times as long."""
    return np.stack(
        (
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ),
        axis=-1,
    )


def wrapped(angles: FloatArray) -> FloatArray:
    """Bring angles into [-pi, pi]."""
    return angles - 2 * np.pi * np.round(angles / (2 * np.pi))


def distinct(chain: SerialChain, q: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the rows of q (m, k) that differ modulo whole turns, in order, and how often each is.

    Returns q, counts: rad or m, (n, k); (n,).
    """
    gaps = q[:, None] - q[None]
    gaps = np.abs(np.where(chain.slides, gaps, wrapped(gaps)))
    one = np.all(gaps <= DISTINCT * chain.per_radian, axis=-1)
    kept: list[int] = []
    for i in range(len(q)):
        if not one[i, kept].any():
            kept.append(i)
    return q[kept], np.sum(one[kept], axis=1)


def spread(chain: SerialChain, free: Sequence[int], count: int) -> FloatArray:
    """Return positions of joints, (count, n), spread evenly over whole turns, always the same.

    Those of joints that slide are spread over their limits, m.
    """
    angles = spread_angles(count, len(free))
    slides, low, high = chain.slides[free], chain.lower[free], chain.upper[free]
    travel = low + (angles + np.pi) / (2 * np.pi) * np.where(slides, high - low, 0.0)
    return np.where(slides, travel, angles)


def spread_angles(count: int, joints: int) -> FloatArray:
    """Return joint angles spread evenly over whole turns, always the same ones, rad.

    An additive recurrence with the powers of the root of x^(d+1) = x + 1, of low discrepancy in
    d dimensions (M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018).

    Returns in [-pi, pi), (count, joints).
    """
    root = 2.0
    for _ in range(40):
        root = (1.0 + root) ** (1.0 / (joints + 1.0))
    steps = root ** -np.arange(1.0, joints + 1.0)
    unit = (0.5 + np.arange(1.0, count + 1.0)[:, None] * steps) % 1.0
    return np.asarray(2 * np.pi * unit - np.pi)


@dataclass(frozen=True)
class MissedSolutions:
    """What poses solved from many starts tell about solutions that none of these found."""

    found: int  # Solutions of all poses
    arrived: int  # Starts that arrived at one
    # Solutions that were found so often
    once: int
    twice: int

    @property
    def chance_of_new(self) -> float:
        """How likely one more start that arrives has a solution not found, at 95 % confidence.

        Good's estimate is once / arrived; in place of the count stands the upper limit of the
        mean of a Poisson variable with that count, which is 3.0 at 0.
        """
        return float(gammaincinv(self.once + 1.0, 0.95)) / max(self.arrived, 1)

    @property
    def missed(self) -> float:
        """Chao's estimate of how many solutions were missed; a lower bound in expectation."""
        return self.once * (self.once - 1) / (2.0 * (self.twice + 1))


FREE_JOINTS = 6
FEWEST_JOINTS = 3
"""With fewer the tool is led along a surface, where most zero-offsets look like one another."""

OWN_CONFIGURATIONS = (
    'poses cannot be planned for it; measure configurations of your own choice, and make a '
    'session of their table: remaster import TABLE --urdf FILE --out SESSION'
)
"""What can be done with an arm whose solutions are not sought."""

# An arm is near one with a closed form where no axis is turned by more than this against it, rad,
# or shifted by more, m. Manufacture and wear leave a tenth of it. With three times as much, 3 of
# 1,000 solutions would be missed (see `_Exact.around`).
NEAR_RAD = 0.02
NEAR_M = 0.01
# Nearer than this, m and rad at the tool, both are one arm, written with other digits.
EXACT = 1e-9
# How many of these differences at the tool the poses around the one that is asked for are off. The
# true arm's solutions are those of the exact one at some pose that is one of it off.
AROUND = 2.0
# Solutions of the exact arm as near to one another as this, rad, give one start of Newton's.
ONE_START_RAD = 0.05
# Starts where no exact arm is near.
STARTS = 160
# Poses by which it is judged what they miss.
TRIAL_POSES = 20
# The free joints cannot move the tool in as many ways as they are where the smallest singular
# value of the Jacobian (m, rad) stays below. Errors of axes of some mrad lend a held elbow no
# more.
IMMOBILE = 5e-3


@dataclass(frozen=True)
class _Exact:
    """The nearest arm with a closed form, with the held joints at one combination of values."""

    chain: SerialChain  # Its six free joints
    robot: HPRobot  # EAIK's model of it, which has no rotation of the tool at zero
    # How far its tool is from that of the true arm at the same angles, at most
    difference_m: float
    difference_rad: float

    @property
    def is_the_arm(self) -> bool:
        """Whether the arm itself has the closed form."""
        return max(self.difference_m, self.difference_rad) < EXACT

    @cached_property
    def around(self) -> tuple[FloatArray, FloatArray]:
        """The pose itself and twelve around it: turns (n, 3, 3) and shifts, m, (n, 3).

        Six orthogonal directions and their opposites, so that one of them leads to where the
        exact arm has solutions which the true arm has at the pose itself.
        """
        if self.is_the_arm:
            return np.eye(3)[None], np.zeros((1, 3))
        directions = np.linalg.qr(np.sin(np.arange(1.0, 37.0)).reshape(6, 6))[0]
        twists = AROUND * np.vstack((np.zeros(6), directions, -directions))
        turns = rotation_vector_to_matrix(self.difference_rad * np.sqrt(2.0) * twists[:, 3:])
        return turns, self.difference_m * np.sqrt(2.0) * twists[:, :3]

    def starts(self, T: FloatArray) -> FloatArray:
        """Return angles near all solutions of the true arm at T (4, 4), and others, (m, 6)."""
        turns, shifts = self.around
        poses = np.broadcast_to(np.eye(4), (len(turns), 4, 4)).copy()
        poses[:, :3, :3] = turns @ T[:3, :3] @ self.chain.T_fixed[-1, :3, :3].T
        poses[:, :3, 3] = T[:3, 3] + shifts
        solved = [np.reshape(self.robot.IK(pose).Q, (-1, FREE_JOINTS)) for pose in poses]
        q = np.concatenate(solved)
        q = q[np.all(np.isfinite(q), axis=1)]
        if self.is_the_arm or not len(q):
            return q
        # Least-squares angles lie far from the pose.
        _, rotation, position = screws_and_tool(self.chain, q)
        off_m = np.linalg.norm(position - T[:3, 3], axis=1)
        # The Frobenius norm of a difference of rotations is 2 sqrt(2) sin(angle / 2).
        off_rad = np.linalg.norm(rotation - T[:3, :3], axis=(1, 2)) / np.sqrt(2.0)
        near = 2.0 * AROUND
        q = q[
            (off_m <= near * self.difference_m + EXACT)
            & (off_rad <= near * self.difference_rad + EXACT)
        ]
        gaps = np.max(np.abs(wrapped(q[:, None] - q[None])), axis=-1)
        return q[~np.any(np.tril(gaps < ONE_START_RAD, -1), axis=1)]


class InverseKinematics:
    """All joint solutions of a tool pose.

    A regular pose has up to eight solutions (sixteen for some arms) per value of the held joint.
    At a singular pose, where two joint axes line up or the shoulder's axis meets the wrist, a
    whole curve of joint angles reaches the pose: each branch that survives gives one point of it.
    Where branches meet (elbow straight), they are one solution. Everything returned satisfies
    forward kinematics within 1e-8 m and 1e-8 rad.

    Parameters
    ----------
    chain
        The arm: at most six joints, or more with the rest held.
    held
        Joint index (0 is the base's) -> the values, rad or m, at which it is held. None holds
        nothing on up to six joints and the third joint at 0 on seven, as the counts of poses and
        solutions in Van Wyk et al. suggest they did.

    Raises
    ------
    InputError
        The arm has other than six free joints, or more than three where it has no more; a held
        value lies outside the joint's limits, or the arm is singular wherever it is.
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
        self._parts: list[tuple[tuple[float, ...], _Exact | None]] = [
            (values, self._nearest_exact(values)) for values in product(*self.held.values())
        ]

    @property
    def way(self) -> Literal['closed form', 'near closed form', 'many starts']:
        """How solutions are found, for the held values for which that is hardest."""
        exact = [part for _, part in self._parts]
        if None in exact:
            return 'many starts'
        alike = all(part is not None and part.is_the_arm for part in exact)
        return 'closed form' if alike else 'near closed form'

    @property
    def difference(self) -> tuple[float, float] | None:
        """How far the nearest arm with a closed form is off at the tool, m and rad, at most.

        None where there is none for some held values.
        """
        found = [part for _, part in self._parts if part is not None]
        if len(found) < len(self._parts):
            return None
        return max(p.difference_m for p in found), max(p.difference_rad for p in found)

    def in_words(self) -> str:
        """Return in one sentence how solutions are found, and what they may lack."""
        within = 'each is kept where forward kinematics reaches the pose to 1e-8 m and 1e-8 rad'
        if self.difference is not None:
            off_m, off_rad = self.difference
            if self.way == 'closed form':
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
            f'{trial.arrived} starts arrived at {trial.found} solutions, {trial.once} of which '
            f'were found once: {100.0 * share:.1f} % are missed (by Chao), and the chance that '
            f'one more start finds a further one is below {100.0 * trial.chance_of_new:.1g} % '
            '(by Good, at 95 % confidence).'
        )

    def missed_solutions(self) -> MissedSolutions:
        """Return what many starts find of poses whose joint angles are spread evenly."""
        seeds = spread(self.chain, range(len(self.chain)), TRIAL_POSES)
        counts = []
        for q in seeds:
            values, _ = self._parts[0]
            q[list(self.held)] = values
            pose = self.chain.forward(q)
            starts = self._with_held(spread(self.chain, self._free, STARTS), values)
            found, left = reach_from(
                self.chain, self._free, starts, np.broadcast_to(pose, (STARTS, 4, 4))
            )
            counts.append(distinct(self.chain, found[left < CERTIFIED])[1])
        times = np.concatenate(counts)
        return MissedSolutions(
            len(times), int(times.sum()), int(np.sum(times == 1)), int(np.sum(times == 2))
        )

    def solutions_of_each(self, T: FloatArray) -> list[FloatArray]:
        """Return the joint solutions in [-pi, pi] of many tool poses (n, 4, 4), limits aside.

        Much faster than pose by pose.
        """
        starts = [
            np.concatenate([self._starts(values, exact, pose) for values, exact in self._parts])
            for pose in T
        ]
        owner = np.repeat(np.arange(len(T)), [len(q) for q in starts])
        q, left = reach_from(
            self.chain,
            self._free,
            np.concatenate([np.empty((0, len(self.chain))), *starts]),
            T[owner],
        )
        reached = left < CERTIFIED
        ends = np.cumsum(np.bincount(owner[reached], minlength=len(T)))[:-1]
        return [distinct(self.chain, mine)[0] for mine in np.split(q[reached], ends)]

    def usable(self, q: FloatArray) -> FloatArray:
        """Return those of joint solutions (m, k) that a turn brings within the limits, (n, k)."""
        q = self._towards_middle(q)
        return q[self.chain.within_limits(q, tolerance=1e-9)]

    def _starts(
        self, values: tuple[float, ...], exact: _Exact | None, T: FloatArray
    ) -> FloatArray:
        """Return where Newton's method starts for one combination of held values, (m, k)."""
        free = spread(self.chain, self._free, STARTS) if exact is None else exact.starts(T)
        return self._with_held(free, values)

    def _with_held(self, free: FloatArray, values: tuple[float, ...]) -> FloatArray:
        q = np.empty((len(free), len(self.chain)))
        q[:, self._free] = free
        q[:, list(self.held)] = values
        return q

    def _require_mobility(self) -> None:
        """Refuse held joints that leave the tool fewer ways to move than joints, wherever it is.

        Holding the elbow of an S-R-S arm does: the wrist stays at its distance to the shoulder,
        and the arm still swings about the line between them.
        """
        chain = self.chain
        if _is_mobile(chain, {joint: values[0] for joint, values in self.held.items()}):
            return
        names = ', '.join(chain.joint_names[joint] for joint in self.held)
        others = [
            f'{name} (at {chain.shown_offset(joint, value, 0)}, say)'
            for joint, name in enumerate(chain.joint_names)
            for value in (_middle(chain, joint),)
            if len(self.held) == 1 and _is_mobile(chain, {joint: value})
        ]
        remedy = (
            f'held_joint in the cell file may be {" or ".join(others)}'
            if others
            else OWN_CONFIGURATIONS
        )
        raise InputError(
            f"inverse kinematics: with {names or 'no joint'} held, robot '{chain.name}' is "
            f'singular everywhere; {remedy}'
        )

    def _nearest_exact(self, values: tuple[float, ...]) -> _Exact | None:
        """Return the nearest arm with a closed form; None where none is near."""
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
        # At most 2 sin(angle / 2) of sqrt(2) times it, see `_Exact.starts`.
        return _Exact(
            exact,
            robot,
            float(np.max(np.linalg.norm(off[:, :3, 3], axis=1))),
            float(np.max(np.linalg.norm(off[:, :3, :3], axis=(1, 2))) / np.sqrt(2.0)),
        )

    def _towards_middle(self, q: FloatArray) -> FloatArray:
        """Turn joints by whole turns as near the middle of their ranges as they come.

        What slides has no turns.
        """
        bounded = np.isfinite(self.chain.lower) & np.isfinite(self.chain.upper)
        middle = np.zeros(len(self.chain))
        middle[bounded] = (self.chain.lower + self.chain.upper)[bounded] / 2
        turns = np.where(self.chain.slides, 0.0, np.round((middle - q) / (2 * np.pi)))
        return q + 2 * np.pi * turns


def _is_mobile(chain: SerialChain, held: Mapping[int, float]) -> bool:
    """Return whether the free joints move the tool in as many ways at any of a few places."""
    spread = np.sin(np.arange(8.0 * len(chain))).reshape(8, -1)
    spread[:, list(held)] = list(held.values())
    free = [i for i in range(len(chain)) if i not in held]
    screws = screws_and_tool(chain, spread)[0][..., free]
    return bool(np.max(np.linalg.svd(screws, compute_uv=False)[:, -1]) >= IMMOBILE)


def _check_held(chain: SerialChain, held: Mapping[int, Sequence[float]]) -> None:
    free = len(chain) - len(held)
    if free != min(len(chain), FREE_JOINTS) or free < FEWEST_JOINTS:
        raise InputError(
            f'inverse kinematics: {len(chain)} joints with {len(held)} held leave {free} free; '
            f'poses need {FREE_JOINTS} free joints, or all of {FEWEST_JOINTS} to '
            f'{FREE_JOINTS - 1}: hold none of six or fewer, one of seven'
        )
    for joint, values in held.items():
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
    """Make axes exactly parallel, and let them meet exactly, where they nearly do.

    ``axes, points``: direction and a point of each of six axes at zero, (6, 3).
    Returns axes, points: Those of the exact arm.
    """
    axes, points = axes.copy(), points.copy()
    count = len(axes)
    # Turned about points near the arm: the origin of a joint may be metres along its axis.
    before = np.zeros(3)
    for i in range(count):
        before = points[i] = points[i] + axes[i] * (axes[i] @ (before - points[i]))
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
            # What follows is carried along, with what meets there.
            points[i + 1 :] -= gap * normal
    return axes, points


def _meeting_point(axes: FloatArray, points: FloatArray) -> tuple[FloatArray, float]:
    """Return the point nearest to three lines, m, (3,), and how far the farthest is from it, m."""
    # Sum of (I - a a^T)(x - o) = 0.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    to_lines = np.einsum('nij,nj->ni', across, points)
    point = np.linalg.lstsq(across.sum(axis=0), to_lines.sum(axis=0), rcond=None)[0]
    return point, float(np.max(np.linalg.norm(across @ point - to_lines, axis=1)))


def _may_have_closed_form(axes: FloatArray, origins: FloatArray) -> bool:
    """Return whether three successive axes are parallel, or the first or last three meet.

    All of EAIK's decompositions need one of these; with other arms EAIK writes to the terminal.
    """
    neighbours = np.linalg.norm(np.cross(axes[:-1], axes[1:]), axis=1) < 1e-9
    if np.any(neighbours[:-1] & neighbours[1:]):
        return True
    return any(
        _meeting_point(axes[three], origins[three])[1] < EXACT
        for three in (slice(0, 3), slice(3, 6))
    )


def _middle(chain: SerialChain, joint: int) -> float:
    """Return zero, or mid-range where the limits exclude it, rad or m."""
    low, high = chain.lower[joint], chain.upper[joint]
    if not chain.slides[joint]:
        low, high = max(low, -np.pi), min(high, np.pi)
    return 0.0 if low < 0.0 < high else float(low + high) / 2
