"""What a cell is worth in a set: in evidence, and on poses left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri

from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray, IntArray

# What rows left out leave of a direction is no less than rounding leaves.
ROUNDING = 1e-12
# Beyond this no eigenvalue is near that: a factor serves, at a tenth of the work.
WELL_CONDITIONED = 1e-6


def worth_of(solution: Solution, cell: Cell, where: slice, price: float) -> float:
    """Estimate how much log evidence would be lost without a cell."""
    values, covariance = solution.parameters[where], solution.covariance[where, where]
    if cell.size == 1:
        drop = 0.5 * values[0] ** 2 / covariance[0, 0]
    else:
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
        deviance = np.empty(len(self.data))
        for fold, errors, first, second in self._left_out(self._orthogonal(solution)):
            own, axes = errors.reshape(-1, 3), (-1, len(fold) // 3, 3)
            of_rows = np.einsum('pri,prj->rij', first.reshape(axes), second.reshape(axes))
            of_rows += np.eye(3)
            scaled = np.linalg.solve(of_rows, own[:, :, None])[:, :, 0]
            deviance[fold[::3] // 3] = np.sum(own * scaled, axis=1) + np.linalg.slogdet(of_rows)[1]
        return np.bincount(self.data.pose_of_row, deviance).astype(float)

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


class Comparisons:
    """Sets of cells against each other by poses left out.

    Parameters
    ----------
    data
        The residuals.
    fold_of_pose
        Poses with the same number are left out together, (poses,).
    """

    def __init__(self, data: Residuals, fold_of_pose: IntArray) -> None:
        self.data, self.fold_of_pose = data, fold_of_pose
        # The larger set is compared with many smaller ones in turn, some of them again later.
        self._last: tuple[Solution, LeftOut, FloatArray] | None = None
        self._known: dict[tuple[object, ...], tuple[float, float]] = {}

    def saved(self, smaller: Solution, larger: Solution) -> tuple[float, float]:
        """Return the share of the smaller set's deviance that the larger one saves.

        And the standard error that it has by the choice of poses.
        """
        both = tuple((frozenset(one.cells), one.log_evidence) for one in (smaller, larger))
        if both in self._known:
            return self._known[both]
        last = self._last
        if last is None or last[0] is not larger or not set(smaller.cells) <= set(last[1].cells):
            cells = tuple(dict.fromkeys((*larger.cells, *smaller.cells)))
            left_out = LeftOut.of(self.data, cells, larger.noise, self.fold_of_pose)
            last = larger, left_out, left_out.deviance(larger)
            self._last = last
        before = last[1].deviance(smaller)
        saved = before - last[2]
        error = np.sqrt(len(saved)) * saved.std()
        found = float(saved.sum() / before.sum()), float(error / before.sum())
        self._known[both] = found
        return found


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
