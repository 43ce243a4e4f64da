"""What a cell is worth in a set: in evidence, and on poses left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray, IntArray


def worth_of(solution: Solution, cell: Cell, where: slice, price: float) -> float:
    """Estimate how much log evidence would be lost without a cell."""
    values, covariance = solution.parameters[where], solution.covariance[where, where]
    drop = 0.5 * values @ np.linalg.solve(covariance, values)
    if cell.penalty is None:
        return float(drop - 0.5 * cell.size * price)
    return float(drop - 0.5 * cell.size)


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Poses left out in turn, to be predicted by fits of some cells to the other poses.

    Attributes
    ----------
    data
        The residuals.
    cells
        All that can be fitted.
    scale
        Of each column of the offsets model, of the cells, and of the errors, (size + 1,).
    rows
        Which coordinates of the rows are left out together, (fold size,) each.
    parts, grams
        Of each fold columns and errors in units of the noise and of the scale, (fold size,
        size + 1), and their products with each other.
    """

    data: Residuals
    cells: tuple[Cell, ...]
    scale: FloatArray
    rows: list[IntArray]
    parts: list[FloatArray]
    grams: list[FloatArray]

    @classmethod
    def of(
        cls, data: Residuals, cells: Sequence[Cell], noise: Noise, fold_of_pose: IntArray
    ) -> LeftOut:
        """Assemble.

        Parameters
        ----------
        data
            The residuals.
        cells
            All that can be fitted.
        noise
            The noise to fit and to judge by.
        fold_of_pose
            Poses with the same number are left out together, (poses,).
        """
        joined = np.concatenate((data.base, data.columns(cells), data.errors[:, :, None]), axis=2)
        white = data.noise_model.whitened(joined, noise).reshape(3 * len(data), -1)
        scale = np.linalg.norm(white, axis=0)
        scale[-1] = 1.0
        scale[scale == 0.0] = 1.0
        white /= scale
        fold = np.repeat(fold_of_pose[data.pose_of_row], 3)
        rows = [np.flatnonzero(fold == index) for index in range(int(fold.max()) + 1)]
        parts = [white[mine] for mine in rows]
        return cls(data, tuple(cells), scale, rows, parts, [part.T @ part for part in parts])

    def deviance(self, solution: Solution) -> FloatArray:
        """Return how well poses are predicted by the fit of some of the cells to the others.

        In units of what is uncertain of its prediction, a pose that is far from all others does
        not decide between two sets of cells, as it does by its squared error (Gelman, Hwang &
        Vehtari 2014, Stat. Comput. 24, 997).

        Parameters
        ----------
        solution
            Which cells, with which smoothness.

        Returns
        -------
        ndarray
            Of each pose −2 log of its density, without the constants, which are those of the
            noise, (poses,).
        """
        errors, variance = self._predicted(solution)
        scaled = np.linalg.solve(variance, errors[:, :, None])[:, :, 0]
        deviance = np.sum(errors * scaled, axis=1) + np.linalg.slogdet(variance)[1]
        return np.bincount(self.data.pose_of_row, deviance).astype(float)

    def _predicted(self, solution: Solution) -> tuple[FloatArray, FloatArray]:
        """Return the error of each row by the fit to others, (n, 3), and its variance."""
        p = self.data.base.shape[2]
        edges = p + np.cumsum([0, *(cell.size for cell in self.cells)])
        first = dict(zip(self.cells, edges, strict=False))
        mine = [np.arange(first[cell], first[cell] + cell.size) for cell in solution.cells]
        chosen = np.concatenate((np.arange(p), *mine)).astype(int)
        every = np.append(chosen, len(self.scale) - 1)
        total = np.sum(self.grams, axis=0)[np.ix_(every, every)]
        unit = self.scale[chosen[p:]]
        total[p:-1, p:-1] += solution.prior_precision() / np.outer(unit, unit)
        base = self.scale[:p]
        total[:p, :p] += self.data.base_precision / np.outer(base, base)
        np.einsum('ii->i', total)[:-1] += 1e-12
        errors = np.empty(3 * len(self.data))
        variance = np.empty((len(self.data), 3, 3))
        for rows, part, gram in zip(self.rows, self.parts, self.grams, strict=True):
            kept = total - gram[np.ix_(every, every)]
            root = np.linalg.cholesky(kept[:-1, :-1])
            X = part[:, chosen]
            pulls = np.column_stack((kept[:-1, -1], X.T))
            solved = solve_triangular(root, pulls, lower=True, check_finite=False)
            errors[rows] = part[:, -1] - solved[:, 1:].T @ solved[:, 0]
            spread = solved[:, 1:].T.reshape(-1, 3, len(chosen))
            variance[rows[::3] // 3] = np.eye(3) + spread @ spread.transpose(0, 2, 1)
        return errors.reshape(-1, 3), variance
