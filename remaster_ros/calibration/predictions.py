# SPDX-License-Identifier: Apache-2.0
"""Predicted positions of the measurements, with 95 % regions and the share of measurements inside.

To first order the prediction is Gaussian, with the covariance Σ of the parameters' posterior
propagated by the model's derivative J, and the covariance R of the sensor's noise::

  C = J Σ J' + R,    R = σ_across² I + (σ_along² − σ_across²) s s'

with s the direction of the line of sight, and variances that are means over the posterior. A
measurement is in the 95 % region if its squared Mahalanobis distance is below the quantile of
chi-squared with three degrees of freedom. C is multiplied by one factor, the largest of these:

*1.*

*For a noise that is uncertain.* Few poses determine the noise common to the rows of a pose badly,
and all errors scale with it: a mixture of Gaussians with the covariances τ² C, the posterior of τ²
being that of the sensor's variance over its mean. As Student's t, it has longer tails than a
Gaussian with the same covariance: 95 % of it is below the q with mean F(q / τ²) = 0.95, F being
the distribution of chi-squared.

*For a model with errors.* The errors on fitted poses are smaller than on others. 95 % of the
fitted rows are in their regions when their whole pose is left out (cross-validation; Vovk et al.
2005). Gross errors do not count. For a pose with the errors e, the rows' noise R and M = J Σ J',
the errors without the pose and their covariance are, without another fit::

  e_out = R (R − M)⁻¹ e,    C_out = R (R − M)⁻¹ R

Of three or four poses none can be left out, as each determines a registration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from msgspec import Struct

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.result import FitResult
from remaster_ros.kinematics.transforms import apply, inverse
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements

REGION = 0.95
# Number of rows whose derivatives are in memory at a time.
BLOCK_ROWS = 2_000
# Largest number of poses for the factor, and of rows of each.
MOST_POSES = 1_000
MOST_ROWS = 60
POSES_AT_A_TIME = 50
# Fewest rows for a quantile of 95 %.
FEWEST_ROWS = 20


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of n rows in the frame N of each row's sensor."""

    position: FloatArray  # m, (n, 3)
    covariance: FloatArray  # With the factor, m², (n, 3, 3)
    inside: BoolArray  # Whether the measured position lies in the 95 % region, (n,)
    widening: float  # The factor on standard deviations


class Coverage(Struct, frozen=True):
    """Number and share of measurements in their 95 % regions."""

    rows: int
    inside: int
    share: float | None  # Number inside over number of rows; None without rows
    # Interval of the share with independent rows (Clopper & Pearson 1934); None without rows
    interval95: tuple[float, float] | None

    @classmethod
    def of(cls, inside: BoolArray) -> Coverage:
        """Share of rows in their regions, with its 95 % interval; None for both without rows.

        ``inside``: whether each row is in its region, (n,). The interval is Clopper and Pearson's.
        """
        rows, count = len(inside), int(inside.sum())
        if rows == 0:
            return cls(0, 0, None, None)
        low, high = (
            scipy.special.betaincinv(count + failure, rows - count + 1 - failure, quantile)
            for failure, quantile in ((0, 0.025), (1, 0.975))
        )
        interval = (float(low) if count else 0.0, float(high) if count < rows else 1.0)
        return cls(rows, count, count / rows, interval)


