# SPDX-License-Identifier: Apache-2.0
"""Standard deviations of the offsets with errors outside the model.

Such errors are not only noise: they shift the estimates. So smooth functions are added to the
model's columns (`smooth_functions`), each family with a Gaussian prior whose width is estimated:
a discrepancy as in Kennedy and O'Hagan (2001, doi:10.1111/1467-9868.00294). The variance of an
offset is then that of this larger model, plus the square of the distance of its estimate from
that of the model itself. A sandwich or a bootstrap by pose is no remedy: it is valid for the
limit of the wrong model with more data of the same kind, not for the truth (figures:
docs/statistics.md).
"""

from __future__ import annotations

import numpy as np
import scipy
from scipy.linalg import cho_factor, cho_solve

from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.smooth_functions import (
    of_joint_angles,
    of_joint_times,
    of_links,
    of_position,
    of_time,
    spread_poses,
    whitened,
)
from remaster_ros.types import FloatArray, Measurements

# Logarithms of the variances, in units of the noise's: start of the search, width of a weak prior
# about the start, and range.
START, PRIOR_STD = -3.0, 10.0
RANGE = (-9.0, 6.0)
NOISE_RANGE = (-3.0, 3.0)


def robust_std(mode: Mode, measurements: Measurements) -> FloatArray:
    """Standard deviation of each joint's offset with smooth errors outside the model, (k,).

    In rad or m; 0 for offsets that are held; never below that of the model. ``mode``: of the
    posterior of the fitted rows; ``measurements``: source of the rows.
    """
    posterior = mode.linearisation.posterior
    rows = spread_poses(posterior.rows)
    seconds = measurements.stamp_s[rows.source]
    links, tilts = of_links(mode, rows)
    families = {
        'position': of_position(rows),
        'time': of_time(rows, seconds),
        'joint_angle': of_joint_angles(mode, rows),
        'joint_time': of_joint_times(mode, rows, seconds),
        'link': links,
        'tilt': tilts,
    }
    white = whitened(mode, rows, families)
    f = len(posterior.free)
    parts = [white['model'].reshape(-1, f)]
    parts += [_unit(white[name]) for name in families]
    columns, errors = np.concatenate(parts, axis=1), white['errors'].ravel()
    size = np.array([part.shape[1] for part in parts[1:]])
    family = np.repeat(np.arange(len(size)), size)
    gram, pull = columns.T @ columns, columns.T @ errors
    square, count = float(errors @ errors), len(errors)
    prior = mode.linearisation.prior[:f, :f]

    def system(logs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Precision of all parameters, scaled, and the scale, for the log variances."""
        precision = gram / np.exp(logs[0])
        precision[:f, :f] += prior
        inner = np.arange(f, len(precision))
        precision[inner, inner] += np.exp(-logs[1:][family])
        scale = np.sqrt(np.diag(precision))
        return precision / np.outer(scale, scale), scale

    def cost(logs: FloatArray) -> float:
        """Minus the log likelihood with the parameters integrated out."""
        scaled, scale = system(logs)
        root = cho_factor(scaled, lower=True)
        right = pull / scale / np.exp(logs[0])
        residual_square = square / np.exp(logs[0]) - right @ cho_solve(root, right)
        determinant = np.sum(np.log(np.diag(root[0]))) + np.sum(np.log(scale))
        weak = np.sum(((logs[1:] - START) / PRIOR_STD) ** 2)
        return float(
            0.5 * (count * logs[0] + size @ logs[1:] + residual_square + weak) + determinant
        )

    start = np.append(0.0, np.full(len(size), START))
    bounds = [NOISE_RANGE, *[RANGE] * len(size)]
    logs = scipy.optimize.minimize(cost, start, method='L-BFGS-B', bounds=bounds).x
    scaled, scale = system(logs)
    root = cho_factor(scaled, lower=True)
    shift = cho_solve(root, pull / scale / np.exp(logs[0])) / scale
    variance = np.diag(cho_solve(root, np.eye(len(scale)))) / scale**2
    joints = np.flatnonzero(posterior.free < posterior.model.joints)
    least = np.diag(mode.covariance)[joints]
    std = np.zeros(posterior.model.joints)
    std[posterior.free[joints]] = np.sqrt(np.maximum(variance[joints], least) + shift[joints] ** 2)
    return std


def _unit(columns: FloatArray) -> FloatArray:
    """Columns (n, 3, c) without those of zeros, as (3 n, c), each scaled by itself.

    The mean over the n rows of a column's squared length (3,) becomes 1. Zeros: below 1e-9 of the
    longest column.
    """
    flat = columns.reshape(-1, columns.shape[2])
    length = np.linalg.norm(flat, axis=0)
    kept = length > 1e-9 * np.max(length)
    unit: FloatArray = flat[:, kept] / length[kept] * np.sqrt(len(columns))
    return unit
