"""From chosen cells to an `Extension` of the model that is sampled."""

from __future__ import annotations

import numpy as np

from remaster_ros.calibration.extension import Extension, Term
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray


def extension_of(residuals: Residuals, solution: Solution) -> Extension:
    """Return the cells of a solution as further parameters, linearised where it has them."""
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
    )


def _columns(cell: Cell, context: Context) -> tuple[int | None, FloatArray]:
    """Return joint and values of a cell's columns in every row of a session."""
    blocks = [cell.columns(block) for _, block in context.blocks()]
    return blocks[0].at, np.concatenate([block.values for block in blocks])
