"""From chosen cells to an `Extension` of the model that is sampled."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.extension import Extension, Start, Term
from remaster_ros.calibration.priors import OFFSET_STD, STEP_STD, prior_rows
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray, IntArray

# Where the prior on steps takes a smaller share of its variance off an offset nothing is added.
NOTICEABLE = 0.1


def extension_of(residuals: Residuals, solution: Solution, found: Estimate) -> Extension:
    """Return the cells of a solution as further parameters, linearised where it has them."""
    terms = []
    displacement0 = np.zeros((len(residuals.context), 3))
    for cell, where in zip(solution.cells, solution.slices(), strict=True):
        term = Term(where, *_columns(cell, residuals.context))
        if term.at is None:
            displacement0 += term.values @ solution.parameters[where]
        terms.append(term)
    model = found.model
    # Steps of the natural parameters, zeros where the gauge holds.
    x, free = model.natural(found.mode.z), found.posterior.free
    columns = residuals.full_jacobian[residuals.rows.source][:, :, free].reshape(-1, len(free))
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    step = (residuals.base @ solution.base).ravel()
    x[free] += np.linalg.lstsq(columns / scale, step, rcond=None)[0] / scale
    names = tuple(name for cell in solution.cells for name in cell.parameters)
    units = tuple(cell.unit for cell in solution.cells for _ in cell.parameters)
    return Extension(
        names,
        units,
        tuple(terms),
        displacement0,
        solution.parameters,
        solution.prior_precision(),
        offsets_of(found)[0],
        STEP_STD,
        Start(
            model.offsets(x),
            model.T_R_N(x),
            model.markers(x),
            np.setdiff1d(found.problem.fitted, np.union1d(found.kept, residuals.rows.source)),
        ),
    )


def moved_by_open_offsets(found: Estimate, data: Residuals, solution: Solution) -> FloatArray:
    """Return how the parameters move with offsets that the prior on steps holds, one std of each.

    It is no knowledge of the arm: an offset is known no better than by the data and by what is
    known of any mastering. Of all natural parameters and the m of the cells, (size + m, c).
    """
    _, root, where = _solved(found, data, solution)
    names = found.problem.chain.joint_names
    joints = np.array(
        [
            place
            for place, joint in enumerate(found.posterior.free)
            if joint < len(names) and names[joint] not in found.problem.priors.joint_offsets
        ],
        dtype=np.int64,
    )
    covariance = root @ root[joints].T
    free = covariance[joints]
    taken = STEP_STD**-2.0 - OFFSET_STD**-2.0
    per_radian = found.problem.chain.per_radian[found.posterior.free[joints]]
    held = np.linalg.inv(np.linalg.inv(free) + np.diag(taken / per_radian**2))
    variance, less = np.diag(free), np.diag(free) - np.diag(held)
    noticeable = less > NOTICEABLE * variance
    moves = np.zeros((found.model.size + len(solution.parameters), int(noticeable.sum())))
    # All else goes along, so that the predictions stay.
    moves[where] = (covariance / variance * np.sqrt(np.maximum(less, 0.0)))[:, noticeable]
    return moves


def _solved(
    found: Estimate, data: Residuals, solution: Solution
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return the whitened columns of all that is fitted, a root of its covariance, and where."""
    free, size = found.posterior.free, found.model.size
    own = data.columns(solution.cells)
    columns = np.concatenate((data.full_jacobian[data.rows.source][:, :, free], own), axis=2)
    x = found.model.natural(found.mode.z)
    rows = prior_rows(found.model, found.posterior.priors, x, natural=True)[1][:, free]
    precision = np.zeros((columns.shape[2],) * 2)
    precision[: len(free), : len(free)] = rows.T @ rows
    precision[len(free) :, len(free) :] = solution.prior_precision()
    white = data.noise_model.whitened(columns, solution.noise).reshape(3 * len(data), -1)
    root = root_of_inverse(white.T @ white + precision)
    return white, root, np.concatenate((free, size + np.arange(own.shape[2])))


def moved_by(
    found: Estimate, data: Residuals, solution: Solution, displacements: Iterable[FloatArray]
) -> FloatArray:
    """Return how displacements (n, 3, …), m, beside the model move all fitted, (size + m, c)."""
    white, root, where = _solved(found, data, solution)
    parts = [np.zeros((len(root), 0))]
    for some in displacements:
        others = data.noise_model.whitened(some, solution.noise).reshape(3 * len(data), -1)
        parts.append(root @ (root.T @ (white.T @ others)))
    together = np.concatenate(parts, axis=1)
    moves = np.zeros((found.model.size + len(solution.parameters), together.shape[1]))
    moves[where] = together
    return moves


def moved_by_names(
    found: Estimate, data: Residuals, named: Solution, every: Solution
) -> FloatArray:
    """Return how all fitted moves if each cause has its size, of which kinds have a part.

    In a model of all kinds of errors another one may take over what a cause explains: a curve has
    the mean of a scale in the zero-offset beside it. Which of them it is these data do not tell.
    Predictions stay. Of all natural parameters and the m of the model of all kinds, (size + m, c).
    """
    places = {name: i for i, name in enumerate(n for c in every.cells for n in c.parameters)}
    kept = [
        (cell, named.parameters[where], [places[name] for name in cell.parameters])
        for cell, where in zip(named.cells, named.slices(), strict=True)
        if places.keys() >= {*cell.parameters}
    ]
    missing = [values - every.parameters[at] for _, values, at in kept]
    shifts = (
        data.columns([cell]) @ less for (cell, _, _), less in zip(kept, missing, strict=True)
    )
    moves = -moved_by(found, data, every, shifts)
    for column, ((_, _, at), less) in enumerate(zip(kept, missing, strict=True)):
        moves[found.model.size + np.array(at), column] += less
    return moves


def root_of_inverse(precision: FloatArray) -> FloatArray:
    """Return L with L L' the inverse of a matrix of parameters in units far apart, (P, P)."""
    unit = np.maximum(np.diag(precision), np.finfo(float).tiny) ** -0.5
    scaled = precision * np.outer(unit, unit) + 1e-12 * np.eye(len(precision))
    root: FloatArray = unit[:, None] * np.linalg.inv(np.linalg.cholesky(scaled)).T
    return root


def offsets_of(found: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return the zero-offsets of the fit without effects and their stds, rad, (k,) each."""
    joints = found.model.joints
    std = np.full(joints, np.nan)
    free = found.posterior.free
    angles = free < joints
    std[free[angles]] = np.sqrt(np.diag(found.mode.covariance)[: len(free)][angles])
    return found.model.offsets(found.mode.z), std


def _columns(cell: Cell, context: Context) -> tuple[int | None, FloatArray]:
    """Return joint and values of a cell's columns in every row of a session."""
    blocks = [cell.columns(block) for _, block in context.blocks()]
    return blocks[0].at, np.concatenate([block.values for block in blocks])
