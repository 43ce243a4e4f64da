# SPDX-License-Identifier: Apache-2.0
"""Newton's method for many poses from many starts at once.

One row is one start for one pose. Steps are damped (Levenberg) and limited; references are in
`inverse_kinematics`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, IntArray

CERTIFIED = 1e-8
"""Largest error of a solution by forward kinematics: 10 nm and 10 nrad."""
DISTINCT = 1e-4
"""Largest difference of any joint between two solutions that count as one, rad."""

# Most steps of Newton's method, which ends at a hundredth of `CERTIFIED`. Where two solutions
# merge each step only halves the error, as from 0.1 rad to 1e-4 rad in ten steps.
_STEPS = 60
# Longest step of a revolute joint, up to which the derivative at its start holds: sin x is x to
# 4 %. A prismatic joint moves the tool in proportion, and its steps have any length.
_LONGEST_RAD = 0.5
# Rows computed at a time, which bounds the memory: about 2 kB per row.
_ROWS = 20_000


def reach_from(
    chain: SerialChain, free: Sequence[int], starts: FloatArray, T: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Solve poses by damped Newton steps from start configurations, one start for one pose each.

    ``free``: indices of the joints that may move, at most six; ``starts``: rad or m, (m, k);
    ``T``: pose T_R_T of each start, (m, 4, 4). Returns the final configurations, (m, k), with free
    revolute joints in [-pi, pi], and their residuals, (m,): the larger of the translation, m, and
    rotation, rad, between tool and pose. The caller checks convergence by the residual.
    """
    q, residuals = starts.copy(), np.empty(len(starts))
    for first in range(0, len(q), _ROWS):
        rows = slice(first, first + _ROWS)
        q[rows], residuals[rows] = _newton(chain, list(free), q[rows], T[rows])
    turning = [joint for joint in free if not chain.slides[joint]]
    q[:, turning] = wrapped(q[:, turning])
    return q, residuals


