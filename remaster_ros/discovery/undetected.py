"""What the search cannot see: how far causes too small to be found move the parameters.

A search that names no more causes does not show that there are none: two that are just below what
is found move zero-offsets and named sizes by more than their standard deviations. Each cause that
has a name and was not found therefore gets a Gaussian prior about 0, as wide as a cause that
escapes the search; the parameters' posterior is widened by what it moves them by (Kennedy &
O'Hagan 2001, J. R. Stat. Soc. B 63, with physical causes in place of a Gaussian process). Beside
the poses that were fitted the other parameters make up for it, elsewhere they do not: predictions
there are widened, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.priors import prior_rows
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray, IntArray

# A cause is found from about so many standard deviations on; the others lie anywhere below.
DETECTED = 4.5
# So many of them are expected in an arm: with two, the intervals of sessions with two small causes
# held 99 % instead of 95.
MISSED = 1.0
# Shares of a cause's size that what was found, and the offsets model, have to leave of it.
IMITATED = 0.3
ABSORBED = 0.02


@dataclass(frozen=True, eq=False)
class Undetected:
    """Causes that a search may have missed; c independent ones.

    Attributes
    ----------
    found, solution
        The fit that the search began with, and what it found.
    cells, std
        The causes, and the standard deviations of their priors, (c,).
    moved
        How the f free parameters of the fit and the m of the solution's cells move for a unit of
        each, (f + m, c).
    moves
        How the causes move all natural parameters of the fit and the m, one standard deviation of
        each, (size + m, c). Zeros where the gauge holds a parameter.
    """

    found: Estimate
    solution: Solution
    cells: tuple[Cell, ...]
    std: FloatArray
    moved: FloatArray
    moves: FloatArray

    def covariance(self, context: Context) -> FloatArray:
        """Return by how much they may displace each row, in its sensor's frame, m², (n, 3, 3).

        Beside the poses that were fitted that is little, since other parameters make up for it;
        away from them it grows. Rows are those of the session, or of another one of the arm.
        """
        model, free = self.found.model, self.found.posterior.free
        x = model.natural(self.found.mode.z)
        covariance = np.empty((len(context), 3, 3))
        for where, block in context.blocks():
            rows = Rows.of(block.measurements, np.arange(len(block)), model.reference)
            jacobian = np.empty((len(block), 3, model.size))
            jacobian[rows.source] = model.natural_jacobian(x, rows)
            known = np.concatenate(
                (jacobian[:, :, free], _displacements(block, self.solution.cells)), axis=2
            )
            left = _displacements(block, self.cells) + known @ self.moved
            left = np.swapaxes(block.sensor_turn, 1, 2) @ left * self.std
            covariance[where] = left @ np.swapaxes(left, 1, 2)
        return covariance


def _displacements(context: Context, cells: Sequence[Cell]) -> FloatArray:
    parts = [cell.columns(context).displacement(context) for cell in cells]
    return np.concatenate([np.zeros((len(context), 3, 0)), *parts], axis=2)


def undetected(found: Estimate, data: Residuals, solution: Solution) -> Undetected:
    """Return the causes that a search may have missed, and what they move.

    Parameters
    ----------
    found
        The fit that the search began with.
    data, solution
        What it worked on and found.
    """
    fitted, precision, where = fitted_columns(found, data, solution)
    free = len(found.posterior.free)
    cells = tuple(_not_found(data, solution))
    columns = data.columns(cells)
    both = np.concatenate((fitted, columns), axis=2)
    white = data.noise_model.whitened(both, solution.noise).reshape(3 * len(data), -1)
    known, unknown = white[:, : fitted.shape[2]], white[:, fitted.shape[2] :]
    moved = _response(known, precision, unknown)
    left = np.linalg.norm(unknown + known @ moved, axis=0)
    # What the causes found can imitate is not undetected, and what the offsets model imitates
    # altogether is no error of it.
    core = known[:, :free]
    alone = _response(core, precision[:free, :free], unknown)
    left_by_core = np.linalg.norm(unknown + core @ alone, axis=0)
    whole = np.linalg.norm(unknown, axis=0)
    apart = (left > IMITATED * left_by_core) & (left_by_core > ABSORBED * whole)
    seen = DETECTED * np.sqrt(MISSED / 3.0 / max(int(apart.sum()), 1))
    largest = np.array([cell.largest or np.inf for cell in cells for _ in cell.parameters])
    std = apart * np.minimum(largest, seen / np.maximum(left, np.finfo(float).tiny))
    moves = np.zeros((found.model.size + len(solution.parameters), columns.shape[2]))
    moves[where] = moved * std
    return Undetected(found, solution, cells, std, moved, moves)


def fitted_columns(
    found: Estimate, data: Residuals, solution: Solution
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return what all parameters of the extended model do, and what is known of them beforehand.

    Parameters
    ----------
    found, data, solution
        As in `undetected`.

    Returns
    -------
    columns
        What a unit of each free parameter of the fit and of the m of the cells displaces in the
        rows worked on, (n, 3, f + m).
    precision
        Of their priors, (f + m, f + m).
    where
        Their indices among all the natural parameters and the m, (f + m,).
    """
    free, size = found.posterior.free, found.model.size
    own = data.columns(solution.cells)
    columns = np.concatenate((data.full_jacobian[data.rows.source][:, :, free], own), axis=2)
    x = found.model.natural(found.mode.z)
    rows = prior_rows(found.model, found.posterior.priors, x, natural=True)[1][:, free]
    precision = np.zeros((columns.shape[2],) * 2)
    precision[: len(free), : len(free)] = rows.T @ rows
    precision[len(free) :, len(free) :] = solution.prior_precision()
    return columns, precision, np.concatenate((free, size + np.arange(own.shape[2])))


