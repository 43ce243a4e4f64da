"""From chosen cells to an `Extension` of the model that is sampled."""

from __future__ import annotations

import numpy as np

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.extension import Extension, Term
from remaster_ros.calibration.priors import OFFSET_STD, STEP_STD
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray

# In standard deviations of the fit without effects, where that is more than a step may be: what
# only a prior determines is not to be known better for it.
AS_UNCERTAIN = 3.0


def extension_of(residuals: Residuals, solution: Solution, found: Estimate) -> Extension:
    """Return the cells of a solution as further parameters, linearised where it has them.

    Parameters
    ----------
    residuals, solution
        What was searched, and found.
    found
        The fit that the search began with.
    """
    joint_offsets, std = offsets_of(found)
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
        joint_offsets,
        np.where(np.isnan(std), OFFSET_STD, np.maximum(STEP_STD, AS_UNCERTAIN * std)),
    )


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
