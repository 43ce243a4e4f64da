# SPDX-License-Identifier: Apache-2.0
"""The correction along a path: as near to the wanted tool as accelerations allow.

The change c of the joints and its speed are sought at each of n times; between them it is the
cubic that a trajectory controller draws. With the pose errors e of the tool and its Jacobian J::

    minimise  Σ h |e + J Δc|² + μ² h |c|² + Σ κ h |c - f|² + Σ ρ h |acceleration of c|²

The weights ρ of intervals whose accelerations or speeds would pass a limit are raised until none
does. The weights κ pull the change to that of the joint angles' own errors f, and are raised where
a change passes its bound: so a singularity is passed smoothly in directions in which the tool
hardly moves, while the visible part of the correction is kept. On the bounds themselves the change
could only jump from one to the other, as the sign of a singular direction changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from remaster_ros.compensation.bounded_poses import LEAST_WORTH
from remaster_ros.types import BoolArray, FloatArray

# Initial ρ: an added acceleration as large as the limit weighs as a tool error of a micrometre a
# metre.
FIRST_WEIGHT = 1e-6
# Least and largest factor of ρ for an interval that passes a limit, and the number of neighbouring
# intervals to which it applies.
HEAVIER = (4.0, 1e3)
NEIGHBOURS = 2
# Share that a change may add to an acceleration that passes its limit already.
ADDED = 0.1
# Initial κ, as of a direction in which a radian moves the tool by a hundredth of a lever, and its
# factor if it does not suffice.
FIRST_PULL, PULL_HEAVIER = 1e-4, 10.0
# Added to a matrix with 1 on its diagonal, so that rounding makes no eigenvalue negative.
ROUNDING = 1e-13
# Limit of rounds of weights: most paths take ten, and no path of the tests more than thirty.
ROUNDS = 40
# Convergence limit of the change once no limit is passed, rad.
CONVERGED_RAD = 1e-6

# Changes (n, k) -> weighted pose errors (n, 6) and Jacobians (n, 6, k)
Errors = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, eq=False)
class Limits:
    """Largest acceleration, speed and change of a corrected path; k joints, n times."""

    acceleration: FloatArray  # Acceleration of the path with its change, rad/s², (k,)
    speed: FloatArray  # rad/s, (k,)
    change: FloatArray  # rad, (n, k)


@dataclass(frozen=True, eq=False)
class Ends:
    """Known joint changes at the first and the last time of a path, and whether it rests there.

    Changes in rad, (k,) each; None if the change is free there.
    """

    first: FloatArray | None
    last: FloatArray | None
    # Whether the path rests there, and with it the change
    first_rests: bool
    last_rests: bool


@dataclass(frozen=True, eq=False)
class SmoothChanges:
    """Joint changes along a path, cubics over time, and the weights that produced them."""

    times_s: FloatArray  # Ascending, (n,)
    change: FloatArray  # At each time, rad, (n, k)
    speed: FloatArray  # Of the change, rad/s, (n, k)
    # ρ of each interval and joint, (n - 1, k), and κ of each time, (n,)
    weight: FloatArray
    pull: FloatArray

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Changes, rad, and their speeds, rad/s, at times (m,), s, each (m, k), by the cubics."""
        cubic = scipy.interpolate.CubicHermiteSpline(self.times_s, self.change, self.speed)
        return np.asarray(cubic(times)), np.asarray(cubic(times, 1))