def predict(
    fit: FitResult,
    measurements: Measurements,
    widening: float | None = None,
) -> Predictions:
    """Predictions of all rows of a session.

    Parameters
    ----------
    fit
        The posterior.
    measurements
        Those that were fitted, in the model's order of sensors and markers.
    widening
        Factor on standard deviations; None to determine it: at least 1, as much as the noise's
        uncertainty takes, and, with enough rows (`FEWEST_ROWS`), so that 95 % of the fitted
        rows are in their regions if predicted without their pose.
    """
    model, draws = fit.predictive.model, fit.predictive.draws
    root = (draws - draws.mean(axis=0)) / np.sqrt(max(1, len(draws) - 1))
    # Σ = L' L with the triangle L of the draws: rounding leaves it positive.
    triangle = np.asarray(np.linalg.qr(root, 'r'))
    every = model.rows(measurements, np.arange(len(measurements))).of_points
    position = np.empty((len(measurements), 3))
    covariance = np.empty((len(measurements), 3, 3))
    for first, last in every.blocks(BLOCK_ROWS):
        part = _RowBlock.of(fit, every.of_groups(first, last), triangle)
        source = part.rows.source
        found = part.spread @ np.swapaxes(part.spread, 1, 2) + part.row_noise + part.pose_noise
        to_sensor = inverse(model.reference)[part.sensor]
        turn = to_sensor[:, :3, :3]
        position[source] = apply(to_sensor, part.place)
        covariance[source] = turn @ found @ np.swapaxes(turn, 1, 2)
    limit = float(scipy.special.chdtri(3, 1.0 - REGION))
    if widening is None:
        reached = [limit, _distance_of_uncertain_noise(fit, measurements, limit)]
        left_out = _left_out_distances(fit, measurements, triangle)
        if len(left_out) >= FEWEST_ROWS:
            reached.append(float(np.quantile(left_out, REGION)))
        widening = float(np.sqrt(max(reached) / limit))
    covariance *= widening**2
    distance = squared_distances(measurements.position - position, covariance)
    return Predictions(position, covariance, distance <= limit, widening)


def _distance_of_uncertain_noise(
    fit: FitResult, measurements: Measurements, limit: float
) -> float:
    """Squared distance that 95 % of errors with a noise as uncertain as this fit's do not exceed.

    At least ``limit``: the distance with a known noise, from which the search begins.
    """
    rows = np.bincount(measurements.sensor, minlength=len(fit.predictive.model.sensor_names))
    along, across = np.moveaxis(fit.predictive.sigma[..., rows > 0, :] ** 2, -1, 0)
    variance = (along + 2.0 * across) / 3.0
    squares = variance / variance.mean(axis=0)
    share = rows[rows > 0] / rows.sum()

    def beyond(distance: float) -> float:
        inside = scipy.special.chdtr(3, distance / squares).mean(axis=0) @ share
        return REGION - float(inside)

    if beyond(limit) <= 0.0:
        return limit
    # Of a posterior however wide: at the largest draw nothing is beyond.
    return float(scipy.optimize.brentq(beyond, limit, 10.0 * limit * float(squares.max())))


