# SPDX-License-Identifier: Apache-2.0
"""The correction along a path: as near to the wanted tool as accelerations allow.

At each of n times the change c of the joints and its speed are sought; between them it is the
cubic that a trajectory controller draws. With the pose errors e of the tool and its Jacobian J::

    minimise  Σ h |e + J Δc|² + μ² h |c|² + Σ κ h |c - f|² + Σ ρ h |acceleration of c|²

The weights ρ of intervals whose accelerations or speeds would pass a limit are raised until none
does, and κ, which holds the change at that of the joint angles' own errors f, where a change
passes its bound: in directions in which the tool hardly moves a singularity so is passed smoothly,
while all that the tool shows is kept. On the bounds themselves the change could only jump from the
one to the other: a direction that is singular has one sign before and the other behind.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from remaster_ros.compensation.bounded_poses import LEAST_WORTH
from remaster_ros.types import BoolArray, FloatArray

# An added acceleration as large as the limit weighs as a tool error of a micrometre a metre,
# before any limit is passed.
FIRST_WEIGHT = 1e-6
# Least and largest factor of a weight ρ whose interval passes a limit, or one of so many beside.
HEAVIER = (4.0, 1e3)
BESIDE = 2
# What a change may add to an acceleration that passes its limit without it.
ADDED = 0.1
# First κ, that of a direction in which a radian moves the tool by a hundredth of a lever, and its
# factor where it does not suffice.
FIRST_HELD, HELD_HEAVIER = 1e-4, 10.0
# Added to what has 1 on its diagonal: rounding makes no direction negative.
ROUNDING = 1e-13
# Rounds of weights: most paths take ten, and no path of the tests more than thirty.
ROUNDS = 40
# A round without a limit passed is repeated until the change is this near, rad.
CONVERGED_RAD = 1e-6

# Changes (n, k) -> weighted pose errors (n, 6) and Jacobians (n, 6, k)
Errors = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, eq=False)
class Limits:
    """What a corrected path must keep to; k joints, n times."""

    acceleration: FloatArray  # Of the path with its change, rad/s², (k,)
    speed: FloatArray  # rad/s, (k,)
    change: FloatArray  # rad, (n, k)


@dataclass(frozen=True, eq=False)
class Ends:
    """What is known of the change at the first and at the last time, rad and rad/s, (k,) each.

    None where it is free.
    """

    first: FloatArray | None
    last: FloatArray | None
    # Whether the path rests there: so must the change
    first_rests: bool
    last_rests: bool


@dataclass(frozen=True, eq=False)
class SmoothChanges:
    """The correction along a path, and the weights that have made it so."""

    times_s: FloatArray  # Ascending, (n,)
    change: FloatArray  # At each time, rad, (n, k)
    speed: FloatArray  # Of the change, rad/s, (n, k)
    # ρ of each interval and joint, (n - 1, k), and κ of each time, (n,)
    weight: FloatArray
    held: FloatArray

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return changes and speeds between, (m, k) each."""
        cubic = scipy.interpolate.CubicHermiteSpline(self.times_s, self.change, self.speed)
        return np.asarray(cubic(times)), np.asarray(cubic(times, 1))


def smooth_changes(
    errors: Errors,
    times_s: FloatArray,
    own: FloatArray,
    wanted: tuple[FloatArray, FloatArray],
    limits: Limits,
    ends: Ends,
    before: SmoothChanges | None = None,
) -> SmoothChanges:
    """Return the correction along a path.

    Parameters
    ----------
    errors
        Pose errors at changes.
    times_s
        Ascending, (n,), n >= 2.
    own
        f, the change that takes off the errors of the joint angles alone, (n, k).
    wanted
        Of the path: accelerations at the start and the end of each interval, (n - 1, 2, k), and
        speeds at each time, (n, k).
    limits, ends
        What is kept to.
    before
        That of other times of the same path, to begin with.
    """
    n, k = own.shape
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
    held = np.zeros(n)
    weight = np.tile((FIRST_WEIGHT / limits.acceleration) ** 2, (n - 1, 1))
    state = np.zeros((n, 2, k))
    state[:, 0] = own
    if before is not None:
        state[:, 0], state[:, 1] = before.at(times_s)
        inside = np.searchsorted(before.times_s, times_s, side='right') - 1
        last = len(before.times_s) - 2
        weight, held = before.weight[np.minimum(inside[:-1], last)], before.held[inside]
    for end, given in ((0, ends.first), (n - 1, ends.last)):
        if given is not None:
            state[end, 0] = given
    fixed = np.zeros((n, 2, k), dtype=bool)
    fixed[0, 0], fixed[-1, 0] = ends.first is not None, ends.last is not None
    fixed[0, 1], fixed[-1, 1] = ends.first_rests, ends.last_rests
    for _ in range(ROUNDS):
        error, jacobian = errors(state[:, 0])
        step = _step(error, jacobian, state, own, rows, h, share, weight, held, fixed)
        state = state + step
        over = _over(state[:, 1], accelerations(rows, state), wanted, limits)
        far = np.any((np.abs(state[:, 0]) > limits.change) & ~fixed[:, 0], axis=1)
        if over.max() > 1.0 or far.any():
            # A weight of an interval alone would only move what is too much to the next ones.
            near = scipy.ndimage.maximum_filter1d(over, 2 * BESIDE + 1)
            factor = np.clip(near**2, HEAVIER[0], HEAVIER[1])
            weight = np.where(near > 1.0, factor, 1.0)[:, None] * weight
            held = np.where(far, np.maximum(HELD_HEAVIER * held, FIRST_HELD), held)
        elif np.abs(step[:, 0]).max() < CONVERGED_RAD:
            break
    return SmoothChanges(times_s, state[:, 0], state[:, 1], weight, held)