def _newton(
    chain: SerialChain, free: list[int], q: FloatArray, T: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Damped Newton steps of starts q, (n, k), changed in place, towards poses T, (n, 4, 4).

    Returns q and the residuals, (n,), as in `reach_from`. ``free``: indices of the joints that may
    change. At most `_STEPS` steps, in each of which a joint turns by at most `_LONGEST_RAD`.
    """
    residuals = np.full(len(q), np.inf)
    active = np.arange(len(q))
    diagonal, turning = np.arange(len(free)), ~chain.slides[free]
    for step in range(_STEPS + 1):
        screws, rotation, position = screws_and_tool(chain, q[active])
        twists = twists_to(T[active], rotation, position)
        residuals[active] = np.sqrt(
            np.max(np.sum(twists.reshape(-1, 2, 3) ** 2, axis=-1), axis=-1)
        )
        unsolved = residuals[active] > 0.01 * CERTIFIED
        active = active[unsolved]
        if step == _STEPS or not len(active):
            break
        jacobian, twists = screws[unsolved][:, :, free], twists[unsolved]
        transposed = np.swapaxes(jacobian, 1, 2)
        normal = transposed @ jacobian
        # Damped in proportion to the squared error, so that the last steps are undamped Newton
        # steps; 1e-12 keeps them solvable at singular configurations.
        squared = np.sum(twists**2, axis=1)
        normal[:, diagonal, diagonal] += (0.01 * np.minimum(squared, 1.0) + 1e-12)[:, None]
        moves = np.linalg.solve(normal, transposed @ twists[:, :, None])[:, :, 0]
        longest = np.max(np.abs(moves) * turning, axis=1, keepdims=True)
        q[active[:, None], free] += moves * (_LONGEST_RAD / np.maximum(longest, _LONGEST_RAD))
    return q, residuals


def screws_and_tool(
    chain: SerialChain, q: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return joint screws in R, (m, 6, k), tool rotation, (m, 3, 3), and position, m, (m, 3).

    At configurations q (m, k). A screw is (o × a, a) of a revolute joint with axis a through o,
    (a, 0) of a prismatic one. Several times as fast as `SerialChain.frames`: with joint axes along
    Z, a rotation needs no product of matrices.
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
    """Return the twists in R that move tools to poses T (m, 4, 4): the logarithm of SE(3), (m, 6).

    ``rotation``, ``position``: those of the tools. The full logarithm, because a closed-form
    solution at a singular pose may be off by a rotation of any size, which one step then corrects.
    Faster than with SciPy's rotations.
    """
    turn = T[:, :3, :3] @ np.swapaxes(rotation, 1, 2)
    shift = T[:, :3, 3] - (turn @ position[:, :, None])[:, :, 0]
    across = turn - np.swapaxes(turn, 1, 2)
    axis = 0.5 * np.stack((across[:, 2, 1], across[:, 0, 2], across[:, 1, 0]), axis=-1)
    sine = np.sqrt(np.sum(axis**2, axis=1))
    angle = np.arctan2(sine, 0.5 * (np.trace(turn, axis1=1, axis2=2) - 1.0))
    # First order at small angles, at which the quotient is inaccurate.
    axis *= np.where(sine < 1e-9, 1.0, angle / np.maximum(sine, 1e-9))[:, None]
    # At half a turn the axis is undetermined: any will do, as the next step finds the right one.
    axis[(sine < 1e-9) & (angle > 1.0)] = (np.pi, 0.0, 0.0)
    half = 0.5 * np.maximum(angle, 1e-4)
    weight = np.where(angle < 1e-4, 1.0 / 12.0, (1.0 - half / np.tan(half)) / (4.0 * half**2))
    turned = _cross(axis, shift)
    linear = shift - 0.5 * turned + weight[:, None] * _cross(axis, turned)
    return np.concatenate((linear, axis), axis=1)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a × b of vectors (m, 3), in a fraction of the time of `numpy.cross`."""
    return np.stack(
        (
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ),
        axis=-1,
    )


def wrapped(angles: FloatArray) -> FloatArray:
    """Return angles, rad, shifted by whole turns into [-pi, pi]; both ends occur."""
    return angles - 2 * np.pi * np.round(angles / (2 * np.pi))


def distinct(chain: SerialChain, q: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return distinct configurations of q (m, k), modulo whole turns, and how often each occurs.

    In order of first occurrence: rad or m, (n, k), and counts, (n,). Tolerance of each joint:
    `DISTINCT`; of a prismatic one `per_radian` times as much, without turns.
    """
    gaps = q[:, None] - q[None]
    gaps = np.abs(np.where(chain.slides, gaps, wrapped(gaps)))
    is_same = np.all(gaps <= DISTINCT * chain.per_radian, axis=-1)
    kept: list[int] = []
    for i in range(len(q)):
        if not is_same[i, kept].any():
            kept.append(i)
    return q[kept], np.sum(is_same[kept], axis=1)


def spread(chain: SerialChain, free: Sequence[int], count: int) -> FloatArray:
    """Return evenly spread positions of the free joints, (count, n), the same at every call.

    Over whole turns of revolute joints, rad, and over the limits of prismatic ones, m.
    """
    angles = spread_angles(count, len(free))
    slides, low, high = chain.slides[free], chain.lower[free], chain.upper[free]
    travel = low + (angles + np.pi) / (2 * np.pi) * np.where(slides, high - low, 0.0)
    return np.where(slides, travel, angles)


def spread_angles(count: int, joints: int) -> FloatArray:
    """Return evenly spread angles in [-pi, pi), (count, joints), the same at every call.

    An additive recurrence with the powers of the root of x^(d+1) = x + 1, of low discrepancy in
    d dimensions (M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018).
    """
    root = 2.0
    for _ in range(40):
        root = (1.0 + root) ** (1.0 / (joints + 1.0))
    steps = root ** -np.arange(1.0, joints + 1.0)
    unit = (0.5 + np.arange(1.0, count + 1.0)[:, None] * steps) % 1.0
    return np.asarray(2 * np.pi * unit - np.pi)
