"""Are held-out poses predicted as well as poses that are left out of the fit in turn?

Both are judged in units of what is uncertain of their prediction, the parameters included, and
both by a noise that was estimated without them: a noise fitted to the rows that it judges is too
small, by how much depends on how few they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from remaster_ros.discovery.cross_validation import LeftOut
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray, IntArray

FOLDS = 10
# Fewer poses of either kind are not compared.
FEWEST_POSES = 8
# Rows that are predicted; of more, every second pose, every third, …
MOST_ROWS = 3_000


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