def smooth_changes(
    errors: Errors,
    times_s: FloatArray,
    angle_change: FloatArray,
    wanted: tuple[FloatArray, FloatArray],
    limits: Limits,
    ends: Ends,
    before: SmoothChanges | None = None,
) -> SmoothChanges:
    """Joint changes along a path that keep the tool as near to the wanted one as limits allow.

    After `ROUNDS` rounds they are returned as they are, even if a limit is still exceeded.

    Parameters
    ----------
    errors
        Function of changes (n, k) that returns weighted pose errors, (n, 6), and Jacobians,
        (n, 6, k).
    times_s
        Ascending, (n,), n >= 2.
    angle_change
        f, the change that removes the errors of the joint angles alone, (n, k).
    wanted
        Accelerations of the path at the start and the end of each interval, (n - 1, 2, k), and
        speeds at each time, (n, k).
    limits, ends
        Constraints of the corrected path.
    before
        Result for other times of the same path, to begin with.
    """
    n, k = angle_change.shape
    h = np.diff(times_s)
    share = np.zeros(n)
    share[:-1] += 0.5 * h
    share[1:] += 0.5 * h
    # Accelerations at both ends of an interval from (c, speed) before and after it: (n - 1, 2, 4).
    per = 1.0 / h[:, None]
    rows = np.stack(
        (
            np.concatenate((-6.0 * per**2, -4.0 * per, 6.0 * per**2, -2.0 * per), axis=1),
            np.concatenate((6.0 * per**2, 2.0 * per, -6.0 * per**2, 4.0 * per), axis=1),
        ),
        axis=1,
    )
    pull = np.zeros(n)
    weight = np.tile((FIRST_WEIGHT / limits.acceleration) ** 2, (n - 1, 1))
    state = np.zeros((n, 2, k))
    state[:, 0] = angle_change
    if before is not None:
        state[:, 0], state[:, 1] = before.at(times_s)
        inside = np.searchsorted(before.times_s, times_s, side='right') - 1
        last = len(before.times_s) - 2
        weight, pull = before.weight[np.minimum(inside[:-1], last)], before.pull[inside]
    for end, given in ((0, ends.first), (n - 1, ends.last)):
        if given is not None:
            state[end, 0] = given
    fixed = np.zeros((n, 2, k), dtype=bool)
    fixed[0, 0], fixed[-1, 0] = ends.first is not None, ends.last is not None
    fixed[0, 1], fixed[-1, 1] = ends.first_rests, ends.last_rests
    for _ in range(ROUNDS):
        error, jacobian = errors(state[:, 0])
        step = _step(error, jacobian, state, angle_change, rows, h, share, weight, pull, fixed)
        state = state + step
        over = _limit_shares(state[:, 1], accelerations(rows, state), wanted, limits)
        far = np.any((np.abs(state[:, 0]) > limits.change) & ~fixed[:, 0], axis=1)
        if over.max() > 1.0 or far.any():
            # A weight of an interval alone would only move what is too much to the next ones.
            local_max = scipy.ndimage.maximum_filter1d(over, 2 * NEIGHBOURS + 1)
            factor = np.clip(local_max**2, HEAVIER[0], HEAVIER[1])
            weight = np.where(local_max > 1.0, factor, 1.0)[:, None] * weight
            pull = np.where(far, np.maximum(PULL_HEAVIER * pull, FIRST_PULL), pull)
        elif np.abs(step[:, 0]).max() < CONVERGED_RAD:
            break
    return SmoothChanges(times_s, state[:, 0], state[:, 1], weight, pull)


def accelerations(rows: FloatArray, state: FloatArray) -> FloatArray:
    """Accelerations of cubics at both ends of each interval, (n - 1, 2, k).

    ``state``: values and speeds at the n times, (n, 2, k); ``rows``: for the acceleration at
    each end of an interval, factors of value and speed at its start, then at its end, (n - 1,
    2, 4).
    """
    both = np.concatenate((state[:-1], state[1:]), axis=1)
    return np.asarray(np.einsum('nej,njk->nek', rows, both))


def _limit_shares(
    speed: FloatArray,
    acceleration: FloatArray,
    wanted: tuple[FloatArray, FloatArray],
    limits: Limits,
) -> FloatArray:
    """Largest ratio of acceleration or speed to its limit in each interval, (n - 1,).

    ``speed``, (n, k), and ``acceleration``, (n - 1, 2, k): of the change, to which those of
    the path, ``wanted``, are added. The limit of an acceleration is at least 1 + `ADDED` times
    that of the path itself, which may exceed ``limits``.
    """
    allowed = np.maximum(limits.acceleration, (1.0 + ADDED) * np.abs(wanted[0]))
    accelerated = np.max(np.abs(acceleration + wanted[0]) / allowed, axis=(1, 2))
    fast = np.max(np.abs(speed + wanted[1]) / limits.speed, axis=1)
    return np.asarray(np.maximum(accelerated, np.maximum(fast[:-1], fast[1:])))


