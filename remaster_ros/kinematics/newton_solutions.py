"""Joint angles that reach tool poses, by Newton's method from many starts at once.

One row is one start for one pose. Steps are damped (Levenberg [1]_) and limited, so that also
starts far from any solution arrive at one: of a six-joint arm's starts spread evenly, nearly all
do where the pose can be reached, and to each of its solutions about as often.

How many solutions such starts may have missed follows from how often each was found [2]_ [3]_.

References
----------
.. [1] K. Levenberg, "A method for the solution of certain non-linear problems in least squares",
   Quarterly of Applied Mathematics 2, 1944; for arms: T. Sugihara, "Solvability-unconcerned
   inverse kinematics by the Levenberg-Marquardt method", IEEE Transactions on Robotics 27, 2011.
.. [2] I. J. Good, "The population frequencies of species and the estimation of population
   parameters", Biometrika 40, 1953: the chance that a further draw is of a kind not seen is near
   the share of draws whose kind was seen once.
.. [3] A. Chao, "Nonparametric estimation of the number of classes in a population",
   Scandinavian Journal of Statistics 11, 1984; bias-corrected as in R. K. Colwell et al.,
   Journal of Plant Ecology 5, 2012, equation 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, IntArray

CERTIFIED = 1e-8
"""What forward kinematics may leave of a solution: 10 nm and 10 nrad."""
DISTINCT = 1e-4
"""Solutions whose joints all agree within this, rad, are one."""

# Steps are taken until a hundredth of what is certified remains; where two solutions are about to
# meet they halve the rest, as from 0.1 rad to 1e-4 rad in ten steps.
_STEPS = 60
# Longer steps leave what the derivative at their start holds for: sin x is x to 4 % up to here.
_LONGEST_RAD = 0.5
# Rows computed at a time, which bounds the memory: some 2 kB each.
_ROWS = 20_000


def reach_from(
    chain: SerialChain, free: Sequence[int], starts: FloatArray, T: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Bring starts to the poses that they are for.

    ``free``: joints that may turn, six; ``starts``: rad, (m, k); ``T``: T_R_T of each, (m, 4, 4).
    Returns q: Where they arrive, in [-pi, pi] for the free joints, rad, (m, k); left: The larger
    of the translation, m, and rotation, rad, between tool and pose, (m,).
    """
    q, left = starts.copy(), np.empty(len(starts))
    for first in range(0, len(q), _ROWS):
        rows = slice(first, first + _ROWS)
        q[rows], left[rows] = _newton(chain, list(free), q[rows], T[rows])
    q[:, free] = wrapped(q[:, free])
    return q, left


def _newton(
    chain: SerialChain, free: list[int], q: FloatArray, T: FloatArray
) -> tuple[FloatArray, FloatArray]:
    left = np.full(len(q), np.inf)
    going = np.arange(len(q))
    diagonal = np.arange(6)
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
        normal = jacobian @ transposed
        # Damped in proportion to the square of what is missing, so that the last steps are
        # Newton's; 1e-12 keeps them solvable where the arm is singular.
        squared = np.sum(missing**2, axis=1)
        normal[:, diagonal, diagonal] += (0.01 * np.minimum(squared, 1.0) + 1e-12)[:, None]
        turns = (transposed @ np.linalg.solve(normal, missing[:, :, None]))[:, :, 0]
        longest = np.max(np.abs(turns), axis=1, keepdims=True)
        q[going[:, None], free] += turns * (_LONGEST_RAD / np.maximum(longest, _LONGEST_RAD))
    return q, left


def screws_and_tool(
    chain: SerialChain, q: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the joints' screws in R, o × a and a, (m, 6, k), and the tool in R at q (m, k).

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
    motion holds it exactly, and one step makes up for it. It is `transforms.twist_logarithm`
    without what SciPy's rotations cost.
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


def distinct(q: FloatArray, apart_rad: float = DISTINCT) -> tuple[FloatArray, IntArray]:
    """Return the rows of q (m, k) that differ modulo whole turns, in order, and how often each is.

    Returns q, counts: rad, (n, k); (n,).
    """
    one = np.max(np.abs(wrapped(q[:, None] - q[None])), axis=-1) <= apart_rad
    kept: list[int] = []
    for i in range(len(q)):
        if not one[i, kept].any():
            kept.append(i)
    return q[kept], np.sum(one[kept], axis=1)


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
