"""Are held-out poses predicted as well as poses that are left out of the fit in turn?

Both are judged in units of what is uncertain of their prediction, the parameters included, and
both by a noise that was estimated without them: a noise fitted to the rows that it judges is too
small, by how much depends on how few they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri

from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray, IntArray

FOLDS = 10
# Fewer poses of either kind are not compared.
FEWEST_POSES = 8
# Rows that are predicted; of more, every second pose, every third, …
MOST_ROWS = 3_000
# What rows left out leave of a direction is no less than rounding leaves.
ROUNDING = 1e-12
# Beyond this no eigenvalue is near that: a factor serves, at a tenth of the work.
WELL_CONDITIONED = 1e-6


@dataclass(frozen=True)
class HeldOutPoses:
    """How held-out poses compare with poses left out of the fit.

    Attributes
    ----------
    ratio
        Of the typical errors, each in units of what is uncertain of its prediction.
    p_value
        That they are as large by chance.
    """

    ratio: float
    p_value: float


def compare_held_out(data: Residuals, solution: Solution, source: IntArray) -> HeldOutPoses | None:
    """Compare held-out poses with poses left out of the fit; None where there are too few.

    Parameters
    ----------
    data, solution
        What was fitted, and the fit.
    source
        Held-out rows of the session without gross errors, (m,).
    """
    pose = np.unique(data.context.measurements.pose[source], return_inverse=True)[1]
    source = source[pose % (1 + len(source) // MOST_ROWS) == 0]
    if min(data.poses, len(np.unique(pose))) < FEWEST_POSES:
        return None
    found = predicted_squares(data.only(source), solution)
    fold = np.arange(data.poses) % min(FOLDS, data.poses)
    left_out = LeftOut.of(data, solution.cells, solution.noise, fold).squares(solution)
    if np.any(np.isnan(left_out)):
        return None
    return HeldOutPoses(
        float(np.sqrt(np.median(found) / np.median(left_out))),
        float(scipy.stats.mannwhitneyu(found, left_out, alternative='greater').pvalue),
    )


def predicted_squares(data: Residuals, solution: Solution) -> FloatArray:
    """Judge how well a fit predicts poses that it has not seen.

    Each by itself: what a sensor that was moved has in common in all of them, must count in all.

    Parameters
    ----------
    data
        The rows of these poses.
    solution
        The fit.

    Returns
    -------
    ndarray
        Mean squared error of each pose in units of what is uncertain of its prediction: chi-square
        over its degrees of freedom, (poses,).
    """
    columns = np.concatenate((data.base, data.columns(solution.cells)), axis=2)
    white = data.noise_model.whitened(columns, solution.noise)
    left = data.noise_model.whitened(data.left(solution), solution.noise)
    squares = np.empty(data.poses)
    for pose in range(data.poses):
        mine = data.pose_of_row == pose
        X, errors = white[mine].reshape(-1, columns.shape[2]), left[mine].ravel()
        variance = X @ solution.full_covariance @ X.T + np.eye(len(X))
        squares[pose] = errors @ np.linalg.solve(variance, errors) / len(errors)
    return squares


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
    white
        Columns and errors in units of the noise and of the scale, (3 rows, size + 1).
    gram
        Their products with each other, (size + 1, size + 1).
    folds
        Which of the coordinates are left out together, (fold size,) each.
    """

    data: Residuals
    cells: tuple[Cell, ...]
    scale: FloatArray
    white: FloatArray
    gram: FloatArray
    folds: list[IntArray]

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
        folds = [np.flatnonzero(fold == index) for index in range(int(fold.max()) + 1)]
        return cls(data, tuple(cells), scale, white, white.T @ white, folds)

    def squares(self, solution: Solution) -> FloatArray:
        """Return how large the errors are on poses that are left out.

        By the noise of the others: what is left of the squares of all rows is the sum of what is
        left without a fold, and of the squares of that in units of what is uncertain of its
        prediction.

        Parameters
        ----------
        solution
            Which cells, with which smoothness and noise, but for its scale.

        Returns
        -------
        ndarray
            Mean squared error of each pose in units of what is uncertain of its prediction:
            chi-square over its degrees of freedom, (poses,); NaN where the others leave none to
            judge the noise by.
        """
        X, y = self._orthogonal(solution), self.white[:, -1]
        rss = y @ y - np.sum((X @ y) ** 2)
        free = sum(cell.size for cell in solution.cells if cell.penalty is None)
        freedom = len(y) - self.data.base.shape[2] - free
        squares = np.full(self.data.poses, np.nan)
        for fold, errors, first, second in self._left_out(X):
            variance = np.eye(len(fold)) + first.T @ second
            others = freedom - len(fold)
            if others <= 0:
                continue
            noise = (rss - errors @ np.linalg.solve(variance, errors)) / others
            pose = self.data.pose_of_row[fold // 3]
            for number in np.unique(pose):
                mine = pose == number
                scaled = np.linalg.solve(variance[np.ix_(mine, mine)], errors[mine])
                squares[number] = errors[mine] @ scaled / (noise * len(scaled))
        return squares

    def _left_out(
        self, X: FloatArray
    ) -> Iterator[tuple[IntArray, FloatArray, FloatArray, FloatArray]]:
        """Give the coordinates of each fold, their errors by the fit to others, and matrices A, B.

        The variance of the prediction is I + A'B, noise included. With S = X'X of the rows X left
        out, in parameters whose posterior covariance is the identity, it is (I − S)⁻¹, and the
        error the product of it and what the fit to all rows leaves (Cook & Weisberg 1982,
        Residuals and Influence in Regression, section 2.2). That is I + X' (I − XX')⁻¹ X, which
        inverts a matrix of the parameters where they are fewer.

        Parameters
        ----------
        X
            As `_orthogonal` gives it.
        """
        y = self.white[:, -1]
        left = y - (X @ y) @ X
        for fold in self.folds:
            own = X[:, fold]
            if len(own) < len(fold):
                pulled = _inverse(np.eye(len(own)) - own @ own.T) @ own
            else:
                pulled = _inverse(np.eye(len(fold)) - own.T @ own) - np.eye(len(fold))
                own = np.eye(len(fold))
            yield fold, left[fold] + own.T @ (pulled @ left[fold]), own, pulled

    def _orthogonal(self, solution: Solution) -> FloatArray:
        """Return the columns of parameters whose posterior covariance is the identity, (P, 3n)."""
        p = self.data.base.shape[2]
        edges = p + np.cumsum([0, *(cell.size for cell in self.cells)])
        first = dict(zip(self.cells, edges, strict=False))
        mine = [np.arange(first[cell], first[cell] + cell.size) for cell in solution.cells]
        chosen = np.concatenate((np.arange(p), *mine)).astype(int)
        H = self.gram[np.ix_(chosen, chosen)]
        unit, base = self.scale[chosen[p:]], self.scale[:p]
        H[p:, p:] += solution.prior_precision() / np.outer(unit, unit)
        H[:p, :p] += self.data.base_precision / np.outer(base, base)
        np.einsum('ii->i', H)[:] += 1e-12
        root = np.linalg.cholesky(H)
        columns = self.white[:, chosen].T
        return np.asarray(solve_triangular(root, columns, lower=True, check_finite=False))


def _inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric matrix (m, m) whose eigenvalues are positive or rounding.

    Where rows determine something that no other row does, nothing is left of it without them.
    """
    root, wrong = dpotrf(information, lower=1)
    if not wrong and np.min(np.diag(root)) ** 2 > WELL_CONDITIONED:
        lower, _ = dpotri(root, lower=1)
        return np.asarray(lower + np.tril(lower, -1).T)
    values, vectors = np.linalg.eigh(information)
    inverse: FloatArray = (vectors / np.maximum(values, ROUNDING)) @ vectors.T
    return inverse