def _step(
    error: FloatArray,
    jacobian: FloatArray,
    state: FloatArray,
    angle_change: FloatArray,
    rows: FloatArray,
    h: FloatArray,
    share: FloatArray,
    weight: FloatArray,
    pull: FloatArray,
    fixed: BoolArray,
) -> FloatArray:
    """Gauss–Newton step of changes and speeds, (n, 2, k); 0 where ``fixed``.

    ``error, jacobian``: weighted, (n, 6) and (n, 6, k); ``state``: present changes and speeds,
    (n, 2, k); ``rows``: as of `accelerations`; ``h``: intervals, s; ``share``: duration that
    each time counts for, s; ``weight``: of squared accelerations, (n - 1, k); ``pull``: of the
    squared difference from ``angle_change``, (n,).
    """
    n, _, k = state.shape
    turned = jacobian.swapaxes(1, 2)
    change = state[:, 0]
    on_change = share[:, None, None] * (
        turned @ jacobian + (LEAST_WORTH**2 + pull)[:, None, None] * np.eye(k)
    )
    slope = np.zeros((n, 2, k))
    slope[:, 0] = share[:, None] * (
        (turned @ error[..., None])[..., 0]
        + LEAST_WORTH**2 * change
        + pull[:, None] * (change - angle_change)
    )
    # Of each joint by itself: (n - 1, k, 4, 4).
    gram = np.einsum('nea,neb->nab', rows, rows) * h[:, None, None]
    bent = gram[:, None] * weight[:, :, None, None]
    of_bends = np.einsum('nkab,nbk->nak', bent, np.concatenate((state[:-1], state[1:]), axis=1))
    slope[:-1] += of_bends[:, :2]
    slope[1:] += of_bends[:, 2:]
    diagonal, off_diagonal = np.zeros((n, 2, k, 2, k)), np.zeros((n - 1, 2, k, 2, k))
    diagonal[:, 0, :, 0, :] = on_change
    joint = np.arange(k)
    # (k, n, 2, 2) is what NumPy makes of two index arrays with slices between them.
    diagonal[:-1, :, joint, :, joint] += bent[:, :, :2, :2].swapaxes(0, 1)
    diagonal[1:, :, joint, :, joint] += bent[:, :, 2:, 2:].swapaxes(0, 1)
    off_diagonal[:, :, joint, :, joint] = bent[:, :, :2, 2:].swapaxes(0, 1)
    size = 2 * k
    free = ~fixed.reshape(n, size)
    own_block = diagonal.reshape(n, size, size) * (free[:, :, None] & free[:, None, :])
    next_block = off_diagonal.reshape(n - 1, size, size) * (free[:-1, :, None] & free[1:, None, :])
    place = np.arange(size)
    own_block[:, place, place] += ~free
    right = np.where(free, -slope.reshape(n, size), 0.0)
    # Speeds and changes have units far apart.
    unit = 1.0 / np.sqrt(own_block[:, place, place])
    own_block *= unit[:, :, None] * unit[:, None, :]
    next_block *= unit[:-1, :, None] * unit[1:, None, :]
    band = np.zeros((2 * size, n * size))
    below, across = np.triu_indices(size)
    starts = size * np.arange(n)[:, None]
    band[2 * size - 1 + below - across, starts + across] = own_block[:, below, across]
    band[-1] += ROUNDING
    a, b = np.indices((size, size)).reshape(2, -1)
    band[2 * size - 1 + a - (b + size), starts[1:] + b] = next_block[:, a, b]
    found = scipy.linalg.solveh_banded(band, (unit * right).ravel(), check_finite=False)
    return np.asarray(unit * found.reshape(n, size)).reshape(n, 2, k)
