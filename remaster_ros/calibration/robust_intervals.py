"""Standard deviations of the offsets that hold where the model leaves other errors out.

What is left out is not only noise: it shifts the estimates. So smooth functions stand beside the
model's columns (`smooth_functions`), each family with a Gaussian prior whose width is estimated: a
discrepancy as Kennedy and O'Hagan (2001, doi:10.1111/1467-9868.00294) have it. The variance of an
offset is then that of this larger model, plus the square of how far its estimate is from that of
the model itself. A sandwich or a bootstrap by pose is no remedy: it holds for where the wrong
model would end with more data of the same kind, not for the truth (figures: docs/statistics.md).
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

# Logarithms of the variances, in units of the noise's: where the search begins, the width of a
# weak prior about it, and how far it may go.
START, PRIOR_STD = -3.0, 10.0
RANGE = (-9.0, 6.0)
NOISE_RANGE = (-3.0, 3.0)


def robust_std(mode: Mode, measurements: Measurements) -> FloatArray:
    """Return the standard deviation of each joint's offset with a discrepancy, rad, (k,).

    0 for offsets that are held. Never below that of the model.

    Parameters
    ----------
    mode
        Of the posterior of the rows fitted.
    measurements
        That the rows were taken from.
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
        """Return the precision of all parameters and their scale for the log variances."""
        precision = gram / np.exp(logs[0])
        precision[:f, :f] += prior
        inner = np.arange(f, len(precision))
        precision[inner, inner] += np.exp(-logs[1:][family])
        scale = np.sqrt(np.diag(precision))
        return precision / np.outer(scale, scale), scale

    def cost(logs: FloatArray) -> float:
        """Return minus the log likelihood, the parameters integrated out."""
        scaled, scale = system(logs)
        root = cho_factor(scaled, lower=True)
        right = pull / scale / np.exp(logs[0])
        left = square / np.exp(logs[0]) - right @ cho_solve(root, right)
        determinant = np.sum(np.log(np.diag(root[0]))) + np.sum(np.log(scale))
        weak = np.sum(((logs[1:] - START) / PRIOR_STD) ** 2)
        return float(0.5 * (count * logs[0] + size @ logs[1:] + left + weak) + determinant)

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
    """Return columns (n, 3, c), but those of zeros, as (3 n, c) with a mean square of 1 a row."""
    flat = columns.reshape(-1, columns.shape[2])
    length = np.linalg.norm(flat, axis=0)
    kept = length > 1e-9 * np.max(length)
    unit: FloatArray = flat[:, kept] / length[kept] * np.sqrt(len(columns))
    return unit