def natural_parameters(
    found: Estimate, data: Residuals, solution: Solution, other: Solution
) -> FloatArray:
    """Return the parameters of another set of cells, as those of a solution, (size + m,).

    Parameters
    ----------
    found, data, solution
        As in `undetected`.
    other
        The other set, fitted to the same rows.

    Returns
    -------
    ndarray
        Steps of the natural parameters of the fit from where the search began, zeros where the
        gauge holds; and the parameters of the solution's m cells, 0 of those that the other set
        does not have.
    """
    free, size = found.posterior.free, found.model.size
    values = np.zeros(size + len(solution.parameters))
    columns = data.full_jacobian[data.rows.source][:, :, free].reshape(-1, len(free))
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    step = (data.base @ other.base).ravel()
    values[free] = np.linalg.lstsq(columns / scale, step, rcond=None)[0] / scale
    found_again = dict(zip(other.cells, other.slices(), strict=True))
    for cell, where in zip(solution.cells, solution.slices(), strict=True):
        if cell in found_again:
            values[size:][where] = other.parameters[found_again[cell]]
    return values


def _response(known: FloatArray, precision: FloatArray, unknown: FloatArray) -> FloatArray:
    """Return how the parameters of the known columns move for a unit of each unknown one."""
    gram = known.T @ known + precision
    # In units of each parameter's own: those of rad and of m/s differ by ten decades.
    unit = np.maximum(np.diag(gram), np.finfo(float).tiny) ** -0.5
    scaled = gram * np.outer(unit, unit) + 1e-12 * np.eye(len(gram))
    moved: FloatArray = -unit[:, None] * np.linalg.solve(scaled, unit[:, None] * known.T @ unknown)
    return moved


def _not_found(data: Residuals, solution: Solution) -> Iterator[Cell]:
    """Give the simplest cell of each cause with a name that is not in a solution."""
    taken = {(cell.name, cell.joints, cell.subject) for cell in solution.cells}
    for effect in EFFECTS.values():
        if effect.reported_as or effect.costly or effect.moves_the_fit:
            continue
        if effect.needs(data.context) or effect.plausible is None:
            continue
        for cell in effect.cells(data.context):
            key = cell.name, cell.joints, cell.subject
            several = effect.cause_per == 'variant'
            if cell.penalty is None and (several or key not in taken):
                taken.add(key)
                yield cell
