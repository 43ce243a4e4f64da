"""What a cell is worth in a set: in evidence, and on poses left out."""

from __future__ import annotations

import numpy as np

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
    errors, _ = _left_out(data, solution, noise, fold_of_pose)
    by_pose: FloatArray = np.bincount(data.pose_of_row, np.sum(errors**2, axis=1)).astype(float)
    return by_pose


def held_out_deviance(
    data: Residuals, solution: Solution, noise: Noise, fold_of_pose: IntArray
) -> FloatArray:
    """Return −2 log of the density of each pose by the fit to other poses.

    Without the constants, which are those of the noise. In units of what is uncertain of its
    prediction, a pose that is far from all others does not decide between two sets of cells, as
    it does by its squared error (Gelman, Hwang & Vehtari 2014, Stat. Comput. 24, 997).

    Parameters
    ----------
    data, solution, noise, fold_of_pose
        As in `held_out_error`.
    """
    errors, variance = _left_out(data, solution, noise, fold_of_pose)
    scaled = np.linalg.solve(variance, errors[:, :, None])[:, :, 0]
    by_row = np.sum(errors * scaled, axis=1) + np.linalg.slogdet(variance)[1]
    by_pose: FloatArray = np.bincount(data.pose_of_row, by_row).astype(float)
    return by_pose


def _left_out(
    data: Residuals, solution: Solution, noise: Noise, fold_of_pose: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the error of each row left out, (n, 3), and its variance, (n, 3, 3)."""
    columns = data.columns(solution.cells)
    joined = np.concatenate((data.base, columns, data.errors[:, :, None]), axis=2)
    white = data.noise_model.whitened(joined, noise)
    scale = np.linalg.norm(white, axis=(0, 1))
    scale[-1] = 1.0
    scale[scale == 0.0] = 1.0
    white /= scale
    p, size = data.base.shape[2], white.shape[2] - 1
    prior = np.zeros((size, size))
    prior[p:, p:] = solution.prior_precision()
    prior /= np.outer(scale[:-1], scale[:-1])
    fold = fold_of_pose[data.pose_of_row]
    flat = white.reshape(-1, size + 1)
    total = flat.T @ flat
    total[:-1, :-1] += prior + 1e-12 * np.eye(size)
    errors, variance = np.empty((len(white), 3)), np.empty((len(white), 3, 3))
    for index in np.unique(fold):
        mine = fold == index
        out = white[mine].reshape(-1, size + 1)
        kept = total - out.T @ out
        X, pull = out[:, :-1], kept[:-1, -1:]
        solved = np.linalg.solve(kept[:-1, :-1], np.concatenate((pull, X.T), axis=1))
        errors[mine] = (out[:, -1] - X @ solved[:, 0]).reshape(-1, 3)
        spread = solved[:, 1:].T.reshape(-1, 3, size)
        variance[mine] = np.eye(3) + X.reshape(-1, 3, size) @ spread.transpose(0, 2, 1)
    return errors, variance
