"""All analytical inverse-kinematics solutions of a pose, certified by forward kinematics.

EAIK [1]_ decomposes arms of six free joints into closed-form subproblems. It needs exact geometry
(axes that meet or are parallel to 1e-13), and at singular or unreachable poses it returns
least-squares angles, some of them wrong, or zero for an angle that is not determined. So it gets
a cleaned model of the arm; its results are corrected on the true model by Newton's method and
kept only where forward kinematics confirms them.

References
----------
.. [1] D. Ostermeier, J. Külz, M. Althoff, "Automatic Geometric Decomposition for Analytical
   Inverse Kinematics", IEEE Robotics and Automation Letters, 2025.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from eaik.IK_HP import HPRobot
from numpy.typing import ArrayLike

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse, twist_logarithm
from remaster_ros.types import FloatArray

FREE_JOINTS = 6

OWN_CONFIGURATIONS = (
    'poses cannot be planned for it; measure configurations of your own choice, and make a '
    'session of their table: remaster import TABLE --urdf FILE --out SESSION'
)
"""What can be done with an arm that has no closed form."""

# Entries of the arm's fixed rotations and translations below this count as a zero that was
# rounded (rpy="1.5708 0 0", a 0.4 mm CAD artefact). Newton's method takes the difference back.
SNAP = 1e-3
# As calibrated, axes that are drawn parallel are so no longer.
_OF_ONE_ARM = (
    " (that is so of a description with one arm's own calibration in it, as kinematics_params of "
    'a UR)'
)
# What forward kinematics may leave of a solution: 10 nm and 10 nrad.
CERTIFIED = 1e-8
# Solutions whose joints all agree within this, rad, are one.
DISTINCT = 1e-4
NEWTON_STEPS = 12
# Singular values below this share of the largest are left alone: no long steps at singularities.
SINGULAR = 1e-6


@dataclass(frozen=True)
class _Decomposition:
    """EAIK's model of the arm with the held joints at one combination of values.

    ``rotation`` is the tool's rotation at zero, which EAIK does not carry.
    """

    held_values: tuple[float, ...]
    robot: HPRobot
    rotation: FloatArray


class InverseKinematics:
    """All joint solutions of a tool pose in closed form.

    A regular pose has up to eight solutions (sixteen for some arms) per value of the held joint.
    At a singular pose, where two joint axes line up or the shoulder's axis meets the wrist, a
    whole curve of joint angles reaches the pose: each branch that survives gives one point of it.
    Where branches meet (elbow straight), they are one solution. Everything returned satisfies
    forward kinematics within 1e-8 m and 1e-8 rad.

    Parameters
    ----------
    chain
        The arm: six joints, or more with the rest held.
    held
        Joint index (0 is the base's) -> the values, rad, at which this joint is held. None holds
        nothing on six joints and the third joint at 0 on seven, as the counts of poses and
        solutions in Van Wyk et al. suggest they did.

    Raises
    ------
    InputError
        The arm has not six free joints, a held value lies outside the joint's limits, or the arm
        has no closed form.
    """

    def __init__(
        self, chain: SerialChain, held: Mapping[int, Sequence[float]] | None = None
    ) -> None:
        if held is None:
            held = {2: (0.0,)} if len(chain) == FREE_JOINTS + 1 else {}
        _check_held(chain, held)
        try:
            self._prepare(chain, held)
        except InputError as error:
            if len(chain) == FREE_JOINTS + 1:
                raise InputError(f'{error}; {_what_may_be_held(chain)}') from None
            if len(chain) == FREE_JOINTS:
                raise InputError(f'{error}{_OF_ONE_ARM}; {OWN_CONFIGURATIONS}') from None
            raise

    def _prepare(self, chain: SerialChain, held: Mapping[int, Sequence[float]]) -> None:
        """Set up the closed forms; an `InputError` where these held joints leave none."""
        self.chain = chain
        self.held = {joint: tuple(map(float, held[joint])) for joint in sorted(held)}
        self._free = [i for i in range(len(chain)) if i not in held]
        self._require_mobility()
        clean = _cleaned(chain)
        self._decompositions = [
            self._decompose(clean, values) for values in product(*self.held.values())
        ]

    def solutions(self, T: ArrayLike, within_limits: bool = True) -> FloatArray:
        """Return the joint solutions of one tool pose.

        Parameters
        ----------
        T
            T_R_T, (4, 4).
        within_limits
            Keep solutions within the joint limits only, each joint turned by whole turns towards
            the middle of its range. Without, angles lie in [-pi, pi].

        Returns
        -------
        ndarray
            rad, (m, k); m is 0 where no solution exists.
        """
        T = np.asarray(T, dtype=float)
        q = self._certified(T)
        if not within_limits:
            return q
        q = self._towards_middle(q)
        return q[self.chain.within_limits(q, tolerance=1e-9)]

    def _require_mobility(self) -> None:
        """Refuse held joints that leave the tool fewer than six ways to move, wherever it is.

        Holding the elbow of an S-R-S arm does: the wrist stays at its distance to the shoulder,
        and the arm still swings about the line between them.
        """
        spread = np.sin(np.arange(8.0 * len(self.chain))).reshape(8, -1)
        spread[:, list(self.held)] = [values[0] for values in self.held.values()]
        singular_values = np.linalg.svd(self._jacobian(spread)[..., self._free], compute_uv=False)
        if np.max(singular_values[:, -1]) < SINGULAR:
            names = ', '.join(self.chain.joint_names[joint] for joint in self.held)
            raise InputError(
                f"inverse kinematics: with {names or 'no joint'} held, robot '{self.chain.name}' "
                'is singular everywhere'
            )

    def _decompose(self, clean: SerialChain, values: tuple[float, ...]) -> _Decomposition:
        """Prepare EAIK for the cleaned arm with the held joints at the given values."""
        q = np.zeros(len(clean))
        q[list(self.held)] = values
        frames, tip = clean.frames(q), clean.forward(q)
        axes = clean.axes_in_base(frames)[self._free]
        origins = frames[self._free, :3, 3]
        if not _may_have_closed_form(axes, origins):
            raise InputError(_no_closed_form(self.chain, self.held))
        steps = np.diff(np.vstack((np.zeros(3), origins, tip[:3, 3])), axis=0)
        robot = HPRobot(axes, steps)
        if not robot.hasKnownDecomposition():
            raise InputError(_no_closed_form(self.chain, self.held))
        return _Decomposition(values, robot, tip[:3, :3])

    def _certified(self, T: FloatArray) -> FloatArray:
        """Return all distinct solutions, regardless of limits, angles in [-pi, pi], (m, k)."""
        if T.shape != (4, 4) or not np.all(np.isfinite(T)):
            raise ValueError(f'a pose is a finite matrix of shape (4, 4), not {T.shape}')
        candidates = [self._closed_form(part, T) for part in self._decompositions]
        q = self._corrected(np.concatenate(candidates), T)
        return _distinct(q)

    def _closed_form(self, part: _Decomposition, T: FloatArray) -> FloatArray:
        """Return EAIK's results for one combination of held values, also wrong ones, (m, k)."""
        without_tool_rotation = T.copy()
        without_tool_rotation[:3, :3] = T[:3, :3] @ part.rotation.T
        free = np.reshape(part.robot.IK(without_tool_rotation).Q, (-1, FREE_JOINTS))
        q = np.empty((len(free), len(self.chain)))
        q[:, self._free] = free
        q[:, list(self.held)] = part.held_values
        return q[np.all(np.isfinite(q), axis=1)]

    def _corrected(self, q: FloatArray, T: FloatArray) -> FloatArray:
        """Correct candidates (m, k) on the true model; return those that reach T."""
        missing = self._missing(q, T)
        for _ in range(NEWTON_STEPS):
            wrong = np.flatnonzero(_size(missing) > 0.01 * CERTIFIED)
            if not len(wrong):
                break
            jacobian = self._jacobian(q[wrong])[..., self._free]
            step = np.linalg.pinv(jacobian, rcond=SINGULAR) @ missing[wrong, :, None]
            q[wrong[:, None], self._free] += step[..., 0]
            missing[wrong] = self._missing(q[wrong], T)
        return _wrapped(q[_size(missing) < CERTIFIED])

    def _missing(self, q: FloatArray, T: FloatArray) -> FloatArray:
        """Return the screw motions in R that bring the tool at q (m, k) to T, (m, 6).

        Where two axes line up EAIK leaves out a turn about them, of any size: a screw motion
        holds it exactly, and one Newton step makes up for it.
        """
        return twist_logarithm(T @ inverse(self.chain.forward(q)))

    def _jacobian(self, q: FloatArray) -> FloatArray:
        """Return the joints' screws in R, o × a and a, (m, 6, k)."""
        frames = self.chain.frames(q)
        axes = self.chain.axes_in_base(frames)
        screws = np.concatenate((np.cross(frames[..., :3, 3], axes), axes), axis=-1)
        return np.swapaxes(screws, -1, -2)

    def _towards_middle(self, q: FloatArray) -> FloatArray:
        """Turn joints by whole turns as near the middle of their ranges as they come."""
        bounded = np.isfinite(self.chain.lower) & np.isfinite(self.chain.upper)
        middle = np.zeros(len(self.chain))
        middle[bounded] = (self.chain.lower + self.chain.upper)[bounded] / 2
        return q + 2 * np.pi * np.round((middle - q) / (2 * np.pi))


def _check_held(chain: SerialChain, held: Mapping[int, Sequence[float]]) -> None:
    free = len(chain) - len(held)
    if free != FREE_JOINTS:
        raise InputError(
            f'inverse kinematics: {len(chain)} joints with {len(held)} held leave {free} free; '
            f'closed forms need {FREE_JOINTS} free joints: hold none of six, one of seven'
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
                    f'rad; its limits are {chain.lower[joint]:.4f} to {chain.upper[joint]:.4f}'
                )


def _cleaned(chain: SerialChain) -> SerialChain:
    """Return the arm with rounded zeros made exact."""
    T = np.where(np.abs(chain.T_fixed_z) < SNAP, 0.0, chain.T_fixed_z)
    left, _, right = np.linalg.svd(T[:, :3, :3])
    T[:, :3, :3] = left @ right
    axes = np.broadcast_to((0.0, 0.0, 1.0), (len(chain), 3))
    return replace(chain, T_fixed=T, axes=axes)


def _may_have_closed_form(axes: FloatArray, origins: FloatArray) -> bool:
    """Return whether three successive axes are parallel, or the first or last three meet.

    All of EAIK's decompositions need one of these; with other arms EAIK writes to the terminal.
    """
    neighbours = np.linalg.norm(np.cross(axes[:-1], axes[1:]), axis=1) < 1e-9
    if np.any(neighbours[:-1] & neighbours[1:]):
        return True
    for three in (slice(0, 3), slice(3, 6)):
        # The point nearest to three lines: sum of (I - a a^T)(x - o) = 0.
        across = np.eye(3) - axes[three, :, None] * axes[three, None, :]
        to_lines = np.einsum('nij,nj->ni', across, origins[three])
        point = np.linalg.lstsq(across.sum(axis=0), to_lines.sum(axis=0), rcond=None)[0]
        if np.max(np.abs(across @ point - to_lines)) < 1e-9:
            return True
    return False


def _no_closed_form(chain: SerialChain, held: Mapping[int, Sequence[float]]) -> str:
    free = ', '.join(name for i, name in enumerate(chain.joint_names) if i not in held)
    return (
        f"inverse kinematics: robot '{chain.name}' has no closed form in {free}: no three "
        'successive axes are parallel, nor do the first or last three meet in a point'
    )


def _what_may_be_held(chain: SerialChain) -> str:
    """Return which joints of seven leave a closed form, found by trying each."""
    good = []
    for joint, name in enumerate(chain.joint_names):
        for value in _trial_values(chain, joint):
            solver = InverseKinematics.__new__(InverseKinematics)
            try:
                solver._prepare(chain, {joint: (value,)})
            except InputError:
                continue
            good.append(f'{name} (at {np.degrees(value):.0f} degrees, say)')
            break
    if good:
        return f'held_joint in the cell file may be {" or ".join(good)}'
    return f'no joint of this arm may be held instead: {OWN_CONFIGURATIONS}'


def _trial_values(chain: SerialChain, joint: int) -> list[float]:
    """Return angles to try to hold a joint at: zero or mid-range, and off it, rad."""
    low, high = max(chain.lower[joint], -np.pi), min(chain.upper[joint], np.pi)
    middle = 0.0 if low < 0.0 < high else (low + high) / 2
    return [middle, *(v for v in (middle + np.pi / 6, middle - np.pi / 6) if low <= v <= high)]


def _size(twists: FloatArray) -> FloatArray:
    """Return the larger of translation, m, and rotation, rad, of twists (m, 6), (m,)."""
    return np.max(np.linalg.norm(twists.reshape(-1, 2, 3), axis=-1), axis=-1)


def _wrapped(angles: FloatArray) -> FloatArray:
    """Bring angles into [-pi, pi]."""
    return angles - 2 * np.pi * np.round(angles / (2 * np.pi))


def _distinct(q: FloatArray) -> FloatArray:
    """Return the rows of q (m, k) without repetitions modulo whole turns, in order."""
    apart = np.max(np.abs(_wrapped(q[:, None] - q[None])), axis=-1) > DISTINCT
    kept: list[int] = []
    for i in range(len(q)):
        if apart[i, kept].all():
            kept.append(i)
    return q[kept]