def squared_distances(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis distances (n,) of errors (n, 3), m, by covariances (n, 3, 3), m²."""
    solved = np.linalg.solve(covariance, errors[..., None])[..., 0]
    distances: FloatArray = np.einsum('ni,ni->n', errors, solved)
    return distances


@dataclass(frozen=True, eq=False)
class _RowBlock:
    """Predictions of some rows and the parts of their covariance, in R by the references."""

    # n rows, with the index of each row's sensor, (n,)
    rows: Rows
    sensor: IntArray
    place: FloatArray  # Predicted position, m, (n, 3)
    spread: FloatArray  # Root of the covariance by the parameters, m, (n, 3, size)
    # Covariance of the noise of one row, of the noise common to the rows of a pose, and of that
    # common to the rows of a frame, m², (n, 3, 3)
    row_noise: FloatArray
    pose_noise: FloatArray
    frame_noise: FloatArray

    @classmethod
    def of(cls, fit: FitResult, rows: Rows, triangle: FloatArray) -> _RowBlock:
        """Predicted positions and noise of rows.

        ``triangle``: U, (size, size), with U'U the covariance of the pinned parameters.
        """
        predictive = fit.predictive
        model = predictive.model
        sensor = rows.group_sensor[rows.group_of_row]
        place = model.seen(predictive.after, rows)
        spread = model.jacobian(predictive.after, rows) @ triangle.T
        sight = place - model.reference[sensor, :3, 3]
        sight /= np.linalg.norm(sight, axis=1)[:, None]
        squares = sight[:, :, None] * sight[:, None, :]

        def covariance(variances: FloatArray) -> FloatArray:
            along, across = variances[sensor].T
            total: FloatArray = across[:, None, None] * np.eye(3)
            return total + (along - across)[:, None, None] * squares

        parts = [covariance(variances) for variances in _variances(fit)]
        return cls(rows, sensor, place, spread, *parts)

    def left_out(self, pose_rows: IntArray) -> FloatArray:
        """Squared distances (n,) of the rows of one pose, predicted without that pose.

        ``pose_rows``: indices of its n rows in the block. A distance may be negative by rounding
        if the pose alone determines a parameter.
        """
        n, rows = len(pose_rows), self.rows
        group = rows.group_of_row[pose_rows]
        # Rows of a pose share an error: their noise is one matrix of n × n blocks.
        same = (group[:, None] == group).astype(float)
        noise = np.einsum('nm,nij->nimj', same, self.pose_noise[pose_rows])
        if rows.frame is not None:
            same = (rows.frame[pose_rows][:, None] == rows.frame[pose_rows]).astype(float)
            noise += np.einsum('nm,nij->nimj', same, self.frame_noise[pose_rows])
        noise[np.arange(n), :, np.arange(n)] += self.row_noise[pose_rows]
        R = noise.reshape(3 * n, 3 * n)
        root = self.spread[pose_rows].reshape(3 * n, -1)
        error = (rows.measured - self.place)[pose_rows].ravel()
        out = R @ np.linalg.solve(R - root @ root.T, np.column_stack((error, R)))
        blocks = out[:, 1:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
        return squared_distances(out[:, 0].reshape(n, 3), blocks)


def _variances(fit: FitResult) -> FloatArray:
    """Noise of a row, noise common to a pose, and noise common to a frame, m², (3, sensors, 2).

    Means of the posterior's variances; the last axis is along and across the line of sight.
    """
    variances = []
    for name in fit.predictive.model.sensor_names:
        noise = fit.noise[name]
        sides = [noise.directions.get(side, noise) for side in ('along', 'across')]
        variances.append(
            [
                (
                    side.sigma_m**2 + side.std_m**2,
                    (side.pose_sigma_m or 0.0) ** 2 + (side.pose_std_m or 0.0) ** 2,
                    (side.frame_sigma_m or 0.0) ** 2 + (side.frame_std_m or 0.0) ** 2,
                )
                for side in sides
            ]
        )
    return np.moveaxis(np.array(variances), -1, 0)


def _left_out_distances(
    fit: FitResult, measurements: Measurements, triangle: FloatArray
) -> FloatArray:
    """Squared distances (n,) of fitted rows, each predicted without its whole pose.

    Of at most 1,000 poses, evenly spread, and 60 rows of each; gross errors do not count. Empty
    without fitted rows. ``triangle``: as of `_RowBlock.of`.
    """
    gross = [observation for observation, _ in fit.left_out]
    fitted = ~measurements.is_validation & ~np.isin(measurements.observation, gross)
    poses = np.unique(measurements.pose[fitted])
    poses = poses[:: max(1, -(-len(poses) // MOST_POSES))]
    distances = [np.zeros(0)]
    for few in np.array_split(poses, -(-len(poses) // POSES_AT_A_TIME)) if len(poses) else ():
        sources = [
            np.flatnonzero(fitted & (measurements.pose == pose))[:MOST_ROWS] for pose in few
        ]
        rows = fit.predictive.model.rows(measurements, np.concatenate(sources)).of_points
        part = _RowBlock.of(fit, rows, triangle)
        for source in sources:
            selection = np.flatnonzero(np.isin(rows.source, source))
            found = part.left_out(selection)
            # If a pose alone determines a parameter, only rounding is left: it is not counted.
            distances.append(found[found >= 0.0])
    return np.concatenate(distances)
