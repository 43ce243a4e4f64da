# SPDX-License-Identifier: Apache-2.0
"""Comparison of held-out poses with poses that are left out of the fit in turn.

Parameters and noise of a fit absorb a part of the model's errors on the fitted poses, and nothing
on held-out ones: a sensor that was moved before them, or a model that does not hold there, shows.
Each pose is judged in units of its prediction's uncertainty, the parameters included, and by a
noise estimated without it.

In units of the noise a pose has the errors e and the derivative X, and the fit the covariance Σ.
To first order, with the pose left out, its errors and their covariance are::

    u = (I − X Σ X')⁻¹ e,    (I − X Σ X')⁻¹

and the parameters move by Σ X' u. Errors that were not fitted have the covariance I + X Σ X'.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.residual_structure import LEAST_NOISE_M, StructureTest
from remaster_ros.calibration.smooth_functions import spread_poses, whitened
from remaster_ros.types import FloatArray, IntArray, Measurements

# Least numbers of held-out and of fitted poses of a sensor for a comparison.
FEWEST_HELD_OUT, FEWEST_FITTED = 4, 8
# Number of poses above which their ranks count as normal: SciPy's own limit, for equal p-values.
FEW = 8
# Largest number of poses that are left out, evenly spread.
MOST_LEFT_OUT = 1_000
# A pose is not left out if the others have less than this share of the information on a direction.
LEAST_SHARE = 1e-6


@dataclass(frozen=True, eq=False)
class Contrasts:
    """Mean and deviations of each sensor's rows at a pose, independent, in units of the noise.

    The mean shows a sensor or base that was moved, deviations show differences between joint
    solutions. (The rows of Helmert's matrix: the first has equal numbers, all have length one.)
    """

    pose: IntArray  # Pose of each contrast in the session, (n,)
    kind: IntArray  # Twice the sensor's index, and one more for a mean, (n,)
    derivative: FloatArray  # (n, 3, f)
    errors: FloatArray  # (n, 3)

    @classmethod
    def of(cls, rows: Rows, measurements: Measurements, white: FloatArray) -> Contrasts:
        """Contrasts of the rows' [derivative | error] in units of the noise.

        ``white``: (n, 3, f + 1), the error last; ``rows``: the same n rows, grouped by pose.
        """
        formed = np.empty_like(white)
        for size in np.unique(rows.group_size).tolist():
            at = rows.group_start[rows.group_size == size][:, None] + np.arange(size)
            formed[at] = np.einsum('ij,gj...->gi...', scipy.linalg.helmert(size, True), white[at])
        kind = 2 * rows.group_sensor[rows.group_of_row]
        kind[rows.group_start] += 1
        return cls(measurements.pose[rows.source], kind, formed[..., :-1], formed[..., -1])

    def gram(self, kind: int) -> FloatArray:
        """Gram matrix of [derivative | error] of the contrasts of one kind, (f + 1, f + 1).

        ``kind``: twice the sensor's index, and one more for means of poses.
        """
        of_kind = self.kind == kind
        both = np.concatenate((self.derivative[of_kind], self.errors[of_kind][..., None]), axis=2)
        flat = both.reshape(-1, both.shape[2])
        gram: FloatArray = flat.T @ flat
        return gram

    def distances(self, kind: int, covariance: FloatArray) -> Iterator[float]:
        """Yield the squared Mahalanobis distance of each pose of one kind, per error of the pose.

        For a pose that was not fitted: e' (I + X Σ X')⁻¹ e / (number of e), with its errors e
        and their derivative X. ``kind``: twice the sensor's index, and one more for means of
        poses; ``covariance``: Σ of the parameters in units of the noise, (f, f).
        """
        for pose in np.unique(self.pose[self.kind == kind]):
            of_pose = (self.kind == kind) & (self.pose == pose)
            X, e = (
                self.derivative[of_pose].reshape(-1, len(covariance)),
                self.errors[of_pose].ravel(),
            )
            yield float(e @ np.linalg.solve(np.eye(len(e)) + X @ covariance @ X.T, e)) / len(e)


def compared(
    fitted: Contrasts, held_out: Contrasts, covariance: FloatArray
) -> Iterator[tuple[int, float, float]]:
    """Compare held-out poses with poses left out of the fit, for each kind of contrasts.

    By ranks (Mann and Whitney 1947, doi:10.1214/aoms/1177730491), which a few far outliers do not
    decide.

    Parameters
    ----------
    fitted, held_out
        Contrasts of the errors of either.
    covariance
        Covariance of the parameters, (f, f).

    Yields
    ------
    int, float, float
        Kind, probability of errors as large by chance, and ratio of the typical errors, each in
        units of their uncertainty; for each kind with enough poses of either.
    """
    expected = left_out_distances(fitted, covariance)
    for kind in np.intersect1d(fitted.kind, held_out.kind).tolist():
        size = 3 * int(np.sum(fitted.kind == kind))
        noise = _variance(fitted.gram(kind), size, covariance)
        found = np.array([*held_out.distances(kind, covariance)]) / noise
        if len(found) < FEWEST_HELD_OUT or len(expected[kind]) < FEWEST_FITTED:
            continue
        ratio = float(np.sqrt(np.median(found) / np.median(expected[kind])))
        yield kind, _p_value_larger(found, expected[kind]), ratio


def _p_value_larger(found: FloatArray, expected: FloatArray) -> float:
    """Probability by chance that numbers (n,) rank as high among others (m,), one-sided.

    Mann and Whitney's test: exact if either has at most 8 (`FEW`), else by a normal distribution
    with continuity correction.
    """
    n, m = len(found), len(expected)
    larger = int(np.searchsorted(np.sort(expected), found).sum())
    if min(n, m) <= FEW:
        return _share_of_orders(n, m, larger)
    std = np.sqrt(n * m * (n + m + 1) / 12.0)
    return float(scipy.special.ndtr(-(larger - 0.5 * n * m - 0.5) / std))


def _share_of_orders(n: int, m: int, larger: int) -> float:
    """Share of all orders of n numbers among m others in which so many pairs or more are larger.

    The orders with u such pairs are the coefficient of q^u in the product of
    (1 - q^(m + i)) / (1 - q^i) over i = 1 to n. SciPy's test has the same, but its statistics take
    half a second to import.
    """
    n, m = min(n, m), max(n, m)
    orders = np.zeros(n * m + 1)
    orders[0] = 1.0
    for i in range(1, n + 1):
        orders[m + i :] -= orders[: len(orders) - m - i].copy()
        for start in range(i):
            orders[start::i] = np.cumsum(orders[start::i])
    # It is symmetric: the smaller counts are exact.
    return float(orders[: n * m - larger + 1].sum() / orders.sum())


def left_out_distances(fitted: Contrasts, covariance: FloatArray) -> dict[int, FloatArray]:
    """Squared Mahalanobis distance of each fitted pose by the fit without that pose, by kind.

    Dict: kind of contrasts -> (poses with the kind,). The distance is divided by the number of
    the pose's errors of the kind. The noise is estimated without the pose, too. At most 1,000
    poses, evenly spread; poses that alone determine a direction are skipped. ``covariance``:
    of the parameters, (f, f).
    """
    kinds = np.unique(fitted.kind).tolist()
    f = len(covariance)
    distances: dict[int, list[float]] = {kind: [] for kind in kinds}
    grams = {kind: fitted.gram(kind) for kind in kinds}
    flat = fitted.derivative.reshape(-1, f)
    spread = flat @ covariance
    # Change of a kind's degrees of freedom by each row, which determines its noise.
    by_kind = {kind: spread @ grams[kind][:f, :f] @ covariance for kind in kinds}
    free = {kind: float(np.sum(grams[kind][:f, :f] * covariance)) for kind in kinds}
    of_kind = np.repeat(fitted.kind, 3)
    pose = np.repeat(fitted.pose, 3)
    poses = np.unique(fitted.pose)
    for out in poses[:: -(-len(poses) // MOST_LEFT_OUT)]:
        rows = np.flatnonzero(pose == out)
        X, e = flat[rows], fitted.errors.ravel()[rows]
        known = np.eye(len(rows)) - spread[rows] @ X.T
        if np.linalg.eigvalsh(known)[0] < LEAST_SHARE:
            continue
        without = np.linalg.inv(known)
        u = without @ e
        step = np.append(spread[rows].T @ u, 1.0)
        for kind in np.unique(of_kind[rows]).tolist():
            kind_rows = of_kind[rows] == kind
            uncertain = without[np.ix_(kind_rows, kind_rows)]
            square = step @ grams[kind] @ step - u[kind_rows] @ u[kind_rows]
            spent = free[kind] + np.sum(without * (by_kind[kind][rows] @ X.T))
            spent -= np.trace(uncertain) - kind_rows.sum()
            freedom = np.sum(of_kind == kind) - kind_rows.sum() - spent
            distance = u[kind_rows] @ np.linalg.solve(uncertain, u[kind_rows]) / kind_rows.sum()
            distances[kind].append(distance * max(freedom, 1.0) / square)
    return {kind: np.array(found) for kind, found in distances.items()}


def _variance(gram: FloatArray, size: int, covariance: FloatArray) -> float:
    """Variance of the noise: sum of squared errors over the degrees of freedom (at least 1).

    The degrees of freedom are ``size``, the number of errors, less the trace of the columns'
    Gram matrix times ``covariance``. ``gram``: Gram matrix of [columns | errors at the fit],
    (f + 1, f + 1); ``covariance``: of the fitted parameters in units of the noise, (f, f).
    """
    freedom = size - np.sum(gram[:-1, :-1] * covariance)
    return float(gram[-1, -1] / max(freedom, 1.0))


def held_out_tests(
    mode: Mode, measurements: Measurements, gross: IntArray
) -> tuple[StructureTest, ...]:
    """Test for each sensor of a fit whether held-out poses are predicted worse than fitted ones.

    Each fitted pose is predicted by the fit without that pose; errors are in units of their
    uncertainty. Separate tests for means of poses and for deviations from them, of sensors with
    enough poses of either; () without held-out rows or if all noise is below 1 µm. ``mode``:
    maximum of the posterior of the fitted rows; ``measurements``: all rows; ``gross``:
    ``observation`` of each held-out row that is a gross error.
    """
    posterior = mode.linearisation.posterior
    kept = measurements.is_validation & ~np.isin(measurements.observation, gross)
    if not kept.any() or np.all(posterior.noise(mode.eta).sigma < LEAST_NOISE_M):
        return ()
    held_out = posterior.model.rows_of_path(measurements, np.flatnonzero(kept)).of_points
    fitted = _contrasts(mode, measurements, spread_poses(posterior.rows))
    held_out_contrasts = _contrasts(mode, measurements, spread_poses(held_out))
    return tuple(
        StructureTest(
            'held_out', kind % 2 == 1, p_value, posterior.model.sensor_names[kind // 2], ratio
        )
        for kind, p_value, ratio in compared(fitted, held_out_contrasts, mode.covariance)
    )


def _contrasts(mode: Mode, measurements: Measurements, rows: Rows) -> Contrasts:
    """Contrasts of rows, n, at a mode, in units of its noise: whitened derivative and error."""
    white = whitened(mode, rows, {})
    joined = np.concatenate((white['model'], white['errors']), axis=2)
    return Contrasts.of(rows, measurements, joined)
