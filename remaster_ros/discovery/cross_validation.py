"""What a cell is worth in a set: in evidence, and on poses left out."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

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


def held_out_error(
    data: Residuals, solution: Solution, noise: Noise, fold_of_pose: IntArray
) -> FloatArray:
    """Return each pose's squared error, in units of the noise, by the fit to other poses.

    Parameters
    ----------
    data
        The residuals.
    solution
        Which cells, with which smoothness.
    noise
        The noise to fit and to judge by.
    fold_of_pose
        Poses with the same number are left out together, (poses,).
    """
    columns = data.columns(solution.cells)
    joined = np.concatenate((data.base, columns, data.errors[:, :, None]), axis=2)
    white = data.noise_model.whitened(joined, noise).reshape(3 * len(data), -1)
    scale = np.linalg.norm(white, axis=0)
    scale[-1] = 1.0
    scale[scale == 0.0] = 1.0
    white /= scale
    p, size = data.base.shape[2], white.shape[1] - 1
    prior = np.zeros((size, size))
    prior[p:, p:] = solution.prior_precision()
    prior /= np.outer(scale[:-1], scale[:-1])
    fold = np.repeat(fold_of_pose[data.pose_of_row], 3)
    parts = [white[fold == index] for index in range(fold.max() + 1)]
    grams = [part.T @ part for part in parts]
    total = np.sum(grams, axis=0)
    total[:-1, :-1] += prior + 1e-12 * np.eye(size)
    errors = np.empty(len(white))
    for index, (out, gram) in enumerate(zip(parts, grams, strict=True)):
        kept = total - gram
        root = cho_factor(kept[:-1, :-1], lower=True, check_finite=False)
        beta = cho_solve(root, kept[:-1, -1], check_finite=False)
        errors[fold == index] = out[:, -1] - out[:, :-1] @ beta
    square = np.add.reduceat(errors**2, np.arange(0, len(errors), 3))
    by_pose: FloatArray = np.bincount(data.pose_of_row, square).astype(float)
    return by_pose
