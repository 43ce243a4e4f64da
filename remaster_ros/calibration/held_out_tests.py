"""Are held-out poses predicted as well as poses that are left out of the fit in turn?

Parameters and noise of a fit take up a part of the model's errors on the poses fitted, and nothing
of those on held-out ones: a sensor that was moved before them, or a model that does not hold where
they lie, shows there. Each pose is judged in units of what is uncertain of its prediction, the
parameters included, and by a noise estimated without it.

In units of the noise a pose has the errors e and the derivative X, and the fit the covariance Σ.
To first order, without the rows of a pose, the parameters' covariance and their change are::

    P = (Σ⁻¹ − X' X)⁻¹,    Δ = −P X' e

and any errors e with derivative X that were not fitted have, with W = (P⁻¹ + X' X)⁻¹, the squared
Mahalanobis distance::

    e' (I + X P X')⁻¹ e = e' e − e' X W X' e
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.residual_structure import LEAST_NOISE_M, StructureTest
from remaster_ros.calibration.smooth_functions import spread_poses, whitened
from remaster_ros.types import FloatArray, IntArray, Measurements

# Fewer poses of a sensor say little, held out or fitted.
FEWEST_HELD_OUT, FEWEST_FITTED = 4, 8
# So many poses of the fit are left out, evenly spread.
MOST_LEFT_OUT = 1_000
# A pose is not left out where the others would know less than this share about a direction.
LEAST_SHARE = 1e-6


def held_out_tests(
    mode: Mode, measurements: Measurements, gross: IntArray
) -> tuple[StructureTest, ...]:
    """Test for each sensor whether held-out poses are worse predicted than those left out.

    The mean of a sensor's rows at a pose and their deviations from it are judged apart: the one
    shows a sensor or base that was moved, the other what differs between joint solutions.

    Parameters
    ----------
    mode
        Of the posterior of the rows fitted.
    measurements
        That the rows were taken from.
    gross
        ``observation`` of every held-out row that is a gross error.

    Returns
    -------
    tuple of StructureTest
        Of every sensor with enough poses of either kind: a rank test (Mann and Whitney 1947,
        doi:10.1214/aoms/1177730491), which a few poses do not decide, however far out.
    """
    posterior = mode.linearisation.posterior
    kept = measurements.is_validation & ~np.isin(measurements.observation, gross)
    if not kept.any() or np.all(posterior.noise(mode.eta).sigma < LEAST_NOISE_M):
        return ()
    fitted = parts_of(mode, measurements, posterior.rows)
    reference = posterior.model.reference
    held_out = parts_of(mode, measurements, Rows.of(measurements, np.flatnonzero(kept), reference))
    precision = np.asarray(np.linalg.inv(mode.covariance), float)
    left_out = left_out_distances(fitted, precision)
    tests = []
    for key in sorted(fitted.keys() & held_out.keys()):
        expected = left_out[key]
        part = fitted[key]
        noise = _variance(part.gram.sum(axis=0), part.size.sum(), mode.covariance)
        found = held_out[key].distances(precision) / noise
        if len(found) < FEWEST_HELD_OUT or len(expected) < FEWEST_FITTED:
            continue
        p_value = scipy.stats.mannwhitneyu(found, expected, alternative='greater').pvalue
        sensor, is_mean = key
        tests.append(
            StructureTest(
                'held_out',
                is_mean,
                float(p_value),
                posterior.model.sensor_names[sensor],
                float(np.sqrt(np.median(found) / np.median(expected))),
            )
        )
    return tuple(tests)


@dataclass(frozen=True, eq=False)
class Part:
    """Means, or deviations from them, of the rows of one sensor at each of g poses.

    Attributes
    ----------
    pose
        Of the session, (g,).
    size
        How many numbers each has, (g,).
    gram
        Gram matrices of [derivative | error] in units of the noise, (g, f+1, f+1).
    """

    pose: IntArray
    size: IntArray
    gram: FloatArray

    def at(self, pose: int) -> Part:
        """Return the one at a pose, if any."""
        mine = self.pose == pose
        return Part(self.pose[mine], self.size[mine], self.gram[mine])

    def distances(self, precision: FloatArray) -> FloatArray:
        """Return squared distances over the sizes, (g,); of poses that a precision is without."""
        pull = self.gram[:, :-1, -1]
        inner = np.linalg.solve(precision + self.gram[:, :-1, :-1], pull[..., None])[..., 0]
        distances: FloatArray = (self.gram[:, -1, -1] - np.sum(pull * inner, axis=1)) / self.size
        return distances


def _variance(gram: FloatArray, size: int, covariance: FloatArray) -> float:
    """Return that of the noise, by ``size`` numbers that determined parameters."""
    freedom = size - np.sum(gram[:-1, :-1] * covariance)
    return float(gram[-1, -1] / max(freedom, 1.0))


def _shifted(gram: FloatArray, shift: FloatArray) -> FloatArray:
    """Return bordered Gram matrices (..., f+1, f+1) with the parameters shifted, (f,)."""
    change = np.eye(len(shift) + 1)
    change[:-1, -1] = -shift
    shifted: FloatArray = change.T @ gram @ change
    return shifted


def left_out_distances(
    parts: Mapping[tuple[int, bool], Part], precision: FloatArray
) -> dict[tuple[int, bool], FloatArray]:
    """Return squared distances of poses left out in turn, in units of the noise without them."""
    distances: dict[tuple[int, bool], list[FloatArray]] = {key: [] for key in parts}
    poses = np.unique(np.concatenate([part.pose for part in parts.values()]))
    scale = np.sqrt(np.diag(precision))
    sums = {key: part.gram.sum(axis=0) for key, part in parts.items()}
    for pose in poses[:: -(-len(poses) // MOST_LEFT_OUT)]:
        mine = {key: part.at(pose) for key, part in parts.items()}
        gram = np.sum([part.gram.sum(axis=0) for part in mine.values()], axis=0)
        without = precision - gram[:-1, :-1]
        if np.linalg.eigvalsh(without / np.outer(scale, scale))[0] < LEAST_SHARE:
            continue
        covariance = np.linalg.inv(without)
        shift = -covariance @ gram[:-1, -1]
        for key, part in parts.items():
            own = replace(mine[key], gram=_shifted(mine[key].gram, shift))
            others = _shifted(sums[key] - mine[key].gram.sum(axis=0), shift)
            noise = _variance(others, int(part.size.sum() - own.size.sum()), covariance)
            distances[key].append(own.distances(without) / noise)
    return {key: np.concatenate([np.zeros(0), *part]) for key, part in distances.items()}


def parts_of(mode: Mode, measurements: Measurements, rows: Rows) -> dict[tuple[int, bool], Part]:
    """Return means (True) and deviations (False) of every sensor, by its index."""
    rows = spread_poses(rows)
    white = whitened(mode, rows, {})
    columns = np.concatenate((white['model'], white['errors']), axis=2)
    mean = rows.group_sum(columns) / np.sqrt(rows.group_size)[:, None, None]
    of_means = np.swapaxes(mean, 1, 2) @ mean
    pose = measurements.pose[rows.source[rows.group_start]]
    stops = rows.group_start + rows.group_size
    of_all = np.stack(
        [
            np.tensordot(columns[start:stop], columns[start:stop], axes=((0, 1), (0, 1)))
            for start, stop in zip(rows.group_start, stops, strict=True)
        ]
    )
    parts = {}
    for sensor, _ in rows.spans:
        mine = rows.group_sensor == sensor
        several = mine & (rows.group_size > 1)
        size = np.full(mine.sum(), 3)
        parts[sensor, True] = Part(pose[mine], size, of_means[mine])
        if several.any():
            size = 3 * (rows.group_size[several] - 1)
            parts[sensor, False] = Part(pose[several], size, (of_all - of_means)[several])
    return parts
