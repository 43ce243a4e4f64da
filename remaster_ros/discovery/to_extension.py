"""From chosen cells to an `Extension` of the model that is sampled."""

from __future__ import annotations

import numpy as np

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.extension import Extension, Term
from remaster_ros.calibration.priors import STEP_STD
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray

# Of an offset with a larger share of the prior's standard deviation the prior takes more than a
# twentieth off.
OPEN = 1.0 / 3.0


def extension_of(residuals: Residuals, solution: Solution, found: Estimate) -> Extension:
    """Return the cells of a solution as further parameters, linearised where it has them.

    Parameters
    ----------
    residuals, solution
        What was searched, and found.
    found
        The fit that the search began with.
    """
    terms = []
    displacement0 = np.zeros((len(residuals.context), 3))
    for cell, where in zip(solution.cells, solution.slices(), strict=True):
        term = Term(where, *_columns(cell, residuals.context))
        if term.at is None:
            displacement0 += term.values @ solution.parameters[where]
        terms.append(term)
    names = tuple(name for cell in solution.cells for name in cell.parameters)
    units = tuple(cell.unit for cell in solution.cells for _ in cell.parameters)
    return Extension(
        names,
        units,
        tuple(terms),
        displacement0,
        solution.parameters,
        solution.prior_precision(),
        solution.prior_mean,
        offsets_of(found)[0],
        STEP_STD,
    )


def moved_by_open_offsets(found: Estimate, solution: Solution) -> FloatArray:
    """Return how offsets that the fit leaves open move its parameters, one std of each.

    Where the prior holds an offset near the one that was searched with, it is known no better.

    Parameters
    ----------
    found
        The fit that the search began with.
    solution
        What was found.

    Returns
    -------
    ndarray
        (size + m, c) for all parameters of the fit and the m of the solution's cells, which stay.
    """
    free, covariance = found.posterior.free, found.mode.covariance
    std = np.sqrt(np.diag(covariance))
    hardly_known = (free < found.model.joints) & (std > OPEN * STEP_STD)
    moves = np.zeros((found.model.size + len(solution.parameters), int(hardly_known.sum())))
    # All else goes along, so that the predictions stay.
    moves[free] = covariance[:, hardly_known] / std[hardly_known]
    return moves


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
