# SPDX-License-Identifier: Apache-2.0
"""Joint changes whose tool pose is nearest to a wanted pose, within bounds of each joint.

Gauss–Newton steps on the pose error, each the exact minimum of its linear least squares within the
bounds (an active-set method, as of Lawson and Hanson, *Solving Least Squares Problems*, 1974, ch.
23). Of all changes that do equally well the smallest is taken.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from remaster_ros.types import FloatArray, IntArray

# Regularisation: pose error, in levers and rad, that a change of one radian must remove. A
# direction that moves the tool by less is not used. At 2 degrees it leaves a micrometre a metre.
LEAST_WORTH = 3e-5
# Limit of Gauss–Newton steps: regular rows take four; near singularities they halve the error at
# the worst, and reach a bound before.
MOST_STEPS = 30
# Convergence limit of a step, rad: 1e-11 rad are 0.01 nm a metre away.
CONVERGED_RAD = 1e-11
# Number of halvings of a step that does not reduce the cost, before the row stops.
HALVINGS = 6
# Limit, per joint, of changes of the active set: a joint enters and leaves it a few times at most.
SETS_OF_JOINT = 8
# A gradient below this share of the largest one counts as zero.
ROUNDING = 1e-12

# Changes x, (m, k), of some rows -> their pose errors (m, 6) and Jacobians (m, 6, k)
Errors = Callable[[FloatArray, IntArray], tuple[FloatArray, FloatArray]]


def nearest(
    errors: Errors,
    start: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    avoided: FloatArray | None = None,
) -> FloatArray:
    """Joint changes x of n rows with the least squared pose error, within bounds, (n, k).

    A small regularisation prefers the smallest of equally good changes. A row ends when its
    steps converge or no longer reduce the cost, or after `MOST_STEPS`.

    Parameters
    ----------
    errors
        Function of changes (m, k) and row indices (m,) that returns pose errors, (m, 6), and
        Jacobians, (m, 6, k), of these rows.
    start
        Initial changes, within the bounds, (n, k); not changed.
    bounds
        Least and largest change of each joint, (n, k) each.
    avoided
        Matrix N of an additional cost x'Nx, (n, k, k); None for none.
    """
    low, high = bounds
    k = start.shape[1]
    x = start.copy()
    rows = np.arange(len(x))
    if not len(x):
        return x
    cost = np.tile(LEAST_WORTH**2 * np.eye(k), (len(x), 1, 1))
    if avoided is not None:
        cost += avoided

    def worth(error: FloatArray, at: FloatArray, rows: IntArray) -> FloatArray:
        """Cost of pose errors and changes, (m,)."""
        of_change = np.einsum('ni,nij,nj->n', at, cost[rows], at)
        return np.asarray(np.sum(error**2, axis=1) + of_change)

    error, jacobian = errors(x, rows)
    reached = worth(error, x, rows)
    for _ in range(MOST_STEPS):
        turned = jacobian.swapaxes(1, 2)
        linear = turned @ (jacobian @ x[rows, :, None] - error[..., None])
        target = box_minimum(
            turned @ jacobian + cost[rows], linear[..., 0], x[rows], (low[rows], high[rows])
        )
        step = target - x[rows]
        going = np.abs(step).max(axis=1) > CONVERGED_RAD
        rows, step, error, jacobian = (values[going] for values in (rows, step, error, jacobian))
        tried = np.arange(len(rows))
        for halving in range(HALVINGS):
            if not len(tried):
                break
            at = x[rows[tried]] + 0.5**halving * step[tried]
            new_error, new_jacobian = errors(at, rows[tried])
            new = worth(new_error, at, rows[tried])
            gains = new < reached[rows[tried]]
            good = tried[gains]
            x[rows[good]], reached[rows[good]] = at[gains], new[gains]
            error[good], jacobian[good] = new_error[gains], new_jacobian[gains]
            tried = tried[~gains]
        # A row none of whose steps gains has arrived, to rounding.
        rows, error, jacobian = (
            np.delete(values, tried, axis=0) for values in (rows, error, jacobian)
        )
        if not len(rows):
            break
    return x


def box_minimum(
    hessian: FloatArray,
    linear: FloatArray,
    start: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Point x at which x'Hx / 2 - l'x is least within bounds, for each of n rows, (n, k).

    ``hessian``: H, positive definite, (n, k, k); ``linear``: l, (n, k); ``start``: within the
    bounds, (n, k); ``bounds``: least and largest x, (n, k) each. A row that needs more than 8
    k changes of the active set keeps its last value, within the bounds.
    """
    low, high = bounds
    k = linear.shape[1]
    x = np.asarray(np.linalg.solve(hessian, linear[..., None])[..., 0])
    rows = np.flatnonzero(np.any((x < low) | (x > high), axis=1))
    x[rows] = start[rows]
    free = (low < x) & (x < high)
    eye = np.eye(k)
    for _ in range(SETS_OF_JOINT * k):
        if not len(rows):
            break
        H, x_active, is_free = hessian[rows], x[rows], free[rows]
        x_fixed = np.where(is_free, 0.0, x_active)
        right = linear[rows] - np.einsum('nij,nj->ni', H, x_fixed)
        both = is_free[:, :, None] & is_free[:, None, :]
        best = np.linalg.solve(
            np.where(both, H, eye), np.where(is_free, right, x_fixed)[..., None]
        )[..., 0]
        step = best - x_active
        # How much of the step each joint can go.
        end = np.where(step > 0.0, high[rows], low[rows])
        share = np.full_like(step, np.inf)
        np.divide(end - x_active, step, out=share, where=is_free & (step != 0.0))
        first, part = share.argmin(axis=1), np.minimum(share.min(axis=1), 1.0)
        x_active = np.clip(x_active + part[:, None] * step, low[rows], high[rows])
        stopped = part < 1.0
        hit = np.flatnonzero(stopped)
        x_active[hit, first[hit]] = end[hit, first[hit]]
        is_free[hit, first[hit]] = False
        # At the minimum of its set: the joint that gains most by leaving its bound.
        slope = np.einsum('nij,nj->ni', H, x_active) - linear[rows]
        outward = np.where(x_active >= high[rows], 1.0, -1.0)
        inward = np.where(is_free | (low[rows] >= high[rows]), 0.0, slope * outward)
        leaver = inward.argmax(axis=1)
        leaves = ~stopped & (inward.max(axis=1) > ROUNDING * np.abs(linear[rows]).max(axis=1))
        go = np.flatnonzero(leaves)
        is_free[go, leaver[go]] = True
        x[rows], free[rows] = x_active, is_free
        rows = rows[stopped | leaves]
    return x