def accelerations(rows: FloatArray, state: FloatArray) -> FloatArray:
    """Return those of cubics at both ends of each interval, (n - 1, 2, k)."""
    both = np.concatenate((state[:-1], state[1:]), axis=1)
    return np.asarray(np.einsum('nej,njk->nek', rows, both))


def _over(
    speed: FloatArray,
    acceleration: FloatArray,
    wanted: tuple[FloatArray, FloatArray],
    limits: Limits,
) -> FloatArray:
    """Return the largest share of a limit that each interval takes, (n - 1,).

    ``speed, acceleration``: of the change. Where the path passes a limit by itself, a change may
    add `ADDED` of that.
    """
    allowed = np.maximum(limits.acceleration, (1.0 + ADDED) * np.abs(wanted[0]))
    accelerated = np.max(np.abs(acceleration + wanted[0]) / allowed, axis=(1, 2))
    fast = np.max(np.abs(speed + wanted[1]) / limits.speed, axis=1)
    return np.asarray(np.maximum(accelerated, np.maximum(fast[:-1], fast[1:])))


def _step(
    error: FloatArray,
    jacobian: FloatArray,
    state: FloatArray,
    own: FloatArray,
    rows: FloatArray,
    h: FloatArray,
    share: FloatArray,
    weight: FloatArray,
    held: FloatArray,
    fixed: BoolArray,
) -> FloatArray:
    """Return the Gauss–Newton step of changes and speeds, (n, 2, k)."""
    n, _, k = state.shape
    turned = jacobian.swapaxes(1, 2)
    change = state[:, 0]
    on_change = share[:, None, None] * (
        turned @ jacobian + (LEAST_WORTH**2 + held)[:, None, None] * np.eye(k)
    )
    slope = np.zeros((n, 2, k))
    slope[:, 0] = share[:, None] * (
        (turned @ error[..., None])[..., 0]
        + LEAST_WORTH**2 * change
        + held[:, None] * (change - own)
    )
    # Of each joint by itself: (n - 1, k, 4, 4).
    gram = np.einsum('nea,neb->nab', rows, rows) * h[:, None, None]
    bent = gram[:, None] * weight[:, :, None, None]
    of_bends = np.einsum('nkab,nbk->nak', bent, np.concatenate((state[:-1], state[1:]), axis=1))
    slope[:-1] += of_bends[:, :2]
    slope[1:] += of_bends[:, 2:]
    diagonal, beside = np.zeros((n, 2, k, 2, k)), np.zeros((n - 1, 2, k, 2, k))
    diagonal[:, 0, :, 0, :] = on_change
    joint = np.arange(k)
    # (k, n, 2, 2) is what NumPy makes of two index arrays with slices between them.
    diagonal[:-1, :, joint, :, joint] += bent[:, :, :2, :2].swapaxes(0, 1)
    diagonal[1:, :, joint, :, joint] += bent[:, :, 2:, 2:].swapaxes(0, 1)
    beside[:, :, joint, :, joint] = bent[:, :, :2, 2:].swapaxes(0, 1)
    size = 2 * k
    free = ~fixed.reshape(n, size)
    own_block = diagonal.reshape(n, size, size) * (free[:, :, None] & free[:, None, :])
    next_block = beside.reshape(n - 1, size, size) * (free[:-1, :, None] & free[1:, None, :])
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
